//! `simulate`: what each effect changes when it is forced on, beside the bound for leaving it out;
//! and `--tolerance`, beside the scene in which everything is simulated.

use super::ledger::Ledger;
use super::{Share, draw};
use sat3d::grid::{LonLat, Projected};
use sat3d::plan::{Bound, Plan};
use sat3d::random::Draw;
use sat3d::scene::effects::{HeightBounds, reach};
use sat3d::scene::lidar::{Layer, Survey, Tile};
use sat3d::scene::object::Epoch;
use sat3d::scene::pixels::PixelPositions;
use sat3d::scene::solid::Ray;
use sat3d::scene::spec::{
    CameraSpec, ChangeSpec, ImageColours, PictureSpec, Sampling, Season, Side, SunSpec, ViewSpec,
    WaterSpec,
};
use sat3d::scene::{Effect, Options, Scene, SceneSpec};
use sat3d::units::{Metres, US_SURVEY_FOOT_M};

/// The test of each step of the plan.
pub const LEDGER: Ledger = &[
    ("projection", &[there_and_back_stays_within_the_projections_bound]),
    ("datum", &[positions_keep_the_bounds_of_what_is_left_out, the_tolerance]),
    ("convergence", &[positions_keep_the_bounds_of_what_is_left_out]),
    ("grid-scale", &[positions_keep_the_bounds_of_what_is_left_out]),
    ("curvature", &[positions_keep_the_bounds_of_what_is_left_out, a_curved_earth_is_round_enough]),
    ("relief", &[positions_keep_the_bounds_of_what_is_left_out]),
    ("shadows", &[what_shades_a_point_stands_within_the_bound]),
    ("terrain-shadows", &[hills_shade_within_their_bound_and_as_a_fine_search_says]),
    ("season", &[heights_keep_the_bounds_of_what_is_left_out, what_is_left_out_is_not_worked_on]),
    ("change", &[heights_keep_the_bounds_of_what_is_left_out, what_is_left_out_is_not_worked_on]),
    ("area-sampling", &[heights_keep_the_bounds_of_what_is_left_out]),
    ("crown-penetration", &[heights_keep_the_bounds_of_what_is_left_out]),
    ("noise", &[heights_keep_the_bounds_of_what_is_left_out]),
    ("missing-pulses", &[heights_keep_the_bounds_of_what_is_left_out]),
    ("gaps", &[heights_keep_the_bounds_of_what_is_left_out]),
    ("sensor-noise", &[the_sensors_noise_changes_no_height_and_few_grey_levels]),
    ("camera", &[what_becomes_of_a_picture_changes_no_height]),
    ("palette", &[what_becomes_of_a_picture_changes_no_height]),
    ("picture", &[what_becomes_of_a_picture_changes_no_height]),
    ("units", &[a_stored_height_is_within_half_a_step]),
];

fn the_tolerance() {
    what_is_left_out_stays_within_the_tolerance_together();
}

