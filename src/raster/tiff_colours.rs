//! RGB pixels of 8-bit GeoTIFFs in pure Rust.

use super::header::Rectangle;
use super::tiff_codec::{BandReader, Run, check_supported};
use super::tiff_directory::{TiffFile, TiffImage};
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

/// An 8-bit GeoTIFF as RGB: shades, palette or colours, chunky or planar, in the encodings that
/// [`TiffReader`] has. Alpha and masks are left out.
#[derive(Debug)]
pub(crate) struct TiffColours {
    header: RasterHeader,
    file: File,
    bands: Vec<BandReader>,
    colours: Colours,
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
        let bands: Vec<_> = match &colours {
            Colours::Rgb(bands) if image.planar => bands.to_vec(),
            _ => vec![0],
        };
        Ok(Self {
            header,
            file: File::open(path)
                .map_err(|source| RasterError::Io { path: path.to_owned(), source })?,
            bands: bands.into_iter().map(|band| BandReader::new(image.clone(), band)).collect(),
            colours,
            fill: tiff.nodata.unwrap_or(0.0).round_ties_even() as u8,
        })
    }

    /// What the header says.
    pub(crate) fn header(&self) -> &RasterHeader {
        &self.header
    }

    /// Reads a rectangle: rows from the top, three bytes a pixel.
    ///
    /// # Errors
    /// [`RasterError::Block`] naming the block that holds the rectangle's corner.
    pub(crate) fn read(&mut self, rectangle: Rectangle, out: &mut [u8]) -> Result<(), RasterError> {
        let (size, fill) = (self.header.size_bytes, self.fill);
        let (colours, planar) = (&self.colours, self.bands.len() > 1);
        for (channel, band) in self.bands.iter_mut().enumerate() {
            band.read(&mut self.file, size, rectangle, |run| {
                let start = (run.y * rectangle.width + run.x) * 3;
                let out = &mut out[start..start + run.width * 3];
                match colours {
                    Colours::Rgb(_) if planar => {
                        for (i, pixel) in out.chunks_exact_mut(3).enumerate() {
                            pixel[channel] = sample(&run, i, 0, fill);
                        }
                    }
                    colours => convert(colours, &run, fill, out),
                }
            })
            .map_err(|reason| {
                let (x, y) = (rectangle.x as u32, rectangle.y as u32);
                let block = (x / self.header.block_width, y / self.header.block_height);
                self.header.block_error(block.0, block.1, reason)
            })?;
        }
        Ok(())
    }
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
