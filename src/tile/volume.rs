//! The density volume, written while the lines come.

use super::city::{Along, City};
use super::slabs::FOLDER;
use crate::batch::Shard;
use crate::volume::{Axes, Frame, VolumeDescription, VolumeError, ZarrVolume};
use std::path::{Path, PathBuf};

/// Lines and columns of one chunk of the volume.
const CHUNK: u32 = 64;

/// What the volume is: its axes, on the map where the city's place is known.
///
/// # Errors
/// The place cannot be used; in words.
pub fn describe(
    city: &City,
    metres_per_unit: [f64; 3],
    weights: Option<&str>,
) -> Result<VolumeDescription, String> {
    let [columns, rows] = city.size;
    let z = city.levels.z.iter().map(|z| city.height_m(f64::from(*z))).collect();
    let on_map = city.grid().filter(|grid| grid.crs.epsg.is_some() || grid.crs.wkt.is_some());
    let (axes, frame) = match on_map {
        Some(grid) => {
            let c = grid.geotransform.0;
            let x = (0..columns).map(|i| c[0] + (f64::from(i) + 0.5) * c[1]).collect();
            let y = (0..rows).map(|j| c[3] + (f64::from(j) + 0.5) * c[5]).collect();
            (Axes { x, y, z }, Frame::Map(grid.crs))
        }
        None => {
            let [across, down] = city.gsd_m();
            let place = |index: u32, count: u32, step: f64| {
                (f64::from(index) + 0.5 - f64::from(count) / 2.0) * step
            };
            let x = (0..columns).map(|i| place(i, columns, across)).collect();
            let y = (0..rows).map(|j| place(j, rows, -down)).collect();
            let center = |error: &dyn std::fmt::Display| error.to_string();
            let georeference = city.footprint.georeference().map_err(|error| center(&error))?;
            let origin = georeference.map(|place| place.center()).transpose();
            (Axes { x, y, z }, Frame::Local { origin: origin.map_err(|error| center(&error))? })
        }
    };
    let mut description = VolumeDescription::new(axes, frame, metres_per_unit);
    let software = format!("sat3d {}", env!("CARGO_PKG_VERSION"));
    description.attributes.insert("software".into(), software.into());
    if let Some(hash) = weights {
        description.attributes.insert("weights_sampled_sha256".into(), hash.into());
    }
    Ok(description)
}

/// The folder in which a shard's part of the volume grows, in the output folder.
#[must_use]
pub fn folder_name(shard: Shard) -> String {
    format!("{FOLDER}/volume.{}-of-{}.zarr", shard.index, shard.count)
}

/// Writes lines as they come.
#[derive(Debug)]
pub struct VolumeSink {
    volume: ZarrVolume,
    along: Along,
    across: u32,
    levels: usize,
    /// Lines that wait for a row of chunks to be whole.
    waiting: Vec<f32>,
    first: u32,
    count: u32,
    end: u32,
}

impl VolumeSink {
    /// Begins or continues the volume in the folder of a shard.
    ///
    /// # Errors
    /// [`VolumeError`].
    pub fn new(
        city: &City,
        target: &Path,
        folder: &Path,
        description: VolumeDescription,
    ) -> Result<Self, VolumeError> {
        let [end, across] = city.lines_across();
        Ok(Self {
            volume: ZarrVolume::resume(target, folder, description)?,
            along: city.along,
            across,
            levels: city.levels.z.len(),
            waiting: Vec::new(),
            first: 0,
            count: 0,
            end,
        })
    }

    /// Takes the next line of the slabs.
    ///
    /// # Errors
    /// [`VolumeError`].
    pub fn push(&mut self, line: u32, densities: &[f32]) -> Result<(), VolumeError> {
        if self.count == 0 {
            self.first = line;
        }
        self.waiting.extend_from_slice(densities);
        self.count += 1;
        let next = line + 1;
        if next.is_multiple_of(CHUNK) || next == self.end { self.flush() } else { Ok(()) }
    }

    fn flush(&mut self) -> Result<(), VolumeError> {
        let (lines, levels) = (self.count as usize, self.levels);
        let width = self.across as usize;
        for from in (0..self.across).step_by(CHUNK as usize) {
            let columns = (self.across - from).min(CHUNK) as usize;
            let mut block = Vec::with_capacity(lines * columns * levels);
            let column = |line: usize, at: usize| {
                &self.waiting[(line * width + from as usize + at) * levels..][..levels]
            };
            let (start, size) = match self.along {
                Along::X => {
                    for line in 0..lines {
                        (0..columns).for_each(|at| block.extend_from_slice(column(line, at)));
                    }
                    ([self.first, from], [lines, columns])
                }
                Along::Y => {
                    for at in 0..columns {
                        (0..lines).for_each(|line| block.extend_from_slice(column(line, at)));
                    }
                    ([from, self.first], [columns, lines])
                }
            };
            let start = [start[0] as usize, start[1] as usize, 0];
            self.volume.write_region(start, [size[0], size[1], levels], &block)?;
        }
        self.waiting.clear();
        self.count = 0;
        Ok(())
    }
}

/// Files of a slab's chunks below a volume's folder, relative to it, that are there.
#[must_use]
pub fn chunk_files(city: &City, slab: u32, folder: &Path) -> Vec<String> {
    let [x, y] = city.rectangle(slab);
    let chunks = |range: &std::ops::Range<u32>| range.start / CHUNK..range.end.div_ceil(CHUNK);
    let mut files = Vec::new();
    for i in chunks(&x) {
        for j in chunks(&y) {
            for k in 0..city.levels.z.len().div_ceil(CHUNK as usize) {
                let file = format!("density/c/{i}/{j}/{k}");
                if folder.join(&file).exists() {
                    files.push(file);
                }
            }
        }
    }
    files
}

/// Puts the volume together out of the parts of all shards, and in its place.
///
/// # Errors
/// [`VolumeError`].
pub fn finish(
    city: &City,
    out: &Path,
    target: &Path,
    description: VolumeDescription,
) -> Result<(), VolumeError> {
    let io = |path: &Path| {
        let path = path.to_owned();
        move |source| VolumeError::Io { path, source }
    };
    let slabs = out.join(FOLDER);
    let mut parts: Vec<PathBuf> = Vec::new();
    for item in std::fs::read_dir(&slabs).map_err(io(&slabs))? {
        let path = item.map_err(io(&slabs))?.path();
        if path.extension().is_some_and(|end| end == "zarr") {
            parts.push(path);
        }
    }
    parts.sort_unstable();
    let whole = slabs.join("volume.zarr");
    let volume = ZarrVolume::resume(target, &whole, description)?;
    for part in parts.iter().filter(|part| **part != whole) {
        for slab in 0..city.slabs() {
            for file in chunk_files(city, slab, part) {
                let to = whole.join(&file);
                if let Some(folder) = to.parent() {
                    std::fs::create_dir_all(folder).map_err(io(folder))?;
                }
                std::fs::rename(part.join(&file), &to).map_err(io(&to))?;
            }
        }
    }
    volume.finish()
}