/// A scene with every cause, at a place of Washington, with hills, sun and view of its own.
fn spec(seed: u64) -> SceneSpec {
    let mut draw = draw(seed);
    let mut spec = SceneSpec { seed, ..SceneSpec::default() };
    spec.place.latitude_degrees = draw.range(45.7, 48.9);
    spec.place.longitude_degrees = draw.range(-124.0, -117.2);
    (spec.extent.width_metres, spec.extent.height_metres) = (80.0, 70.0);
    spec.terrain.relief_metres = draw.range(0.0, 50.0);
    spec.terrain.wavelength_metres = draw.range(90.0, 300.0);
    spec.terrain.slope_percent = draw.range(0.0, 12.0);
    spec.blocks.downtown = draw.pick([0.0, 1.0, 3.0]);
    spec.blocks.tower_height_metres = draw.range(20.0, 180.0);
    spec.trees.height_metres = draw.range(6.0, 35.0);
    spec.sun = Some(SunSpec {
        azimuth_degrees: draw.range(0.0, 360.0),
        elevation_degrees: draw.range(4.0, 88.0),
    });
    spec.view = Some(ViewSpec {
        off_nadir_degrees: draw.range(1.0, 44.0),
        azimuth_degrees: draw.range(0.0, 360.0),
    });
    spec.lidar.noise_sigma_metres = draw.range(0.001, 0.2);
    spec.lidar.missing_pulse_share = 0.05;
    spec.lidar.crown_penetration_share = 0.4;
    (spec.lidar.gap_count, spec.lidar.gap_width_metres) = (1, 4.0);
    spec.lidar.sampling = Sampling::Area;
    (spec.lidar.season, spec.images.season) = (Season::Winter, Season::Summer);
    (spec.lidar.year, spec.images.year) = (2016, 2021);
    spec.change = Some(ChangeSpec {
        built_share_per_year: 0.1,
        demolished_share_per_year: 0.1,
        felled_share_per_year: 0.05,
        growth_metres_per_year: 0.4,
        ..ChangeSpec::default()
    });
    spec.images.sensor_noise_levels = 3.0;
    spec
}

fn everything() -> Options {
    Options { force: Effect::ALL.into(), ..Options::default() }
}

fn without(effect: Effect) -> Options {
    Options { without: [effect].into(), ..everything() }
}

fn scene(spec: &SceneSpec, options: &Options) -> Scene {
    Scene::new(spec.clone(), options).expect("a scene")
}

fn bound(plan: &Plan, effect: Effect) -> Bound {
    plan.step(effect.id()).expect("a step").bound
}

fn heights_of(scene: &Scene) -> HeightBounds {
    HeightBounds::new(&scene.spec, &scene.terrain)
}

/// Where a point of the ground lies by the lidar's coordinates, metres of the projection.
fn on_the_map(scene: &Scene, at: LonLat) -> [f64; 2] {
    let local = scene.frame.to_local(at).expect("in the domain");
    let origin = scene.frame.origin_feet();
    [0, 1].map(|i| local[i] + origin[i] * US_SURVEY_FOOT_M)
}

/// How far from a point of the highest ground its shadow ends, `fall` metres lower.
fn shadow(scene: &Scene, fall: f64) -> [f64; 2] {
    let Some(sun) = scene.sun() else { return [0.0; 2] };
    // fall = t step_z + curvature t^2, so written that nothing cancels.
    let up = sun.step[2];
    let t = 2.0 * fall / (up + (up * up + 4.0 * sun.curvature * fall).sqrt());
    [t * sun.step[0], t * sun.step[1]]
}

/// Where the image shows the end of the shadow of the highest point on a roof so high.
fn shadow_on_roof(scene: &Scene, roof: f64) -> [f64; 2] {
    let heights = heights_of(scene);
    let [x, y] = shadow(scene, heights.above_ground + heights.ground_range - roof);
    let lean = scene.lean();
    [x + roof * lean[0], y + roof * lean[1]]
}

fn apart(a: [f64; 2], b: [f64; 2]) -> f64 {
    libm::hypot(a[0] - b[0], a[1] - b[1])
}

/// The largest displacement between two scenes of one specification, in the image or on the map,
/// ground metres.
fn displacement(a: &Scene, b: &Scene) -> f64 {
    let place = a.spec.place;
    let mut worst: f64 = 0.0;
    for (east, north) in [(0.0, 0.0), (5e-4, 5e-4), (-5e-4, 5e-4), (5e-4, -5e-4), (-5e-4, -5e-4)] {
        let lat_deg = place.latitude_degrees + north;
        let at = LonLat { lon_deg: place.longitude_degrees + east, lat_deg };
        for k in 0..=8 {
            let roof = heights_of(a).above_ground * f64::from(k) / 8.0;
            let shown = |scene: &Scene| {
                let (map, image) = (on_the_map(scene, at), shadow_on_roof(scene, roof));
                [map[0] + image[0], map[1] + image[1]]
            };
            worst = worst.max(apart(shown(a), shown(b)));
        }
    }
    worst / a.frame.scale().max(1.0)
}

