//! Cameras out of files: NeRF's `transforms.json` and COLMAP's model folders.
//!
//! Their world is east, north and up in metres ([`super::World`]). Inside this module every camera has
//! the axes x right, y down, z forward and a rotation from those to the world.

mod colmap;
mod nerf;

use super::lens::{Lens, Optics};
use crate::model::render::Intrinsics;
use crate::model::render::frames::{Matrix, Vector};
use crate::plan::hex;
use serde::Serialize;
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};

/// One camera of a file.
#[derive(Clone, Debug, PartialEq)]
pub struct FileCamera {
    /// Name of its picture: the file's own, made fit for a file name.
    pub name: String,
    /// Size and intrinsics of the picture.
    pub optics: Optics,
    /// East, north, up in metres.
    pub position: Vector,
    /// From the camera's axes (right, down, forward) to east, north, up.
    pub rotation: Matrix,
}

/// The cameras of a file or folder. Only its name, digest and count go into a plan.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CameraFile {
    /// Name of the file or folder, without the folders above it.
    pub name: String,
    /// SHA-256 of what was read.
    pub sha256: String,
    /// How many cameras there are.
    pub count: usize,
    /// The cameras, in the order of the file.
    #[serde(skip)]
    pub cameras: Vec<FileCamera>,
}

/// Why cameras cannot be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CameraError {
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A folder without a COLMAP model.
    #[error(
        "{}: no COLMAP model here (cameras.bin and images.bin, or cameras.txt and images.txt, also in \
         sparse/0)",
        path.display()
    )]
    NoModel {
        /// The folder.
        path: PathBuf,
    },
    /// The file is not what it should be.
    #[error("{}: {place}: {why}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// Where in it.
        place: String,
        /// What is wrong, with the value.
        why: String,
    },
    /// A camera with lens distortion, or none at all.
    #[error(
        "{}: {place}: camera model {model}: only pinhole cameras are rendered (PINHOLE, \
         SIMPLE_PINHOLE); undistort the pictures first (COLMAP's image_undistorter, nerfstudio's ns-process-data)",
        path.display()
    )]
    Model {
        /// The file.
        path: PathBuf,
        /// Which camera.
        place: String,
        /// The model's name, or the distortion.
        model: String,
    },
}

impl CameraFile {
    /// Reads a `transforms.json`, or the COLMAP model in a folder. A size that is given replaces the
    /// files': intrinsics grow or shrink with it.
    ///
    /// # Errors
    /// [`CameraError`] with file, place and value.
    pub fn read(path: &Path, size: Option<[u32; 2]>) -> Result<Self, CameraError> {
        let mut source = Source { digest: Sha256::new() };
        let mut cameras = if path.is_dir() {
            colmap::read(path, &mut source)?
        } else {
            nerf::read(path, size, &mut source)?
        };
        if cameras.is_empty() {
            return Err(content(path, "cameras", "there is none"));
        }
        let mut taken = std::collections::HashMap::<String, usize>::new();
        for camera in &mut cameras {
            if let Some(size) = size {
                camera.optics = camera.optics.resized(size);
            }
            camera
                .optics
                .check()
                .map_err(|error| content(path, &format!("camera of {}", camera.name), error))?;
            let count = taken.entry(camera.name.clone()).or_default();
            *count += 1;
            if *count > 1 {
                camera.name = format!("{}_{count}", camera.name);
            }
        }
        let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
        let sha256 = hex(&source.digest.finalize());
        Ok(Self { name, sha256, count: cameras.len(), cameras })
    }
}

/// Reads files and keeps account of what was read.
struct Source {
    digest: Sha256,
}

impl Source {
    fn read(&mut self, path: &Path) -> Result<Vec<u8>, CameraError> {
        let bytes = std::fs::read(path)
            .map_err(|source| CameraError::Io { path: path.to_owned(), source })?;
        self.digest.update((bytes.len() as u64).to_le_bytes());
        self.digest.update(&bytes);
        Ok(bytes)
    }
}

fn content(path: &Path, place: &str, why: impl std::fmt::Display) -> CameraError {
    CameraError::Content { path: path.to_owned(), place: place.to_owned(), why: why.to_string() }
}

/// A pinhole picture; intrinsics count from its upper left corner.
fn pinhole(size: [u32; 2], [fx, fy, cx, cy]: [f64; 4]) -> Optics {
    Optics { size, lens: Lens::Intrinsics(Intrinsics { fx, fy, cx, cy }) }
}

/// A picture's name without its ending, as part of a file name: folders and odd characters become `_`.
fn picture_name(name: &str) -> String {
    let name = name.trim_start_matches("./");
    let (folders, file) = name.rsplit_once(['/', '\\']).map_or(("", name), |(a, b)| (a, b));
    let stem =
        file.rsplit_once('.').map_or(file, |(stem, _)| if stem.is_empty() { file } else { stem });
    let whole = if folders.is_empty() { stem.to_owned() } else { format!("{folders}_{stem}") };
    let fit = |c: char| if c.is_alphanumeric() || "-_.".contains(c) { c } else { '_' };
    let fitted: String = whole.chars().map(fit).collect();
    let fitted = fitted.trim_start_matches('.');
    if fitted.is_empty() { "camera".to_owned() } else { fitted.to_owned() }
}

/// Whether the rows of a matrix are a right-handed set of unit vectors within 1e-4.
fn is_rotation(m: &Matrix) -> bool {
    let dot = |a: Vector, b: Vector| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let near = |value: f64, want: f64| (value - want).abs() < 1e-4;
    let determinant = m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1])
        - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
        + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0]);
    near(determinant, 1.0)
        && (0..3).all(|i| (0..3).all(|j| near(dot(m[i], m[j]), if i == j { 1.0 } else { 0.0 })))
}

#[cfg(test)]
mod tests;
