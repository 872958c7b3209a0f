//! A panorama and its sky mask as the network's training saw them.

use super::IlluminationError;
use crate::model::Image8;
use crate::model::illumination::sky_histogram;
use crate::model::preprocess::resize_bicubic;
use image::DynamicImage;
use std::path::Path;

/// Columns of the resized panorama.
pub(super) const WIDTH: usize = 512;
/// Rows of the resized panorama.
pub(super) const HEIGHT: usize = 128;

pub(super) fn histogram(panorama: &Path, mask: &Path) -> Result<Vec<f32>, IlluminationError> {
    let image = open(panorama)?.to_rgb8();
    let (width, height) = (image.width() as usize, image.height() as usize);
    let image = Image8 { width, height, channels: 3, data: image.into_raw() };
    let image = resize_bicubic(&image, WIDTH, HEIGHT);
    let mask = nearest(&luminance(&open(mask)?));
    // Both have the same size, which is all that can be wrong.
    Ok(sky_histogram(&image.data, &mask).unwrap_or_default())
}

fn open(path: &Path) -> Result<DynamicImage, IlluminationError> {
    let fail = |source| IlluminationError::Image { path: path.to_owned(), source };
    let reader = image::ImageReader::open(path).map_err(|error| fail(error.into()))?;
    // By its first bytes: panoramas are renamed more often than converted.
    reader.with_guessed_format().map_err(|error| fail(error.into()))?.decode().map_err(fail)
}

/// A mask as Pillow's `convert("L")` makes it: grey as it is, colours by the weights of ITU-R 601 in 16 bits.
pub(super) fn luminance(mask: &DynamicImage) -> Image8 {
    let (width, height) = (mask.width() as usize, mask.height() as usize);
    let data = if mask.color().has_color() {
        let grey = |&[r, g, b]: &[u8; 3]| {
            let [r, g, b] = [r, g, b].map(u32::from);
            ((r * 19_595 + g * 38_470 + b * 7_471 + 0x8000) >> 16) as u8
        };
        mask.to_rgb8().as_raw().as_chunks::<3>().0.iter().map(grey).collect()
    } else {
        mask.to_luma8().into_raw()
    };
    Image8 { width, height, channels: 1, data }
}

/// Pillow's `resize((512, 128), NEAREST)`.
fn nearest(mask: &Image8) -> Vec<u8> {
    let columns = nearest_indices(mask.width, WIDTH);
    let mut out = Vec::with_capacity(WIDTH * HEIGHT);
    for row in nearest_indices(mask.height, HEIGHT) {
        out.extend(columns.iter().map(|column| mask.data[row * mask.width + column]));
    }
    out
}

/// The pixel that each target pixel takes. Pillow adds up the step, so that its rounding errors do too.
pub(super) fn nearest_indices(source: usize, target: usize) -> Vec<usize> {
    let step = source as f64 / target as f64;
    let mut at = step * 0.5;
    (0..target)
        .map(|_| {
            let index = (at as usize).min(source.saturating_sub(1));
            at += step;
            index
        })
        .collect()
}
