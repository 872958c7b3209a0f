//! Coordinate reference systems: what a raster says about its CRS, and the way from WGS 84 to it.
//!
//! Coordinates come from one code path in every build: closed forms for a table of EPSG codes
//! (checked against PROJ where it is linked), PROJ for every other CRS.

#[cfg(feature = "proj")]
mod authority;
mod closed;
mod conic;
mod ellipsoid;
mod geokeys;
#[cfg(test)]
mod hard_cases;
mod helmert;
mod identify;
#[cfg(feature = "proj")]
mod proj;
mod resolve;
mod scale;
mod spec;
mod table;
mod transverse_mercator;
mod vertical;
mod wkt;

#[cfg(feature = "proj")]
pub use authority::check_against_proj;
pub use conic::LambertConic;
pub use ellipsoid::Ellipsoid;
pub use geokeys::GeoKeys;
pub use helmert::{Convention, DatumStep, Helmert};
pub use resolve::resolve;
pub(crate) use scale::ground_distance_m;
pub use scale::{ScaleFactor, scale_factor};
pub use table::{area_of_use, closed_form_codes};
pub use transverse_mercator::TransverseMercator;

use crate::grid::{LonLat, Projected};
use crate::units::LinearUnit;
use serde::{Deserialize, Serialize};
use std::fmt::Debug;
use std::sync::Arc;

/// What a raster (or the user) says about a coordinate reference system.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CrsSpec {
    /// Name as written, for messages.
    pub name: String,
    /// EPSG code of the horizontal CRS, if stated or identified.
    pub epsg: Option<u32>,
    /// Whether the horizontal axes are angles (degrees).
    pub geographic: bool,
    /// Unit of the horizontal axes, if linear and known.
    pub linear_unit: Option<LinearUnit>,
    /// The vertical part of a compound CRS.
    pub vertical: Option<VerticalCrs>,
    /// The definition as WKT, if the file had one.
    pub wkt: Option<String>,
}

/// The vertical part of a compound CRS.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct VerticalCrs {
    /// Name, for example `NAVD88 height (ftUS)`.
    pub name: String,
    /// EPSG code, if stated.
    pub epsg: Option<u32>,
    /// Unit of the heights.
    pub unit: Option<LinearUnit>,
}

/// One coordinate operation from WGS 84 (EPSG:4326) to a projected CRS, as it goes into manifests.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OperationInfo {
    /// PROJ's name, for example `Inverse of NAD83(HARN) to WGS 84 (3) + SPCS83 Washington South zone (US Survey feet)`.
    pub name: String,
    /// EPSG code of the datum step, if it has one.
    pub code: Option<u32>,
    /// Accuracy stated by the operation's authority, metres.
    pub accuracy_m: Option<f64>,
    /// Grid files that the operation reads.
    pub grids: Vec<String>,
    /// Definition as a PROJ pipeline.
    pub definition: String,
    /// Displacement on the ground that the datum step makes, metres (0 for a null shift), measured
    /// at the area of use given.
    pub datum_shift_m: f64,
    /// `closed form` or `PROJ x.y.z`.
    pub provider: String,
}

/// A way from WGS 84 to a projected CRS and back. Exact: closed forms agree with PROJ to 5e-8 m.
pub trait Projection: Send + Sync + Debug {
    /// WGS 84 longitude and latitude to easting and northing in the CRS's own linear unit.
    ///
    /// # Errors
    /// [`CrsError`] where the projection is undefined.
    fn forward(&self, at: LonLat) -> Result<Projected, CrsError>;

    /// Easting and northing in the CRS's own linear unit to WGS 84.
    ///
    /// # Errors
    /// [`CrsError`] where the projection is undefined.
    fn inverse(&self, at: Projected) -> Result<LonLat, CrsError>;
}

/// Choices that decide which operation serves a CRS.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ResolveOptions {
    /// `--operation`: an EPSG code of a datum operation (`1901`, `EPSG:1901`) or a PROJ pipeline.
    pub operation: Option<String>,
    /// `--proj-network`: lets PROJ fetch grids.
    pub proj_network: bool,
    /// Leaves the datum step out (its shift is under the tolerance).
    pub without_datum_step: bool,
    /// West, south, east, north of the work, degrees: decides among operations and where the datum
    /// shift is measured.
    pub area: Option<[f64; 4]>,
}

