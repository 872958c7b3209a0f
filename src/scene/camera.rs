//! What air, lens and processing make of a picture: light of the sky, haze, exposure, white balance,
//! blur, sharpening. Pictures only; no height depends on it.

use super::object::{Colour, rgb};
use super::spec::CameraSpec;

/// Grey level about which contrast turns, 0 to 1 in display values.
const PIVOT: f32 = 0.45;

/// Light that the haze scatters into the line of sight.
const HAZE: Colour = rgb(150, 160, 176);
/// Share of the haze without a `[camera]` table.
const CLEAR_HAZE: f32 = 0.025;

/// A camera as a picture needs it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Camera {
    pub sky_light: f32,
    haze: f32,
    gain: Colour,
    saturation: f32,
    contrast: f32,
    blur: f32,
    sharpening: f32,
    half_colour: bool,
}

impl Camera {
    pub fn new(spec: Option<&CameraSpec>) -> Self {
        let Some(c) = spec else {
            return Self {
                sky_light: 1.0,
                haze: CLEAR_HAZE,
                gain: [1.0; 3],
                saturation: 1.0,
                contrast: 1.0,
                blur: 0.0,
                sharpening: 0.0,
                half_colour: false,
            };
        };
        Self {
            sky_light: c.sky_light as f32,
            haze: c.haze as f32,
            gain: c.white_balance.map(|w| (w * c.exposure) as f32),
            saturation: c.saturation as f32,
            contrast: c.contrast as f32,
            blur: c.blur_pixels as f32,
            sharpening: c.sharpening as f32,
            half_colour: c.half_colour_resolution,
        }
    }

    /// A linear colour through the air and the sensor.
    pub fn expose(&self, colour: Colour) -> Colour {
        let hazy = super::ground::mix(colour, HAZE, self.haze);
        if self.gain == [1.0; 3] && self.saturation == 1.0 {
            return hazy;
        }
        let lit = [0, 1, 2].map(|i| hazy[i] * self.gain[i]);
        let grey = 0.3 * lit[0] + 0.59 * lit[1] + 0.11 * lit[2];
        lit.map(|c| grey + self.saturation * (c - grey))
    }

    /// A display value (0 to 1) with this camera's contrast.
    pub fn curve(&self, level: f32) -> f32 {
        if self.contrast == 1.0 { level } else { PIVOT + self.contrast * (level - PIVOT) }
    }

    /// What happens to a finished picture of `width` columns: colours at half resolution, blur,
    /// sharpening. Beyond the border the picture goes on as its outermost pixels.
    pub fn develop(&self, picture: &mut [u8], width: usize) {
        if width == 0 || (self.blur <= 0.0 && self.sharpening <= 0.0 && !self.half_colour) {
            return;
        }
        let height = picture.len() / 3 / width;
        let mut planes: [Vec<f32>; 3] =
            [0, 1, 2].map(|i| picture.iter().skip(i).step_by(3).map(|v| f32::from(*v)).collect());
        if self.half_colour {
            halve_colour(&mut planes, width, height);
        }
        for plane in &mut planes {
            if self.blur > 0.0 {
                *plane = gaussian(plane, width, height, self.blur);
            }
            if self.sharpening > 0.0 {
                let soft = gaussian(plane, width, height, 1.0);
                for (v, s) in plane.iter_mut().zip(soft) {
                    *v += self.sharpening * (*v - s);
                }
            }
        }
        for (i, plane) in planes.iter().enumerate() {
            for (out, v) in picture.iter_mut().skip(i).step_by(3).zip(plane) {
                *out = (v + 0.5).clamp(0.0, 255.0) as u8;
            }
        }
    }
}

/// Means of colour differences over 2 x 2 pixels, as JPEG files store them; brightness stays.
fn halve_colour(planes: &mut [Vec<f32>; 3], width: usize, height: usize) {
    for row in (0..height).step_by(2) {
        for column in (0..width).step_by(2) {
            let (mut red, mut blue, mut count) = (0.0, 0.0, 0.0);
            let cells = [(0, 0), (0, 1), (1, 0), (1, 1)]
                .map(|(j, i)| (row + j, column + i))
                .map(|(j, i)| (j < height && i < width).then_some(j * width + i));
            let grey =
                |p: &[Vec<f32>; 3], i: usize| 0.3 * p[0][i] + 0.59 * p[1][i] + 0.11 * p[2][i];
            for i in cells.into_iter().flatten() {
                let y = grey(planes, i);
                red += planes[0][i] - y;
                blue += planes[2][i] - y;
                count += 1.0;
            }
            let (red, blue) = (red / count, blue / count);
            for i in cells.into_iter().flatten() {
                let y = grey(planes, i);
                planes[0][i] = y + red;
                planes[2][i] = y + blue;
                planes[1][i] = y - (0.3 * red + 0.11 * blue) / 0.59;
            }
        }
    }
}

