//! From an image's pixels to the lattice of the lidar tiles: exactly, or by a polynomial whose
//! error is measured for each image.
//!
//! Within one image the projection is so smooth that a polynomial of degree 2 in each direction,
//! interpolating at the nine Chebyshev nodes, is exact to nanometres. The leading error term of
//! that interpolant is `A T3(u) + B T3(v)`, whose largest value on the square is taken at a corner:
//! so four more projections, at the corners, measure the error that the other pixels cannot exceed
//! by more than the (far smaller) next order. The affine and the separable form are truncations of
//! the same expansion, and what they drop bounds what they err, since Chebyshev polynomials never
//! exceed 1.

use super::Lattice;
use crate::crs::{CrsError, Projection};
use crate::grid::{GeoTransform, ImageGrid, LonLat, PixelPoint, Projected};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// How image pixels are taken to the tiles' CRS.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TransformForm {
    /// Nine-point Chebyshev polynomial, 3 x 3 coefficients.
    Chebyshev,
    /// `f(x) + g(y)`, each of degree 2.
    Separable,
    /// Degree 1.
    Affine,
    /// One projection per pixel.
    Exact,
}

impl TransformForm {
    /// Name on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Chebyshev => "chebyshev",
            Self::Separable => "separable",
            Self::Affine => "affine",
            Self::Exact => "exact",
        }
    }
}

/// The exact way from an image pixel to a position in the tiles' CRS.
#[derive(Clone, Debug)]
pub enum PixelToCrs {
    /// Pixel -> WGS 84 -> CRS, by the image's exact Web-Mercator grid.
    WebMercator {
        /// The image.
        grid: ImageGrid,
        /// The coordinate operation.
        projection: Arc<dyn Projection>,
    },
    /// Pixel of a raster in another CRS -> WGS 84 -> CRS.
    Raster {
        /// From its pixels to its CRS.
        geotransform: GeoTransform,
        /// Pixels across.
        width: u32,
        /// Pixels down.
        height: u32,
        /// The operation that its CRS stands for.
        from: Arc<dyn Projection>,
        /// The operation to the CRS.
        to: Arc<dyn Projection>,
    },
    /// The reference implementation's grid: an axis-aligned box in the CRS.
    Box {
        /// North-west corner.
        north_west: Projected,
        /// South-east corner.
        south_east: Projected,
        /// Pixels across.
        width: u32,
        /// Pixels down.
        height: u32,
    },
}

impl PixelToCrs {
    /// The reference implementation's box for an image (metres per pixel on the sphere, degrees
    /// from 111.32 km, two corners projected).
    ///
    /// # Errors
    /// A corner cannot be projected.
    pub fn reference_box(grid: &ImageGrid, projection: &dyn Projection) -> Result<Self, CrsError> {
        let LonLat { lon_deg, lat_deg } = grid.center();
        let cos = libm::cos(lat_deg.to_radians());
        let metres_per_pixel = 156_543.03 * cos / (1_u64 << grid.zoom()) as f64;
        let kilometres = |pixels: u32| f64::from(pixels) * metres_per_pixel / 1000.0;
        let half_lon = kilometres(grid.width()) / (111.32 * cos) / 2.0;
        let half_lat = kilometres(grid.height()) / 111.32 / 2.0;
        let corner = |sx: f64, sy: f64| {
            projection.forward(LonLat {
                lon_deg: lon_deg + sx * half_lon,
                lat_deg: lat_deg + sy * half_lat,
            })
        };
        let (low, high) = (corner(-1.0, -1.0)?, corner(1.0, 1.0)?);
        Ok(Self::Box {
            north_west: Projected { x: low.x, y: high.y },
            south_east: Projected { x: high.x, y: low.y },
            width: grid.width(),
            height: grid.height(),
        })
    }

    /// Position of a pixel coordinate in the CRS.
    ///
    /// # Errors
    /// The projection is undefined there.
    pub fn position(&self, p: PixelPoint) -> Result<Projected, CrsError> {
        match self {
            Self::WebMercator { grid, projection } => projection.forward(grid.lonlat(p)),
            Self::Raster { geotransform, from, to, .. } => {
                to.forward(from.inverse(geotransform.to_projected(p))?)
            }
            Self::Box { north_west, south_east, width, height } => {
                let (u, v) = (p.x / f64::from(*width), p.y / f64::from(*height));
                Ok(Projected {
                    x: north_west.x + u * (south_east.x - north_west.x),
                    y: north_west.y + v * (south_east.y - north_west.y),
                })
            }
        }
    }

