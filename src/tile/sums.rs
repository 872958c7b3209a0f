//! Sums of weighted densities for the lines that are still open, in memory or in a file.
//!
//! A ring of lines: line l has the place l modulo the ring's length. Both stores hold the same
//! numbers, added in the same order.

use rayon::prelude::*;
use std::fs::File;
use std::io;
use std::ops::Range;
use std::os::unix::fs::FileExt;
use std::path::Path;

enum Store {
    Memory(Vec<f32>),
    File(File),
}

/// A ring of lines of `across x levels` sums, with the weight that went into each column.
pub struct Sums {
    store: Store,
    /// Weights so far: lines x across.
    weights: Vec<f32>,
    lines: usize,
    across: usize,
    levels: usize,
}

impl std::fmt::Debug for Sums {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let place = if matches!(self.store, Store::File(_)) { "file" } else { "memory" };
        f.debug_struct("Sums")
            .field("in", &place)
            .field("lines", &self.lines)
            .finish_non_exhaustive()
    }
}

/// What a window adds: densities and weights of its columns.
pub trait Columns: Sync {
    /// Densities of a column, from the lowest level, and its weight.
    fn column(&self, line: u32, across: u32) -> (&[f32], f32);
}

impl Sums {
    /// Bytes of the sums of one line.
    #[must_use]
    pub const fn line_bytes(across: u32, levels: usize) -> u64 {
        across as u64 * levels as u64 * 4
    }

    /// A ring in memory.
    #[must_use]
    pub fn in_memory(lines: u32, across: u32, levels: usize) -> Self {
        let (lines, across) = (lines as usize, across as usize);
        let store = Store::Memory(vec![0.0; lines * across * levels]);
        Self { store, weights: vec![0.0; lines * across], lines, across, levels }
    }

    /// A ring in a file of `folder` that has no name and vanishes with the program.
    ///
    /// # Errors
    /// The file cannot be made or is larger than the disk.
    pub fn in_file(folder: &Path, lines: u32, across: u32, levels: usize) -> io::Result<Self> {
        let file = tempfile::tempfile_in(folder)?;
        let (lines, across) = (lines as usize, across as usize);
        file.set_len((lines * across * levels * 4) as u64)?;
        let weights = vec![0.0; lines * across];
        Ok(Self { store: Store::File(file), weights, lines, across, levels })
    }

    /// Adds a window's columns, weight times density.
    ///
    /// # Errors
    /// Those of the file.
    ///
    /// # Panics
    /// When there are more lines than the ring has.
    pub fn add(
        &mut self,
        lines: Range<u32>,
        across: Range<u32>,
        columns: &impl Columns,
    ) -> io::Result<()> {
        assert!(lines.len() <= self.lines, "{lines:?} in a ring of {}", self.lines);
        let (ring, width, levels) = (self.lines, self.across, self.levels);
        let line_of = |place: usize| {
            let ahead = (place + ring - lines.start as usize % ring) % ring;
            let line = lines.start + ahead as u32;
            (line < lines.end).then_some(line)
        };
        let part = across.start as usize * levels..across.end as usize * levels;
        let sum = |line: u32, sums: &mut [f32]| {
            for (sums, at) in sums.chunks_exact_mut(levels).zip(across.clone()) {
                let (densities, weight) = columns.column(line, at);
                for (sum, density) in sums.iter_mut().zip(densities) {
                    *sum += weight * density;
                }
            }
        };
        match &mut self.store {
            Store::Memory(sums) => {
                sums.par_chunks_exact_mut(width * levels).enumerate().for_each(|(place, sums)| {
                    if let Some(line) = line_of(place) {
                        sum(line, &mut sums[part.clone()]);
                    }
                });
            }
            Store::File(file) => {
                let file = &*file;
                lines.clone().into_par_iter().try_for_each_init(Vec::new, |bytes, line| {
                    let place = (line as usize % ring * width * levels + part.start) * 4;
                    let mut sums = vec![0.0; part.len()];
                    read(file, place as u64, bytes, &mut sums)?;
                    sum(line, &mut sums);
                    write(file, place as u64, bytes, &sums)
                })?;
            }
        }
        for line in lines {
            let first = line as usize % ring * width;
            for at in across.clone() {
                self.weights[first + at as usize] += columns.column(line, at).1;
            }
        }
        Ok(())
    }