#[test]
pub fn positions_keep_the_bounds_of_what_is_left_out() {
    use Effect::{Convergence, Curvature, Datum, GridScale, Relief};
    for effect in [Datum, Convergence, GridScale, Curvature, Relief] {
        let mut share = Share::new(&format!("simulate, {effect} left out"));
        for seed in 0..24 {
            let spec = spec(seed);
            let (on, off) = (scene(&spec, &everything()), scene(&spec, &without(effect)));
            let bound = bound(&off.plan, effect).horizontal_m;
            // Positions are rounded so far from the projection's origin.
            let moved = (displacement(&on, &off) - 1e-9).max(0.0);
            share.add(moved, bound, || format!("scene {seed}"));
        }
        share.check();
    }
}

#[test]
pub fn a_curved_earth_is_round_enough() {
    let mut share = Share::new("simulate, curvature simulated");
    for seed in 0..40 {
        let mut spec = spec(seed);
        spec.sun = Some(SunSpec { azimuth_degrees: 200.0, elevation_degrees: 1.0 + seed as f64 });
        let scene = scene(&spec, &everything());
        let heights = heights_of(&scene);
        let (sun, fall) = (scene.sun().unwrap(), heights.above_ground + heights.ground_range);
        // A ray of light over a sphere of the place's own radii of curvature.
        let sin = libm::sin(spec.place.latitude_degrees.to_radians());
        let w = 1.0 - 0.006_694_379_990_141_316 * sin * sin;
        for radius in [
            6_378_137.0 * (1.0 - 0.006_694_379_990_141_316) / (w * w.sqrt()),
            6_378_137.0 / w.sqrt(),
        ] {
            let (sin, cos) = libm::sincos(spec.sun.unwrap().elevation_degrees.to_radians());
            let t = 2.0 * fall / (sin + (sin * sin + 2.0 * cos * cos / radius * fall).sqrt());
            let rise = libm::hypot(t * cos, radius + t * sin) - radius;
            let level = t * sun.step[2] + sun.curvature * t * t;
            let stated = bound(&scene.plan, Effect::Curvature).vertical_m;
            share.add((rise - level).abs(), stated, || format!("scene {seed}"));
        }
    }
    share.check();
}

#[test]
pub fn what_shades_a_point_stands_within_the_bound() {
    let mut share = Share::new("simulate, shadows left out");
    for seed in 0..10 {
        let spec = spec(seed);
        let (on, off) = (scene(&spec, &everything()), scene(&spec, &without(Effect::Shadows)));
        let (sun, bound) = (on.sun().unwrap(), bound(&off.plan, Effect::Shadows).horizontal_m);
        let mut draw = draw(100 + seed);
        for _ in 0..200 {
            let (x, y) = (draw.range(-35.0, 35.0), draw.range(-30.0, 30.0));
            let from = [x, y, on.surface(Epoch::Image, x, y).height];
            if !on.world(Epoch::Image).shadowed(from, &sun) {
                continue;
            }
            let ray = Ray { from, step: sun.step };
            let Some((t, _)) = on.world(Epoch::Image).hit(&ray, 1e-3, 1e4) else { continue };
            let away = t * libm::hypot(sun.step[0], sun.step[1]) / on.frame.scale();
            share.add(away, bound, || format!("scene {seed} at {x} {y}"));
        }
    }
    share.check();
}

