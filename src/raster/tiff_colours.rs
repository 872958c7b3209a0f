//! RGB pixels of 8-bit GeoTIFFs in pure Rust.

use super::header::Rectangle;
use super::tiff_codec::{BandReader, Run, check_supported};
use super::tiff_directory::{MetadataItem, TiffFile, TiffImage, parse_nodata};
use super::tiff_reader::valid_pixels;
use super::{OpenOptions, RasterError, RasterHeader, RasterReader, TiffReader, beside};
use std::fs::File;

/// What the samples of a pixel are.
#[derive(Debug)]
enum Colours {
    /// One sample, taken for all three; the other way round where 0 is white.
    Shade { white_is_zero: bool },
    /// The first sample, a number of the palette.
    Palette(Vec<[u8; 3]>),
    /// The bands that hold red, green and blue.
    Rgb([usize; 3]),
}

/// What says that a pixel has no data.
#[derive(Debug)]
enum Validity {
    /// Nothing.
    Whole,
    /// The internal mask.
    Mask(Box<BandReader>),
    Samples(SampleRule),
}

/// No data where alpha is 0, and where all bands but alpha equal their no-data values.
#[derive(Debug)]
struct SampleRule {
    alpha: Option<usize>,
    /// Bands with their no-data values; none where a band has no such value.
    nodata: Vec<(usize, u8)>,
}

/// An 8-bit GeoTIFF as RGB: shades, palette or colours, chunky or planar, in the encodings that
/// [`TiffReader`] has. Alpha and masks change no colours.
#[derive(Debug)]
pub(crate) struct TiffColours {
    header: RasterHeader,
    file: File,
    /// Those of the colours; the only one of a chunky image.
    bands: Vec<BandReader>,
    /// Numbers of a planar image's bands that only the mask needs.
    more: Vec<(usize, BandReader)>,
    colours: Colours,
    validity: Validity,
    /// What a strip or tile that was never written holds.
    fill: u8,
}

impl TiffColours {
    /// Opens a GeoTIFF and reads its directories.
    ///
    /// # Errors
    /// [`RasterError`] for what is no TIFF, is damaged, or holds no 8-bit colours that this reader can
    /// decode.
    pub(crate) fn open(path: &std::path::Path, options: &OpenOptions) -> Result<Self, RasterError> {
        let tiff = TiffFile::read(path, options.memory_limit)?;
        let unreadable = |reason: String| RasterError::Unreadable { path: path.to_owned(), reason };
        let image = &tiff.image;
        check_samples(image).map_err(unreadable)?;
        check_supported(image).map_err(|what| {
            unreadable(format!(
                "holds {what}, which this build cannot decode; rewrite it (gdal_translate -co \
                 COMPRESS=DEFLATE in.tif out.tif), or use a build with GDAL"
            ))
        })?;
        let auxiliary = std::fs::read(beside(path, ".aux.xml")).unwrap_or_default();
        let auxiliary = String::from_utf8_lossy(&auxiliary);
        if ["<ColorTable", "<ColorInterp"].iter().any(|element| auxiliary.contains(element)) {
            return Err(unreadable(
                "has a side file (.aux.xml) that changes its colours, which this build does not read; write it \
                 into the raster (gdal_translate in.tif out.tif), or use a build with GDAL"
                    .to_owned(),
            ));
        }
        let (colours, warning) = colours(&tiff).map_err(unreadable)?;
        let mut header = TiffReader::open(path, options)?.header().clone();
        header.warnings.extend(warning);
        let numbers = match &colours {
            Colours::Rgb(bands) if image.planar => bands.to_vec(),
            _ => vec![0],
        };
        let validity = validity(&tiff, &colours);
        let reader = |band: usize| BandReader::new(image.clone(), band);
        let more = match &validity {
            Validity::Samples(rule) if image.planar => rule.bands(),
            _ => Vec::new(),
        };
        let more = more.into_iter().filter(|band| !numbers.contains(band));
        Ok(Self {
            header,
            file: File::open(path)
                .map_err(|source| RasterError::Io { path: path.to_owned(), source })?,
            more: more.map(|band| (band, reader(band))).collect(),
            bands: numbers.into_iter().map(reader).collect(),
            colours,
            validity,
            fill: tiff.nodata.unwrap_or(0.0).round_ties_even() as u8,
        })
    }

