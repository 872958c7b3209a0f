//! What the renderer's switches change, in numbers (docs/model-switches.md):
//!
//! ```text
//! cargo run -p sat3d-model --example switches
//! ```
//!
//! Twice: a network with weights made by rule on the synthetic image, whose field is a haze of every
//! opacity, and a city of boxes in closed form, whose surfaces are hard.

use sat3d_model::config::Config;
use sat3d_model::field::closed_form::BoxCity;
use sat3d_model::field::{Field, FieldInputs, PointHead};
use sat3d_model::network::BurnNetwork;
use sat3d_model::render::{
    Angles, Camera, Composite, DepthKind, Pose, RenderOptions, SkyMap, SkySeam, View, Wanted, dsm,
    render,
};
use sat3d_model::weights::point_head;
use sat3d_model::weights::rule::{RuleWeights, tiny_overrides};
use sat3d_model::{Device, Grid, Image8, Network, preprocess};
use std::error::Error;

/// Metres of a height of 1.0: two cube units of 32.24 m, as the published scoring has it.
const METRES: f64 = 64.48;
const SIZE: usize = 256;

fn main() -> Result<(), Box<dyn Error>> {
    let (inputs, head, style, sky, network) = tiny()?;
    let plain = Field::new(&inputs, &head, None)?;
    let lit = plain.with_style(&head, Some(&style))?;
    let (city_inputs, city_head) = BoxCity::example().inputs();
    let city = Field::new(&city_inputs, &city_head, None)?;

    println!("| scene | switch | mean | rms | largest | no hit |\n|---|---|---|---|---|---|");
    for (scene, field) in [("made-up network", &plain), ("box city", &city)] {
        heights(scene, field);
    }
    println!("\n| scene | view | switch | mean | largest | pixels |\n|---|---|---|---|---|---|");
    let sky = SkyMap::from_padded(&sky);
    colors("made-up network", &lit, &sky, Some(&network))?;
    // A bright sky that knows no direction, so without a seam.
    let blue = [0.55, 0.7, 0.95].map(|value| [value; 64]).concat();
    colors("box city", &city, &SkyMap::from_decoder(&Grid::new(3, 8, 8, blue)), None)
}

type Tiny = (FieldInputs, PointHead, Vec<f32>, Grid, BurnNetwork);

fn tiny() -> Result<Tiny, Box<dyn Error>> {
    let bytes: &[u8] = include_bytes!("../fixtures/sat_resized_256.png");
    let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info()?;
    let mut data = vec![0; reader.output_buffer_size().unwrap_or(0)];
    let size = reader.next_frame(&mut data)?.buffer_size();
    data.truncate(size);
    let image = preprocess::satellite(&Image8::new(256, 256, 3, data)?, 256)?;
    let config = Config::from_json(include_str!("../fixtures/tiny/model/config.json"))?;
    let weights = RuleWeights::new(&config, tiny_overrides());
    let head = point_head(&config, &weights)?;
    let network = BurnNetwork::new(config.clone(), Box::new(weights), Device::Cpu)?;
    let inputs = FieldInputs {
        map: network.map(&image)?,
        representation: config.representation,
        activation: config.activation,
        scale: config.scale as f32,
    };
    // Every colour as often: no particular sky.
    let style = network.style(&[1.0 / 90.0; 270])?;
    let sky = network.sky(&style)?;
    Ok((inputs, head, style, sky, network))
}

/// The DSM with each switch against the default's.
fn heights(scene: &str, field: &Field) {
    let released = RenderOptions::default();
    let normalised = RenderOptions { depth: DepthKind::Normalised, ..released };
    let stable = RenderOptions::stable();
    let base = dsm(field, SIZE, &released);
    let same = dsm(field, SIZE, &normalised);
    for (switch, options, from) in [
        ("`--depth normalised` against the default", normalised, &base),
        ("`--sampling stable` against the default", stable, &base),
        ("`--sampling stable` against `--depth normalised`", stable, &same),
    ] {
        let other = dsm(field, SIZE, &options);
        let nothing = other.height.iter().filter(|height| height.is_nan()).count();
        let changes: Vec<f64> = (other.height.iter().zip(&from.height))
            .map(|(a, b)| f64::from(a - b) * METRES)
            .filter(|change| !change.is_nan())
            .collect();
        let share = 100.0 * nothing as f64 / other.height.len() as f64;
        let count = changes.len() as f64;
        let mean = changes.iter().sum::<f64>() / count;
        let rms = (changes.iter().map(|change| change * change).sum::<f64>() / count).sqrt();
        let largest = changes.iter().fold(0.0_f64, |most, change| most.max(change.abs()));
        println!(
            "| {scene} | {switch} | {mean:+.3} m | {rms:.3} m | {largest:.2} m | {share:.2} % |"
        );
    }
}

/// Street views with each switch against the default's, and their sharp images.
fn colors(
    scene: &str,
    field: &Field,
    sky: &SkyMap,
    network: Option<&BurnNetwork>,
) -> Result<(), Box<dyn Error>> {
    const POSITION: [f64; 3] = [0.25, -0.3, -0.85];
    let angles = Angles { roll: 0.0, pitch: 10.0, yaw: 35.0 };
    let views = [
        ("panorama", Camera::panorama(POSITION, 0.8)),
        ("perspective", Camera::perspective(Pose::on_crop(POSITION, angles, 0.8))),
    ];
    let wanted = Wanted { color: true, normals: false };
    let released = RenderOptions::default();
    for (name, camera) in views {
        let view = |options: &RenderOptions| render(field, Some(sky), &camera, options, wanted);
        let base = view(&released);
        for (switch, options) in [
            ("`--composite once`", RenderOptions { composite: Composite::Once, ..released }),
            ("`--sky-seam wrap`", RenderOptions { sky_seam: SkySeam::Wrap, ..released }),
            ("`--sampling stable`", RenderOptions::stable()),
        ] {
            if network.is_none() && options.sky_seam == SkySeam::Wrap {
                continue;
            }
            let other = view(&options);
            let (Some(a), Some(b)) = (composite(&base), composite(&other)) else { continue };
            change(scene, name, switch, a, b);
            if let Some(network) = network {
                let [a, b] = [network.super_resolve(a)?, network.super_resolve(b)?];
                change(scene, &format!("{name}, sharp"), switch, &a, &b);
            }
        }
    }
    Ok(())
}

fn composite(view: &View) -> Option<&Grid> {
    view.composite.as_ref()
}

/// Change of red, green and blue in steps of 1/255; pixels where one of them changes by a step or more.
fn change(scene: &str, view: &str, switch: &str, from: &Grid, to: &Grid) {
    let pixels = from.height * from.width;
    let apart = |k: usize| 255.0 * f64::from(to.data[k] - from.data[k]).abs();
    let mean = (0..3 * pixels).map(apart).sum::<f64>() / (3 * pixels) as f64;
    let largest = (0..3 * pixels).map(apart).fold(0.0, f64::max);
    let changed = (0..pixels).filter(|k| (0..3).any(|c| apart(c * pixels + k) >= 1.0)).count();
    let share = 100.0 * changed as f64 / pixels as f64;
    println!(
        "| {scene} | {view} | {switch} | {mean:.2} | {largest:.1} | {changed} ({share:.1} %) |"
    );
}
