//! Meshes as files that others open: binary glTF, PLY, OBJ.
//!
//! | | glb | ply | obj |
//! |---|---|---|---|
//! | axes of an east-north-up mesh | y up (x east, y up, z south), as glTF demands | z up | z up |
//! | axes of a reference mesh | as they are: y is up | as they are | as they are |
//! | colours | `COLOR_0`, linear, 16 bits | `red green blue`, 8 bits | `v x y z r g b` |
//! | texture | inside, PNG | its colours at the vertices | `.mtl` and `.png` beside it |
//! | place on Earth | `extras` of the scene | comments | comments |
//!
//! The writers stream: they hold nothing of the mesh's size, but for normals of a mesh without colours in a glb.

pub(crate) mod container;
mod glb;
mod obj;
mod ply;
mod texture;

pub use glb::write_glb;
pub use obj::{write_material, write_obj};
pub use ply::write_ply;
pub use texture::png as texture_png;

use crate::grid::LonLat;
use sat3d_model::Image8;
use sat3d_model::mesh::{Mesh, MeshFrame};
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

/// Why a mesh is not written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MeshFileError {
    /// There is no triangle, and glTF knows no empty mesh.
    #[error("the mesh is empty: no density reaches the isovalue; try a lower one")]
    Empty,
    /// A list is not as long as the vertices, or an index points behind them, or a value is not finite.
    #[error("a mesh of {vertices} vertices with {found}")]
    Content {
        /// Number of vertices.
        vertices: usize,
        /// What does not fit.
        found: String,
    },
    /// More than the format can state.
    #[error(
        "{found} {what}, and a {format} holds at most {most}: use a coarser lattice, or {instead}"
    )]
    TooLarge {
        /// The format's extension.
        format: &'static str,
        /// What there is too much of.
        what: &'static str,
        /// How much there is.
        found: u64,
        /// How much there may be.
        most: u64,
        /// Another way.
        instead: &'static str,
    },
    /// The mesh has texture coordinates, and no image was given.
    #[error("a mesh with texture coordinates needs its image")]
    NoTexture,
    /// The image is none that PNG holds.
    #[error("a texture of {width} x {height} pixels, {channels} channels: {reason}")]
    Texture {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// Channels per pixel.
        channels: usize,
        /// What is wrong.
        reason: String,
    },
    /// A file name that is none.
    #[error("`{0}` is no file name without folders")]
    Stem(String),
    /// A coordinate of the georeference is not finite.
    #[error("a georeference with the value {0}")]
    Georeference(f64),
    /// Writing failed.
    #[error(transparent)]
    Io(#[from] std::io::Error),
}

/// A mesh as the files of one format: `<stem>.<extension>`, and for an OBJ with a texture `<stem>.mtl` and
/// `<stem>.png` beside it (white space in these two names becomes `_`, since OBJ ends names there). The
/// same mesh gives the same bytes.
///
/// A texture is used where the mesh has texture coordinates, and left out otherwise.
///
/// # Errors
/// [`MeshFileError`]: an empty mesh, one that is not consistent, one over the format's limits (32-bit indices; 4 GiB
/// for glb), texture coordinates without an image, a stem with folders in it.
pub fn encode(
    mesh: &Mesh,
    format: MeshFormat,
    stem: &str,
    georeference: Option<&MeshGeoreference>,
    texture: Option<&Image8>,
) -> Result<Vec<NamedBytes>, MeshFileError> {
    let no_name = |c: char| matches!(c, '/' | '\\') || c.is_control();
    if stem.is_empty() || stem.contains(no_name) {
        return Err(MeshFileError::Stem(stem.to_owned()));
    }
    let mut bytes = Vec::new();
    let mut files = Vec::new();
    match format {
        MeshFormat::Glb => write_glb(mesh, georeference, texture, &mut bytes)?,
        MeshFormat::Ply => write_ply(mesh, georeference, texture, &mut bytes)?,
        MeshFormat::Obj => {
            let textured = mesh.texture_coordinates.is_some();
            let [material, picture] = companions(stem);
            write_obj(mesh, georeference, textured.then_some(&*material), &mut bytes)?;
            if textured {
                let png = texture::png(texture.ok_or(MeshFileError::NoTexture)?)?;
                let mut library = Vec::new();
                write_material(&picture, &mut library)?;
                files.push(NamedBytes { name: material, bytes: library });
                files.push(NamedBytes { name: picture, bytes: png });
            }
        }
    }
    let name = format!("{stem}.{}", format.extension());
    files.insert(0, NamedBytes { name, bytes });
    Ok(files)
}

