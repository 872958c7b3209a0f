//! Density grids: on the pixel lattice, and on the released grid with its drift (MODEL_SPEC section 10).

use super::camera::crop_coordinate;
use super::view::exact_scale;
use crate::field::{ColumnRoom, ColumnTables, Field};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Coordinates of a regular grid in the map frame, each list ascending.
#[derive(Clone, Debug, PartialEq)]
pub struct Lattice {
    /// x (east) of axis 0.
    pub x: Vec<f32>,
    /// y (south) of axis 1.
    pub y: Vec<f32>,
    /// z (up) of axis 2.
    pub z: Vec<f32>,
}

impl Lattice {
    /// Columns at the centres of the crop's `size x size` pixels, `scale * ((j + 1/2) / (size / 2) - 1)`, and
    /// levels of about the same pitch at the centres of equal parts of the cube's whole height:
    /// 256 x 256 x 320 at a scale of 0.8.
    #[must_use]
    pub fn pixels(size: usize, scale: f32) -> Self {
        let scale = exact_scale(scale);
        let across: Vec<f32> = (0..size).map(|j| crop_coordinate(j, size, scale)).collect();
        let levels = (size as f64 / scale).round_ties_even() as usize;
        let z = (0..levels).map(|k| ((2 * k + 1) as f64 / levels as f64 - 1.0) as f32).collect();
        Self { x: across.clone(), y: across, z }
    }

    /// Points along each axis.
    #[must_use]
    pub fn shape(&self) -> [usize; 3] {
        [self.x.len(), self.y.len(), self.z.len()]
    }
}

/// Volume densities on a lattice: `values[(ix * shape[1] + iy) * shape[2] + iz]`, per cube unit.
#[derive(Clone, Debug, PartialEq)]
pub struct DensityGrid {
    /// Where the points are. Of the released grid, where they are meant to be.
    pub lattice: Lattice,
    /// The densities, z fastest.
    pub values: Vec<f32>,
}

impl DensityGrid {
    /// Points along x, y and z.
    #[must_use]
    pub fn shape(&self) -> [usize; 3] {
        self.lattice.shape()
    }
}

/// Densities on any lattice, column by column over all cores.
#[must_use]
pub fn density_grid(field: &Field, lattice: Lattice) -> DensityGrid {
    let [_, ny, nz] = lattice.shape();
    let mut values = vec![0.0_f32; lattice.shape().iter().product()];
    let tables = ColumnTables::new(field, &lattice.x);
    let rows: Vec<_> =
        if nz == 0 { Vec::new() } else { lattice.y.par_iter().map(|y| tables.row(*y)).collect() };
    if ny * nz > 0 {
        values.par_chunks_mut(ny * nz).enumerate().for_each_init(
            ColumnRoom::default,
            |room, (ix, slab)| {
                for (row, column) in rows.iter().zip(slab.chunks_exact_mut(nz)) {
                    row.column(ix, lattice.x[ix], room).raw_at_heights(&lattice.z, column);
                }
                field.activate(slab);
            },
        );
    }
    DensityGrid { lattice, values }
}

/// What the released code does at the border of its grid.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Border {
    /// Nothing.
    Keep,
    /// `crop=false`: zero the outer voxels in x and y and the lowest in z, so that a mesh closes there.
    #[default]
    Zero,
    /// `crop=true`: cut those voxels off.
    Cut,
}

/// The released grid of `count` points along each axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReferenceGrid {
    /// Points along each axis (320 as released).
    pub count: usize,
    /// Its border.
    pub border: Border,
}

impl Default for ReferenceGrid {
    fn default() -> Self {
        Self { count: 320, border: Border::default() }
    }
}

impl ReferenceGrid {
    /// Voxels that the border takes from each side: `count * (1 - scale) / 2`, a tie to the even number.
    #[must_use]
    pub fn border_width(&self, scale: f32) -> usize {
        (self.count as f64 * (1.0 - exact_scale(scale)) / 2.0).round_ties_even() as usize
    }

