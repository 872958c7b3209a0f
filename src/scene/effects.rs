//! The plan of a simulation: each effect is a step with a bound, a cost and a cause, simulated only
//! if the scene calls for it and leaving it out would be noticed.

use super::error::SceneError;
use super::frame::Frame;
use super::spec::SceneSpec;
use super::terrain::Terrain;
use crate::grid::WGS84_A;
use crate::plan::{Bound, Plan, Step, runs};
use crate::units::Metres;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::fmt;
use std::str::FromStr;
use steps::{picture_steps, projection_step, units_step};

mod steps;

/// Budget of a simulation unless `--tolerance` says otherwise: a tenth of the finest lidar noise.
pub const DEFAULT_TOLERANCE: Metres = Metres(1e-3);

/// What may be simulated or left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Effect {
    /// The datum step between WGS 84 (images) and NAD83(HARN) (lidar).
    Datum,
    /// Grid north is not true north: directions of sun and satellite turn.
    Convergence,
    /// A metre of the projection is not a metre of the ground: light travels ground metres.
    GridScale,
    /// Cast shadows of objects.
    Shadows,
    /// Shadows that hills cast.
    TerrainShadows,
    /// Light runs straight while level surfaces curve.
    Curvature,
    /// What stands above the ground leans away from an oblique satellite.
    Relief,
    /// Trees without leaves in one of the epochs.
    Season,
    /// Building, demolition, felling, growth and other cars between lidar and images.
    Change,
    /// Cells as means over their area.
    AreaSampling,
    /// Pulses that pass through crowns.
    CrownPenetration,
    /// Noise of lidar heights.
    Noise,
    /// Cells that no pulse hit.
    MissingPulses,
    /// Gaps between flight lines.
    Gaps,
    /// Noise of the image sensor.
    SensorNoise,
}

impl Effect {
    /// All effects, in the order of the plan.
    pub const ALL: [Self; 15] = [
        Self::Datum,
        Self::Convergence,
        Self::GridScale,
        Self::Season,
        Self::Change,
        Self::AreaSampling,
        Self::CrownPenetration,
        Self::Noise,
        Self::MissingPulses,
        Self::Gaps,
        Self::Shadows,
        Self::TerrainShadows,
        Self::Curvature,
        Self::Relief,
        Self::SensorNoise,
    ];

    /// The name on the command line and in the plan.
    #[must_use]
    pub const fn id(self) -> &'static str {
        match self {
            Self::Datum => "datum",
            Self::Convergence => "convergence",
            Self::GridScale => "grid-scale",
            Self::Shadows => "shadows",
            Self::TerrainShadows => "terrain-shadows",
            Self::Curvature => "curvature",
            Self::Relief => "relief",
            Self::Season => "season",
            Self::Change => "change",
            Self::AreaSampling => "area-sampling",
            Self::CrownPenetration => "crown-penetration",
            Self::Noise => "noise",
            Self::MissingPulses => "missing-pulses",
            Self::Gaps => "gaps",
            Self::SensorNoise => "sensor-noise",
        }
    }
}

impl fmt::Display for Effect {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.id())
    }
}

impl FromStr for Effect {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL.into_iter().find(|e| e.id() == text).ok_or_else(|| {
            let known: Vec<&str> = Self::ALL.iter().map(|e| e.id()).collect();
            format!("`{text}` is no effect; the effects are {}", known.join(", "))
        })
    }
}

/// What a user may change about the plan.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Options {
    /// The smallest effects are left out, as far as their bounds together are not above this.
    pub tolerance: Metres,
    /// Effects to simulate whatever their bound and cause (`--force`).
    pub force: BTreeSet<Effect>,
    /// Effects to leave out whatever their bound and cause (`--without`).
    pub without: BTreeSet<Effect>,
}

impl Default for Options {
    fn default() -> Self {
        Self { tolerance: DEFAULT_TOLERANCE, force: BTreeSet::new(), without: BTreeSet::new() }
    }
}

/// The effects that are on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Effects(BTreeSet<Effect>);

impl Effects {
    /// Whether an effect is simulated.
    #[must_use]
    pub fn on(&self, effect: Effect) -> bool {
        self.0.contains(&effect)
    }

