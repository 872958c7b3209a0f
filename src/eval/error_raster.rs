//! `--errors`: the error of every pixel as a raster.

use super::inputs::Place;
use super::run::EvalError;
use super::score::Compared;
use crate::batch::write_atomic;
use crate::grid::GeoTransform;
use crate::raster::geotiff::{CogSpec, encode_cog};
use crate::raster::npz::{self, Compression, NpyArray, NpyData};
use crate::units::LinearUnit;
use std::path::Path;

/// Writes `<name>_error.tif` (a COG on the prediction's pixels, EPSG:3857) where the name implies a
/// grid, else `<name>_error.npz`: prediction - aligned truth, metres, rounded to `f32`.
///
/// # Errors
/// [`EvalError::Write`].
pub fn write(
    folder: &Path,
    name: &str,
    compared: &Compared,
    place: &Place,
) -> Result<(), EvalError> {
    let (width, height) = compared.truth.size();
    let errors: Vec<f32> = compared.errors.iter().map(|&error| error as f32).collect();
    let (file, bytes) = match &place.grid {
        Some(grid) => {
            let GeoTransform([west, pixel_width, _, north, _, pixel_height]) = grid.geotransform();
            let across = pixel_width * f64::from(grid.width()) / width as f64;
            let down = -pixel_height * f64::from(grid.height()) / height as f64;
            let software = format!("sat3d {}", env!("CARGO_PKG_VERSION"));
            let spec = CogSpec {
                width: width as u32,
                height: height as u32,
                geotransform: GeoTransform::north_up(west, north, across, down),
                epsg: 3857,
                vertical_epsg: None,
                unit: Some(LinearUnit::Metre),
                metadata: vec![
                    ("TIFFTAG_SOFTWARE".into(), software),
                    ("CONTENT".into(), "prediction - aligned ground truth".into()),
                ],
            };
            (format!("{name}_error.tif"), encode_cog(&errors, &spec))
        }
        None => {
            let shape = [height, width];
            let array = NpyArray { name: "error", shape: &shape, data: NpyData::F32(&errors) };
            (format!("{name}_error.npz"), npz::encode(&[array], Compression::Fast))
        }
    };
    let path = folder.join(file);
    let unwritten = |source| EvalError::Write { path: path.clone(), source };
    std::fs::create_dir_all(folder).map_err(unwritten)?;
    write_atomic(&path, &bytes).map_err(unwritten)
}