    /// What the header says.
    pub(crate) fn header(&self) -> &RasterHeader {
        &self.header
    }

    /// Whether there can be pixels without data.
    pub(crate) fn has_mask(&self) -> bool {
        !matches!(self.validity, Validity::Whole)
    }

    /// Reads a rectangle: rows from the top, three bytes a pixel, and where it is asked for the mask: 255 where a
    /// pixel has data, 0 where it has none.
    ///
    /// # Errors
    /// [`RasterError::Block`] naming the first block of the row of blocks that could not be read.
    pub(crate) fn read(
        &mut self,
        rectangle: Rectangle,
        out: &mut [u8],
        mut valid: Option<&mut [u8]>,
    ) -> Result<(), RasterError> {
        // By rows of blocks, so that damage has a place; a block holds whole strips or tiles.
        let height = self.header.block_height as usize;
        let bottom = rectangle.y + rectangle.height;
        let mut y = rectangle.y;
        while y < bottom {
            let end = ((y / height + 1) * height).min(bottom);
            let part = Rectangle { y, height: end - y, ..rectangle };
            let start = (y - rectangle.y) * rectangle.width;
            let pixels = start..start + part.height * part.width;
            let out = &mut out[pixels.start * 3..pixels.end * 3];
            let valid = valid.as_deref_mut().map(|valid| &mut valid[pixels]);
            self.read_part(part, out, valid).map_err(|reason| {
                let column = part.x as u32 / self.header.block_width;
                self.header.block_error(column, (y / height) as u32, reason)
            })?;
            y = end;
        }
        Ok(())
    }

    fn read_part(
        &mut self,
        rectangle: Rectangle,
        out: &mut [u8],
        mut valid: Option<&mut [u8]>,
    ) -> Result<(), String> {
        let (size, fill, file) = (self.header.size_bytes, self.fill, &mut self.file);
        if let (Some(valid), Validity::Mask(mask)) = (&mut valid, &mut self.validity) {
            let bytes = usize::from(mask.image.bits / 8);
            mask.read(file, size, rectangle, |run| {
                let start = run.y * rectangle.width + run.x;
                let valid = &mut valid[start..start + run.width];
                valid_pixels(&run, bytes, false, valid);
                valid.iter_mut().for_each(|value| *value *= 255);
            })?;
        }
        let rule = match &self.validity {
            Validity::Samples(rule) => Some(rule),
            _ => None,
        };
        let mut valid = valid.filter(|_| rule.is_some());
        if let (Some(valid), Some(rule)) = (&mut valid, rule) {
            // Of a planar image, one band with data after the other makes a pixel valid.
            valid.fill(if rule.nodata.is_empty() { 255 } else { 0 });
        }
        let (colours, planar) = (&self.colours, self.bands[0].image.planar);
        for (channel, band) in self.bands.iter_mut().enumerate() {
            let number = band.band();
            band.read(file, size, rectangle, |run| {
                let start = run.y * rectangle.width + run.x;
                let out = &mut out[start * 3..(start + run.width) * 3];
                match colours {
                    Colours::Rgb(_) if planar => {
                        for (i, pixel) in out.chunks_exact_mut(3).enumerate() {
                            pixel[channel] = sample(&run, i, 0, fill);
                        }
                    }
                    colours => convert(colours, &run, fill, out),
                }
                if let (Some(valid), Some(rule)) = (&mut valid, rule) {
                    let valid = &mut valid[start..start + run.width];
                    if planar {
                        rule.mark_band(number, &run, fill, valid);
                    } else {
                        rule.mark_pixels(&run, fill, valid);
                    }
                }
            })?;
        }
        // Alpha comes last: it takes data away.
        if let (Some(valid), Some(rule)) = (valid, rule) {
            for (number, band) in &mut self.more {
                band.read(file, size, rectangle, |run| {
                    let start = run.y * rectangle.width + run.x;
                    rule.mark_band(*number, &run, fill, &mut valid[start..start + run.width]);
                })?;
            }
        }
        Ok(())
    }
}

