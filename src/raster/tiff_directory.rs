//! What the directories of a GeoTIFF say: layout, georeference, GDAL's private tags.
//!
//! The `tiff` crate walks the directories; what their tags mean to GDAL is decided here. Where a
//! file can be read in two ways, this follows GDAL's GeoTIFF driver, so that both builds agree.

use super::RasterError;
use crate::crs::GeoKeys;
use crate::grid::GeoTransform;
use std::collections::HashSet;
use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::Path;
use tiff::TiffError;
use tiff::decoder::{Decoder, IfdDecoder};
use tiff::tags::{ByteOrder, Tag};

const GDAL_METADATA: Tag = Tag::Unknown(42112);
const TYPE_REDUCED: u32 = 1;
const TYPE_MASK: u32 = 4;
const PHOTOMETRIC_MASK: u32 = 4;
/// Pieces into which large uncompressed strips are cut.
const PIECE_SAMPLES: u64 = 64 * 1024;

/// One image of a TIFF file: how its samples are stored.
#[derive(Clone, Debug, Default)]
pub(super) struct TiffImage {
    pub(super) width: u32,
    pub(super) height: u32,
    /// Samples of a pixel.
    pub(super) samples: u16,
    pub(super) bits: u16,
    /// 1 unsigned, 2 signed, 3 floating point.
    pub(super) format: u16,
    pub(super) compression: u16,
    pub(super) predictor: u16,
    /// Whether each band has strips or tiles of its own; band 1 comes first.
    pub(super) planar: bool,
    pub(super) tiled: bool,
    /// Size of a strip or tile, pixels.
    pub(super) chunk_width: u32,
    pub(super) chunk_height: u32,
    /// Where the strips or tiles are; with `planar`, all of band 1, then all of band 2, ...
    pub(super) offsets: Vec<u64>,
    /// Their bytes; 0 marks one that was never written.
    pub(super) counts: Vec<u64>,
    pub(super) extra_samples: Vec<u16>,
    pub(super) fill_order: u16,
    /// 0 and 1 shades, 2 RGB, 3 a palette.
    pub(super) photometric: u16,
    pub(super) big_endian: bool,
}

impl TiffImage {
    /// Samples of a pixel within one strip or tile.
    pub(super) fn chunk_samples(&self) -> usize {
        if self.planar { 1 } else { usize::from(self.samples) }
    }

    /// Bytes of one row of a strip or tile.
    pub(super) fn row_bytes(&self) -> u64 {
        (u64::from(self.chunk_width) * self.chunk_samples() as u64 * u64::from(self.bits))
            .div_ceil(8)
    }

    /// Bytes of a whole strip or tile, decompressed.
    pub(super) fn chunk_bytes(&self) -> u64 {
        self.row_bytes().saturating_mul(u64::from(self.chunk_height))
    }

    /// Strips or tiles in a row.
    pub(super) fn chunks_across(&self) -> usize {
        self.width.div_ceil(self.chunk_width.max(1)) as usize
    }

    /// Strips or tiles of one band (of all bands if they are interleaved).
    pub(super) fn chunks_per_band(&self) -> usize {
        self.chunks_across() * self.height.div_ceil(self.chunk_height.max(1)) as usize
    }

    /// GDAL's name of the compression, in lower case.
    pub(super) fn compression_name(&self) -> String {
        match self.compression {
            1 => "none",
            2 => "ccittrle",
            3 => "ccittfax3",
            4 => "ccittfax4",
            5 => "lzw",
            6 | 7 => "jpeg",
            8 | 32_946 => "deflate",
            32_773 => "packbits",
            34_712 => "jp2000",
            34_887 => "lerc",
            34_925 => "lzma",
            50_000 => "zstd",
            50_001 => "webp",
            50_002 | 52_546 => "jxl",
            other => return format!("compression {other}"),
        }
        .to_owned()
    }

