//! WKT definitions of CRSs: WKT 1 as OGC, GDAL and ESRI write it, and WKT 2 (ISO 19162).
//!
//! Both builds read WKT here, so that a file means the same to both.

mod meaning;
mod tree;

pub(super) use meaning::spec_from_wkt;
