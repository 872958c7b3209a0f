// One or two points of the surface: where they are, and how far apart.
import { BufferGeometry, Group, Line, LineBasicMaterial, Points, PointsMaterial, Vector3 } from 'three';

const COLOUR = 0xd4351c;

export class Measure {
	points = [];
	group = new Group();
	#geometry = new BufferGeometry();

	constructor(panel) {
		this.panel = panel;
		// Drawn over everything, so that a point behind an edge is not lost.
		const over = { color: COLOUR, depthTest: false, transparent: true };
		this.group.add(
			new Points(this.#geometry, new PointsMaterial({ ...over, size: 9, sizeAttenuation: false })),
			new Line(this.#geometry, new LineBasicMaterial(over)),
		);
		for (const part of this.group.children) {
			part.frustumCulled = false;
			part.renderOrder = 1;
		}
		this.clear();
	}

	clear() {
		this.points = [];
		this.#show(null);
	}

	// A third point starts anew.
	add(point, place) {
		if (this.points.length === 2) this.points = [];
		this.points.push(point.clone());
		this.#show(place);
	}

	#show(place) {
		this.group.visible = this.points.length > 0;
		this.panel.hidden = this.points.length === 0;
		if (!this.points.length) return;
		// A buffer cannot grow, so each number of points has one of its own.
		this.#geometry.dispose();
		this.#geometry = new BufferGeometry().setFromPoints(this.points);
		for (const part of this.group.children) part.geometry = this.#geometry;
		const [first, second] = this.points;
		const tables = this.points.map((point, index) => ({ title: this.points.length > 1 ? `Point ${index + 1}` : 'Point', rows: place.describe(point) }));
		if (second) {
			const step = new Vector3().subVectors(second, first);
			tables.push({
				title: 'Between them',
				rows: [
					['Distance', place.length(step.length())],
					['Level distance', place.length(Math.hypot(step.x, step.z))],
					['Height difference', place.length(step.y)],
				],
			});
		}
		this.panel.replaceChildren(...tables.map(tableOf));
	}
}

function tableOf({ title, rows }) {
	const table = document.createElement('table');
	table.createCaption().textContent = title;
	for (const [name, value] of rows) {
		const row = table.insertRow();
		const head = document.createElement('th');
		head.textContent = name;
		row.append(head);
		row.insertCell().textContent = value;
	}
	return table;
}
