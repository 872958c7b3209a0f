//! RGB pixels of whatever GDAL reads.

use super::gdal_reader::explain;
use super::gdal_setup::set_up;
use super::header::Rectangle;
use super::tiff_colours::{UNNAMED, no_bytes};
use super::{GdalReader, OpenOptions, RasterError, RasterHeader, RasterReader};
use gdal::errors::GdalError;
use gdal::raster::{ColorInterpretation, GdalDataType, RasterBand};
use gdal::{Dataset, Metadata};
use std::path::Path;

/// What the samples of a pixel are; bands are counted from 1.
#[derive(Debug)]
enum Colours {
    Shade { white_is_zero: bool },
    Palette(Vec<[u8; 3]>),
    Rgb([usize; 3]),
}

/// What says that a pixel has no data, beside [`crate::picture`]'s rule. A pixel has none where all these masks
/// are 0, or alpha is.
#[derive(Debug, Default)]
struct Validity {
    /// Bands whose masks are looked at.
    masks: Vec<usize>,
    alpha: Option<usize>,
}

/// A raster of 8-bit bands as RGB. Alpha and masks change no colours.
#[derive(Debug)]
pub(crate) struct GdalColours {
    header: RasterHeader,
    dataset: Dataset,
    colours: Colours,
    validity: Validity,
}

impl GdalColours {
    /// Opens a raster and reads its header.
    ///
    /// # Errors
    /// [`RasterError`] when GDAL cannot open the file, when it holds no 8-bit colours, or when its blocks are
    /// beyond the memory allowed.
    pub(crate) fn open(path: &Path, options: &OpenOptions) -> Result<Self, RasterError> {
        set_up();
        let unreadable = |reason: String| RasterError::Unreadable { path: path.to_owned(), reason };
        // Whether it opens at all is for the reader below to say in full.
        if let Ok(dataset) = Dataset::open(path) {
            let bands = (1..=dataset.raster_count()).filter_map(|n| dataset.rasterband(n).ok());
            if let Some(band) = bands.into_iter().find(|band| !is_byte(band)) {
                return Err(unreadable(no_bytes(&band.band_type().name())));
            }
        }
        let mut header = GdalReader::open(path, options)?.header().clone();
        let dataset = Dataset::open(path).map_err(|error| unreadable(error.to_string()))?;
        let (colours, warning) = colours(&dataset).map_err(unreadable)?;
        header.warnings.extend(warning);
        let validity = validity(&dataset, &colours).map_err(|error| unreadable(explain(&error)))?;
        Ok(Self { header, dataset, colours, validity })
    }

    /// What the header says.
    pub(crate) fn header(&self) -> &RasterHeader {
        &self.header
    }

    /// Whether there can be pixels without data.
    pub(crate) fn has_mask(&self) -> bool {
        !self.validity.masks.is_empty() || self.validity.alpha.is_some()
    }

    /// Reads a rectangle: rows from the top, three bytes a pixel, and where it is asked for the mask: 255 where a
    /// pixel has data, 0 where it has none.
    ///
    /// # Errors
    /// [`RasterError::Block`] naming the block that could not be read.
    pub(crate) fn read(
        &mut self,
        rectangle: Rectangle,
        out: &mut [u8],
        mut valid: Option<&mut [u8]>,
    ) -> Result<(), RasterError> {
        let (width, height) = (self.header.block_width as usize, self.header.block_height as usize);
        let (right, bottom) = (rectangle.x + rectangle.width, rectangle.y + rectangle.height);
        // Block by block, so that the bands of one block come out of GDAL's cache.
        for by in rectangle.y / height..bottom.div_ceil(height) {
            for bx in rectangle.x / width..right.div_ceil(width) {
                let (x, y) = ((bx * width).max(rectangle.x), (by * height).max(rectangle.y));
                let part = Rectangle {
                    x,
                    y,
                    width: ((bx + 1) * width).min(right) - x,
                    height: ((by + 1) * height).min(bottom) - y,
                };
                let start = (y - rectangle.y) * rectangle.width + (x - rectangle.x);
                let valid = valid.as_deref_mut().map(|valid| &mut valid[start..]);
                self.read_part(part, &mut out[start * 3..], rectangle.width * 3)
                    .and_then(|()| match valid {
                        Some(valid) => self.mark_part(part, valid, rectangle.width),
                        None => Ok(()),
                    })
                    .map_err(|error| {
                        self.header.block_error(bx as u32, by as u32, explain(&error))
                    })?;
            }
        }
        Ok(())
    }

    /// Reads a part of a rectangle into rows that lie `stride` bytes apart.
    fn read_part(&self, part: Rectangle, out: &mut [u8], stride: usize) -> Result<(), GdalError> {
        let read = |band: usize| read_part(&self.dataset.rasterband(band)?, part);
        let mut put = |values: &[u8], convert: &dyn Fn(u8, &mut [u8])| {
            for (row, values) in values.chunks_exact(part.width).enumerate() {
                let out = &mut out[row * stride..][..part.width * 3];
                for (pixel, value) in out.chunks_exact_mut(3).zip(values) {
                    convert(*value, pixel);
                }
            }
        };
        match &self.colours {
            Colours::Shade { white_is_zero } => {
                let turn = if *white_is_zero { 255 } else { 0 };
                // 255 - v is v ^ 255.
                put(&read(1)?, &|value, pixel| pixel.fill(value ^ turn));
            }
            Colours::Palette(palette) => put(&read(1)?, &|value, pixel| {
                pixel.copy_from_slice(palette.get(usize::from(value)).unwrap_or(&[0; 3]));
            }),
            Colours::Rgb(bands) => {
                for (channel, band) in bands.iter().enumerate() {
                    put(&read(*band)?, &|value, pixel| pixel[channel] = value);
                }
            }
        }
        Ok(())
    }
}