    /// Cuts uncompressed strips into pieces of whole rows where one strip holds a whole raster (as
    /// `tifffile` writes) or more than `limit` bytes: nothing has to be read as one then.
    fn split_large_strips(&mut self, limit: u64) {
        let whole = self.chunk_height >= self.height && self.height > 2000;
        if self.tiled || self.compression != 1 || !(whole || self.chunk_bytes() > limit) {
            return;
        }
        let rows = (PIECE_SAMPLES / u64::from(self.chunk_width.max(1))).max(1);
        let mut rows = u32::try_from(rows).unwrap_or(u32::MAX).min(self.chunk_height);
        if self.chunks_per_band() > 1 {
            // Pieces of unequal height would not make a regular grid.
            while !self.chunk_height.is_multiple_of(rows) {
                rows -= 1;
            }
        }
        let piece = self.row_bytes() * u64::from(rows);
        let strips = self.chunks_per_band();
        let (mut offsets, mut counts) = (Vec::new(), Vec::new());
        for (strip, (&offset, &count)) in self.offsets.iter().zip(&self.counts).enumerate() {
            let first = (strip % strips) as u64 * u64::from(self.chunk_height);
            let height = (u64::from(self.height) - first).min(u64::from(self.chunk_height));
            for i in 0..height.div_ceil(u64::from(rows)) {
                offsets.push(offset.saturating_add(i * piece));
                // A strip that was never written stays so in all its pieces; one that is too short
                // ends in pieces of a single byte, which fail when they are read.
                let left = count.saturating_sub(i * piece).min(piece);
                counts.push(if count == 0 { 0 } else { left.max(1) });
            }
        }
        (self.offsets, self.counts, self.chunk_height) = (offsets, counts, rows);
    }
}

/// Everything that a GeoTIFF's directories say about its first image.
#[derive(Clone, Debug)]
pub(super) struct TiffFile {
    pub(super) image: TiffImage,
    /// The internal mask.
    pub(super) mask: Option<TiffImage>,
    /// Reduced-size images in the same file.
    pub(super) overviews: u32,
    pub(super) nodata: Option<f64>,
    /// The palette: all reds, all greens, all blues, of 16 bits.
    pub(super) colour_map: Vec<u16>,
    /// Items of GDAL's metadata tag.
    pub(super) items: Vec<MetadataItem>,
    pub(super) geo_keys: Option<GeoKeys>,
    pub(super) geotransform: Option<GeoTransform>,
    /// Whether control points stand in for a georeference.
    pub(super) control_points: bool,
    /// Strips or tiles that lie beyond the end of the file.
    pub(super) truncated_chunks: usize,
}

/// One item of the XML in GDAL's metadata tag.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct MetadataItem {
    pub(super) name: String,
    pub(super) value: String,
    pub(super) domain: String,
    /// Band, counted from 0; `None` for the dataset.
    pub(super) sample: Option<u32>,
    pub(super) role: String,
}

impl TiffFile {
    /// Reads the directories.
    ///
    /// # Errors
    /// [`RasterError::Unreadable`] for what is no TIFF file or is damaged.
    pub(super) fn read(path: &Path, memory_limit: usize) -> Result<Self, RasterError> {
        let file =
            File::open(path).map_err(|source| RasterError::Io { path: path.to_owned(), source })?;
        let size = file.metadata().map_or(0, |m| m.len());
        let unreadable = |error: TiffError| RasterError::Unreadable {
            path: path.to_owned(),
            reason: explain(&error),
        };
        let decoder = Decoder::new(BufReader::new(file)).map_err(unreadable)?;
        Self::read_directories(decoder, size, memory_limit as u64).map_err(unreadable)
    }