    /// [`Self::on`], asked by the place that simulates it: the plan is held to what it says.
    #[must_use]
    pub fn runs(&self, effect: Effect) -> bool {
        let on = self.on(effect);
        if on {
            runs(effect.id());
        }
        on
    }
}

/// Bounds on the heights of a scene, known before anything is laid out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HeightBounds {
    /// No object stands higher above the ground at its foot, metres.
    pub above_ground: f64,
    /// Highest minus lowest ground, metres.
    pub ground_range: f64,
    /// Nothing is higher (NAVD88), metres.
    pub highest: f64,
}

/// Half of the longest side that an object's foot has, metres: a shop along a whole block.
const FOOT_M: f64 = 60.0;

impl HeightBounds {
    /// Bounds from what the scene file says.
    #[must_use]
    pub fn new(spec: &SceneSpec, terrain: &Terrain) -> Self {
        let reach = reach(spec);
        let b = &spec.blocks;
        let mut tallest: f64 = 8.5; // lamp posts
        if b.downtown > 0.0 {
            tallest = tallest.max(b.tower_height_metres + 4.0);
        }
        if b.suburb + b.commercial + b.industrial > 0.0 {
            tallest = tallest.max(15.0);
        }
        let grown = spec.change.map_or(0.0, |c| c.growth_metres_per_year) * spec.years_apart();
        tallest = tallest.max(spec.trees.height_metres + grown);
        let t = &spec.terrain;
        let half = t.relief_metres / 2.0 + t.slope_percent / 100.0 * reach;
        let high = t.base_height_metres + half;
        let low = terrain.water_level().unwrap_or(t.base_height_metres - half);
        // Roofs are level: on a slope they stand higher over their lowest corner.
        let above_ground = tallest + terrain.steepest(reach).min(1.0) * FOOT_M.min(reach);
        Self { above_ground, ground_range: high - low, highest: high + above_ground }
    }
}

/// Distance from the origin to the farthest corner of the scene and what stands around it, metres.
#[must_use]
pub fn reach(spec: &SceneSpec) -> f64 {
    libm::hypot(spec.extent.width_metres, spec.extent.height_metres) / 2.0 + super::MARGIN_M * 1.5
}

/// One effect as it is weighed.
struct Case {
    effect: Effect,
    /// Whether the scene has the cause at all, and the cause in words.
    present: bool,
    /// Whether the scene says enough to simulate it, with the cause or without.
    possible: bool,
    cause: String,
    form: &'static str,
    /// Error of leaving it out.
    bound: Bound,
    /// Error that remains when it is simulated in this form.
    remains: Bound,
    cost: &'static str,
    /// A bound that has no length (missing cells, grey levels) is never under a tolerance.
    always: bool,
}

impl Case {
    /// The larger of what leaving it out can displace and what it can raise, metres.
    fn size(&self) -> f64 {
        self.bound.horizontal_m.max(self.bound.vertical_m)
    }
}

/// Effects that the scene calls for and the tolerance leaves out, the smallest first: as many as
/// together stay within it, in position and in height. What `--without` names is not among them.
fn under_tolerance(cases: &[Case], options: &Options) -> BTreeSet<Effect> {
    let free = |effect| !options.force.contains(effect) && !options.without.contains(effect);
    let mut cases: Vec<&Case> =
        cases.iter().filter(|c| c.present && !c.always && free(&c.effect)).collect();
    cases.sort_by(|a, b| a.size().total_cmp(&b.size()));
    let mut sum = Bound::EXACT;
    let mut small = BTreeSet::new();
    for case in cases {
        let horizontal_m = sum.horizontal_m + case.bound.horizontal_m;
        let vertical_m = sum.vertical_m + case.bound.vertical_m;
        if horizontal_m.max(vertical_m) <= options.tolerance.0 {
            sum = Bound { horizontal_m, vertical_m };
            small.insert(case.effect);
        }
    }
    small
}

