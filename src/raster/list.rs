//! Which files a `--lidar` argument means.

use super::RasterError;
use std::cmp::Ordering;
use std::collections::HashSet;
use std::path::{Path, PathBuf};

/// The raster files that `inputs` mean, in order and without repeats.
///
/// A file stands for itself. A folder stands for its `*.tif` and `*.tiff` files (any case) in
/// natural order (`tile_2` before `tile_10`); only a folder without any stands for its `*.vrt` files,
/// because a VRT beside tiles is made of those tiles. Subfolders are not searched, and names that
/// begin with a dot are left out.
///
/// # Errors
/// [`RasterError::Io`] for a path that is missing or cannot be listed, [`RasterError::NoTiles`] for a
/// folder without rasters or an empty list, [`RasterError::Unreadable`] for a VRT in a build without
/// GDAL.
pub fn list_tiles(inputs: &[PathBuf]) -> Result<Vec<PathBuf>, RasterError> {
    let io = |path: &Path| {
        let path = path.to_owned();
        move |source| RasterError::Io { path, source }
    };
    let mut seen = HashSet::new();
    let mut tiles = Vec::new();
    for input in inputs {
        let metadata = std::fs::metadata(input).map_err(io(input))?;
        let files = if metadata.is_dir() { list_folder(input)? } else { vec![input.clone()] };
        for file in files {
            let refused = cfg!(not(feature = "gdal")) && has_extension(&file, &["vrt"]);
            if refused {
                return Err(RasterError::Unreadable {
                    path: file,
                    reason:
                        "is a VRT, and this build reads GeoTIFF only; give the tiles that it is \
                             made of, or use a build with GDAL"
                            .to_owned(),
                });
            }
            if seen.insert(std::fs::canonicalize(&file).map_err(io(&file))?) {
                tiles.push(file);
            }
        }
    }
    if tiles.is_empty() {
        return Err(RasterError::NoTiles {
            path: PathBuf::from("list of rasters"),
            reason: "no raster was given".to_owned(),
        });
    }
    Ok(tiles)
}

fn list_folder(folder: &Path) -> Result<Vec<PathBuf>, RasterError> {
    let io = |source| RasterError::Io { path: folder.to_owned(), source };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let path = entry.map_err(io)?.path();
        let hidden = path.file_name().is_none_or(|n| n.as_encoded_bytes().starts_with(b"."));
        if !hidden && path.is_file() {
            files.push(path);
        }
    }
    files.sort_by(|a, b| natural_order(&name(a), &name(b)));
    let with = |extensions: &[&str]| -> Vec<PathBuf> {
        files.iter().filter(|f| has_extension(f, extensions)).cloned().collect()
    };
    let tiffs = with(&["tif", "tiff"]);
    let found = if tiffs.is_empty() { with(&["vrt"]) } else { tiffs };
    if found.is_empty() {
        return Err(RasterError::NoTiles {
            path: folder.to_owned(),
            reason: "the folder holds no *.tif, *.tiff or *.vrt file (subfolders are not searched)"
                .to_owned(),
        });
    }
    Ok(found)
}

fn name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

fn has_extension(path: &Path, extensions: &[&str]) -> bool {
    path.extension().is_some_and(|e| extensions.iter().any(|x| e.eq_ignore_ascii_case(x)))
}

/// Compares runs of digits by value and everything else letter by letter, without case; what is
/// equal so far is ordered by its bytes, so that the order is total.
fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut x, mut y) = (a.as_bytes(), b.as_bytes());
    loop {
        let order = match (x.first(), y.first()) {
            (None, None) => return a.cmp(b),
            (None, Some(_)) => Ordering::Less,
            (Some(_), None) => Ordering::Greater,
            (Some(p), Some(q)) if p.is_ascii_digit() && q.is_ascii_digit() => {
                let (p, q) = (take_number(&mut x), take_number(&mut y));
                p.len().cmp(&q.len()).then_with(|| p.cmp(q))
            }
            (Some(p), Some(q)) => {
                (x, y) = (&x[1..], &y[1..]);
                p.to_ascii_lowercase().cmp(&q.to_ascii_lowercase())
            }
        };
        if order != Ordering::Equal {
            return order;
        }
    }
}

/// Cuts a run of digits off the front and returns it without leading zeros.
fn take_number<'a>(text: &mut &'a [u8]) -> &'a [u8] {
    let length = text.iter().take_while(|c| c.is_ascii_digit()).count();
    let (digits, rest) = text.split_at(length);
    *text = rest;
    let zeros = digits.iter().take_while(|c| **c == b'0').count();
    &digits[zeros..]
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may fail")]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn names(tiles: &[PathBuf]) -> Vec<String> {
        tiles.iter().map(|t| name(t)).collect()
    }

    #[test]
    fn a_folder_is_listed_in_natural_order() {
        let folder = tempfile::tempdir().unwrap();
        for file in
            ["t_10.tif", "t_2.TIF", "T_1.tiff", "t_002.tif", "._t_1.tif", "notes.txt", "all.vrt"]
        {
            std::fs::write(folder.path().join(file), b"x").unwrap();
        }
        std::fs::create_dir(folder.path().join("t_0.tif")).unwrap();
        let given = folder.path().join("t_10.tif");
        let tiles = list_tiles(&[folder.path().to_owned(), given]).unwrap();
        assert_eq!(names(&tiles), ["T_1.tiff", "t_002.tif", "t_2.TIF", "t_10.tif"]);
    }

    #[test]
    fn a_vrt_is_taken_where_there_is_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("all.vrt"), b"x").unwrap();
        let listed = list_tiles(&[folder.path().to_owned()]);
        if cfg!(feature = "gdal") {
            assert_eq!(names(&listed.unwrap()), ["all.vrt"]);
        } else {
            let message = listed.unwrap_err().to_string();
            assert!(message.contains("all.vrt") && message.contains("GDAL"), "{message}");
        }
    }

    #[test]
    fn nothing_to_read_is_an_error_that_names_the_place() {
        let folder = tempfile::tempdir().unwrap();
        let message = list_tiles(&[folder.path().to_owned()]).unwrap_err().to_string();
        assert!(message.contains(&*folder.path().to_string_lossy()), "{message}");
        assert!(message.contains("no *.tif"), "{message}");
        let missing = folder.path().join("missing.tif");
        let message = list_tiles(&[missing]).unwrap_err().to_string();
        assert!(message.contains("missing.tif"), "{message}");
        assert!(matches!(list_tiles(&[]), Err(RasterError::NoTiles { .. })));
    }

    proptest! {
        #[test]
        fn natural_order_is_a_total_order(
            names in proptest::collection::vec("[aB0-9._]{0,6}", 3)
        ) {
            let (a, b, c) = (&names[0], &names[1], &names[2]);
            prop_assert_eq!(natural_order(a, b), natural_order(b, a).reverse());
            prop_assert_eq!(natural_order(a, b) == Ordering::Equal, a == b);
            if natural_order(a, b).is_le() && natural_order(b, c).is_le() {
                prop_assert!(natural_order(a, c).is_le());
            }
        }

        #[test]
        fn numbers_are_ordered_by_value(a in 0u64.., b in 0u64..) {
            let order = natural_order(&format!("tile_{a}.tif"), &format!("tile_{b}.tif"));
            prop_assert_eq!(order, a.cmp(&b));
        }
    }
}
