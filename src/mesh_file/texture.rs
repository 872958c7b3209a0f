//! Textures: PNG, and colours of single points.

use super::MeshFileError;
use sat3d_model::Image8;

fn wrong(image: &Image8, reason: impl Into<String>) -> MeshFileError {
    let Image8 { width, height, channels, .. } = *image;
    MeshFileError::Texture { width, height, channels, reason: reason.into() }
}

/// An image as PNG, without a time or anything else that changes.
///
/// # Errors
/// [`MeshFileError::Texture`] for more than four channels.
pub fn png(image: &Image8) -> Result<Vec<u8>, MeshFileError> {
    let color = match image.channels {
        1 => png::ColorType::Grayscale,
        2 => png::ColorType::GrayscaleAlpha,
        3 => png::ColorType::Rgb,
        4 => png::ColorType::Rgba,
        _ => return Err(wrong(image, "1 to 4 channels are written")),
    };
    let side = |side: usize| u32::try_from(side).map_err(|_| wrong(image, "too many pixels"));
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, side(image.width)?, side(image.height)?);
    encoder.set_color(color);
    encoder.set_depth(png::BitDepth::Eight);
    let failed = |error: png::EncodingError| wrong(image, error.to_string());
    let mut writer = encoder.write_header().map_err(failed)?;
    writer.write_image_data(&image.data).map_err(failed)?;
    writer.finish().map_err(failed)?;
    Ok(bytes)
}

/// Red, green and blue at a texture coordinate, between the four nearest pixel centres.
pub(super) fn color(image: &Image8, [u, v]: [f32; 2]) -> [u8; 3] {
    let taps = |value: f32, size: usize| {
        let at = (f64::from(value) * size as f64 - 0.5).clamp(0.0, (size - 1) as f64);
        let first = at as usize;
        (first, (first + 1).min(size - 1), at - first as f64)
    };
    let ((x0, x1, right), (y0, y1, down)) = (taps(u, image.width), taps(v, image.height));
    [0, 1, 2].map(|k| {
        // Grey stands for all three.
        let channel = if image.channels < 3 { 0 } else { k };
        let at = |x: usize, y: usize| {
            f64::from(image.data[(y * image.width + x) * image.channels + channel])
        };
        let top = at(x0, y0) * (1.0 - right) + at(x1, y0) * right;
        let bottom = at(x0, y1) * (1.0 - right) + at(x1, y1) * right;
        (top * (1.0 - down) + bottom * down).round() as u8
    })
}
