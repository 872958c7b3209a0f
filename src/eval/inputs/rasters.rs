//! Surfaces in rasters: on the grid that a name implies, or on the ground truth's own.

use super::{InputError, Place, Prediction, Truth};
use crate::crs::{CrsSpec, ground_distance_m};
use crate::eval::surface::Surface;
use crate::grid::{GeoTransform, ImageGrid, LonLat, PixelPoint};
use crate::lidar::{EdgeRule, Resampling, SingleRaster, SingleRasterError};
use crate::raster::OpenOptions;
use std::path::Path;

/// Pixels that a single raster may have: as many are held several times in memory.
const MOST_PIXELS: u64 = 100_000_000;
/// Corners that lie within so many pixels of each other are the same.
const SAME_PX: f64 = 0.01;

/// Georeference of a raster.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Its pixel corners.
    pub geotransform: GeoTransform,
    /// Its CRS.
    pub crs: CrsSpec,
}

/// The heights of a raster on the image grid of a name.
///
/// A raster that covers exactly the image is taken with the pixels that it has; any other is
/// warped onto the grid, bilinearly, by GDAL's rules.
pub(super) fn on_image_grid(path: &Path, grid: &ImageGrid) -> Result<Surface, InputError> {
    let raster = open(path)?;
    if covers(&raster, grid) {
        return whole(&raster, path);
    }
    let values = raster
        .on_grid(grid, Resampling::Bilinear, EdgeRule::Renormalise)
        .map_err(|error| failure(path, error))?;
    Ok(Surface::new(grid.width() as usize, grid.height() as usize, values))
}

/// Columns and rows that [`on_image_grid`] gives of a raster, or (without a grid) those that it has,
/// with the metres of a pixel east-west where its place is known. Reads the header.
pub(super) fn size(
    path: &Path,
    grid: Option<&ImageGrid>,
) -> Result<([usize; 2], Option<f64>), InputError> {
    let raster = open(path)?;
    let own = [raster.header().width, raster.header().height].map(|side| side as usize);
    Ok(match grid {
        Some(grid) if !covers(&raster, grid) => {
            ([grid.width() as usize, grid.height() as usize], None)
        }
        Some(_) => (own, None),
        None => (own, place(&raster).0.map(|(across, _)| across)),
    })
}

/// Metres of a raster's pixel east-west and north-south, and its centre, where they are known.
fn place(raster: &SingleRaster) -> (Option<(f64, f64)>, Option<LonLat>) {
    let header = raster.header();
    let middle = |dx: f64, dy: f64| {
        let x = f64::from(header.width / 2) + dx;
        let y = f64::from(header.height / 2) + dy;
        let at = header.geotransform.to_projected(PixelPoint { x, y });
        raster.placement().projection.inverse(at).ok()
    };
    let pixel_m = match (middle(0.0, 0.0), middle(1.0, 0.0), middle(0.0, 1.0)) {
        (Some(at), Some(east), Some(south)) => {
            Some((ground_distance_m(at, east), ground_distance_m(at, south)))
        }
        _ => None,
    };
    (pixel_m, middle(0.0, 0.0))
}

/// A ground truth whose name implies no grid: its own grid is the one.
pub(super) fn truth(path: &Path) -> Result<Truth, InputError> {
    let raster = open(path)?;
    let surface = whole(&raster, path)?;
    let header = raster.header();
    let (pixel_m, center) = place(&raster);
    let frame = header.crs.clone().map(|crs| Frame { geotransform: header.geotransform, crs });
    let place = Place { grid: None, center, pixel_m, frame };
    Ok(Truth { surface, ground: None, place, notes: raster.warnings().to_vec() })
}

/// A prediction for a truth whose name implies no grid.
pub(super) fn prediction(path: &Path, truth: &Truth) -> Result<Prediction, InputError> {
    let raster = open(path)?;
    let source = whole(&raster, path)?;
    let notes = raster.warnings().to_vec();
    let Some(frame) = &truth.place.frame else {
        return Ok(Prediction { surface: source, notes });
    };
    let header = raster.header();
    let same_crs = header.crs.as_ref().is_some_and(|crs| {
        crs.epsg.is_some() && crs.epsg == frame.crs.epsg || crs.name == frame.crs.name
    });
    if !same_crs {
        let own = header.crs.as_ref().map_or_else(|| "no CRS".to_owned(), CrsSpec::label);
        return Err(InputError::Warp {
            path: path.to_owned(),
            reason: format!(
                "it is in {own} and the ground truth in {}; bring it there first (gdalwarp -t_srs)",
                frame.crs.label()
            ),
        });
    }
    let (width, height) = truth.surface.size();
    let surface = onto(&source, &header.geotransform, &frame.geotransform, width, height);
    Ok(Prediction { surface, notes })
}