    /// The point of flat index `index`, in the released arithmetic: x and y are found in `f32` without
    /// rounding down, so that both drift by up to one voxel along the faster axes.
    #[must_use]
    pub fn point(&self, index: usize) -> [f32; 3] {
        let count = self.count as f32;
        let step = self.step();
        let n = index as f32 / count;
        let x = remainder(n / count, count);
        let y = remainder(n, count);
        let z = (index % self.count) as f32;
        [x * step - 1.0, y * step - 1.0, z * step - 1.0]
    }

    fn step(&self) -> f32 {
        (2.0 / (self.count as f64 - 1.0)) as f32
    }

    /// Where the points are meant to be along an axis.
    pub(crate) fn axis(&self) -> Vec<f32> {
        (0..self.count).map(|k| k as f32 * self.step() - 1.0).collect()
    }
}

/// `value % modulus` for a positive number and a positive integer whose quotient is below 2^24, without
/// `fmod`'s loop. The rounded quotient is at most one off, and everything else is exact: the product is an
/// integer near `value`, the difference has no more bits than `value`.
fn remainder(value: f32, modulus: f32) -> f32 {
    let rest = value - (value / modulus) as u32 as f32 * modulus;
    if rest < 0.0 {
        rest + modulus
    } else if rest >= modulus {
        rest - modulus
    } else {
        rest
    }
}

/// Densities on the released grid, with its drift: for parity, not for use ([`density_grid`] has the
/// points where they belong). Cut, axes start at the border's width.
///
/// # Panics
/// When the grid has fewer than two points along an axis.
#[must_use]
pub fn reference_grid(field: &Field, grid: &ReferenceGrid) -> DensityGrid {
    let count = grid.count;
    assert!(count >= 2, "a grid of {count} points along an axis");
    let width = grid.border_width(field.scale());
    let cut = if grid.border == Border::Cut { width } else { 0 };
    let across = cut..count - cut;
    let mut values = vec![0.0_f32; across.len() * across.len() * (count - cut)];
    let slab = across.len() * (count - cut);
    let inside = |index: usize| (width..count - width).contains(&index);
    values.par_chunks_mut(slab).zip(across.clone()).for_each_init(
        Vec::new,
        |points: &mut Vec<[f32; 3]>, (slab, ix)| {
            for (column, iy) in slab.chunks_exact_mut(count - cut).zip(across.clone()) {
                let from = match grid.border {
                    Border::Zero if !(inside(ix) && inside(iy)) => continue,
                    Border::Zero => width,
                    _ => 0,
                };
                let first = (ix * count + iy) * count + cut;
                points.clear();
                points.extend((from..column.len()).map(|k| grid.point(first + k)));
                field.raw_at(points, &mut column[from..], None);
                field.activate(&mut column[from..]);
            }
        },
    );
    let axis = grid.axis();
    let lattice = Lattice {
        x: axis[across.clone()].to_vec(),
        y: axis[across].to_vec(),
        z: axis[cut..].to_vec(),
    };
    DensityGrid { lattice, values }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn remainder_is_fmod() {
        for k in 0..400_000_u32 {
            let value = (k * 83) as f32 / 320.0;
            assert_eq!(remainder(value, 320.0), value % 320.0, "{value}");
            let value = value / 320.0;
            assert_eq!(remainder(value, 320.0), value % 320.0, "{value}");
        }
        assert_eq!(remainder(320.0, 320.0), 0.0);
        assert_eq!(remainder(f32::from_bits(320.0_f32.to_bits() - 1), 320.0), 319.999_97);
    }

    #[test]
    fn border_and_lattice() {
        assert_eq!(ReferenceGrid { count: 320, border: Border::Zero }.border_width(0.8), 32);
        assert_eq!(ReferenceGrid { count: 64, border: Border::Zero }.border_width(0.8), 6);
        // numpy: round(n * (1 - 1 / 1.25) / 2)
        for (count, width) in [(5, 0), (15, 1), (25, 2), (35, 3), (45, 4), (512, 51)] {
            assert_eq!(
                ReferenceGrid { count, border: Border::Zero }.border_width(0.8),
                width,
                "{count}"
            );
        }
        let lattice = Lattice::pixels(256, 0.8);
        assert_eq!(lattice.shape(), [256, 256, 320]);
        assert_eq!((lattice.x[0], lattice.x[255]), (-0.796_875, 0.796_875));
        assert_eq!((lattice.z[0], lattice.z[319]), (-0.996_875, 0.996_875));
    }
}
