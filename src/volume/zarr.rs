//! A density volume as a Zarr v3 folder, written region by region.

use super::{Frame, VolumeDescription, VolumeError, chunk, metadata};
use crate::batch::{AtomicFile, sync_folder};
use rayon::prelude::*;
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// A volume that is being written. Memory is what is written at once and a chunk for each core, whatever
/// the volume's size.
///
/// It grows in a folder beside its place and takes that place when it is finished: nobody sees half a volume.
/// Points that were never written are NaN, and chunks of nothing else are no files. The same values give the
/// same bytes, however they were cut into regions.
#[derive(Debug)]
pub struct ZarrVolume {
    target: PathBuf,
    folder: PathBuf,
    /// Removes the folder where it is not finished.
    temporary: Option<TempDir>,
    description: VolumeDescription,
}

impl ZarrVolume {
    /// Begins a volume that will stand at `target`, whose parent must exist. Dropped unfinished, it leaves
    /// nothing. An older volume there is replaced at the end.
    ///
    /// # Errors
    /// [`VolumeError::Description`], [`VolumeError::Occupied`] where `target` is something else than a Zarr
    /// volume, [`VolumeError::Io`].
    pub fn create(target: &Path, description: VolumeDescription) -> Result<Self, VolumeError> {
        check_target(target)?;
        let name = target.file_name().unwrap_or_default().to_string_lossy();
        let mut builder = tempfile::Builder::new();
        let prefix = format!(".{name}.");
        builder.prefix(&prefix).suffix(".part");
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            // Temporary folders are private by default; outputs get what the umask allows.
            builder.permissions(std::fs::Permissions::from_mode(0o777));
        }
        let parent = parent_of(target);
        let temporary = builder.tempdir_in(parent).map_err(VolumeError::io(parent))?;
        let folder = temporary.path().to_owned();
        let volume =
            Self { target: target.to_owned(), folder, temporary: Some(temporary), description };
        volume.begin()?;
        Ok(volume)
    }

    /// Begins or continues a volume in a folder that stays where it is until the volume is finished: what an
    /// interrupted run has written is there. `folder` must lie on the same file system as `target`.
    ///
    /// # Errors
    /// As [`ZarrVolume::create`]; [`VolumeError::Occupied`] where `folder` holds another volume.
    pub fn resume(
        target: &Path,
        folder: &Path,
        description: VolumeDescription,
    ) -> Result<Self, VolumeError> {
        check_target(target)?;
        let volume = Self {
            target: target.to_owned(),
            folder: folder.to_owned(),
            temporary: None,
            description,
        };
        let group = folder.join("zarr.json");
        if group.exists() {
            volume.check()?;
            for (name, document) in metadata::documents(&volume.description) {
                let path = folder.join(name).join("zarr.json");
                let found = std::fs::read(&path).map_err(VolumeError::io(&path))?;
                if found != text(&document) {
                    return Err(VolumeError::Occupied {
                        path: folder.to_owned(),
                        reason: "holds a volume of another description; remove it, or give the settings that it \
                                 was begun with"
                            .to_owned(),
                    });
                }
            }
            remove_leftovers(folder).map_err(VolumeError::io(folder))?;
        } else {
            std::fs::create_dir_all(folder).map_err(VolumeError::io(folder))?;
            volume.begin()?;
        }
        Ok(volume)
    }

    /// Writes everything but the densities; the whole's own file last.
    fn begin(&self) -> Result<(), VolumeError> {
        self.check()?;
        let axes = &self.description.axes;
        for (name, values) in [("x", &axes.x), ("y", &axes.y), ("z", &axes.z)] {
            let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
            write(&self.folder.join(name).join("c/0"), &bytes)?;
        }
        for (name, document) in metadata::documents(&self.description) {
            write(&self.folder.join(name).join("zarr.json"), &text(&document))?;
        }
        Ok(())
    }

    fn check(&self) -> Result<(), VolumeError> {
        let VolumeDescription { axes, chunk, frame, metres_per_unit, .. } = &self.description;
        let wrong =
            |reason: String| Err(VolumeError::Description { path: self.target.clone(), reason });
        let points = |sizes: &[usize; 3]| sizes.iter().try_fold(1_usize, |n, s| n.checked_mul(*s));
        if axes.shape().contains(&0) {
            return wrong(format!("it has {:?} points", axes.shape()));
        }
        // gzip states sizes below 4 GB.
        if chunk.contains(&0) || points(chunk).is_none_or(|count| count > 1 << 28) {
            return wrong(format!("chunks of {chunk:?} points are none, or above 1 GB"));
        }
        let numbers = [&axes.x, &axes.y, &axes.z].into_iter().flatten().chain(metres_per_unit);
        if let Some(number) = numbers.into_iter().find(|number| !number.is_finite()) {
            return wrong(format!("a coordinate is {number}"));
        }
        match frame {
            Frame::Map(crs) if crs.epsg.is_none() && crs.wkt.is_none() => {
                wrong(format!("its CRS `{}` has neither a code nor a definition", crs.name))
            }
            _ => Ok(()),
        }
    }

    /// Points along x, y and z.
    #[must_use]
    pub fn shape(&self) -> [usize; 3] {
        self.description.axes.shape()
    }

    /// Points along x, y and z of one chunk. Regions of whole chunks are written without being read back.
    #[must_use]
    pub fn chunk(&self) -> [usize; 3] {
        self.description.chunk
    }

    /// Writes a region: `size` points from `start` on, z fastest, over all cores. Points that were written before
    /// are replaced.
    ///
    /// # Errors
    /// [`VolumeError::Region`], [`VolumeError::Io`], [`VolumeError::Chunk`] for a damaged chunk that the region
    /// covers in part.
    pub fn write_region(
        &mut self,
        start: [usize; 3],
        size: [usize; 3],
        values: &[f32],
    ) -> Result<(), VolumeError> {
        self.check_region(start, size, values.len())?;
        let results: Vec<_> = self
            .chunks_of(start, size)
            .into_par_iter()
            .map(|part| self.write_part(&part, start, size, values))
            .collect();
        results.into_iter().collect()
    }

    /// Reads a region back, NaN where nothing was written.
    ///
    /// # Errors
    /// As [`ZarrVolume::write_region`].
    pub fn read_region(
        &self,
        start: [usize; 3],
        size: [usize; 3],
    ) -> Result<Vec<f32>, VolumeError> {
        let count = size.iter().try_fold(1_usize, |n, s| n.checked_mul(*s));
        self.check_region(start, size, count.unwrap_or(usize::MAX))?;
        let mut values = vec![f32::NAN; count.unwrap_or_default()];
        for part in self.chunks_of(start, size) {
            let Some(stored) = self.read_chunk(part.index)? else { continue };
            part.for_each_run(start, size, self.description.chunk, |region, chunk, length| {
                values[region..region + length].copy_from_slice(&stored[chunk..chunk + length]);
            });
        }
        Ok(values)
    }

    fn check_region(
        &self,
        start: [usize; 3],
        size: [usize; 3],
        values: usize,
    ) -> Result<(), VolumeError> {
        let shape = self.shape();
        let inside = (0..3).all(|axis| {
            let end = start[axis].checked_add(size[axis]);
            end.is_some_and(|end| end <= shape[axis])
        });
        let count = size.iter().try_fold(1_usize, |n, s| n.checked_mul(*s));
        if inside && count == Some(values) {
            return Ok(());
        }
        Err(VolumeError::Region { path: self.target.clone(), start, size, values, shape })
    }

    /// The chunks that a region touches, with what of it lies in each.
    fn chunks_of(&self, start: [usize; 3], size: [usize; 3]) -> Vec<Part> {
        let chunk = self.description.chunk;
        if size.contains(&0) {
            return Vec::new();
        }
        let range = |axis: usize| {
            start[axis] / chunk[axis]..(start[axis] + size[axis]).div_ceil(chunk[axis])
        };
        let mut parts = Vec::new();
        for i in range(0) {
            for j in range(1) {
                for k in range(2) {
                    let index = [i, j, k];
                    let first: [usize; 3] =
                        std::array::from_fn(|a| (index[a] * chunk[a]).max(start[a]));
                    let end: [usize; 3] = std::array::from_fn(|a| {
                        ((index[a] + 1) * chunk[a]).min(start[a] + size[a])
                    });
                    parts.push(Part { index, first, end });
                }
            }
        }
        parts
    }

    fn write_part(
        &self,
        part: &Part,
        start: [usize; 3],
        size: [usize; 3],
        values: &[f32],
    ) -> Result<(), VolumeError> {
        let (chunk, shape) = (self.description.chunk, self.shape());
        // Beyond the volume's edge there is nothing to keep.
        let whole = (0..3).all(|axis| {
            let first = part.index[axis] * chunk[axis];
            let end = (first + chunk[axis]).min(shape[axis]);
            part.first[axis] == first && part.end[axis] == end
        });
        let kept = if whole { None } else { self.read_chunk(part.index)? };
        let mut stored = kept.unwrap_or_else(|| vec![f32::NAN; chunk.iter().product()]);
        part.for_each_run(start, size, chunk, |region, at, length| {
            stored[at..at + length].copy_from_slice(&values[region..region + length]);
        });
        for value in &mut stored {
            // One NaN for all, whatever made it.
            if value.is_nan() {
                *value = f32::NAN;
            }
        }
        let path = self.chunk_path(part.index);
        if stored.iter().all(|value| value.is_nan()) {
            return match std::fs::remove_file(&path) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => {
                    Err(VolumeError::Io { path, source: error })
                }
                _ => Ok(()),
            };
        }
        write(&path, &chunk::encode(&stored, self.description.compression))
    }

    fn chunk_path(&self, [i, j, k]: [usize; 3]) -> PathBuf {
        self.folder.join(format!("density/c/{i}/{j}/{k}"))
    }

    fn read_chunk(&self, index: [usize; 3]) -> Result<Option<Vec<f32>>, VolumeError> {
        let path = self.chunk_path(index);
        let bytes = match std::fs::read(&path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(VolumeError::Io { path, source }),
        };
        let count = self.description.chunk.iter().product();
        chunk::decode(&bytes, count, self.description.compression)
            .map(Some)
            .map_err(|reason| VolumeError::Chunk { path, reason })
    }

    /// Puts the volume in its place.
    ///
    /// # Errors
    /// [`VolumeError::Io`]; what stood there before stands there still.
    pub fn finish(mut self) -> Result<(), VolumeError> {
        sync_tree(&self.folder).map_err(VolumeError::io(&self.folder))?;
        check_target(&self.target)?;
        let parent = parent_of(&self.target).to_owned();
        // A folder cannot be renamed onto one that holds files: the old one steps aside first.
        let aside = if self.target.exists() {
            let name = self.target.file_name().unwrap_or_default().to_string_lossy();
            let aside = tempfile::Builder::new()
                .prefix(&format!(".{name}."))
                .suffix(".old")
                .tempdir_in(&parent)
                .map_err(VolumeError::io(&parent))?;
            let old = aside.path().join("volume");
            std::fs::rename(&self.target, &old).map_err(VolumeError::io(&self.target))?;
            Some((aside, old))
        } else {
            None
        };
        if let Err(source) = std::fs::rename(&self.folder, &self.target) {
            if let Some((_, old)) = &aside {
                // Best effort: the error that counts is the first one.
                let _ = std::fs::rename(old, &self.target);
            }
            return Err(VolumeError::Io { path: self.target, source });
        }
        if let Some(temporary) = self.temporary.take() {
            // Its folder is elsewhere now.
            let _ = temporary.keep();
        }
        sync_folder(&parent).map_err(VolumeError::io(&parent))
    }
}

