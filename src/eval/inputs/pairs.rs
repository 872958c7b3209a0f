//! Which prediction belongs to which ground truth: `<stem>.npz|.npy|.tif` to `<stem>_dsm.npz|.tif`.

use super::InputError;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// File endings of predictions, the preferred first (`sat3d infer --geotiff` writes two of them).
const PREDICTIONS: [&str; 5] = ["npz", "npy", "tif", "tiff", "vrt"];
/// File endings of ground truths, the preferred first.
const TRUTHS: [&str; 5] = ["npz", "tif", "tiff", "vrt", "npy"];
/// What the name of a ground truth has behind the name of its image.
const SUFFIX: &str = "_dsm";

/// What names of arrays that lie beside a prediction have behind the name of its image.
const BESIDE: [&str; 5] = [
    "_satellite_depth",
    "_panorama_depth",
    "_perspective_depth",
    "_density",
    "_density_coordinates",
];

/// The files of one image, in every set of predictions and in the ground truth.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pair {
    /// Stem of the image.
    pub name: String,
    /// One per set of predictions.
    pub predictions: Vec<Option<PathBuf>>,
    /// The ground truth.
    pub truth: Option<PathBuf>,
}

/// Pairs files by stem; sorted by name. Every file of a known kind on either side is in the list.
///
/// Where both sides are files and not folders, they are a pair whatever they are called.
///
/// # Errors
/// [`InputError`] for a path that cannot be listed, and for a folder without any file of a known
/// kind.
pub fn pair(predictions: &[PathBuf], truth: &Path) -> Result<Vec<Pair>, InputError> {
    if truth.is_file() && predictions.iter().all(|p| p.is_file()) {
        let name = image_name(predictions.first().map_or(truth, |p| p));
        let predictions = predictions.iter().cloned().map(Some).collect();
        return Ok(vec![Pair { name, predictions, truth: Some(truth.to_owned()) }]);
    }
    let mut pairs: BTreeMap<String, Pair> = BTreeMap::new();
    let empty = |name: &str| Pair {
        name: name.to_owned(),
        predictions: vec![None; predictions.len()],
        truth: None,
    };
    for (name, file) in list(truth, &TRUTHS)? {
        pairs.entry(name.clone()).or_insert_with(|| empty(&name)).truth = Some(file);
    }
    for (set, folder) in predictions.iter().enumerate() {
        let listed = list(folder, &PREDICTIONS)?;
        // What `sat3d infer` writes beside an image's prediction is none.
        let beside = |name: &str| {
            BESIDE
                .iter()
                .any(|end| name.strip_suffix(end).is_some_and(|stem| listed.contains_key(stem)))
        };
        for (name, file) in listed.iter().filter(|(name, _)| !beside(name)) {
            let (name, file) = (name.clone(), file.clone());
            let pair = pairs.entry(name.clone()).or_insert_with(|| empty(&name));
            pair.predictions[set] = Some(file);
        }
    }
    Ok(pairs.into_values().collect())
}

/// Name of the image that a file is about: its stem without `_dsm`.
fn image_name(file: &Path) -> String {
    let stem = file.file_stem().unwrap_or_default().to_string_lossy();
    stem.strip_suffix(SUFFIX).unwrap_or(&stem).to_owned()
}