    /// Pixels across and down.
    #[must_use]
    pub const fn size(&self) -> (u32, u32) {
        match self {
            Self::WebMercator { grid, .. } => (grid.width(), grid.height()),
            Self::Raster { width, height, .. } | Self::Box { width, height, .. } => {
                (*width, *height)
            }
        }
    }
}

/// Bounds on the displacement of each polynomial form for one image, CRS units.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FitErrors {
    /// The 3 x 3 polynomial: the largest miss at the four corners, times 1.5, and the rounding of
    /// positions.
    pub chebyshev: f64,
    /// That, and the cross terms.
    pub separable: f64,
    /// That, and all terms of degree 2 and more.
    pub affine: f64,
}

impl FitErrors {
    /// The bound of one form.
    #[must_use]
    pub const fn of(&self, form: TransformForm) -> f64 {
        match form {
            TransformForm::Chebyshev => self.chebyshev,
            TransformForm::Separable => self.separable,
            TransformForm::Affine => self.affine,
            TransformForm::Exact => 0.0,
        }
    }

    /// The cheapest form that errs by no more than `most` (CRS units); the exact one where no other does.
    #[must_use]
    pub fn cheapest(&self, most: f64) -> TransformForm {
        [TransformForm::Affine, TransformForm::Separable, TransformForm::Chebyshev]
            .into_iter()
            .find(|form| self.of(*form) <= most)
            .unwrap_or(TransformForm::Exact)
    }

    /// The worse of two, form by form.
    #[must_use]
    pub fn worst(self, other: Self) -> Self {
        Self {
            chebyshev: self.chebyshev.max(other.chebyshev),
            separable: self.separable.max(other.separable),
            affine: self.affine.max(other.affine),
        }
    }
}

/// Image pixel -> lattice coordinate.
#[derive(Clone, Debug)]
pub struct PixelMap {
    exact: PixelToCrs,
    lattice: Lattice,
    /// `None`: one projection per pixel.
    polynomial: Option<Polynomial>,
    errors: FitErrors,
}

/// Chebyshev coefficients `c[j][i]` of `T_i(u) T_j(v)`, `u` and `v` in [-1, 1] over the image, for
/// column and row; the origin is an integer, kept apart so that sums stay small and precise.
#[derive(Clone, Copy, Debug)]
struct Polynomial {
    origin: (f64, f64),
    col: [[f64; 3]; 3],
    row: [[f64; 3]; 3],
}

/// The three Chebyshev nodes of degree 3, `cos(pi (k + 1/2) / 3)`: +-sqrt(3)/2 and 0.
const NODES: [f64; 3] = [0.866_025_403_784_438_6, 0.0, -0.866_025_403_784_438_6];

/// What rounding moves a projected position, CRS units: a step of `f64` at half the Earth's
/// circumference in feet, because longitudes are rounded at up to 180 degrees. Nine such positions
/// make the polynomial, whose weights at a corner sum to 2.8.
const ROUNDING: f64 = 6.6e7 * f64::EPSILON;

/// `T_0`, `T_1`, `T_2` at `u`.
const fn chebyshev(u: f64) -> [f64; 3] {
    [1.0, u, 2.0 * u * u - 1.0]
}

