//! Resizing by Pillow's bicubic kernel in a stream: the same bytes as
//! [`resize_bicubic`](crate::model::preprocess::resize_bicubic) of the whole picture, in the memory of a
//! few rows.

use super::{Picture, PictureError};
use crate::model::preprocess::{Taps, bicubic_taps, blend_rows, resize_row};
use rayon::prelude::*;

/// Resizes a picture whose rows are given from the top.
#[derive(Debug)]
pub struct BicubicRows {
    channels: usize,
    source: [usize; 2],
    target: [usize; 2],
    /// `None` where the width stays.
    columns: Option<Vec<Taps>>,
    /// `None` where the height stays.
    rows: Option<Vec<Taps>>,
    /// Rows of the target's width, from `first` on, that are still looked at.
    held: Vec<u8>,
    first: usize,
    /// Rows given and rows made so far.
    given: usize,
    made: usize,
}

impl BicubicRows {
    /// From `source` to `target` columns and rows of `channels` bytes a pixel.
    ///
    /// # Panics
    /// When a side or the number of channels is 0.
    #[must_use]
    pub fn new(source: [usize; 2], target: [usize; 2], channels: usize) -> Self {
        let empty = source.contains(&0) || target.contains(&0) || channels == 0;
        assert!(!empty, "{source:?} to {target:?} pixels of {channels} channels");
        let taps = |axis: usize| {
            (source[axis] != target[axis]).then(|| bicubic_taps(source[axis], target[axis]))
        };
        Self {
            channels,
            source,
            target,
            columns: taps(0),
            rows: taps(1),
            held: Vec::new(),
            first: 0,
            given: 0,
            made: 0,
        }
    }

    /// Bytes of a row of the target.
    #[must_use]
    pub fn row_bytes(&self) -> usize {
        self.target[0] * self.channels
    }

    /// How many of the source's rows have to be given before `count` more rows can be taken.
    #[must_use]
    pub fn wanted(&self, count: usize) -> usize {
        let last = (self.made + count).min(self.target[1]);
        let Some(last) = last.checked_sub(1).filter(|last| *last >= self.made) else { return 0 };
        let end = match &self.rows {
            Some(rows) => rows[last].first + rows[last].weights.len(),
            None => last + 1,
        };
        end.saturating_sub(self.given)
    }

    /// Takes the next rows of the source.
    ///
    /// # Panics
    /// When `rows` are no whole rows, or more than there are.
    pub fn give(&mut self, rows: &[u8]) {
        let from = self.source[0] * self.channels;
        let count = rows.len() / from;
        assert!(rows.len() == count * from, "{} bytes are no rows of {from}", rows.len());
        assert!(self.given + count <= self.source[1], "more than {} rows", self.source[1]);
        self.given += count;
        let Some(taps) = &self.columns else {
            self.held.extend_from_slice(rows);
            return;
        };
        let (to, start) = (self.row_bytes(), self.held.len());
        self.held.resize(start + count * to, 0);
        let channels = self.channels;
        self.held[start..]
            .par_chunks_exact_mut(to)
            .zip(rows.par_chunks_exact(from))
            .for_each(|(out, row)| resize_row(row, channels, taps, out));
    }

    /// Makes the next rows, as many as fit into `out` and can be made of what was given; returns how many.
    pub fn take(&mut self, out: &mut [u8]) -> usize {
        let to = self.row_bytes();
        let wanted = (out.len() / to).min(self.target[1] - self.made);
        let reach = |row: usize| match &self.rows {
            Some(rows) => rows[row].first + rows[row].weights.len(),
            None => row + 1,
        };
        let ready = (0..wanted).take_while(|i| reach(self.made + i) <= self.given).count();
        let (held, first, made) = (&self.held, self.first, self.made);
        let rows = self.rows.as_deref();
        out[..ready * to].par_chunks_exact_mut(to).enumerate().for_each(|(i, out)| {
            let at = |row: usize| (row - first) * to;
            match rows {
                Some(rows) => {
                    let taps = &rows[made + i];
                    blend_rows(held[at(taps.first)..].chunks_exact(to), &taps.weights, out);
                }
                None => out.copy_from_slice(&held[at(made + i)..][..to]),
            }
        });
        self.made += ready;
        let needed = match &self.rows {
            Some(rows) => rows.get(self.made).map_or(self.given, |taps| taps.first),
            None => self.made,
        };
        let done = needed.min(self.given).saturating_sub(self.first);
        self.held.drain(..done * to);
        self.first += done;
        ready
    }
}

/// A picture resized while it is read.
#[derive(Debug)]
pub struct ResampledPicture {
    picture: Picture,
    rows: BicubicRows,
    read: u32,
    buffer: Vec<u8>,
}

impl ResampledPicture {
    /// The picture at another size.
    ///
    /// # Panics
    /// When a side of `size` is 0.
    #[must_use]
    pub fn new(picture: Picture, size: [u32; 2]) -> Self {
        let rows = BicubicRows::new(
            picture.size().map(|side| side as usize),
            size.map(|side| side as usize),
            3,
        );
        Self { picture, rows, read: 0, buffer: Vec::new() }
    }

    /// The picture that is read.
    #[must_use]
    pub fn picture(&self) -> &Picture {
        &self.picture
    }

    /// Columns and rows after resizing.
    #[must_use]
    pub fn size(&self) -> [usize; 2] {
        self.rows.target
    }

    /// Rows that were not read yet.
    #[must_use]
    pub fn rows_left(&self) -> usize {
        self.rows.target[1] - self.rows.made
    }

    /// Reads the next rows into `out`, three bytes a pixel: as many as fit. Returns how many; 0 at the end.
    ///
    /// # Errors
    /// Those of [`Picture::read_rows`].
    pub fn next_rows(&mut self, out: &mut [u8]) -> Result<usize, PictureError> {
        let row = self.rows.row_bytes();
        let wanted = (out.len() / row).min(self.rows_left());
        let mut done = 0;
        while done < wanted {
            let lacking = self.rows.wanted(1);
            if lacking > 0 {
                let [width, height] = self.picture.size();
                // Up to the next edge of the file's own strips or tiles: each is decoded once.
                let band = self.picture.block()[1].max(1);
                let needed = self.read.saturating_add(u32::try_from(lacking).unwrap_or(u32::MAX));
                let end = needed.div_ceil(band).saturating_mul(band).min(height);
                self.buffer.resize((end - self.read) as usize * width as usize * 3, 0);
                self.picture.read_rows(self.read..end, &mut self.buffer)?;
                self.read = end;
                self.rows.give(&self.buffer);
            }
            done += self.rows.take(&mut out[done * row..wanted * row]);
        }
        Ok(done)
    }
}