    fn read_directories<R: Read + Seek>(
        mut decoder: Decoder<R>,
        file_size: u64,
        memory_limit: u64,
    ) -> Result<Self, TiffError> {
        let big_endian = decoder.byte_order() == ByteOrder::BigEndian;
        let mut next = decoder.ifd_pointer();
        let mut seen = HashSet::new();
        let mut file: Option<Self> = None;
        while let Some(pointer) = next
            && seen.insert(pointer)
        {
            let directory = match decoder.read_directory(pointer) {
                Ok(directory) => directory,
                // The first image is whole; what follows it is only overviews and masks.
                Err(_) if file.is_some() => break,
                Err(error) => return Err(error),
            };
            next = directory.next();
            let mut tags = decoder.read_directory_tags(&directory);
            match &mut file {
                None => file = Some(Self::first_image(&mut tags, big_endian)?),
                Some(file) => file.later_image(&mut tags, big_endian),
            }
        }
        let mut file =
            file.ok_or(TiffError::FormatError(tiff::TiffFormatError::ImageFileDirectoryNotFound))?;
        file.truncated_chunks = file
            .image
            .offsets
            .iter()
            .zip(&file.image.counts)
            .take(file.image.chunks_per_band())
            .filter(|(offset, count)| **count > 0 && offset.saturating_add(**count) > file_size)
            .count();
        file.image.split_large_strips(memory_limit);
        Ok(file)
    }

    fn first_image(tags: &mut IfdDecoder<'_>, big_endian: bool) -> Result<Self, TiffError> {
        let image = read_image(tags, big_endian)?;
        let items = text(tags, GDAL_METADATA).map_or_else(Vec::new, |xml| parse_metadata(&xml));
        let nodata = text(tags, Tag::GdalNodata).and_then(|text| parse_nodata(&text));
        let colour_map = tags.find_tag_unsigned_vec::<u16>(Tag::ColorMap)?.unwrap_or_default();
        let directory = tags.find_tag_unsigned_vec::<u16>(Tag::GeoKeyDirectoryTag)?;
        let geo_keys = directory.map(|directory| GeoKeys {
            directory,
            doubles: doubles(tags, Tag::GeoDoubleParamsTag),
            ascii: text(tags, Tag::GeoAsciiParamsTag).unwrap_or_default(),
        });
        let point = geo_keys.as_ref().is_some_and(is_pixel_is_point);
        let tiepoints = doubles(tags, Tag::ModelTiepointTag);
        let geotransform = geotransform(
            &doubles(tags, Tag::ModelPixelScaleTag),
            &tiepoints,
            &doubles(tags, Tag::ModelTransformationTag),
            point,
        );
        Ok(Self {
            image,
            mask: None,
            overviews: 0,
            nodata,
            colour_map,
            items,
            geo_keys,
            control_points: geotransform.is_none() && tiepoints.len() >= 6,
            geotransform,
            truncated_chunks: 0,
        })
    }

    /// A mask or an overview of the first image, or something that is no concern of ours.
    fn later_image(&mut self, tags: &mut IfdDecoder<'_>, big_endian: bool) {
        let kind = unsigned(tags, Tag::NewSubfileType).unwrap_or(0);
        let photometric = unsigned(tags, Tag::PhotometricInterpretation).unwrap_or(1);
        let is_mask = kind & TYPE_MASK != 0 || photometric == PHOTOMETRIC_MASK;
        if kind & TYPE_REDUCED != 0 {
            self.overviews += u32::from(!is_mask);
        } else if is_mask && self.mask.is_none() {
            self.mask = read_image(tags, big_endian)
                .ok()
                .filter(|mask| (mask.width, mask.height) == (self.image.width, self.image.height));
        }
    }

    /// The text of band 1's item with a role (`scale`, `offset`, `unittype`).
    pub(super) fn role(&self, role: &str) -> Option<&str> {
        self.items
            .iter()
            .find(|i| i.role.eq_ignore_ascii_case(role) && i.sample.unwrap_or(0) == 0)
            .map(|i| i.value.as_str())
    }
}

