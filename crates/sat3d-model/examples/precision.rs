//! What each precision of the network costs in accuracy: its tokens, planes and DSM against direct 32-bit floats of the same
//! engine, for made-up weights of the released network and for harder ones (one channel of a hundred 20 times as large):
//!
//! ```text
//! cargo run --release -p sat3d-model --features onednn --example precision [IMAGE.png]
//! ```

use sat3d_model::field::{Field, FieldInputs};
use sat3d_model::network::{Engine, Execution, Precision};
use sat3d_model::render::{RenderOptions, dsm};
use sat3d_model::weights::point_head;
use sat3d_model::weights::rule::{RuleWeights, full_overrides};
use sat3d_model::{Config, Device, Grid, Image8, preprocess};
use std::error::Error;
use std::io::Cursor;

/// Metres per unit of a DSM's heights.
const UNIT_M: f64 = 64.48;

struct Made {
    tokens: Grid,
    map: Grid,
    heights: Vec<f32>,
}

fn main() -> Result<(), Box<dyn Error>> {
    let bytes = match std::env::args().nth(1) {
        Some(path) => std::fs::read(path)?,
        None => include_bytes!("../fixtures/sat_resized_256.png").to_vec(),
    };
    let mut reader = png::Decoder::new(Cursor::new(bytes)).read_info()?;
    let mut data = vec![0; reader.output_buffer_size().unwrap_or(0)];
    let info = reader.next_frame(&mut data)?;
    data.truncate(info.buffer_size());
    let picture = Image8::new(info.width as usize, info.height as usize, 3, data)?;
    let config = Config::released();
    let image = preprocess::satellite(&picture, config.image_side())?;
    println!("| weights | precision | tokens | planes | DSM mean, m | p95, m | largest, m |");
    println!("|---|---|---|---|---|---|---|");
    for (name, seed) in [("by rule", None), ("with outliers", Some(1)), ("with outliers", Some(2))]
    {
        let mut exact: Option<Made> = None;
        for precision in Precision::ALL {
            let execution = Execution { device: Device::Cpu, engine: Engine::OneDnn, precision };
            if let Some(why) = execution.refusal() {
                println!("{execution}: {why}");
                continue;
            }
            let weights = RuleWeights::new(&config, full_overrides());
            let weights = match seed {
                Some(seed) => weights.with_outliers(seed),
                None => weights,
            };
            let head = point_head(&config, &weights)?;
            let network = execution.network(config.clone(), Box::new(weights))?;
            let tokens = network.tokens(&image, None)?;
            let map = network.decode(&tokens, None)?;
            let inputs = FieldInputs {
                map: map.clone(),
                representation: config.representation,
                activation: config.activation,
                scale: config.scale as f32,
            };
            let surface = dsm(&Field::new(&inputs, &head, None)?, 256, &RenderOptions::default());
            let made = Made { tokens, map, heights: surface.height };
            let Some(exact) = &exact else {
                exact = Some(made);
                continue;
            };
            let mut apart: Vec<f64> = (made.heights.iter().zip(&exact.heights))
                .map(|(a, b)| UNIT_M * f64::from((a - b).abs()))
                .collect();
            apart.sort_unstable_by(f64::total_cmp);
            let mean = apart.iter().sum::<f64>() / apart.len() as f64;
            let quantile = |share: f64| apart[((apart.len() - 1) as f64 * share) as usize];
            println!(
                "| {name} {} | {precision} | {:.1e} | {:.1e} | {mean:.2e} | {:.2e} | {:.2e} |",
                seed.map_or_else(String::new, |seed| seed.to_string()),
                relative(&made.tokens, &exact.tokens),
                relative(&made.map, &exact.map),
                quantile(0.95),
                quantile(1.0),
            );
        }
    }
    Ok(())
}

/// L2 norm of the difference over that of `b`.
fn relative(a: &Grid, b: &Grid) -> f64 {
    let square = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>();
    let apart = square(&mut a.data.iter().zip(&b.data).map(|(a, b)| f64::from(a - b)));
    (apart / square(&mut b.data.iter().map(|b| f64::from(*b)))).sqrt()
}
