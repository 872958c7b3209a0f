//! The picture of a satellite image: what each pixel sees, how it is lit, and its colour.
//!
//! One sample at each pixel centre; pixels at a drawn or cast edge get three more (antialiasing
//! costs only where it shows).

use super::camera::Camera;
use super::effects::Effect;
use super::ground::{Paint, scale};
use super::layout::SHORE_STRIP_M;
use super::materials;
use super::object::{Class, Colour, Epoch};
use super::pixels::PixelPositions;
use super::solid::Face;
use super::surface::Scene;
use super::terrain::Ground;
use super::world::Seen;
use crate::plan::runs;
use crate::random::{key, normal};
use rayon::prelude::*;

/// One look at the scene.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sight {
    pub colour: Colour,
    /// Differs where neighbouring pixels see different things.
    pub key: u64,
}

/// Light on a scene: what the sky gives, what the sun gives (linear colours).
#[derive(Clone, Copy, Debug)]
pub(super) struct Light {
    pub sky: Colour,
    pub sun: Colour,
}

/// How a part of a picture is rendered.
#[derive(Clone, Copy, Debug)]
pub struct Sheet {
    /// Pixels of the margin that are looked at for edges; none is rendered.
    pub halo: usize,
    /// Seed of the sensor's noise.
    pub seed: u64,
    /// Number of the first pixel, in rows of `pitch` pixels: the noise of a pixel hangs on its number.
    pub first: u64,
    /// Pixels of a row of the whole picture.
    pub pitch: u64,
}

impl Scene {
    /// Renders an image, 3 bytes per pixel, row 0 in the north.
    #[must_use]
    pub fn render(&self, pixels: &PixelPositions, image_seed: u64) -> Vec<u8> {
        let width = pixels.size()[0] - 2 * pixels.margin();
        let sheet = Sheet { halo: 0, seed: image_seed, first: 0, pitch: width as u64 };
        let mut picture = self.render_sheet(pixels, &sheet);
        self.camera.develop(&mut picture, width);
        picture
    }

    /// Renders a part of a picture. With a halo it is the same as in any larger part. What a camera does to
    /// a finished picture is left to the caller.
    #[must_use]
    pub(super) fn render_sheet(&self, pixels: &PixelPositions, sheet: &Sheet) -> Vec<u8> {
        let (margin, halo) = (pixels.margin(), sheet.halo);
        let [width, height] = pixels.size().map(|n| n - 2 * margin);
        let [across, down] = [width, height].map(|n| n + 2 * halo);
        if self.spec.camera.is_some() {
            runs("camera");
        }
        let light = self.light();
        let samples: Vec<Sight> = (0..down)
            .into_par_iter()
            .flat_map_iter(|row| {
                let positions = &pixels.row(row + margin - halo)[margin - halo..][..across];
                let light = &light;
                positions.iter().map(move |p| self.sample(light, *p))
            })
            .collect();
        let [to_right, to_below] = pixels.steps();
        // Offsets of the extra samples in pixels: with the centre a rotated grid.
        let extra = [(-0.375, -0.125), (0.125, -0.375), (0.375, 0.25), (-0.2, 0.375)]
            .map(|(i, j)| [0, 1].map(|k| i * to_right[k] + j * to_below[k]));
        let noise = if self.effects.runs(Effect::SensorNoise) {
            self.spec.images.sensor_noise_levels
        } else {
            0.0
        };
        let mut picture = vec![0_u8; 3 * width * height];
        picture.par_chunks_mut(3 * width).enumerate().for_each(|(row, out)| {
            let positions = &pixels.row(row + margin)[margin..margin + width];
            for column in 0..width {
                let (x, y) = (column + halo, row + halo);
                let index = y * across + x;
                let here = samples[index];
                let differs = |i: usize| samples[i].key != here.key;
                let at_edge = (x > 0 && differs(index - 1))
                    || (x + 1 < across && differs(index + 1))
                    || (y > 0 && differs(index - across))
                    || (y + 1 < down && differs(index + across));
                let mut colour = here.colour;
                if at_edge {
                    for offset in extra {
                        let p = positions[column];
                        let s = self.sample(&light, [p[0] + offset[0], p[1] + offset[1]]);
                        for (sum, part) in colour.iter_mut().zip(s.colour) {
                            *sum += part;
                        }
                    }
                    colour = scale(colour, 0.2);
                }
                let number = sheet.first + row as u64 * sheet.pitch + column as u64;
                for i in 0..3 {
                    let mut level = 255.0 * self.camera.curve(tone(colour[i]).sqrt());
                    if noise > 0.0 {
                        let hash = key(&[sheet.seed, number, i as u64]);
                        level += (noise * normal(hash)) as f32;
                    }
                    out[3 * column + i] = (level + 0.5).clamp(0.0, 255.0) as u8;
                }
            }
        });
        picture
    }

