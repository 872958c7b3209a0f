//! What the views of an example are held against: pictures of the views' sizes (MODEL_SPEC section 11).

use super::TrainError;
use super::example::{Example, Street};
use super::rays::{Look, ViewSettings};
use crate::illumination::sky_histogram;
use crate::preprocess::{self, Image8, resize_bicubic};
use crate::render::frames::Vector;
use crate::tensor::Grid;
use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use std::f64::consts::{PI, TAU};

/// Size of panorama and mask from which the illumination histogram is taken.
const HISTOGRAM_SIZE: [usize; 2] = [512, 128];

/// One example, as the losses need it. Pictures are `3 x height x width` in [-1, 1].
#[derive(Clone, Debug)]
pub(crate) struct Targets {
    /// The network's input, normalised.
    pub input: Grid,
    /// The whole crop.
    pub satellite: Grid,
    /// Relative depth from above, `1 x side x side` in [0, 1]; NaN where unknown.
    pub depth: Option<Grid>,
    /// What is seen from the street.
    pub street: Option<StreetTargets>,
}

/// What is seen from the street.
#[derive(Clone, Debug)]
pub(crate) struct StreetTargets {
    /// Crop position of the camera (row, column, z).
    pub position: Vector,
    /// The panorama, of the rays' size or twice that with super-resolution.
    pub panorama: Grid,
    /// Share of sky, of the rays' size.
    pub sky: Grid,
    /// The illumination histogram.
    pub histogram: Vec<f32>,
    /// Mean colour of the sky in [0, 1]; a light blue where there is none.
    pub sky_mean: [f32; 3],
    /// The direction of the perspective view.
    pub look: Look,
    /// The perspective view, of the rays' size or twice that.
    pub perspective: Grid,
}

/// Sizes that the targets are made for.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sizes<'a> {
    pub views: &'a ViewSettings,
    /// Side of the network's input.
    pub input: usize,
    /// 2 with super-resolution, else 1.
    pub enlarged: usize,
}

impl Targets {
    /// Those of an example; `look` is where its perspective view looks.
    ///
    /// # Errors
    /// [`TrainError::Example`] where a picture has another number of channels or a mask another size than its
    /// panorama.
    pub(crate) fn new(example: &Example, sizes: Sizes<'_>, look: Look) -> Result<Self, TrainError> {
        let wrong = |what: String| TrainError::Example { example: example.name.clone(), what };
        let image = &example.satellite;
        if image.channels != 3 {
            return Err(wrong(format!("a satellite image of {} channels, not 3", image.channels)));
        }
        let side = sizes.views.ortho_grid;
        let street = example.street.as_ref().map(|street| StreetTargets::new(street, sizes, look));
        Ok(Self {
            input: preprocess::satellite(image, sizes.input)?,
            satellite: signed(&resize_bicubic(image, side, side)),
            depth: example
                .depth
                .as_ref()
                .map(|depth| label(depth, side))
                .transpose()
                .map_err(wrong)?,
            street: street.transpose().map_err(wrong)?,
        })
    }
}

impl StreetTargets {
    fn new(street: &Street, sizes: Sizes<'_>, look: Look) -> Result<Self, String> {
        let Street { panorama, sky, position } = street;
        if panorama.channels != 3 || sky.channels != 1 {
            let (a, b) = (panorama.channels, sky.channels);
            return Err(format!("a panorama of {a} channels and a mask of {b}, not 3 and 1"));
        }
        if (panorama.width, panorama.height) != (sky.width, sky.height) {
            return Err(format!(
                "a panorama of {} x {} pixels and a sky mask of {} x {}",
                panorama.width, panorama.height, sky.width, sky.height
            ));
        }
        if !position.iter().all(|value| value.is_finite()) {
            return Err(format!("a camera at {position:?}"));
        }
        let Sizes { views, enlarged, .. } = sizes;
        let [width, height] = [views.panorama_width, views.panorama_height];
        let large = resize_bicubic(panorama, width * enlarged, height * enlarged);
        let mask = nearest(sky, width * enlarged, height * enlarged);
        // The release shrinks the mask a second time to the nearest pixel, which is the upper left.
        let mut shares = Vec::with_capacity(width * height);
        for row in 0..height {
            let row = &mask.data[row * enlarged * mask.width..][..mask.width];
            shares.extend(row.iter().step_by(enlarged).map(|value| f32::from(*value) / 255.0));
        }
        let [wide, high] = HISTOGRAM_SIZE;
        let histogram = sky_histogram(
            &resize_bicubic(panorama, wide, high).data,
            &nearest(sky, wide, high).data,
        );
        Ok(Self {
            position: position.map(f64::from),
            sky_mean: sky_mean(&large, &mask),
            panorama: signed(&large),
            sky: Grid::new(1, height, width, shares),
            histogram: histogram.map_err(|error| error.to_string())?,
            look,
            perspective: signed(&cut(
                panorama,
                &look,
                views.perspective * enlarged,
                views.antialias,
            )),
        })
    }
}

