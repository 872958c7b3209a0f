// How surfaces are drawn: as in the file, or without their picture, so that the shape is seen.
import { DoubleSide, MeshBasicMaterial, MeshLambertMaterial, MeshNormalMaterial } from 'three';

export const MODES = ['picture', 'shaded', 'normals', 'wireframe'];

export class Surface {
	#mode = 'picture';
	#originals = new WeakMap();
	// Flat shading: the facets themselves, and files need no normals for it.
	#materials = {
		shaded: new MeshLambertMaterial({ color: 0xb9b4aa, flatShading: true, side: DoubleSide }),
		normals: new MeshNormalMaterial({ flatShading: true, side: DoubleSide }),
		wireframe: new MeshBasicMaterial({ color: 0x3c7fb1, wireframe: true }),
	};

	get mode() {
		return this.#mode;
	}

	set(mode, scenes) {
		this.#mode = mode;
		for (const scene of scenes) this.apply(scene);
	}

	apply(scene) {
		scene.traverse((part) => {
			if (!part.isMesh) return;
			if (!this.#originals.has(part)) this.#originals.set(part, part.material);
			part.material = this.#materials[this.#mode] ?? this.#originals.get(part);
		});
	}
}

export function trianglesOf(scene) {
	let count = 0;
	scene.traverse((part) => {
		if (!part.isMesh) return;
		const { index, attributes } = part.geometry;
		count += Math.floor((index ?? attributes.position).count / 3);
	});
	return count;
}
