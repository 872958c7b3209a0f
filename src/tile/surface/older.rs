//! Mesh files that an earlier run into other parts left.

use crate::mesh_file::{MeshFormat, companions};
use std::path::{Path, PathBuf};

/// Files to be removed after `<stem>` was written into so many numbered parts (`None`: into one file without a
/// number): the file without a number beside numbered ones, and parts with higher numbers, or from 1 on beside the
/// file without, up to the first that is not there; with the material and the picture of each. `<stem>_7.glb`
/// alone may be another city.
pub(super) fn older(
    folder: &Path,
    stem: &str,
    format: MeshFormat,
    parts: Option<u32>,
) -> Vec<PathBuf> {
    let path = |stem: &str| folder.join(format!("{stem}.{}", format.extension()));
    let first = parts.map_or(1, |parts| parts.saturating_add(1));
    let numbered = (first..).map(|number| format!("{stem}_{number}"));
    let mut stems: Vec<String> = numbered.take_while(|stem| path(stem).is_file()).collect();
    if parts.is_none() && stems.len() == 1 {
        // One part is never all.
        stems.clear();
    }
    if parts.is_some() && path(stem).is_file() {
        stems.push(stem.to_owned());
    }
    let mut paths: Vec<PathBuf> = stems.iter().map(|stem| path(stem)).collect();
    for stem in stems.iter().filter(|_| format == MeshFormat::Obj) {
        let [material, picture] = companions(stem);
        // A picture that the material does not name is not the mesh's.
        let text = std::fs::read_to_string(folder.join(&material)).unwrap_or_default();
        if text.lines().any(|line| line.strip_prefix("map_Kd ") == Some(&*picture)) {
            let both = [material, picture].map(|name| folder.join(name));
            paths.extend(both.into_iter().filter(|path| path.is_file()));
        }
    }
    paths
}