/// Resolves the plan of a scene.
///
/// # Errors
/// The plan's parameters cannot be written as JSON, which no scene causes.
pub fn resolve(
    spec: &SceneSpec,
    options: &Options,
    frame: &Frame,
    terrain: &Terrain,
) -> Result<(Effects, Plan), SceneError> {
    let heights = HeightBounds::new(spec, terrain);
    let cases = cases(spec, frame, terrain, &heights);
    let small = under_tolerance(&cases, options);
    let mut on = BTreeSet::new();
    let mut steps = vec![projection_step()];
    for case in cases {
        let size = case.size();
        let forced = options.force.contains(&case.effect);
        let banned = options.without.contains(&case.effect);
        let wanted = case.present && !small.contains(&case.effect);
        let runs = !banned && case.possible && (forced || wanted);
        if runs {
            on.insert(case.effect);
        }
        let reason = match (runs, forced, banned, case.present) {
            (_, _, true, _) => "left out by --without".to_owned(),
            (false, true, ..) => "--force finds nothing in the scene to simulate".to_owned(),
            (true, true, ..) => "asked for by --force".to_owned(),
            (_, _, _, false) => "the scene has no cause for it".to_owned(),
            (true, ..) if case.always => "the scene asks for it".to_owned(),
            (true, ..) if size <= options.tolerance.0 => {
                format!("its {size:.2e} m and what is left out already exceed the tolerance")
            }
            (true, ..) => format!("without it the error could reach {size:.2e} m"),
            (false, ..) => format!("its {size:.2e} m are under the tolerance"),
        };
        steps.push(Step {
            id: case.effect.id().to_owned(),
            on: runs,
            form: case.form.to_owned(),
            bound: match (runs, case.present) {
                (true, _) => case.remains,
                (false, true) => case.bound,
                (false, false) => Bound::EXACT,
            },
            cost: case.cost.to_owned(),
            cause: case.cause,
            reason,
        });
    }
    steps.push(units_step(&heights, 4.0 * spec.lidar.noise_sigma_metres));
    steps.extend(picture_steps(spec));
    let mut parameters = serde_json::Map::new();
    parameters.insert("scene".to_owned(), serde_json::to_value(spec).unwrap_or_default());
    parameters.insert("force".to_owned(), serde_json::json!(options.force));
    parameters.insert("without".to_owned(), serde_json::json!(options.without));
    let plan = Plan {
        command: "simulate".to_owned(),
        tolerance_m: options.tolerance.0,
        parameters,
        steps,
    };
    Ok((Effects(on), plan))
}

fn cases(spec: &SceneSpec, frame: &Frame, terrain: &Terrain, heights: &HeightBounds) -> Vec<Case> {
    let mut cases = geometry_cases(spec, frame, terrain, heights);
    cases.extend(epoch_cases(spec, heights));
    cases.extend(lidar_cases(spec, heights));
    cases.push(Case {
        effect: Effect::SensorNoise,
        present: spec.images.sensor_noise_levels > 0.0,
        possible: spec.images.sensor_noise_levels > 0.0,
        cause: format!("images.sensor_noise_levels = {}", spec.images.sensor_noise_levels),
        form: "normal, per pixel and colour",
        bound: Bound::EXACT,
        remains: Bound::EXACT,
        cost: "three hashes per pixel",
        always: true,
    });
    cases.sort_by_key(|c| Effect::ALL.iter().position(|e| *e == c.effect));
    cases
}