fn read_image(tags: &mut IfdDecoder<'_>, big_endian: bool) -> Result<TiffImage, TiffError> {
    let (width, height) = (
        tags.get_tag_unsigned::<u32>(Tag::ImageWidth)?,
        tags.get_tag_unsigned::<u32>(Tag::ImageLength)?,
    );
    let small = |tags: &mut IfdDecoder<'_>, tag, default: u16| -> Result<u16, TiffError> {
        let values = tags.find_tag_unsigned_vec::<u16>(tag)?;
        Ok(values.and_then(|v| v.first().copied()).unwrap_or(default))
    };
    let samples = small(tags, Tag::SamplesPerPixel, 1)?;
    let planar = small(tags, Tag::PlanarConfiguration, 1)? == 2 && samples > 1;
    let tiled = tags.find_tag_unsigned_vec::<u64>(Tag::TileOffsets)?;
    let is_tiled = tiled.is_some();
    let (offsets, counts, chunk_width, chunk_height) = match tiled {
        Some(offsets) => (
            offsets,
            tags.find_tag_unsigned_vec::<u64>(Tag::TileByteCounts)?,
            tags.get_tag_unsigned::<u32>(Tag::TileWidth)?,
            tags.get_tag_unsigned::<u32>(Tag::TileLength)?,
        ),
        None => (
            tags.find_tag_unsigned_vec::<u64>(Tag::StripOffsets)?.unwrap_or_default(),
            tags.find_tag_unsigned_vec::<u64>(Tag::StripByteCounts)?,
            width,
            // Absent, or 2^32 - 1: one strip.
            tags.find_tag_unsigned::<u32>(Tag::RowsPerStrip)?.unwrap_or(u32::MAX).min(height),
        ),
    };
    let mut image = TiffImage {
        width,
        height,
        samples,
        bits: small(tags, Tag::BitsPerSample, 1)?,
        format: small(tags, Tag::SampleFormat, 1)?,
        compression: small(tags, Tag::Compression, 1)?,
        predictor: small(tags, Tag::Predictor, 1)?,
        planar,
        tiled: is_tiled,
        chunk_width,
        chunk_height,
        offsets,
        counts: counts.unwrap_or_default(),
        extra_samples: tags.find_tag_unsigned_vec::<u16>(Tag::ExtraSamples)?.unwrap_or_default(),
        fill_order: small(tags, Tag::FillOrder, 1)?,
        photometric: small(tags, Tag::PhotometricInterpretation, 1)?,
        big_endian,
    };
    let inconsistent =
        || TiffError::FormatError(tiff::TiffFormatError::InconsistentSizesEncountered);
    if width == 0 || height == 0 || chunk_width == 0 || chunk_height == 0 || samples == 0 {
        return Err(inconsistent());
    }
    let rows = height.div_ceil(chunk_height) as usize;
    let bands = if planar { usize::from(samples) } else { 1 };
    let expected = image
        .chunks_across()
        .checked_mul(rows)
        .and_then(|n| n.checked_mul(bands))
        .ok_or_else(inconsistent)?;
    if image.offsets.len() < expected || image.counts.len() < expected {
        return Err(inconsistent());
    }
    image.offsets.truncate(expected);
    image.counts.truncate(expected);
    Ok(image)
}

fn unsigned(tags: &mut IfdDecoder<'_>, tag: Tag) -> Option<u32> {
    tags.find_tag_unsigned::<u32>(tag).ok().flatten()
}

fn doubles(tags: &mut IfdDecoder<'_>, tag: Tag) -> Vec<f64> {
    tags.find_tag(tag).ok().flatten().and_then(|v| v.into_f64_vec().ok()).unwrap_or_default()
}

fn text(tags: &mut IfdDecoder<'_>, tag: Tag) -> Option<String> {
    let value = tags.find_tag(tag).ok().flatten()?;
    match value.clone().into_string() {
        Ok(text) => Some(text),
        // Latin-1 in an ASCII tag, or bytes in place of ASCII.
        Err(_) => {
            let bytes = value.into_u8_vec().ok()?;
            let end = bytes.iter().position(|b| *b == 0).unwrap_or(bytes.len());
            Some(bytes[..end].iter().map(|b| char::from(*b)).collect())
        }
    }
}

/// The text of the GDAL_NODATA tag as a number: GDAL's own spellings and any number; text that is no
/// number at all is none, as in GDAL.
pub(super) fn parse_nodata(text: &str) -> Option<f64> {
    let text = text.trim_matches(|c: char| c.is_whitespace() || c == '\0');
    match text.to_ascii_lowercase().as_str() {
        "nan" | "-nan" | "1.#qnan" | "-1.#ind" => Some(f64::NAN),
        "inf" | "1.#inf" => Some(f64::INFINITY),
        "-inf" | "-1.#inf" => Some(f64::NEG_INFINITY),
        lower => lower.replace(',', ".").parse().ok(),
    }
}

