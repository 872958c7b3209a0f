//! Tables that are written as CSV and (Geo)Parquet from one definition.
//!
//! A [`Table`] is a list of typed [`Column`]s of equal length, each with a description that travels
//! in the Parquet file. The bytes depend on the content alone: no times, no machine, no threads.
//!
//! ```
//! use sat3d::table::{Column, Table, wkb};
//!
//! let table = Table::new(vec![
//!     Column::text("stem", "Name of the image without extension", ["satellite_47.6_-122.3"]),
//!     Column::f64("coverage", "Share of valid pixels, 0 to 1", [0.98]),
//!     Column::i64("tiles", "Number of tiles used", [Some(2)]),
//!     Column::geometry("geometry", "Centre of the image", [wkb::point(-122.3, 47.6)]),
//! ])?;
//! assert_eq!(table.to_csv(), b"stem,coverage,tiles\nsatellite_47.6_-122.3,0.98,2\n");
//! assert!(table.to_parquet()?.starts_with(b"PAR1"));
//! # Ok::<(), sat3d::table::TableError>(())
//! ```

mod csv_text;
mod geopackage;
mod parquet_file;
pub mod wkb;

pub use geopackage::{Layer, check_geopackage, write_geopackage};

use crate::batch::write_atomic;
use std::borrow::Cow;
use std::path::{Path, PathBuf};

/// Why a table cannot be made or written.
#[derive(Debug, thiserror::Error)]
pub enum TableError {
    /// Two columns have the same name.
    #[error("the table has two columns named `{column}`")]
    DuplicateColumn {
        /// The name.
        column: String,
    },
    /// A column is longer or shorter than the first.
    #[error("column `{column}` has {rows} rows where the table has {expected}")]
    Length {
        /// Name of the column.
        column: String,
        /// Its rows.
        rows: usize,
        /// Rows of the first column.
        expected: usize,
    },
    /// A value of a dictionary column points past its dictionary.
    #[error("row {row} of column `{column}` refers to entry {key} of a dictionary of {entries}")]
    Key {
        /// Name of the column.
        column: String,
        /// Row, from 0.
        row: usize,
        /// The key.
        key: u32,
        /// Entries in the dictionary.
        entries: usize,
    },
    /// A geometry is no little-endian WKB point or polygon.
    #[error("row {row} of column `{column}` is not a WKB point or polygon")]
    Geometry {
        /// Name of the column.
        column: String,
        /// Row, from 0.
        row: usize,
    },
    /// The Parquet encoder failed.
    #[error("cannot encode the table as Parquet: {source}")]
    Parquet {
        /// What it said.
        #[from]
        source: parquet::errors::ParquetError,
    },
    /// This build has no GDAL.
    #[error(
        "cannot write {}: this sat3d is built without GDAL, which writes GeoPackages; use a build with GDAL, or open the Parquet manifest in QGIS instead",
        path.display()
    )]
    NoGeoPackage {
        /// The file asked for.
        path: PathBuf,
    },
    /// GDAL could not write a GeoPackage.
    #[cfg(feature = "gdal")]
    #[error("cannot write {}: {source}", path.display())]
    GeoPackage {
        /// The file.
        path: PathBuf,
        /// What GDAL says.
        source: gdal::errors::GdalError,
    },
    /// The file could not be written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
}

/// The CRS of a geometry column.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum GeometryCrs {
    /// WGS 84 longitude, latitude in degrees (OGC:CRS84, GeoParquet's default).
    #[default]
    Crs84,
    /// Any other CRS as PROJJSON; axis order in the geometry is always x, y.
    Projjson(serde_json::Value),
}

