//! Tables as layers of a GeoPackage, for QGIS. Written through GDAL; the pure build refuses.

use super::{Table, TableError};
use std::path::Path;

/// A layer: a name and a table whose first geometry column (WGS 84) is the layer's.
#[derive(Clone, Copy, Debug)]
pub struct Layer<'a> {
    /// Name of the layer.
    pub name: &'a str,
    /// What the layer is about, shown by QGIS.
    pub description: &'a str,
    /// Its features.
    pub table: &'a Table,
}

/// Says whether this build can write GeoPackages, before any work is done for one.
///
/// # Errors
/// [`TableError::NoGeoPackage`] in builds without GDAL.
pub fn check_geopackage(path: &Path) -> Result<(), TableError> {
    if cfg!(feature = "gdal") {
        Ok(())
    } else {
        Err(TableError::NoGeoPackage { path: path.to_owned() })
    }
}

/// Writes layers to a GeoPackage that appears whole or not at all. The bytes depend on the content
/// and on the versions of GDAL and SQLite.
///
/// # Errors
/// [`TableError::NoGeoPackage`] in builds without GDAL, [`TableError::GeoPackage`] and
/// [`TableError::Write`] when writing fails.
#[cfg(not(feature = "gdal"))]
pub fn write_geopackage(path: &Path, layers: &[Layer<'_>]) -> Result<(), TableError> {
    let _ = layers;
    check_geopackage(path)
}

#[cfg(feature = "gdal")]
pub use with_gdal::write_geopackage;

#[cfg(feature = "gdal")]
mod with_gdal {
    use super::super::{ColumnData, Table, TableError};
    use super::Layer;
    use crate::batch::sync_folder;
    use gdal::config::{clear_thread_local_config_option, set_thread_local_config_option};
    use gdal::errors::GdalError;
    use gdal::spatial_ref::{AxisMappingStrategy, SpatialRef};
    use gdal::vector::{
        Feature, FieldDefn, Geometry, LayerAccess, LayerOptions, OGRFieldType, OGRwkbGeometryType,
    };
    use gdal::{Dataset, DriverManager};
    use std::fs::File;
    use std::path::Path;

    /// GDAL stamps the time of writing into the file, unless this says another.
    const TIME_OPTION: &str = "OGR_CURRENT_DATE";
    const NO_TIME: &str = "1970-01-01T00:00:00.000Z";

    /// Writes layers to a GeoPackage that appears whole or not at all. The bytes depend on the
    /// content and on the versions of GDAL and SQLite.
    ///
    /// # Errors
    /// [`TableError::GeoPackage`] and [`TableError::Write`].
    pub fn write_geopackage(path: &Path, layers: &[Layer<'_>]) -> Result<(), TableError> {
        let folder = match path.parent() {
            Some(folder) if !folder.as_os_str().is_empty() => folder,
            _ => Path::new("."),
        };
        let failed = |source| TableError::Write { path: path.to_owned(), source };
        // SQLite keeps a journal beside its file, so the file gets a folder of its own.
        let temporary = tempfile::Builder::new()
            .prefix(".geopackage.")
            .suffix(".part")
            .tempdir_in(folder)
            .map_err(failed)?;
        let file = temporary.path().join("layers.gpkg");
        set_thread_local_config_option(TIME_OPTION, NO_TIME)
            .and_then(|()| {
                let written = write_layers(&file, layers);
                clear_thread_local_config_option(TIME_OPTION).and(written)
            })
            .map_err(|source| TableError::GeoPackage { path: path.to_owned(), source })?;
        File::open(&file).and_then(|f| f.sync_all()).map_err(failed)?;
        std::fs::rename(&file, path).map_err(failed)?;
        sync_folder(folder).map_err(failed)
    }

    fn write_layers(file: &Path, layers: &[Layer<'_>]) -> Result<(), GdalError> {
        let driver = DriverManager::get_driver_by_name("GPKG")?;
        let mut dataset = driver.create_vector_only(file)?;
        for layer in layers {
            write_layer(&mut dataset, layer)?;
        }
        dataset.close()
    }

    fn write_layer(dataset: &mut Dataset, layer: &Layer<'_>) -> Result<(), GdalError> {
        let mut wgs84 = SpatialRef::from_epsg(4326)?;
        wgs84.set_axis_mapping_strategy(AxisMappingStrategy::TraditionalGisOrder);
        let table = layer.table;
        let geometries = table.columns().iter().find_map(|c| match &c.data {
            ColumnData::Wkb { values, .. } => Some(values),
            _ => None,
        });
        let kind = match geometries.and_then(|all| all.iter().flatten().next()) {
            Some(first) if first.get(1) == Some(&1) => OGRwkbGeometryType::wkbPoint,
            Some(_) => OGRwkbGeometryType::wkbPolygon,
            None => OGRwkbGeometryType::wkbNone,
        };
        let description = format!("DESCRIPTION={}", layer.description);
        let mut transaction = dataset.start_transaction()?;
        {
            let target = transaction.create_layer(LayerOptions {
                name: layer.name,
                srs: geometries.is_some().then_some(&wgs84),
                ty: kind,
                options: Some(&[description.as_str()]),
            })?;
            add_fields(&target, table)?;
            for row in 0..table.rows() {
                let mut feature = Feature::new(target.defn())?;
                set_fields(&mut feature, table, row)?;
                if let Some(Some(wkb)) = geometries.map(|all| all[row].as_deref()) {
                    feature.set_geometry(Geometry::from_wkb(wkb)?)?;
                }
                feature.create(&target)?;
            }
        }
        transaction.commit()
    }

    fn add_fields(layer: &impl LayerAccess, table: &Table) -> Result<(), GdalError> {
        for column in table.columns() {
            let kind = match column.data {
                ColumnData::Utf8(_) | ColumnData::Dictionary { .. } => OGRFieldType::OFTString,
                ColumnData::F64(_) => OGRFieldType::OFTReal,
                ColumnData::I64(_) => OGRFieldType::OFTInteger64,
                ColumnData::Bool(_) => OGRFieldType::OFTInteger,
                ColumnData::Wkb { .. } => continue,
            };
            FieldDefn::new(&column.name, kind)?.add_to_layer(layer)?;
        }
        Ok(())
    }

    fn set_fields(feature: &mut Feature<'_>, table: &Table, row: usize) -> Result<(), GdalError> {
        let columns = table.columns().iter().filter(|c| !matches!(c.data, ColumnData::Wkb { .. }));
        for (index, column) in columns.enumerate() {
            match &column.data {
                ColumnData::Utf8(values) => match &values[row] {
                    Some(text) => feature.set_field_string(index, text)?,
                    None => feature.set_field_null(index)?,
                },
                ColumnData::Dictionary { values, keys } => match keys[row] {
                    Some(key) => feature.set_field_string(index, &values[key as usize])?,
                    None => feature.set_field_null(index)?,
                },
                ColumnData::F64(values) if values[row].is_nan() => feature.set_field_null(index)?,
                ColumnData::F64(values) => feature.set_field_double(index, values[row])?,
                ColumnData::I64(values) => match values[row] {
                    Some(value) => feature.set_field_integer64(index, value)?,
                    None => feature.set_field_null(index)?,
                },
                ColumnData::Bool(values) => match values[row] {
                    Some(value) => feature.set_field_integer(index, i32::from(value))?,
                    None => feature.set_field_null(index)?,
                },
                ColumnData::Wkb { .. } => {}
            }
        }
        Ok(())
    }
}

#[cfg(all(test, feature = "gdal"))]
mod tests {
    use super::super::{Column, wkb};
    use super::*;
    use gdal::Dataset;
    use gdal::vector::LayerAccess;

    fn points() -> Table {
        Table::new(vec![
            Column::text("name", "", ["a", "b"]),
            Column::f64("metres", "", [1.5, f64::NAN]),
            Column::i64("count", "", [None, Some(1_i64 << 40)]),
            Column::bool("inside", "", [Some(true), None]),
            Column::geometry("geometry", "", [wkb::point(-122.3, 47.6), wkb::point(1.0, 2.0)]),
        ])
        .expect("a table")
    }

    #[test]
    fn layers_come_back_and_bytes_repeat() {
        let folder = tempfile::tempdir().expect("a folder");
        let squares = Table::new(vec![Column::geometry(
            "geometry",
            "",
            [wkb::rectangle(0.0, 0.0, 1.0, 1.0)],
        )])
        .expect("a table");
        let points = points();
        let layers = [
            Layer { name: "points", description: "Points", table: &points },
            Layer { name: "squares", description: "Squares", table: &squares },
        ];
        let paths = ["a.gpkg", "b.gpkg"].map(|name| folder.path().join(name));
        for path in &paths {
            write_geopackage(path, &layers).expect("writes");
        }
        let bytes = paths.each_ref().map(|path| std::fs::read(path).expect("reads"));
        assert!(bytes[0] == bytes[1], "the same layers gave different bytes");
        assert_eq!(std::fs::read_dir(folder.path()).expect("lists").count(), 2, "leftovers");

        let dataset = Dataset::open(&paths[0]).expect("opens");
        assert_eq!(dataset.layer_count(), 2);
        let mut layer = dataset.layer_by_name("points").expect("the layer");
        assert_eq!(layer.spatial_ref().and_then(|s| s.auth_code().ok()), Some(4326));
        let rows: Vec<_> = layer
            .features()
            .map(|f| {
                (
                    f.field_as_string(0).expect("a field"),
                    f.field_as_double(1).expect("a field"),
                    f.field_as_integer64(2).expect("a field"),
                    f.field_as_integer(3).expect("a field"),
                    f.geometry().expect("a geometry").get_point(0),
                )
            })
            .collect();
        assert_eq!(
            rows,
            [
                (Some("a".to_owned()), Some(1.5), None, Some(1), (-122.3, 47.6, 0.0)),
                (Some("b".to_owned()), None, Some(1 << 40), None, (1.0, 2.0, 0.0)),
            ]
        );
    }

    #[test]
    fn a_missing_folder_is_an_error_that_names_the_file() {
        let error = write_geopackage(Path::new("/no/such/folder/x.gpkg"), &[]);
        assert!(error.expect_err("fails").to_string().contains("/no/such/folder/x.gpkg"));
    }
}
