//! Meshes as files that others open: binary glTF, PLY, OBJ.

use crate::grid::LonLat;
use serde::{Deserialize, Serialize};
use std::str::FromStr;

/// A mesh file's kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MeshFormat {
    /// Binary glTF 2.0.
    Glb,
    /// Binary little-endian PLY.
    Ply,
    /// Wavefront OBJ.
    Obj,
}

impl MeshFormat {
    /// The file name's ending, without the dot.
    #[must_use]
    pub const fn extension(self) -> &'static str {
        match self {
            Self::Glb => "glb",
            Self::Ply => "ply",
            Self::Obj => "obj",
        }
    }
}

impl FromStr for MeshFormat {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        [Self::Glb, Self::Ply, Self::Obj]
            .into_iter()
            .find(|format| text.eq_ignore_ascii_case(format.extension()))
            .ok_or_else(|| format!("`{text}` is no mesh format; glb, ply and obj are written"))
    }
}

/// Where the mesh's origin lies on Earth.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MeshGeoreference {
    /// The point that the mesh's origin stands on (WGS 84).
    pub origin: LonLat,
    /// Metres of the mesh per metre of height by the scene's true proportion (0.8 for the paper's scale).
    pub vertical_exaggeration: f64,
}

/// A file to be written: its name, and its bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NamedBytes {
    /// File name, without folders.
    pub name: String,
    /// What is in it.
    pub bytes: Vec<u8>,
}