/// Mean colour of the sky.
fn sky_mean(panorama: &Image8, mask: &Image8) -> [f32; 3] {
    let (mut sums, mut count) = ([0.0_f64; 3], 0.0);
    for (pixel, share) in panorama.data.chunks_exact(3).zip(&mask.data) {
        let share = f64::from(*share) / 255.0;
        for (sum, value) in sums.iter_mut().zip(pixel) {
            *sum += share * f64::from(*value) / 255.0;
        }
        count += share;
    }
    if count > 0.0 { sums.map(|sum| (sum / count) as f32) } else { [0.7, 0.8, 0.9] }
}

/// Bytes to [-1, 1], channels first.
fn signed(image: &Image8) -> Grid {
    let area = image.width * image.height;
    let channels = image.channels;
    let mut data = Vec::with_capacity(channels * area);
    for channel in 0..channels {
        let values = image.data.iter().skip(channel).step_by(channels);
        data.extend(values.map(|value| f32::from(*value) / 255.0 * 2.0 - 1.0));
    }
    Grid::new(channels, image.height, image.width, data)
}

/// Pillow's resize to the nearest pixel.
fn nearest(image: &Image8, width: usize, height: usize) -> Image8 {
    let place = |index: usize, from: usize, to: usize| {
        (((index as f64 + 0.5) * from as f64 / to as f64) as usize).min(from - 1)
    };
    let mut data = Vec::with_capacity(width * height * image.channels);
    for row in 0..height {
        let row = place(row, image.height, height) * image.width;
        for column in 0..width {
            let first = (row + place(column, image.width, width)) * image.channels;
            data.extend_from_slice(&image.data[first..][..image.channels]);
        }
    }
    Image8 { width, height, channels: image.channels, data }
}

/// A depth label at another size: in bytes, as labels are stored; unknown where any unknown pixel has a
/// part in it.
fn label(depth: &Grid, side: usize) -> Result<Grid, String> {
    let Grid { channels, height, width, data } = depth;
    if *channels != 1 || *height == 0 || *width == 0 {
        return Err(format!("a depth label of {channels} x {height} x {width}"));
    }
    if (*height, *width) == (side, side) {
        return Ok(depth.clone());
    }
    let resized = |value: &dyn Fn(f32) -> u8| {
        let data = data.iter().map(|depth| value(*depth)).collect();
        let image = Image8 { width: *width, height: *height, channels: 1, data };
        resize_bicubic(&image, side, side).data
    };
    // A cast of NaN is 0.
    let values = resized(&|depth| (depth.clamp(0.0, 1.0) * 255.0).round() as u8);
    let known = if data.iter().all(|depth| depth.is_finite()) {
        vec![255; side * side]
    } else {
        resized(&|depth| if depth.is_finite() { 255 } else { 0 })
    };
    let value = |(value, known): (&u8, &u8)| {
        if *known == 255 { f32::from(*value) / 255.0 } else { f32::NAN }
    };
    Ok(Grid::new(1, side, side, values.iter().zip(&known).map(value).collect()))
}