/// Effects of light and of the coordinate system.
fn geometry_cases(
    spec: &SceneSpec,
    frame: &Frame,
    terrain: &Terrain,
    heights: &HeightBounds,
) -> Vec<Case> {
    let fall = heights.above_ground + heights.ground_range;
    let (tan_sun, shadow) = spec.sun.map_or((f64::INFINITY, 0.0), |sun| {
        let (sin, cos) = libm::sincos(sun.elevation_degrees.to_radians());
        // A sun at the zenith has no shadow, however small the cosine of 90 degrees comes out.
        if sun.elevation_degrees >= 90.0 {
            (f64::INFINITY, 0.0)
        } else {
            (sin / cos, fall * cos / sin)
        }
    });
    let lean = spec
        .view
        .map_or(0.0, |v| heights.above_ground * libm::tan(v.off_nadir_degrees.to_radians()));
    // A shadow's end on a roof is displaced as the shadow and as the roof: what stands on the lowest
    // ground and leans takes the shadow of the highest.
    let over_roofs = if tan_sun.is_finite() { heights.ground_range / tan_sun } else { 0.0 };
    let longest = if lean > 0.0 { shadow.max(lean + over_roofs) } else { shadow };
    let drop = shadow * shadow / (2.0 * WGS84_A);
    // The Earth's radius of curvature in Washington is within 0.2 % of the equator's.
    let of_radius = 2e-3 * drop;
    let sky = match (&spec.sun, &spec.view) {
        (None, None) => "no sun, satellite at nadir".to_owned(),
        (Some(s), None) => format!("sun {} deg high", s.elevation_degrees),
        (None, Some(v)) => format!("satellite {} deg off nadir", v.off_nadir_degrees),
        (Some(s), Some(v)) => format!(
            "sun {} deg high, satellite {} deg off nadir",
            s.elevation_degrees, v.off_nadir_degrees
        ),
    };
    let scale = (frame.scale() - 1.0).abs();
    // Light falls by the metre of the ground or, where that is left out, of the grid.
    let scale_of_light = frame.scale().max(1.0);
    // Light that comes from somewhere, or a satellite that stands somewhere.
    let lit = spec.sun.is_some() || spec.view.is_some();
    // Over the scene the convergence changes by the longitude times the cone's constant (< 1).
    let turn_over_scene = reach(spec) / WGS84_A * 1.2;
    let rise = spec.sun.map_or(0.0, |sun| {
        let turn = frame.convergence();
        let sun = [0.0, turn].map(|turn| sun.azimuth_degrees.to_radians() + turn);
        rise_towards(terrain, sun, reach(spec), heights.ground_range / tan_sun)
    });
    vec![
        Case {
            effect: Effect::Datum,
            present: true,
            possible: true,
            cause: "images are WGS 84, lidar is NAD83(HARN)".to_owned(),
            form: "7-parameter shift as PROJ defines it",
            // Over a scene the shift changes by far less than 1 %.
            bound: Bound::horizontal(1.01 * frame.datum_shift_m()),
            remains: Bound::EXACT,
            cost: "0.1 us per pixel",
            always: false,
        },
        Case {
            effect: Effect::Convergence,
            present: longest > 0.0,
            possible: lit,
            cause: format!("{sky}; true north is {:.2} deg off", frame.convergence().to_degrees()),
            form: "one angle for the scene",
            bound: Bound::horizontal(longest * frame.convergence().abs()),
            remains: Bound::horizontal(longest * turn_over_scene),
            cost: "none",
            always: false,
        },
        Case {
            effect: Effect::GridScale,
            present: longest > 0.0,
            possible: lit,
            cause: format!("{sky}; scale of the projection {:.6}", frame.scale()),
            form: "one factor for the scene",
            bound: Bound::horizontal(longest * scale),
            remains: Bound::horizontal(longest * 1e-6 * reach(spec) / 100.0),
            cost: "none",
            always: false,
        },
        Case {
            effect: Effect::Shadows,
            present: spec.sun.is_some(),
            possible: spec.sun.is_some(),
            cause: format!("{sky}; shadows up to {shadow:.1} m long"),
            form: "one ray per sample",
            bound: Bound::horizontal(shadow),
            remains: Bound::EXACT,
            cost: "0.2 us per pixel",
            always: false,
        },
        Case {
            effect: Effect::TerrainShadows,
            present: spec.sun.is_some() && rise * scale_of_light >= tan_sun,
            possible: spec.sun.is_some(),
            cause: match spec.sun {
                Some(_) => format!("{sky}; ground rises up to {rise:.2} m per metre towards it"),
                None => sky.clone(),
            },
            form: "ray march in steps of 2 m, refined",
            bound: Bound::horizontal(heights.ground_range / tan_sun),
            remains: Bound::horizontal(0.1),
            cost: "20 us per pixel",
            always: false,
        },
        Case {
            effect: Effect::Curvature,
            present: shadow > 0.0,
            possible: spec.sun.is_some(),
            cause: format!(
                "{sky}; a ray of {shadow:.1} m rises {drop:.1e} m over the level surface"
            ),
            form: "parabola, per cell of the index",
            bound: Bound { horizontal_m: drop / tan_sun, vertical_m: drop },
            remains: Bound { horizontal_m: of_radius / tan_sun, vertical_m: 3e-6 + of_radius },
            cost: "5 ns per cell",
            always: false,
        },
        Case {
            effect: Effect::Relief,
            present: lean > 0.0,
            possible: spec.view.is_some(),
            cause: format!("{sky}; roofs lean up to {lean:.2} m"),
            form: "exact line of sight per sample",
            bound: Bound::horizontal(lean),
            remains: Bound::horizontal(lean * lean * lean / (2.0 * WGS84_A * heights.above_ground)),
            cost: "0.3 us per pixel",
            always: false,
        },
    ]
}