/// What of a region lies in one chunk.
struct Part {
    index: [usize; 3],
    first: [usize; 3],
    end: [usize; 3],
}

impl Part {
    /// Runs along z: where each begins in the region and in the chunk, and how long it is.
    fn for_each_run(
        &self,
        start: [usize; 3],
        size: [usize; 3],
        chunk: [usize; 3],
        mut run: impl FnMut(usize, usize, usize),
    ) {
        let flat = |point: [usize; 3], from: [usize; 3], size: [usize; 3]| {
            let [x, y, z]: [usize; 3] = std::array::from_fn(|axis| point[axis] - from[axis]);
            (x * size[1] + y) * size[2] + z
        };
        let corner = std::array::from_fn(|axis| self.index[axis] * chunk[axis]);
        for x in self.first[0]..self.end[0] {
            for y in self.first[1]..self.end[1] {
                let point = [x, y, self.first[2]];
                let length = self.end[2] - self.first[2];
                run(flat(point, start, size), flat(point, corner, chunk), length);
            }
        }
    }
}

fn text(document: &serde_json::Value) -> Vec<u8> {
    let mut bytes = format!("{document:#}").into_bytes();
    bytes.push(b'\n');
    bytes
}

/// Writes a file whole, and the folders above it.
fn write(path: &Path, bytes: &[u8]) -> Result<(), VolumeError> {
    let file = || -> io::Result<()> {
        std::fs::create_dir_all(parent_of(path))?;
        let mut file = AtomicFile::create(path)?;
        file.file().write_all(bytes)?;
        file.commit()
    };
    file().map_err(VolumeError::io(path))
}

