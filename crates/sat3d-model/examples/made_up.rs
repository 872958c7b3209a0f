//! Writes a checkpoint folder with made-up weights, the ones that the parity data was computed with:
//!
//! ```text
//! cargo run --release -p sat3d-model --example made_up -- tiny|full FOLDER
//! ```
//!
//! `full` is the released network: 1.5 GB.

use sat3d_model::config::RELEASED;
use sat3d_model::weights::rule::{full_overrides, tiny_overrides, write_checkpoint};
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [size, folder] = arguments.as_slice() else {
        return Err("usage: made_up tiny|full FOLDER".into());
    };
    let (config, overrides) = match size.as_str() {
        "tiny" => (include_str!("../fixtures/tiny/model/config.json"), tiny_overrides()),
        "full" => (RELEASED, full_overrides()),
        other => return Err(format!("{other}: tiny or full").into()),
    };
    write_checkpoint(Path::new(folder), config, overrides)?;
    Ok(())
}