impl PixelMap {
    /// Fits the polynomial for one image and measures its error.
    ///
    /// # Errors
    /// The projection is undefined somewhere in the image.
    pub fn fit(exact: PixelToCrs, lattice: Lattice, form: TransformForm) -> Result<Self, CrsError> {
        let (width, height) = exact.size();
        let (half_width, half_height) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
        let at = |u: f64, v: f64| -> Result<PixelPoint, CrsError> {
            let p = PixelPoint { x: half_width * (1.0 + u), y: half_height * (1.0 + v) };
            Ok(lattice.coordinate(exact.position(p)?))
        };
        let centre = at(0.0, 0.0)?;
        let origin = (centre.x.floor(), centre.y.floor());
        let mut samples = [[(0.0, 0.0); 3]; 3];
        for (j, v) in NODES.into_iter().enumerate() {
            for (i, u) in NODES.into_iter().enumerate() {
                let p = at(u, v)?;
                samples[j][i] = (p.x - origin.0, p.y - origin.1);
            }
        }
        let col = coefficients(&samples.map(|row| row.map(|s| s.0)));
        let row = coefficients(&samples.map(|row| row.map(|s| s.1)));
        let full = Polynomial { origin, col, row };

        let miss = |p: PixelPoint, q: PixelPoint| {
            libm::hypot((p.x - q.x) * lattice.pixel_width, (p.y - q.y) * lattice.pixel_height)
        };
        let mut corner_miss: f64 = 0.0;
        for (u, v) in [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
            corner_miss = corner_miss.max(miss(at(u, v)?, full.evaluate(u, v)));
        }
        let dropped = |terms: &[(usize, usize)]| {
            let sum = |c: &[[f64; 3]; 3]| terms.iter().map(|&(i, j)| c[j][i].abs()).sum::<f64>();
            libm::hypot(sum(&col) * lattice.pixel_width, sum(&row) * lattice.pixel_height)
        };
        let cross = [(1, 1), (2, 1), (1, 2), (2, 2)];
        let rounding = match &exact {
            PixelToCrs::Box { north_west: a, south_east: b, .. } => {
                let far =
                    [a.x, a.y, b.x, b.y].into_iter().fold(0.0, |far: f64, v| far.max(v.abs()));
                4.0 * f64::EPSILON * far
            }
            _ => ROUNDING,
        };
        let chebyshev_bound = 1.5 * corner_miss + rounding;
        let separable_bound = chebyshev_bound + dropped(&cross);
        let errors = FitErrors {
            chebyshev: chebyshev_bound,
            separable: separable_bound,
            affine: separable_bound + dropped(&[(2, 0), (0, 2)]),
        };
        let keep: &[(usize, usize)] = match form {
            TransformForm::Exact => &[],
            TransformForm::Affine => &[(0, 0), (1, 0), (0, 1)],
            TransformForm::Separable => &[(0, 0), (1, 0), (0, 1), (2, 0), (0, 2)],
            TransformForm::Chebyshev => {
                &[(0, 0), (1, 0), (0, 1), (2, 0), (0, 2), (1, 1), (2, 1), (1, 2), (2, 2)]
            }
        };
        let polynomial = (form != TransformForm::Exact).then(|| Polynomial {
            origin,
            col: truncated(&col, keep),
            row: truncated(&row, keep),
        });
        Ok(Self { exact, lattice, polynomial, errors })
    }

    /// The same image with another form, when [`errors`](Self::errors) says that it must.
    ///
    /// # Errors
    /// As [`fit`](Self::fit).
    pub fn with_form(self, form: TransformForm) -> Result<Self, CrsError> {
        Self::fit(self.exact, self.lattice, form)
    }

    /// The lattice that coordinates refer to.
    #[must_use]
    pub const fn lattice(&self) -> &Lattice {
        &self.lattice
    }

    /// Bounds on the displacement of each form, CRS units.
    #[must_use]
    pub const fn errors(&self) -> FitErrors {
        self.errors
    }

    /// Pixels across and down.
    #[must_use]
    pub const fn size(&self) -> (u32, u32) {
        self.exact.size()
    }

