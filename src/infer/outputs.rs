//! The files of one image, one function per kind.

use super::item::Workshop;
use crate::footprint::Footprint;
use crate::grid::GeoTransform;
use crate::model::Scene;
use crate::model::render::Dsm;
use crate::raster::geotiff::{CogSpec, encode_cog};
use crate::raster::npz::{self, Compression, NpyArray, NpyData};
use crate::units::LinearUnit;
use std::collections::BTreeMap;

/// End of a scene file's name.
pub const SCENE_END: &str = ".scene.safetensors";
/// Entry of a scene file's metadata with the footprint as JSON.
pub const NOTE_FOOTPRINT: &str = "sat3d.footprint";
/// Entry of a scene file's metadata with the hash that names its weights.
pub const NOTE_WEIGHTS: &str = "sat3d.weights_sampled_sha256";

/// Entry of a scene file's metadata with the name of the light that its sky is of.
pub const NOTE_LIGHT: &str = "sat3d.light";

/// Entry of a scene file's metadata with the numbers of samples that it was rendered with.
pub const NOTE_SAMPLES: &str = "sat3d.samples";

/// A file to be written: its path in the output folder, and its content.
pub type NamedBytes = (String, Vec<u8>);

/// The heights of one image, with their scale.
pub struct Heights<'a> {
    pub dsm: &'a Dsm,
    /// Metres per 1.0 of the DSM's heights.
    pub metres_per_unit: f64,
}

impl Heights<'_> {
    /// Heights in metres above the bottom of the cube; NaN where there is no surface.
    pub fn metres(&self) -> Vec<f32> {
        let metres = |height: &f32| (f64::from(*height) * self.metres_per_unit) as f32;
        self.dsm.height.iter().map(metres).collect()
    }
}

impl Workshop<'_> {
    /// `<stem>.npz`: what `sat3d eval` reads.
    pub fn npz(&self, heights: &Heights<'_>, stem: &str) -> Vec<NamedBytes> {
        let dsm = heights.dsm;
        let shape = [dsm.size, dsm.size];
        // Depth is in cube units, two of which are 1.0 of a height.
        let metres = |spread: &f32| (f64::from(*spread) * heights.metres_per_unit / 2.0) as f32;
        let spread: Vec<f32> = dsm.depth_spread.iter().map(metres).collect();
        let scale = [heights.metres_per_unit];
        let arrays = [
            NpyArray { name: "arr_0", shape: &shape, data: NpyData::F32(&dsm.height) },
            NpyArray { name: "metres_per_unit", shape: &[], data: NpyData::F64(&scale) },
            NpyArray { name: "opacity", shape: &shape, data: NpyData::F32(&dsm.opacity) },
            NpyArray { name: "depth_spread", shape: &shape, data: NpyData::F32(&spread) },
        ];
        vec![(format!("{stem}.npz"), npz::encode(&arrays, Compression::Fast))]
    }

    /// `<stem>.tif`: the heights in metres on the image's grid, with the DSM's pixels. What a reader
    /// should know goes into `flags`.
    pub fn geotiff(
        &self,
        heights: &Heights<'_>,
        footprint: &Footprint,
        stem: &str,
        flags: &mut Vec<String>,
    ) -> Vec<NamedBytes> {
        let size = heights.dsm.size as u32;
        let (geotransform, epsg) = match footprint.dsm_grid(size) {
            Some(grid) => {
                if grid.crs.epsg.is_none() {
                    flags.push(format!(
                        "the CRS of the image ({}) has no EPSG code: its GeoTIFF has the image's coordinates and no CRS",
                        grid.crs.name
                    ));
                }
                (grid.geotransform, grid.crs.epsg.unwrap_or(0))
            }
            None => {
                flags.push(
                    "the image's place is not known: its GeoTIFF has no CRS, and metres from the north-west corner"
                        .into(),
                );
                let [across, down] = footprint.ground_m().map(|metres| metres / f64::from(size));
                (GeoTransform::north_up(0.0, 0.0, across, down), 0)
            }
        };
        let metadata = [
            ("TIFFTAG_SOFTWARE", format!("sat3d {}", env!("CARGO_PKG_VERSION"))),
            (
                "VERTICAL_DATUM",
                "none: heights are above the bottom of the scene, an arbitrary zero".into(),
            ),
            ("METRES_PER_UNIT", heights.metres_per_unit.to_string()),
        ];
        let spec = CogSpec {
            width: size,
            height: size,
            geotransform,
            epsg,
            vertical_epsg: None,
            unit: Some(LinearUnit::Metre),
            metadata: metadata.map(|(key, value)| (key.to_owned(), value)).to_vec(),
        };
        vec![(format!("{stem}.tif"), encode_cog(&heights.metres(), &spec))]
    }

    /// `<stem>.scene.safetensors`: the scene, with the footprint and the weights' hash in its metadata.
    pub fn scene(
        &self,
        scene: &Scene,
        footprint: &Footprint,
        stem: &str,
        light: Option<&str>,
    ) -> Result<Vec<NamedBytes>, String> {
        let mut notes = BTreeMap::new();
        let json = serde_json::to_string(footprint).map_err(|error| error.to_string())?;
        notes.insert(NOTE_FOOTPRINT.to_owned(), json);
        if let Some(identity) = self.identity {
            notes.insert(NOTE_WEIGHTS.to_owned(), identity.sampled_sha256.clone());
        }
        let samples = self.options.render.samples;
        notes.insert(NOTE_SAMPLES.to_owned(), format!("{},{}", samples.coarse(), samples.fine()));
        if let Some(light) = light.filter(|_| scene.parts().sky.is_some()) {
            notes.insert(NOTE_LIGHT.to_owned(), light.to_owned());
        }
        let bytes = scene.to_bytes(&notes).map_err(|error| error.to_string())?;
        Ok(vec![(format!("{stem}{SCENE_END}"), bytes)])
    }
}
