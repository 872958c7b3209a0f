//! Saves the closed-form city of boxes as a scene, to look at it with everything that renders scenes:
//!
//! ```text
//! cargo run -p sat3d-model --example box_city -- box_city.scene.safetensors
//! sat3d infer box_city.scene.safetensors --satellite --panorama --perspective --mesh glb --out out/
//! ```
//!
//! A tower stands in the north-east, a hall in the south, a house in the west; the ground is at z = -0.8 of the
//! cube. Colours are those of an untrained head; the sky is brightest in the south (a narrow stripe) and north.

use sat3d_model::Grid;
use sat3d_model::field::closed_form::BoxCity;
use sat3d_model::scene::{Scene, SceneParts, SkyParts};
use std::error::Error;
use std::path::Path;

fn main() -> Result<(), Box<dyn Error>> {
    let path = std::env::args().nth(1).ok_or("usage: box_city FILE.scene.safetensors")?;
    let (inputs, head) = BoxCity::example().inputs();
    // A sky that is darker towards the zenith, with a bright patch in the north.
    let (channels, side) = (head.color.outputs, 64);
    let value = |index: usize| {
        let (channel, azimuth, zenith) = (index / (side * side), index / side % side, index % side);
        let bright = 0.35 + 0.5 * zenith as f32 / side as f32;
        let north = azimuth.abs_diff(side / 4) < 3 || azimuth.abs_diff(3 * side / 4) < 1;
        if channel == 2 || north { bright.max(0.8) } else { bright }
    };
    let map = Grid::new(channels, side, side, (0..channels * side * side).map(value).collect());
    let sky = Some(SkyParts { style: vec![0.0; head.style.inputs], map });
    let scene = Scene::new(SceneParts { inputs, head, sky, metres_per_unit: 32.24 })?;
    Ok(scene.save(Path::new(&path))?)
}
