// What is shown: a tileset, whose tiles come and go with the camera, or one mesh. Both answer to the same calls.
import { Box3, Group, LoadingManager, Sphere } from 'three';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
import { MeshoptDecoder } from 'three/addons/libs/meshopt_decoder.module.js';
import { TilesRenderer } from '3d-tiles-renderer/three';
import { placeOfMesh, placeOfTileset } from './place.js';
import { trianglesOf } from './surface.js';

function loaderWith(manager) {
	return new GLTFLoader(manager).setMeshoptDecoder(MeshoptDecoder);
}

function copyrights(gltf, set) {
	const text = gltf?.asset?.copyright;
	if (typeof text === 'string' && text.trim()) set.add(text.trim());
}

function setPlace(group, place) {
	place.toScene.decompose(group.position, group.quaternion, group.scale);
	group.updateMatrixWorld(true);
}

// An error of loading in words.
export function inWords(error, what) {
	const text = String(error?.message ?? error);
	if (/\bstatus(?: code)?:? "?404|: 404|Error Code 404/i.test(text)) return `${what} is missing from the folder.`;
	if (error instanceof TypeError && /fetch|network/i.test(text)) return `${what}: the server does not answer. Is sat3d view still running?`;
	if (error instanceof SyntaxError) return `${what} is broken: ${text}.`;
	return `${what} cannot be shown: ${text}`;
}

// `on` has: place(), change(), scene(scene) for each newly loaded part, error(text).
export class Tileset {
	kind = 'tileset';
	place = null;
	asset = {};
	copyrights = new Set();
	#triangles = new WeakMap();

	constructor(url, base, camera, on) {
		this.base = base;
		const tiles = new TilesRenderer(url);
		tiles.manager.addHandler(/\.(gltf|glb)$/i, loaderWith(tiles.manager));
		tiles.setCamera(camera);
		this.tiles = tiles;
		this.camera = camera;
		this.group = tiles.group;
		const start = () => {
			if (this.place || !tiles.root?.engineData?.boundingVolume) return;
			this.asset = tiles.rootTileset?.asset ?? {};
			this.place = placeOfTileset(tiles);
			setPlace(this.group, this.place);
			on.place();
		};
		tiles.addEventListener('load-root-tileset', start);
		tiles.addEventListener('load-model', ({ scene, tile }) => {
			copyrights(tile.engineData.metadata, this.copyrights);
			this.#triangles.set(scene, trianglesOf(scene));
			on.scene(scene);
			on.change();
		});
		tiles.addEventListener('load-error', ({ error, url }) => on.error(inWords(error, this.#name(url))));
		for (const name of ['needs-update', 'load-tileset', 'tile-visibility-change', 'tiles-load-end']) {
			tiles.addEventListener(name, on.change);
		}
	}

	#name(url) {
		const text = decodeURIComponent(String(url));
		return text.startsWith(this.base) ? text.slice(this.base.length) : text;
	}

	update(renderer) {
		this.tiles.setResolutionFromRenderer(this.camera, renderer);
		this.tiles.update();
		return this.tiles.isLoading;
	}

	set error(pixels) {
		this.tiles.errorTarget = pixels;
	}

	// In the scene's coordinates.
	sphere() {
		const sphere = new Sphere();
		this.tiles.getBoundingSphere(sphere);
		return sphere.applyMatrix4(this.place.toScene);
	}

	scenes() {
		const scenes = [];
		this.tiles.forEachLoadedModel((scene) => scenes.push(scene));
		return scenes;
	}

	statistics() {
		let tiles = 0;
		let triangles = 0;
		for (const tile of this.tiles.visibleTiles) {
			const scene = tile.engineData.scene;
			if (!scene) continue;
			tiles++;
			triangles += this.#triangles.get(scene) ?? 0;
		}
		const { queued, downloading, parsing, failed } = this.tiles.stats;
		const loaded = this.scenes();
		const loadedTriangles = loaded.reduce((sum, scene) => sum + (this.#triangles.get(scene) ?? 0), 0);
		return { tiles, triangles, loaded: loaded.length, loadedTriangles, waiting: queued + downloading + parsing, failed };
	}

	dispose() {
		this.tiles.dispose();
		this.group.removeFromParent();
	}
}

export class Mesh {
	kind = 'mesh';
	place = null;
	asset = {};
	copyrights = new Set();
	group = new Group();
	#waiting = 1;
	#triangles = 0;
	#disposed = false;

	constructor(url, name, on) {
		loaderWith(new LoadingManager()).loadAsync(url).then((gltf) => {
			if (this.#disposed) return;
			this.asset = { ...gltf.asset, extras: { ...gltf.asset.extras, ...gltf.scene.userData } };
			copyrights(gltf, this.copyrights);
			this.#triangles = trianglesOf(gltf.scene);
			this.place = placeOfMesh(gltf);
			this.group.add(gltf.scene);
			setPlace(this.group, this.place);
			on.scene(gltf.scene);
			on.place();
		}).catch((error) => on.error(inWords(error, name))).finally(() => {
			this.#waiting = 0;
			on.change();
		});
	}

	update() {
		return false;
	}

	sphere() {
		return new Box3().setFromObject(this.group).getBoundingSphere(new Sphere());
	}

	scenes() {
		return [...this.group.children];
	}

	statistics() {
		const tiles = this.group.children.length;
		return { tiles, triangles: this.#triangles, loaded: tiles, loadedTriangles: this.#triangles, waiting: this.#waiting, failed: 0 };
	}

	dispose() {
		this.#disposed = true;
		this.group.traverse((part) => {
			if (!part.isMesh) return;
			part.geometry.dispose();
		});
		this.group.removeFromParent();
	}
}
