//! Resizing by Pillow's bicubic kernel in a stream: the same bytes as
//! [`resize_bicubic`](crate::model::preprocess::resize_bicubic) of the whole picture, in the memory of a
//! few rows.

use super::{Picture, PictureError};
use crate::model::preprocess::{Taps, bicubic_taps, blend_rows, resize_row};
use rayon::prelude::*;

/// What is made of the pixels under the kernel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    /// Their weighted sum.
    Colours,
    /// 255 where all that have a weight are not 0, else 0.
    Validity,
}

/// Resizes a picture whose rows are given from the top.
#[derive(Debug)]
pub struct BicubicRows {
    kind: Kind,
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
            kind: Kind::Colours,
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

    /// Masks of one byte a pixel: a pixel of the target is 255 (valid) exactly where every pixel of the source that
    /// the kernel gives a weight, along both axes, is not 0, so that no colour of a valid pixel has a part
    /// from one without data.
    ///
    /// # Panics
    /// When a side is 0.
    #[must_use]
    pub fn validity(source: [usize; 2], target: [usize; 2]) -> Self {
        Self { kind: Kind::Validity, ..Self::new(source, target, 1) }
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
        let (channels, kind) = (self.channels, self.kind);
        self.held[start..].par_chunks_exact_mut(to).zip(rows.par_chunks_exact(from)).for_each(
            |(out, row)| match kind {
                Kind::Colours => resize_row(row, channels, taps, out),
                Kind::Validity => valid_row(row, taps, out),
            },
        );
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
        let (held, first, made, kind) = (&self.held, self.first, self.made, self.kind);
        let rows = self.rows.as_deref();
        out[..ready * to].par_chunks_exact_mut(to).enumerate().for_each(|(i, out)| {
            let at = |row: usize| (row - first) * to;
            match rows {
                Some(rows) => {
                    let taps = &rows[made + i];
                    let held = held[at(taps.first)..].chunks_exact(to);
                    match kind {
                        Kind::Colours => blend_rows(held, &taps.weights, out),
                        Kind::Validity => valid_rows(held, &taps.weights, out),
                    }
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

/// The mask of one row after the first pass.
fn valid_row(row: &[u8], taps: &[Taps], out: &mut [u8]) {
    // Most rows have data everywhere or nowhere.
    if let Some(value) = uniform(row) {
        out.fill(value);
        return;
    }
    for (out, taps) in out.iter_mut().zip(taps) {
        let mut under = taps.weights.iter().zip(&row[taps.first..]);
        *out = if under.all(|(weight, valid)| *weight == 0 || *valid != 0) { 255 } else { 0 };
    }
}

/// The mask of one row after the second pass, from the rows under the kernel.
fn valid_rows<'a>(rows: impl Iterator<Item = &'a [u8]>, weights: &[i32], out: &mut [u8]) {
    out.fill(255);
    for (row, _) in rows.zip(weights).filter(|(_, weight)| **weight != 0) {
        for (out, valid) in out.iter_mut().zip(row) {
            *out = if *valid == 0 { 0 } else { *out };
        }
    }
}

/// 255 or 0 for a mask that is valid, or not, throughout.
fn uniform(row: &[u8]) -> Option<u8> {
    let valid = *row.first()? != 0;
    row.iter().all(|value| (*value != 0) == valid).then_some(if valid { 255 } else { 0 })
}

/// A picture resized while it is read.
#[derive(Debug)]
pub struct ResampledPicture {
    picture: Picture,
    rows: BicubicRows,
    /// Of a picture with a mask, once the mask is asked for.
    valid_rows: Option<BicubicRows>,
    read: u32,
    buffer: Vec<u8>,
    valid_buffer: Vec<u8>,
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
        let (buffer, valid_buffer) = (Vec::new(), Vec::new());
        Self { picture, rows, valid_rows: None, read: 0, buffer, valid_buffer }
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
        self.advance(out, None)
    }

    /// As [`ResampledPicture::next_rows`], the same colours, and into `valid`, one byte a pixel, 255 where the pixel
    /// is made of pixels with data alone ([`BicubicRows::validity`]) and 0 elsewhere: as many rows as fit into both.
    ///
    /// # Errors
    /// Those of [`Picture::read_rows`].
    ///
    /// # Panics
    /// When the picture has a mask and rows were taken before without it.
    pub fn next_rows_masked(
        &mut self,
        out: &mut [u8],
        valid: &mut [u8],
    ) -> Result<usize, PictureError> {
        if self.picture.has_mask() && self.valid_rows.is_none() {
            assert!(self.read == 0, "rows were taken without their mask");
            self.valid_rows = Some(BicubicRows::validity(self.rows.source, self.rows.target));
        }
        self.advance(out, Some(valid))
    }

    fn advance(
        &mut self,
        out: &mut [u8],
        mut valid: Option<&mut [u8]>,
    ) -> Result<usize, PictureError> {
        let (row, pixels) = (self.rows.row_bytes(), self.rows.target[0]);
        let fit = valid.as_ref().map_or(usize::MAX, |valid| valid.len() / pixels);
        let wanted = (out.len() / row).min(fit).min(self.rows_left());
        let mut done = 0;
        while done < wanted {
            let lacking = self.rows.wanted(1);
            if lacking > 0 {
                self.read_more(lacking)?;
            }
            let made = self.rows.take(&mut out[done * row..wanted * row]);
            if let Some(rows) = &mut self.valid_rows {
                // In step with the colours, whether they are asked for or not.
                let mut unused = Vec::new();
                let out = match &mut valid {
                    Some(valid) => &mut valid[done * pixels..(done + made) * pixels],
                    None => {
                        unused.resize(made * pixels, 0);
                        &mut unused[..]
                    }
                };
                rows.take(out);
            } else if let Some(valid) = &mut valid {
                valid[done * pixels..(done + made) * pixels].fill(255);
            }
            done += made;
        }
        Ok(done)
    }

    /// Gives at least `lacking` more rows of the picture to the kernel.
    fn read_more(&mut self, lacking: usize) -> Result<(), PictureError> {
        let [width, height] = self.picture.size();
        // Up to the next edge of the file's own strips or tiles: each is decoded once.
        let band = self.picture.block()[1].max(1);
        let needed = self.read.saturating_add(u32::try_from(lacking).unwrap_or(u32::MAX));
        let end = needed.div_ceil(band).saturating_mul(band).min(height);
        let pixels = (end - self.read) as usize * width as usize;
        self.buffer.resize(pixels * 3, 0);
        if let Some(rows) = &mut self.valid_rows {
            self.valid_buffer.resize(pixels, 0);
            let (rgb, valid) = (&mut self.buffer, &mut self.valid_buffer);
            self.picture.read_rows_masked(self.read..end, rgb, valid)?;
            rows.give(valid);
        } else {
            self.picture.read_rows(self.read..end, &mut self.buffer)?;
        }
        self.read = end;
        self.rows.give(&self.buffer);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Beside the plain statement of it, pixel by pixel.
        #[test]
        fn a_valid_pixel_has_no_part_from_one_without_data(
            source in (1_usize..40, 1_usize..40), target in (1_usize..40, 1_usize..40),
            holes in proptest::collection::vec((0_usize..40, 0_usize..40), 0..6),
            band in 1_usize..9,
        ) {
            let (source, target) = ([source.0, source.1], [target.0, target.1]);
            let mut valid = vec![255; source[0] * source[1]];
            for (x, y) in &holes {
                valid[(y % source[1]) * source[0] + x % source[0]] = 0;
            }
            let mut rows = BicubicRows::validity(source, target);
            let mut found = vec![7; target[0] * target[1]];
            let mut done = 0;
            for part in valid.chunks(band * source[0]) {
                rows.give(part);
                done += rows.take(&mut found[done * target[0]..]);
            }
            prop_assert_eq!(done, target[1]);
            let taps = |axis: usize| {
                if source[axis] == target[axis] {
                    (0..source[axis]).map(|first| Taps { first, weights: vec![1] }).collect()
                } else {
                    bicubic_taps(source[axis], target[axis])
                }
            };
            let (columns, lines) = (taps(0), taps(1));
            for (i, value) in found.iter().enumerate() {
                let (column, line) = (&columns[i % target[0]], &lines[i / target[0]]);
                let mut expected = 255;
                for (y, down) in line.weights.iter().enumerate() {
                    for (x, across) in column.weights.iter().enumerate() {
                        let at = (line.first + y) * source[0] + column.first + x;
                        if *down != 0 && *across != 0 && valid[at] == 0 {
                            expected = 0;
                        }
                    }
                }
                prop_assert_eq!(*value, expected, "pixel {}", i);
            }
        }
    }
}
