//! Reading whatever GDAL reads.
//!
//! Blocks of GeoTIFFs are read as they are stored (`GDALReadBlock`), past GDAL's own block cache:
//! blocks are cached once, in the form that is used. Other formats go through `GDALRasterIO`.

use super::gdal_setup::set_up;
use super::header::{Found, Rectangle, block_size, check_memory, finish, stat};
use super::sample::{SampleDecoder, SampleType, UndeclaredNodata};
use super::tiff_directory::TiffFile;
use super::tiff_reader::truncation_warning;
use super::{OpenOptions, RasterError, RasterHeader, RasterReader};
use crate::crs::CrsSpec;
use crate::grid::GeoTransform;
use crate::units::LinearUnit;
use gdal::config::{clear_thread_local_config_option, set_thread_local_config_option};
use gdal::errors::GdalError;
use gdal::raster::{ColorInterpretation, GdalDataType, GdalType, RasterBand};
use gdal::spatial_ref::SpatialRef;
use gdal::{Dataset, DatasetOptions, GdalOpenFlags, Metadata};
use std::path::Path;

/// A raster opened with GDAL: band 1 at full resolution.
#[derive(Debug)]
pub struct GdalReader {
    header: RasterHeader,
    decoder: SampleDecoder,
    dataset: Dataset,
    access: Access,
    mask: Mask,
    mask_values: Vec<u8>,
    undeclared: UndeclaredNodata,
}

/// How samples are fetched.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Access {
    /// Block by block as stored, in the type given.
    Blocks(SampleType),
    /// Window by window.
    Windows,
}

/// What marks valid pixels beside the samples themselves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mask {
    None,
    /// GDAL's mask band of band 1.
    Band,
    /// The alpha band of this number.
    Alpha(usize),
}

impl GdalReader {
    /// Opens a raster and reads its header.
    ///
    /// # Errors
    /// [`RasterError`] when GDAL cannot open the file, when it holds no raster or samples that are
    /// no heights, or when its blocks are beyond the memory allowed.
    pub fn open(path: &Path, options: &OpenOptions) -> Result<Self, RasterError> {
        set_up();
        let metadata = stat(path)?;
        let unreadable = |reason: String| RasterError::Unreadable { path: path.to_owned(), reason };
        let failed = |error: GdalError| unreadable(explain(&error));
        let flags = GdalOpenFlags::GDAL_OF_READONLY
            | GdalOpenFlags::GDAL_OF_RASTER
            | GdalOpenFlags::GDAL_OF_VERBOSE_ERROR;
        let dataset = Dataset::open_ex(
            path,
            DatasetOptions { open_flags: flags, ..DatasetOptions::default() },
        )
        .map_err(|error| {
            unreadable(format!("is no raster that GDAL can read: {}", explain(&error)))
        })?;
        if dataset.raster_count() == 0 {
            return Err(unreadable(subdatasets(&dataset)));
        }
        let band = dataset.rasterband(1).map_err(failed)?;
        let sample_type = sample_type(&band).map_err(unreadable)?;
        let is_tiff = dataset.driver().short_name() == "GTiff";
        let mask = find_mask(&dataset, &band).map_err(failed)?;

        let stored = band.block_size();
        let block = (clamp(stored.0), clamp(stored.1));
        let tiff = is_tiff.then(|| TiffFile::read(path, options.memory_limit).ok()).flatten();
        let (stored, stored_bytes) = match &tiff {
            // GDAL offers the rows of a large compressed strip one by one and decodes the strip
            // from its beginning for each step back; it is read as a whole here.
            Some(tiff)
                if tiff.image.compression != 1
                    && tiff.image.chunk_width.is_multiple_of(block.0.max(1))
                    && tiff.image.chunk_height.is_multiple_of(block.1.max(1)) =>
            {
                ((tiff.image.chunk_width, tiff.image.chunk_height), tiff.image.chunk_bytes())
            }
            _ => {
                let samples = u64::from(block.0) * u64::from(block.1);
                (block, samples * sample_type.bytes() as u64)
            }
        };
        let (width, height) = dataset.raster_size();
        let raster = (clamp(width), clamp(height));
        let block = block_size(raster, stored);
        check_memory(path, options, stored, block, stored_bytes)?;

        let found =
            describe(&dataset, &band, tiff.as_ref(), sample_type, block, mask).map_err(failed)?;
        let (header, decoder) = finish(path, &metadata, options, found)?;
        let access = if is_tiff { block_access(&band, sample_type) } else { Access::Windows };
        Ok(Self {
            header,
            access,
            mask: if decoder.use_mask { mask } else { Mask::None },
            mask_values: Vec::new(),
            decoder,
            dataset,
            undeclared: UndeclaredNodata::default(),
        })
    }

