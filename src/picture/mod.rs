//! Satellite pictures: RGB pixels in windows, and where on Earth they lie.
//!
//! PNG and JPEG are read row by row in pure Rust, TIFF in strips or tiles (by GDAL where the build has
//! it), everything else by GDAL. Nothing is ever held as a whole but interlaced PNG and progressive JPEG,
//! whose rows do not come in order. See `docs/pictures.md`.

mod georeference;
mod jpeg;
mod mask;
mod png_rows;
mod resample;
mod source;

pub use resample::{BicubicRows, ResampledPicture};

use crate::crs::CrsError;
use crate::footprint::{Footprint, FootprintError, Place};
use crate::model::Image8;
use crate::raster::{RasterError, Rectangle};
use source::{Blocks, Format, RowSource, format_of, open_blocks, open_rows};
use std::ops::Range;
use std::path::{Path, PathBuf};

/// How a picture is opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PictureOptions {
    /// Most bytes that one strip or tile may take, or a whole picture where it has to be held.
    pub memory_limit: u64,
}

impl Default for PictureOptions {
    fn default() -> Self {
        Self { memory_limit: 1 << 30 }
    }
}

/// In what order a picture can be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// Any window, at the cost of the strips or tiles that it touches.
    Windows,
    /// Rows from the top. A step back begins at the top again.
    Rows,
    /// Any window, once the whole picture is decoded, which the first reading does: interlaced PNG (its
    /// pixels are held) and progressive JPEG (its coefficients are held, two bytes a sample).
    Whole,
}

/// A part of a picture, pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    /// First column.
    pub x: u32,
    /// First row.
    pub y: u32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// Why a picture cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum PictureError {
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is no picture, is damaged before its pixels, or uses something that is not read.
    #[error("{}: {reason}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What is wrong and what to do.
        reason: String,
    },
    /// Pixels are damaged or missing. Of a raster in strips or tiles, the row is the first of the block.
    #[error("{}: row {row} of {height} cannot be read: {reason}", path.display())]
    Row {
        /// The file.
        path: PathBuf,
        /// The row, from 0.
        row: u32,
        /// Rows of the picture.
        height: u32,
        /// What is wrong.
        reason: String,
    },
    /// The whole picture is asked for and does not fit.
    #[error(
        "{}: a picture of {width} x {height} pixels takes {bytes} bytes as a whole, and {limit} are allowed; \
         `sat3d tile` reads pictures of any size",
        path.display()
    )]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
        /// What the pixels take.
        bytes: u64,
        /// What is allowed.
        limit: u64,
    },
    /// A window reaches beyond the picture, or a buffer has another size than the window.
    #[error("{}: {what}", path.display())]
    Window {
        /// The file.
        path: PathBuf,
        /// Both sizes.
        what: String,
    },
    /// Where the picture lies cannot be used.
    #[error("{}: {reason}", path.display())]
    Georeference {
        /// The file.
        path: PathBuf,
        /// What is wrong and what to do.
        reason: String,
    },
    /// The picture's coordinate reference system cannot be served.
    #[error("{}: {source}", path.display())]
    Crs {
        /// The file.
        path: PathBuf,
        /// Why.
        source: CrsError,
    },
    /// A ground sample distance that is none.
    #[error(
        "a ground sample distance of {gsd} m makes no sense; give metres per pixel (0.1 for VIGOR's images)"
    )]
    Gsd {
        /// What was given.
        gsd: f64,
    },
    /// A raster that cannot be read.
    #[error(transparent)]
    Raster(#[from] RasterError),
}

enum Source {
    Rows { rows: Box<dyn RowSource>, next: u32 },
    Blocks(Blocks),
}

/// An open picture.
pub struct Picture {
    path: PathBuf,
    options: PictureOptions,
    size: [u32; 2],
    place: Option<Place>,
    warnings: Vec<String>,
    format: Format,
    access: Access,
    source: Source,
}

impl std::fmt::Debug for Picture {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Picture")
            .field("path", &self.path)
            .field("size", &self.size)
            .field("place", &self.place)
            .field("access", &self.access)
            .finish_non_exhaustive()
    }
}

/// Pixels of a name and of a georeference are the same within this share: a name's are of the sphere, up to 0.7 % off.
const SAME_GSD: f64 = 0.01;

/// Opens a picture and reads its header; no pixels are read.
///
/// # Errors
/// [`PictureError`] for what is no picture, is damaged, or holds something else than 8-bit colours (16 bits in
/// PNG are rounded).
pub fn open(path: &Path) -> Result<Picture, PictureError> {
    open_with(path, &PictureOptions::default())
}

