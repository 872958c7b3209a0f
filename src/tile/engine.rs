//! The order of work: windows in bands across the shorter side, and lines handed on as soon as no further
//! window counts for them.

use super::TileError;
use super::city::{Along, City};
use super::layout::{AxisWindow, AxisWindows, WINDOW};
use super::sums::{Columns, Sums};
use crate::batch::Interrupt;
use crate::model::Image8;
use crate::model::render::DensityGrid;
use crate::plan::runs;
use std::io;
use std::ops::Range;
use std::path::Path;

/// Lines whose validity is looked up at a time.
const MASK_LINES: u32 = 64;
/// A column whose windows sum up to less lacks some of them: those without any valid pixel.
const WHOLE: f32 = 1.0 - 1e-5;

/// The picture at model resolution, in any order.
pub trait WindowSource: Sync {
    /// A window from a pixel on, RGB, and which of its pixels hold data. Beyond the picture's edge it goes on
    /// as its mirror image.
    ///
    /// # Errors
    /// The picture cannot be read.
    fn window(&self, x: i64, y: i64) -> io::Result<(Image8, Vec<bool>)>;

    /// Which pixels of a rectangle (columns, rows) hold data, row-major; `None` where all do.
    ///
    /// # Errors
    /// The picture cannot be read.
    fn valid(&self, rectangle: [Range<u32>; 2]) -> io::Result<Option<Vec<bool>>>;
}

/// What makes densities out of a window: the network, or a stand-in with a known answer.
pub trait WindowModel: Sync {
    /// Densities of the window's columns, [`WINDOW`] x [`WINDOW`] x the city's levels.
    ///
    /// # Errors
    /// What the network says, in words.
    fn densities(&self, picture: &Image8, start: [i64; 2]) -> Result<DensityGrid, String>;
}

/// What takes the finished lines.
pub trait LineSink {
    /// The next line's averaged densities, `across x levels`, NaN where the picture has no data.
    ///
    /// # Errors
    /// Whatever keeps the run from going on.
    fn line(&mut self, line: u32, densities: &[f32]) -> Result<(), TileError>;

    /// A window whose first line is this was run, or left out for want of data.
    fn window(&mut self, first_line: u32, run: bool);
}

/// Windows, averages, lines.
pub struct Engine<'a> {
    /// The lattice.
    pub city: &'a City,
    /// Windows along x and along y.
    pub windows: &'a [AxisWindows; 2],
    /// The picture.
    pub source: &'a dyn WindowSource,
    /// The network.
    pub model: &'a dyn WindowModel,
    /// Folder for the sums of open lines; in memory where there is none.
    pub spill: Option<&'a Path>,
    /// Looked at before each window.
    pub stop: &'a Interrupt,
    /// Called after each window.
    pub progress: &'a (dyn Fn() + Sync),
}

/// Whether all lines were made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// All.
    Complete,
    /// A stop was asked for.
    Stopped,
}

impl Engine<'_> {
    fn along_and_across(&self) -> [&AxisWindows; 2] {
        let [x, y] = self.windows;
        match self.city.along {
            Along::X => [x, y],
            Along::Y => [y, x],
        }
    }

    /// Windows that have to be run for a range of lines.
    #[must_use]
    pub fn count(&self, lines: &Range<u32>) -> usize {
        let [along, across] = self.along_and_across();
        along.touching(lines).len() * across.all().len()
    }

    /// Makes these lines, in order. A line's values do not depend on which others are made.
    ///
    /// # Errors
    /// [`TileError`] of the picture, the network, the file of sums or the sink.
    pub fn run(&self, lines: Range<u32>, sink: &mut dyn LineSink) -> Result<Outcome, TileError> {
        let [along, across] = self.along_and_across();
        let [_, width] = self.city.lines_across();
        let levels = self.city.levels.z.len();
        let open = WINDOW.min(lines.len() as u32);
        runs("spill");
        let mut sums = match self.spill {
            None => Sums::in_memory(open, width, levels),
            Some(folder) => Sums::in_file(folder, open, width, levels)
                .map_err(TileError::io("make a file of sums in", folder))?,
        };
        let mut lines_out = Lines { engine: self, next: lines.start, mask: None };
        for band in &along.all()[along.touching(&lines)] {
            let part = band.pixels.start.max(lines.start)..band.pixels.end.min(lines.end);
            lines_out.until(part.start, &mut sums, sink)?;
            for window in across.all() {
                if self.stop.requested() {
                    return Ok(Outcome::Stopped);
                }
                self.window(band, window, part.clone(), &mut sums, sink)?;
                (self.progress)();
            }
        }
        lines_out.until(lines.end, &mut sums, sink)?;
        Ok(Outcome::Complete)
    }

    fn window(
        &self,
        band: &AxisWindow,
        window: &AxisWindow,
        lines: Range<u32>,
        sums: &mut Sums,
        sink: &mut dyn LineSink,
    ) -> Result<(), TileError> {
        let along = self.city.along;
        let start = match along {
            Along::X => [band.start, window.start],
            Along::Y => [window.start, band.start],
        };
        let (picture, valid) =
            self.source.window(start[0], start[1]).map_err(TileError::picture)?;
        let some = valid.iter().any(|valid| *valid);
        sink.window(band.start.max(0) as u32, some);
        if !some {
            return Ok(());
        }
        let [x, y] = start;
        let grid = (self.model.densities(&picture, start)).map_err(|reason| TileError::Window {
            x,
            y,
            reason,
        })?;
        let expected = [WINDOW as usize, WINDOW as usize, self.city.levels.z.len()];
        if grid.shape() != expected {
            let reason = format!("densities of {:?} points, not {expected:?}", grid.shape());
            return Err(TileError::Window { x, y, reason });
        }
        if self.windows.iter().any(|axis| axis.all().len() > 1) {
            runs("blend");
        }
        let columns = OfWindow { values: &grid.values, levels: expected[2], along, band, window };
        sums.add(lines, window.pixels.clone(), &columns).map_err(TileError::sums)
    }
}