/// A CRS with the operation that leads to it.
#[derive(Clone, Debug)]
pub struct ResolvedCrs {
    /// The CRS as asked for, with EPSG code and unit filled in where they were found.
    pub spec: CrsSpec,
    /// Metres per unit of the horizontal axes.
    pub metres_per_unit: f64,
    /// The operation used.
    pub operation: OperationInfo,
    /// The operation as a function.
    pub projection: Arc<dyn Projection>,
    /// Things the user should know: a null shift, a better operation whose grid is missing, a
    /// disagreement between PROJ and the closed form; each names the metres.
    pub warnings: Vec<String>,
}

/// How far a closed form lies from PROJ, over a set of positions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CheckReport {
    /// Number of positions compared.
    pub points: usize,
    /// Largest difference from PROJ's own computation of the same definition, metres on the ground.
    pub same_operation_m: f64,
    /// Largest difference from the operation that PROJ picks by itself there, metres on the ground.
    pub default_operation_m: f64,
    /// Name of the operation that PROJ picks by itself.
    pub default_operation: String,
    /// PROJ's version.
    pub proj_version: String,
}

impl CheckReport {
    /// Agreement that closed forms promise, with the datum step, metres.
    pub const TOLERANCE_M: f64 = 5e-8;

    /// What the user should know: that the closed form is not what PROJ computes, or that PROJ left
    /// to itself would take another operation; each names the metres.
    #[must_use]
    pub fn warnings(&self, resolved: &ResolvedCrs) -> Vec<String> {
        let crs = resolved.spec.label();
        let mut warnings = Vec::new();
        // So written that NaN warns too.
        let agrees = self.same_operation_m <= Self::TOLERANCE_M;
        if !agrees {
            warnings.push(format!(
                "{crs}: `{}` and PROJ {} differ by {:.3e} m for the same operation",
                resolved.operation.provider, self.proj_version, self.same_operation_m
            ));
        }
        if self.default_operation_m > self.same_operation_m.max(Self::TOLERANCE_M) {
            warnings.push(format!(
                "{crs}: PROJ {} left to itself would take `{}` here, which lands {:.3} m away from `{}`; `--operation` chooses",
                self.proj_version,
                self.default_operation,
                self.default_operation_m,
                resolved.operation.name
            ));
        }
        warnings
    }
}

/// Why a CRS cannot be served, or a position not be projected.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CrsError {
    /// Outside the domain of the projection.
    #[error("{projection} is undefined at {what}")]
    Domain {
        /// Name of the projection.
        projection: String,
        /// The position, in words.
        what: String,
    },
    /// Text, WKT or GeoKeys that describe no CRS.
    #[error("`{input}` describes no coordinate reference system: {reason}")]
    Malformed {
        /// What was given, shortened.
        input: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The CRS's axes are angles.
    #[error(
        "{name} is geographic (degrees), and lidar tiles must be in a projected CRS; reproject them (gdalwarp -t_srs EPSG:...), or say `--crs EPSG:...` if the tile's own statement is wrong"
    )]
    Geographic {
        /// The CRS.
        name: String,
    },
    /// The CRS is outside the closed-form table, and no PROJ is linked or PROJ cannot serve it.
    #[error("{name}: {reason}")]
    Unsupported {
        /// The CRS.
        name: String,
        /// Why, and what to do.
        reason: String,
    },
    /// The operation asked for does not lead to the CRS.
    #[error("operation `{operation}` cannot be used for {name}: {reason}")]
    Operation {
        /// What `--operation` said.
        operation: String,
        /// The CRS.
        name: String,
        /// Why, and what to do.
        reason: String,
    },
    /// The parts of a definition disagree (a code and its parameters, for example).
    #[error("{name} contradicts itself: {what}; say which CRS it is with `--crs EPSG:...`")]
    Contradiction {
        /// The CRS.
        name: String,
        /// Both statements.
        what: String,
    },
    /// PROJ failed.
    #[error("PROJ cannot {action}: {message}")]
    Proj {
        /// What was tried.
        action: String,
        /// PROJ's own message.
        message: String,
    },
}
