//! What the files of an evaluation call for, from their headers.

use super::{InputSettings, Pair, is_array, rasters};
use crate::grid::ImageGrid;
use crate::raster::npz;
use crate::vigor::SatelliteName;
use rayon::prelude::*;
use std::path::Path;

/// What the plan of an evaluation has to know of its files. A file whose header cannot be read calls
/// for nothing: the run says what is wrong with it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Demands {
    /// Images with a truth and at least one prediction.
    pub pairs: usize,
    /// Of those, with a prediction in units of the scene cube.
    pub scaled: usize,
    /// With a prediction of another size than the truth.
    pub resized: usize,
    /// With a truth that has bare earth and a known pixel size.
    pub ground: usize,
    /// With a known pixel size.
    pub placed: usize,
    /// With a name that implies an image grid.
    pub named: usize,
    /// Largest pixel of a truth on the ground, metres; 0 where none is known.
    pub truth_m: f64,
    /// Largest pixel of a prediction on the ground, metres; 0 where none is known.
    pub pixel_m: f64,
    /// Pixels from the middle of the largest prediction to its corner.
    pub half_diagonal_px: f64,
}

/// Looks at the headers of all pairs.
#[must_use]
pub fn demands(pairs: &[Pair], settings: &InputSettings) -> Demands {
    let each: Vec<Demands> = pairs.par_iter().filter_map(|pair| of_pair(pair, settings)).collect();
    each.into_iter().fold(Demands::default(), |a, b| Demands {
        pairs: a.pairs + b.pairs,
        scaled: a.scaled + b.scaled,
        resized: a.resized + b.resized,
        ground: a.ground + b.ground,
        placed: a.placed + b.placed,
        named: a.named + b.named,
        truth_m: a.truth_m.max(b.truth_m),
        pixel_m: a.pixel_m.max(b.pixel_m),
        half_diagonal_px: a.half_diagonal_px.max(b.half_diagonal_px),
    })
}

/// What a file's header says.
struct Header {
    /// Columns and rows.
    size: [usize; 2],
    /// A truth has bare earth; a prediction is in units of the cube.
    extra: bool,
    /// Metres per pixel, of a raster without an image's name.
    pixel_m: Option<f64>,
}

fn of_pair(pair: &Pair, settings: &InputSettings) -> Option<Demands> {
    let path = pair.truth.as_deref()?;
    let center = SatelliteName::parse(&pair.name).ok().map(|name| name.center());
    let grid = |side: u32| ImageGrid::new(center?, settings.zoom, side, side).ok();
    let truth = if is_array(path) {
        array(path, &["dsm"], |names| names.contains(&"dtm"))?
    } else {
        raster(path, grid(settings.size).as_ref())?
    };
    // Predictions are brought onto the grid that the truth's pixels make.
    let grid = center.and_then(|center| {
        let [columns, rows] = truth.size.map(|side| side as u32);
        ImageGrid::new(center, settings.zoom, columns, rows).ok()
    });
    let pixel_m = grid.as_ref().map(ImageGrid::ground_sample_distance);
    let pixel_m = pixel_m.or(truth.pixel_m).or(settings.gsd_m);
    let predictions: Vec<Header> = pair
        .predictions
        .iter()
        .flatten()
        .filter_map(|path| {
            if is_array(path) {
                let other = settings.metres_per_unit.is_none_or(|scale| scale != 1.0);
                let npy = path.extension().is_some_and(|end| end.eq_ignore_ascii_case("npy"));
                let stated = settings.metres_per_unit.is_some() || !npy;
                array(path, &["dsm", "arr_0"], |names| !names.contains(&"dsm") && other && stated)
            } else if grid.is_none() && truth.pixel_m.is_some() {
                // Rasters without an image's name are laid onto the truth's own grid.
                Some(Header { size: truth.size, extra: false, pixel_m: None })
            } else {
                raster(path, grid.as_ref())
            }
        })
        .collect();
    let largest = predictions.iter().map(|p| p.size).max_by_key(|size| size[0] * size[1])?;
    let smallest = predictions.iter().map(|p| p.size[0]).min()?;
    let any = |what: &dyn Fn(&Header) -> bool| usize::from(predictions.iter().any(what));
    Some(Demands {
        pairs: 1,
        scaled: any(&|prediction| prediction.extra),
        resized: any(&|prediction| prediction.size != truth.size),
        ground: usize::from(truth.extra && pixel_m.is_some()),
        placed: usize::from(pixel_m.is_some()),
        named: usize::from(grid.is_some()),
        truth_m: pixel_m.unwrap_or(0.0),
        pixel_m: pixel_m.map_or(0.0, |metres| metres * truth.size[0] as f64 / smallest as f64),
        half_diagonal_px: libm::hypot(largest[0] as f64, largest[1] as f64) / 2.0,
    })
}

/// The first of some arrays that a file has.
fn array(path: &Path, keys: &[&str], extra: impl Fn(&[&str]) -> bool) -> Option<Header> {
    let shapes = npz::shapes(path).ok()?;
    let names: Vec<&str> = shapes.iter().map(|(name, _)| name.as_str()).collect();
    let npy = path.extension().is_some_and(|end| end.eq_ignore_ascii_case("npy"));
    let keys: &[&str] = if npy { &["arr_0"] } else { keys };
    let (_, shape) = keys.iter().find_map(|key| shapes.iter().find(|(name, _)| name == key))?;
    let axes: Vec<usize> = match shape.len() {
        2 => shape.clone(),
        _ => shape.iter().copied().filter(|&length| length != 1).collect(),
    };
    let &[height, width] = &axes[..] else { return None };
    (width > 0 && height > 0).then(|| Header {
        size: [width, height],
        extra: extra(&names),
        pixel_m: None,
    })
}

fn raster(path: &Path, grid: Option<&ImageGrid>) -> Option<Header> {
    let (size, pixel_m) = rasters::size(path, grid).ok()?;
    Some(Header { size, extra: false, pixel_m })
}