/// As [`open`], with other limits.
///
/// # Errors
/// As [`open`].
pub fn open_with(path: &Path, options: &PictureOptions) -> Result<Picture, PictureError> {
    let format = format_of(path)?;
    let mut warnings = Vec::new();
    let (source, size, access, place) = if matches!(format, Format::Png | Format::Jpeg) {
        let (rows, size, access) = open_rows(path, format, options)?;
        let place = georeference::from_side_files(path, &mut warnings)?;
        (Source::Rows { rows, next: 0 }, size, access, place)
    } else {
        let blocks = open_blocks(path, format, options)?;
        let header = blocks.header();
        warnings.extend(header.warnings.iter().cloned());
        let place = georeference::from_header(header, &mut warnings);
        let size = [header.width, header.height];
        (Source::Blocks(blocks), size, Access::Windows, place)
    };
    let (named, warning) = georeference::from_name(path, size);
    warnings.extend(warning);
    let mut picture = Picture {
        path: path.to_owned(),
        options: *options,
        size,
        place: None,
        warnings,
        format,
        access,
        source,
    };
    picture.place = match (named, place) {
        (Some(named), Some(own)) => Some(picture.which_place(named, own)),
        (named, own) => named.or(own),
    };
    Ok(picture)
}

impl Picture {
    /// The file.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Columns and rows.
    #[must_use]
    pub const fn size(&self) -> [u32; 2] {
        self.size
    }

    /// In what order it can be read.
    #[must_use]
    pub const fn access(&self) -> Access {
        self.access
    }

    /// Columns and rows of the pieces that are best read at once: those of the file's strips or tiles, small
    /// ones merged. Of [`Access::Rows`] and [`Access::Whole`], some whole rows.
    #[must_use]
    pub fn block(&self) -> [u32; 2] {
        /// Rows that are decoded one by one.
        const ROWS: u32 = 64;
        match &self.source {
            Source::Rows { .. } => [self.size[0], ROWS.min(self.size[1])],
            Source::Blocks(blocks) => {
                let header = blocks.header();
                [header.block_width, header.block_height]
            }
        }
    }

    /// Where it lies: what its name says (VIGOR's: zoom 20, the name is the centre), else what the file or
    /// those beside it say. Not checked for use: see [`Picture::footprint`].
    #[must_use]
    pub const fn place(&self) -> Option<&Place> {
        self.place.as_ref()
    }

    /// Things the user should know about the file.
    #[must_use]
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Place and size on the ground. `gsd_m`, metres per pixel across and down, overrides what the place
    /// says; a picture with neither is taken to be as wide as those of the training.
    ///
    /// # Errors
    /// [`PictureError::Georeference`] for a rotated grid and the like, [`PictureError::Crs`] for a CRS that
    /// this build cannot serve, [`PictureError::Gsd`] for a distance that is none.
    pub fn footprint(&self, gsd_m: Option<[f64; 2]>) -> Result<Footprint, PictureError> {
        if let Some(gsd) = gsd_m.into_iter().flatten().find(|gsd| !(*gsd > 0.0 && *gsd < 1e5)) {
            return Err(PictureError::Gsd { gsd });
        }
        let mut footprint = match &self.place {
            Some(place) => Footprint::of_place(self.size, place.clone())
                .map_err(|error| self.misplaced(error))?,
            None => Footprint::of_training(self.size),
        };
        if let Some(gsd) = gsd_m {
            footprint.gsd_m = gsd;
        }
        Ok(footprint)
    }

    fn misplaced(&self, error: FootprintError) -> PictureError {
        let path = self.path.clone();
        match error {
            FootprintError::Crs(source) => PictureError::Crs { path, source },
            other => PictureError::Georeference { path, reason: other.to_string() },
        }
    }

    /// The name's place, with a warning where the file disagrees; the file's own where both have the same centre and
    /// pixels of another size: of pixels the name says nothing, and zoom 20 is only what VIGOR's have.
    fn which_place(&mut self, named: Place, own: Place) -> Place {
        let known = |place: &Place| {
            let footprint = Footprint::of_place(self.size, place.clone()).ok()?;
            Some((footprint.georeference().ok()??.center().ok()?, footprint.gsd_m))
        };
        let (Some((a, named_gsd)), Some((b, own_gsd))) = (known(&named), known(&own)) else {
            return named;
        };
        let apart = crate::crs::ground_distance_m(a, b);
        if apart > 1.0 {
            self.warnings.push(format!(
                "the name and the file's georeference put the picture's centre {apart:.1} m apart; the name counts"
            ));
            return named;
        }
        let other = |k: usize| (own_gsd[k] / named_gsd[k] - 1.0).abs() > SAME_GSD;
        if other(0) || other(1) { own } else { named }
    }

    /// Reads the whole picture, RGB.
    ///
    /// # Errors
    /// [`PictureError::TooLarge`] beyond [`PictureOptions::memory_limit`]; what [`Picture::read_rows`] returns.
    pub fn read(&mut self) -> Result<Image8, PictureError> {
        let [width, height] = self.size;
        let (bytes, limit) = (u64::from(width) * u64::from(height) * 3, self.options.memory_limit);
        if bytes > limit {
            return Err(PictureError::TooLarge {
                path: self.path.clone(),
                width,
                height,
                bytes,
                limit,
            });
        }
        let mut data = vec![0; bytes as usize];
        self.read_rows(0..height, &mut data)?;
        Ok(Image8 { width: width as usize, height: height as usize, channels: 3, data })
    }