/// Names of the material and the texture that lie beside a textured OBJ.
#[must_use]
pub fn companions(stem: &str) -> [String; 2] {
    let plain: String = stem.chars().map(|c| if c.is_whitespace() { '_' } else { c }).collect();
    [format!("{plain}.mtl"), format!("{plain}.png")]
}

/// Axes and unit in words, for people who open the file.
const fn axes(frame: MeshFrame) -> &'static str {
    match frame {
        MeshFrame::EastNorthUp => "metres, x east, y north, z up",
        MeshFrame::Reference => "cube units, x south, y up, z west",
    }
}

const fn frame_name(frame: MeshFrame) -> &'static str {
    match frame {
        MeshFrame::EastNorthUp => "east-north-up",
        MeshFrame::Reference => "reference",
    }
}

/// Lines that say what the vertices are and where they lie.
fn comments(mesh: &Mesh, georeference: Option<&MeshGeoreference>) -> Vec<String> {
    let mut lines = vec![
        "generator sat3d".to_owned(),
        format!("frame {}", frame_name(mesh.frame)),
        format!("axes {}", axes(mesh.frame)),
    ];
    if let Some(MeshGeoreference { origin, vertical_exaggeration }) = georeference {
        lines.push(format!("origin_longitude_deg {}", origin.lon_deg));
        lines.push(format!("origin_latitude_deg {}", origin.lat_deg));
        lines.push("origin_crs EPSG:4326".to_owned());
        lines.push(format!("vertical_exaggeration {vertical_exaggeration}"));
    }
    lines
}

/// Refuses what no format holds, before anything is written.
fn check(mesh: &Mesh, georeference: Option<&MeshGeoreference>) -> Result<(), MeshFileError> {
    let vertices = mesh.vertices.len();
    let fail = |found: String| Err(MeshFileError::Content { vertices, found });
    if let Some(MeshGeoreference { origin, vertical_exaggeration }) = georeference {
        let values = [origin.lon_deg, origin.lat_deg, *vertical_exaggeration];
        if let Some(value) = values.into_iter().find(|value| !value.is_finite()) {
            return Err(MeshFileError::Georeference(value));
        }
    }
    if mesh.triangles.is_empty() {
        return Err(MeshFileError::Empty);
    }
    if let Some(colors) = &mesh.colors
        && colors.len() != vertices
    {
        return fail(format!("{} colours", colors.len()));
    }
    if let Some(places) = &mesh.texture_coordinates {
        if places.len() != vertices {
            return fail(format!("{} texture coordinates", places.len()));
        }
        if let Some(place) = places.iter().flatten().find(|value| !value.is_finite()) {
            return fail(format!("the texture coordinate {place}"));
        }
    }
    if let Some(value) = mesh.vertices.iter().flatten().find(|value| !value.is_finite()) {
        return fail(format!("the coordinate {value}"));
    }
    match mesh.triangles.iter().flatten().find(|index| **index as usize >= vertices) {
        Some(index) => fail(format!("a triangle of vertex {index}")),
        None => Ok(()),
    }
}

/// Items that a writer encodes before it hands them on.
const GROUP: usize = 4096;

/// Streams items as bytes, in groups.
fn put<T>(
    out: &mut impl std::io::Write,
    items: &[T],
    encode: impl Fn(&T, &mut Vec<u8>),
) -> std::io::Result<()> {
    let mut buffer = Vec::new();
    for group in items.chunks(GROUP) {
        buffer.clear();
        for item in group {
            encode(item, &mut buffer);
        }
        out.write_all(&buffer)?;
    }
    Ok(())
}
