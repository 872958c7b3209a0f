//! One scene: what a model makes of it, against its exact heights.

use super::buildings::{Building, Buildings, buildings};
use super::columns::Columns;
use crate::eval::align::{AlignError, AlignSettings, align, apply};
use crate::eval::metrics::{ErrorSums, PUBLISHED_THRESHOLDS_M};
use crate::eval::{OffsetMethod, Protocol, Surface};
use crate::scene::random::Kind;
use serde::{Deserialize, Serialize};

/// The exact heights of a square image, rows from the north.
#[derive(Clone, Copy, Debug)]
pub struct Truth<'a> {
    /// Pixels of a side.
    pub side: usize,
    /// Height of the surface, metres.
    pub surface: &'a [f32],
    /// Its classes, by the numbers of [`Sample::classes`](crate::scene::random::Sample::classes).
    pub classes: &'a [u8],
}

/// What a model makes of an image.
#[derive(Clone, Debug, PartialEq)]
pub struct Prediction {
    /// Its DSM, metres, rows from the north.
    pub dsm_m: Vec<f32>,
    /// Its mesh.
    pub columns: Columns,
}

/// Errors of a surface after its vertical offset is out.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Errors {
    /// Pixels that have a height.
    pub pixels: u64,
    /// Mean absolute error, metres.
    pub mae_m: f64,
    /// Root mean square error, metres.
    pub rmse_m: f64,
    /// Pixels with an error under 2.5 m.
    pub within: u64,
}

impl Errors {
    /// Of a prediction of the same size, as `sat3d eval --protocol vertical` has them.
    ///
    /// # Errors
    /// [`AlignError`] where no pixel has both heights.
    ///
    /// # Panics
    /// When the sizes differ.
    pub fn between(prediction: &Surface, truth: &Surface) -> Result<Self, AlignError> {
        let settings = AlignSettings {
            protocol: Protocol::Vertical,
            offset: OffsetMethod::Median,
            // The median draws nothing; shift and rotation stay as they are.
            seed: 0,
            pixel_m: (1.0, 1.0),
            max_shift_px: 0.0,
            max_rotation_deg: 0.0,
        };
        let alignment = align(prediction, truth, &settings)?;
        let aligned = apply(&alignment, truth);
        let error =
            |(p, t): (&f32, &f32)| f64::from(*p) - (f64::from(*t) - alignment.vertical_offset_m);
        let errors: Vec<f64> = prediction
            .values
            .iter()
            .zip(&aligned.values)
            .map(error)
            .filter(|error| error.is_finite())
            .collect();
        let mut sums = ErrorSums::new(PUBLISHED_THRESHOLDS_M.len());
        sums.add(&errors, &PUBLISHED_THRESHOLDS_M);
        let (mae_m, rmse_m) = (sums.mae(), sums.rmse());
        Ok(Self { pixels: sums.pixels(), mae_m, rmse_m, within: sums.below(0) })
    }
}

/// The scores of one scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ImageScore {
    /// Seed of its set.
    pub seed: u64,
    /// Its number.
    pub index: u64,
    /// What kind of place it is.
    pub kind: Kind,
    /// The DSM.
    pub dsm: Errors,
    /// The same height everywhere.
    pub flat: Errors,
    /// The mesh's top.
    pub mesh: Errors,
    /// Columns of the pixel lattice.
    pub columns: u64,
    /// Columns in which nothing stands.
    pub holes: u64,
    /// Columns in which something stands over an empty cell.
    pub floaters: u64,
    /// Its buildings.
    pub buildings: Vec<Building>,
    /// Buildings without ground around them, which are not scored.
    pub without_ground: u64,
}

impl ImageScore {
    /// Scores a prediction; `place` is seed and number.
    ///
    /// # Errors
    /// [`AlignError`] where the prediction has no height.
    ///
    /// # Panics
    /// When sizes differ.
    pub fn new(
        place: [u64; 2],
        kind: Kind,
        prediction: &Prediction,
        truth: &Truth<'_>,
    ) -> Result<Self, AlignError> {
        let side = truth.side;
        let surface = |values: &[f32]| Surface::new(side, side, values.to_vec());
        let exact = surface(truth.surface);
        let errors = |values: &[f32]| Errors::between(&surface(values), &exact);
        let Columns { top_m, holes, floaters } = &prediction.columns;
        let Buildings { list, without_ground } =
            buildings(&prediction.dsm_m, truth.surface, truth.classes, side);
        Ok(Self {
            seed: place[0],
            index: place[1],
            kind,
            dsm: errors(&prediction.dsm_m)?,
            flat: errors(&vec![0.0; side * side])?,
            mesh: errors(top_m)?,
            columns: top_m.len() as u64,
            holes: *holes,
            floaters: *floaters,
            buildings: list,
            without_ground,
        })
    }
}