    fn read(&mut self, rectangle: Rectangle, out: &mut [f32]) -> Result<(), GdalError> {
        let band = self.dataset.rasterband(1)?;
        self.mask_values.clear();
        match self.mask {
            Mask::None => {}
            Mask::Band => {
                let mask = band.open_mask_band()?;
                self.mask_values = read_window::<u8>(&mask, rectangle)?;
            }
            Mask::Alpha(number) => {
                let alpha = self.dataset.rasterband(number)?;
                let values = read_window::<f64>(&alpha, rectangle)?;
                self.mask_values.extend(values.into_iter().map(|v| u8::from(v != 0.0)));
            }
        }
        let mask = (self.mask != Mask::None).then_some(self.mask_values.as_slice());
        let mut sink = Sink {
            decoder: &self.decoder,
            rectangle,
            block_width: self.header.block_width as usize,
            mask,
            out,
            undeclared: &mut self.undeclared,
        };
        match self.access {
            Access::Windows => {
                let values = read_window::<f64>(&band, rectangle)?;
                for (y, row) in values.chunks_exact(rectangle.width).enumerate() {
                    sink.row(rectangle.x, rectangle.y + y, row.iter().copied());
                }
                Ok(())
            }
            Access::Blocks(SampleType::Byte) => read_blocks::<u8>(&band, &mut sink, f64::from),
            // GDAL before 3.7 hands signed bytes out as bytes.
            Access::Blocks(SampleType::Int8) => {
                read_blocks::<u8>(&band, &mut sink, |v| f64::from(v.cast_signed()))
            }
            Access::Blocks(SampleType::UInt16) => read_blocks::<u16>(&band, &mut sink, f64::from),
            Access::Blocks(SampleType::Int16) => read_blocks::<i16>(&band, &mut sink, f64::from),
            Access::Blocks(SampleType::UInt32) => read_blocks::<u32>(&band, &mut sink, f64::from),
            Access::Blocks(SampleType::Int32) => read_blocks::<i32>(&band, &mut sink, f64::from),
            Access::Blocks(SampleType::Float32) => read_blocks::<f32>(&band, &mut sink, f64::from),
            Access::Blocks(SampleType::Float64) => read_blocks::<f64>(&band, &mut sink, |v| v),
        }
    }
}

impl RasterReader for GdalReader {
    fn header(&self) -> &RasterHeader {
        &self.header
    }

    fn read_block(&mut self, bx: u32, by: u32, out: &mut Vec<f32>) -> Result<(), RasterError> {
        let rectangle =
            self.header.block_rectangle(bx, by).ok_or_else(|| self.header.no_such_block(bx, by))?;
        out.clear();
        out.resize(self.header.block_width as usize * rectangle.height, f32::NAN);
        self.read(rectangle, out).map_err(|error| self.header.block_error(bx, by, explain(&error)))
    }

    fn undeclared_nodata(&self) -> UndeclaredNodata {
        self.undeclared
    }
}

/// Where the samples of one rectangle go.
struct Sink<'a> {
    decoder: &'a SampleDecoder,
    rectangle: Rectangle,
    block_width: usize,
    mask: Option<&'a [u8]>,
    out: &'a mut [f32],
    undeclared: &'a mut UndeclaredNodata,
}

impl Sink<'_> {
    /// Takes samples of row `y` from column `x` on, in raster coordinates within the rectangle.
    fn row(&mut self, x: usize, y: usize, samples: impl ExactSizeIterator<Item = f64>) {
        let (x, y) = (x - self.rectangle.x, y - self.rectangle.y);
        let width = samples.len();
        let mask = self.mask.map(|m| &m[y * self.rectangle.width + x..][..width]);
        let out = &mut self.out[y * self.block_width + x..][..width];
        *self.undeclared |= self.decoder.decode(out, samples, mask);
    }
}

