//! Inference: samples along a ray, importance sampling, size of the DSM.

use super::clock::{Findings, Judged, Subject, Way};
use super::report::Quantity;
use super::truth::{quantile, rms};
use super::{Setup, TradeoffError};
use crate::footprint::TRAINING_WIDTH_M;
use crate::model::field::Field;
use crate::model::field::closed_form::{BoxCity, Building};
use crate::model::render::{
    DepthKind, RenderOptions, SampleCountError, SampleCounts, Sampling, dsm, exact_scale,
};
use crate::model::{Device, Image8, Model};
use crate::scene::random::{Kind, RandomScenes};
use rayon::prelude::*;

pub(super) const SAMPLES: &str = "density varies along a ray";
pub(super) const WALLS: &str = "walls and roofs are sharp";
pub(super) const IMPORTANCE: &str = "light ends within a small part of a ray";
pub(super) const SIZE: &str = "heights vary within a pixel";

/// Cells of the slow march.
const TRUTH_CELLS: usize = 4096;
/// Metres of one unit of a DSM's heights.
const UNIT_M: f64 = TRAINING_WIDTH_M;
/// Opacity under which a ray has no height.
const LEAST_OPACITY: f64 = 0.05;

/// The trained field of one simulated image.
pub(super) fn trained(setup: &Setup<'_>) -> Result<Field, TradeoffError> {
    let model = Model::of_checkpoint(
        &crate::weights::find(setup.weights.as_deref())?.open()?,
        &Device::Cpu.into(),
    )?;
    let image = downtown(model.config.image_side())?;
    Ok(Field::new(&model.field_inputs(&image)?, &model.head, None)?)
}

/// A simulated image with tall buildings: the first of its kind.
pub(super) fn downtown(side: usize) -> Result<Image8, TradeoffError> {
    let scenes = RandomScenes { seed: 23 };
    let index = (0..1000).find(|index| scenes.kind(*index) == Kind::Downtown).unwrap_or(0);
    let sample = scenes.sample(index, side, TRAINING_WIDTH_M)?;
    Ok(Image8::new(side, side, 3, sample.rgb)?)
}

/// Buildings whose walls keep to no raster: they cut through pixels of every size.
fn crooked() -> BoxCity {
    let building = |x, y, roof| Building { x, y, roof };
    BoxCity {
        buildings: vec![
            building([0.337, 0.611], [-0.617, -0.343], 0.3),
            building([-0.213, 0.459], [0.387, 0.653], -0.35),
            building([-0.661, -0.391], [-0.311, 0.103], -0.55),
            building([-0.109, 0.071], [-0.547, -0.229], -0.1),
            building([-0.577, -0.463], [0.311, 0.719], -0.42),
        ],
        ..BoxCity::example()
    }
}

fn boxes() -> Result<(BoxCity, Field), TradeoffError> {
    let city = crooked();
    let (inputs, head) = city.inputs();
    let field = Field::new(&inputs, &head, None)?;
    Ok((city, field))
}

/// Crop coordinates of pixel centres.
pub(super) fn centres(size: usize, scale: f64) -> impl Iterator<Item = f32> + Clone {
    (0..size).map(move |k| (((2 * k + 1) as f64 / size as f64 - 1.0) * scale) as f32)
}

/// Heights in metres by a slow march in `f64`: [`TRUTH_CELLS`] cells of constant density, exact transmittance,
/// expected distance over opacity; NaN where a ray has no height.
pub(super) fn slow_heights(field: &Field, size: usize) -> Vec<f32> {
    let scale = exact_scale(field.scale());
    let width = 2.0 / TRUTH_CELLS as f64;
    let centre = |k: usize| 1.0 - (k as f64 + 0.5) * width;
    let pixels: Vec<[f32; 2]> =
        centres(size, scale).flat_map(|y| centres(size, scale).map(move |x| [x, y])).collect();
    pixels
        .par_iter()
        .map(|&[x, y]| {
            let points: Vec<[f32; 3]> =
                (0..TRUTH_CELLS).map(|k| [x, y, centre(k) as f32]).collect();
            let (mut depth, mut opacity, mut height) = (0.0_f64, 0.0_f64, 0.0_f64);
            for (k, density) in field.densities(&points).into_iter().enumerate() {
                let tau = f64::from(density) * width;
                let weight = libm::exp(-depth) * -libm::expm1(-tau);
                opacity += weight;
                height += weight * (centre(k) + 1.0) / 2.0;
                depth += tau;
            }
            if opacity < LEAST_OPACITY { f32::NAN } else { (height / opacity * UNIT_M) as f32 }
        })
        .collect()
}

fn metres(field: &Field, size: usize, options: &RenderOptions) -> Vec<f32> {
    let heights = dsm(field, size, options).height;
    heights.into_iter().map(|height| (f64::from(height) * UNIT_M) as f32).collect()
}

