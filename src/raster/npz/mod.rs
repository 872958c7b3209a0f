//! numpy's `.npz` and `.npy` files.
//!
//! A `.npz` is a zip archive with one `<name>.npy` per array. [`encode`] writes what `numpy.load`
//! reads, byte for byte the same for the same arrays (members carry zip's earliest date, as numpy's
//! own do). [`read`] takes whatever numpy wrote: stored or deflated members, zip64, any byte order,
//! C and Fortran order.

mod npy;
mod zip;

pub use super::deflate::Compression;
use super::deflate::InflateError;
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

/// One array to write.
#[derive(Clone, Copy, Debug)]
pub struct NpyArray<'a> {
    /// Key in the archive, without `.npy`.
    pub name: &'a str,
    /// Lengths of the axes, slowest first: rows, then columns.
    pub shape: &'a [usize],
    /// The values, row-major.
    pub data: NpyData<'a>,
}

macro_rules! element_types {
    ($($variant:ident, $type:ty, $descr:literal, $doc:literal;)*) => {
        /// Values to write, row-major.
        #[derive(Clone, Copy, Debug)]
        pub enum NpyData<'a> {
            $(#[doc = $doc] $variant(&'a [$type]),)*
        }

        /// Values read, row-major.
        #[derive(Clone, Debug, PartialEq)]
        pub enum NpyValues {
            $(#[doc = $doc] $variant(Vec<$type>),)*
        }

        impl NpyData<'_> {
            const fn len(&self) -> usize {
                match self { $(Self::$variant(values) => values.len(),)* }
            }

            const fn descr(&self) -> &'static str {
                match self { $(Self::$variant(_) => $descr,)* }
            }

            const fn item_bytes(&self) -> usize {
                match self { $(Self::$variant(_) => size_of::<$type>(),)* }
            }

            fn append_to(&self, out: &mut Vec<u8>) {
                match self {
                    $(Self::$variant(values) => {
                        const SIZE: usize = size_of::<$type>();
                        let from = out.len();
                        out.resize(from + SIZE * values.len(), 0);
                        for (bytes, value) in out[from..].as_chunks_mut::<SIZE>().0.iter_mut().zip(*values) {
                            *bytes = value.to_le_bytes();
                        }
                    })*
                }
            }
        }

        impl NpyValues {
            /// Number of values.
            #[must_use]
            pub const fn len(&self) -> usize {
                match self { $(Self::$variant(values) => values.len(),)* }
            }

            /// numpy's name of the element type, for messages: `<f4`, `|u1`, ...
            #[must_use]
            pub const fn descr(&self) -> &'static str {
                match self { $(Self::$variant(_) => $descr,)* }
            }

            /// The values as `f32`; integers and doubles are rounded to the nearest.
            #[must_use]
            pub fn to_f32(&self) -> Vec<f32> {
                match self { $(Self::$variant(values) => values.iter().map(|&v| v as f32).collect(),)* }
            }

            /// The values as `f64`; 64-bit integers beyond 2^53 are rounded to the nearest.
            #[must_use]
            pub fn to_f64(&self) -> Vec<f64> {
                match self { $(Self::$variant(values) => values.iter().map(|&v| v as f64).collect(),)* }
            }

            fn to_row_major(&self, shape: &[usize]) -> Self {
                match self { $(Self::$variant(values) => Self::$variant(npy::to_row_major(values, shape)),)* }
            }
        }
    };
}

element_types! {
    F32, f32, "<f4", "32-bit floats (half floats are read as these, exactly).";
    F64, f64, "<f8", "64-bit floats.";
    U8, u8, "|u1", "Bytes (booleans are read as these, 0 and 1).";
    I8, i8, "|i1", "Signed bytes.";
    U16, u16, "<u2", "Unsigned 16-bit integers.";
    I16, i16, "<i2", "Signed 16-bit integers.";
    U32, u32, "<u4", "Unsigned 32-bit integers.";
    I32, i32, "<i4", "Signed 32-bit integers.";
    U64, u64, "<u8", "Unsigned 64-bit integers.";
    I64, i64, "<i8", "Signed 64-bit integers.";
}

