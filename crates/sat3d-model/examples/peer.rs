//! Times each stage from image to outputs, one line of JSON per stage, for `benches/peers/infer.sh`:
//!
//! ```text
//! RAYON_NUM_THREADS=2 cargo run --release -p sat3d-model --example peer -- CHECKPOINT IMAGE.png [ROUNDS [ENGINE PRECISION [network]]]
//! ```
//!
//! The median of the rounds; every stage is warm but for the first round of the network, which reads weights.

use sat3d_model::network::{Engine, Execution, Precision};
use sat3d_model::render::{
    Angles, Border, Camera, Pose, ReferenceGrid, RenderOptions, SkyMap, Wanted, dsm,
    reference_grid, render,
};
use sat3d_model::weights::point_head;
use sat3d_model::{Checkpoint, Device, Image8, field, preprocess};
use std::error::Error;
use std::path::Path;
use std::time::Instant;

fn timed<T>(
    name: &str,
    rounds: usize,
    mut run: impl FnMut() -> Result<T, Box<dyn Error>>,
) -> Result<T, Box<dyn Error>> {
    let mut seconds = Vec::new();
    let mut last = None;
    for _ in 0..rounds.max(1) {
        let start = Instant::now();
        last = Some(run()?);
        seconds.push(start.elapsed().as_secs_f64());
    }
    let all = seconds.clone();
    seconds.sort_unstable_by(f64::total_cmp);
    let median = seconds[seconds.len() / 2];
    println!("{{\"stage\": \"{name}\", \"seconds\": {median}, \"all\": {all:?}}}");
    last.ok_or_else(|| "no round was run".into())
}

fn read(path: &Path) -> Result<Image8, Box<dyn Error>> {
    let mut decoder = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(path)?));
    decoder.set_transformations(png::Transformations::EXPAND | png::Transformations::STRIP_16);
    let mut reader = decoder.read_info()?;
    let size = reader.output_buffer_size().ok_or("the image is too large")?;
    let mut pixels = vec![0; size];
    let info = reader.next_frame(&mut pixels)?;
    pixels.truncate(info.buffer_size());
    let samples = info.color_type.samples();
    let rgb = pixels
        .chunks_exact(samples)
        .flat_map(|p| if samples < 3 { [p[0]; 3] } else { [p[0], p[1], p[2]] });
    Ok(Image8::new(info.width as usize, info.height as usize, 3, rgb.collect())?)
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [folder, image, rest @ ..] = arguments.as_slice() else {
        return Err("usage: peer CHECKPOINT IMAGE.png [ROUNDS [ENGINE PRECISION [network]]]".into());
    };
    let rounds = rest.first().map_or(Ok(3), |text| text.parse())?;
    let checkpoint = Checkpoint::open(Path::new(folder))?;
    let config = checkpoint.config().clone();
    let head = point_head(&config, &checkpoint)?;
    let (engine, precision): (Engine, Precision) = match &rest[rest.len().min(1)..] {
        [engine, precision, ..] => (engine.parse()?, precision.parse()?),
        _ => Default::default(),
    };
    let execution = Execution { device: Device::Cpu, engine, precision };
    let network = execution.network(config.clone(), Box::new(checkpoint))?;
    let image = preprocess::satellite(&read(Path::new(image))?, config.image_side())?;
    let histogram = vec![1.0 / 90.0; 270];
    let tokens = timed("encoder", rounds, || Ok(network.tokens(&image, None)?))?;
    let map = timed("decoder", rounds, || Ok(network.decode(&tokens, None)?))?;
    let inputs = field::FieldInputs {
        map,
        representation: config.representation,
        activation: config.activation,
        scale: config.scale as f32,
    };
    let options = RenderOptions::default();
    let plain = timed("fold", rounds, || Ok(field::Field::new(&inputs, &head, None)?))?;
    timed("dsm", rounds, || Ok(dsm(&plain, 256, &options)))?;
    if rest.len() > 3 {
        return peak_memory();
    }
    let (style, sky) = timed("sky", rounds, || {
        let style = network.style(&histogram)?;
        let sky = network.sky(&style)?;
        Ok((style, sky))
    })?;
    let lit = plain.with_style(&head, Some(&style))?;
    let sky = SkyMap::from_padded(&sky);
    let color = Wanted { color: true, normals: false };
    let position = [-0.25, -0.3, -0.85];
    let pose = Pose::on_crop(position, Angles { roll: 0.0, pitch: 10.0, yaw: 35.0 }, config.scale);
    let views = [
        ("panorama", Camera::panorama(position, config.scale)),
        ("perspective", Camera::perspective(pose)),
    ];
    for (name, camera) in views {
        let view = timed(&format!("{name}, rays only"), rounds, || {
            Ok(render(&lit, Some(&sky), &camera, &options, color))
        })?;
        let composite = view.composite.ok_or("a view without colours")?;
        timed(&format!("{name}, super-resolution only"), rounds, || {
            Ok(network.super_resolve(&composite)?)
        })?;
    }
    let grid = ReferenceGrid { count: 320, border: Border::Zero };
    timed("grid 320", rounds, || Ok(reference_grid(&plain, &grid)))?;
    peak_memory()
}

fn peak_memory() -> Result<(), Box<dyn Error>> {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    if let Some(kib) = status.lines().find_map(|line| line.strip_prefix("VmHWM:")) {
        let kib: f64 = kib.trim().trim_end_matches(" kB").parse()?;
        println!("{{\"stage\": \"peak memory\", \"gib\": {}}}", kib / 1024.0 / 1024.0);
    }
    Ok(())
}