fn counts(coarse: usize, fine: usize) -> Result<SampleCounts, TradeoffError> {
    let wrong = |error: SampleCountError| TradeoffError::Input(error.to_string());
    SampleCounts::new(coarse, fine).map_err(wrong)
}

fn ways<'a>(
    field: &'a Field,
    size: usize,
    parts: &[[usize; 2]],
) -> Result<Vec<Way<'a, Vec<f32>>>, TradeoffError> {
    let mut ways = Vec::new();
    for (name, sampling) in [("reference", Sampling::Reference), ("stable", Sampling::Stable)] {
        for &[coarse, fine] in parts {
            let samples = counts(coarse, fine)?;
            let options = RenderOptions { sampling, samples, ..RenderOptions::default() };
            let way = Way::new(
                format!("{name} {coarse} + {fine}"),
                options == RenderOptions::default(),
                move || Ok(metres(field, size, &options)),
            );
            ways.push(way);
        }
    }
    let options = RenderOptions { depth: DepthKind::Normalised, ..RenderOptions::default() };
    ways.push(Way::new("reference 48 + 48, normalised depth", false, move || {
        Ok(metres(field, size, &options))
    }));
    Ok(ways)
}

fn judged(heights: &[f32], truth: &[f32]) -> Judged {
    Judged::new(rms(heights, truth)).also("median error", "m", quantile(heights, truth, 0.5)).also(
        "largest error",
        "m",
        quantile(heights, truth, 1.0),
    )
}

const EVEN: [[usize; 2]; 7] =
    [[8, 8], [16, 16], [32, 32], [48, 48], [64, 64], [128, 128], [512, 512]];

fn subject(size: usize, units: f64) -> Subject {
    Subject {
        truth: "a march of 4096 cells in f64 through the same field",
        error: Quantity::new("RMS height error", "m"),
        work: format!("one DSM of {size} x {size} px"),
        units,
    }
}

/// How many samples a ray has, through the field of a network.
pub(super) fn samples_of_network(setup: &Setup<'_>) -> Result<Findings, TradeoffError> {
    let field = trained(setup)?;
    samples(setup, &field)
}

/// The same through a city of boxes.
pub(super) fn samples_of_boxes(setup: &Setup<'_>) -> Result<Findings, TradeoffError> {
    let (_, field) = boxes()?;
    samples(setup, &field)
}

fn samples(setup: &Setup<'_>, field: &Field) -> Result<Findings, TradeoffError> {
    let size = setup.either(48, 256);
    let truth = slow_heights(field, size);
    let ways = ways(field, size, if setup.quick { &EVEN[..6] } else { &EVEN })?;
    setup.clock.measure(subject(size, 1.0), ways, |heights| Ok(judged(heights, &truth)))
}

/// How 96 samples are shared between the whole ray and the part where the light ends.
pub(super) fn importance(setup: &Setup<'_>) -> Result<Findings, TradeoffError> {
    let field = trained(setup)?;
    let size = setup.either(48, 256);
    let truth = slow_heights(&field, size);
    let parts = [[88, 8], [72, 24], [48, 48], [24, 72], [8, 88]];
    let ways = ways(&field, size, &parts)?;
    setup.clock.measure(subject(size, 1.0), ways, |heights| Ok(judged(heights, &truth)))
}

/// How many pixels a DSM has.
pub(super) fn size(setup: &Setup<'_>) -> Result<Findings, TradeoffError> {
    const FINE: usize = 1024;
    let (city, field) = boxes()?;
    let scale = exact_scale(field.scale());
    let truth: Vec<f32> = centres(FINE, scale)
        .flat_map(|y| {
            let city = &city;
            centres(FINE, scale)
                .map(move |x| ((f64::from(city.surface(x, y)) + 1.0) / 2.0 * UNIT_M) as f32)
        })
        .collect();
    let field = &field;
    let sizes: &[usize] = if setup.quick { &[64, 128, 256] } else { &[64, 128, 256, 512] };
    let ways = sizes
        .iter()
        .map(|&size| {
            Way::new(format!("{size} px"), size == 256, move || {
                Ok((size, metres(field, size, &RenderOptions::default())))
            })
        })
        .collect();
    let subject = Subject {
        truth: "the closed-form surface of a city of boxes at 1024 x 1024 points, each compared with the pixel \
                that it lies in",
        error: Quantity::new("RMS height error", "m"),
        work: "one DSM".into(),
        units: 1.0,
    };
    setup.clock.measure(subject, ways, |(size, heights): &(usize, Vec<f32>)| {
        let times = FINE / size;
        let nearest: Vec<f32> =
            (0..FINE * FINE).map(|k| heights[k / FINE / times * size + k % FINE / times]).collect();
        Ok(judged(&nearest, &truth))
    })
}
