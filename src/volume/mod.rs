//! Density volumes as files: npy and Zarr.
