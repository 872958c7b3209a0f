//! A sample to be scored, and the schema of reports.

/// The sample is also compiled inside the library, which has another name there.
use sat3d as library;

pub mod sample;
pub mod schema;
