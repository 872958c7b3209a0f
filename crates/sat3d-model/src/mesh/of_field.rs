//! The mesh of a field: grid, surface, frame, colours.

use super::{
    Axis, CLAMP, Mesh, MeshColor, MeshError, MeshFrame, MeshLattice, MeshOptions, mesh_grid,
};
use crate::field::Field;
use crate::render::{
    Border, DensityGrid, Lattice, ReferenceGrid, density_grid, exact_scale, reference_grid,
};
use rayon::prelude::*;

/// Vertices that are coloured at a time: a field's colours take up to 24 values each.
const BATCH: usize = 1 << 16;

/// The mesh of a field; colours are the field's own.
pub(crate) fn scene_mesh(field: &Field, options: &MeshOptions) -> Result<Mesh, MeshError> {
    if !(options.isovalue > 0.0 && options.isovalue.is_finite()) {
        return Err(MeshError::Isovalue(options.isovalue.into()));
    }
    let frame = Frame::new(options)?;
    let scale = exact_scale(field.scale());
    let (axes, grid) = match options.lattice {
        MeshLattice::Pixels { size } => {
            let least = 1;
            if size < least {
                return Err(MeshError::Lattice { found: size, least });
            }
            frame.check_count(size, scale)?;
            let lattice = Lattice::pixels(size, field.scale());
            let axes = [
                axis(-scale, &lattice.x, scale)?,
                axis(-scale, &lattice.y, scale)?,
                axis(-1.0, &lattice.z, 1.0)?,
            ];
            frame.check(&axes)?;
            (axes, density_grid(field, lattice))
        }
        MeshLattice::Reference { count } => {
            let least = 2;
            if count < least {
                return Err(MeshError::Lattice { found: count, least });
            }
            frame.check_count(count, 1.0)?;
            let half = 1.0 / (count as f64 - 1.0);
            let grid = ReferenceGrid { count, border: Border::Zero };
            let all = axis(-1.0 - half, &grid.axis(), 1.0 + half)?;
            let axes = [all.clone(), all.clone(), all];
            frame.check(&axes)?;
            (axes, reference_grid(field, &grid))
        }
    };
    let DensityGrid { values, .. } = grid;
    let surface = mesh_grid(&axes, &values, options.isovalue.into())?;
    drop(values);
    let (vertices, mut triangles) = (surface.vertices, surface.triangles);
    // The map frame is left-handed; both frames mirror it once.
    triangles.par_iter_mut().for_each(|corners| corners.reverse());
    let colors = (options.color == MeshColor::Field).then(|| colors(field, &vertices));
    let texture_coordinates = (options.color == MeshColor::Texture).then(|| {
        let across = |value: f64| ((value / scale + 1.0) / 2.0) as f32;
        vertices.par_iter().map(|vertex| [across(vertex[0]), across(vertex[1])]).collect()
    });
    let vertices = vertices.par_iter().map(|vertex| frame.place(*vertex)).collect();
    Ok(Mesh { frame: options.frame, vertices, triangles, colors, texture_coordinates })
}

fn axis(before: f64, points: &[f32], behind: f64) -> Result<Axis, MeshError> {
    Axis::new(before, points.iter().map(|point| f64::from(*point)), behind)
}

/// From the map frame to the one that was asked for.
struct Frame {
    frame: MeshFrame,
    /// Metres per cube unit along x, y and z; 1 where cube units stay.
    metres: [f64; 3],
}

impl Frame {
    fn new(options: &MeshOptions) -> Result<Self, MeshError> {
        let [across, down] = options.horizontal_metres_per_unit;
        let metres = [across, down, options.vertical_metres_per_unit];
        if let Some(wrong) = metres.iter().find(|metres| !(**metres > 0.0 && metres.is_finite())) {
            return Err(MeshError::MetresPerUnit(*wrong));
        }
        let metres = match options.frame {
            MeshFrame::EastNorthUp => metres,
            MeshFrame::Reference => [1.0; 3],
        };
        Ok(Self { frame: options.frame, metres })
    }

    fn place(&self, [x, y, z]: [f64; 3]) -> [f32; 3] {
        let [across, down, up] = self.metres;
        let placed = match self.frame {
            MeshFrame::EastNorthUp => [x * across, -y * down, (z + 1.0) * up],
            MeshFrame::Reference => [y, z, -x],
        };
        placed.map(|value| value as f32)
    }

    /// Refuses at once what would only fill the memory: [`Frame::check`] never passes so many points.
    fn check_count(&self, count: usize, scale: f64) -> Result<(), MeshError> {
        let extent = 2.0 * scale * self.metres[0];
        let step = extent / count as f64;
        if count > 1 << 15 { Err(MeshError::TooFine { step, extent }) } else { Ok(()) }
    }

    /// Whether rounding keeps vertices apart that the clamp keeps apart, by a few units of the last place.
    fn check(&self, axes: &[Axis; 3]) -> Result<(), MeshError> {
        for (axis, metres) in axes.iter().zip(self.metres) {
            let step = axis.least_step() * metres;
            // Heights count from the bottom, twice the half of the cube.
            let ends = axis.with_closing_planes();
            let extent = metres * 2.0_f64.max(ends[ends.len() - 1] - ends[0]);
            let unit = f64::from((extent as f32).next_up()) - f64::from(extent as f32);
            // Of an extent beyond 32-bit floats the unit is not a number.
            if unit.is_nan() || step * CLAMP <= 4.0 * unit {
                return Err(MeshError::TooFine { step, extent });
            }
        }
        Ok(())
    }
}

/// Red, green and blue of the field, as the reference rounds them.
fn colors(field: &Field, vertices: &[[f64; 3]]) -> Vec<[u8; 3]> {
    let channels = field.color_channels();
    let mut all = Vec::with_capacity(vertices.len());
    for vertices in vertices.chunks(BATCH) {
        let points: Vec<[f32; 3]> = vertices.iter().map(|v| v.map(|v| v as f32)).collect();
        let (_, values) = field.densities_and_colors(&points);
        all.extend(values.chunks_exact(channels).map(|values| {
            // A field of one channel is grey.
            [0, 1, 2].map(|k| (values[k.min(channels - 1)] * 255.0) as u8)
        }));
    }
    all
}
