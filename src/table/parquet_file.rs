//! A table as Parquet, with GeoParquet 1.1 metadata where it has geometries.

use super::{Column, ColumnData, GeometryCrs, Table, TableError, wkb};
use parquet::basic::{Compression, LogicalType, Repetition, Type as Physical};
use parquet::data_type::{BoolType, ByteArray, ByteArrayType, DataType, DoubleType, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use parquet::file::writer::{SerializedFileWriter, SerializedRowGroupWriter};
use parquet::schema::types::{ColumnPath, Type};
use std::ops::Range;
use std::sync::Arc;

/// Rows per row group: what readers skip or load at once.
const ROWS_PER_GROUP: usize = 131_072;
/// Key of the column descriptions in the file's metadata.
const DESCRIPTIONS_KEY: &str = "sat3d:columns";

pub(super) fn encode(table: &Table) -> Result<Vec<u8>, TableError> {
    let fields = table
        .columns()
        .iter()
        .map(|column| {
            let (physical, logical) = match column.data {
                ColumnData::Utf8(_) | ColumnData::Dictionary { .. } => {
                    (Physical::BYTE_ARRAY, Some(LogicalType::String))
                }
                ColumnData::F64(_) => (Physical::DOUBLE, None),
                ColumnData::I64(_) => (Physical::INT64, None),
                ColumnData::Bool(_) => (Physical::BOOLEAN, None),
                ColumnData::Wkb { .. } => (Physical::BYTE_ARRAY, None),
            };
            Type::primitive_type_builder(&column.name, physical)
                .with_repetition(Repetition::OPTIONAL)
                .with_logical_type(logical)
                .build()
                .map(Arc::new)
        })
        .collect::<Result<Vec<_>, ParquetError>>()?;
    let schema = Type::group_type_builder("schema").with_fields(fields).build()?;

    let mut metadata = vec![descriptions(table)];
    metadata.extend(geo_metadata(table)?);
    let mut properties = WriterProperties::builder()
        .set_created_by(concat!("sat3d ", env!("CARGO_PKG_VERSION")).to_owned())
        .set_compression(Compression::SNAPPY)
        .set_key_value_metadata(Some(metadata));
    for column in table.columns() {
        if matches!(column.data, ColumnData::Wkb { .. }) {
            // The least and the greatest WKB say nothing about where the geometries lie.
            let path = ColumnPath::from(column.name.as_ref());
            properties = properties.set_column_statistics_enabled(path, EnabledStatistics::None);
        }
    }

    let mut file =
        SerializedFileWriter::new(Vec::new(), Arc::new(schema), Arc::new(properties.build()))?;
    let rows = table.rows();
    for start in (0..rows).step_by(ROWS_PER_GROUP) {
        let range = start..rows.min(start + ROWS_PER_GROUP);
        let mut group = file.next_row_group()?;
        for column in table.columns() {
            write_column(&mut group, column, range.clone())?;
        }
        group.close()?;
    }
    Ok(file.into_inner()?)
}

fn write_column<W: std::io::Write + Send>(
    group: &mut SerializedRowGroupWriter<'_, W>,
    column: &Column,
    range: Range<usize>,
) -> Result<(), ParquetError> {
    match &column.data {
        ColumnData::Utf8(values) => write_values::<ByteArrayType, _>(
            group,
            values[range].iter().map(|v| v.as_ref().map(|v| ByteArray::from(v.as_str()))),
        ),
        ColumnData::Dictionary { values, keys } => {
            // Clones of a `ByteArray` share its bytes.
            let values: Vec<ByteArray> =
                values.iter().map(|v| ByteArray::from(v.as_str())).collect();
            write_values::<ByteArrayType, _>(
                group,
                keys[range].iter().map(|key| key.map(|key| values[key as usize].clone())),
            )
        }
        ColumnData::F64(values) => write_values::<DoubleType, _>(
            group,
            values[range].iter().map(|v| (!v.is_nan()).then_some(*v)),
        ),
        ColumnData::I64(values) => {
            write_values::<Int64Type, _>(group, values[range].iter().copied())
        }
        ColumnData::Bool(values) => {
            write_values::<BoolType, _>(group, values[range].iter().copied())
        }
        ColumnData::Wkb { values, .. } => write_values::<ByteArrayType, _>(
            group,
            values[range].iter().map(|v| v.as_ref().map(|v| ByteArray::from(v.clone()))),
        ),
    }
}

fn write_values<T: DataType, W: std::io::Write + Send>(
    group: &mut SerializedRowGroupWriter<'_, W>,
    rows: impl ExactSizeIterator<Item = Option<T::T>>,
) -> Result<(), ParquetError> {
    let mut present = Vec::with_capacity(rows.len());
    let mut levels = Vec::with_capacity(rows.len());
    for row in rows {
        levels.push(i16::from(row.is_some()));
        present.extend(row);
    }
    let mut writer = group
        .next_column()?
        .ok_or_else(|| ParquetError::General("the schema ends before the table".to_owned()))?;
    writer.typed::<T>().write_batch(&present, Some(&levels), None)?;
    writer.close()
}

fn descriptions(table: &Table) -> KeyValue {
    let object: serde_json::Map<String, serde_json::Value> = table
        .columns()
        .iter()
        .map(|c| (c.name.clone().into_owned(), c.description.as_ref().into()))
        .collect();
    KeyValue::new(DESCRIPTIONS_KEY.to_owned(), serde_json::Value::from(object).to_string())
}

/// The `geo` entry of GeoParquet 1.1, if the table has a geometry column.
fn geo_metadata(table: &Table) -> Result<Option<KeyValue>, TableError> {
    let mut columns = serde_json::Map::new();
    for column in table.columns() {
        let ColumnData::Wkb { values, crs } = &column.data else { continue };
        let mut summary = wkb::Summary::default();
        for (row, value) in values.iter().enumerate() {
            if let Some(value) = value {
                summary.add(value).ok_or_else(|| TableError::Geometry {
                    column: column.name.clone().into_owned(),
                    row,
                })?;
            }
        }
        let mut entry = serde_json::json!({
            "encoding": "WKB",
            "geometry_types": summary.types(),
        });
        // The standard's default, OGC:CRS84, is said by leaving the key out.
        if let GeometryCrs::Projjson(crs) = crs {
            entry["crs"] = crs.clone();
        }
        if let Some(bbox) = summary.bbox {
            entry["bbox"] = serde_json::json!(bbox);
        }
        columns.insert(column.name.clone().into_owned(), entry);
    }
    let Some(primary) = columns.keys().next().cloned() else { return Ok(None) };
    let geo = serde_json::json!({
        "version": "1.1.0",
        "primary_column": primary,
        "columns": columns,
    });
    Ok(Some(KeyValue::new("geo".to_owned(), geo.to_string())))
}

#[cfg(test)]
mod tests {
    use super::super::{Column, ColumnData, Table, TableError, wkb};
    use parquet::file::reader::{FileReader, SerializedFileReader};
    use parquet::record::Field;

    fn sample() -> Table {
        Table::new(vec![
            Column::text("name", "A name", ["a", "b", "c"]),
            Column::f64("f", "A number, metres", [0.1, f64::NAN, -0.0]),
            Column::i64("i", "", [Some(i64::MAX), None, Some(-3)]),
            Column::bool("b", "", [None, Some(true), Some(false)]),
            Column::dictionary("d", "", vec!["x".into(), "y".into()], [Some(1), None, Some(0)]),
            Column::geometry(
                "geometry",
                "A place",
                [Some(wkb::point(1.0, 2.0)), None, Some(wkb::rectangle(0.0, 0.0, 1.0, 3.0))],
            ),
        ])
        .expect("a table")
    }

    fn open(bytes: Vec<u8>) -> (tempfile::NamedTempFile, SerializedFileReader<std::fs::File>) {
        let file = tempfile::NamedTempFile::new().expect("a file");
        std::fs::write(file.path(), bytes).expect("writes");
        let reader = SerializedFileReader::new(file.reopen().expect("opens")).expect("parquet");
        (file, reader)
    }

    #[test]
    fn values_and_holes_come_back() {
        let (_file, reader) = open(sample().to_parquet().expect("encodes"));
        let rows: Vec<Vec<Field>> = reader
            .get_row_iter(None)
            .expect("rows")
            .map(|row| row.expect("a row").into_columns().into_iter().map(|(_, f)| f).collect())
            .collect();
        let text = |s: &str| Field::Str(s.to_owned());
        assert_eq!(rows.len(), 3);
        assert_eq!(
            rows[0][..5],
            [text("a"), Field::Double(0.1), Field::Long(i64::MAX), Field::Null, text("y")]
        );
        assert_eq!(rows[0][5], Field::Bytes(wkb::point(1.0, 2.0).into()));
        assert_eq!(
            rows[1],
            [text("b"), Field::Null, Field::Null, Field::Bool(true), Field::Null, Field::Null]
        );
        assert_eq!(rows[2][2], Field::Long(-3));
    }

    #[test]
    fn metadata_is_geoparquet_and_says_what_the_columns_mean() {
        let (_file, reader) = open(sample().to_parquet().expect("encodes"));
        let file = reader.metadata().file_metadata();
        let entry = |key: &str| -> serde_json::Value {
            let entries = file.key_value_metadata().expect("metadata");
            let entry = entries.iter().find(|e| e.key == key).expect("the key");
            serde_json::from_str(entry.value.as_deref().expect("a value")).expect("JSON")
        };
        let geo = entry("geo");
        assert_eq!(geo["version"], "1.1.0");
        assert_eq!(geo["primary_column"], "geometry");
        let column = &geo["columns"]["geometry"];
        assert_eq!(column["encoding"], "WKB");
        assert_eq!(column["geometry_types"], serde_json::json!(["Point", "Polygon"]));
        assert_eq!(column["bbox"], serde_json::json!([0.0, 0.0, 1.0, 3.0]));
        assert_eq!(column.get("crs"), None);
        assert_eq!(entry("sat3d:columns")["f"], "A number, metres");
        assert!(file.created_by().is_some_and(|by| by.starts_with("sat3d ")));
    }

    #[test]
    fn the_same_table_gives_the_same_bytes() {
        assert_eq!(
            sample().to_parquet().expect("encodes"),
            sample().to_parquet().expect("encodes")
        );
    }

    #[test]
    fn row_groups_cut_long_tables() {
        let n = super::ROWS_PER_GROUP + 5;
        let table = Table::new(vec![Column::i64("i", "", 0..n as i64)]).expect("a table");
        let (_file, reader) = open(table.to_parquet().expect("encodes"));
        assert_eq!(reader.metadata().num_row_groups(), 2);
        for (i, row) in reader.get_row_iter(None).expect("rows").enumerate() {
            let row = row.expect("a row");
            assert_eq!(row.get_column_iter().next().expect("a field").1, &Field::Long(i as i64));
        }
    }

    #[test]
    fn tables_without_rows_and_bad_geometries() {
        let none = Table::new(vec![Column::geometry("g", "", Vec::<Vec<u8>>::new())]);
        let (_file, reader) = open(none.expect("a table").to_parquet().expect("encodes"));
        assert_eq!(reader.metadata().file_metadata().num_rows(), 0);
        let bad = Table::new(vec![Column::new(
            "g",
            "",
            ColumnData::Wkb { values: vec![None, Some(vec![1, 2])], crs: Default::default() },
        )]);
        assert!(matches!(
            bad.expect("a table").to_parquet(),
            Err(TableError::Geometry { row: 1, .. })
        ));
    }
}