#[test]
pub fn hills_shade_within_their_bound_and_as_a_fine_search_says() {
    let mut left_out = Share::new("simulate, terrain-shadows left out");
    let mut simulated = Share::new("simulate, terrain-shadows simulated");
    let mut dark = 0;
    for seed in 0..8 {
        let mut spec = spec(seed);
        (spec.terrain.relief_metres, spec.terrain.wavelength_metres) = (45.0, 120.0);
        spec.sun = Some(SunSpec { azimuth_degrees: 250.0, elevation_degrees: 6.0 + seed as f64 });
        let scene = scene(&spec, &without(Effect::TerrainShadows));
        let (sun, bound) = (scene.sun().unwrap(), bound(&scene.plan, Effect::TerrainShadows));
        let level = libm::hypot(sun.step[0], sun.step[1]);
        // The first step of 5 cm at which the ray is below the ground.
        let shaded = |x: f64, y: f64| {
            let z = scene.ground(x, y);
            (1..12_000).map(|k| 0.05 * f64::from(k)).find(|t| {
                let ray = z + t * sun.step[2] + sun.curvature * t * t;
                ray < scene.ground(x + t * sun.step[0], y + t * sun.step[1]) - 1e-9
            })
        };
        let mut draw = draw(200 + seed);
        for _ in 0..60 {
            let (x, y) = (draw.range(-35.0, 35.0), draw.range(-30.0, 30.0));
            let (found, fine) =
                (scene.terrain_shadowed([x, y, scene.ground(x, y)], &sun), shaded(x, y));
            if let Some(t) = fine {
                dark += 1;
                let away = t * level / scene.frame.scale();
                left_out.add(away, bound.horizontal_m, || format!("scene {seed} at {x} {y}"));
            }
            // Where they differ, the shadow's edge is no farther than the form's own bound.
            let edge = (0..=10).map(|k| 0.01 * f64::from(k)).find(|r| {
                (0..16).any(|k| {
                    let (sin, cos) = libm::sincos(f64::from(k) * std::f64::consts::TAU / 16.0);
                    shaded(x + r * sin, y + r * cos).is_some() == found
                })
            });
            simulated
                .add(edge.unwrap_or(f64::INFINITY), 0.1, || format!("scene {seed} at {x} {y}"));
        }
    }
    assert!(dark > 50, "{dark}");
    [left_out, simulated].iter().for_each(Share::check);
}

#[test]
fn no_hill_shades_where_the_plan_finds_none_steep_enough() {
    let (mut off, mut shaded) = (0, [0, 0]);
    for seed in 0..60 {
        let mut draw = draw(900 + seed);
        let mut spec = spec(seed);
        spec.terrain.wavelength_metres = draw.range(90.0, 200.0);
        let side = draw.pick([Side::North, Side::East, Side::South, Side::West]);
        spec.water = (seed % 2 == 0).then(|| WaterSpec { side, ..WaterSpec::default() });
        let azimuth_degrees = draw.range(0.0, 360.0);
        spec.sun = Some(SunSpec { azimuth_degrees, elevation_degrees: draw.range(4.0, 40.0) });
        let plan = scene(&spec, &Options::default()).plan;
        let on = plan.step(Effect::TerrainShadows.id()).expect("a step").on;
        let scene = scene(&spec, &everything());
        let sun = scene.sun().unwrap();
        off += usize::from(!on);
        for _ in 0..300 {
            let (x, y) = (draw.range(-40.0, 40.0), draw.range(-35.0, 35.0));
            let from = [x, y, scene.ground(x, y)];
            shaded[usize::from(on)] += usize::from(scene.terrain_shadowed(from, &sun));
        }
    }
    assert!(off > 15 && off < 50 && shaded[1] > 300, "{off} {shaded:?}");
    assert_eq!(shaded[0], 0, "of {off} scenes");
}

/// Cells of the survey, both layers.
fn survey(scene: &Scene) -> Vec<Option<f64>> {
    let survey = Survey::new(scene);
    let cells =
        (-70..70).step_by(2).flat_map(|row| (-80..80).step_by(2).map(move |col| (col, row)));
    cells.flat_map(|(c, r)| [Layer::Dsm, Layer::Dtm].map(|l| survey.height(l, c, r))).collect()
}

