//! Surfaces in npz and npy files.

use super::{InputError, InputSettings, PAPER_METRES_PER_UNIT, Place, Prediction, Truth};
use crate::eval::surface::Surface;
use crate::raster::npz::{self, NpyOwned, NpzError};
use std::path::Path;

/// Heights in the scene cube lie in [0, 1]; what reaches further than this is in metres.
const CUBE_LIMITS: std::ops::RangeInclusive<f32> = -1.0..=2.0;

/// The ground truth in `dsm` (an npy: its one array), bare earth in `dtm`.
pub(super) fn truth(path: &Path) -> Result<Truth, InputError> {
    let mut arrays = npz::read(path)?;
    let npy = is_npy(path);
    let surface = match take(&mut arrays, if npy { "arr_0" } else { "dsm" }) {
        Some(array) => surface(path, "dsm", array)?,
        None => return Err(missing(path, "dsm", &arrays)),
    };
    let ground = take(&mut arrays, "dtm").map(|array| self::surface(path, "dtm", array));
    let ground = ground.transpose()?;
    if let Some(ground) = &ground
        && ground.size() != surface.size()
    {
        return Err(InputError::content(
            path,
            format!(
                "`dtm` has {} x {} pixels and `dsm` {} x {}",
                ground.width, ground.height, surface.width, surface.height
            ),
        ));
    }
    Ok(Truth { surface, ground, place: Place::unknown(), notes: Vec::new() })
}

/// A prediction: `dsm` in metres, else `arr_0` in the scene cube.
pub(super) fn prediction(path: &Path, settings: &InputSettings) -> Result<Prediction, InputError> {
    let mut arrays = npz::read(path)?;
    let mut notes = Vec::new();
    let npy = is_npy(path);
    if !npy && let Some(array) = take(&mut arrays, "dsm") {
        return Ok(Prediction { surface: surface(path, "dsm", array)?, notes });
    }
    let Some(array) = take(&mut arrays, "arr_0") else {
        return Err(missing(path, "arr_0` or `dsm", &arrays));
    };
    let mut surface = surface(path, "arr_0", array)?;
    let in_cube = surface.values.iter().all(|v| !v.is_finite() || CUBE_LIMITS.contains(v));
    let scale = match (settings.metres_per_unit, npy) {
        (Some(scale), _) => scale,
        (None, true) if in_cube => {
            return Err(InputError::content(
                path,
                "all values lie in [-1, 2], so this npy may hold metres or heights in the scene cube; say --metres-per-unit 1 or --metres-per-unit 64.48",
            ));
        }
        (None, true) => 1.0,
        (None, false) => {
            if !in_cube {
                return Err(InputError::content(
                    path,
                    "`arr_0` reaches beyond the scene cube's [0, 1]; metres belong into an array `dsm`, or say --metres-per-unit 1",
                ));
            }
            match take(&mut arrays, "metres_per_unit") {
                Some(array) => stated_scale(path, &array)?,
                None => PAPER_METRES_PER_UNIT,
            }
        }
    };
    if scale != 1.0 {
        crate::plan::runs("scale");
        for value in &mut surface.values {
            // As numpy multiplies an array of f32 by a Python float.
            *value *= scale as f32;
        }
    }
    if scale != PAPER_METRES_PER_UNIT {
        notes.push(format!("{scale} m per unit"));
    }
    Ok(Prediction { surface, notes })
}

fn stated_scale(path: &Path, array: &NpyOwned) -> Result<f64, InputError> {
    match array.to_f64()[..] {
        [scale] if scale.is_finite() && scale > 0.0 => Ok(scale),
        ref other => Err(InputError::content(
            path,
            format!("`metres_per_unit` is one positive number, not {other:?}"),
        )),
    }
}

fn is_npy(path: &Path) -> bool {
    path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("npy"))
}

fn take(arrays: &mut Vec<(String, NpyOwned)>, name: &str) -> Option<NpyOwned> {
    let at = arrays.iter().position(|(key, _)| key == name)?;
    Some(arrays.swap_remove(at).1)
}

fn missing(path: &Path, name: &str, arrays: &[(String, NpyOwned)]) -> InputError {
    InputError::Npz(NpzError::Missing {
        path: path.to_owned(),
        name: name.to_owned(),
        found: arrays.iter().map(|(key, _)| key.clone()).collect(),
    })
}

/// An array of two axes (others of length one are dropped) as a surface.
fn surface(path: &Path, key: &str, array: NpyOwned) -> Result<Surface, InputError> {
    let axes: Vec<usize> = match array.shape.len() {
        2 => array.shape.clone(),
        _ => array.shape.iter().copied().filter(|&n| n != 1).collect(),
    };
    match axes[..] {
        [height, width] if width > 0 && height > 0 => {
            Ok(Surface::new(width, height, array.into_f32()))
        }
        _ => Err(InputError::content(
            path,
            format!("`{key}` has the shape {:?}; rows and columns are needed", array.shape),
        )),
    }
}
