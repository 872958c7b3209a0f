//! What a random scene is like: its place, ground, streets, uses, trees, cars, season, sun and view.

use super::{Kind, RandomScenes, purpose};
use crate::random::{Draw, key};
use crate::scene::spec::{
    BlockSpec, CameraSpec, CarSpec, DetailSpec, ExtentSpec, ImageSpec, LidarSpec, PlaceSpec,
    SceneSpec, Season, Side, StreetSpec, SunSpec, TerrainSpec, TreeSpec, ViewSpec, WaterSpec,
};

/// Room around the square, metres in all: turning the square by the convergence of the grid (1.3
/// degrees), and half a crown.
const ROOM_M: f64 = 16.0;
/// Box of the city, in which scenes lie: west, south, east, north, degrees.
const CITY: [f64; 4] = [-122.42, 47.50, -122.25, 47.73];

pub(super) fn spec(scenes: &RandomScenes, index: u64, metres: f64) -> SceneSpec {
    let kind = scenes.kind(index);
    let draw = &mut Draw::new(&[scenes.seed, index, purpose::SCENE]);
    let season = season(draw);
    let extent = metres + ROOM_M;
    let terrain = terrain(draw, kind);
    SceneSpec {
        name: format!("{kind}-{index}"),
        seed: key(&[scenes.seed, index]),
        place: place(scenes, index),
        extent: ExtentSpec { width_metres: extent, height_metres: extent },
        terrain,
        water: water(draw, kind, &terrain),
        streets: streets(draw, kind),
        blocks: blocks(draw, kind),
        trees: trees(draw, kind),
        cars: CarSpec {
            parked_share: draw.range(0.15, 0.95),
            driving_per_100_metres: draw.range(0.2, 2.0),
        },
        sun: sun(draw),
        view: view(draw),
        // Leaves that have fallen are the images' affair: a surface model shows the crown.
        lidar: LidarSpec { season: Season::Summer, ..LidarSpec::default() },
        images: ImageSpec {
            season,
            sensor_noise_levels: draw.range(0.0, 4.0),
            ..ImageSpec::default()
        },
        camera: Some(camera(draw)),
        detail: Some(detail(draw, kind)),
        ..SceneSpec::default()
    }
}

/// Where in the city a scene lies: a golden-ratio lattice, so that no two come near each other.
fn place(scenes: &RandomScenes, index: u64) -> PlaceSpec {
    let mut start = Draw::new(&[scenes.seed, purpose::PLACE]);
    let [west, south, east, north] = CITY;
    // The plastic number's fractions: a low-discrepancy sequence in the plane.
    let turn = |start: f64, step: f64| (start + (index % (1 << 40)) as f64 * step).fract();
    let (u, v) =
        (turn(start.unit(), 0.754_877_666_246_692_8), turn(start.unit(), 0.569_840_290_998_053_2));
    PlaceSpec {
        latitude_degrees: south + (north - south) * v,
        longitude_degrees: west + (east - west) * u,
    }
}

fn season(draw: &mut Draw) -> Season {
    match draw.index(20) {
        0..4 => Season::Spring,
        4..13 => Season::Summer,
        13..17 => Season::Autumn,
        _ => Season::Winter,
    }
}

fn terrain(draw: &mut Draw, kind: Kind) -> TerrainSpec {
    // Most of a city is nearly level: half of the scenes fall by less than an eighth of `most`.
    let steep = draw.unit();
    let most = match kind {
        Kind::Forest | Kind::Suburb | Kind::Park => 10.0,
        Kind::Waterfront => 2.0,
        _ => 5.0,
    };
    TerrainSpec {
        base_height_metres: draw.range(20.0, 90.0),
        relief_metres: relief(draw, kind),
        wavelength_metres: draw.range(150.0, 420.0),
        slope_percent: most * steep * steep * steep,
        slope_azimuth_degrees: draw.range(0.0, 360.0),
    }
}

