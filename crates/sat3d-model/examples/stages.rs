//! Seconds per stage of the network, and the most memory it took:
//!
//! ```text
//! RAYON_NUM_THREADS=2 cargo run --release -p sat3d-model --example stages [CHECKPOINT [DEVICE [ENGINE PRECISION]]]
//! ```
//!
//! Without a checkpoint folder the released network runs with weights made by rule.

use sat3d_model::config::Config;
use sat3d_model::network::Execution;
use sat3d_model::weights::rule::{RuleWeights, full_overrides};
use sat3d_model::{Checkpoint, Device, Grid, ModelError};
use std::path::Path;
use std::time::Instant;

fn main() -> Result<(), ModelError> {
    let mut arguments = std::env::args().skip(1);
    let folder = arguments.next().filter(|name| name != "rule");
    let device: Device = arguments.next().as_deref().unwrap_or("cpu").parse()?;
    let mut execution = Execution::from(device);
    if let (Some(engine), Some(precision)) = (arguments.next(), arguments.next()) {
        execution = Execution { engine: engine.parse()?, precision: precision.parse()?, device };
    }
    let network = match folder {
        Some(folder) => {
            let checkpoint = Checkpoint::open(Path::new(&folder))?;
            execution.network(checkpoint.config().clone(), Box::new(checkpoint))?
        }
        None => {
            let config = Config::released();
            let weights = RuleWeights::new(&config, full_overrides());
            execution.network(config, Box::new(weights))?
        }
    };
    let config = network.config().clone();
    let side = config.image_side();
    let image = Grid::new(3, side, side, wave(3 * side * side));
    let histogram = vec![1.0 / 270.0; 270];
    let (height, width) = (64, 256);
    let rendered = Grid::new(
        config.color_channels,
        height,
        width,
        wave(config.color_channels * height * width),
    );
    // The first round reads the weights as well.
    for round in ["first", "second", "third"] {
        println!("{round} round");
        let tokens = timed("encoder", || network.tokens(&image, None))?;
        let map = timed("decoder", || network.decode(&tokens, None))?;
        let style = timed("sky mapping", || network.style(&histogram))?;
        let sky = timed("sky decoder", || network.sky(&style))?;
        if config.super_resolution == 2 {
            timed("super-resolution of 64 x 256", || network.super_resolve(&rendered))?;
        }
        // Keeps the results alive and shows that they are numbers.
        let sum: f32 = map.data.iter().chain(&sky.data).sum();
        println!("  {:32} {sum}", "(sum)");
    }
    if let Some(most) = peak_memory() {
        println!("most memory resident: {most}");
    }
    Ok(())
}

fn timed<T>(name: &str, run: impl FnOnce() -> Result<T, ModelError>) -> Result<T, ModelError> {
    let (start, busy) = (Instant::now(), processor_seconds());
    let result = run()?;
    let wall = start.elapsed().as_secs_f64();
    match (busy, processor_seconds()) {
        (Some(before), Some(after)) => {
            println!("  {name:32} {wall:7.3} s, {:7.2} s of all cores", after - before);
        }
        _ => println!("  {name:32} {wall:7.3} s"),
    }
    Ok(result)
}

/// Processor time of all threads so far, where the system says so (in ticks of 10 ms).
fn processor_seconds() -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    // The fields after the program's name, which may hold spaces: 12 and 13 are user and system.
    let mut fields = stat.rsplit_once(')')?.1.split_whitespace().skip(11);
    let mut next = || fields.next()?.parse::<f64>().ok();
    Some((next()? + next()?) / 100.0)
}

/// Values in [-1, 1] without a pattern that a layer would like.
fn wave(count: usize) -> Vec<f32> {
    (0..count).map(|index| libm::sin(index as f64 * 0.731) as f32).collect()
}

/// What the system calls the peak of this process, where it says so.
fn peak_memory() -> Option<String> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    Some(line.trim().to_owned())
}