    /// Reads rows into `out`, three bytes a pixel. Of [`Access::Rows`], rows that are left out are decoded all
    /// the same.
    ///
    /// # Errors
    /// [`PictureError::Row`] for damaged pixels, [`PictureError::Window`] for rows that there are not, or an `out` of
    /// another size.
    pub fn read_rows(&mut self, rows: Range<u32>, out: &mut [u8]) -> Result<(), PictureError> {
        let window = Window {
            x: 0,
            y: rows.start,
            width: self.size[0],
            height: rows.end.saturating_sub(rows.start),
        };
        self.read_window(window, out)
    }

    /// Reads a window into `out`, three bytes a pixel.
    ///
    /// # Errors
    /// As [`Picture::read_rows`].
    pub fn read_window(&mut self, window: Window, out: &mut [u8]) -> Result<(), PictureError> {
        self.check(window, out.len())?;
        self.read_checked(window, out, None)
    }

    /// Reads a window that lies inside the picture, with its mask where the picture has one and `valid` is given.
    fn read_checked(
        &mut self,
        window: Window,
        out: &mut [u8],
        valid: Option<&mut [u8]>,
    ) -> Result<(), PictureError> {
        if window.width == 0 || window.height == 0 {
            return Ok(());
        }
        let rectangle = Rectangle {
            x: window.x as usize,
            y: window.y as usize,
            width: window.width as usize,
            height: window.height as usize,
        };
        match &mut self.source {
            Source::Blocks(blocks) => {
                blocks.read(rectangle, out, valid).map_err(|error| self.block_error(error))
            }
            Source::Rows { .. } => self.read_in_order(window, out, valid),
        }
    }

    /// A damaged strip or tile, by the first of its rows.
    fn block_error(&self, error: RasterError) -> PictureError {
        match error {
            RasterError::Block { path, column, row, reason } => PictureError::Row {
                path,
                row: row.saturating_mul(self.block()[1]),
                height: self.size[1],
                reason: format!("in block ({column}, {row}), {reason}"),
            },
            other => other.into(),
        }
    }

    fn check(&self, window: Window, bytes: usize) -> Result<(), PictureError> {
        let wrong = |what: String| Err(PictureError::Window { path: self.path.clone(), what });
        let Window { x, y, width, height } = window;
        let beyond = |from: u32, length: u32, size: u32| {
            u64::from(from) + u64::from(length) > u64::from(size)
        };
        if beyond(x, width, self.size[0]) || beyond(y, height, self.size[1]) {
            let [w, h] = self.size;
            return wrong(format!(
                "a window of {width} x {height} pixels from ({x}, {y}) reaches beyond the picture of {w} x {h}"
            ));
        }
        let wanted = u64::from(width) * u64::from(height) * 3;
        if wanted != bytes as u64 {
            return wrong(format!(
                "a window of {width} x {height} pixels takes {wanted} bytes, not {bytes}"
            ));
        }
        Ok(())
    }

    fn read_in_order(
        &mut self,
        window: Window,
        out: &mut [u8],
        valid: Option<&mut [u8]>,
    ) -> Result<(), PictureError> {
        let Source::Rows { rows, next } = &mut self.source else { return Ok(()) };
        if window.y < *next {
            if *next == u32::MAX || !rows.rewind() {
                *rows = open_rows(&self.path, self.format, &self.options)?.0;
            }
            *next = 0;
        }
        let width = self.size[0] as usize;
        let full = window.width as usize == width;
        let mut spare = if full && *next == window.y { Vec::new() } else { vec![0; width * 3] };
        let mut spare_valid = vec![0; if valid.is_some() { width } else { 0 }];
        let mut masks = valid.map(|valid| valid.chunks_exact_mut(window.width as usize));
        let mut read = || {
            while *next < window.y {
                rows.next_row(&mut spare, None)?;
                *next += 1;
            }
            for line in out.chunks_exact_mut(window.width as usize * 3) {
                let mask = masks.as_mut().and_then(Iterator::next);
                if full {
                    rows.next_row(line, mask)?;
                } else {
                    rows.next_row(&mut spare, mask.is_some().then_some(&mut spare_valid[..]))?;
                    line.copy_from_slice(&spare[window.x as usize * 3..][..line.len()]);
                    if let Some(mask) = mask {
                        mask.copy_from_slice(&spare_valid[window.x as usize..][..mask.len()]);
                    }
                }
                *next += 1;
            }
            Ok(())
        };
        let result: Result<(), String> = read();
        result.map_err(|reason| {
            // The decoder stands somewhere: whoever asks again begins at the top.
            let row = std::mem::replace(next, u32::MAX);
            PictureError::Row { path: self.path.clone(), row, height: self.size[1], reason }
        })
    }
}