fn water(draw: &mut Draw, kind: Kind, terrain: &TerrainSpec) -> Option<WaterSpec> {
    (kind == Kind::Waterfront).then(|| {
        let fall = terrain.relief_metres / 2.0 + terrain.slope_percent;
        WaterSpec {
            side: draw.pick([Side::South, Side::North, Side::West, Side::East]),
            share: draw.range(0.3, 0.65),
            level_metres: terrain.base_height_metres - fall - draw.range(1.0, 4.0),
            shoreline_swing_metres: draw.range(0.0, 12.0),
            docks_per_100_metres: draw.range(0.0, 3.0),
        }
    })
}

fn streets(draw: &mut Draw, kind: Kind) -> StreetSpec {
    // Half of the grids lie with the compass, as they do in the city.
    let azimuth = if draw.chance(0.5) { draw.range(-3.0, 3.0) } else { draw.range(0.0, 180.0) };
    let turn = if draw.chance(0.5) { 90.0 } else { 0.0 };
    let (width, length, every) = match kind {
        Kind::Suburb => {
            (draw.range(62.0, 90.0), draw.range(90.0, 180.0), draw.pick([0, 0, 0, 3, 4]))
        }
        Kind::Downtown => {
            (draw.range(70.0, 100.0), draw.range(80.0, 120.0), draw.pick([0, 2, 2, 3, 4]))
        }
        Kind::Industry => {
            (draw.range(90.0, 150.0), draw.range(110.0, 220.0), draw.pick([0, 0, 2, 3]))
        }
        Kind::CarPark => {
            (draw.range(90.0, 140.0), draw.range(110.0, 200.0), draw.pick([0, 2, 2, 3]))
        }
        Kind::Forest => (draw.range(140.0, 320.0), draw.range(160.0, 320.0), 0),
        Kind::Park => (draw.range(110.0, 200.0), draw.range(120.0, 240.0), draw.pick([0, 0, 2])),
        Kind::Waterfront => {
            (draw.range(80.0, 180.0), draw.range(90.0, 200.0), draw.pick([0, 0, 2, 3]))
        }
        Kind::Mixed => (draw.range(60.0, 100.0), draw.range(70.0, 140.0), draw.pick([0, 0, 3, 4])),
    };
    StreetSpec {
        azimuth_degrees: azimuth + turn,
        block_width_metres: width,
        block_length_metres: length,
        irregularity: draw.range(0.0, 0.3),
        arterial_every: every,
    }
}

fn blocks(draw: &mut Draw, kind: Kind) -> BlockSpec {
    let mut w = [0.0; 6]; // downtown, commercial, industrial, suburb, park, forest
    match kind {
        Kind::Suburb => w[3] = 1.0,
        Kind::Downtown => w[0] = 1.0,
        Kind::Industry => w[2] = 1.0,
        Kind::CarPark => w[1] = 1.0,
        Kind::Forest => w[5] = 1.0,
        Kind::Park => w[4] = 1.0,
        Kind::Waterfront => {
            for (weight, chance) in w.iter_mut().zip([0.2, 0.2, 0.3, 0.5, 0.6, 0.3]) {
                *weight = if draw.chance(chance) { draw.range(0.2, 1.0) } else { 0.0 };
            }
            w[4] += 0.05;
        }
        Kind::Mixed => {
            for weight in &mut w {
                *weight = if draw.chance(0.6) { draw.range(0.3, 1.0) } else { 0.0 };
            }
            w[3] += 0.2;
        }
    }
    // Midrise is common, towers are rare.
    let tower = if draw.chance(0.2) { draw.range(25.0, 60.0) } else { draw.range(10.0, 24.0) };
    BlockSpec {
        downtown: w[0],
        commercial: w[1],
        industrial: w[2],
        suburb: w[3],
        park: w[4],
        forest: w[5],
        built_share: draw.range(0.7, 1.0),
        tower_height_metres: tower,
        hipped_share: draw.range(0.1, 0.7),
    }
}

