//! What joining parts and making outputs needs to know: stored in the journals' header.

use super::TileError;
use super::city::City;
use super::layout::{AxisWindows, WindowOptions};
use super::options::TileOutputs;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

/// A run without the picture and the network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Job {
    /// The lattice.
    pub city: City,
    /// What is written.
    pub outputs: TileOutputs,
    /// Windows and weights.
    pub windows: WindowOptions,
    /// Ground metres and metres of height per cube unit, along x, y and z.
    pub metres_per_unit: [f64; 3],
    /// Density of the surface.
    pub isovalue: f32,
    /// Hash that tells the weights from others.
    pub weights_sampled_sha256: String,
}

impl Job {
    /// The job of a run's description.
    ///
    /// # Errors
    /// The folder holds something else.
    pub fn of(description: &Value) -> Result<Self, TileError> {
        serde_json::from_value(description["job"].clone()).map_err(|error| {
            TileError::Input(format!(
                "the journals there do not describe a city of this program: {error}"
            ))
        })
    }

    /// As it is stored.
    #[must_use]
    pub fn value(&self) -> Value {
        json!(self)
    }

    /// Windows along x and along y.
    ///
    /// # Errors
    /// [`super::layout::LayoutError`].
    pub fn axis_windows(&self) -> Result<[AxisWindows; 2], TileError> {
        let [columns, rows] = self.city.size;
        if self.windows.trim > 0 {
            crate::plan::runs("trim");
        }
        Ok([AxisWindows::new(columns, &self.windows)?, AxisWindows::new(rows, &self.windows)?])
    }
}
