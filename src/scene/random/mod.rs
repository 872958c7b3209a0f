//! Scenes drawn at random, for training and for tests of what was trained: each is a pure function
//! of a seed and an index, and its heights are exact.
//!
//! * [`RandomScenes`]: kinds of place, and the [`SceneSpec`] of each scene (`draw.rs`).
//! * [`Sample`]: a square picture with its heights and classes; [`Street`]: a panorama in it.

mod draw;
mod files;
mod sample;
mod street;

pub use files::{Drawn, PANORAMA_WIDTH, RandomSummary, RandomSurvey};
pub use sample::{Crop, Sample};
pub use street::{Street, draw_position};

use super::error::SceneError;
use super::spec::SceneSpec;
use super::surface::Scene;
use crate::random::{Draw, key};
use serde::{Deserialize, Serialize};
use std::fmt;

/// Purposes of random numbers here: the third part of every key, after the seed and the index.
mod purpose {
    pub const KIND: u64 = 1;
    pub const SCENE: u64 = 2;
    pub const PLACE: u64 = 3;
    pub const STREET: u64 = 4;
    pub const SENSOR: u64 = 5;
}

/// What kind of place a scene shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Kind {
    /// Family houses with gardens.
    Suburb,
    /// Blocks of flats, offices, towers.
    Downtown,
    /// Sheds, tanks, containers.
    Industry,
    /// Large flat-roofed shops and their car parks.
    CarPark,
    /// Closed forest.
    Forest,
    /// A shore with docks.
    Waterfront,
    /// Lawns, paths, scattered trees.
    Park,
    /// Several uses side by side.
    Mixed,
}

impl Kind {
    /// All kinds, in the order of their declaration.
    pub const ALL: [Self; 8] = [
        Self::Suburb,
        Self::Downtown,
        Self::Industry,
        Self::CarPark,
        Self::Forest,
        Self::Waterfront,
        Self::Park,
        Self::Mixed,
    ];

    /// Share of the scenes that are of this kind, per cent.
    const fn share(self) -> u64 {
        match self {
            Self::Suburb => 30,
            Self::Downtown => 14,
            Self::Industry => 11,
            Self::CarPark => 11,
            Self::Forest => 8,
            Self::Waterfront => 7,
            Self::Park => 5,
            Self::Mixed => 14,
        }
    }

    /// The name in files.
    #[must_use]
    pub const fn id(self) -> &'static str {
        match self {
            Self::Suburb => "suburb",
            Self::Downtown => "downtown",
            Self::Industry => "industry",
            Self::CarPark => "car-park",
            Self::Forest => "forest",
            Self::Waterfront => "waterfront",
            Self::Park => "park",
            Self::Mixed => "mixed",
        }
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.id())
    }
}

/// Scenes drawn at random: every one is a pure function of `(seed, index)`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RandomScenes {
    /// Another seed gives other scenes.
    pub seed: u64,
}

impl RandomScenes {
    /// The kind of a scene.
    #[must_use]
    pub fn kind(&self, index: u64) -> Kind {
        let mut lot = key(&[self.seed, index, purpose::KIND]) % 100;
        for kind in Kind::ALL {
            if lot < kind.share() {
                return kind;
            }
            lot -= kind.share();
        }
        Kind::Mixed
    }

    /// What a scene is like, with room for a square of 64 m in any position about its centre; see
    /// [`Self::spec_for`].
    #[must_use]
    pub fn spec(&self, index: u64) -> SceneSpec {
        self.spec_for(index, 64.0)
    }

    /// What a scene is like, just large enough for a square of `metres` about its centre. Another size may
    /// move the shore and the middle of the dense uses.
    #[must_use]
    pub fn spec_for(&self, index: u64, metres: f64) -> SceneSpec {
        draw::spec(self, index, metres)
    }

    /// A scene, just large enough for a square of `metres` about its centre.
    ///
    /// # Errors
    /// [`SceneError`] if the scene cannot be laid out.
    pub fn scene(&self, index: u64, metres: f64) -> Result<Scene, SceneError> {
        Scene::new(self.spec_for(index, metres), &super::Options::default())
    }

    /// One training sample: a square of `side` pixels and `metres` ground metres about the scene's
    /// centre, true north up.
    ///
    /// # Errors
    /// [`SceneError`] if the scene cannot be laid out.
    pub fn sample(&self, index: u64, side: usize, metres: f64) -> Result<Sample, SceneError> {
        let scene = self.scene(index, metres)?;
        Ok(Sample::new(&scene, self.kind(index), side, &Crop::centred(metres)))
    }

    /// A panorama of `width` columns in the same square as [`Self::sample`] shows, at a position (down and right
    /// of its middle, -1 to 1) or, without one, at a drawn place: on a street if one passes through the square,
    /// else on open ground; `None` where there is neither.
    ///
    /// # Errors
    /// [`SceneError`] if the scene cannot be laid out.
    pub fn street(
        &self,
        index: u64,
        metres: f64,
        position: Option<[f64; 2]>,
        width: usize,
    ) -> Result<Option<Street>, SceneError> {
        let scene = self.scene(index, metres)?;
        let crop = Crop::centred(metres);
        Ok(match position {
            Some(position) => Some(Street::at(&scene, &crop, position, width)),
            None => {
                let draw = &mut Draw::new(&[self.seed, index, purpose::STREET]);
                Street::drawn(&scene, &crop, draw, width)
            }
        })
    }
}

#[cfg(test)]
mod tests;