fn read_window<T: Copy + GdalType>(
    band: &RasterBand<'_>,
    rectangle: Rectangle,
) -> Result<Vec<T>, GdalError> {
    let origin = (isize::try_from(rectangle.x)?, isize::try_from(rectangle.y)?);
    let size = (rectangle.width, rectangle.height);
    let (_, data) = band.read_as::<T>(origin, size, size, None)?.into_shape_and_vec();
    Ok(data)
}

fn read_blocks<T: Copy + GdalType>(
    band: &RasterBand<'_>,
    sink: &mut Sink<'_>,
    value: impl Fn(T) -> f64 + Copy,
) -> Result<(), GdalError> {
    let (width, height) = band.block_size();
    let rectangle = sink.rectangle;
    let (right, bottom) = (rectangle.x + rectangle.width, rectangle.y + rectangle.height);
    for by in rectangle.y / height..bottom.div_ceil(height) {
        for bx in rectangle.x / width..right.div_ceil(width) {
            let block = band.read_block::<T>((bx, by))?;
            let (left, top) = (bx * width, by * height);
            let columns = width.min(right - left);
            for y in top..(top + height).min(bottom) {
                let row = &block.data()[(y - top) * width..][..columns];
                sink.row(left, y, row.iter().map(|v| value(*v)));
            }
        }
    }
    Ok(())
}

fn clamp(size: usize) -> u32 {
    u32::try_from(size).unwrap_or(u32::MAX)
}

/// The sample type, or why there are no heights in such samples.
fn sample_type(band: &RasterBand<'_>) -> Result<SampleType, String> {
    let signed = || {
        let pixel_type = band.metadata_item("PIXELTYPE", "IMAGE_STRUCTURE");
        pixel_type.is_some_and(|t| t == "SIGNEDBYTE")
    };
    Ok(match band.band_type() {
        GdalDataType::UInt8 if signed() => SampleType::Int8,
        GdalDataType::UInt8 => SampleType::Byte,
        GdalDataType::UInt16 => SampleType::UInt16,
        GdalDataType::Int16 => SampleType::Int16,
        GdalDataType::UInt32 => SampleType::UInt32,
        GdalDataType::Int32 => SampleType::Int32,
        GdalDataType::Float32 => SampleType::Float32,
        GdalDataType::Float64 => SampleType::Float64,
        other if other.name() == "Int8" => SampleType::Int8,
        other => {
            return Err(format!(
                "holds samples of type {}, which are not read as heights; convert it with \
                 gdal_translate -ot Float32",
                other.name()
            ));
        }
    })
}

/// Stored blocks can be taken over where their type is one that the `gdal` crate has.
fn block_access(band: &RasterBand<'_>, sample_type: SampleType) -> Access {
    match band.band_type() {
        GdalDataType::UInt8
        | GdalDataType::UInt16
        | GdalDataType::Int16
        | GdalDataType::UInt32
        | GdalDataType::Int32
        | GdalDataType::Float32
        | GdalDataType::Float64 => Access::Blocks(sample_type),
        // Int8 of GDAL 3.7.
        _ => Access::Windows,
    }
}

/// Mask and alpha, as `TiffReader` sees them: an internal or external mask band first, else a last
/// band of alpha values of any sample type.
fn find_mask(dataset: &Dataset, band: &RasterBand<'_>) -> Result<Mask, GdalError> {
    let flags = band.mask_flags()?;
    if !flags.is_all_valid() && !flags.is_nodata() && !flags.is_alpha() {
        return Ok(Mask::Band);
    }
    let count = dataset.raster_count();
    let last = dataset.rasterband(count)?.color_interpretation();
    let is_alpha = count > 1 && last == ColorInterpretation::AlphaBand;
    Ok(if is_alpha { Mask::Alpha(count) } else { Mask::None })
}

