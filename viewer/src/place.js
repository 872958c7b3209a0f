// Where things are: from the coordinates of a file to the scene's (metres; x east, y up, z south; origin near the
// ground, so that single precision on the graphics card is enough) and on to longitude and latitude.
import { Box3, MathUtils, Matrix4, Sphere, Vector3 } from 'three';
import { WGS84_ELLIPSOID } from '3d-tiles-renderer/three';

// East, north, up to x, y up, -z.
const UPRIGHT = new Matrix4().makeRotationX(-Math.PI / 2);
// A root frame counts as upright if its z axis is within 0.1 degrees of the ellipsoid's normal.
const STRAIGHT = Math.cos(MathUtils.degToRad(0.1));
// Metres from the ellipsoid within which a tileset's middle lies if it is Earth-centred.
const NEAR = 50_000;

export class Place {
	// `toScene`: from the file's coordinates to the scene's. `toEarth`: from the scene's to Earth-centred,
	// Earth-fixed metres, where known. `heights`: whether those are heights above the ellipsoid.
	constructor({ toScene, toEarth = null, heights = false, unit = 'm' }) {
		this.toScene = toScene;
		this.toEarth = toEarth;
		this.heights = heights;
		this.unit = unit;
	}

	// Rows of [name, value] about a point of the scene.
	describe(point) {
		const rows = [['Height above base', this.length(point.y)]];
		if (this.toEarth) {
			const place = WGS84_ELLIPSOID.getPositionToCartographic(point.clone().applyMatrix4(this.toEarth), {});
			rows.push(['Longitude', degrees(place.lon)], ['Latitude', degrees(place.lat)]);
			if (this.heights) rows.push(['Height above ellipsoid', this.length(place.height)]);
		} else {
			rows.push(['East', this.length(point.x)], ['North', this.length(-point.z)]);
		}
		return rows;
	}

	length(value, digits = 2) {
		return `${number(value, digits)} ${this.unit}`;
	}
}

export function number(value, digits = 0) {
	const text = value.toLocaleString('en', { minimumFractionDigits: digits, maximumFractionDigits: digits });
	return text.replace(/^-(?=[0.,]*$)/, '').replace('-', '−');
}

function degrees(radians) {
	return `${MathUtils.radToDeg(radians).toFixed(7).replace('-', '−')}°`;
}

// The place of a tileset whose root has been read. An Earth-centred one is turned into local east-north-up: that of
// its root's transform, if this is one (so that the base is the height it was made for), else that of its middle.
export function placeOfTileset(tiles) {
	const sphere = new Sphere();
	tiles.getBoundingSphere(sphere);
	const { ellipsoid } = tiles;
	// Northings of UTM are long too: only what is near the ellipsoid is Earth-centred.
	const near = Math.abs(ellipsoid.getPositionElevation(sphere.center)) < NEAR + sphere.radius;
	if (!near) {
		// Local, z up: the base is the lowest point.
		const box = new Box3();
		tiles.getBoundingBox(box);
		const middle = box.getCenter(new Vector3()).setZ(box.min.z);
		return new Place({ toScene: UPRIGHT.clone().multiply(new Matrix4().makeTranslation(middle.negate())) });
	}
	const root = tiles.root.engineData.transform;
	const origin = new Vector3().setFromMatrixPosition(root);
	const normal = new Vector3();
	const up = new Vector3().setFromMatrixColumn(root, 2).normalize();
	const place = {};
	const close = origin.distanceTo(sphere.center) < 20 * sphere.radius + 1000;
	if (close && up.dot(ellipsoid.getPositionToNormal(origin, normal)) > STRAIGHT) {
		ellipsoid.getPositionToCartographic(origin, place);
	} else {
		ellipsoid.getPositionToCartographic(sphere.center, place);
		const box = new Box3();
		const frame = new Matrix4();
		tiles.getOrientedBoundingBox(box, frame);
		for (let corner = 0; corner < 8; corner++) {
			const point = new Vector3(...[1, 2, 4].map((bit, axis) => box[corner & bit ? 'max' : 'min'].getComponent(axis)));
			place.height = Math.min(place.height, ellipsoid.getPositionElevation(point.applyMatrix4(frame)));
		}
	}
	const fromLocal = ellipsoid.getEastNorthUpFrame(place.lat, place.lon, place.height, new Matrix4());
	const toScene = UPRIGHT.clone().multiply(fromLocal.invert());
	return new Place({ toScene, toEarth: toScene.clone().invert(), heights: true });
}

// The place of a mesh in a file of its own, by what `sat3d` notes in the scene's extras.
export function placeOfMesh(gltf) {
	const extras = gltf.scene.userData ?? {};
	const toScene = new Matrix4();
	if (!extras.frame) {
		// Another program's: y is up, the base is the lowest point.
		const box = new Box3().setFromObject(gltf.scene);
		if (!box.isEmpty()) toScene.makeTranslation(box.getCenter(new Vector3()).setY(box.min.y).negate());
		return new Place({ toScene });
	}
	const { origin_longitude_deg: lon, origin_latitude_deg: lat } = extras;
	let toEarth = null;
	if (Number.isFinite(lon) && Number.isFinite(lat)) {
		toEarth = WGS84_ELLIPSOID.getEastNorthUpFrame(MathUtils.degToRad(lat), MathUtils.degToRad(lon), 0, new Matrix4());
		toEarth.multiply(UPRIGHT.clone().invert());
	}
	return new Place({ toScene, toEarth, unit: extras.frame === 'reference' ? 'cube units' : 'm' });
}
