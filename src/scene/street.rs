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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::effects::Options;
    use crate::scene::object::{Class, Finish, Kind, Object, Part};
    use crate::scene::pixels::PixelPositions;
    use crate::scene::shape::Rect;
    use crate::scene::solid::{Prism, Shape, flat};
    use crate::scene::spec::{SceneSpec, SunSpec};

    /// A level scene with one white box: 10 m east to west, 8 m south to north, its middle at the origin.
    fn lone_box(height: f64, sun: Option<SunSpec>) -> Scene {
        let mut spec = SceneSpec { sun, ..SceneSpec::default() };
        spec.terrain.relief_metres = 0.0;
        spec.terrain.slope_percent = 0.0;
        let scene = Scene::new(spec, &Options::default()).expect("a scene");
        let [nx, ny] = scene.frame.true_north();
        let ground = scene.ground(0.0, 0.0);
        let rect = Rect::new([0.0, 0.0], [ny, -nx], 5.0, 4.0);
        let shape = Shape::Prism(Prism { rect, bottom: ground - 1.0, roof: flat(ground + height) });
        let finish = Finish::Plain { colour: rgb(250, 250, 250) };
        let part = Part { class: Class::Building, finish, shape };
        scene.with_objects(vec![Object {
            id: 0,
            kind: Kind::Building,
            only: None,
            parts: vec![part],
        }])
    }

    #[test]
    fn a_shadow_in_the_picture_is_the_height_over_the_tangent() {
        for (height, elevation) in [(6.0, 30.0_f64), (12.0, 55.0), (9.0, 20.0)] {
            let at =
                |azimuth_degrees| Some(SunSpec { azimuth_degrees, elevation_degrees: elevation });
            // The same place lit from the south and from the north: dark in one only is shadow.
            let (south, north) = (lone_box(height, at(180.0)), lone_box(height, at(0.0)));
            let (side, metres) = (320, 80.0);
            let pixels = PixelPositions::square(&south.frame, side, [0.0; 2], metres);
            let pictures = [&south, &north].map(|s| s.render(&pixels, 1));
            let brightness = |p: &[u8], row: usize| f64::from(p[3 * (row * side + side / 2)]);
            let pixel = metres / side as f64;
            // Up from the northern wall, 4 m north of the middle.
            let wall = (side as f64 / 2.0 - 4.0 / pixel) as usize;
            let dark = (0..wall)
                .rev()
                .take_while(|row| {
                    brightness(&pictures[0], *row) < 0.75 * brightness(&pictures[1], *row)
                })
                .count();
            let (sin, cos) = libm::sincos(elevation.to_radians());
            let expected = height * cos / sin / pixel;
            assert!((dark as f64 - expected).abs() <= 1.0, "{dark} {expected}");
        }
    }

    #[test]
    fn a_panorama_looks_north_in_the_middle_and_sees_a_roofs_edge_at_its_angle() {
        let scene = lone_box(12.0, None);
        let width = 720;
        // 21 m south of the middle: the wall is 17 m to the north.
        let at = scene.frame.from_ground([0.0, -21.0]);
        let view = scene.panorama(at, 2.5, width);
        let sky = |column: usize, row: usize| view.sky[row * width + column] == 255;
        let rows = |column: usize| (0..width / 2).take_while(|row| sky(column, *row)).count();
        let scale = (17.0 * scene.frame.scale(), 12.0 - 2.5);
        let angle = libm::atan2(scale.1, scale.0).to_degrees();
        // Half a degree a pixel.
        let expected = (90.0 - angle) * 2.0;
        assert!((rows(width / 2) as f64 - expected).abs() <= 1.0, "{} {expected}", rows(width / 2));
        // The wall ends 5 m to each side: 16.4 degrees from north.
        let half = libm::atan2(5.0, 17.0).to_degrees() * 2.0;
        let open = |column: usize| sky(column, width / 4 - 4);
        let east = (width / 2..width).take_while(|c| !open(*c)).count() as f64;
        let west = (0..width / 2).rev().take_while(|c| !open(*c)).count() as f64;
        assert!((east - half).abs() <= 1.0 && (west - half).abs() <= 1.0, "{east} {west} {half}");
        // Elsewhere the level ground ends at the horizon.
        for column in [0, width / 8, width * 7 / 8] {
            assert!(rows(column).abs_diff(width / 4) <= 1, "{}", rows(column));
        }
    }

    #[test]
    fn the_ground_is_met_where_a_fine_search_meets_it() {
        let mut spec = SceneSpec::default();
        spec.terrain.relief_metres = 30.0;
        spec.terrain.wavelength_metres = 150.0;
        let scene = Scene::new(spec, &Options::default()).expect("a scene");
        let mut met = 0;
        for i in 0..300 {
            let mut draw = crate::random::Draw::new(&[31, i]);
            let (x, y) = (draw.range(-90.0, 90.0), draw.range(-90.0, 90.0));
            let (e, a) = (draw.range(-1.5, 0.2), draw.range(0.0, 6.3));
            let step = [libm::cos(e) * libm::sin(a), libm::cos(e) * libm::cos(a), libm::sin(e)];
            let ray = Ray { from: [x, y, scene.ground(x, y) + 2.5], step };
            let expected = (1..12_000).map(|k| f64::from(k) * 0.01).find(|t| {
                let [x, y, z] = ray.at(*t);
                z < scene.ground(x, y)
            });
            let found = scene.ground_along(&ray).map(|g| g.0);
            if let Some(expected) = expected {
                met += 1;
                // A grazing ray touches a little earlier than it goes under.
                let found = found.expect("the ground");
                assert!(found <= expected + 1e-3, "{found} {expected}");
                let [x, y, z] = ray.at(found);
                assert!((z - scene.ground(x, y)).abs() < 1e-3);
            } else {
                assert!(found.is_none_or(|t| t > 119.0), "{found:?}");
            }
        }
        assert!(met > 150, "{met}");
    }
}