/// A window's densities as lines and columns across.
struct OfWindow<'a> {
    /// x slowest, then y, then z.
    values: &'a [f32],
    levels: usize,
    along: Along,
    band: &'a AxisWindow,
    window: &'a AxisWindow,
}

impl Columns for OfWindow<'_> {
    fn column(&self, line: u32, across: u32) -> (&[f32], f32) {
        let place = |window: &AxisWindow, pixel: u32| {
            let inside = (i64::from(pixel) - window.start) as usize;
            (inside, window.weights[(pixel - window.pixels.start) as usize])
        };
        let (l, along_weight) = place(self.band, line);
        let (a, across_weight) = place(self.window, across);
        let [x, y] = if self.along == Along::X { [l, a] } else { [a, l] };
        let column = (x * WINDOW as usize + y) * self.levels;
        (&self.values[column..][..self.levels], along_weight * across_weight)
    }
}

/// Hands lines on.
struct Lines<'a> {
    engine: &'a Engine<'a>,
    next: u32,
    /// Validity of some lines, `lines x across`.
    mask: Option<(Range<u32>, Option<Vec<bool>>)>,
}

impl Lines<'_> {
    /// All lines before `end`.
    fn until(
        &mut self,
        end: u32,
        sums: &mut Sums,
        sink: &mut dyn LineSink,
    ) -> Result<(), TileError> {
        let levels = self.engine.city.levels.z.len();
        let (mut densities, mut weights) = (Vec::new(), Vec::new());
        while self.next < end {
            let line = self.next;
            sums.take(line, &mut densities, &mut weights).map_err(TileError::sums)?;
            let valid = self.valid(line)?;
            for (at, (column, weight)) in
                densities.chunks_exact_mut(levels).zip(&weights).enumerate()
            {
                if *weight <= 0.0 || valid.is_some_and(|valid| !valid[at]) {
                    column.fill(f32::NAN);
                } else if *weight < WHOLE {
                    for value in column {
                        *value /= weight;
                    }
                }
            }
            sink.line(line, &densities)?;
            self.next += 1;
        }
        Ok(())
    }

    fn valid(&mut self, line: u32) -> Result<Option<&[bool]>, TileError> {
        let city = self.engine.city;
        let [end, across] = city.lines_across();
        if !self.mask.as_ref().is_some_and(|(lines, _)| lines.contains(&line)) {
            let lines = line..(line + MASK_LINES).min(end);
            let rectangle = match city.along {
                Along::X => [lines.clone(), 0..across],
                Along::Y => [0..across, lines.clone()],
            };
            let mut mask = self.engine.source.valid(rectangle).map_err(TileError::picture)?;
            if let (Some(valid), Along::X) = (&mut mask, city.along) {
                let rows = std::mem::take(valid);
                let width = lines.len();
                *valid = (0..rows.len())
                    .map(|at| rows[at % across as usize * width + at / across as usize])
                    .collect();
            }
            self.mask = Some((lines, mask));
        }
        let Some((lines, Some(mask))) = &self.mask else { return Ok(None) };
        let first = (line - lines.start) as usize * across as usize;
        Ok(Some(&mask[first..][..across as usize]))
    }
}
