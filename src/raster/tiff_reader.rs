//! Reading GeoTIFF in pure Rust.

use super::header::{Found, block_size, check_memory, finish, stat};
use super::sample::{SampleDecoder, SampleType, UndeclaredNodata};
use super::tiff_codec::{BandReader, Run, check_supported};
use super::tiff_directory::{MetadataItem, TiffFile, TiffImage, parse_nodata};
use super::vertical_unit::is_unit_item;
use super::{OpenOptions, RasterError, RasterHeader, RasterReader};
use crate::crs::CrsSpec;
use crate::grid::GeoTransform;
use std::fs::File;
use std::path::{Path, PathBuf};

/// What a side file of GDAL must not say, because this reader does not read it.
const SIDE_FILE_ELEMENTS: [&str; 6] =
    ["<SRS", "<GeoTransform", "<GCPList", "<UnitType", "<Offset", "<Scale"];

/// A GeoTIFF opened in pure Rust: strips or tiles; no compression, deflate, LZW, PackBits or zstd;
/// predictors 1 to 3; classic or BigTIFF in either byte order; integers of up to 32 bits and floats
/// of 32 or 64; an internal mask or an alpha band; the first of several bands; a world file.
#[derive(Debug)]
pub struct TiffReader {
    header: RasterHeader,
    decoder: SampleDecoder,
    sample_type: SampleType,
    file: File,
    heights: BandReader,
    /// The mask or the alpha band.
    mask: Option<BandReader>,
    mask_values: Vec<u8>,
    /// What a strip or tile that was never written holds.
    fill: f64,
    undeclared: UndeclaredNodata,
}

impl TiffReader {
    /// Opens a GeoTIFF and reads its directories.
    ///
    /// # Errors
    /// [`RasterError`] for what is no TIFF, is damaged, or holds what this reader cannot decode (by
    /// name, with what to do).
    pub fn open(path: &Path, options: &OpenOptions) -> Result<Self, RasterError> {
        let metadata = stat(path)?;
        let unreadable = |reason: String| RasterError::Unreadable { path: path.to_owned(), reason };
        if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("vrt")) {
            return Err(unreadable(
                "is a VRT, and this build reads GeoTIFF only; give the tiles that it is made of, \
                 or use a build with GDAL"
                    .to_owned(),
            ));
        }
        let tiff = TiffFile::read(path, options.memory_limit)?;
        refuse_side_files(path, tiff.nodata)?;
        let sample_type = sample_type(&tiff.image)
            .and_then(|found| check_supported(&tiff.image).map(|()| found))
            .map_err(|what| unreadable(unsupported(&what)))?;
        let alpha = alpha_band(&tiff.image);
        let mask = match (&tiff.mask, alpha) {
            (Some(mask), _) => {
                check_mask(mask)
                    .map_err(|what| unreadable(unsupported(&format!("a mask in {what}"))))?;
                Some(BandReader::new(mask.clone(), 0))
            }
            (None, Some(band)) => Some(BandReader::new(tiff.image.clone(), band)),
            (None, None) => None,
        };

        let raster = (tiff.image.width, tiff.image.height);
        let stored = (tiff.image.chunk_width, tiff.image.chunk_height);
        let block = block_size(raster, stored);
        let mask_bytes = mask.as_ref().map_or(0, |mask| mask.image.chunk_bytes());
        let stored_bytes = tiff.image.chunk_bytes().saturating_add(mask_bytes);
        check_memory(path, options, stored, block, stored_bytes)?;

        let found = describe(path, &tiff, sample_type, block, mask.is_some());
        let (header, decoder) = finish(path, &metadata, options, found)?;
        Ok(Self {
            fill: sample_type.nearest(tiff.nodata.unwrap_or(0.0)),
            header,
            sample_type,
            file: File::open(path)
                .map_err(|source| RasterError::Io { path: path.to_owned(), source })?,
            heights: BandReader::new(tiff.image, 0),
            mask: mask.filter(|_| decoder.use_mask),
            mask_values: Vec::new(),
            decoder,
            undeclared: UndeclaredNodata::default(),
        })
    }

    fn read(&mut self, rectangle: super::header::Rectangle, out: &mut [f32]) -> Result<(), String> {
        let block_width = self.header.block_width as usize;
        let size = self.header.size_bytes;
        if let Some(mask) = &mut self.mask {
            self.mask_values.clear();
            self.mask_values.resize(rectangle.width * rectangle.height, 0);
            let (values, width) = (&mut self.mask_values, rectangle.width);
            let (bytes, fill) = (usize::from(mask.image.bits / 8), self.fill != 0.0);
            mask.read(&mut self.file, size, rectangle, |run| {
                let start = run.y * width + run.x;
                valid_pixels(&run, bytes, fill, &mut values[start..start + run.width]);
            })?;
        }
        let mask = self.mask.is_some().then_some(self.mask_values.as_slice());
        let (decoder, sample_type, fill) = (&self.decoder, self.sample_type, self.fill);
        let undeclared = &mut self.undeclared;
        self.heights.read(&mut self.file, size, rectangle, |run| {
            let start = run.y * block_width + run.x;
            let out = &mut out[start..start + run.width];
            let mask = mask.map(|mask| &mask[run.y * rectangle.width + run.x..][..run.width]);
            *undeclared |= decode_run(decoder, sample_type, fill, &run, mask, out);
        })
    }
}

