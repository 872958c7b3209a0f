//! Satellite pictures: RGB pixels in windows, and where on Earth they lie.
