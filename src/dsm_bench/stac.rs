//! The benchmark as a STAC collection.