/// A picture blurred by a normal distribution of standard deviation `sigma`, pixels.
fn gaussian(plane: &[f32], width: usize, height: usize, sigma: f32) -> Vec<f32> {
    let reach = (2.5 * sigma).ceil() as usize;
    let mut taps: Vec<f32> =
        (0..=reach).map(|i| libm::expf(-((i * i) as f32) / (2.0 * sigma * sigma))).collect();
    let total = taps[0] + 2.0 * taps[1..].iter().sum::<f32>();
    for tap in &mut taps {
        *tap /= total;
    }
    let mut across = vec![0.0; plane.len()];
    for (line, out) in plane.chunks_exact(width).zip(across.chunks_exact_mut(width)) {
        for (x, out) in out.iter_mut().enumerate() {
            let mut sum = taps[0] * line[x];
            for (i, tap) in taps.iter().enumerate().skip(1) {
                sum += tap * (line[x.saturating_sub(i)] + line[(x + i).min(width - 1)]);
            }
            *out = sum;
        }
    }
    let mut down = vec![0.0; plane.len()];
    for y in 0..height {
        let out = &mut down[y * width..(y + 1) * width];
        for (i, tap) in taps.iter().enumerate() {
            let (above, below) = (y.saturating_sub(i) * width, (y + i).min(height - 1) * width);
            let weight = if i == 0 { 0.5 * tap } else { *tap };
            for x in 0..width {
                out[x] += weight * (across[above + x] + across[below + x]);
            }
        }
    }
    down
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture() -> Vec<u8> {
        (0..24 * 17 * 3_u64).map(|i| (crate::random::mix(i) % 256) as u8).collect()
    }

    #[test]
    fn without_a_table_a_picture_stays_as_it_was() {
        let camera = Camera::new(None);
        let mut developed = picture();
        camera.develop(&mut developed, 24);
        assert_eq!(developed, picture());
        assert_eq!(
            camera.expose([0.2, 0.4, 0.9]),
            super::super::ground::mix([0.2, 0.4, 0.9], HAZE, 0.025)
        );
        assert_eq!(camera.curve(0.3), 0.3);
    }

    #[test]
    fn blur_keeps_the_mean_and_takes_the_variance_that_its_width_says() {
        // One bright row far from the borders: its profile is the kernel.
        let mut plane = vec![0.0; 41 * 41];
        plane[20 * 41..21 * 41].fill(1.0);
        let soft = gaussian(&plane, 41, 41, 1.6);
        let column: Vec<f32> = (0..41).map(|y| soft[y * 41 + 7]).collect();
        let sum: f32 = column.iter().sum();
        let variance: f32 =
            column.iter().enumerate().map(|(y, v)| v * (y as f32 - 20.0).powi(2)).sum();
        assert!((sum - 1.0).abs() < 1e-5, "{sum}");
        // Cut at 2.5 sigma, the tails are missing.
        assert!((variance - 1.6 * 1.6).abs() < 0.25, "{variance}");
    }

    #[test]
    fn half_colour_keeps_brightness_and_greys() {
        let camera = Camera { half_colour: true, ..Camera::new(None) };
        let before = picture();
        let mut planes: [Vec<f32>; 3] =
            [0, 1, 2].map(|i| before.iter().skip(i).step_by(3).map(|v| f32::from(*v)).collect());
        let old = planes.clone();
        halve_colour(&mut planes, 24, 17);
        let grey = |p: &[Vec<f32>; 3], i: usize| 0.3 * p[0][i] + 0.59 * p[1][i] + 0.11 * p[2][i];
        assert!((0..24 * 17).all(|i| (grey(&planes, i) - grey(&old, i)).abs() < 1e-3));
        assert!(planes != old);
        let mut flat: Vec<u8> = (0..24 * 17).flat_map(|i| [(i % 200) as u8; 3]).collect();
        let same = flat.clone();
        camera.develop(&mut flat, 24);
        assert_eq!(flat, same);
    }
}