#[test]
pub fn heights_keep_the_bounds_of_what_is_left_out() {
    use Effect::{AreaSampling, Change, CrownPenetration, Gaps, MissingPulses, Noise, Season};
    for effect in [Season, Change, AreaSampling, CrownPenetration, Noise, MissingPulses, Gaps] {
        let mut share = Share::new(&format!("simulate, {effect} left out"));
        let mut changed = 0;
        for seed in 0..10 {
            let spec = spec(seed);
            let (on, off) = (scene(&spec, &everything()), scene(&spec, &without(effect)));
            let bound = bound(&off.plan, effect).vertical_m;
            for (a, b) in survey(&on).into_iter().zip(survey(&off)) {
                changed += usize::from(a != b);
                if let (Some(a), Some(b)) = (a, b) {
                    // The noise is added in 64 bits.
                    let error = ((a - b).abs() - 1e-12).max(0.0);
                    share.add(error, bound, || format!("scene {seed}"));
                }
            }
        }
        assert!(changed > 0, "{effect} changes something");
        share.check();
    }
}

#[test]
pub fn what_is_left_out_is_not_worked_on() {
    for seed in 0..4 {
        let spec = spec(seed);
        assert!(scene(&spec, &everything()).changes());
        // Neither season nor change: one index of solids serves both epochs.
        let without = [Effect::Season, Effect::Change].into();
        let still = scene(&spec, &Options { without, ..Options::default() });
        let solids = |epoch| still.world(epoch).solids.len();
        assert!(!still.changes() && solids(Epoch::Lidar) == solids(Epoch::Image));
    }
}

#[test]
pub fn the_sensors_noise_changes_no_height_and_few_grey_levels() {
    let mut share = Share::new("simulate, sensor-noise left out, heights");
    for seed in 0..3 {
        let spec = spec(seed);
        let (on, off) = (scene(&spec, &everything()), scene(&spec, &without(Effect::SensorNoise)));
        let render = |scene: &Scene| {
            let pixels = PixelPositions::square(&scene.frame, 40, [0.0, 0.0], 30.0);
            scene.render(&pixels, 7)
        };
        let (a, b) = (render(&on), render(&off));
        assert_ne!(a, b);
        // Cut at 4 sigma of 3 levels, and rounded.
        assert!(a.iter().zip(&b).all(|(a, b)| a.abs_diff(*b) <= 13));
        for (a, b) in survey(&on).into_iter().zip(survey(&off)) {
            assert_eq!(a.is_some(), b.is_some());
            let error = a.zip(b).map_or(0.0, |(a, b)| (a - b).abs());
            share.add(error, bound(&off.plan, Effect::SensorNoise).vertical_m, || {
                format!("scene {seed}")
            });
        }
    }
    share.check();
}

#[test]
pub fn what_becomes_of_a_picture_changes_no_height() {
    let spec = spec(3);
    let mut with = spec.clone();
    with.camera = Some(CameraSpec::default());
    with.images.colours = ImageColours::Palette;
    with.picture = Some(PictureSpec::default());
    let (plain, with) = (scene(&spec, &everything()), scene(&with, &everything()));
    assert_eq!(survey(&plain), survey(&with));
    for id in ["camera", "palette", "picture"] {
        let on = |scene: &Scene| scene.plan.step(id).is_some_and(|step| step.on);
        assert!(!on(&plain) && on(&with), "{id}");
        assert_eq!(with.plan.step(id).map(|step| step.bound), Some(Bound::EXACT), "{id}");
    }
}

