//! Masks: classes on the ground, from a raster or from polygons, in any CRS.

use super::NO_CLASS;
use super::geojson::{self, Features};
use super::polygons::{ClassPolygon, PolygonSet, densify, nothing};
use crate::crs::{CrsError, CrsSpec};
use crate::grid::{ImageGrid, LonLat, MAX_LATITUDE_DEG, Projected, WGS84_A, mercator_of_latitude};
use crate::lidar::{EdgeRule, Placement, Resampling, SingleRaster, SingleRasterError};
use crate::raster::{OpenOptions, RasterError, open};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// How a mask is read.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct MaskOptions {
    /// Property of GeoJSON features that holds the class.
    pub class_field: Option<String>,
    /// CRS, in the place of what the file says.
    pub crs: Option<String>,
    /// Names of classes, by the value as the file has it (`2`, `building`).
    pub names: Option<BTreeMap<String, String>>,
}

/// Why a file cannot serve as a mask.
#[derive(Debug, thiserror::Error)]
pub enum MaskError {
    /// It cannot be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The raster cannot be read or placed.
    #[error(transparent)]
    Raster(#[from] SingleRasterError),
    /// The raster holds something else than classes.
    #[error(
        "{}: {what}; a mask holds whole numbers from 0 to 65534, one for each class",
        path.display()
    )]
    NoClasses {
        /// The file.
        path: PathBuf,
        /// What was found.
        what: String,
    },
    /// The file as a whole is no usable GeoJSON.
    #[error("{}: {reason}", path.display())]
    GeoJson {
        /// The file.
        path: PathBuf,
        /// Why, and what to do.
        reason: String,
    },
    /// One feature is not usable.
    #[error("{}: feature {feature} (counted from 0): {reason}", path.display())]
    Feature {
        /// The file.
        path: PathBuf,
        /// Number of the feature, from 0.
        feature: usize,
        /// Why, and what to do.
        reason: String,
    },
    /// The CRS cannot be served.
    #[error("{}: {source}", path.display())]
    Crs {
        /// The file.
        path: PathBuf,
        /// Why.
        source: CrsError,
    },
}

/// Classes on the ground, opened once and asked by any number of threads.
#[derive(Debug)]
pub struct Mask {
    path: PathBuf,
    labels: Vec<String>,
    source: Source,
    warnings: Vec<String>,
}

#[derive(Debug)]
enum Source {
    /// `classes[value]` is the number of the class.
    Raster { raster: Box<SingleRaster>, classes: Vec<u16> },
    /// The class of pixels outside of every polygon.
    Polygons { polygons: PolygonSet, outside: u16 },
}

/// Largest value of a class in a raster.
const MAX_VALUE: usize = 65_534;
/// Most different values that a raster of classes may hold.
const MAX_RASTER_CLASSES: usize = 256;

impl Mask {
    /// Opens a mask.
    ///
    /// A **raster** is whatever the program reads, in any CRS; its values are whole numbers from 0
    /// to 65534, no-data is no class. It is read once as a whole, block by block, to learn which
    /// classes there are.
    ///
    /// **GeoJSON** (by the file's end, `.geojson` or `.json`, or its first character) is a
    /// FeatureCollection, a Feature, a Polygon or a MultiPolygon. The class is the property
    /// `class_field`, text or number; without that there are two, `inside` and `outside`. Where
    /// polygons overlap the later one counts. Coordinates are WGS 84 longitude and latitude (RFC
    /// 7946) unless the file has the older `crs` member or `crs` is given. Lines are straight in the
    /// file's CRS; the course that is used deviates from that by less than 0.01 pixel (0.5 mm of
    /// EPSG:3857). The antimeridian is not looked at.
    ///
    /// # Errors
    /// [`MaskError`] naming file, feature, value, and what to do.
    pub fn open(path: &Path, options: &MaskOptions) -> Result<Self, MaskError> {
        if is_geojson(path)? {
            return Self::from_geojson(path, options);
        }
        let raster = SingleRaster::open(path, &OpenOptions::default(), options.crs.as_deref())?;
        let values = values_of(path)?;
        let mut classes = vec![NO_CLASS; MAX_VALUE + 1];
        let mut labels = Vec::new();
        for value in values {
            classes[value] = labels.len() as u16;
            labels.push(named(&value.to_string(), options));
        }
        let warnings = raster.warnings().to_vec();
        let raster = Box::new(raster.without_unit());
        let source = Source::Raster { raster, classes };
        Ok(Self { path: path.to_owned(), labels, source, warnings })
    }

