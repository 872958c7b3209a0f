//! Finished lines become finished slabs: heights, colours, surface, volume, a line in the journal.

use super::TileError;
use super::city::{Along, City};
use super::column::ColumnIntegral;
use super::engine::LineSink;
use super::record::SlabRecord;
use super::slabs::{Kind, file_name};
use super::spool::Spool;
use super::surface::sink::SlabMesher;
use super::surface::store;
use super::volume::{VolumeSink, chunk_files};
use crate::batch::{Journal, OutputFile, write_atomic};
use crate::plan::runs;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Where slabs go.
pub struct SlabWriter<'a> {
    /// The lattice.
    pub city: &'a City,
    /// The output folder.
    pub out: &'a Path,
    /// Colours and validity.
    pub spool: &'a Spool,
    /// Isovalue of the surface, where one is made.
    pub isovalue: Option<f64>,
    /// The volume, where one is made.
    pub volume: Option<VolumeSink>,
    /// The volume's folder relative to the output folder, where its files are listed with the slabs: in shards,
    /// which are joined by these lists.
    pub listed_volume: Option<String>,
    /// Fingerprint of the picture.
    pub inputs: &'a str,
    /// Journal of this shard.
    pub journal: &'a mut Journal<SlabRecord>,
    /// Records of finished slabs.
    pub finished: Vec<SlabRecord>,
    /// Windows run.
    pub windows_run: u64,
    integral: ColumnIntegral,
    open: Option<Open>,
    /// The line before the next one.
    before: Option<(u32, Vec<f32>)>,
    /// Windows run and left out, by the slab in which they begin.
    windows: BTreeMap<u32, [u64; 2]>,
    /// The first slab that is wanted; the line before it only primes the mesher.
    first: u32,
}

/// The slab that is being made.
struct Open {
    slab: u32,
    /// Line by line, as they came.
    heights: Vec<f32>,
    no_data: u64,
    mesher: Option<SlabMesher>,
}

/// What a [`SlabWriter`] needs to know.
pub struct Setting<'a> {
    /// The lattice.
    pub city: &'a City,
    /// The output folder.
    pub out: &'a Path,
    /// Colours and validity.
    pub spool: &'a Spool,
    /// Isovalue of the surface, where one is made.
    pub isovalue: Option<f64>,
    /// Fingerprint of the picture.
    pub inputs: &'a str,
}

impl<'a> SlabWriter<'a> {
    /// A writer of the slabs from `first` on.
    pub fn new(setting: &Setting<'a>, first: u32, journal: &'a mut Journal<SlabRecord>) -> Self {
        let Setting { city, out, spool, isovalue, inputs } = *setting;
        Self {
            city,
            out,
            spool,
            isovalue,
            volume: None,
            listed_volume: None,
            inputs,
            journal,
            finished: Vec::new(),
            windows_run: 0,
            integral: ColumnIntegral::new(city),
            open: None,
            before: None,
            windows: BTreeMap::new(),
            first,
        }
    }

    fn begin(&mut self, slab: u32) -> Result<Open, TileError> {
        let mut mesher = match self.isovalue {
            Some(isovalue) => {
                runs("surface");
                Some(SlabMesher::new(self.city, slab, isovalue)?)
            }
            None => None,
        };
        if let (Some(mesher), Some((_, before))) = (&mut mesher, &self.before) {
            mesher.prime(before)?;
        }
        Ok(Open { slab, heights: Vec::new(), no_data: 0, mesher })
    }

    fn finish(&mut self, open: Open) -> Result<(), TileError> {
        let Open { slab, heights, no_data, mesher } = open;
        let mut record = SlabRecord::new(slab, self.inputs);
        let rectangle = self.city.rectangle(slab);
        let [width, height] = [0, 1].map(|axis| rectangle[axis].len());
        // Row by row, whichever way the lines ran.
        let rows: Vec<f32> = match self.city.along {
            Along::Y => heights,
            Along::X => {
                (0..width * height).map(|at| heights[at % width * height + at / width]).collect()
            }
        };
        describe(&mut record, &rows);
        record.no_data = no_data;
        let [run, empty] = self.windows.remove(&slab).unwrap_or_default();
        (record.windows, record.empty_windows) = (run, empty);
        let (colours, _) = self.spool.rectangle(rectangle).map_err(TileError::picture)?;
        let bytes: Vec<u8> = rows.iter().flat_map(|height| height.to_le_bytes()).collect();
        let mut files = vec![(Kind::Heights, bytes), (Kind::Colours, colours)];
        if let Some(mesher) = mesher {
            let tiles = mesher.finish()?;
            record.triangles = tiles.iter().map(|(_, tile)| tile.triangles.len() as u64).sum();
            files.push((Kind::Surface, store::encode(slab, &tiles)));
        }
        for (kind, bytes) in files {
            let name = file_name(slab, kind);
            let path = self.out.join(&name);
            write_atomic(&path, &bytes).map_err(TileError::io("write", &path))?;
            record.outputs.push(OutputFile::of(&name, &bytes));
        }
        if let Some(folder) = &self.listed_volume {
            let below: PathBuf = self.out.join(folder);
            for file in chunk_files(self.city, slab, &below) {
                let path = below.join(&file);
                let bytes = std::fs::read(&path).map_err(TileError::io("read", &path))?;
                record.outputs.push(OutputFile::of(&format!("{folder}/{file}"), &bytes));
            }
        }
        self.journal.record(vec![record.clone()])?;
        self.finished.push(record);
        Ok(())
    }
}

impl LineSink for SlabWriter<'_> {
    fn line(&mut self, line: u32, densities: &[f32]) -> Result<(), TileError> {
        let slab = line / super::city::SLAB;
        if slab < self.first {
            self.before = Some((line, densities.to_vec()));
            return Ok(());
        }
        let mut open = match self.open.take() {
            Some(open) => open,
            None => self.begin(slab)?,
        };
        let levels = self.city.levels.z.len();
        let no_data = densities.chunks_exact(levels).filter(|column| column[0].is_nan()).count();
        open.no_data += no_data as u64;
        open.heights.extend(self.integral.heights(densities));
        if let Some(mesher) = &mut open.mesher {
            mesher.push(line, densities)?;
        }
        if let Some(volume) = &mut self.volume {
            runs("volume");
            volume.push(line, densities)?;
        }
        if line + 1 == self.city.lines(slab).end {
            self.finish(open)?;
            self.before = Some((line, densities.to_vec()));
        } else {
            self.open = Some(open);
        }
        Ok(())
    }

    fn window(&mut self, first_line: u32, run: bool) {
        self.windows_run += u64::from(run);
        let counts = self.windows.entry(first_line / super::city::SLAB).or_default();
        counts[usize::from(!run)] += 1;
    }
}

fn describe(record: &mut SlabRecord, heights: &[f32]) {
    record.columns = heights.len() as u64;
    let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
    for height in heights.iter().filter(|height| !height.is_nan()) {
        (low, high) = (low.min(*height), high.max(*height));
        record.sum_m += f64::from(*height);
        record.heights += 1;
    }
    if record.heights > 0 {
        (record.min_m, record.max_m) = (Some(f64::from(low)), Some(f64::from(high)));
    }
}