/// The values of a column. A missing value is `None`, or NaN in [`F64`](Self::F64).
#[derive(Clone, Debug, PartialEq)]
pub enum ColumnData {
    /// Text. CSV cannot tell a missing text from an empty one.
    Utf8(Vec<Option<String>>),
    /// Text of which few values are distinct: `keys` index into `values`.
    Dictionary {
        /// The distinct values.
        values: Vec<String>,
        /// One index per row.
        keys: Vec<Option<u32>>,
    },
    /// Floating-point numbers; NaN is a missing value.
    F64(Vec<f64>),
    /// Whole numbers.
    I64(Vec<Option<i64>>),
    /// Truth values, `true` and `false` in CSV.
    Bool(Vec<Option<bool>>),
    /// Geometries as little-endian WKB points or polygons (see [`wkb`]). They are left out of CSV.
    Wkb {
        /// The geometries.
        values: Vec<Option<Vec<u8>>>,
        /// Their CRS.
        crs: GeometryCrs,
    },
}

impl ColumnData {
    /// Number of rows.
    #[must_use]
    pub fn len(&self) -> usize {
        match self {
            Self::Utf8(v) => v.len(),
            Self::Dictionary { keys, .. } => keys.len(),
            Self::F64(v) => v.len(),
            Self::I64(v) => v.len(),
            Self::Bool(v) => v.len(),
            Self::Wkb { values, .. } => values.len(),
        }
    }

    /// Whether there are no rows.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// A named, described column.
#[derive(Clone, Debug, PartialEq)]
pub struct Column {
    /// Name: the CSV header and the Parquet field.
    pub name: Cow<'static, str>,
    /// What the values mean, with units; kept in the Parquet file's metadata.
    pub description: Cow<'static, str>,
    /// The values.
    pub data: ColumnData,
}

impl Column {
    /// A column of any kind.
    pub fn new(
        name: impl Into<Cow<'static, str>>,
        description: impl Into<Cow<'static, str>>,
        data: ColumnData,
    ) -> Self {
        Self { name: name.into(), description: description.into(), data }
    }

    /// A text column without missing values; for those, use [`ColumnData::Utf8`].
    pub fn text<T: Into<String>>(
        name: impl Into<Cow<'static, str>>,
        description: impl Into<Cow<'static, str>>,
        values: impl IntoIterator<Item = T>,
    ) -> Self {
        let values = values.into_iter().map(|v| Some(v.into())).collect();
        Self::new(name, description, ColumnData::Utf8(values))
    }

    /// A text column of few distinct values, given by their index; `None` is missing.
    pub fn dictionary<K: Into<Option<u32>>>(
        name: impl Into<Cow<'static, str>>,
        description: impl Into<Cow<'static, str>>,
        values: Vec<String>,
        keys: impl IntoIterator<Item = K>,
    ) -> Self {
        let keys = keys.into_iter().map(Into::into).collect();
        Self::new(name, description, ColumnData::Dictionary { values, keys })
    }

    /// A column of numbers, from `f64` (NaN is missing) or `Option<f64>`.
    pub fn f64<T: Into<Option<f64>>>(
        name: impl Into<Cow<'static, str>>,
        description: impl Into<Cow<'static, str>>,
        values: impl IntoIterator<Item = T>,
    ) -> Self {
        let values = values.into_iter().map(|v| v.into().unwrap_or(f64::NAN)).collect();
        Self::new(name, description, ColumnData::F64(values))
    }

    /// A column of whole numbers, from `i64` or `Option<i64>`.
    pub fn i64<T: Into<Option<i64>>>(
        name: impl Into<Cow<'static, str>>,
        description: impl Into<Cow<'static, str>>,
        values: impl IntoIterator<Item = T>,
    ) -> Self {
        let values = values.into_iter().map(Into::into).collect();
        Self::new(name, description, ColumnData::I64(values))
    }

    /// A column of truth values, from `bool` or `Option<bool>`.
    pub fn bool<T: Into<Option<bool>>>(
        name: impl Into<Cow<'static, str>>,
        description: impl Into<Cow<'static, str>>,
        values: impl IntoIterator<Item = T>,
    ) -> Self {
        let values = values.into_iter().map(Into::into).collect();
        Self::new(name, description, ColumnData::Bool(values))
    }