impl RasterReader for TiffReader {
    fn header(&self) -> &RasterHeader {
        &self.header
    }

    fn read_block(&mut self, bx: u32, by: u32, out: &mut Vec<f32>) -> Result<(), RasterError> {
        let rectangle =
            self.header.block_rectangle(bx, by).ok_or_else(|| self.header.no_such_block(bx, by))?;
        out.clear();
        out.resize(self.header.block_width as usize * rectangle.height, f32::NAN);
        self.read(rectangle, out).map_err(|reason| self.header.block_error(bx, by, reason))
    }

    fn undeclared_nodata(&self) -> UndeclaredNodata {
        self.undeclared
    }
}

/// Turns one run of stored samples into heights.
fn decode_run(
    decoder: &SampleDecoder,
    sample_type: SampleType,
    fill: f64,
    run: &Run<'_>,
    mask: Option<&[u8]>,
    out: &mut [f32],
) -> UndeclaredNodata {
    let Some(row) = run.row else {
        return decoder.decode(out, std::iter::repeat(fill), mask);
    };
    macro_rules! decode {
        ($sample:ty, $n:literal) => {{
            let samples = &row.as_chunks::<$n>().0[run.first..];
            let value = |bytes: &[u8; $n]| f64::from(<$sample>::from_ne_bytes(*bytes));
            if run.stride == 1 {
                decoder.decode(out, samples.iter().map(value), mask)
            } else {
                decoder.decode(out, samples.iter().step_by(run.stride).map(value), mask)
            }
        }};
    }
    match sample_type {
        SampleType::Byte => decode!(u8, 1),
        SampleType::Int8 => decode!(i8, 1),
        SampleType::UInt16 => decode!(u16, 2),
        SampleType::Int16 => decode!(i16, 2),
        SampleType::UInt32 => decode!(u32, 4),
        SampleType::Int32 => decode!(i32, 4),
        SampleType::Float32 => decode!(f32, 4),
        SampleType::Float64 => decode!(f64, 8),
    }
}

/// Marks the pixels of a run whose mask or alpha sample is not zero. `bytes` is 0 for single bits.
pub(super) fn valid_pixels(run: &Run<'_>, bytes: usize, fill: bool, out: &mut [u8]) {
    match run.row {
        // A mask that was never written is zero; an alpha band holds what the heights hold.
        None => out.fill(u8::from(fill && bytes > 0)),
        Some(row) => {
            for (i, valid) in out.iter_mut().enumerate() {
                let sample = run.first + i * run.stride;
                *valid = if bytes == 0 {
                    row[sample / 8] >> (7 - sample % 8) & 1
                } else {
                    u8::from(row[sample * bytes..][..bytes].iter().any(|byte| *byte != 0))
                };
            }
        }
    }
}

/// What the directories say, in the form that both readers share.
fn describe(
    path: &Path,
    tiff: &TiffFile,
    sample_type: SampleType,
    block: (u32, u32),
    has_mask: bool,
) -> Found {
    let image = &tiff.image;
    let mut warnings = truncation_warning(tiff);
    let crs = tiff.geo_keys.as_ref().and_then(|keys| match CrsSpec::from_geokeys(keys) {
        Ok(crs) => Some(crs),
        Err(error) => {
            warnings.push(format!("the file's coordinate system is not understood: {error}"));
            None
        }
    });
    if tiff.control_points {
        warnings.push(
            "the file is georeferenced by control points only, which are not read; make it \
             north-up with gdalwarp"
                .to_owned(),
        );
    }
    let number = |role| tiff.role(role).and_then(|text| text.trim().parse::<f64>().ok());
    let plain = |item: &&MetadataItem| {
        item.domain.is_empty() && item.role.is_empty() && item.sample.unwrap_or(0) == 0
    };
    Found {
        width: image.width,
        height: image.height,
        geotransform: tiff.geotransform.or_else(|| world_file(path, &WORLD_FILES)),
        crs,
        sample_type,
        nodata: tiff.nodata,
        scale: number("scale").unwrap_or(1.0),
        offset: number("offset").unwrap_or(0.0),
        band_unit: tiff.role("unittype").unwrap_or_default().to_owned(),
        metadata: tiff
            .items
            .iter()
            .filter(plain)
            .map(|item| (item.name.clone(), item.value.clone()))
            .collect(),
        block,
        compression: image.compression_name(),
        overviews: tiff.overviews,
        bands: u32::from(image.samples),
        has_mask,
        warnings,
    }
}