fn trees(draw: &mut Draw, kind: Kind) -> TreeSpec {
    let forest = match kind {
        Kind::Forest if draw.chance(0.75) => draw.range(260.0, 420.0),
        _ => draw.range(90.0, 300.0),
    };
    TreeSpec {
        per_garden: draw.range(0.3, 4.0),
        street_spacing_metres: if draw.chance(0.25) { 0.0 } else { draw.range(7.0, 20.0) },
        park_per_hectare: draw.range(20.0, 140.0),
        forest_per_hectare: forest,
        conifer_share: draw.unit() * draw.unit(),
        height_metres: draw.range(11.0, 27.0),
    }
}

fn sun(draw: &mut Draw) -> Option<SunSpec> {
    if draw.chance(0.05) {
        return None;
    }
    // Satellites that look for a city pass before noon, aeroplanes fly around it; the city lies at 47 degrees
    // north, and its pictures have north at the top.
    let azimuth = 180.0 + draw.range(-60.0, 60.0);
    let high = 0.5 * (draw.unit() + draw.unit());
    Some(SunSpec { azimuth_degrees: azimuth, elevation_degrees: 22.0 + 42.0 * high })
}

fn view(draw: &mut Draw) -> Option<ViewSpec> {
    if draw.chance(0.25) {
        return None;
    }
    let off = if draw.chance(0.06) { draw.range(10.0, 22.0) } else { 10.0 * draw.unit() };
    Some(ViewSpec { off_nadir_degrees: off, azimuth_degrees: draw.range(0.0, 360.0) })
}

/// Half of the scenes lie on a plane.
fn relief(draw: &mut Draw, kind: Kind) -> f64 {
    let hills = draw.chance(0.5);
    let height = draw.unit() * draw.unit();
    match (hills, kind) {
        (false, _) => 0.0,
        (true, Kind::Waterfront) => height,
        (true, _) => 6.0 * height,
    }
}

/// Air, lens and processing: most pictures are contrasty, muted and sharpened, some hazy or soft.
fn camera(draw: &mut Draw) -> CameraSpec {
    let warm = draw.range(-0.09, 0.09);
    let tint = draw.range(-0.04, 0.04);
    let hazy = if draw.chance(0.2) { draw.range(0.05, 0.22) } else { draw.range(0.0, 0.05) };
    CameraSpec {
        sky_light: draw.range(0.22, 0.95),
        haze: hazy,
        exposure: draw.range(0.7, 1.35),
        white_balance: [1.0 + warm, 1.0 + tint, 1.0 - warm],
        saturation: draw.range(0.45, 0.98),
        contrast: draw.range(0.92, 1.25),
        blur_pixels: if draw.chance(0.5) { draw.range(0.3, 0.95) } else { 0.0 },
        sharpening: if draw.chance(0.55) { draw.range(0.2, 1.0) } else { 0.0 },
        half_colour_resolution: draw.chance(0.6),
    }
}

fn detail(draw: &mut Draw, kind: Kind) -> DetailSpec {
    let sometimes = |draw: &mut Draw, chance: f64, low: f64, high: f64| {
        let value = draw.range(low, high);
        if draw.chance(chance) { value } else { 0.0 }
    };
    let railway = match kind {
        Kind::Industry => 0.35,
        Kind::Mixed | Kind::Waterfront => 0.12,
        _ => 0.0,
    };
    DetailSpec {
        railway: sometimes(draw, railway, 0.3, 2.5),
        flats_share: sometimes(draw, 0.35, 0.03, 0.5),
        grey_share: draw.range(0.2, 0.9),
        larger_trees: draw.range(0.0, 1.0),
        closed_canopy: if draw.chance(0.6) { draw.range(0.5, 1.0) } else { 0.0 },
        wires_share: sometimes(draw, 0.6, 0.3, 1.0),
        fence_share: draw.range(0.0, 0.8),
    }
}
