//! The VIGOR data set: names, folder layout, label and split files, and their ingest.
//!
//! Data flows one way: [`Layout`] says where things lie, [`Dataset`] reads the text files,
//! [`measure()`] finds where each panorama really lies in its images, [`Ingest`] puts it together
//! with the image checks, and the manifest and the [`Summary`] say the result.

mod city;
mod dataset;
mod images;
mod ingest;
mod kinds;
mod layout;
mod manifest;
mod measure;
mod name;
mod overlap;
mod panorama;
mod problem;
mod statistics;
mod summary;
mod text;
mod utm;

pub use city::{CITIES, KnownCity, canonical_name};
pub use dataset::{Dataset, FileReport, Pair, Panorama, Satellite};
pub use images::{Expected, ImageProblem, Verify, check};
pub use ingest::{Ingest, IngestError, IngestOptions};
pub use kinds::{ImageSize, ImageStatus, LabelKind, Split};
pub use layout::{CityFolder, Layout, LayoutError, TextFile};
pub use manifest::table as manifest_table;
pub use measure::{Measured, Residual, fitted_resolution, ground_pixel_size, measure};
pub use name::{NameError, SatelliteName};
pub use overlap::{Cover, MAX_DEPTH, Rectangle};
pub use panorama::PanoramaName;
pub use problem::{Problem, ProblemKind};
pub use statistics::{
    Distribution, LabelStatistics, NotReproduced, OverlapStatistics, RoleStatistics, TrainTest,
};
pub use summary::{BadImage, CitySummary, ImageCounts, Summary};
pub use text::Format;
pub use utm::{UtmZone, UtmZones, corrected_offset};
