//! 3D Tiles 1.1 (OGC 22-025r4).
