//! From the images to the feature map and the sky: preprocessing, encoder, decoder, illumination.

use super::golden::{File, Goldens, Picture};
use super::ledger::{Ledger, Stage};
use super::{ParityError, Set};
use crate::field::{FieldInputs, PointHead, Representation};
use crate::illumination::{sky_histogram, sky_histogram_eval_variant};
use crate::network::{self, Execution, Observer, Precision, StagedNetwork};
use crate::preprocess::{Image8, normalise, resize_bicubic};
use crate::tensor::Grid;
use crate::weights::point_head;
use crate::weights::rule::RuleWeights;

const PREPROCESSING: Stage = Stage::new("preprocessing", 0.0);
const ILLUMINATION: Stage = Stage::new("illumination", 0.0);
const ENCODER: Stage = Stage::new("encoder", 1e-5);
const TOKENS: Stage = Stage::new("tokens", 1e-5);
const DECODER: Stage = Stage::new("decoder", 3e-5);
const PLANES: Stage = Stage::new("planes", 3e-5);
const SKY: Stage = Stage::new("sky", 1e-4);

/// Columns and rows of a panorama whose colours are counted.
const PANORAMA: (usize, usize) = (512, 128);

/// What the network made of the images: all that is rendered from.
pub(super) struct Made {
    pub network: Box<dyn StagedNetwork>,
    pub inputs: FieldInputs,
    pub head: PointHead,
    /// The style code.
    pub style: Vec<f32>,
    /// The sky map with its empty columns.
    pub sky: Grid,
}

pub(super) fn compare(
    set: Set,
    execution: &Execution,
    goldens: &Goldens,
    ledger: &mut Ledger<'_>,
) -> Result<Made, ParityError> {
    let common = goldens.file(set, "common")?;
    let image = preprocessing(&common, ledger)?;
    let histogram = illumination(&common, ledger)?;
    let config = set.config()?;
    let weights = RuleWeights::new(&config, set.overrides());
    let head = point_head(&config, &weights)?;
    let network = execution.network(config.clone(), Box::new(weights))?;
    let held = |stage| held(stage, execution.precision);

    // The tri-plane's encoder and sky are those of the tiny network and were not saved again.
    let own = set != Set::TinyTriplane;
    let tokens = watch(
        if own { Some(goldens.file(set, "01_encoder")?) } else { None },
        held(ENCODER),
        ledger,
        |observer| network.tokens(&image, observer),
    )?;
    let file = goldens.file(set, "02_decoder")?;
    let map =
        watch(Some(file), held(DECODER), ledger, |observer| network.decode(&tokens, observer))?;
    let file = goldens.file(set, "02_decoder")?;
    if config.representation == Representation::Triplane {
        ledger.compare(held(PLANES), &file, "triplane", &map.data)?;
    } else {
        planes(held(PLANES), &file, &map, config.plane_channels, ledger)?;
    }

    let style = network.style(&histogram)?;
    let file = if own { Some(goldens.file(set, "05_sky")?) } else { None };
    if let Some(file) = &file {
        ledger.compare(SKY, file, "w_sky", &style)?;
    }
    let sky = watch(file, held(SKY), ledger, |observer| network.sky_observed(&style, observer))?;
    if own {
        ledger.compare(held(SKY), &goldens.file(set, "05_sky")?, "sky_feature_2D", &sky.data)?;
    }
    let inputs = FieldInputs {
        map,
        representation: config.representation,
        activation: config.activation,
        scale: config.scale as f32,
    };
    Ok(Made { network, inputs, head, style, sky })
}

/// What a stage is held to in a precision: its own tolerance, or the precision's bound, without a limit for single
/// values.
fn held(stage: Stage, precision: Precision) -> Stage {
    let bound = precision.bound();
    let tolerance = match precision {
        Precision::Fp32 => return stage,
        _ if stage.name == ENCODER.name => bound.tokens,
        _ => bound.planes,
    };
    Stage { tolerance, times: f64::INFINITY, ..stage }
}

/// Runs a module and compares each of its stages that the file knows.
pub(super) fn watch<T, E>(
    file: Option<File>,
    stage: Stage,
    ledger: &mut Ledger<'_>,
    run: impl FnOnce(Observer<'_>) -> Result<T, E>,
) -> Result<T, ParityError>
where
    ParityError: From<E>,
{
    let Some(file) = file else { return Ok(run(None)?) };
    let mut failed = None;
    let mut look = |seen: network::Stage| {
        if failed.is_some() {
            return;
        }
        let last = seen.name == "last_hidden_state";
        let stage = if last { Stage { name: TOKENS.name, ..stage } } else { stage };
        let looked = file.has(&seen.name).and_then(|known| match known {
            true => ledger.compare_stage(stage, &file, &seen),
            false => Ok(()),
        });
        failed = looked.err();
    };
    let result = run(Some(&mut look))?;
    match failed {
        Some(error) => Err(error),
        None => Ok(result),
    }
}

/// The resized image is Pillow's bit for bit; then the normalised one.
fn preprocessing(common: &File, ledger: &mut Ledger<'_>) -> Result<Grid, ParityError> {
    let wanted = Picture::SatelliteResized.load()?;
    let resized = resize_bicubic(&Picture::Satellite.load()?, wanted.width, wanted.height);
    let bytes = |image: &Image8| image.data.iter().map(|v| f64::from(*v)).collect::<Vec<_>>();
    ledger.add(PREPROCESSING, "common sat_resized", &bytes(&resized), &bytes(&wanted), 0.0);
    let image = normalise(&resized)?;
    ledger.compare(PREPROCESSING, common, "x", &image.data)?;
    Ok(image)
}

/// The histogram and the evaluation's variant of it, both exact; the first is the network's input.
fn illumination(common: &File, ledger: &mut Ledger<'_>) -> Result<Vec<f32>, ParityError> {
    let panorama = Picture::Panorama.load()?;
    let histogram = sky_histogram(&panorama.data, &Picture::SkyMaskNearest.load()?.data)?;
    let mask = resize_bicubic(&Picture::SkyMask.load()?, PANORAMA.0, PANORAMA.1);
    let variant = sky_histogram_eval_variant(&panorama.data, &mask.data)?;
    for (key, ours) in [("z_ill", &histogram), ("z_ill_eval_variant", &variant)] {
        let ours: Vec<f64> = ours.iter().map(|value| f64::from(*value)).collect();
        ledger.compare_within(ILLUMINATION, common, key, &ours, 0.0)?;
    }
    Ok(histogram)
}

/// The plane, every eighth texel of it, and the line: the mean over rows of the map's second half.
fn planes(
    stage: Stage,
    file: &File,
    map: &Grid,
    channels: usize,
    ledger: &mut Ledger<'_>,
) -> Result<(), ParityError> {
    let (plane, rest) = map.data.split_at(channels * map.height * map.width);
    ledger.compare(stage, file, "plane", plane)?;
    let eighths = |row: &[f32]| row.iter().copied().step_by(8).collect::<Vec<_>>();
    let every: Vec<f32> = plane.chunks(map.width).step_by(8).flat_map(eighths).collect();
    ledger.compare(stage, file, "plane_stride8", &every)?;
    let mut line = Vec::new();
    for channel in rest.chunks(map.height * map.width) {
        for column in 0..map.width {
            let rows = channel.iter().skip(column).step_by(map.width);
            line.push((rows.map(|v| f64::from(*v)).sum::<f64>() / map.height as f64) as f32);
        }
    }
    ledger.compare(stage, file, "line", &line)
}
