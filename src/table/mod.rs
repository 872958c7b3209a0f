//! Tables that are written as CSV and (Geo)Parquet from one definition.
