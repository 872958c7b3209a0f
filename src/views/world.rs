//! Metres around the scene, and how they lie in its cube.

use super::ViewError;
use crate::footprint::Footprint;
use crate::model::Scene;
use crate::model::render::exact_scale;
use crate::model::render::frames::{Matrix, Vector};
use crate::model::render::{Angles, Camera, Intrinsics, Pose, RenderOptions, SampleCounts, Wanted};

/// Pixels along each side of the released DSM; the surface is probed that far apart.
const DSM_SIZE: f64 = 256.0;
/// Samples along a probing ray, coarse and fine: cells of 0.004 cube units before the refinement.
const PROBE_SAMPLES: usize = 512;
/// Least distance above the surface from which it is looked at again, cube units.
const PROBE_ABOVE: f64 = 0.05;

/// East, north and up in metres. East and north count from the middle of the crop, up from the bottom of
/// the cube, which is the zero of the DSM.
///
/// Across and up a cube unit may be different numbers of metres
/// ([`VerticalScale`](crate::footprint::VerticalScale)). A camera that is stated in metres is then no
/// rotation in the cube any more: its rays are stretched, so that what it sees is the scene in metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct World {
    scale: f64,
    metres_per_unit: Vector,
}

impl World {
    /// Of a scene whose crop has this footprint.
    #[must_use]
    pub fn new(scene: &Scene, footprint: &Footprint) -> Self {
        let scale = exact_scale(scene.parts().inputs.scale);
        let [across, down] = footprint.metres_per_unit(scale);
        Self { scale, metres_per_unit: [across, down, scene.parts().metres_per_unit] }
    }

    /// Half the width of the crop in the cube: 0.8 as released.
    #[must_use]
    pub fn scale(&self) -> f64 {
        self.scale
    }

    /// A place in metres, in the camera-world frame of the cube.
    #[must_use]
    pub fn to_cube(&self, metres: Vector) -> Vector {
        let [x, y, z] = self.over(metres);
        [x, y, z - 1.0]
    }

    /// A place of the camera-world frame of the cube, in metres.
    #[must_use]
    pub fn to_metres(&self, [x, y, z]: Vector) -> Vector {
        let [east, north, up] = self.metres_per_unit;
        [x * east, y * north, (z + 1.0) * up]
    }

    /// A rotation from a camera's axes to east, north and up in metres, as the matrix from the camera's
    /// axes to directions in the cube.
    #[must_use]
    pub fn camera_to_cube(&self, rotation: &Matrix) -> Matrix {
        // Only directions count: the common factor keeps the matrix near a rotation.
        let [east, ..] = self.metres_per_unit;
        [0, 1, 2].map(|axis| rotation[axis].map(|v| v * (east / self.metres_per_unit[axis])))
    }

    /// Metres of one cube unit along a unit direction of the cube.
    #[must_use]
    pub fn metres_along(&self, direction: Vector) -> f64 {
        let squares = [0, 1, 2].map(|axis| {
            let metres = direction[axis] * self.metres_per_unit[axis];
            metres * metres
        });
        (squares[0] + squares[1] + squares[2]).sqrt()
    }

    /// The normal in metres of a surface with this normal in the cube; not yet of unit length.
    #[must_use]
    pub fn normal_to_metres(&self, normal: Vector) -> Vector {
        self.over(normal)
    }

    fn over(&self, v: Vector) -> Vector {
        [0, 1, 2].map(|axis| v[axis] / self.metres_per_unit[axis])
    }

    /// z of the surface at a place of the cube (camera-world frame): the median of nine vertical rays one
    /// DSM pixel apart, so that neither noise nor half-transparent walls move it. `None` where most of them
    /// hit nothing.
    ///
    /// Rays end where their light ends on average, which thin haze moves up: one per cent of it along
    /// the cube's height by a third of a metre. Each place is therefore looked at again from a little above.
    #[must_use]
    pub fn surface(&self, scene: &Scene, [x, y]: [f64; 2]) -> Option<f64> {
        crate::plan::runs("surface-probe");
        let step = 2.0 * self.scale / DSM_SIZE;
        let mut heights = Vec::with_capacity(9);
        for row in [-1.0, 0.0, 1.0] {
            for column in [-1.0, 0.0, 1.0] {
                let at = [x + column * step, y + row * step];
                let found = probe(scene, at, 1.0).and_then(|(z, spread)| {
                    let above = z + (2.0 * spread).max(PROBE_ABOVE);
                    probe(scene, at, above.min(1.0))
                });
                heights.extend(found.map(|(z, _)| z));
            }
        }
        heights.sort_by(f64::total_cmp);
        (heights.len() >= 5).then(|| heights[heights.len() / 2])
    }

    /// [`Self::surface`], or the error that says where there is none.
    pub(super) fn surface_or_error(
        &self,
        scene: &Scene,
        [x, y]: [f64; 2],
    ) -> Result<f64, ViewError> {
        self.surface(scene, [x, y]).ok_or_else(|| {
            let [east, north, _] = self.to_metres([x, y, 0.0]);
            ViewError::NoSurface { east, north }
        })
    }
}

/// Where a ray straight down from `above` ends, and the standard deviation of that, cube units.
fn probe(scene: &Scene, [x, y]: [f64; 2], above: f64) -> Option<(f64, f64)> {
    let samples = SampleCounts::new(PROBE_SAMPLES, PROBE_SAMPLES).unwrap_or_default();
    let options = RenderOptions { samples, ..RenderOptions::stable() };
    let rotation = Angles { pitch: 90.0, ..Angles::default() }.rotation();
    let camera = Camera::Perspective {
        width: 1,
        height: 1,
        intrinsics: Intrinsics { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 },
        pose: Pose { position: [x, y, above], rotation },
    };
    let view = scene.render(&camera, &options, Wanted::default());
    let (depth, spread) = (f64::from(view.depth[0]), f64::from(view.depth_spread[0]));
    (!depth.is_nan()).then_some((above - depth, spread))
}