    /// A column of WGS 84 geometries (longitude, latitude), from WKB or `Option` of it.
    pub fn geometry<T: Into<Option<Vec<u8>>>>(
        name: impl Into<Cow<'static, str>>,
        description: impl Into<Cow<'static, str>>,
        values: impl IntoIterator<Item = T>,
    ) -> Self {
        let values = values.into_iter().map(Into::into).collect();
        Self::new(name, description, ColumnData::Wkb { values, crs: GeometryCrs::Crs84 })
    }
}

/// Columns of equal length and distinct names.
#[derive(Clone, Debug, PartialEq)]
pub struct Table {
    columns: Vec<Column>,
}

impl Table {
    /// A table of these columns, in this order. The first geometry column is the primary one.
    ///
    /// # Errors
    /// [`TableError`] when names repeat, lengths differ, or a dictionary key is out of range.
    pub fn new(columns: Vec<Column>) -> Result<Self, TableError> {
        let expected = columns.first().map_or(0, |c| c.data.len());
        for (i, column) in columns.iter().enumerate() {
            let name = || column.name.clone().into_owned();
            if columns[..i].iter().any(|c| c.name == column.name) {
                return Err(TableError::DuplicateColumn { column: name() });
            }
            let rows = column.data.len();
            if rows != expected {
                return Err(TableError::Length { column: name(), rows, expected });
            }
            if let ColumnData::Dictionary { values, keys } = &column.data {
                let entries = values.len();
                let bad = |key: &Option<u32>| key.is_some_and(|k| k as usize >= entries);
                if let Some(row) = keys.iter().position(bad) {
                    let key = keys[row].unwrap_or_default();
                    return Err(TableError::Key { column: name(), row, key, entries });
                }
            }
        }
        Ok(Self { columns })
    }

    /// The columns.
    #[must_use]
    pub fn columns(&self) -> &[Column] {
        &self.columns
    }

    /// Number of rows.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.columns.first().map_or(0, |c| c.data.len())
    }

    /// The table as CSV: UTF-8, a header line, LF line ends, fields quoted where they must be.
    /// Numbers are in the shortest form that reads back to the same value; missing values are
    /// empty; geometries are left out.
    #[must_use]
    pub fn to_csv(&self) -> Vec<u8> {
        csv_text::encode(self)
    }

    /// The table as Parquet (snappy), with GeoParquet 1.1 metadata if it has geometries. The
    /// descriptions are in the file's key-value metadata under `sat3d:columns`, as a JSON object.
    ///
    /// # Errors
    /// [`TableError::Geometry`] for a geometry that is no WKB point or polygon;
    /// [`TableError::Parquet`] if the encoder fails.
    pub fn to_parquet(&self) -> Result<Vec<u8>, TableError> {
        parquet_file::encode(self)
    }

    /// Writes [`to_csv`](Self::to_csv) to a file that appears whole or not at all.
    ///
    /// # Errors
    /// [`TableError::Write`].
    pub fn write_csv(&self, path: &Path) -> Result<(), TableError> {
        write(path, &self.to_csv())
    }

    /// Writes [`to_parquet`](Self::to_parquet) to a file that appears whole or not at all.
    ///
    /// # Errors
    /// As [`to_parquet`](Self::to_parquet), and [`TableError::Write`].
    pub fn write_parquet(&self, path: &Path) -> Result<(), TableError> {
        write(path, &self.to_parquet()?)
    }
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), TableError> {
    write_atomic(path, bytes).map_err(|source| TableError::Write { path: path.to_owned(), source })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ill_formed_tables_are_refused_by_column() {
        let n = |name: &'static str, rows: usize| Column::f64(name, "", vec![0.0; rows]);
        assert!(matches!(
            Table::new(vec![n("a", 2), n("a", 2)]),
            Err(TableError::DuplicateColumn { column }) if column == "a"
        ));
        assert!(matches!(
            Table::new(vec![n("a", 2), n("b", 3)]),
            Err(TableError::Length { column, rows: 3, expected: 2 }) if column == "b"
        ));
        let keys = Column::dictionary("d", "", vec!["x".to_owned()], [Some(0), None, Some(1)]);
        assert!(matches!(
            Table::new(vec![keys]),
            Err(TableError::Key { row: 2, key: 1, entries: 1, .. })
        ));
        assert_eq!(Table::new(Vec::new()).expect("an empty table").rows(), 0);
    }
}