impl NpyValues {
    /// Whether there are no values.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// One array that was read, always row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct NpyOwned {
    /// Lengths of the axes, slowest first.
    pub shape: Vec<usize>,
    /// The values, row-major.
    pub values: NpyValues,
}

impl NpyOwned {
    /// The values as `f32`; integers and doubles are rounded to the nearest.
    #[must_use]
    pub fn to_f32(&self) -> Vec<f32> {
        self.values.to_f32()
    }

    /// As [`Self::to_f32`], without a copy where the values are `f32` already.
    #[must_use]
    pub fn into_f32(self) -> Vec<f32> {
        match self.values {
            NpyValues::F32(values) => values,
            other => other.to_f32(),
        }
    }

    /// The values as `f64`; 64-bit integers beyond 2^53 are rounded to the nearest.
    #[must_use]
    pub fn to_f64(&self) -> Vec<f64> {
        self.values.to_f64()
    }
}

/// Why an array file cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum NpzError {
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is no zip archive and no npy file, or its structure is broken.
    #[error("{}: {reason}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// One array of the file is broken, or of a kind that is not read.
    #[error("{}: array `{name}`: {reason}", path.display())]
    Array {
        /// The file.
        path: PathBuf,
        /// Key of the array.
        name: String,
        /// What is wrong.
        reason: String,
    },
    /// The archive has no such array.
    #[error("{}: no array `{name}`; it has {}", path.display(), list(found))]
    Missing {
        /// The file.
        path: PathBuf,
        /// Key that was asked for.
        name: String,
        /// Keys that exist.
        found: Vec<String>,
    },
}

fn list(names: &[String]) -> String {
    if names.is_empty() {
        return "none at all".to_owned();
    }
    names.iter().map(|n| format!("`{n}`")).collect::<Vec<_>>().join(", ")
}

/// What is wrong with one member, before the file's and the array's names are known.
type Reason = String;