    /// Exposure is set so that level sunlit ground shows its own colour.
    pub(super) fn light(&self) -> Light {
        let Some(sun) = self.sun.filter(|_| self.spec.sun.is_some()) else {
            return Light { sky: [1.0, 1.02, 1.06], sun: [0.0; 3] };
        };
        let high = sun.step[2] as f32;
        // A low sun is redder and leaves the sky to light the rest.
        let warm = (1.0 - high).powi(2);
        let deep = self.camera.sky_light;
        let strength = ((0.8 + 0.2 * (1.0 - deep)) / high).min(3.2);
        let sun_colour = [1.0 + 0.1 * warm, 0.985 - 0.06 * warm, 0.95 - 0.3 * warm];
        Light { sky: scale([0.2, 0.235, 0.3], deep), sun: scale(sun_colour, strength) }
    }

    /// What is seen at a position of the image: the ground point that lies there, or what stands
    /// in the way.
    fn look(&self, p: [f64; 2]) -> (Seen, Ground) {
        let ground = self.terrain.at(p[0], p[1]);
        let world = self.world(Epoch::Image);
        let on_ground = Seen { solid: None, face: Face::Top(0), at: [p[0], p[1], ground.z] };
        let seen = if self.effects.runs(Effect::Relief) {
            world.seen(on_ground.at, self.lean)
        } else {
            match world.top(p[0], p[1], |_| true) {
                Some((index, z, face)) => Seen { solid: Some(index), face, at: [p[0], p[1], z] },
                None => on_ground,
            }
        };
        // A solid that the slope has buried is not seen.
        if seen.solid.is_some() && seen.at[2] > ground.z {
            (seen, ground)
        } else {
            (on_ground, ground)
        }
    }

    fn sample(&self, light: &Light, p: [f64; 2]) -> Sight {
        let (seen, ground) = self.look(p);
        self.sight(light, &self.camera, &seen, &ground)
    }

    /// Colour of what is seen, with the ground below it, through a camera.
    pub(super) fn sight(
        &self,
        light: &Light,
        camera: &Camera,
        seen: &Seen,
        ground: &Ground,
    ) -> Sight {
        let [x, y, z] = seen.at;
        let (paint, normal, class, thing) = match seen.solid {
            Some(index) => {
                let solid = &self.world(Epoch::Image).solids[index as usize];
                let n = solid.shape.normal(seen.face, seen.at);
                let paint = materials::paint(solid, seen.face, seen.at, self.spec.detail.is_some());
                (paint, n, solid.class, u64::from(index) + 1)
            }
            None => {
                let inland = self.terrain.inland(x, y);
                let paint = self.paint.at(&self.streets, x, y, inland);
                let class = if ground.water {
                    Class::Water
                } else if inland < SHORE_STRIP_M {
                    Class::Ground
                } else {
                    Class::Street
                };
                (paint, [-ground.dx, -ground.dy, 1.0], class, 0)
            }
        };
        let length = (normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]).sqrt();
        let n = normal.map(|c| c / length);
        let mut lit = 0.0_f32;
        if let Some(sun) = &self.sun {
            let along = n[0] * sun.step[0] + n[1] * sun.step[1] + n[2] * sun.step[2];
            if along > 0.0 && !self.in_shadow([x, y, z], sun) {
                lit = along as f32;
            }
        }
        let colour = camera.expose(shade(light, &paint, n[2] as f32, lit, class));
        // Leaves are all edges; antialiasing them one by one would blur nothing but cost much.
        let face = if class == Class::Tree { 0 } else { face_number(seen.face) };
        let parts = [thing, face, u64::from(paint.key), u64::from(lit > 0.0)];
        let shadow_key = if class == Class::Tree { &parts[..2] } else { &parts[..] };
        Sight { colour, key: key(shadow_key) }
    }

    fn in_shadow(&self, from: [f64; 3], sun: &super::world::SunRay) -> bool {
        (self.effects.runs(Effect::Shadows) && self.world(Epoch::Image).shadowed(from, sun))
            || (self.effects.runs(Effect::TerrainShadows) && self.terrain_shadowed(from, sun))
    }
}

fn face_number(face: Face) -> u64 {
    match face {
        Face::Top(i) => u64::from(i),
        Face::Wall(i) => 300 + u64::from(i),
        Face::Bottom => 400,
    }
}

fn shade(light: &Light, paint: &Paint, up: f32, lit: f32, class: Class) -> Colour {
    // The sky lights what faces it; walls get light from the ground too.
    let sky = 0.45 + 0.55 * up.max(0.0);
    let mut colour: Colour =
        [0, 1, 2].map(|i| paint.colour[i] * (light.sky[i] * sky + light.sun[i] * lit));
    if class == Class::Tree && lit > 0.0 {
        // Leaves let some light through, which makes them yellower.
        colour = [colour[0] * 1.06, colour[1] * 1.05, colour[2] * 0.9];
    }
    colour
}

/// Compresses what is brighter than white, so that pale roofs keep their texture.
pub(super) fn tone(v: f32) -> f32 {
    let knee = 0.72;
    if v <= knee {
        v.max(0.0)
    } else {
        knee + (1.0 - knee) * (1.0 - 1.0 / (1.0 + (v - knee) / (1.0 - knee)))
    }
}