#[test]
pub fn a_stored_height_is_within_half_a_step() {
    let mut share = Share::new("simulate, units");
    for seed in 0..6 {
        let mut spec = spec(seed);
        spec.terrain.base_height_metres = [-30.0, 5.0, 70.0, 300.0, 1500.0, 4000.0][seed as usize];
        let scene = scene(&spec, &everything());
        let bound = scene.plan.step("units").unwrap().bound.vertical_m;
        let survey = Survey::new(&scene);
        let tile = Tile { number: 1, column: -20, row: -20, width: 40, height: 40 };
        let stored = survey.rows(Layer::Dsm, &tile, 0..40);
        for (k, feet) in (0_i64..).zip(stored) {
            let truth = survey.height(Layer::Dsm, tile.column + k % 40, tile.row + k / 40);
            if let Some(truth) = truth {
                let error = (f64::from(feet) * US_SURVEY_FOOT_M - truth).abs();
                share.add(error, bound, || format!("scene {seed}: {truth}"));
            }
        }
    }
    share.check();
}

#[test]
pub fn there_and_back_stays_within_the_projections_bound() {
    let mut share = Share::new("simulate, projection");
    for seed in 0..24 {
        // A datum step drops the height that it makes, as PROJ's does, and has no exact way back.
        let scene = scene(&spec(seed), &without(Effect::Datum));
        let stated = scene.plan.step("projection").unwrap().bound.horizontal_m;
        let mut draw = draw(seed);
        let from = [draw.range(-3e3, 3e3), draw.range(-3e3, 3e3)];
        let at = scene.frame.to_lonlat(from[0], from[1]).unwrap();
        let back = scene.frame.to_local(at).unwrap();
        share.add(apart(from, back), stated, || format!("scene {seed}"));
        let [x, y] = scene.frame.origin_feet();
        let corner = scene.frame.from_feet(Projected { x, y });
        share.add(libm::hypot(corner[0], corner[1]), stated, || format!("scene {seed}"));
    }
    share.check();
}

#[test]
pub fn what_is_left_out_stays_within_the_tolerance_together() {
    let mut horizontal = Share::new("simulate, displacement of the tolerance");
    let mut vertical = Share::new("simulate, height of the plan's sum");
    let mut left_out = 0;
    for seed in 0..8 {
        let spec = spec(seed);
        let whole = scene(&spec, &everything());
        for tolerance in [1e-3, 3e-3, 0.01, 0.1, 0.5, 1.0, 1.5, 3.0, 10.0] {
            let options = Options { tolerance: Metres(tolerance), ..Options::default() };
            let scene = scene(&spec, &options);
            let missing: Vec<Bound> = Effect::ALL
                .into_iter()
                .filter(|e| !scene.plan.step(e.id()).unwrap().on)
                .map(|effect| bound(&scene.plan, effect))
                .collect();
            left_out += missing.len();
            let sum = |of: fn(&Bound) -> f64| missing.iter().map(of).sum::<f64>();
            let what = || format!("scene {seed}, tolerance {tolerance}");
            assert!(sum(|b| b.horizontal_m) <= tolerance, "{}", what());
            assert!(sum(|b| b.vertical_m) <= tolerance, "{}", what());
            horizontal.add(displacement(&whole, &scene), tolerance, what);
            for (a, b) in survey(&whole).into_iter().zip(survey(&scene)) {
                if let (Some(a), Some(b)) = (a, b) {
                    let error = ((a - b).abs() - 1e-12).max(0.0);
                    vertical.add(error, scene.plan.vertical_m(), what);
                }
            }
        }
    }
    assert!(left_out > 50, "{left_out}");
    [horizontal, vertical].iter().for_each(Share::check);
}

/// Plans of scenes with every cause and without any, under tolerances and forced.
pub fn plans() -> Vec<Plan> {
    let tolerant = Options { tolerance: Metres(10.0), ..Options::default() };
    let specs = [spec(0), spec(1), SceneSpec::default()];
    specs
        .iter()
        .flat_map(|spec| [everything(), tolerant.clone()].map(|o| scene(spec, &o).plan))
        .collect()
}

/// No two scenes of this file are the same: seeds decide.
#[test]
fn scenes_differ_by_their_seeds() {
    assert_ne!(spec(1), spec(2));
    assert!(reach(&spec(1)) > 40.0 && Draw::new(&[1]).unit() != Draw::new(&[2]).unit());
}