fn parent_of(path: &Path) -> &Path {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    }
}

/// Only an older volume may stand where a volume will.
fn check_target(target: &Path) -> Result<(), VolumeError> {
    let occupied = |reason: &str| {
        Err(VolumeError::Occupied { path: target.to_owned(), reason: reason.to_owned() })
    };
    if target.file_name().is_none() {
        return occupied("is no name for a volume");
    }
    let Ok(metadata) = std::fs::metadata(target) else { return Ok(()) };
    if !metadata.is_dir() {
        return occupied("is a file; a Zarr volume is a folder: give another name or remove it");
    }
    let empty = std::fs::read_dir(target).is_ok_and(|mut entries| entries.next().is_none());
    if empty || target.join("zarr.json").is_file() {
        return Ok(());
    }
    occupied("is a folder that holds no Zarr volume; give another name or remove it")
}

/// What a killed run was writing.
fn remove_leftovers(folder: &Path) -> io::Result<()> {
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        if entry.file_type()?.is_dir() {
            remove_leftovers(&entry.path())?;
        } else if entry.file_name().to_string_lossy().ends_with(".part") {
            std::fs::remove_file(entry.path())?;
        }
    }
    Ok(())
}

/// Makes the names in all folders durable; the files are already.
fn sync_tree(folder: &Path) -> io::Result<()> {
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        if entry.file_type()?.is_dir() {
            sync_tree(&entry.path())?;
        }
    }
    sync_folder(folder)
}
