// The texts around the picture.
import { number } from './place.js';

export const element = (id) => document.getElementById(id);

// Nested objects become `a.b`; lists of plain values one line.
function* rows(value, prefix = '') {
	for (const [key, item] of Object.entries(value ?? {})) {
		const name = prefix + key;
		const plainList = Array.isArray(item) && item.every((part) => typeof part !== 'object');
		if (item === null || item === undefined) continue;
		if (plainList) yield [name, item.join(', ')];
		else if (typeof item === 'object') yield* rows(item, `${name}.`);
		else yield [name, String(item)];
	}
}

const ATTRIBUTION = /^(attributions?|copyright|credits?)$/i;

export function showAbout(asset, copyrights) {
	const list = element('metadata');
	const { extras, ...rest } = asset;
	list.replaceChildren(...[...rows(extras), ...rows(rest, 'asset.')].flatMap(([name, text]) => {
		const term = document.createElement('dt');
		term.textContent = name.replaceAll('_', ' ');
		const said = document.createElement('dd');
		said.textContent = text;
		return [term, said];
	}));
	element('about').hidden = !list.children.length;
	showAttribution(asset, copyrights);
}

export function showAttribution(asset, copyrights) {
	const said = new Set(copyrights);
	if (typeof asset.copyright === 'string') said.add(asset.copyright);
	for (const [key, value] of Object.entries(asset.extras ?? {})) {
		if (ATTRIBUTION.test(key)) for (const text of [value].flat()) if (typeof text === 'string') said.add(text);
	}
	element('attribution').textContent = [...said].join(' · ');
}

export function showStatistics(model) {
	const { tiles, triangles, loaded, loadedTriangles, waiting, failed } = model.statistics();
	const count = (value, name) => `${number(value)} ${name}${value === 1 ? '' : 's'}`;
	let text = `${count(triangles, 'triangle')} shown`;
	if (model.kind === 'tileset') {
		text = `${count(tiles, 'tile')}, ${count(triangles, 'triangle')} shown; ${count(loaded, 'tile')}, ${count(loadedTriangles, 'triangle')} loaded`;
	}
	if (waiting) text += model.kind === 'tileset' ? `; ${number(waiting)} on the way` : '; loading';
	if (failed) text += `; ${number(failed)} failed`;
	element('statistics').textContent = text;
}

const MOST_ERRORS = 5;
const errors = new Map();

// Each error once, with how often it came.
export function showError(text) {
	errors.set(text, (errors.get(text) ?? 0) + 1);
	const all = [...errors];
	const box = element('errors');
	box.replaceChildren(...all.slice(0, MOST_ERRORS).map(([said, times]) => {
		const line = document.createElement('p');
		line.textContent = times > 1 ? `${said} (${times} times)` : said;
		return line;
	}));
	if (all.length > MOST_ERRORS) {
		const line = document.createElement('p');
		line.textContent = `and ${all.length - MOST_ERRORS} more`;
		box.append(line);
	}
	box.hidden = false;
}

export function clearErrors() {
	errors.clear();
	element('errors').replaceChildren();
	element('errors').hidden = true;
}

// Instead of a picture.
export function showMessage(text) {
	element('message').textContent = text;
	element('message').hidden = !text;
}

// A bar of 1, 2 or 5 times a power of ten, at most `most` pixels wide.
export function showScale(unitsPerPixel, unit, most = 140) {
	const box = element('scale');
	box.hidden = !(unitsPerPixel > 0) || !Number.isFinite(unitsPerPixel);
	if (box.hidden) return;
	const longest = unitsPerPixel * most;
	const power = 10 ** Math.floor(Math.log10(longest));
	const length = [5, 2, 1].find((step) => step * power <= longest) * power;
	element('scale-bar').style.width = `${length / unitsPerPixel}px`;
	const kilometres = unit === 'm' && length >= 1000;
	const shown = Number((kilometres ? length / 1000 : length).toPrecision(1));
	element('scale-text').textContent = `${shown} ${kilometres ? 'km' : unit} at the middle`;
}