/// The files of a folder (or the one file given) by the name of their image. Of several files about
/// one image, the kind that stands first in `kinds`.
fn list(path: &Path, kinds: &[&str]) -> Result<BTreeMap<String, PathBuf>, InputError> {
    let unlisted = |source| InputError::Folder { path: path.to_owned(), source };
    if path.is_file() {
        return Ok(BTreeMap::from([(image_name(path), path.to_owned())]));
    }
    let mut found: BTreeMap<String, (usize, PathBuf)> = BTreeMap::new();
    for entry in std::fs::read_dir(path).map_err(unlisted)? {
        let file = entry.map_err(unlisted)?.path();
        let hidden = file.file_name().is_some_and(|n| n.to_string_lossy().starts_with('.'));
        let kind = file
            .extension()
            .and_then(|ending| kinds.iter().position(|kind| ending.eq_ignore_ascii_case(kind)));
        let (Some(kind), false, true) = (kind, hidden, file.is_file()) else { continue };
        match found.entry(image_name(&file)) {
            std::collections::btree_map::Entry::Vacant(entry) => {
                entry.insert((kind, file));
            }
            std::collections::btree_map::Entry::Occupied(mut entry) => {
                if (kind, &file) < (entry.get().0, &entry.get().1) {
                    entry.insert((kind, file));
                }
            }
        }
    }
    if found.is_empty() {
        return Err(InputError::Empty { path: path.to_owned(), kinds: kinds.join(", *.") });
    }
    Ok(found.into_iter().map(|(name, (_, file))| (name, file)).collect())
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may fail")]
mod tests {
    use super::*;

    fn folder(files: &[&str]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for file in files {
            std::fs::write(folder.path().join(file), b"x").unwrap();
        }
        folder
    }

    #[test]
    fn what_infer_writes_beside_a_prediction_is_no_prediction() {
        let truth = folder(&["a_dsm.npz"]);
        let files = ["a.npz", "a_panorama_depth.npz", "a_density.npy", "a_density_coordinates.npz"];
        let predictions = folder(&[&files[..], &["b_density.npy"]].concat());
        let pairs = pair(&[predictions.path().to_owned()], truth.path()).unwrap();
        let names: Vec<&str> = pairs.iter().map(|pair| pair.name.as_str()).collect();
        assert_eq!(names, ["a", "b_density"], "what belongs to no prediction is listed");
    }

    fn ending(path: Option<&PathBuf>) -> Option<String> {
        path.map(|p| p.file_name().unwrap().to_string_lossy().into_owned())
    }

    #[test]
    fn files_pair_by_stem_and_nothing_is_lost() {
        let first = folder(&["a.npz", "a.tif", "b.npy", "lonely.tif", "notes.txt", ".a.npz"]);
        let second = folder(&["a_dsm.npz"]);
        let truth = folder(&["a_dsm.npz", "a_dsm.tif", "b_dsm.tif", "c_dsm.npz", "manifest.csv"]);
        let sets = [first.path().to_owned(), second.path().to_owned()];
        let pairs = pair(&sets, truth.path()).unwrap();
        let rows: Vec<_> = pairs
            .iter()
            .map(|p| {
                let set = |k: usize| ending(p.predictions[k].as_ref());
                (p.name.as_str(), set(0), set(1), ending(p.truth.as_ref()))
            })
            .collect();
        let file = |name: &str| Some(name.to_owned());
        assert_eq!(
            rows,
            [
                ("a", file("a.npz"), file("a_dsm.npz"), file("a_dsm.npz")),
                ("b", file("b.npy"), None, file("b_dsm.tif")),
                ("c", None, None, file("c_dsm.npz")),
                ("lonely", file("lonely.tif"), None, None),
            ]
        );
    }

    #[test]
    fn two_files_are_a_pair_whatever_their_names() {
        let folder = folder(&["srtm_shifted.tif", "srtm_ref.tif"]);
        let at = |name: &str| folder.path().join(name);
        let pairs = pair(&[at("srtm_shifted.tif")], &at("srtm_ref.tif")).unwrap();
        assert_eq!(pairs.len(), 1);
        assert_eq!(pairs[0].name, "srtm_shifted");
        assert!(pairs[0].truth.is_some());
    }

    #[test]
    fn a_missing_or_empty_folder_is_named() {
        let empty = folder(&["readme.md"]);
        let truth = folder(&["a_dsm.npz"]);
        let message = pair(&[empty.path().to_owned()], truth.path()).unwrap_err().to_string();
        assert!(message.contains(&*empty.path().to_string_lossy()), "{message}");
        assert!(message.contains("*.npz"), "{message}");
        let missing = empty.path().join("missing");
        let message = pair(&[missing], truth.path()).unwrap_err().to_string();
        assert!(message.contains("missing"), "{message}");
    }
}
