//! The VIGOR data set: names, folder layout, label and split files, and their ingest.

mod name;

pub use name::{NameError, SatelliteName};