    /// Takes a line out: its sums, and the weight of each column. Its place is empty afterwards.
    ///
    /// # Errors
    /// Those of the file.
    pub fn take(
        &mut self,
        line: u32,
        sums: &mut Vec<f32>,
        weights: &mut Vec<f32>,
    ) -> io::Result<()> {
        let length = self.across * self.levels;
        let place = line as usize % self.lines;
        let of_line = &mut self.weights[place * self.across..][..self.across];
        weights.clear();
        weights.extend_from_slice(of_line);
        of_line.fill(0.0);
        sums.resize(length, 0.0);
        match &mut self.store {
            Store::Memory(all) => {
                let stored = &mut all[place * length..][..length];
                sums.copy_from_slice(stored);
                stored.fill(0.0);
            }
            Store::File(file) => {
                let mut bytes = Vec::new();
                let at = (place * length * 4) as u64;
                read(file, at, &mut bytes, sums)?;
                bytes.fill(0);
                file.write_all_at(&bytes, at)?;
            }
        }
        Ok(())
    }
}

fn read(file: &File, at: u64, bytes: &mut Vec<u8>, values: &mut [f32]) -> io::Result<()> {
    bytes.resize(values.len() * 4, 0);
    file.read_exact_at(bytes, at)?;
    for (value, bytes) in values.iter_mut().zip(bytes.as_chunks::<4>().0) {
        *value = f32::from_le_bytes(*bytes);
    }
    Ok(())
}

fn write(file: &File, at: u64, bytes: &mut Vec<u8>, values: &[f32]) -> io::Result<()> {
    bytes.clear();
    bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    file.write_all_at(bytes, at)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Densities that tell where they were taken.
    struct Stub {
        levels: Vec<Vec<f32>>,
        across: Range<u32>,
        first: u32,
        weight: f32,
    }

    impl Columns for Stub {
        fn column(&self, line: u32, across: u32) -> (&[f32], f32) {
            let width = self.across.len();
            let at = (line - self.first) as usize * width + (across - self.across.start) as usize;
            (&self.levels[at], self.weight)
        }
    }

    fn stub(lines: &Range<u32>, across: &Range<u32>, weight: f32) -> Stub {
        let value = |line: u32, at: u32| vec![line as f32, at as f32, weight];
        let levels =
            lines.clone().flat_map(|line| across.clone().map(move |at| value(line, at))).collect();
        Stub { levels, across: across.clone(), first: lines.start, weight }
    }

    #[test]
    fn a_line_takes_four_bytes_for_each_level_of_each_column() {
        assert_eq!(Sums::line_bytes(7, 3), 84);
    }

    #[test]
    fn memory_and_file_hold_the_same_and_places_are_used_again() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut stores =
            [Sums::in_memory(5, 7, 3), Sums::in_file(folder.path(), 5, 7, 3).expect("a file")];
        let mut seen = Vec::new();
        for sums in &mut stores {
            let mut lines = Vec::new();
            for first in 0..9_u32 {
                for (across, weight) in [(0..4, 0.5), (2..7, 0.25)] {
                    let range = first..first + 4;
                    sums.add(range.clone(), across.clone(), &stub(&range, &across, weight))
                        .expect("adds");
                }
                let (mut line, mut weights) = (Vec::new(), Vec::new());
                sums.take(first, &mut line, &mut weights).expect("takes");
                lines.push((line, weights));
            }
            seen.push(lines);
        }
        assert_eq!(seen[0], seen[1]);
        // Line 8 was added to by four bands; column 3 lies in both parts, column 6 in one.
        let (line, weights) = &seen[0][8];
        assert_eq!((weights[3], weights[6]), (3.0, 1.0));
        assert_eq!(line[3 * 3..][..3], [24.0, 9.0, 4.0 * (0.25 + 0.0625)]);
    }
}