fn describe(
    dataset: &Dataset,
    band: &RasterBand<'_>,
    tiff: Option<&TiffFile>,
    sample_type: SampleType,
    block: (u32, u32),
    mask: Mask,
) -> Result<Found, GdalError> {
    let (width, height) = dataset.raster_size();
    let mut warnings = tiff.map(truncation_warning).unwrap_or_default();
    let crs = dataset.spatial_ref().ok().map(|srs| read_crs(&srs, &mut warnings));
    let geotransform = dataset.geo_transform().ok().map(GeoTransform);
    if geotransform.is_none() && tiff.is_some_and(|tiff| tiff.control_points) {
        warnings.push(
            "the file is georeferenced by control points only, which are not read; make it \
             north-up with gdalwarp"
                .to_owned(),
        );
    }
    let compression = tiff.map(|tiff| tiff.image.compression_name()).unwrap_or_else(|| {
        dataset
            .metadata_item("COMPRESSION", "IMAGE_STRUCTURE")
            .map_or_else(|| "none".to_owned(), |name| name.to_ascii_lowercase())
    });
    let items = |items: Option<Vec<String>>| {
        items.unwrap_or_default().into_iter().filter_map(|item| {
            item.split_once('=').map(|(name, value)| (name.to_owned(), value.to_owned()))
        })
    };
    Ok(Found {
        width: clamp(width),
        height: clamp(height),
        geotransform,
        crs,
        sample_type,
        nodata: band.no_data_value(),
        scale: band.scale().unwrap_or(1.0),
        offset: band.offset().unwrap_or(0.0),
        band_unit: band.unit(),
        metadata: items(dataset.metadata_domain(""))
            .chain(items(band.metadata_domain("")))
            .collect(),
        block,
        compression,
        overviews: u32::try_from(band.overview_count()?).unwrap_or(0),
        bands: clamp(dataset.raster_count()),
        has_mask: mask != Mask::None,
        warnings,
    })
}

/// The CRS as GDAL sees it, through its WKT; where that is not understood, what GDAL says of it.
fn read_crs(srs: &SpatialRef, warnings: &mut Vec<String>) -> CrsSpec {
    let epsg = |srs: &SpatialRef| match srs.auth_name().as_deref() {
        Some("EPSG") => srs.auth_code().ok().and_then(|code| u32::try_from(code).ok()),
        _ => None,
    };
    let wkt = export_wkt(srs);
    let mut spec = match wkt.as_deref().map(CrsSpec::from_wkt) {
        Some(Ok(spec)) => spec,
        failed => {
            if let Some(Err(error)) = failed {
                warnings.push(format!("the file's coordinate system is not understood: {error}"));
            }
            let linear = !srs.is_geographic() && !srs.is_geocentric();
            CrsSpec {
                name: srs.name().unwrap_or_else(|| "unnamed".to_owned()),
                epsg: if srs.is_compound() { None } else { epsg(srs) },
                geographic: srs.is_geographic(),
                linear_unit: linear
                    .then(|| LinearUnit::from_metres_per_unit(srs.linear_units()))
                    .flatten(),
                vertical: None,
                wkt,
            }
        }
    };
    if spec.epsg.is_none() && !srs.is_compound() {
        let mut identified = srs.clone();
        spec.epsg = identified.auto_identify_epsg().ok().and_then(|()| epsg(&identified));
    }
    spec
}

/// WKT 2, which keeps what WKT 1 cannot say; WKT 1 where GDAL cannot write that.
fn export_wkt(srs: &SpatialRef) -> Option<String> {
    const FORMAT: &str = "OSR_WKT_FORMAT";
    let wkt2 = set_thread_local_config_option(FORMAT, "WKT2_2019").and_then(|()| srs.to_wkt());
    // Clearing fails only for names with a zero byte.
    let cleared = clear_thread_local_config_option(FORMAT);
    debug_assert!(cleared.is_ok());
    wkt2.or_else(|_| srs.to_wkt()).ok().filter(|wkt| !wkt.is_empty())
}

fn subdatasets(dataset: &Dataset) -> String {
    let names: Vec<String> = dataset
        .metadata_domain("SUBDATASETS")
        .unwrap_or_default()
        .into_iter()
        .filter(|item| item.split('=').next().is_some_and(|name| name.ends_with("_NAME")))
        .take(4)
        .collect();
    if names.is_empty() {
        "holds no raster band".to_owned()
    } else {
        format!("holds several rasters ({}); extract one with gdal_translate", names.join(", "))
    }
}

/// GDAL's own words.
pub(super) fn explain(error: &GdalError) -> String {
    match error {
        GdalError::CplError { msg, .. } | GdalError::NullPointer { msg, .. } if !msg.is_empty() => {
            msg.clone()
        }
        other => other.to_string(),
    }
}