/// The perspective view of a panorama: bicubic (a = -0.75), wrapped around at both pairs of edges, each byte
/// rounded, as the release cuts it. With `antialias` a panorama of finer pixels is shrunk first.
fn cut(panorama: &Image8, look: &Look, side: usize, antialias: bool) -> Image8 {
    let camera = look.camera(side, 1, [0.0; 3], 1.0);
    let finest = look.intrinsics(side);
    let ratio = panorama.width as f64 / TAU / finest.fx.max(finest.fy);
    let shrunk = (antialias && ratio > 1.0).then(|| {
        let part = |length: usize| ((length as f64 / ratio) as usize).max(1);
        resize_bicubic(panorama, part(panorama.width), part(panorama.height))
    });
    let panorama = shrunk.as_ref().unwrap_or(panorama);
    let (width, height) = (panorama.width, panorama.height);
    let mut data = vec![0; side * side * 3];
    data.par_chunks_mut(side * 3).enumerate().for_each(|(row, out)| {
        for (column, pixel) in out.chunks_exact_mut(3).enumerate() {
            let [x, y, z] = camera.ray(row, column, 1.0).direction;
            let right = libm::atan2(x, -y) / TAU + 0.5;
            let down = libm::asin((-z).clamp(-1.0, 1.0)) / PI + 0.5;
            let columns = taps(right * (width - 1) as f64, width);
            let rows = taps(down * (height - 1) as f64, height);
            for (channel, value) in pixel.iter_mut().enumerate() {
                let mut sum = 0.0;
                for (row, by_row) in rows {
                    for (column, by_column) in columns {
                        let source = panorama.data[(row * width + column) * 3 + channel];
                        sum += by_row * by_column * f64::from(source);
                    }
                }
                *value = sum.round().clamp(0.0, 255.0) as u8;
            }
        }
    });
    Image8 { width: side, height: side, channels: 3, data }
}

/// Four pixels around a position, wrapped, and their cubic weights.
fn taps(position: f64, length: usize) -> [(usize, f64); 4] {
    const A: f64 = -0.75;
    let below = position.floor();
    let t = position - below;
    let near = |x: f64| ((A + 2.0) * x - (A + 3.0)) * x * x + 1.0;
    let far = |x: f64| ((A * x - 5.0 * A) * x + 8.0 * A) * x - 4.0 * A;
    let weights = [far(t + 1.0), near(t), near(1.0 - t), far(2.0 - t)];
    std::array::from_fn(|tap| {
        let at = (below as i64 + tap as i64 - 1).rem_euclid(length as i64);
        (at as usize, weights[tap])
    })
}

/// Grids of one shape as a batch.
pub(crate) fn batch<'a>(grids: impl Iterator<Item = &'a Grid>, device: &Device) -> Tensor<4> {
    let parts: Vec<Tensor<4>> = grids
        .map(|grid| {
            let shape = [1, grid.channels, grid.height, grid.width];
            Tensor::from_data(TensorData::new(grid.data.clone(), shape), device)
        })
        .collect();
    Tensor::cat(parts, 0)
}

/// Half the height and width with a triangular kernel of four pixels, renormalised at the edges: PyTorch's
/// antialiased bilinear interpolation. Both sides have to be even.
pub(crate) fn halved(map: Tensor<4>) -> Tensor<4> {
    let [_, _, height, width] = map.dims();
    let device = map.device();
    let matrix = |length: usize| -> Tensor<4> {
        let half = length / 2;
        let mut values = vec![0.0_f32; length * half];
        for out in 0..half {
            let taps =
                [(2 * out).checked_sub(1), Some(2 * out), Some(2 * out + 1), Some(2 * out + 2)];
            let inside = |tap: Option<usize>| tap.filter(|tap| *tap < length);
            let of = |tap: usize| if tap == 0 || tap == 3 { 1.0 } else { 3.0 };
            let total: f64 = (0..4).filter(|k| inside(taps[*k]).is_some()).map(of).sum();
            for (k, tap) in taps.into_iter().enumerate() {
                if let Some(tap) = inside(tap) {
                    values[tap * half + out] = (of(k) / total) as f32;
                }
            }
        }
        Tensor::<2>::from_data(TensorData::new(values, [length, half]), &device).unsqueeze()
    };
    let narrow = map.matmul(matrix(width));
    narrow.swap_dims(2, 3).matmul(matrix(height)).swap_dims(2, 3)
}

#[cfg(test)]
mod tests;
