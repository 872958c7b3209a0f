//! Pixels without data.
//!
//! One rule for all formats. The first of these that a picture has decides:
//!
//! 1. a **mask** (a TIFF's internal mask, a `.msk` beside it, the mask band of a VRT): no data where it is 0;
//! 2. else **alpha** (a channel, a palette's or a colour's transparency in PNG, a raster's alpha band) and the
//!    **no-data value** of the bands together: no data where alpha is 0, and where every band but alpha
//!    equals its no-data value. A band without such a value never does.
//!
//! A pixel that is a little transparent has data. JPEG has none of these.

use super::{Picture, PictureError, Source, Window};
use std::ops::Range;

impl Picture {
    /// Whether there can be pixels without data: a mask, alpha or a no-data value. Whether there are any only
    /// reading shows.
    #[must_use]
    pub fn has_mask(&self) -> bool {
        match &self.source {
            Source::Rows { rows, .. } => rows.has_mask(),
            Source::Blocks(blocks) => blocks.has_mask(),
        }
    }

    /// As [`Picture::read_window`], the same colours, and into `valid`, one byte a pixel, 255 where the pixel has
    /// data and 0 where it has none. The colours of a pixel without data are what the file holds.
    ///
    /// # Errors
    /// As [`Picture::read_rows`].
    pub fn read_window_masked(
        &mut self,
        window: Window,
        rgb: &mut [u8],
        valid: &mut [u8],
    ) -> Result<(), PictureError> {
        self.check(window, rgb.len())?;
        let pixels = rgb.len() / 3;
        if valid.len() != pixels {
            let what =
                format!("a mask of {pixels} pixels takes {pixels} bytes, not {}", valid.len());
            return Err(PictureError::Window { path: self.path.clone(), what });
        }
        if self.has_mask() {
            self.read_checked(window, rgb, Some(valid))
        } else {
            valid.fill(255);
            self.read_checked(window, rgb, None)
        }
    }

    /// As [`Picture::read_rows`], with the mask of [`Picture::read_window_masked`].
    ///
    /// # Errors
    /// As [`Picture::read_rows`].
    pub fn read_rows_masked(
        &mut self,
        rows: Range<u32>,
        rgb: &mut [u8],
        valid: &mut [u8],
    ) -> Result<(), PictureError> {
        let height = rows.end.saturating_sub(rows.start);
        let window = Window { x: 0, y: rows.start, width: self.size[0], height };
        self.read_window_masked(window, rgb, valid)
    }
}
