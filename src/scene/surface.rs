//! A scene: a pure function of position. Everything that is written is a sample of it.

use super::camera::Camera;
use super::effects::{Effect, Effects, Options, reach, resolve};
use super::epoch;
use super::error::SceneError;
use super::frame::Frame;
use super::ground::GroundPaint;
use super::layout::{self, Layout};
use super::object::{Class, Epoch};
use super::shape::Bounds;
use super::solid::Face;
use super::spec::SceneSpec;
use super::streets::Streets;
use super::terrain::{Ground, Terrain};
use super::world::{SunRay, World};
use crate::grid::{LonLat, WGS84_A};
use crate::plan::Plan;
use std::sync::Arc;

/// The surface at a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surface {
    /// Height (NAVD88), metres.
    pub height: f64,
    /// Index of the solid on top (in [`World::solids`]) and its face; the ground when `None`.
    pub solid: Option<(u32, Face)>,
    /// The ground below.
    pub ground: Ground,
}

/// A scene with exact truth. Coordinates are metres in the local [`Frame`].
#[derive(Clone, Debug)]
pub struct Scene {
    /// What the scene file says.
    pub spec: SceneSpec,
    /// The local frame.
    pub frame: Frame,
    /// The bare earth.
    pub terrain: Terrain,
    /// The street grid.
    pub streets: Streets,
    /// All objects of both epochs.
    pub layout: Layout,
    /// The plan that was resolved.
    pub plan: Plan,
    pub(super) effects: Effects,
    pub(super) paint: GroundPaint,
    pub(super) sun: Option<SunRay>,
    pub(super) lean: [f64; 2],
    pub(super) camera: Camera,
    /// A bound on the slope of the ground, rise per metre.
    pub(super) steepest: f64,
    worlds: [Arc<World>; 2],
}

impl Scene {
    /// Lays out a scene. Everything that follows from the scene file is decided here.
    ///
    /// # Errors
    /// [`SceneError::Crs`] where the place cannot be projected.
    pub fn new(spec: SceneSpec, options: &Options) -> Result<Self, SceneError> {
        let place =
            LonLat { lon_deg: spec.place.longitude_degrees, lat_deg: spec.place.latitude_degrees };
        let frame = Frame::new(place, spec.tiles.pixel_feet, true)?;
        let terrain = Terrain::new(&spec);
        let (effects, plan) = resolve(&spec, options, &frame, &terrain)?;
        let frame = if effects.runs(Effect::Datum) {
            frame
        } else {
            Frame::new(place, spec.tiles.pixel_feet, false)?
        };
        let (hw, hh) = (spec.extent.width_metres / 2.0, spec.extent.height_metres / 2.0);
        let area = Bounds { west: -hw, south: -hh, east: hw, north: hh }.grown(super::MARGIN_M);
        let streets = Streets::new(&spec.streets, spec.seed, reach(&spec));
        let change = epoch::Change::new(&spec, &effects);
        let layout = layout::lay_out(&spec, &terrain, &streets, area, change.moves_cars());
        // Crowns and roofs may reach past the area in which things are placed.
        let indexed = area.grown(30.0);
        let make = |which| {
            let objects = layout.objects.iter().filter_map(|o| change.at(which, o));
            Arc::new(World::new(objects, indexed))
        };
        let image = make(Epoch::Image);
        let apart = change.happens() || layout.objects.iter().any(|o| o.only.is_some());
        let lidar = if apart { make(Epoch::Lidar) } else { Arc::clone(&image) };
        let paint = GroundPaint::new(&layout, indexed, spec.images.season, spec.seed);
        let (sun, lean) = (sun_ray(&spec, &frame, &effects), view_lean(&spec, &frame, &effects));
        let camera = Camera::new(spec.camera.as_ref());
        let steepest = terrain.steepest(reach(&spec));
        Ok(Self {
            spec,
            frame,
            terrain,
            streets,
            layout,
            plan,
            effects,
            paint,
            sun,
            lean,
            camera,
            steepest,
            worlds: [lidar, image],
        })
    }

