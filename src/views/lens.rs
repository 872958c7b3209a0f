//! Pictures of a pinhole camera and the rays behind them.

use super::ViewError;
use crate::model::render::Intrinsics;
use serde::Serialize;

/// Least and most pixels along a side of a perspective picture.
pub const SIZE_LIMITS: [u32; 2] = [4, 4096];

/// How wide a perspective picture looks.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Lens {
    /// Degrees across, and down; without the latter pixels are square.
    FieldOfView {
        /// Degrees from the left to the right edge.
        horizontal: f64,
        /// Degrees from the upper to the lower edge.
        vertical: Option<f64>,
    },
    /// Focal lengths and principal point in pixels of the picture; the upper left corner of the picture is
    /// (0, 0), so that the middle of 256 pixels is 128, as in COLMAP and NeRF files.
    Intrinsics(Intrinsics),
}

impl Default for Lens {
    /// As released: 120 degrees.
    fn default() -> Self {
        Self::FieldOfView { horizontal: 120.0, vertical: None }
    }
}

/// A picture's size and lens.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Optics {
    /// Columns and rows.
    pub size: [u32; 2],
    /// How wide it looks.
    pub lens: Lens,
}

impl Default for Optics {
    fn default() -> Self {
        Self { size: [256, 256], lens: Lens::default() }
    }
}

impl Optics {
    /// Checks sizes and angles.
    ///
    /// # Errors
    /// [`ViewError::Size`], [`ViewError::FieldOfView`] or [`ViewError::Intrinsics`] with the value.
    pub fn check(&self) -> Result<(), ViewError> {
        let [least, most] = SIZE_LIMITS;
        if self.size.iter().any(|side| !(least..=most).contains(side)) {
            return Err(ViewError::Size { size: self.size });
        }
        match self.lens {
            Lens::FieldOfView { horizontal, vertical } => {
                let mut angles = [Some(horizontal), vertical].into_iter().flatten();
                match angles.find(|degrees| !(*degrees >= 1.0 && *degrees <= 179.0)) {
                    Some(degrees) => Err(ViewError::FieldOfView { degrees }),
                    None => Ok(()),
                }
            }
            Lens::Intrinsics(intrinsics) => {
                let Intrinsics { fx, fy, cx, cy } = intrinsics;
                let usable = fx > 0.0 && fy > 0.0 && [fx, fy, cx, cy].iter().all(|v| v.is_finite());
                if usable { Ok(()) } else { Err(ViewError::Intrinsics { fx, fy, cx, cy }) }
            }
        }
    }

    /// The same view in another number of pixels.
    #[must_use]
    pub fn resized(&self, size: [u32; 2]) -> Self {
        let [x, y] = [0, 1].map(|axis| f64::from(size[axis]) / f64::from(self.size[axis]));
        let lens = match self.lens {
            Lens::Intrinsics(Intrinsics { fx, fy, cx, cy }) => {
                Lens::Intrinsics(Intrinsics { fx: fx * x, fy: fy * y, cx: cx * x, cy: cy * y })
            }
            angles @ Lens::FieldOfView { .. } => angles,
        };
        Self { size, lens }
    }

    /// Columns and rows of rays, and their intrinsics (rays stand at integers).
    ///
    /// Super-resolution makes two pixels of a ray: pixel U, whose centre is at U + 1/2, lies at ray
    /// (U + 1/2) / 2 - 1/2. For intrinsics in pixels that is followed exactly. A field of view has the
    /// released principal point, `(size - 1) / 4` rays: a quarter of a ray right of and below the middle,
    /// for which the network was trained. An odd picture has half a pair cut off.
    #[must_use]
    pub fn rays(&self, doubled: bool) -> ([usize; 2], Intrinsics) {
        let part = if doubled { 2.0 } else { 1.0 };
        let size = self.size.map(|side| if doubled { side.div_ceil(2) } else { side } as usize);
        let intrinsics = match self.lens {
            Lens::FieldOfView { horizontal, vertical } => {
                let [width, height] = self.size.map(f64::from);
                let focal = |side: f64, degrees: f64| {
                    side / 2.0 / libm::tan(degrees.to_radians() / 2.0) / part
                };
                let fx = focal(width, horizontal);
                let fy = vertical.map_or(fx, |degrees| focal(height, degrees));
                let centre = |side: f64| (side - 1.0) / 2.0 / part;
                Intrinsics { fx, fy, cx: centre(width), cy: centre(height) }
            }
            Lens::Intrinsics(Intrinsics { fx, fy, cx, cy }) => {
                let ray = |corner: f64| corner / part - 0.5;
                Intrinsics { fx: fx / part, fy: fy / part, cx: ray(cx), cy: ray(cy) }
            }
        };
        (size, intrinsics)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_released_view_has_the_released_rays() {
        let (size, rays) = Optics::default().rays(true);
        assert_eq!(size, [128, 128]);
        assert_eq!(rays, Intrinsics::from_field_of_view(128, 128, 120.0, 120.0));
        assert_eq!((rays.cx, rays.cy), (63.75, 63.75));
    }

    #[test]
    fn pixels_and_rays_look_the_same_way() {
        let given = Intrinsics { fx: 90.0, fy: 80.0, cx: 31.0, cy: 22.5 };
        let optics = Optics { size: [64, 45], lens: Lens::Intrinsics(given) };
        let (size, rays) = optics.rays(true);
        assert_eq!(size, [32, 23]);
        for pixel in [0.0, 17.0, 63.0_f64] {
            let want = (pixel + 0.5 - given.cx) / given.fx;
            let ray = (pixel + 0.5) / 2.0 - 0.5;
            assert!(((ray - rays.cx) / rays.fx - want).abs() < 1e-15);
        }
        let (_, rays) = optics.rays(false);
        assert_eq!((rays.fx, rays.cx, rays.cy), (90.0, 30.5, 22.0));
        let (_, half) = optics.resized([32, 45]).rays(false);
        assert_eq!((half.fx, half.fy, half.cx), (45.0, 80.0, 15.0));
    }

    #[test]
    fn lenses_that_make_no_picture_are_refused_by_value() {
        let of = |horizontal: f64| Lens::FieldOfView { horizontal, vertical: None };
        let check = |size, lens| Optics { size, lens }.check().map_err(|e| e.to_string());
        assert!(check([256, 256], of(120.0)).is_ok());
        assert!(check([3, 256], of(120.0)).is_err_and(|e| e.contains("3x256")));
        assert!(check([8, 8], of(180.0)).is_err_and(|e| e.contains("180")));
        assert!(check([8, 8], of(f64::NAN)).is_err_and(|e| e.contains("NaN")));
        let intrinsics = Intrinsics { fx: 0.0, fy: 1.0, cx: 1.0, cy: 1.0 };
        assert!(check([8, 8], Lens::Intrinsics(intrinsics)).is_err_and(|e| e.contains("0,1,1,1")));
    }
}
