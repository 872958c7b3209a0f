//! Shadows that hills cast; those of objects are in [`super::world`].

use super::surface::Scene;
use super::world::SunRay;

/// Step of the march along a ray, metres on the ground. Hills are smooth over this distance.
const STEP_M: f64 = 2.0;

impl Scene {
    /// Whether the ground itself stands between a point and the sun.
    #[must_use]
    pub fn terrain_shadowed(&self, from: [f64; 3], sun: &SunRay) -> bool {
        let [dx, dy, dz] = sun.step;
        let level = libm::hypot(dx, dy);
        if level <= 0.0 {
            return false;
        }
        let reach = super::effects::reach(&self.spec);
        let step = STEP_M / level;
        let end = 2.0 * reach / level;
        let clearance = |t: f64| {
            let (x, y) = (from[0] + t * dx, from[1] + t * dy);
            let ray = from[2] + t * dz + sun.curvature * t * t;
            (ray - self.terrain.height(x, y), ray)
        };
        let mut t = 0.25 * step;
        let mut last = t;
        let mut least = f64::INFINITY;
        while t < end {
            let (room, ray) = clearance(t);
            if room < 0.0 {
                return true;
            }
            if ray > self.highest_ground() {
                return false;
            }
            // The ray came closest between two steps: look there too.
            if room < least {
                least = room;
                last = t;
            } else if least < STEP_M && t - last <= 1.5 * step {
                let (mut low, mut high) = ((last - step).max(0.1 * step), t);
                for _ in 0..16 {
                    let third = (high - low) / 3.0;
                    let (a, b) = (clearance(low + third).0, clearance(high - third).0);
                    if a.min(b) < 0.0 {
                        return true;
                    }
                    if a < b { high -= third } else { low += third }
                }
            }
            t += step;
        }
        false
    }

    /// No ground is higher, metres.
    fn highest_ground(&self) -> f64 {
        let t = &self.spec.terrain;
        t.base_height_metres
            + t.relief_metres / 2.0
            + t.slope_percent / 100.0 * 3.0 * super::effects::reach(&self.spec)
    }
}

#[cfg(test)]
mod tests {
    use crate::scene::effects::Options;
    use crate::scene::spec::{SceneSpec, SunSpec};
    use crate::scene::surface::Scene;

    #[test]
    fn a_hill_shades_what_a_fine_search_says_it_does() {
        let mut spec = SceneSpec::default();
        spec.terrain.relief_metres = 40.0;
        spec.terrain.wavelength_metres = 140.0;
        spec.sun = Some(SunSpec { azimuth_degrees: 250.0, elevation_degrees: 9.0 });
        let scene = Scene::new(spec, &Options::default()).expect("a scene");
        let sun = scene.sun.expect("a sun");
        let (mut dark, mut wrong) = (0, 0);
        for i in 0..400 {
            let x = f64::from(i % 20) * 13.0 - 130.0;
            let y = f64::from(i / 20) * 13.0 - 130.0;
            let from = [x, y, scene.ground(x, y)];
            let expected = (1..40_000).any(|k| {
                let t = f64::from(k) * 0.02;
                let z = from[2] + t * sun.step[2];
                z < scene.ground(x + t * sun.step[0], y + t * sun.step[1]) - 1e-9
            });
            dark += usize::from(expected);
            wrong += usize::from(scene.terrain_shadowed(from, &sun) != expected);
        }
        assert!(dark > 40, "{dark}");
        assert!(wrong <= 2, "{wrong} of {dark}");
    }
}
