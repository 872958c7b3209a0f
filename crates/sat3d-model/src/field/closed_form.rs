//! Fields whose surface is known: a city of boxes, for tests, demonstrations and trade-off studies.
//!
//! MODEL_SPEC section 13: one plane channel holds `steepness * h(x, y)`, one line channel
//! `-steepness * z`, and the head adds them, so that the raw density is
//! `gain * softplus(steepness * (h(x, y) - z)) + bias`: solid below the surface `z = h(x, y)`, empty above.
//! It holds where `|z| <= 1 - 1/texels`; nearer the cube's rim features fade to zero, as they do in
//! a trained field.

use super::{DensityActivation, FieldInputs, Linear, PointHead, Representation};
use crate::tensor::Grid;

/// A box standing on the ground; all lengths in cube units, map frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Building {
    /// Least and greatest x (east).
    pub x: [f32; 2],
    /// Least and greatest y (south).
    pub y: [f32; 2],
    /// z of its roof.
    pub roof: f32,
}

/// A city of boxes on level ground.
#[derive(Clone, Debug, PartialEq)]
pub struct BoxCity {
    /// z of the ground.
    pub ground: f32,
    /// The buildings; where two overlap the higher one counts.
    pub buildings: Vec<Building>,
    /// How fast raw density grows with depth below the surface, per cube unit.
    pub steepness: f32,
    /// Raw density per unit of softplus.
    pub gain: f32,
    /// Raw density far above the surface.
    pub bias: f32,
    /// Texels along each axis of the map.
    pub texels: usize,
}

impl BoxCity {
    /// A small city without any symmetry: a tower in the north-east, a hall in the south, a low
    /// house in the west, level ground elsewhere.
    #[must_use]
    pub fn example() -> Self {
        let building = |x, y, roof| Building { x, y, roof };
        Self {
            ground: -0.8,
            buildings: vec![
                building([0.35, 0.6], [-0.6, -0.35], 0.3),
                building([-0.2, 0.45], [0.4, 0.65], -0.35),
                building([-0.65, -0.4], [-0.3, 0.1], -0.55),
            ],
            steepness: 400.0,
            gain: 40.0,
            bias: -4.0,
            texels: 320,
        }
    }

    /// z of the surface at a texel's centre.
    #[must_use]
    pub fn surface(&self, x: f32, y: f32) -> f32 {
        let inside = |range: [f32; 2], value: f32| range[0] <= value && value < range[1];
        (self.buildings.iter())
            .filter(|building| inside(building.x, x) && inside(building.y, y))
            .map(|building| building.roof)
            .fold(self.ground, f32::max)
    }

    /// Feature map and point head of the field. Colour tells the height of the roof: red grows and
    /// green falls with it.
    #[must_use]
    pub fn inputs(&self) -> (FieldInputs, PointHead) {
        let n = self.texels;
        let centre = |index: usize| (2 * index + 1) as f32 / n as f32 - 1.0;
        let mut data = Vec::with_capacity(2 * n * n);
        for row in 0..n {
            data.extend(
                (0..n).map(|column| self.steepness * self.surface(centre(column), centre(row))),
            );
        }
        for _ in 0..n {
            data.extend((0..n).map(|column| -self.steepness * centre(column)));
        }
        let linear = |inputs: usize, outputs: usize, weight: Vec<f32>, bias: Vec<f32>| Linear {
            inputs,
            outputs,
            weight,
            bias,
        };
        let inputs = FieldInputs {
            map: Grid::new(2, n, n, data),
            representation: Representation::Oneplane,
            activation: DensityActivation::Mipnerf,
            scale: 0.8,
        };
        // A second hidden value, softplus of the plane alone, is a roof colour.
        let head = PointHead {
            net0: linear(2, 2, vec![1.0, 1.0, 1.0 / self.steepness, 0.0], vec![0.0, 0.0]),
            density: linear(2, 1, vec![self.gain, 0.0], vec![self.bias]),
            feature: linear(2, 1, vec![0.0, 1.0], vec![0.0]),
            style: linear(1, 1, vec![1.0], vec![0.0]),
            color: linear(2, 3, vec![4.0, 0.0, -4.0, 0.0, 1.0, 0.5], vec![-2.0, 2.0, 0.0]),
        };
        (inputs, head)
    }
}
