//! A checkpoint, or the mean of several, written anew with 32-bit or 16-bit floats.

use crate::batch::AtomicFolder;
use crate::model::weights::{Precision, Rounding, RoundingError, WEIGHTS_FILE, write_rounded};
use crate::model::{Checkpoint, ModelError};
use std::io;
use std::path::{Path, PathBuf};

/// The files of a checkpoint folder.
const FILES: [&str; 2] = ["config.json", WEIGHTS_FILE];

/// Why nothing was exported. What stood at the target is as it was.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ExportError {
    /// The checkpoint cannot be read again, or what was written cannot.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A tensor cannot be read, or does not fit.
    #[error(transparent)]
    Rounding(#[from] RoundingError),
    /// The target is the checkpoint itself.
    #[error("{}: this is the checkpoint itself; name another folder", target.display())]
    Itself {
        /// As given.
        target: PathBuf,
    },
    /// The target holds other things than a checkpoint.
    #[error("{}: there is `{found}` in it, which is no part of a checkpoint; name another folder", target.display())]
    Occupied {
        /// As given.
        target: PathBuf,
        /// A file or folder in it.
        found: String,
    },
    /// Reading or writing failed.
    #[error("{}: {source}", target.display())]
    Io {
        /// The target.
        target: PathBuf,
        /// What the system said.
        #[source]
        source: io::Error,
    },
}

/// Writes a checkpoint folder: `config.json` as it is, and all tensors in one precision, the mean of the checkpoint's
/// and the `others'` (see [`write_rounded`]). An older checkpoint at `target` is replaced. The bytes depend on the
/// checkpoint's config and the values alone.
///
/// # Errors
/// [`ExportError`]; nothing is left then.
pub fn export(
    checkpoint: &Checkpoint,
    others: &[Checkpoint],
    target: &Path,
    precision: Precision,
) -> Result<Rounding, ExportError> {
    let io = |source| ExportError::Io { target: target.into(), source };
    if target.exists() {
        for source in std::iter::once(checkpoint).chain(others) {
            replaceable(source, target)?;
        }
    }
    let folder = AtomicFolder::create(target).map_err(io)?;
    folder.write(FILES[0], checkpoint.config_text().as_bytes()).map_err(io)?;
    let mut result = None;
    folder
        .file(FILES[1], |path| match write_rounded(checkpoint, others, precision, path) {
            Ok(rounding) => {
                result = Some(Ok(rounding));
                Ok(())
            }
            // The file's place is a temporary one, which `file` replaces by the target's.
            Err(RoundingError::Write { source, .. }) => Err(source),
            Err(other) => {
                let kind = io::ErrorKind::InvalidData;
                let text = other.to_string();
                result = Some(Err(other));
                Err(io::Error::new(kind, text))
            }
        })
        .or_else(|error| if matches!(result, Some(Err(_))) { Ok(()) } else { Err(io(error)) })?;
    let rounding = match result {
        Some(rounding) => rounding?,
        None => return Err(io(io::ErrorKind::Other.into())),
    };
    // What cannot be opened again must not take the place of what can.
    Checkpoint::open(folder.path())?;
    folder.commit().map_err(io)?;
    Ok(rounding)
}