    /// The same scene with other solids, at both epochs.
    #[cfg(test)]
    pub(super) fn with_objects(mut self, objects: Vec<super::object::Object>) -> Self {
        let reach = reach(&self.spec);
        let world = Arc::new(World::new(objects, Bounds::around(0.0, 0.0, reach)));
        self.worlds = [Arc::clone(&world), world];
        self
    }

    /// The solids of an epoch.
    #[must_use]
    pub fn world(&self, epoch: Epoch) -> &World {
        match epoch {
            Epoch::Lidar => &self.worlds[0],
            Epoch::Image => &self.worlds[1],
        }
    }

    /// Light of the sun as the plan has it; `None` under an overcast sky.
    #[must_use]
    pub const fn sun(&self) -> Option<SunRay> {
        self.sun
    }

    /// Horizontal way towards the satellite per metre of height (local frame), as the plan has it.
    #[must_use]
    pub const fn lean(&self) -> [f64; 2] {
        self.lean
    }

    /// Whether lidar and images see different scenes.
    #[must_use]
    pub fn changes(&self) -> bool {
        !Arc::ptr_eq(&self.worlds[0], &self.worlds[1])
    }

    /// The surface at a point: the highest solid, or the ground.
    #[must_use]
    pub fn surface(&self, epoch: Epoch, x: f64, y: f64) -> Surface {
        let ground = self.terrain.at(x, y);
        match self.world(epoch).top(x, y, |_| true) {
            // A solid that a slope has buried is not on top.
            Some((index, z, face)) if z > ground.z => {
                Surface { height: z, solid: Some((index, face)), ground }
            }
            _ => Surface { height: ground.z, solid: None, ground },
        }
    }

    /// Height of the bare earth (of the water over water), metres.
    #[must_use]
    pub fn ground(&self, x: f64, y: f64) -> f64 {
        self.terrain.height(x, y)
    }

    /// What a point of the surface belongs to.
    #[must_use]
    pub fn class(&self, epoch: Epoch, x: f64, y: f64) -> Class {
        let surface = self.surface(epoch, x, y);
        match surface.solid {
            Some((index, _)) => self.world(epoch).solids[index as usize].class,
            None if surface.ground.water => Class::Water,
            None if self.is_street(x, y) => Class::Street,
            None => Class::Ground,
        }
    }

    /// Whether a point lies on a carriageway, kerb or pavement.
    #[must_use]
    pub fn is_street(&self, x: f64, y: f64) -> bool {
        self.terrain.inland(x, y) > layout::SHORE_STRIP_M
            && self.streets.locate(x, y).kerb < super::streets::SIDE_WIDTH_M
    }
}

/// The unit vector in the grid of a direction given clockwise from true north.
fn grid_direction(azimuth_degrees: f64, frame: &Frame, effects: &Effects) -> [f64; 2] {
    let turn = if effects.runs(Effect::Convergence) { frame.convergence() } else { 0.0 };
    let (sin, cos) = libm::sincos(azimuth_degrees.to_radians() + turn);
    [sin, cos]
}

fn grid_scale(frame: &Frame, effects: &Effects) -> f64 {
    if effects.runs(Effect::GridScale) { frame.scale() } else { 1.0 }
}

fn sun_ray(spec: &SceneSpec, frame: &Frame, effects: &Effects) -> Option<SunRay> {
    let sun = spec.sun?;
    let [east, north] = grid_direction(sun.azimuth_degrees, frame, effects);
    let (up, level) = if sun.elevation_degrees >= 90.0 {
        (1.0, 0.0)
    } else {
        libm::sincos(sun.elevation_degrees.to_radians())
    };
    let level_grid = level * grid_scale(frame, effects);
    let curvature =
        if effects.runs(Effect::Curvature) { level * level / (2.0 * WGS84_A) } else { 0.0 };
    Some(SunRay { step: [east * level_grid, north * level_grid, up], curvature })
}

fn view_lean(spec: &SceneSpec, frame: &Frame, effects: &Effects) -> [f64; 2] {
    let Some(view) = spec.view.filter(|_| effects.runs(Effect::Relief)) else { return [0.0, 0.0] };
    let tan = libm::tan(view.off_nadir_degrees.to_radians()) * grid_scale(frame, effects);
    grid_direction(view.azimuth_degrees, frame, effects).map(|d| d * tan)
}
