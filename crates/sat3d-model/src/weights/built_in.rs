//! Models that are part of the program, so that it works where nothing was downloaded.

use std::path::Path;

/// A model inside the program.
#[derive(Clone, Copy, Debug)]
pub struct BuiltIn {
    /// Its name.
    pub name: &'static str,
    /// Text of `config.json`.
    pub config: &'static str,
    /// The weights' file.
    pub weights: &'static [u8],
    /// The model card: data, recipe, numbers, limits.
    pub card: &'static str,
}

impl BuiltIn {
    /// How it is named where a folder could stand: `built-in:mini`.
    #[must_use]
    pub fn place(&self) -> String {
        format!("{PREFIX}{}", self.name)
    }

    /// The model that a place of [`BuiltIn::place`] names.
    #[must_use]
    pub fn named(place: &str) -> Option<&'static Self> {
        let name = place.strip_prefix(PREFIX)?;
        ALL.into_iter().find(|model| model.name == name)
    }

    /// The same, where a folder could stand.
    #[must_use]
    pub fn at(place: &Path) -> Option<&'static Self> {
        place.to_str().and_then(Self::named)
    }
}

const PREFIX: &str = "built-in:";

/// The small model, trained on the heights of simulated cities.
pub static MINI: BuiltIn = BuiltIn {
    name: "mini",
    config: include_str!("../../models/mini/config.json"),
    weights: include_bytes!("../../models/mini/diffusion_pytorch_model.safetensors"),
    card: include_str!("../../models/mini/README.md"),
};

/// All of them.
const ALL: [&BuiltIn; 1] = [&MINI];