/// A bound on how steeply the ground rises towards the sun, rise per metre, wherever light of a scene of that reach
/// comes by before it is above the highest ground, `clear` metres further on. The sun stands at one of two azimuths
/// (radians): whether grid north is told from true north is decided later.
fn rise_towards(terrain: &Terrain, azimuths: [f64; 2], reach: f64, clear: f64) -> f64 {
    let half = reach + clear.min(2.0 * reach);
    let rises = azimuths.map(|azimuth| {
        let (east, north) = libm::sincos(azimuth);
        terrain.steepest_towards([east, north], half)
    });
    rises[0].max(rises[1])
}

/// Effects of time between lidar and images.
fn epoch_cases(spec: &SceneSpec, heights: &HeightBounds) -> Vec<Case> {
    let years = spec.years_apart();
    let changes = years > 0.0 && spec.change.is_some();
    vec![
        Case {
            effect: Effect::Season,
            present: spec.seasons_differ(),
            possible: spec.seasons_differ(),
            cause: format!("lidar in {:?}, images in {:?}", spec.lidar.season, spec.images.season)
                .to_lowercase(),
            form: "bare crowns let pulses and light through",
            bound: Bound::vertical(spec.trees.height_metres),
            remains: Bound::EXACT,
            cost: "a second index",
            always: false,
        },
        Case {
            effect: Effect::Change,
            present: changes,
            possible: changes,
            cause: match &spec.change {
                Some(_) => format!("{years} years between lidar and images"),
                None => "no [change] table".to_owned(),
            },
            form: "objects of both epochs",
            bound: Bound::vertical(heights.above_ground),
            remains: Bound::EXACT,
            cost: "a second index",
            always: false,
        },
    ]
}

/// Flaws of the survey.
fn lidar_cases(spec: &SceneSpec, heights: &HeightBounds) -> Vec<Case> {
    let l = &spec.lidar;
    vec![
        Case {
            effect: Effect::AreaSampling,
            present: spec.samples_areas(),
            possible: spec.samples_areas(),
            cause: format!("lidar.sampling = {:?}", l.sampling).to_lowercase(),
            form: "mean of 4 x 4 points",
            bound: Bound::vertical(heights.above_ground),
            remains: Bound::EXACT,
            cost: "16 samples per cell",
            always: false,
        },
        Case {
            effect: Effect::CrownPenetration,
            present: l.crown_penetration_share > 0.0,
            possible: l.crown_penetration_share > 0.0,
            cause: format!("lidar.crown_penetration_share = {}", l.crown_penetration_share),
            form: "per cell",
            bound: Bound::vertical(spec.trees.height_metres),
            remains: Bound::EXACT,
            cost: "one hash per cell",
            always: false,
        },
        Case {
            effect: Effect::Noise,
            present: l.noise_sigma_metres > 0.0,
            possible: l.noise_sigma_metres > 0.0,
            cause: format!("lidar.noise_sigma_metres = {}", l.noise_sigma_metres),
            form: "normal per cell, cut at 4 sigma",
            bound: Bound::vertical(4.0 * l.noise_sigma_metres),
            remains: Bound::vertical(4.0 * l.noise_sigma_metres),
            cost: "50 ns per cell",
            always: false,
        },
        Case {
            effect: Effect::MissingPulses,
            present: l.missing_pulse_share > 0.0,
            possible: l.missing_pulse_share > 0.0,
            cause: format!("lidar.missing_pulse_share = {}", l.missing_pulse_share),
            form: "nodata per cell",
            bound: Bound::EXACT,
            remains: Bound::EXACT,
            cost: "one hash per cell",
            always: true,
        },
        Case {
            effect: Effect::Gaps,
            present: l.gap_count > 0 && l.gap_width_metres > 0.0,
            possible: l.gap_count > 0 && l.gap_width_metres > 0.0,
            cause: format!("lidar.gap_count = {}", l.gap_count),
            form: "nodata in strips",
            bound: Bound::EXACT,
            remains: Bound::EXACT,
            cost: "none",
            always: true,
        },
    ]
}
