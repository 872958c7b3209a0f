//! Two epochs of one plan: what change and season make of an object at the time of the lidar and
//! at the time of the images.
//!
//! The plan is the scene at the lidar's time, plus the buildings that are new and without those torn
//! down, felled or moved by the time of the images.

use super::effects::{Effect, Effects};
use super::object::{Epoch, Kind, Object};
use super::purpose;
use super::solid::{Crown, Shape};
use super::spec::{SceneSpec, Season};
use crate::random::{key, unit};

/// Share of a bare crown that lets pulses and light pass.
const BARE_POROSITY: f32 = 0.62;

/// What happens between the epochs.
#[derive(Clone, Debug)]
pub struct Change {
    seed: u64,
    built: f64,
    demolished: f64,
    felled: f64,
    growth_m: f64,
    cars: bool,
    seasons: [Season; 2],
}

impl Change {
    /// What a scene asks for, of the effects that are on.
    #[must_use]
    pub fn new(spec: &SceneSpec, effects: &Effects) -> Self {
        let years = spec.years_apart();
        let change = spec.change.filter(|_| effects.runs(Effect::Change) && years > 0.0);
        let share = |rate: f64| (rate * years).min(1.0);
        let images = spec.images.season;
        let lidar = if effects.runs(Effect::Season) { spec.lidar.season } else { images };
        Self {
            seed: spec.seed,
            built: change.map_or(0.0, |c| share(c.built_share_per_year)),
            demolished: change.map_or(0.0, |c| share(c.demolished_share_per_year)),
            felled: change.map_or(0.0, |c| share(c.felled_share_per_year)),
            growth_m: change.map_or(0.0, |c| c.growth_metres_per_year * years),
            cars: change.is_some_and(|c| c.cars_move),
            seasons: [lidar, images],
        }
    }

    /// Whether each epoch has cars of its own.
    #[must_use]
    pub const fn moves_cars(&self) -> bool {
        self.cars
    }

    /// Whether the epochs can differ at all.
    #[must_use]
    pub fn happens(&self) -> bool {
        self.built + self.demolished + self.felled + self.growth_m > 0.0
            || self.cars
            || (self.seasons[0] == Season::Winter) != (self.seasons[1] == Season::Winter)
    }

    /// The object at an epoch, or `None` if it is not there.
    #[must_use]
    pub fn at(&self, epoch: Epoch, object: &Object) -> Option<Object> {
        if object.only.is_some_and(|only| only != epoch) || !self.stands(epoch, object) {
            return None;
        }
        let mut object = object.clone();
        if matches!(object.kind, Kind::Broadleaf | Kind::Conifer) {
            let season = self.seasons[usize::from(epoch == Epoch::Image)];
            let bare = object.kind == Kind::Broadleaf && season == Season::Winter;
            for part in &mut object.parts {
                if epoch == Epoch::Image && self.growth_m > 0.0 {
                    grow(&mut part.shape, self.growth_m);
                }
                if let Shape::Crown(crown) = &mut part.shape {
                    crown.porosity = if bare { BARE_POROSITY } else { 0.0 };
                }
            }
        }
        Some(object)
    }

    fn stands(&self, epoch: Epoch, object: &Object) -> bool {
        let lot = |what: u64| unit(key(&[self.seed, purpose::CHANGE, what, u64::from(object.id)]));
        match (object.kind, epoch) {
            (Kind::Building, Epoch::Lidar) => lot(0) >= self.built,
            (Kind::Building, Epoch::Image) => lot(0) < self.built || lot(1) >= self.demolished,
            (Kind::Broadleaf | Kind::Conifer | Kind::Shrub, Epoch::Image) => lot(2) >= self.felled,
            _ => true,
        }
    }
}

/// Makes a tree higher: the crown grows in proportion about the tree's foot.
fn grow(shape: &mut Shape, by: f64) {
    match shape {
        Shape::Crown(crown) => {
            // The crown keeps its lowest branches and stretches from there.
            let factor = (crown.top + by - crown.bottom) / (crown.top - crown.bottom);
            let Crown { x, y, bottom, .. } = *crown;
            for puff in &mut crown.puffs {
                puff.center = [
                    x + (puff.center[0] - x) * factor,
                    y + (puff.center[1] - y) * factor,
                    bottom + (puff.center[2] - bottom) * factor,
                ];
                puff.radius *= factor;
                puff.half_height *= factor;
            }
            crown.radius *= factor;
            crown.top += by;
        }
        Shape::Cylinder(trunk) => trunk.radius *= 1.0 + 0.02 * by,
        Shape::Prism(_) => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::solid::Puff;

    #[test]
    fn a_tree_grows_by_what_the_years_say() {
        let puff = |z, radius| Puff { center: [3.0, 4.0, z], radius, half_height: 2.0 };
        let mut crown = Shape::Crown(Crown {
            x: 3.0,
            y: 4.0,
            radius: 2.5,
            bottom: 8.0,
            top: 14.0,
            puffs: vec![puff(10.0, 2.5), puff(12.0, 1.0)],
            porosity: 0.0,
            pattern: 1,
        });
        grow(&mut crown, 1.5);
        assert!((crown.highest() - 15.5).abs() < 1e-12);
        assert!((crown.top(3.0, 4.0).expect("over the axis").0 - 15.5).abs() < 1e-12);
        let Shape::Crown(c) = &crown else { panic!("a crown") };
        assert!((c.radius - 2.5 * 1.25).abs() < 1e-12);
    }

    #[test]
    fn shares_are_what_the_rates_say() {
        let change = Change {
            seed: 3,
            built: 0.2,
            demolished: 0.3,
            felled: 0.1,
            growth_m: 0.0,
            cars: false,
            seasons: [Season::Summer; 2],
        };
        let object = |id, kind| Object { id, kind, only: None, parts: Vec::new() };
        let share = |kind, epoch| {
            (0..5000).filter(|id| change.stands(epoch, &object(*id, kind))).count() as f64 / 5000.0
        };
        assert!((share(Kind::Building, Epoch::Lidar) - 0.8).abs() < 0.02);
        assert!((share(Kind::Building, Epoch::Image) - (0.2 + 0.8 * 0.7)).abs() < 0.02);
        assert!((share(Kind::Conifer, Epoch::Image) - 0.9).abs() < 0.02);
        assert_eq!(share(Kind::Conifer, Epoch::Lidar), 1.0);
        assert_eq!(share(Kind::Structure, Epoch::Image), 1.0);
    }
}