/// GTRasterTypeGeoKey (1025) = RasterPixelIsPoint (2).
fn is_pixel_is_point(keys: &GeoKeys) -> bool {
    keys.directory
        .get(4..)
        .unwrap_or_default()
        .chunks_exact(4)
        .any(|key| key[0] == 1025 && key[1] == 0 && key[3] == 2)
}

/// The pixel corner grid from the three georeference tags, in the order in which GDAL looks at them.
fn geotransform(
    scale: &[f64],
    tiepoints: &[f64],
    matrix: &[f64],
    pixel_is_point: bool,
) -> Option<GeoTransform> {
    let mut c = if scale.len() >= 2 && scale[0] != 0.0 && scale[1] != 0.0 {
        let c1 = scale[0];
        // A negative scale is written by programs that mean the same as its absolute value.
        let c5 = -scale[1].abs();
        let tie = tiepoints.get(..6)?;
        [tie[3] - tie[0] * c1, c1, 0.0, tie[4] - tie[1] * c5, 0.0, c5]
    } else if matrix.len() >= 16 {
        [matrix[3], matrix[0], matrix[1], matrix[7], matrix[4], matrix[5]]
    } else {
        return None;
    };
    if pixel_is_point {
        c[0] -= c[1] * 0.5 + c[2] * 0.5;
        c[3] -= c[4] * 0.5 + c[5] * 0.5;
    }
    Some(GeoTransform(c))
}

/// The items of `<GDALMetadata>`: a list of `<Item name= sample= role= domain=>text</Item>`.
fn parse_metadata(xml: &str) -> Vec<MetadataItem> {
    let mut items = Vec::new();
    let mut rest = xml;
    while let Some(start) = rest.find("<Item") {
        rest = &rest[start + "<Item".len()..];
        let Some(end) = rest.find('>') else { break };
        let (attributes, body) = (&rest[..end], &rest[end + 1..]);
        let (value, after) = if attributes.ends_with('/') {
            ("", body)
        } else {
            let Some(close) = body.find("</Item") else { break };
            (&body[..close], &body[close..])
        };
        rest = after;
        let attribute = |name: &str| -> String {
            [format!(" {name}=\""), format!(" {name}='")]
                .into_iter()
                .find_map(|key| {
                    let quote = key.chars().next_back()?;
                    let from = attributes.find(&key)? + key.len();
                    let length = attributes[from..].find(quote)?;
                    Some(unescape(&attributes[from..from + length]))
                })
                .unwrap_or_default()
        };
        items.push(MetadataItem {
            name: attribute("name"),
            value: unescape(value),
            domain: attribute("domain"),
            sample: attribute("sample").parse().ok(),
            role: attribute("role"),
        });
    }
    items
}

fn unescape(text: &str) -> String {
    text.replace("&lt;", "<")
        .replace("&gt;", ">")
        .replace("&quot;", "\"")
        .replace("&apos;", "'")
        .replace("&amp;", "&")
}

