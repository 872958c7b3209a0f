//! Benchmark build, one image in memory: transforms and kernels.

use super::clock::{Findings, Judged, Subject, Way};
use super::report::Quantity;
use super::truth::{FOOT_M, Place, SIDE, ZOOM, block_means, quantile, rms};
use super::{Setup, TradeoffError};
use crate::grid::{ImageGrid, PixelPoint};
use crate::lidar::{EdgeRule, PixelMap, PixelToCrs, Resampling, TransformForm, WarpSettings, warp};

pub(super) const TRANSFORM: &str = "the projection bends within an image";
pub(super) const FINE: &str = "image pixels do not coincide with lidar cells";
pub(super) const COARSE: &str = "image pixels are larger than lidar cells";

/// Zoom and side of images whose pixels are larger than lidar cells: 0.81 m against 0.46 m in Seattle.
const COARSE_IMAGE: (u8, u32) = (17, 160);
/// Points along a pixel of the supersampled kernel.
const PARTS: u32 = 4;

fn settings(resampling: Resampling) -> WarpSettings {
    WarpSettings {
        resampling,
        edge: EdgeRule::Renormalise,
        metres_per_unit: FOOT_M,
        horizontal_bound: 0.0,
    }
}

/// The exact way from an image of the place to its tile.
fn exact(place: &Place, grid: ImageGrid) -> PixelToCrs {
    PixelToCrs::WebMercator { grid, projection: place.projection.clone() }
}

/// Heights of an image in one form.
fn warped(
    place: &Place,
    pixels: PixelToCrs,
    form: TransformForm,
    resampling: Resampling,
) -> Result<(PixelMap, Vec<f32>), TradeoffError> {
    let map = PixelMap::fit(pixels, place.lattice, form)?;
    let (width, height) = map.size();
    let mut heights = vec![f32::NAN; width as usize * height as usize];
    warp(&map, &place.tile, &settings(resampling), &mut heights, None)?;
    Ok((map, heights))
}

/// An image in one form; the reference grid has none.
struct Transformed {
    form: Option<TransformForm>,
    map: PixelMap,
    heights: Vec<f32>,
}

/// How pixels are taken to the tiles' CRS.
pub(super) fn transform(setup: &Setup<'_>) -> Result<Findings, TradeoffError> {
    let place = Place::new()?;
    let grid = place.image(ZOOM, SIDE)?;
    let (reference, truth) =
        warped(&place, exact(&place, grid), TransformForm::Exact, Resampling::Bilinear)?;
    // What `auto` takes here within the tolerance.
    let usual = reference.errors().cheapest(super::bench::defaults().tolerance_m / FOOT_M);
    let forms = [
        ("exact", TransformForm::Exact),
        ("chebyshev", TransformForm::Chebyshev),
        ("separable", TransformForm::Separable),
        ("affine", TransformForm::Affine),
    ];
    let place = &place;
    let mut ways: Vec<Way<'_, Transformed>> = forms
        .into_iter()
        .map(|(name, form)| {
            Way::new(name, form == usual, move || {
                let pixels = exact(place, grid);
                let (map, heights) = warped(place, pixels, form, Resampling::Bilinear)?;
                Ok(Transformed { form: Some(form), map, heights })
            })
        })
        .collect();
    ways.push(Way::new("reference grid", false, move || {
        let pixels = PixelToCrs::reference_box(&grid, &*place.projection)?;
        let (map, heights) = warped(place, pixels, TransformForm::Affine, Resampling::Bilinear)?;
        Ok(Transformed { form: None, map, heights })
    }));
    let subject = Subject {
        truth: "one projection per pixel",
        error: Quantity::new("largest displacement", "m"),
        work: "fit and bilinear warp of one image of 640 x 640 px".into(),
        units: 1.0,
    };
    setup.clock.measure(subject, ways, |Transformed { form, map, heights }| {
        let mut most: f64 = 0.0;
        for k in 0..SIDE * SIDE {
            let p = PixelPoint { x: f64::from(k % SIDE) + 0.5, y: f64::from(k / SIDE) + 0.5 };
            let (a, b) = (map.coordinate(p)?, reference.coordinate(p)?);
            let lattice = map.lattice();
            let (dx, dy) = ((a.x - b.x) * lattice.pixel_width, (a.y - b.y) * lattice.pixel_height);
            most = most.max(libm::hypot(dx, dy) * FOOT_M);
        }
        let judged = Judged::new(most).also("RMS height error", "m", rms(heights, &truth));
        Ok(match form {
            Some(form) => judged.bounded(map.errors().of(*form) * FOOT_M),
            None => judged,
        })
    })
}

/// How heights are interpolated where the image is finer than the tiles.
pub(super) fn resampling(setup: &Setup<'_>) -> Result<Findings, TradeoffError> {
    let place = Place::new()?;
    let truth = place.heights(&place.image(ZOOM, SIDE)?)?;
    let what = "true heights of a simulated city at the pixel centres; no noise in the lidar";
    kernels(setup, &place, (ZOOM, SIDE), what, &truth)
}

/// The same where it is coarser.
pub(super) fn resampling_coarse(setup: &Setup<'_>) -> Result<Findings, TradeoffError> {
    let place = Place::new()?;
    let (zoom, side) = COARSE_IMAGE;
    let truth = place.means(zoom, side, setup.either(4, 16))?;
    let what = "true mean heights of a simulated city over each pixel; no noise in the lidar";
    kernels(setup, &place, COARSE_IMAGE, what, &truth)
}

fn kernels(
    setup: &Setup<'_>,
    place: &Place,
    (zoom, side): (u8, u32),
    what: &'static str,
    truth: &[f32],
) -> Result<Findings, TradeoffError> {
    let grid = place.image(zoom, side)?;
    let fine = place.image(zoom + PARTS.trailing_zeros() as u8, side * PARTS)?;
    let kinds = [Resampling::Nearest, Resampling::Bilinear, Resampling::Cubic, Resampling::Average];
    let usual = super::bench::defaults().resampling;
    let mut ways: Vec<Way<'_, Vec<f32>>> = kinds
        .into_iter()
        .map(|kind| {
            Way::new(kind.name(), kind == usual, move || {
                let pixels = exact(place, grid);
                Ok(warped(place, pixels, TransformForm::Chebyshev, kind)?.1)
            })
        })
        .collect();
    ways.push(Way::new("bilinear, 4 x 4 points a pixel", false, move || {
        let pixels = exact(place, fine);
        let (_, points) = warped(place, pixels, TransformForm::Chebyshev, Resampling::Bilinear)?;
        Ok(block_means(&points, (side * PARTS) as usize, PARTS as usize))
    }));
    let subject = Subject {
        truth: what,
        error: Quantity::new("RMS height error", "m"),
        work: format!("warp of one image of {side} x {side} px at zoom {zoom}"),
        units: 1.0,
    };
    setup.clock.measure(subject, ways, |heights| {
        Ok(Judged::new(rms(heights, truth))
            .also("median error", "m", quantile(heights, truth, 0.5))
            .also("95 % quantile", "m", quantile(heights, truth, 0.95)))
    })
}
