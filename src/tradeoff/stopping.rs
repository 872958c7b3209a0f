//! Inference: rays that end where no light is left. A study: the program's renderer does not stop early, because
//! its second pass needs the weights of the whole first one; this says what stopping would gain.
//!
//! The march is the stable rule with 96 equal cells, taken in blocks of 16 over a row of pixels at once, so
//! that rays that have ended cost nothing.

use super::clock::{Findings, Judged, Subject, Way};
use super::rays::{centres, slow_heights, trained};
use super::report::Quantity;
use super::truth::{quantile, rms};
use super::{Setup, TradeoffError};
use crate::footprint::TRAINING_WIDTH_M;
use crate::model::field::Field;
use crate::model::render::exact_scale;

pub(super) const CAUSE: &str = "behind a surface there is no light";

const CELLS: usize = 96;
const BLOCK: usize = 16;

/// One ray under way.
#[derive(Clone, Copy)]
struct Ray {
    /// Column of its pixel.
    column: usize,
    x: f32,
    transmittance: f64,
    opacity: f64,
    height: f64,
}

/// What a march gave.
struct Marched {
    heights: Vec<f32>,
    samples: usize,
}

/// Heights in metres; a ray ends where its transmittance is not above `least`.
fn march(field: &Field, size: usize, least: f64) -> Marched {
    let scale = exact_scale(field.scale());
    let width = 2.0 / CELLS as f64;
    let mut heights = vec![f32::NAN; size * size];
    let mut samples = 0;
    let mut points = Vec::new();
    for (y, row) in centres(size, scale).zip(heights.chunks_exact_mut(size)) {
        let new = |(column, x)| Ray { column, x, transmittance: 1.0, opacity: 0.0, height: 0.0 };
        let mut rays: Vec<Ray> = centres(size, scale).enumerate().map(new).collect();
        for block in 0..CELLS / BLOCK {
            points.clear();
            let z = |k: usize| 1.0 - ((block * BLOCK + k) as f64 + 0.5) * width;
            for ray in &rays {
                points.extend((0..BLOCK).map(|k| [ray.x, y, z(k) as f32]));
            }
            samples += points.len();
            let densities = field.densities(&points);
            for (ray, densities) in rays.iter_mut().zip(densities.chunks_exact(BLOCK)) {
                for (k, density) in densities.iter().enumerate() {
                    let ends = -libm::expm1(-f64::from(*density) * width);
                    ray.opacity += ray.transmittance * ends;
                    ray.height += ray.transmittance * ends * (z(k) + 1.0) / 2.0;
                    ray.transmittance *= 1.0 - ends;
                }
            }
            rays.retain(|ray| {
                let goes_on = ray.transmittance > least && block + 1 < CELLS / BLOCK;
                if !goes_on && ray.opacity > 0.0 {
                    row[ray.column] = (ray.height / ray.opacity * TRAINING_WIDTH_M) as f32;
                }
                goes_on
            });
        }
    }
    Marched { heights, samples }
}

/// At which transmittance a ray ends.
pub(super) fn early_stop(setup: &Setup<'_>) -> Result<Findings, TradeoffError> {
    let field = trained(setup)?;
    let size = setup.either(48, 256);
    let truth = slow_heights(&field, size);
    let field = &field;
    let ways = [0.0, 1e-6, 1e-4, 1e-2, 5e-2]
        .into_iter()
        .map(|least| {
            let name = if least == 0.0 { "never".into() } else { format!("below {least:e}") };
            Way::new(name, least == 0.0, move || Ok(march(field, size, least)))
        })
        .collect();
    let subject = Subject {
        truth: "a march of 4096 cells in f64 through the same field",
        error: Quantity::new("RMS height error", "m"),
        work: format!("one DSM of {size} x {size} px by a plain march of 96 cells"),
        units: 1.0,
    };
    setup.clock.measure(subject, ways, |marched: &Marched| {
        Ok(Judged::new(rms(&marched.heights, &truth))
            .also("largest error", "m", quantile(&marched.heights, &truth, 1.0))
            .also("samples a ray", "", marched.samples as f64 / (size * size) as f64))
    })
}