    fn from_geojson(path: &Path, options: &MaskOptions) -> Result<Self, MaskError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| MaskError::Io { path: path.to_owned(), source })?;
        let features = geojson::read(path, &text, options)?;
        drop(text);
        let (classes, outside) = match &options.class_field {
            Some(field) => (geojson::sorted_classes(path, field, &features)?, NO_CLASS),
            None => (vec!["inside".to_owned(), "outside".to_owned()], 1),
        };
        let mut warnings = features.warnings.clone();
        let polygons = place(path, features, &classes, options, &mut warnings)?;
        let labels = classes.iter().map(|class| named(class, options)).collect();
        let source = Source::Polygons { polygons: PolygonSet::new(polygons), outside };
        Ok(Self { path: path.to_owned(), labels, source, warnings })
    }

    /// Names of the classes; their numbers are the places in this list.
    #[must_use]
    pub fn labels(&self) -> &[String] {
        &self.labels
    }

    /// What the user should know.
    #[must_use]
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// What the classes are, in a sentence.
    pub(super) fn description(&self) -> String {
        let name = self.path.file_name().unwrap_or(self.path.as_os_str());
        format!("Class of the mask {}.", Path::new(name).display())
    }

    /// Classes on an image grid of the Web-Mercator plane, at the centres of its pixels, row-major;
    /// `u16::MAX` for none.
    ///
    /// # Errors
    /// [`MaskError::Raster`] when a block cannot be read. Polygons never fail.
    pub fn classes(&self, grid: &ImageGrid) -> Result<Vec<u16>, MaskError> {
        match &self.source {
            Source::Raster { raster, classes } => {
                let values = raster.on_grid(grid, Resampling::Nearest, EdgeRule::Renormalise)?;
                let class = |value: f32| {
                    if value.is_nan() { NO_CLASS } else { classes[value as usize] }
                };
                Ok(values.into_iter().map(class).collect())
            }
            Source::Polygons { polygons, outside } => {
                let mut classes = nothing(grid);
                classes.fill(*outside);
                polygons.paint(grid, &mut classes);
                Ok(classes)
            }
        }
    }
}

fn named(value: &str, options: &MaskOptions) -> String {
    let names = options.names.as_ref();
    names.and_then(|names| names.get(value)).map_or_else(|| value.to_owned(), Clone::clone)
}

fn is_geojson(path: &Path) -> Result<bool, MaskError> {
    let end = path.extension().and_then(|end| end.to_str()).unwrap_or("").to_ascii_lowercase();
    if matches!(&end[..], "geojson" | "json") {
        return Ok(true);
    }
    let fail = |source| MaskError::Io { path: path.to_owned(), source };
    if std::fs::metadata(path).map_err(fail)?.is_dir() {
        return Ok(false);
    }
    let mut start = [0_u8; 64];
    let mut file = std::fs::File::open(path).map_err(fail)?;
    let read = std::io::Read::read(&mut file, &mut start).map_err(fail)?;
    let start = start[..read].strip_prefix(b"\xef\xbb\xbf").unwrap_or(&start[..read]);
    Ok(start.trim_ascii_start().first() == Some(&b'{'))
}

/// The values that a raster holds, ascending. Its blocks are read one after the other.
fn values_of(path: &Path) -> Result<Vec<usize>, MaskError> {
    let raster = |error: RasterError| MaskError::Raster(error.into());
    let fail = |what: String| MaskError::NoClasses { path: path.to_owned(), what };
    let mut reader = open(path, &OpenOptions::default()).map_err(raster)?;
    let (across, down) = reader.header().blocks();
    let mut seen = vec![false; MAX_VALUE + 1];
    let mut block = Vec::new();
    for by in 0..down {
        for bx in 0..across {
            reader.read_block(bx, by, &mut block).map_err(raster)?;
            for value in block.iter().copied().filter(|value| !value.is_nan()) {
                let whole = value as usize;
                if whole as f32 != value || whole > MAX_VALUE {
                    return Err(fail(format!("it holds the value {value}")));
                }
                seen[whole] = true;
            }
        }
    }
    let values: Vec<usize> = (0..=MAX_VALUE).filter(|value| seen[*value]).collect();
    match values.len() {
        0 => Err(fail("it holds no data at all".to_owned())),
        count if count > MAX_RASTER_CLASSES => Err(fail(format!(
            "it holds {count} different values, more than {MAX_RASTER_CLASSES}: is it a raster of heights?"
        ))),
        _ => Ok(values),
    }
}

