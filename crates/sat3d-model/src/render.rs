//! Rays through the field: satellite view, panorama, perspective, density grid.
