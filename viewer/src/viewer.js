// The page of `sat3d view`: asks the server what there is and draws it. Pictures are drawn when something changed,
// not all the time: the page also runs where the processor does the graphics.
import {
	AmbientLight, Color, DirectionalLight, MathUtils, PerspectiveCamera, Raycaster, Scene, Sphere, Spherical, Vector2, Vector3, WebGLRenderer,
} from 'three';
import { OrbitControls } from 'three/addons/controls/OrbitControls.js';
import { Measure } from './measure.js';
import { inWords, Mesh, Tileset } from './models.js';
import { clearErrors, element, showAbout, showAttribution, showError, showMessage, showScale, showStatistics } from './panel.js';
import { MODES, Surface } from './surface.js';

const canvas = element('scene');
const state = document.documentElement.dataset;
state.state = 'loading';

let renderer;
try {
	renderer = new WebGLRenderer({ canvas, antialias: true });
} catch {
	state.state = 'failed';
	showMessage('This browser gives no WebGL 2, so nothing can be drawn. Turn on hardware acceleration or software rendering (SwiftShader), or open the address in another browser.');
}
if (renderer) start();

function start() {
	const camera = new PerspectiveCamera(45, 1, 0.1, 1000);
	const scene = new Scene();
	const controls = new OrbitControls(camera, canvas);
	const surface = new Surface();
	const measure = new Measure(element('measure'));
	const raycaster = new Raycaster();
	raycaster.firstHitOnly = true;
	let model = null;
	let items = [];
	let bounds = new Sphere(new Vector3(), 100);
	let flight = null;

	controls.enableDamping = !matchMedia('(prefers-reduced-motion: reduce)').matches;
	controls.dampingFactor = 0.15;
	controls.zoomToCursor = true;
	controls.screenSpacePanning = false;
	controls.maxPolarAngle = MathUtils.degToRad(89);
	controls.addEventListener('change', invalidate);
	controls.addEventListener('start', () => { flight = null; });

	const sun = new DirectionalLight(0xffffff, 2.2);
	// From the north-west, as in shaded relief.
	sun.position.set(-1, 1.6, -0.8);
	scene.add(new AmbientLight(0xffffff, 1.1), sun, measure.group);

	const dark = matchMedia('(prefers-color-scheme: dark)');
	const paint = () => {
		scene.background = new Color(getComputedStyle(document.documentElement).getPropertyValue('--ground').trim());
		invalidate();
	};
	dark.addEventListener('change', paint);
	new ResizeObserver(resize).observe(canvas);

	// ---- drawing

	let asked = false;
	function invalidate() {
		if (asked) return;
		asked = true;
		requestAnimationFrame(draw);
	}

	function resize() {
		const { clientWidth: width, clientHeight: height } = canvas;
		if (!width || !height) return;
		renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
		renderer.setSize(width, height, false);
		camera.aspect = width / height;
		invalidate();
	}

	function draw(now) {
		asked = false;
		fly(now);
		controls.update();
		const distance = camera.position.distanceTo(controls.target);
		camera.near = Math.max(distance * 0.005, bounds.radius * 1e-4);
		camera.far = camera.position.distanceTo(bounds.center) + 2 * bounds.radius + distance;
		camera.updateProjectionMatrix();
		camera.updateMatrixWorld();
		const loading = model?.update(renderer);
		renderer.render(scene, camera);
		if (model) showStatistics(model);
		const perPixel = 2 * distance * Math.tan(MathUtils.degToRad(camera.fov) / 2) / canvas.clientHeight;
		showScale(model?.place ? perPixel : 0, model?.place?.unit);
		element('needle').style.transform = `rotate(${controls.getAzimuthalAngle()}rad)`;
		if (loading) setTimeout(invalidate, 100);
		else if (model?.place && state.state === 'loading') state.state = 'ready';
	}

	// ---- the camera

	// Moves camera and target over a third of a second.
	function flyTo(position, target) {
		if (!controls.enableDamping) {
			camera.position.copy(position);
			controls.target.copy(target);
		} else {
			flight = { from: camera.position.clone(), to: position, fromTarget: controls.target.clone(), toTarget: target, start: null };
		}
		invalidate();
	}

	function fly(now) {
		if (!flight) return;
		flight.start ??= now;
		const part = Math.min((now - flight.start) / 330, 1);
		const eased = part * part * (3 - 2 * part);
		camera.position.lerpVectors(flight.from, flight.to, eased);
		controls.target.lerpVectors(flight.fromTarget, flight.toTarget, eased);
		if (part === 1) flight = null;
		else invalidate();
	}

	function offset() {
		return new Spherical().setFromVector3(new Vector3().subVectors(camera.position, controls.target));
	}

	function view(spherical, target = controls.target.clone()) {
		spherical.phi = MathUtils.clamp(spherical.phi, 1e-4, controls.maxPolarAngle);
		spherical.radius = MathUtils.clamp(spherical.radius, controls.minDistance, controls.maxDistance);
		flyTo(new Vector3().setFromSpherical(spherical).add(target), target);
	}

	// The distance from which the whole scene is seen.
	function whole() {
		const half = MathUtils.degToRad(camera.fov) / 2;
		return bounds.radius / Math.sin(Math.min(half, Math.atan(Math.tan(half) * camera.aspect)));
	}

	const home = () => view(new Spherical(whole() * 0.8, MathUtils.degToRad(50), 0), bounds.center.clone());
	const fromAbove = () => view(new Spherical(offset().radius, 1e-4, 0));
	const northUp = () => {
		const now = offset();
		view(new Spherical(now.radius, now.phi, 0));
	};

	function frame() {
		bounds = model.sphere();
		if (!(bounds.radius > 0)) bounds.radius = 1;
		controls.minDistance = bounds.radius * 1e-3;
		controls.maxDistance = bounds.radius * 20;
		const damping = controls.enableDamping;
		controls.enableDamping = false;
		home();
		controls.enableDamping = damping;
	}

	// ---- picking

	function hit(x, y) {
		if (!model?.place) return null;
		const box = canvas.getBoundingClientRect();
		raycaster.setFromCamera(new Vector2((x - box.left) / box.width * 2 - 1, 1 - (y - box.top) / box.height * 2), camera);
		return raycaster.intersectObject(model.group, true)[0]?.point ?? null;
	}

	function pick(x, y) {
		const point = hit(x, y);
		if (point) measure.add(point, model.place);
		else measure.clear();
		invalidate();
	}

	let pressed = null;
	let clicking = null;
	canvas.addEventListener('pointerdown', (event) => {
		pressed = event.isPrimary && event.button === 0 ? { x: event.clientX, y: event.clientY } : null;
	});
	canvas.addEventListener('pointerup', (event) => {
		const still = pressed && Math.hypot(event.clientX - pressed.x, event.clientY - pressed.y) < 4;
		pressed = null;
		if (!still || event.shiftKey || event.ctrlKey || event.metaKey) return;
		clearTimeout(clicking);
		// It may become a double click.
		clicking = setTimeout(() => pick(event.clientX, event.clientY), 250);
	});
	canvas.addEventListener('dblclick', (event) => {
		clearTimeout(clicking);
		const point = hit(event.clientX, event.clientY);
		if (!point) return;
		const now = offset();
		now.radius /= 2;
		view(now, point);
	});

	// ---- controls of the page

	function setMode(mode) {
		surface.set(mode, model?.scenes() ?? []);
		for (const button of element('modes').querySelectorAll('button')) {
			button.setAttribute('aria-pressed', String(button.dataset.mode === mode));
		}
		invalidate();
	}

	const detail = element('detail');
	function setDetail() {
		const pixels = 2 ** Number(detail.value);
		element('detail-value').textContent = String(Number(pixels.toPrecision(2)));
		if (model?.kind === 'tileset') model.error = pixels;
		invalidate();
	}

	function fold() {
		const hidden = !element('controls').hidden;
		element('controls').hidden = hidden;
		element('fold').setAttribute('aria-expanded', String(!hidden));
		element('fold').textContent = hidden ? '+' : '–';
	}

	element('modes').addEventListener('click', (event) => {
		if (event.target.dataset.mode) setMode(event.target.dataset.mode);
	});
	detail.addEventListener('input', setDetail);
	element('fold').addEventListener('click', fold);
	element('home').addEventListener('click', home);
	element('top').addEventListener('click', fromAbove);
	element('compass').addEventListener('click', northUp);
	element('help-open').addEventListener('click', () => element('help').showModal());
	element('items').addEventListener('change', (event) => show(items[Number(event.target.value)]));

	function turn(across, down) {
		const now = offset();
		now.theta += across;
		now.phi += down;
		view(now);
	}

	function move(right, ahead) {
		const now = offset();
		const step = now.radius * 0.15;
		const across = new Vector3(Math.cos(now.theta), 0, -Math.sin(now.theta)).multiplyScalar(right * step);
		across.add(new Vector3(-Math.sin(now.theta), 0, -Math.cos(now.theta)).multiplyScalar(ahead * step));
		view(now, controls.target.clone().add(across));
	}

	function zoom(factor) {
		const now = offset();
		now.radius *= factor;
		view(now);
	}

	function slide(step) {
		detail.value = String(Number(detail.value) + step);
		setDetail();
	}

	const middle = () => {
		const box = canvas.getBoundingClientRect();
		pick(box.left + box.width / 2, box.top + box.height / 2);
	};
	const turnBy = MathUtils.degToRad(10);
	const keys = {
		ArrowLeft: (shift) => (shift ? turn(-turnBy, 0) : move(-1, 0)),
		ArrowRight: (shift) => (shift ? turn(turnBy, 0) : move(1, 0)),
		ArrowUp: (shift) => (shift ? turn(0, -turnBy) : move(0, 1)),
		ArrowDown: (shift) => (shift ? turn(0, turnBy) : move(0, -1)),
		'+': () => zoom(0.8), '=': () => zoom(0.8), '-': () => zoom(1.25),
		Home: home, t: fromAbove, n: northUp, p: fold, m: middle,
		'[': () => slide(-0.5), ']': () => slide(0.5),
		Escape: () => { measure.clear(); invalidate(); },
		'?': () => element('help').showModal(),
	};
	MODES.forEach((mode, index) => { keys[index + 1] = () => setMode(mode); });
	addEventListener('keydown', (event) => {
		const typing = event.target.closest?.('select, input, dialog');
		const action = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
		if (!action || typing || event.ctrlKey || event.metaKey || event.altKey) return;
		event.preventDefault();
		action(event.shiftKey);
	});

	canvas.addEventListener('webglcontextlost', (event) => {
		event.preventDefault();
		showMessage('The graphics driver gave up. Load the page again; less detail needs less memory.');
	});
	canvas.addEventListener('webglcontextrestored', () => { showMessage(''); invalidate(); });

	// ---- what is shown

	function show(item) {
		model?.dispose();
		measure.clear();
		clearErrors();
		showMessage('');
		state.state = 'loading';
		const name = item.name;
		element('title').textContent = name;
		document.title = `${name} – sat3d view`;
		element('detail-row').hidden = item.kind !== 'tileset';
		const url = `data/${item.path.split('/').map(encodeURIComponent).join('/')}`;
		let made = null;
		const on = {
			place() {
				if (made !== model) return;
				showAbout(made.asset, made.copyrights);
				frame();
				setDetail();
			},
			scene(part) {
				surface.apply(part);
				showAttribution(made.asset, made.copyrights);
			},
			change: invalidate,
			error(text) {
				if (made !== model) return;
				showError(text);
				if (!made.place) {
					state.state = 'failed';
					showMessage(text);
				}
				invalidate();
			},
		};
		const address = new URL(url, location.href).href;
		made = item.kind === 'tileset' ? new Tileset(address, new URL('data/', location.href).href, camera, on) : new Mesh(address, name, on);
		model = made;
		scene.add(model.group);
		showAbout({}, new Set());
		setDetail();
	}

	async function load() {
		const response = await fetch('contents.json');
		if (!response.ok) throw new Error(`status ${response.status}`);
		const contents = await response.json();
		items = contents.items;
		const select = element('items');
		select.replaceChildren(...items.map((item, index) => new Option(item.kind === 'tileset' ? `${item.name} (3D Tiles)` : item.name, String(index))));
		element('items-row').hidden = items.length < 2;
		show(items[0]);
	}

	resize();
	paint();
	load().catch((error) => {
		state.state = 'failed';
		showMessage(inWords(error, 'The list of what there is'));
	});
}
