//! Trains the small network of the parity data for a few steps, for `benches/peers/train_step.sh`: one line of
//! JSON a step, with its terms and seconds.
//!
//! ```text
//! cargo run --release -p sat3d-model --features train --example train_step -- FOLDER STEPS
//! ```
//!
//! FOLDER holds `satellite.K.png`, `panorama.K.png`, `sky.K.png` and `depth.K.png` for K of 0 and 1. Into it go what the
//! other side needs to do the same (`start.safetensors`: weights of the discriminators and the points of the
//! gravity term) and the trained checkpoint (`exported`).

use sat3d_model::train::losses::gravity::Gravity;
use sat3d_model::train::{
    Example, Learner, NamedTensor, Outcome, PaperLearner, PaperSettings, Street, ViewSettings,
};
use sat3d_model::weights::WEIGHTS_FILE;
use sat3d_model::weights::rule::{RuleWeights, tiny_overrides};
use sat3d_model::{Config, Device, Grid, Image8};
use std::collections::HashMap;
use std::error::Error;
use std::path::Path;
use std::time::Instant;

const CONFIG: &str = include_str!("../fixtures/tiny/model/config.json");

fn read(path: &Path, channels: usize) -> Result<Image8, Box<dyn Error>> {
    let mut decoder = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(path)?));
    decoder.set_transformations(png::Transformations::EXPAND | png::Transformations::STRIP_16);
    let mut reader = decoder.read_info()?;
    let mut pixels = vec![0; reader.output_buffer_size().ok_or("the image is too large")?];
    let info = reader.next_frame(&mut pixels)?;
    pixels.truncate(info.buffer_size());
    if info.color_type.samples() != channels {
        return Err(format!("{}: not {channels} channels", path.display()).into());
    }
    Ok(Image8::new(info.width as usize, info.height as usize, channels, pixels)?)
}

fn example(folder: &Path, index: usize) -> Result<Example, Box<dyn Error>> {
    let picture =
        |name: &str, channels| read(&folder.join(format!("{name}.{index}.png")), channels);
    let depth = picture("depth", 1)?;
    let values = depth.data.iter().map(|value| f32::from(*value) / 255.0).collect();
    Ok(Example {
        name: index.to_string(),
        satellite: picture("satellite", 3)?,
        truth: None,
        street: Some(Street {
            panorama: picture("panorama", 3)?,
            sky: picture("sky", 1)?,
            position: [0.2, -0.15, -0.85],
        }),
        depth: Some(Grid::new(1, depth.height, depth.width, values)),
    })
}

/// The release's recipe without chance: one window, one direction, samples in the middle; absolute errors in
/// place of the perceptual distance, whose weights not everyone has.
fn settings() -> PaperSettings {
    let mut settings = PaperSettings::release();
    for view in [
        &mut settings.weights.satellite,
        &mut settings.weights.panorama,
        &mut settings.weights.perspective,
    ] {
        (view.l1, view.perceptual) = (1.0, 0.0);
    }
    settings.weights.raw_view.perceptual = 0.0;
    settings.encoder_rescale = 1.0;
    settings.views = ViewSettings {
        ortho_grid: 64,
        ortho_window: 64,
        panorama_width: 64,
        panorama_height: 16,
        perspective: 32,
        fields_of_view: vec![105.0],
        pitch: 0.0,
        yaw: [35.0, 35.0],
        coarse_samples: 24,
        fine_samples: 24,
        jitter: false,
        antialias: false,
    };
    settings
}

fn write(path: &Path, tensors: &[NamedTensor]) -> Result<(), Box<dyn Error>> {
    let bytes: Vec<Vec<u8>> = tensors
        .iter()
        .map(|tensor| tensor.values.iter().flat_map(|value| value.to_le_bytes()).collect())
        .collect();
    let mut views = Vec::with_capacity(tensors.len());
    for (tensor, bytes) in tensors.iter().zip(&bytes) {
        let shape = tensor.shape.clone();
        let view = safetensors::tensor::TensorView::new(safetensors::Dtype::F32, shape, bytes)?;
        views.push((tensor.name.as_str(), view));
    }
    let metadata = HashMap::from([("format".to_owned(), "pt".to_owned())]);
    Ok(safetensors::serialize_to_file(views, Some(metadata), path)?)
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [folder, steps] = arguments.as_slice() else {
        return Err("usage: train_step FOLDER STEPS".into());
    };
    let (folder, steps) = (Path::new(folder), steps.parse::<u64>()?);
    let batch = [example(folder, 0)?, example(folder, 1)?];
    let source = RuleWeights::new(&Config::from_json(CONFIG)?, tiny_overrides());
    let mut learner = PaperLearner::new(CONFIG, &source, Device::Cpu, settings())?;

    let mut start = learner.state()?;
    start.retain(|tensor| {
        tensor.name.starts_with("discriminators/") || tensor.name.starts_with("power-iterations/")
    });
    let gravity = Gravity::release();
    for step in (0..steps).step_by(2) {
        let plain = burn::tensor::Device::flex();
        let pairs = gravity.pairs(batch.len(), learner.settings().seed, step, &plain);
        for (name, points) in ["lower", "upper"].into_iter().zip(pairs) {
            let shape = points.dims().to_vec();
            let values = points.into_data().iter::<f32>().collect();
            start.push(NamedTensor { name: format!("points/{step}/{name}"), shape, values });
        }
    }
    write(&folder.join("start.safetensors"), &start)?;

    for step in 0..steps {
        let begin = Instant::now();
        let outcome = learner.step(step, &batch)?;
        let seconds = begin.elapsed().as_secs_f64();
        let Outcome::Stepped(terms) = outcome else {
            return Err(format!("step {step}: {outcome:?}").into());
        };
        let terms: serde_json::Map<String, serde_json::Value> =
            terms.into_iter().map(|term| (term.name.into(), term.value.into())).collect();
        println!("{}", serde_json::json!({ "step": step, "seconds": seconds, "terms": terms }));
    }
    let exported = learner.export()?;
    let place = folder.join("exported");
    std::fs::create_dir_all(&place)?;
    std::fs::write(place.join("config.json"), exported.config)?;
    write(&place.join(WEIGHTS_FILE), &exported.model)?;
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    if let Some(kib) = status.lines().find_map(|line| line.strip_prefix("VmHWM:")) {
        let kib: f64 = kib.trim().trim_end_matches(" kB").parse()?;
        println!("{}", serde_json::json!({ "gib": kib / 1024.0 / 1024.0 }));
    }
    Ok(())
}