impl GdalColours {
    /// Marks the pixels of a part of a rectangle, in rows that lie `stride` bytes apart.
    fn mark_part(&self, part: Rectangle, valid: &mut [u8], stride: usize) -> Result<(), GdalError> {
        let mut mask =
            vec![if self.validity.masks.is_empty() { 255 } else { 0 }; part.width * part.height];
        for number in &self.validity.masks {
            let band = self.dataset.rasterband(*number)?;
            let values = read_part(&band.open_mask_band()?, part)?;
            for (valid, value) in mask.iter_mut().zip(values) {
                *valid |= if value == 0 { 0 } else { 255 };
            }
        }
        if let Some(number) = self.validity.alpha {
            let alpha = read_part(&self.dataset.rasterband(number)?, part)?;
            for (valid, value) in mask.iter_mut().zip(alpha) {
                *valid = if value == 0 { 0 } else { *valid };
            }
        }
        for (row, values) in mask.chunks_exact(part.width).enumerate() {
            valid[row * stride..][..part.width].copy_from_slice(values);
        }
        Ok(())
    }
}

fn read_part(band: &RasterBand<'_>, part: Rectangle) -> Result<Vec<u8>, GdalError> {
    let origin = (isize::try_from(part.x)?, isize::try_from(part.y)?);
    let size = (part.width, part.height);
    Ok(band.read_as::<u8>(origin, size, size, None)?.into_shape_and_vec().1)
}

/// Which masks mark pixels.
fn validity(dataset: &Dataset, colours: &Colours) -> Result<Validity, GdalError> {
    let used = match colours {
        Colours::Rgb(bands) => bands.to_vec(),
        Colours::Shade { .. } | Colours::Palette(_) => vec![1],
    };
    let mut alpha = None;
    let mut plain = Vec::new();
    for number in 1..=dataset.raster_count() {
        let band = dataset.rasterband(number)?;
        if band.color_interpretation() == ColorInterpretation::AlphaBand && !used.contains(&number)
        {
            alpha = Some(number);
        } else {
            plain.push((number, band.mask_flags()?));
        }
    }
    // One mask for all bands: the file's own, or no-data values of all bands together.
    if let Some((number, flags)) = plain.first()
        && flags.is_per_dataset()
        && !flags.is_alpha()
    {
        let alpha = alpha.filter(|_| flags.is_nodata());
        return Ok(Validity { masks: vec![*number], alpha });
    }
    // A band that has data everywhere gives every pixel some.
    let masked = plain.iter().all(|(_, flags)| !flags.is_all_valid() && !flags.is_alpha());
    let masks =
        if masked { plain.into_iter().map(|(number, _)| number).collect() } else { Vec::new() };
    Ok(Validity { masks, alpha })
}

fn is_byte(band: &RasterBand<'_>) -> bool {
    let signed = band.metadata_item("PIXELTYPE", "IMAGE_STRUCTURE");
    band.band_type() == GdalDataType::UInt8 && signed.is_none_or(|kind| kind != "SIGNEDBYTE")
}

/// What the bands mean, and a warning where that is a guess.
fn colours(dataset: &Dataset) -> Result<(Colours, Option<String>), String> {
    let count = dataset.raster_count();
    let band = |number: usize| dataset.rasterband(number).map_err(|error| explain(&error));
    let mut kinds = Vec::new();
    for number in 1..=count {
        kinds.push(band(number)?.color_interpretation());
    }
    let find = |kind| kinds.iter().position(|found| *found == kind).map(|index| index + 1);
    use ColorInterpretation as Kind;
    if let (Some(red), Some(green), Some(blue)) =
        (find(Kind::RedBand), find(Kind::GreenBand), find(Kind::BlueBand))
    {
        return Ok((Colours::Rgb([red, green, blue]), None));
    }
    let first = band(1)?;
    if let Some(table) = first.color_table() {
        let mut palette = Vec::new();
        for index in 0..table.entry_count() {
            let entry = table.entry_as_rgb(index).ok_or("has a palette of no RGB colours")?;
            palette.push([entry.r, entry.g, entry.b].map(|value| value.clamp(0, 255) as u8));
        }
        return Ok((Colours::Palette(palette), None));
    }
    if let Some(bits) = first.metadata_item("NBITS", "IMAGE_STRUCTURE") {
        return Err(format!(
            "holds samples of {bits} bits; write it with 8: gdal_translate -ot Byte -scale in.tif out.tif"
        ));
    }
    let foreign = [Kind::CyanBand, Kind::HueBand, Kind::YCbCrSpaceYBand];
    if let Some(kind) = kinds.iter().find(|kind| foreign.contains(kind)) {
        return Err(format!(
            "stores its colours in another way than RGB, palette or shades (the first band is {kind:?}); \
             write it as RGB first"
        ));
    }
    let plain = kinds.iter().filter(|kind| **kind != Kind::AlphaBand).count();
    if plain >= 3 {
        return Ok((Colours::Rgb([1, 2, 3]), Some(UNNAMED.to_owned())));
    }
    let white_is_zero = first.metadata_item("MINISWHITE", "IMAGE_STRUCTURE").is_some()
        || dataset.metadata_item("MINISWHITE", "IMAGE_STRUCTURE").is_some();
    Ok((Colours::Shade { white_is_zero }, None))
}
