//! All end-to-end and integration tests as one program: forty of them would each link GDAL, PROJ and the network once more,
//! which takes minutes and gigabytes. `cargo test --test suite tile::` runs those of one file.

mod bounds;
mod cli;
mod common;
mod crs_definitions;
mod crs_geographiclib;
mod crs_gie;
mod crs_operations;
mod dsm_bench_bad_input;
mod dsm_bench_build;
mod effects;
mod eval_alignment;
mod eval_numbers;
mod eval_report;
mod eval_run;
mod eval_strata;
mod eval_support;
mod gdalwarp_parity;
mod geotiff_gdal;
#[cfg(feature = "fetch")]
mod hub_support;
mod infer;
mod infer_outputs;
mod mesh_file;
mod model_command;
mod model_fetch;
mod model_score;
mod picture;
mod picture_place;
mod plans;
mod raster_bad_input;
mod raster_pure;
mod raster_reading;
mod raster_support;
mod readme;
mod recipes;
mod simulate;
mod stac_pystac;
mod table_python;
mod tile;
mod tile_dsm;
mod tile_oracles;
mod tradeoff;
mod train;
#[cfg(feature = "train")]
mod train_support;
mod view;
mod views;
mod views_model;
mod views_support;
mod vigor_ingest;
mod volume;