/// Writes arrays as one `.npz`, in the order given.
///
/// # Panics
/// Where a shape and the number of values disagree: a mistake of the caller, never of the data.
#[must_use]
pub fn encode(arrays: &[NpyArray<'_>], compression: Compression) -> Vec<u8> {
    let mut archive = zip::Writer::new();
    add_all(&mut archive, arrays, compression);
    archive.finish()
}

/// Header of a `.npy` file of little-endian 32-bit floats, row-major; the values follow it.
#[must_use]
pub fn npy_header_f32(shape: &[usize]) -> Vec<u8> {
    npy::header("<f4", shape)
}

fn add_all(archive: &mut zip::Writer, arrays: &[NpyArray<'_>], compression: Compression) {
    for array in arrays {
        let NpyArray { name, shape, data } = array;
        let count = shape.iter().try_fold(1_usize, |n, &d| n.checked_mul(d));
        assert_eq!(count, Some(data.len()), "values of array `{name}` of shape {shape:?}");
        let header = npy::header(data.descr(), shape);
        let item = data.item_bytes();
        let mut bytes = Vec::with_capacity(header.len() + item * data.len());
        bytes.extend_from_slice(&header);
        data.append_to(&mut bytes);
        archive.add(&format!("{name}.npy"), &bytes, item, compression);
    }
}

/// Reads every array of a `.npz`, in the order of the archive, or the one array of a `.npy` (under
/// the name `arr_0`, which numpy gives to an array saved without one).
///
/// # Errors
/// [`NpzError`] naming the file and the array.
pub fn read(path: &Path) -> Result<Vec<(String, NpyOwned)>, NpzError> {
    parse(&load(path)?, path)
}

/// Reads one array of a `.npz` by its key; a `.npy` has the key `arr_0`.
///
/// # Errors
/// [`NpzError`] naming the file and the array; [`NpzError::Missing`] lists the keys there are.
pub fn read_one(path: &Path, name: &str) -> Result<NpyOwned, NpzError> {
    let bytes = load(path)?;
    let members = members(&bytes, path)?;
    match members.iter().find(|m| m.name == name) {
        Some(member) => member.read(&bytes, path),
        None => Err(NpzError::Missing {
            path: path.to_owned(),
            name: name.to_owned(),
            found: members.into_iter().map(|m| m.name).collect(),
        }),
    }
}

/// Bytes of a file's end in which its directory is looked for, and of each member's beginning.
const LOOKED_AT: [u64; 2] = [1 << 16, 1 << 12];

/// Names and shapes of the arrays of a file, of which little more is read than the headers. An array
/// whose header is not to be made out is left out: reading it says why.
///
/// # Errors
/// [`NpzError`] naming the file.
pub fn shapes(path: &Path) -> Result<Vec<(String, Vec<usize>)>, NpzError> {
    let io = |source| NpzError::Io { path: path.to_owned(), source };
    let [end, start] = LOOKED_AT;
    let file = File::open(path).map_err(io)?;
    let length = file.metadata().map_err(io)?.len();
    // As long as the file, so that offsets hold; memory that nobody touches is none.
    let mut bytes = vec![0; usize::try_from(length).unwrap_or(usize::MAX)];
    let fill = |bytes: &mut Vec<u8>, from: u64, count: u64| {
        let to = from.saturating_add(count).min(length);
        let from = from.min(to);
        file.read_exact_at(&mut bytes[from as usize..to as usize], from).map_err(io)
    };
    fill(&mut bytes, 0, start)?;
    fill(&mut bytes, length.saturating_sub(end), end)?;
    let found = match members(&bytes, path) {
        Ok(found) => found,
        Err(_) => {
            fill(&mut bytes, 0, length)?;
            members(&bytes, path)?
        }
    };
    let mut shapes = Vec::new();
    for Member { name, entry } in found {
        let shape = match &entry {
            None => npy::shape(&bytes),
            Some(entry) => {
                fill(&mut bytes, entry.offset(), start)?;
                entry.beginning(&bytes, start as usize / 2).and_then(|bytes| npy::shape(&bytes))
            }
        };
        shapes.extend(shape.map(|shape| (name, shape)));
    }
    Ok(shapes)
}

/// [`read`] for bytes in memory; `path` is for messages only.
///
/// # Errors
/// As [`read`].
pub fn parse(bytes: &[u8], path: &Path) -> Result<Vec<(String, NpyOwned)>, NpzError> {
    members(bytes, path)?
        .into_iter()
        .map(|member| member.read(bytes, path).map(|array| (member.name, array)))
        .collect()
}

fn load(path: &Path) -> Result<Vec<u8>, NpzError> {
    std::fs::read(path).map_err(|source| NpzError::Io { path: path.to_owned(), source })
}

struct Member {
    name: String,
    /// `None`: the file itself is the npy.
    entry: Option<zip::Entry>,
}

impl Member {
    fn read(&self, file: &[u8], path: &Path) -> Result<NpyOwned, NpzError> {
        let array = match &self.entry {
            None => npy::parse(file),
            Some(entry) => entry.content(file).and_then(|bytes| npy::parse(&bytes)),
        };
        array.map_err(|reason| NpzError::Array {
            path: path.to_owned(),
            name: self.name.clone(),
            reason,
        })
    }
}

fn members(bytes: &[u8], path: &Path) -> Result<Vec<Member>, NpzError> {
    if bytes.starts_with(npy::MAGIC) {
        return Ok(vec![Member { name: "arr_0".to_owned(), entry: None }]);
    }
    let entries = zip::entries(bytes)
        .map_err(|reason| NpzError::Damaged { path: path.to_owned(), reason })?;
    Ok(entries
        .into_iter()
        .filter(|entry| !entry.name.ends_with('/'))
        .map(|entry| Member {
            name: entry.name.strip_suffix(".npy").unwrap_or(&entry.name).to_owned(),
            entry: Some(entry),
        })
        .collect())
}

impl From<InflateError> for Reason {
    fn from(error: InflateError) -> Self {
        error.to_string()
    }
}

#[cfg(test)]
mod tests;