/// Brings polygons onto the Web-Mercator plane.
fn place(
    path: &Path,
    features: Features,
    classes: &[String],
    options: &MaskOptions,
    warnings: &mut Vec<String>,
) -> Result<Vec<ClassPolygon>, MaskError> {
    let wrong_crs = |source| MaskError::Crs { path: path.to_owned(), source };
    let stated = options.crs.as_deref().or(features.crs.as_deref()).unwrap_or("EPSG:4326");
    let spec = CrsSpec::from_user_input(stated).map_err(wrong_crs)?;
    let placement = Placement::of(&spec, None).map_err(wrong_crs)?;
    let area = corners(&features).and_then(|corners| area_of(&placement, corners));
    let placement = match area {
        Some(area) => Placement::of(&spec, Some(area)).map_err(wrong_crs)?,
        None => placement,
    };
    warnings.extend(placement.warnings.iter().cloned());
    let degrees = spec.geographic;
    let on_plane = |[x, y]: [f64; 2]| -> Result<[f64; 2], CrsError> {
        let inside = if degrees { x.abs() <= 180.0 && y.abs() <= 90.0 } else { true };
        if !(inside && x.is_finite() && y.is_finite()) {
            return Err(CrsError::Domain { projection: spec.label(), what: format!("{x}, {y}") });
        }
        mercator(placement.projection.inverse(Projected { x, y })?)
    };
    let mut polygons = Vec::new();
    for (feature, class, parts) in features.features {
        let class = class.and_then(|class| classes.iter().position(|known| *known == class));
        for part in parts {
            let mut rings = Vec::with_capacity(part.len());
            for (number, ring) in part.iter().enumerate() {
                rings.push(densify(ring, &on_plane).map_err(|(vertex, error)| {
                    MaskError::Feature {
                        path: path.to_owned(),
                        feature,
                        reason: format!(
                            "position {vertex} of ring {number} is out of range: {error}; if the file is in another CRS than {stated}, state it (for example EPSG:2927)"
                        ),
                    }
                })?);
            }
            polygons.push(ClassPolygon {
                class: class.unwrap_or(0) as u16,
                order: polygons.len(),
                rings,
            });
        }
    }
    Ok(polygons)
}

/// EPSG:3857 coordinates. Images end where the Web-Mercator square does, so what lies nearer to a
/// pole may be put just beyond it.
fn mercator(at: LonLat) -> Result<[f64; 2], CrsError> {
    let lat_deg = at.lat_deg.clamp(-MAX_LATITUDE_DEG - 0.1, MAX_LATITUDE_DEG + 0.1);
    let x = WGS84_A * at.lon_deg.to_radians();
    let y = WGS84_A * mercator_of_latitude(lat_deg);
    if x.is_finite() && y.is_finite() {
        return Ok([x, y]);
    }
    let what = format!("longitude {}, latitude {}", at.lon_deg, at.lat_deg);
    Err(CrsError::Domain { projection: "Web Mercator".to_owned(), what })
}

/// Lowest and highest coordinates of all polygons.
fn corners(features: &Features) -> Option<[f64; 4]> {
    let points = features.features.iter().flat_map(|(_, _, parts)| parts).flatten().flatten();
    points.fold(None, |bounds: Option<[f64; 4]>, [x, y]| {
        let b = bounds.unwrap_or([*x, *y, *x, *y]);
        Some([b[0].min(*x), b[1].min(*y), b[2].max(*x), b[3].max(*y)])
    })
}

/// West, south, east, north in degrees.
fn area_of(placement: &Placement, [x0, y0, x1, y1]: [f64; 4]) -> Option<[f64; 4]> {
    let mut area: Option<[f64; 4]> = None;
    for (x, y) in [(x0, y0), (x1, y0), (x0, y1), (x1, y1)] {
        let LonLat { lon_deg: x, lat_deg: y } =
            placement.projection.inverse(Projected { x, y }).ok()?;
        let b = area.unwrap_or([x, y, x, y]);
        area = Some([b[0].min(x), b[1].min(y), b[2].max(x), b[3].max(y)]);
    }
    area
}