impl SampleRule {
    /// The bands that are looked at, alpha last.
    fn bands(&self) -> Vec<usize> {
        self.nodata.iter().map(|(band, _)| *band).chain(self.alpha).collect()
    }

    /// Of a run with all samples of its pixels.
    fn mark_pixels(&self, run: &Run<'_>, fill: u8, valid: &mut [u8]) {
        for (i, valid) in valid.iter_mut().enumerate() {
            let transparent = self.alpha.is_some_and(|band| sample(run, i, band, fill) == 0);
            let mut bands = self.nodata.iter();
            let empty = !self.nodata.is_empty()
                && bands.all(|(band, nodata)| sample(run, i, *band, fill) == *nodata);
            *valid = if transparent || empty { 0 } else { 255 };
        }
    }

    /// Of a run of one band.
    fn mark_band(&self, band: usize, run: &Run<'_>, fill: u8, valid: &mut [u8]) {
        let nodata = self.nodata.iter().find(|(number, _)| *number == band);
        for (i, valid) in valid.iter_mut().enumerate() {
            let value = sample(run, i, 0, fill);
            if self.alpha == Some(band) {
                *valid = if value == 0 { 0 } else { *valid };
            } else if nodata.is_some_and(|(_, nodata)| value != *nodata) {
                *valid = 255;
            }
        }
    }
}

/// What the file has that marks pixels: see [`crate::picture`].
fn validity(tiff: &TiffFile, colours: &Colours) -> Validity {
    if let Some(mask) = &tiff.mask {
        return Validity::Mask(Box::new(BandReader::new(mask.clone(), 0)));
    }
    let samples = usize::from(tiff.image.samples);
    let used = match colours {
        Colours::Rgb(bands) => bands.to_vec(),
        Colours::Shade { .. } | Colours::Palette(_) => vec![0],
    };
    let alpha = (0..samples).rfind(|band| is_alpha(tiff, *band) && !used.contains(band));
    // A value for each band, as programs other than GDAL write it, or one for all.
    let item = |item: &&MetadataItem| item.domain.is_empty() && item.name == "NODATA_VALUES";
    let each = tiff
        .items
        .iter()
        .find(item)
        .map(|item| item.value.split_whitespace().map(parse_nodata).collect::<Vec<_>>());
    let value = |band: usize| match &each {
        Some(values) if values.len() == samples => values[band],
        _ => tiff.nodata,
    };
    let plain: Vec<usize> = (0..samples).filter(|band| alpha != Some(*band)).collect();
    let byte =
        |value: f64| (value.fract() == 0.0 && (0.0..256.0).contains(&value)).then_some(value as u8);
    let nodata: Option<Vec<_>> =
        plain.into_iter().map(|band| Some((band, byte(value(band)?)?))).collect();
    let nodata = nodata.unwrap_or_default();
    if alpha.is_none() && nodata.is_empty() {
        return Validity::Whole;
    }
    Validity::Samples(SampleRule { alpha, nodata })
}

/// Whether a band, counted from 0, is alpha: GDAL's own note first, then the tag.
fn is_alpha(tiff: &TiffFile, band: usize) -> bool {
    let note = tiff.items.iter().find(|item| {
        item.role.eq_ignore_ascii_case("colorinterp")
            && item.sample.is_some_and(|sample| sample as usize == band)
    });
    if let Some(note) = note {
        return note.value.eq_ignore_ascii_case("alpha");
    }
    let extra = &tiff.image.extra_samples;
    let first = usize::from(tiff.image.samples).saturating_sub(extra.len());
    let kind = band.checked_sub(first).and_then(|index| extra.get(index));
    matches!(kind, Some(1 | 2))
}

fn sample(run: &Run<'_>, pixel: usize, band: usize, fill: u8) -> u8 {
    run.row.map_or(fill, |row| row[run.first + pixel * run.stride + band])
}

