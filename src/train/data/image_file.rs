//! Image files of a data set, as the reference's loader reads them.

use super::SkipReason;
use crate::model::Image8;
use image::DynamicImage;
use std::path::Path;

/// Decodes a file; a missing one is told from a broken one.
pub(super) fn open(path: &Path, what: &'static str) -> Result<DynamicImage, SkipReason> {
    let unreadable = |cause: String| SkipReason::Unreadable { what, path: path.to_owned(), cause };
    let bytes = std::fs::read(path).map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound => SkipReason::Missing { what, path: path.to_owned() },
        _ => unreadable(error.to_string()),
    })?;
    // By its first bytes: images are renamed more often than converted.
    let format =
        image::guess_format(&bytes).map_err(|_| unreadable("neither PNG nor JPEG".to_owned()))?;
    image::load_from_memory_with_format(&bytes, format)
        .map_err(|error| unreadable(error.to_string()))
}

/// RGB, alpha dropped.
pub(super) fn rgb(image: DynamicImage) -> Image8 {
    let (width, height) = (image.width() as usize, image.height() as usize);
    Image8 { width, height, channels: 3, data: image.into_rgb8().into_raw() }
}

/// RGB bytes to grey as Pillow's `convert("L")` makes it: the weights of ITU-R 601 in 16 bits.
#[must_use]
pub fn pillow_grey(rgb: &[u8]) -> Vec<u8> {
    let grey = |&[r, g, b]: &[u8; 3]| {
        let [r, g, b] = [r, g, b].map(u32::from);
        ((r * 19_595 + g * 38_470 + b * 7_471 + 0x8000) >> 16) as u8
    };
    rgb.as_chunks::<3>().0.iter().map(grey).collect()
}

/// One channel, as Pillow's `convert("L")`.
pub(super) fn grey(image: DynamicImage) -> Image8 {
    let (width, height) = (image.width() as usize, image.height() as usize);
    let data = if image.color().has_color() {
        pillow_grey(&image.into_rgb8())
    } else {
        image.into_luma8().into_raw()
    };
    Image8 { width, height, channels: 1, data }
}