/// A warning about strips or tiles beyond the end of the file: reading those fails.
pub(super) fn truncation_warning(tiff: &TiffFile) -> Vec<String> {
    let (missing, all) = (tiff.truncated_chunks, tiff.image.chunks_per_band());
    if missing == 0 {
        return Vec::new();
    }
    vec![format!(
        "the file is truncated: {missing} of {all} strips or tiles lie beyond its end and cannot \
         be read; copy it again"
    )]
}

/// The sample type, or what is not supported.
fn sample_type(image: &TiffImage) -> Result<SampleType, String> {
    Ok(match (image.format, image.bits) {
        // 4, undefined, is unsigned to GDAL.
        (1 | 4, 8) => SampleType::Byte,
        (2, 8) => SampleType::Int8,
        (1 | 4, 16) => SampleType::UInt16,
        (2, 16) => SampleType::Int16,
        (1 | 4, 32) => SampleType::UInt32,
        (2, 32) => SampleType::Int32,
        (3, 32) => SampleType::Float32,
        (3, 64) => SampleType::Float64,
        (5 | 6, bits) => return Err(format!("complex samples of {bits} bits")),
        (3, bits) => return Err(format!("floating-point samples of {bits} bits")),
        (_, bits) => return Err(format!("integer samples of {bits} bits")),
    })
}

fn check_mask(mask: &TiffImage) -> Result<(), String> {
    check_supported(mask)?;
    match mask.bits {
        1 if mask.predictor == 1 || mask.compression == 1 => Ok(()),
        8 => Ok(()),
        bits => Err(format!("{bits} bits")),
    }
}

/// The last of several bands, where it holds alpha values (ExtraSamples 1 or 2).
fn alpha_band(image: &TiffImage) -> Option<usize> {
    let is_alpha = matches!(image.extra_samples.last(), Some(1 | 2)) && image.samples > 1;
    is_alpha.then(|| usize::from(image.samples) - 1)
}

fn unsupported(what: &str) -> String {
    format!(
        "holds {what}, which this build cannot decode; rewrite it (gdal_translate -ot Float32 -co \
         TILED=YES -co COMPRESS=DEFLATE in.tif out.tif), or use a build with GDAL"
    )
}

/// The path with something put behind its whole name.
pub(crate) fn beside(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(suffix);
    PathBuf::from(name)
}

/// Refuses a raster with side files that would change what GDAL reads: the two builds must not
/// give different heights for the same file without a word.
fn refuse_side_files(path: &Path, nodata: Option<f64>) -> Result<(), RasterError> {
    let refuse = |side: &Path, what: &str| {
        let reason = format!(
            "the side file {} {what}, and this build reads no side files; write it into the \
             raster (gdal_translate in.tif out.tif), remove it, or use a build with GDAL",
            side.display()
        );
        Err(RasterError::Unreadable { path: path.to_owned(), reason })
    };
    let mask = beside(path, ".msk");
    if mask.exists() {
        return refuse(&mask, "holds a mask");
    }
    let auxiliary = beside(path, ".aux.xml");
    if let Ok(bytes) = std::fs::read(&auxiliary) {
        let text = String::from_utf8_lossy(&bytes);
        if let Some(element) = SIDE_FILE_ELEMENTS.iter().find(|element| text.contains(**element)) {
            return refuse(&auxiliary, &format!("changes {}", &element[1..]));
        }
        let mut items = text.split("<MDI key=\"").skip(1).filter_map(|rest| rest.split('"').next());
        if let Some(item) = items.find(|item| is_unit_item(item)) {
            return refuse(&auxiliary, &format!("states the unit of heights ({item})"));
        }
        // GDAL repeats there a value that lost digits in the raster's own tag.
        let same = |value: &str| {
            let value = parse_nodata(value).unwrap_or(f64::NAN);
            nodata.is_some_and(|own| own as f32 == value as f32 || (own.is_nan() && value.is_nan()))
        };
        let other = text
            .split("<NoDataValue")
            .skip(1)
            .filter_map(|rest| rest.split(['>', '<']).nth(1))
            .find(|value| !same(value));
        if let Some(other) = other {
            return refuse(&auxiliary, &format!("sets the no-data value {other}"));
        }
    }
    Ok(())
}

/// Extensions of a TIFF's world file.
const WORLD_FILES: [&str; 6] = ["tfw", "tifw", "wld", "TFW", "TIFW", "WLD"];

/// The grid of a world file beside the raster: six lines, for the centre of the first pixel.
pub(crate) fn world_file(path: &Path, extensions: &[impl AsRef<str>]) -> Option<GeoTransform> {
    let text = extensions.iter().find_map(|extension| {
        std::fs::read_to_string(path.with_extension(extension.as_ref())).ok()
    })?;
    let values: Vec<f64> =
        text.split_whitespace().map(|v| v.parse().ok()).collect::<Option<_>>()?;
    let [a, d, b, e, c, f] = values.get(..6)?.try_into().ok()?;
    Some(GeoTransform([c - 0.5 * a - 0.5 * b, a, b, f - 0.5 * d - 0.5 * e, d, e]))
}