    /// Appends the lattice coordinates of `columns` of pixel row `y`, at centres (`offset` 0.5) or
    /// corners (`offset` 0).
    ///
    /// # Errors
    /// The projection is undefined there (exact form only).
    pub fn fill_row(
        &self,
        y: u32,
        columns: std::ops::Range<u32>,
        offset: f64,
        cols: &mut Vec<f64>,
        rows: &mut Vec<f64>,
    ) -> Result<(), CrsError> {
        let (width, height) = self.exact.size();
        let Some(polynomial) = &self.polynomial else {
            for x in columns {
                let p = PixelPoint { x: f64::from(x) + offset, y: f64::from(y) + offset };
                let c = self.lattice.coordinate(self.exact.position(p)?);
                cols.push(c.x);
                rows.push(c.y);
            }
            return Ok(());
        };
        let (u_step, v_step) = (2.0 / f64::from(width), 2.0 / f64::from(height));
        let v = (f64::from(y) + offset) * v_step - 1.0;
        let in_u = |c: &[[f64; 3]; 3]| {
            let t = chebyshev(v);
            let a: [f64; 3] =
                std::array::from_fn(|i| c[0][i] * t[0] + c[1][i] * t[1] + c[2][i] * t[2]);
            // a0 + a1 u + a2 (2 u^2 - 1), as a plain quadratic.
            [a[0] - a[2], a[1], 2.0 * a[2]]
        };
        let (c, r) = (in_u(&polynomial.col), in_u(&polynomial.row));
        let (col0, row0) = polynomial.origin;
        let start = columns.start;
        let count = columns.len() as u32;
        let u_of = move |k: u32| (f64::from(start + k) + offset) * u_step - 1.0;
        cols.extend((0..count).map(|k| {
            let u = u_of(k);
            col0 + (c[0] + u * (c[1] + u * c[2]))
        }));
        rows.extend((0..count).map(|k| {
            let u = u_of(k);
            row0 + (r[0] + u * (r[1] + u * r[2]))
        }));
        Ok(())
    }

    /// Lattice coordinate of one pixel coordinate.
    ///
    /// # Errors
    /// The projection is undefined there (exact form only).
    pub fn coordinate(&self, p: PixelPoint) -> Result<PixelPoint, CrsError> {
        let (width, height) = self.exact.size();
        match &self.polynomial {
            None => Ok(self.lattice.coordinate(self.exact.position(p)?)),
            Some(polynomial) => Ok(polynomial
                .evaluate(p.x * 2.0 / f64::from(width) - 1.0, p.y * 2.0 / f64::from(height) - 1.0)),
        }
    }

    /// Lattice cells per image pixel along each lattice axis at the middle of the image: above 1
    /// the target is coarser than the source.
    ///
    /// # Errors
    /// The projection is undefined at the middle of the image.
    pub fn cells_per_pixel(&self) -> Result<(f64, f64), CrsError> {
        let (width, height) = self.exact.size();
        let (x, y) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
        let at = |dx: f64, dy: f64| self.coordinate(PixelPoint { x: x + dx, y: y + dy });
        let (west, east, north, south) =
            (at(-0.5, 0.0)?, at(0.5, 0.0)?, at(0.0, -0.5)?, at(0.0, 0.5)?);
        Ok((
            libm::hypot(east.x - west.x, south.x - north.x),
            libm::hypot(east.y - west.y, south.y - north.y),
        ))
    }
}

impl Polynomial {
    fn evaluate(&self, u: f64, v: f64) -> PixelPoint {
        let (tu, tv) = (chebyshev(u), chebyshev(v));
        let sum = |c: &[[f64; 3]; 3]| {
            (0..3).map(|j| tv[j] * (0..3).map(|i| c[j][i] * tu[i]).sum::<f64>()).sum::<f64>()
        };
        PixelPoint { x: self.origin.0 + sum(&self.col), y: self.origin.1 + sum(&self.row) }
    }
}

/// Chebyshev coefficients from samples at the nine nodes, by discrete orthogonality.
fn coefficients(samples: &[[f64; 3]; 3]) -> [[f64; 3]; 3] {
    let weight = |i: usize| if i == 0 { 1.0 / 3.0 } else { 2.0 / 3.0 };
    let mut c = [[0.0; 3]; 3];
    for (j, row) in c.iter_mut().enumerate() {
        for (i, value) in row.iter_mut().enumerate() {
            let mut sum = 0.0;
            for (l, v) in NODES.into_iter().enumerate() {
                for (k, u) in NODES.into_iter().enumerate() {
                    sum += samples[l][k] * chebyshev(u)[i] * chebyshev(v)[j];
                }
            }
            *value = sum * weight(i) * weight(j);
        }
    }
    c
}

fn truncated(c: &[[f64; 3]; 3], keep: &[(usize, usize)]) -> [[f64; 3]; 3] {
    let mut out = [[0.0; 3]; 3];
    for &(i, j) in keep {
        out[j][i] = c[j][i];
    }
    out
}

#[cfg(test)]
mod tests;
