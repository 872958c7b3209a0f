//! What is seen from a street: an equirectangular panorama with the same solids, paint, light and
//! shadows as the satellite image, and where it shows the sky.

use super::camera::Camera;
use super::object::Epoch;
use super::object::{Colour, rgb};
use super::render::{Light, Sight};
use super::solid::{Face, Ray};
use super::surface::Scene;
use super::terrain::Ground;
use super::world::Seen;
use rayon::prelude::*;

/// Height of the camera over the ground, metres: on the roof of a car.
pub const CAMERA_HEIGHT_M: f64 = 2.5;
/// Nothing is looked for farther away, metres.
const FAR_M: f64 = 2000.0;
/// Ground is met when the ray is this close to it, metres.
const TOUCH_M: f64 = 1e-4;
/// Most steps towards the ground.
const STEPS: usize = 200;

/// A panorama from a point of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Panorama {
    /// Columns; rows are half as many.
    pub width: usize,
    /// Red, green, blue: `width * width / 2 * 3` bytes. The middle column looks to true north, three quarters
    /// east; row 0 is the zenith. Column `u` looks along `360 ((u + 0.5) / width - 0.5)` degrees from north, row `v`
    /// at `180 (0.5 - (v + 0.5) / height)` degrees over the horizon.
    pub rgb: Vec<u8>,
    /// 255 where the middle of the pixel shows the sky, else 0.
    pub sky: Vec<u8>,
}

impl Scene {
    /// What a camera at a point of the local frame, `above` metres over the ground, sees all around at
    /// the images' time.
    #[must_use]
    pub fn panorama(&self, at: [f64; 2], above: f64, width: usize) -> Panorama {
        let height = width / 2;
        let from = [at[0], at[1], self.ground(at[0], at[1]) + above];
        let light = self.light();
        let look = |u: f64, v: f64| self.look_along(&light, from, self.direction(u, v, width));
        let sights: Vec<Sight> = (0..height)
            .into_par_iter()
            .flat_map_iter(|row| {
                (0..width).map(move |column| look(column as f64 + 0.5, row as f64 + 0.5))
            })
            .collect();
        let mut picture = vec![0_u8; 3 * width * height];
        picture.par_chunks_mut(3 * width.max(1)).enumerate().for_each(|(row, out)| {
            for column in 0..width {
                let here = &sights[row * width + column];
                let right = &sights[row * width + (column + 1) % width];
                let left = &sights[row * width + (column + width - 1) % width];
                let above = &sights[row.saturating_sub(1) * width + column];
                let below = &sights[(row + 1).min(height - 1) * width + column];
                let mut colour = here.colour;
                if [right, left, above, below].iter().any(|s| s.key != here.key) {
                    for (i, j) in [(-0.375, -0.125), (0.125, -0.375), (0.375, 0.25), (-0.2, 0.375)]
                    {
                        let more = look(column as f64 + 0.5 + i, row as f64 + 0.5 + j);
                        colour = [0, 1, 2].map(|k| colour[k] + more.colour[k]);
                    }
                    colour = colour.map(|c| c * 0.2);
                }
                for (out, c) in out[3 * column..3 * column + 3].iter_mut().zip(colour) {
                    let level = 255.0 * super::render::tone(c).sqrt();
                    *out = (level + 0.5).clamp(0.0, 255.0) as u8;
                }
            }
        });
        let sky = sights.iter().map(|s| if s.key == SKY { 255 } else { 0 }).collect();
        Panorama { width, rgb: picture, sky }
    }

    /// The unit vector in the local frame of a place in a panorama.
    fn direction(&self, u: f64, v: f64, width: usize) -> [f64; 3] {
        use std::f64::consts::{PI, TAU};
        let (sin, cos) = libm::sincos(TAU * (u / width as f64 - 0.5) + self.frame.convergence());
        let (up, level) = libm::sincos(PI * (0.5 - v / (width / 2) as f64));
        [level * sin, level * cos, up]
    }

    /// What is seen along a direction.
    fn look_along(&self, light: &Light, from: [f64; 3], step: [f64; 3]) -> Sight {
        let ray = Ray { from, step };
        let ground = self.ground_along(&ray);
        let end = ground.as_ref().map_or(FAR_M, |g| g.0);
        if let Some((_, seen)) = self.world(Epoch::Image).hit(&ray, 0.0, end) {
            let below = self.terrain.at(seen.at[0], seen.at[1]);
            return self.sight(light, &Camera::new(None), &seen, &below);
        }
        match ground {
            Some((t, ground)) => {
                let [x, y, _] = ray.at(t);
                let seen = Seen { solid: None, face: Face::Top(0), at: [x, y, ground.z] };
                self.sight(light, &Camera::new(None), &seen, &ground)
            }
            None => Sight { colour: self.sky(light, step), key: SKY },
        }
    }

    /// Where a ray that starts above the ground meets it: steps that cannot pass it, for no ground is
    /// steeper than the bound of the terrain.
    fn ground_along(&self, ray: &Ray) -> Option<(f64, Ground)> {
        let [dx, dy, dz] = ray.step;
        let steepest = self.steepest;
        let closing = steepest * libm::hypot(dx, dy) - dz;
        if closing <= 0.0 {
            return None;
        }
        let mut t = 0.0;
        for _ in 0..STEPS {
            let [x, y, z] = ray.at(t);
            let ground = self.terrain.at(x, y);
            let gap = z - ground.z;
            if gap < TOUCH_M {
                return Some((t, ground));
            }
            t += gap / closing;
            if t > FAR_M {
                return None;
            }
        }
        // So flat an angle that the steps ran out: the horizon.
        let [x, y, _] = ray.at(t);
        (dz < 0.0).then(|| (t, self.terrain.at(x, y)))
    }

    /// The sky in a direction: blue and darker towards the zenith, pale at the horizon, bright about the
    /// sun; grey when overcast.
    fn sky(&self, light: &Light, step: [f64; 3]) -> Colour {
        let up = step[2].clamp(0.0, 1.0) as f32;
        let high = 1.0 - (1.0 - up) * (1.0 - up);
        let blend = |low: Colour, top: Colour| super::ground::mix(low, top, high);
        let Some(sun) = &self.sun else {
            return blend(rgb(226, 228, 230), rgb(196, 200, 206));
        };
        let cos = (0..3).map(|i| step[i] * sun.step[i]).sum::<f64>().clamp(-1.0, 1.0) as f32;
        let glow = libm::powf(cos.max(0.0), 24.0) * 0.5 + libm::powf(cos.max(0.0), 900.0) * 2.0;
        let clear = blend(rgb(206, 218, 230), rgb(92, 138, 204));
        [0, 1, 2].map(|i| clear[i] + glow * light.sun[i].min(1.5))
    }
}

/// Key of what is sky.
const SKY: u64 = u64::MAX;