/// Samples a raster at the pixel centres of another grid in the same CRS: as it is where the
/// centres agree, bilinearly elsewhere (NaN where a tap is missing).
fn onto(
    source: &Surface,
    from: &GeoTransform,
    to: &GeoTransform,
    width: usize,
    height: usize,
) -> Surface {
    let tap = |col: i64, row: i64| {
        let inside =
            (0..source.width as i64).contains(&col) && (0..source.height as i64).contains(&row);
        if inside { source.values[row as usize * source.width + col as usize] } else { f32::NAN }
    };
    let mut values = Vec::with_capacity(width * height);
    for y in 0..height {
        for x in 0..width {
            let centre = PixelPoint { x: x as f64 + 0.5, y: y as f64 + 0.5 };
            let at = from.to_pixel(to.to_projected(centre));
            let (col, row) = (at.x - 0.5, at.y - 0.5);
            let near = (col.round(), row.round());
            if (col - near.0).abs() < SAME_PX && (row - near.1).abs() < SAME_PX {
                values.push(tap(near.0 as i64, near.1 as i64));
                continue;
            }
            let (left, top) = (col.floor(), row.floor());
            let (dx, dy) = ((col - left) as f32, (row - top) as f32);
            let (left, top) = (left as i64, top as i64);
            let upper = tap(left, top) * (1.0 - dx) + tap(left + 1, top) * dx;
            let lower = tap(left, top + 1) * (1.0 - dx) + tap(left + 1, top + 1) * dx;
            values.push(upper * (1.0 - dy) + lower * dy);
        }
    }
    Surface::new(width, height, values)
}

fn open(path: &Path) -> Result<SingleRaster, InputError> {
    SingleRaster::open(path, &OpenOptions::default(), None).map_err(|error| failure(path, error))
}

fn whole(raster: &SingleRaster, path: &Path) -> Result<Surface, InputError> {
    let (width, height) = (raster.header().width, raster.header().height);
    if u64::from(width) * u64::from(height) > MOST_PIXELS {
        return Err(InputError::content(
            path,
            format!("{width} x {height} pixels are too many to score at once; cut it into images"),
        ));
    }
    let values = raster.whole().map_err(|error| failure(path, error))?;
    Ok(Surface::new(width as usize, height as usize, values))
}

/// Whether a raster covers exactly the footprint of an image, with any number of pixels.
fn covers(raster: &SingleRaster, grid: &ImageGrid) -> bool {
    let header = raster.header();
    let corner = |grid: &GeoTransform, x: u32, y: u32| {
        grid.to_projected(PixelPoint { x: f64::from(x), y: f64::from(y) })
    };
    let target = grid.geotransform();
    let near = SAME_PX * target.0[1];
    let pairs = [
        (corner(&header.geotransform, 0, 0), corner(&target, 0, 0)),
        (
            corner(&header.geotransform, header.width, header.height),
            corner(&target, grid.width(), grid.height()),
        ),
    ];
    raster.placement().web_mercator
        && pairs.iter().all(|(a, b)| (a.x - b.x).abs() < near && (a.y - b.y).abs() < near)
}

fn failure(path: &Path, error: SingleRasterError) -> InputError {
    match error {
        SingleRasterError::Raster(error) => error.into(),
        SingleRasterError::Crs { path, source } => InputError::Crs { path, source },
        other => InputError::Warp {
            path: path.to_owned(),
            reason: other.to_string().replace(&format!("{}: ", path.display()), ""),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_grid_in_the_same_crs_is_cut_where_it_fits_and_sampled_where_not() {
        let source = Surface::new(3, 2, vec![0.0, 1.0, 2.0, 10.0, 11.0, 12.0]);
        let grid = |west: f64, north: f64| GeoTransform::north_up(west, north, 1.0, 1.0);
        let from = grid(100.0, 50.0);
        let cut = onto(&source, &from, &grid(101.0, 50.0), 3, 1);
        assert_eq!(cut.values[..2], [1.0, 2.0]);
        assert!(cut.values[2].is_nan());
        let between = onto(&source, &from, &grid(100.5, 49.5), 1, 1);
        assert!((between.values[0] - 5.5).abs() < 1e-6, "{between:?}");
        let half = onto(&source, &from, &GeoTransform::north_up(100.0, 50.0, 0.5, 0.5), 6, 4);
        assert!(half.values[0].is_nan(), "half a pixel outside of the first centre");
        assert!((half.values[6 + 1] - (0.25 + 0.25 * 10.0)).abs() < 1e-5, "{half:?}");
    }
}
