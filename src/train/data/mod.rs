//! Examples: where they come from, and in what order.
//!
//! A [`Source`] makes the example of a draw, which is a number that counts from 0 over the whole training; the
//! [`Loader`] makes them ahead of time on threads of its own, and hands them out in order.

mod augment;
mod image_file;
mod loader;
mod order;
mod scenes;
mod simulated;
mod vigor;
mod vigor_list;

pub use image_file::pillow_grey;
pub use loader::{Batch, Loader};
pub use order::Order;
pub use simulated::Simulated;
pub use vigor::Vigor;

use super::error::TrainingError;
use super::settings::{DataSource, ObjectiveKind, Settings};
use crate::model::train::Example;
use serde_json::Value;
use std::path::PathBuf;
use std::sync::Arc;

/// Why an item of the data makes no example. The training goes on without it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SkipReason {
    /// There is no such file.
    #[error("the {what} is missing: {}", path.display())]
    Missing {
        /// Satellite image, panorama or sky mask.
        what: &'static str,
        /// Where it was looked for.
        path: PathBuf,
    },
    /// The file does not decode.
    #[error("the {what} cannot be read: {}: {cause}", path.display())]
    Unreadable {
        /// Satellite image, panorama, sky mask or depth label.
        what: &'static str,
        /// The file.
        path: PathBuf,
        /// What the decoder says.
        cause: String,
    },
    /// The file decodes, and is not of the size that belongs to the others.
    #[error("the {what} is {found} pixels, not {expected}: {}", path.display())]
    Size {
        /// Panorama, sky mask.
        what: &'static str,
        /// The file.
        path: PathBuf,
        /// Its size.
        found: String,
        /// The size it should have.
        expected: String,
    },
    /// A simulated scene cannot be laid out.
    #[error("scene {index} cannot be made: {cause}")]
    Scene {
        /// Its index.
        index: u64,
        /// Why.
        cause: String,
    },
    /// The camera stands outside the satellite image.
    #[error("the camera stands outside the image, at {x}, {y} of half its side")]
    Outside {
        /// Right of the centre.
        x: String,
        /// Down of the centre.
        y: String,
    },
}

impl SkipReason {
    /// What is counted: the kind of problem, without what differs from item to item.
    #[must_use]
    pub fn kind(&self) -> String {
        match self {
            Self::Missing { what, .. } => format!("{what} missing"),
            Self::Unreadable { what, .. } => format!("{what} unreadable"),
            Self::Size { what, .. } => format!("{what} of another size"),
            Self::Scene { .. } => "scene cannot be made".to_owned(),
            Self::Outside { .. } => "camera outside the image".to_owned(),
        }
    }
}

/// An item that makes no example.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Skip {
    /// Name of the item.
    pub item: String,
    /// Why.
    pub reason: SkipReason,
}

/// Makes examples. The example of a draw depends on the source's settings, the draw and the attempt alone.
pub trait Source: Send + Sync {
    /// Items there are: as many attempts of one draw are all different.
    fn len(&self) -> usize;

    /// Whether there is nothing.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The example of a draw. Where its item is no good, the next attempt takes another one.
    ///
    /// # Errors
    /// The item, and why it makes no example.
    fn example(&self, draw: u64, attempt: usize) -> Result<Example, Skip>;

    /// Examples that the training never draws, for the log; fewer where they are no good.
    fn held_out(&self, count: usize) -> Vec<Example>;

    /// What the examples depend on: a training goes on only with the same.
    fn identity(&self) -> Value;

    /// For people: what there is, in a few words.
    fn describe(&self) -> String;
}

/// Opens the data that the settings name.
///
/// # Errors
/// [`TrainingError`] where there is nothing.
pub fn open(settings: &Settings) -> Result<Arc<dyn Source>, TrainingError> {
    let seed = settings.run.seed;
    match (settings.data.source, &settings.data.vigor) {
        (DataSource::Vigor, Some(vigor)) => Ok(Arc::new(Vigor::open(vigor, seed)?)),
        _ => {
            let street = settings.objective.kind == ObjectiveKind::Paper;
            Ok(Arc::new(Simulated::new(&settings.data.simulated, seed, street)))
        }
    }
}
