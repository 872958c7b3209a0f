//! Which decoder reads a file, by its first bytes.

use super::{Access, PictureError, PictureOptions, jpeg, png_rows};
#[cfg(feature = "gdal")]
use crate::raster::GdalColours;
use crate::raster::{OpenOptions, RasterError, RasterHeader, Rectangle, TiffColours};
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// A decoder that gives rows from the top.
pub(super) trait RowSource: Send {
    /// The next row, three bytes a pixel. Of a source with a mask, `valid` becomes 255 where the pixel has data
    /// and 0 where it has none; a source without one leaves it alone.
    fn next_row(&mut self, out: &mut [u8], valid: Option<&mut [u8]>) -> Result<(), String>;

    /// Whether there can be pixels without data.
    fn has_mask(&self) -> bool {
        false
    }

    /// Goes back to the top, if that costs nothing.
    fn rewind(&mut self) -> bool;
}

/// A decoder that gives any rectangle.
pub(super) enum Blocks {
    Tiff(Box<TiffColours>),
    #[cfg(feature = "gdal")]
    Gdal(Box<GdalColours>),
}

impl Blocks {
    pub(super) fn header(&self) -> &RasterHeader {
        match self {
            Self::Tiff(colours) => colours.header(),
            #[cfg(feature = "gdal")]
            Self::Gdal(colours) => colours.header(),
        }
    }

    pub(super) fn has_mask(&self) -> bool {
        match self {
            Self::Tiff(colours) => colours.has_mask(),
            #[cfg(feature = "gdal")]
            Self::Gdal(colours) => colours.has_mask(),
        }
    }

    pub(super) fn read(
        &mut self,
        rectangle: Rectangle,
        out: &mut [u8],
        valid: Option<&mut [u8]>,
    ) -> Result<(), RasterError> {
        match self {
            Self::Tiff(colours) => colours.read(rectangle, out, valid),
            #[cfg(feature = "gdal")]
            Self::Gdal(colours) => colours.read(rectangle, out, valid),
        }
    }
}

/// What the first bytes say.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Format {
    Png,
    Jpeg,
    Tiff,
    /// Whatever GDAL makes of it.
    #[cfg(feature = "gdal")]
    Other,
}

/// Finds the format.
pub(super) fn format_of(path: &Path) -> Result<Format, PictureError> {
    let io = |source| PictureError::Io { path: path.to_owned(), source };
    let unreadable = |reason: &str| PictureError::Unreadable {
        path: path.to_owned(),
        reason: reason.to_owned(),
    };
    if std::fs::metadata(path).map_err(io)?.is_dir() {
        return Err(unreadable("is a folder, not a picture"));
    }
    let mut start = Vec::new();
    File::open(path).and_then(|file| file.take(8).read_to_end(&mut start)).map_err(io)?;
    if start.is_empty() {
        return Err(unreadable("the file is empty (0 bytes)"));
    }
    if start == b"\x89PNG\r\n\x1a\n" {
        return Ok(Format::Png);
    }
    if start.starts_with(&[0xFF, 0xD8, 0xFF]) {
        return Ok(Format::Jpeg);
    }
    if [b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"].iter().any(|magic| start.starts_with(*magic)) {
        return Ok(Format::Tiff);
    }
    let bytes: Vec<_> = start.iter().map(|byte| format!("{byte:02x}")).collect();
    let none = format!("is neither PNG nor JPEG nor TIFF: it starts with {}", bytes.join(" "));
    #[cfg(feature = "gdal")]
    {
        let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
        let own = ["png", "jpg", "jpeg", "tif", "tiff"];
        if own.iter().any(|name| extension.eq_ignore_ascii_case(name)) {
            return Err(unreadable(&none));
        }
        Ok(Format::Other)
    }
    #[cfg(not(feature = "gdal"))]
    Err(unreadable(&format!("{none}; other formats need a build with GDAL")))
}

/// A decoder of rows with columns and rows, and the order in which it can be read.
pub(super) type OpenRows = (Box<dyn RowSource>, [u32; 2], Access);

/// Opens a PNG or JPEG.
pub(super) fn open_rows(
    path: &Path,
    format: Format,
    options: &PictureOptions,
) -> Result<OpenRows, PictureError> {
    let file =
        File::open(path).map_err(|source| PictureError::Io { path: path.to_owned(), source })?;
    let limit = options.memory_limit;
    let unreadable = |reason| PictureError::Unreadable { path: path.to_owned(), reason };
    let access = |whole: bool| if whole { Access::Whole } else { Access::Rows };
    Ok(if format == Format::Png {
        let rows = png_rows::PngRows::open(file, limit).map_err(unreadable)?;
        let (size, access) = ([rows.width, rows.height], access(rows.interlaced));
        (Box::new(rows), size, access)
    } else {
        let rows = jpeg::JpegRows::open(file, limit).map_err(unreadable)?;
        let (size, access) = ([rows.width, rows.height], access(rows.whole));
        (Box::new(rows), size, access)
    })
}

/// Opens a TIFF, or whatever GDAL reads. A TIFF that the reader in pure Rust has is read by it in every
/// build; only the others go to GDAL.
pub(super) fn open_blocks(
    path: &Path,
    format: Format,
    options: &PictureOptions,
) -> Result<Blocks, PictureError> {
    let limit = usize::try_from(options.memory_limit).unwrap_or(usize::MAX);
    let options = OpenOptions { memory_limit: limit, ..OpenOptions::default() };
    #[cfg(feature = "gdal")]
    {
        if format == Format::Tiff
            && let Ok(colours) = TiffColours::open(path, &options)
        {
            return Ok(Blocks::Tiff(Box::new(colours)));
        }
        Ok(Blocks::Gdal(Box::new(GdalColours::open(path, &options)?)))
    }
    #[cfg(not(feature = "gdal"))]
    {
        debug_assert_eq!(format, Format::Tiff);
        Ok(Blocks::Tiff(Box::new(TiffColours::open(path, &options)?)))
    }
}