fn convert(colours: &Colours, run: &Run<'_>, fill: u8, out: &mut [u8]) {
    for (i, pixel) in out.chunks_exact_mut(3).enumerate() {
        match colours {
            Colours::Shade { white_is_zero } => {
                let shade = sample(run, i, 0, fill);
                pixel.fill(if *white_is_zero { 255 - shade } else { shade });
            }
            Colours::Palette(palette) => {
                let number = usize::from(sample(run, i, 0, fill));
                pixel.copy_from_slice(palette.get(number).unwrap_or(&[0; 3]));
            }
            Colours::Rgb(bands) => {
                for (value, band) in pixel.iter_mut().zip(bands) {
                    *value = sample(run, i, *band, fill);
                }
            }
        }
    }
}

fn check_samples(image: &TiffImage) -> Result<(), String> {
    match (image.format, image.bits) {
        (1 | 4, 8) => Ok(()),
        (1 | 4, bits) if bits < 8 => Err(format!(
            "holds samples of {bits} bits; write it with 8: gdal_translate -ot Byte -expand rgb \
             in.tif out.tif"
        )),
        (3, bits) => Err(no_bytes(&format!("Float{bits}"))),
        (2, bits) => Err(no_bytes(&format!("Int{bits}"))),
        (1 | 4, bits) => Err(no_bytes(&format!("UInt{bits}"))),
        (_, bits) => Err(no_bytes(&format!("complex samples of {bits} bits"))),
    }
}

/// Why samples that are no bytes are refused, and what to do.
pub(super) fn no_bytes(kind: &str) -> String {
    format!(
        "holds {kind}, and the network takes 8-bit colours; how reflectances become colours is for you \
         to say: gdal_translate -ot Byte -scale LOW HIGH 0 255 in.tif out.tif"
    )
}

/// What is said of bands without names.
pub(super) const UNNAMED: &str = "the file does not say which bands are red, green and blue; the \
    first three are taken, in this order (gdal_translate -b 3 -b 2 -b 1 puts them in another)";

/// What the samples mean, and a warning where that is a guess.
fn colours(tiff: &TiffFile) -> Result<(Colours, Option<String>), String> {
    let image = &tiff.image;
    let alpha = image.extra_samples.iter().filter(|kind| matches!(kind, 1 | 2)).count();
    let plain = usize::from(image.samples).saturating_sub(alpha);
    // GDAL writes the bands' names where they are not what the photometric tag says.
    let named = |colour: &str| {
        let item = tiff.items.iter().find(|item| {
            item.role.eq_ignore_ascii_case("colorinterp") && item.value.eq_ignore_ascii_case(colour)
        });
        item.and_then(|item| item.sample).map(|band| band as usize)
    };
    if let (Some(red), Some(green), Some(blue)) = (named("red"), named("green"), named("blue"))
        && [red, green, blue].iter().all(|band| *band < usize::from(image.samples))
    {
        return Ok((Colours::Rgb([red, green, blue]), None));
    }
    // As GDAL has it, a palette counts whatever the photometric tag says.
    if image.samples == 1 && !tiff.colour_map.is_empty() {
        return Ok((Colours::Palette(palette(&tiff.colour_map)), None));
    }
    match image.photometric {
        2 if image.samples >= 3 => Ok((Colours::Rgb([0, 1, 2]), None)),
        0 | 1 if plain >= 3 => Ok((Colours::Rgb([0, 1, 2]), Some(UNNAMED.to_owned()))),
        kind @ (0 | 1) => Ok((Colours::Shade { white_is_zero: kind == 0 }, None)),
        other => Err(format!(
            "stores its colours in another way than RGB, palette or shades (photometric \
             interpretation {other}); write it as RGB with gdal_translate, or use a build with GDAL"
        )),
    }
}

/// The palette in bytes: the upper ones, unless the file has bytes in place of 16 bits.
fn palette(map: &[u16]) -> Vec<[u8; 3]> {
    let count = map.len() / 3;
    let shift = if map.iter().any(|value| *value > 255) { 8 } else { 0 };
    let byte = |value: u16| (value >> shift) as u8;
    (0..count).map(|i| [0, 1, 2].map(|channel| byte(map[channel * count + i]))).collect()
}