/// What a TIFF error means to the user.
fn explain(error: &TiffError) -> String {
    use tiff::TiffFormatError as Format;
    match error {
        TiffError::FormatError(Format::TiffSignatureNotFound | Format::TiffSignatureInvalid) => {
            "is no TIFF file (it does not begin with a TIFF signature); other formats need a build \
             with GDAL"
                .to_owned()
        }
        TiffError::IoError(source) if source.kind() == std::io::ErrorKind::UnexpectedEof => {
            "the file ends within its TIFF header or directory: it is truncated; copy it again"
                .to_owned()
        }
        TiffError::FormatError(Format::InvalidDimensions(width, height)) => {
            format!("the raster has zero size ({width} x {height} pixels)")
        }
        other => format!("the TIFF directory is damaged or not understood: {other}"),
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may fail")]
mod tests {
    use super::*;

    #[test]
    fn metadata_items_are_read_with_their_attributes() {
        let xml = "<GDALMetadata>\n  <Item name=\"UNITS\" sample=\"0\">feet</Item>\n  \
                   <Item name=\"SCALE\" sample=\"0\" role=\"scale\">0.01</Item>\n  \
                   <Item name='A &amp; B' domain='D'>x &lt; &amp;lt; y</Item><Item name=\"E\"/>\n\
                   </GDALMetadata>\n";
        let items = parse_metadata(xml);
        assert_eq!(items.len(), 4);
        assert_eq!((items[0].name.as_str(), items[0].value.as_str()), ("UNITS", "feet"));
        assert_eq!((items[1].role.as_str(), items[1].sample), ("scale", Some(0)));
        assert_eq!((items[2].name.as_str(), items[2].domain.as_str()), ("A & B", "D"));
        assert_eq!((items[2].value.as_str(), items[2].sample), ("x < &lt; y", None));
        assert_eq!((items[3].name.as_str(), items[3].value.as_str()), ("E", ""));
        for broken in ["", "<Item", "<Item name=\"x", "<Item name=\"x\">", "<Item name=\"x\">y"] {
            assert!(parse_metadata(broken).is_empty(), "{broken}");
        }
    }

    #[test]
    fn nodata_text_is_read_in_every_spelling() {
        assert_eq!(parse_nodata("-9999 \0"), Some(-9999.0));
        assert_eq!(parse_nodata("-3.4028234663852886e+38"), Some(f64::from(f32::MIN)));
        assert_eq!(parse_nodata("-1.#INF"), Some(f64::NEG_INFINITY));
        assert!(parse_nodata("nan").is_some_and(f64::is_nan));
        assert!(parse_nodata(" NaN").is_some_and(f64::is_nan));
        assert_eq!(parse_nodata("none"), None);
        assert_eq!(parse_nodata(""), None);
    }

    #[test]
    fn the_georeference_is_shifted_for_points() {
        let scale = [1.5, 1.5, 0.0];
        let tie = [0.0, 0.0, 0.0, 100.0, 200.0, 0.0];
        let area = geotransform(&scale, &tie, &[], false).unwrap();
        assert_eq!(area, GeoTransform::north_up(100.0, 200.0, 1.5, 1.5));
        let point = geotransform(&scale, &tie, &[], true).unwrap();
        assert_eq!(point, GeoTransform::north_up(99.25, 200.75, 1.5, 1.5));
        assert_eq!(geotransform(&[], &tie, &[], false), None);
        let mut matrix = [0.0; 16];
        (matrix[0], matrix[1], matrix[3]) = (1.0, 0.25, 10.0);
        (matrix[4], matrix[5], matrix[7]) = (0.5, -2.0, 20.0);
        let rotated = geotransform(&[], &[], &matrix, false).unwrap();
        assert_eq!(rotated, GeoTransform([10.0, 1.0, 0.25, 20.0, 0.5, -2.0]));
    }

    #[test]
    fn a_raster_in_one_uncompressed_strip_is_cut_into_rows() {
        let mut image = TiffImage {
            width: 1000,
            height: 2001,
            samples: 1,
            bits: 32,
            compression: 1,
            chunk_width: 1000,
            chunk_height: 2001,
            offsets: vec![8],
            counts: vec![1000 * 2001 * 4],
            ..TiffImage::default()
        };
        image.split_large_strips(u64::MAX);
        assert_eq!(image.chunk_height, 65);
        assert_eq!(image.offsets.len(), 2001_usize.div_ceil(65));
        assert_eq!(image.offsets[1], 8 + 65 * 4000);
        assert_eq!(image.counts.iter().sum::<u64>(), 1000 * 2001 * 4);

        // Of two strips, the pieces are all of one height; the second ends early.
        let mut two = TiffImage {
            chunk_height: 2000,
            height: 3990,
            offsets: vec![8, 8_000_008],
            counts: vec![8_000_000, 10_000],
            ..image
        };
        two.split_large_strips(1 << 20);
        assert_eq!((two.chunk_height, two.offsets.len()), (50, 80));
        assert_eq!(two.offsets[40], 8_000_008);
        assert_eq!((two.counts[40], two.counts[41], two.counts[79]), (10_000, 1, 1));
    }
}