/// Whether what stands at the target may be replaced.
fn replaceable(checkpoint: &Checkpoint, target: &Path) -> Result<(), ExportError> {
    let io = |source| ExportError::Io { target: target.into(), source };
    let own = checkpoint.folder().canonicalize().ok();
    if own.is_some() && target.canonicalize().ok() == own {
        return Err(ExportError::Itself { target: target.into() });
    }
    for entry in std::fs::read_dir(target).map_err(io)? {
        let name = entry.map_err(io)?.file_name();
        if FILES.iter().all(|file| name != *file) {
            let found = name.to_string_lossy().into_owned();
            return Err(ExportError::Occupied { target: target.into(), found });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::weights::rule::{Override, tiny_overrides, write_checkpoint};
    use crate::model::weights::{LEAST_NORMAL, MappedFile};

    const CONFIG: &str = include_str!("../../crates/sat3d-model/fixtures/tiny/model/config.json");
    const KEY: &str = "mlp.net0.bias";

    fn checkpoint(folder: &Path, changed: Option<(f32, f32)>) -> Checkpoint {
        let mut overrides = tiny_overrides();
        overrides.extend(changed.map(|(offset, scale)| Override {
            key: KEY.into(),
            offset,
            scale,
        }));
        write_checkpoint(folder, CONFIG, overrides).expect("writes");
        Checkpoint::open(folder).expect("opens")
    }

    fn tensors(folder: &Path) -> Vec<(String, Vec<usize>, String, Vec<f32>)> {
        let file = MappedFile::open(&folder.join(WEIGHTS_FILE)).expect("opens");
        let mut keys: Vec<&str> = file.keys().collect();
        keys.sort_unstable();
        let one = |key: &str| {
            let shape = file.shape(key).expect("is there").to_vec();
            let values = file.read(key, &shape).expect("reads");
            (key.to_owned(), shape, file.element(key).expect("is there"), values)
        };
        keys.into_iter().map(one).collect()
    }

    /// 16-bit rounding without the library: 11 binary digits, or multiples of 2^-24.
    fn rounded(value: f32) -> f32 {
        let value = f64::from(value);
        let exponent = libm::ilogb(value.abs().max(f64::from(LEAST_NORMAL)));
        let unit = libm::exp2(f64::from(exponent - 10));
        (libm::rint(value / unit) * unit) as f32
    }

    #[test]
    fn half_of_the_bytes_give_the_rounded_values() {
        let place = tempfile::tempdir().expect("a folder");
        let (source, target) = (place.path().join("source"), place.path().join("target"));
        let checkpoint = checkpoint(&source, None);
        let rounding = export(&checkpoint, &[], &target, Precision::Half).expect("exports");
        let (before, after) = (tensors(&source), tensors(&target));
        assert_eq!(before.len(), after.len());
        let mut largest = 0.0_f64;
        let mut small = 0;
        for (before, after) in before.iter().zip(&after) {
            assert_eq!((&before.0, &before.1, after.2.as_str()), (&after.0, &after.1, "F16"));
            for (old, new) in before.3.iter().zip(&after.3) {
                assert_eq!(*new, rounded(*old), "{} of {}", old, before.0);
                if old.abs() >= LEAST_NORMAL {
                    largest = largest.max(f64::from((new - old) / old).abs());
                } else if *old != 0.0 {
                    small += 1;
                }
            }
        }
        assert!((rounding.largest_relative - largest).abs() < 1e-9);
        assert!(largest > 4e-4 && largest <= f64::from(2.0_f32.powi(-11)));
        assert_eq!((rounding.tensors, rounding.small), (before.len(), small));
        assert!(rounding.largest_in.is_some() && rounding.largest_of_small <= 2.0_f64.powi(-25));
        let values: usize = before.iter().map(|tensor| tensor.3.len()).sum();
        assert_eq!(rounding.values, values as u64);
        let config = std::fs::read_to_string(target.join("config.json")).expect("reads");
        assert_eq!(config, CONFIG);
        let size = |folder: &Path| folder.join(WEIGHTS_FILE).metadata().expect("is there").len();
        assert!(size(&target) * 2 < size(&source) + 100_000);
    }

    #[test]
    fn whole_floats_keep_every_bit_and_bytes_depend_on_the_values_alone() {
        let place = tempfile::tempdir().expect("a folder");
        let at = |name: &str| place.path().join(name);
        let source = checkpoint(&at("source"), None);
        let rounding = export(&source, &[], &at("whole"), Precision::Single).expect("exports");
        assert_eq!((rounding.largest_relative, rounding.largest_in), (0.0, None));
        assert_eq!(tensors(&at("source")), tensors(&at("whole")));
        export(&source, &[], &at("half"), Precision::Half).expect("exports");
        // Again from another folder and another order of tensors, over an older export.
        let whole = Checkpoint::open(&at("whole")).expect("opens");
        export(&whole, &[], &at("half2"), Precision::Single).expect("exports");
        export(&whole, &[], &at("half2"), Precision::Half).expect("exports");
        let bytes = |name: &str| std::fs::read(at(name).join(WEIGHTS_FILE)).expect("reads");
        assert_eq!(bytes("half"), bytes("half2"));
        // Half floats are whole floats, too.
        let half = Checkpoint::open(&at("half")).expect("opens");
        export(&half, &[], &at("back"), Precision::Half).expect("exports");
        assert_eq!(bytes("half"), bytes("back"));
    }

    #[test]
    fn several_give_the_mean_of_their_values() {
        let place = tempfile::tempdir().expect("a folder");
        let at = |name: &str| place.path().join(name);
        let one = checkpoint(&at("one"), None);
        // Values that the rule gives around other offsets, at other scales.
        let two = checkpoint(&at("two"), Some((3.0, 0.7)));
        let three = checkpoint(&at("three"), Some((-1e-3, 1e-6)));
        let others = [two, three];
        let rounding = export(&one, &others, &at("mean"), Precision::Single).expect("exports");
        let of = |name: &str| tensors(&at(name));
        let (one_s, two_s, three_s) = (of("one"), of("two"), of("three"));
        let mean = of("mean");
        assert_eq!((rounding.tensors, mean.len()), (one_s.len(), one_s.len()));
        for (index, (key, shape, _, values)) in mean.iter().enumerate() {
            let all = [&one_s[index], &two_s[index], &three_s[index]];
            assert_eq!((key, shape), (&all[0].0, &all[0].1));
            for (place, value) in values.iter().enumerate() {
                let [a, b, c] = all.map(|tensor| f64::from(tensor.3[place]));
                assert_eq!(*value, ((a + b + c) / 3.0) as f32, "{key} {place}");
            }
            // Only one of the keys differs between the three.
            assert_eq!(*values != all[0].3, key == KEY, "{key}");
        }
        // The mean of one and itself is itself.
        let again = [Checkpoint::open(&at("one")).expect("opens")];
        export(&one, &again, &at("same"), Precision::Single).expect("exports");
        assert_eq!(of("same"), of("one"));
    }

    #[test]
    fn no_mean_of_other_networks_or_onto_one_of_its_parts() {
        let place = tempfile::tempdir().expect("a folder");
        let at = |name: &str| place.path().join(name);
        let one = checkpoint(&at("one"), None);
        let two = [checkpoint(&at("two"), None)];
        let error = export(&one, &two, &at("two"), Precision::Single);
        assert!(matches!(error, Err(ExportError::Itself { .. })));
        let mini = [Checkpoint::at(Path::new("built-in:mini")).expect("opens")];
        let error = export(&one, &mini, &at("out"), Precision::Single).expect_err("no mean");
        assert!(matches!(error, ExportError::Rounding(RoundingError::Differs { .. })), "{error}");
        assert!(error.to_string().contains("one") && !at("out").exists(), "{error}");
        // The one whose value is to blame is named, not the first, and its value, not the mean.
        for (offset, said) in [(4e5, "400000"), (f32::NAN, "NaN"), (f32::INFINITY, "inf")] {
            let far = [checkpoint(&at("far"), Some((offset, 0.0)))];
            let error = export(&one, &far, &at("out"), Precision::Half).expect_err("too large");
            let text = error.to_string();
            assert!(text.contains("far") && text.contains(KEY) && text.contains(said), "{text}");
        }
    }

    #[test]
    fn what_does_not_fit_is_refused_and_leaves_what_was_there() {
        let place = tempfile::tempdir().expect("a folder");
        let at = |name: &str| place.path().join(name);
        let good = checkpoint(&at("good"), None);
        export(&good, &[], &at("target"), Precision::Half).expect("exports");
        let before = tensors(&at("target"));
        // 65519 rounds down to 65504, 65520 is beyond.
        let edge = checkpoint(&at("edge"), Some((65_519.0, 0.0)));
        export(&edge, &[], &at("fits"), Precision::Half).expect("fits");
        for value in [65_520.0, -1e9, f32::INFINITY, f32::NAN] {
            let bad = checkpoint(&at("bad"), Some((value, 0.0)));
            let error =
                export(&bad, &[], &at("target"), Precision::Half).expect_err("does not fit");
            assert!(matches!(error, ExportError::Rounding(RoundingError::Value { .. })), "{error}");
            assert!(error.to_string().contains(KEY), "{error}");
            let whole = export(&bad, &[], &at("whole"), Precision::Single);
            assert_eq!(whole.is_ok(), value.is_finite());
        }
        assert_eq!(tensors(&at("target")), before);
        let mut names: Vec<String> = std::fs::read_dir(place.path())
            .expect("lists")
            .map(|entry| entry.expect("is there").file_name().to_string_lossy().into_owned())
            .collect();
        names.sort();
        assert_eq!(names, ["bad", "edge", "fits", "good", "target", "whole"]);
    }

    #[test]
    fn small_values_are_counted() {
        let place = tempfile::tempdir().expect("a folder");
        let count = {
            let plain = checkpoint(&place.path().join("plain"), None);
            plain.file().shape(KEY).expect("is there").iter().product::<usize>() as u64
        };
        let of = |value: f32| {
            let made = checkpoint(&place.path().join("made"), Some((value, 0.0)));
            export(&made, &[], &place.path().join("out"), Precision::Half).expect("exports")
        };
        let (zero, tiny) = (of(0.0), of(1e-9));
        assert_eq!((tiny.small - zero.small, tiny.vanished - zero.vanished), (count, count));
        // Half of the least 16-bit float: to even, which is 0.
        let tie = of(2.0_f32.powi(-25));
        assert_eq!(
            (tie.vanished - zero.vanished, tie.largest_of_small),
            (count, 2.0_f64.powi(-25))
        );
    }

    #[test]
    fn other_files_and_the_checkpoint_itself_are_not_replaced() {
        let place = tempfile::tempdir().expect("a folder");
        let source = checkpoint(&place.path().join("source"), None);
        let error = export(&source, &[], &place.path().join("source"), Precision::Half);
        assert!(matches!(error, Err(ExportError::Itself { .. })));
        std::fs::create_dir(place.path().join("home")).expect("makes");
        std::fs::write(place.path().join("home/thesis.tex"), "x").expect("writes");
        let error =
            export(&source, &[], &place.path().join("home"), Precision::Half).expect_err("no");
        assert!(error.to_string().contains("thesis.tex"), "{error}");
        let error = export(&source, &[], &place.path().join("no/such/place"), Precision::Half);
        assert!(matches!(error, Err(ExportError::Io { .. })));
    }
}
