//! Lidar tiles: index, block cache, warp onto an image grid.
