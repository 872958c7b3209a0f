//! What stands in a scene: objects, their parts, how those look, and paint on the ground.

use super::shape::Rect;
use super::solid::Shape;
use serde::Serialize;

/// A linear-light colour: red, green, blue, 0 to 1.
pub type Colour = [f32; 3];

/// A colour from 8-bit display values. Pictures are encoded with a gamma of 2, whose inverse is
/// a square: exact on every machine.
#[must_use]
pub const fn rgb(r: u8, g: u8, b: u8) -> Colour {
    const fn linear(v: u8) -> f32 {
        let v = v as f32 / 255.0;
        v * v
    }
    [linear(r), linear(g), linear(b)]
}

/// What a point of the scene belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Class {
    /// Open ground that is no street.
    Ground,
    /// Carriageway or pavement.
    Street,
    /// Water.
    Water,
    /// Building.
    Building,
    /// Crown or trunk of a tree, shrub or hedge.
    Tree,
    /// Car.
    Car,
    /// Poles, docks, boats, containers, tanks.
    Structure,
}

/// Covering of a roof.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Covering {
    /// Asphalt shingles in courses.
    Shingle,
    /// Clay tiles.
    Tile,
    /// Standing seams down the slope.
    Metal,
    /// Sheets of membrane, with stains.
    Membrane,
    /// Gravel.
    Gravel,
}

/// How a part looks.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Finish {
    /// A roof over walls.
    Roof {
        /// What the roof is made of.
        covering: Covering,
        /// Colour of the roof.
        colour: Colour,
        /// Colour of the walls.
        wall: Colour,
        /// Height of a storey with windows, metres; 0 for blank walls.
        storey: f32,
        /// Seed of its texture.
        seed: u32,
    },
    /// Leaves or needles.
    Foliage {
        /// Colour of the crown.
        colour: Colour,
        /// Seed of its texture.
        seed: u32,
    },
    /// The lower half of a car, with bonnet and boot.
    CarBody {
        /// Paint.
        colour: Colour,
    },
    /// The upper half of a car: roof, windscreens.
    CarCabin {
        /// Paint.
        colour: Colour,
    },
    /// Planks along v.
    Planks {
        /// Colour of the wood.
        colour: Colour,
        /// Seed of its texture.
        seed: u32,
    },
    /// A machine on a roof, with a round fan.
    Machine {
        /// Colour of the housing.
        colour: Colour,
    },
    /// A pane.
    Glass {
        /// Tint.
        colour: Colour,
    },
    /// Corrugated steel: shipping containers.
    Corrugated {
        /// Paint.
        colour: Colour,
    },
    /// Nothing special.
    Plain {
        /// Colour.
        colour: Colour,
    },
}

/// One solid of an object.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Part {
    /// What it belongs to.
    pub class: Class,
    /// How it looks.
    pub finish: Finish,
    /// Its geometry.
    pub shape: Shape,
}

/// Kind of an object: what change and season do to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// Anything that is built and torn down as a whole.
    Building,
    /// A tree that sheds its leaves.
    Broadleaf,
    /// An evergreen tree.
    Conifer,
    /// A hedge or shrub: evergreen, does not grow.
    Shrub,
    /// A car.
    Car,
    /// A pole, dock, boat, container or tank.
    Structure,
}

/// The two moments of a scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Epoch {
    /// When the lidar was flown.
    Lidar,
    /// When the images were taken.
    Image,
}

/// An object: one house, one tree, one car.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Object {
    /// Number, the same at both epochs.
    pub id: u32,
    /// Its kind.
    pub kind: Kind,
    /// The only epoch at which it can exist; any when `None`.
    pub only: Option<Epoch>,
    /// Its solids.
    pub parts: Vec<Part>,
}

/// What the ground is covered with where nothing stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Cover {
    /// Lawn, more or less dry.
    Lawn,
    /// Rough meadow with bare places.
    Meadow,
    /// Forest floor.
    Litter,
    /// Asphalt of a yard or lot.
    Asphalt,
    /// Concrete slabs.
    Concrete,
    /// Paving stones.
    Paving,
    /// Gravel.
    Gravel,
    /// Bare soil.
    Soil,
    /// Bark mulch of a flower bed.
    Mulch,
    /// Sand.
    Sand,
    /// A swimming pool.
    Pool,
    /// Parking places side by side along u, each 2.6 m wide, lines along v.
    Stalls,
    /// A tennis court with its lines.
    TennisCourt,
    /// A football pitch with its lines.
    Pitch,
    /// A railway track along u: rails on sleepers.
    Track,
}

/// A painted rectangle on the ground. Later patches lie over earlier ones.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Patch {
    /// Where.
    pub rect: Rect,
    /// What.
    pub cover: Cover,
    /// Seed of its texture.
    pub seed: u32,
}
