//! The scene file: safetensors, so that Python opens it with `safetensors.numpy.load_file`.
//!
//! Tensors, all little-endian `float32`: `map` (channels, rows, columns), `head.net0.weight`,
//! `head.net0.bias`, likewise `net1_density`, `net1_feature`, `style_squ` and `grd_color_convert` (as in the
//! checkpoint, outputs x inputs), and with a sky `sky.style` (codes) and `sky.map` (channels, rows, columns).
//! The file's `__metadata__` holds `format` = `sat3d-scene`, `version` = `1`, `representation` (`oneplane`,
//! `oneplane_multi`, `triplane`), `activation` (`mipnerf`, `relu`), `scale` and `metres_per_unit`, and
//! after them whatever notes its writer had.

use super::{Scene, SceneError, SceneParts, SkyParts};
use crate::field::{DensityActivation, FieldInputs, Linear, PointHead, Representation};
use crate::tensor::Grid;
use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};
use std::collections::{BTreeMap, HashMap};
use std::io::Write;
use std::path::{Path, PathBuf};

const FORMAT: &str = "sat3d-scene";
const VERSION: &str = "1";
const LAYERS: [&str; 5] =
    ["net0", "net1_density", "net1_feature", "style_squ", "grd_color_convert"];

/// Why a scene file could not be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SceneFileError {
    /// Reading or writing failed.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is not safetensors, or is cut off.
    #[error("{path}: {source}")]
    Safetensors {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: safetensors::SafeTensorError,
    },
    /// It is safetensors, but no scene.
    #[error("{path}: {what}")]
    Content {
        /// The file.
        path: PathBuf,
        /// What is missing or unexpected.
        what: String,
    },
    /// The parts do not make a scene.
    #[error("{path}: {source}")]
    Scene {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: SceneError,
    },
}

impl Scene {
    /// Writes the scene to one file, which appears whole or not at all.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn save(&self, path: &Path) -> Result<(), SceneFileError> {
        let bytes = self
            .to_bytes(&BTreeMap::new())
            .map_err(|source| SceneFileError::Safetensors { path: path.into(), source })?;
        write_whole(path, &bytes).map_err(|source| SceneFileError::Io { path: path.into(), source })
    }

    /// The content of the scene's file. `notes` become entries of its metadata: what the caller wants
    /// to find again beside the scene, such as its place on Earth. An entry of the scene's own wins.
    ///
    /// # Errors
    /// When a tensor's shape and values disagree.
    pub fn to_bytes(
        &self,
        notes: &BTreeMap<String, String>,
    ) -> Result<Vec<u8>, safetensors::SafeTensorError> {
        serialise(&self.parts, notes)
    }

    /// Reads a scene that [`Scene::save`] has written.
    ///
    /// # Errors
    /// When the file cannot be read, is cut off, or does not hold a scene.
    pub fn load(path: &Path) -> Result<Self, SceneFileError> {
        Ok(Self::load_with_notes(path)?.0)
    }

    /// Reads a scene and all entries of its metadata, the notes of [`Scene::to_bytes`] among them.
    ///
    /// # Errors
    /// Those of [`Scene::load`].
    pub fn load_with_notes(
        path: &Path,
    ) -> Result<(Self, BTreeMap<String, String>), SceneFileError> {
        let bytes = std::fs::read(path)
            .map_err(|source| SceneFileError::Io { path: path.into(), source })?;
        let (parts, metadata) = Reader { path, bytes: &bytes }.parts()?;
        let scene = Self::new(parts)
            .map_err(|source| SceneFileError::Scene { path: path.into(), source })?;
        Ok((scene, metadata.into_iter().collect()))
    }
}

fn bytes_of(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|value| value.to_le_bytes()).collect()
}

fn layers(head: &PointHead) -> [&Linear; 5] {
    [&head.net0, &head.density, &head.feature, &head.style, &head.color]
}

fn serialise(
    parts: &SceneParts,
    notes: &BTreeMap<String, String>,
) -> Result<Vec<u8>, safetensors::SafeTensorError> {
    let mut tensors: Vec<(String, Vec<usize>, Vec<u8>)> = Vec::new();
    let mut grid = |name: &str, grid: &Grid| {
        let shape = vec![grid.channels, grid.height, grid.width];
        tensors.push((name.to_owned(), shape, bytes_of(&grid.data)));
    };
    grid("map", &parts.inputs.map);
    if let Some(sky) = &parts.sky {
        grid("sky.map", &sky.map);
        tensors.push(("sky.style".to_owned(), vec![sky.style.len()], bytes_of(&sky.style)));
    }
    for (name, layer) in LAYERS.iter().zip(layers(&parts.head)) {
        let shape = vec![layer.outputs, layer.inputs];
        tensors.push((format!("head.{name}.weight"), shape, bytes_of(&layer.weight)));
        tensors.push((format!("head.{name}.bias"), vec![layer.outputs], bytes_of(&layer.bias)));
    }
    let views = tensors
        .iter()
        .map(|(name, shape, bytes)| Ok((name, TensorView::new(Dtype::F32, shape.clone(), bytes)?)))
        .collect::<Result<Vec<_>, safetensors::SafeTensorError>>()?;
    let representation = match parts.inputs.representation {
        Representation::Oneplane => "oneplane",
        Representation::OneplaneMulti => "oneplane_multi",
        Representation::Triplane => "triplane",
    };
    let activation = match parts.inputs.activation {
        DensityActivation::Mipnerf => "mipnerf",
        DensityActivation::Relu => "relu",
    };
    let metadata = [
        ("format", FORMAT.to_owned()),
        ("version", VERSION.to_owned()),
        ("representation", representation.to_owned()),
        ("activation", activation.to_owned()),
        ("scale", parts.inputs.scale.to_string()),
        ("metres_per_unit", parts.metres_per_unit.to_string()),
    ];
    let own = metadata.into_iter().map(|(key, value)| (key.to_owned(), value));
    let notes = notes.iter().map(|(key, value)| (key.clone(), value.clone()));
    let metadata: HashMap<String, String> = notes.chain(own).collect();
    let mut bytes = safetensors::serialize(views, Some(metadata.clone()))?;
    sort_metadata(&mut bytes, &metadata);
    Ok(bytes)
}

/// The library writes the metadata in the random order of a hash map; a scene's bytes must not differ
/// from run to run, so the entries are put in order in place (their length does not change).
fn sort_metadata(bytes: &mut [u8], metadata: &HashMap<String, String>) {
    const OPENING: &[u8] = b"\"__metadata__\":";
    let sorted: BTreeMap<_, _> = metadata.iter().collect();
    let Ok(text) = serde_json::to_vec(&sorted) else { return };
    let Some(at) = bytes.windows(OPENING.len()).position(|window| window == OPENING) else {
        return;
    };
    let start = at + OPENING.len();
    if let Some(place) = bytes.get_mut(start..start + text.len())
        && place.first() == Some(&b'{')
        && place.last() == Some(&b'}')
    {
        place.copy_from_slice(&text);
    }
}

/// A temporary file in the same folder, flushed to the disk, then renamed.
fn write_whole(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let name = path.file_name().ok_or(std::io::ErrorKind::InvalidInput)?;
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    let folder = folder.unwrap_or(Path::new("."));
    let temporary = folder.join(format!(".{}.{}.tmp", name.to_string_lossy(), std::process::id()));
    let write = || {
        let mut file = std::fs::File::create(&temporary)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        drop(file);
        std::fs::rename(&temporary, path)?;
        // Not every system can flush a folder; the file is whole either way.
        std::fs::File::open(folder).and_then(|folder| folder.sync_all()).or(Ok(()))
    };
    write().inspect_err(|_| {
        let _ = std::fs::remove_file(&temporary);
    })
}

struct Reader<'a> {
    path: &'a Path,
    bytes: &'a [u8],
}

impl Reader<'_> {
    fn content(&self, what: impl Into<String>) -> SceneFileError {
        SceneFileError::Content { path: self.path.into(), what: what.into() }
    }

    fn parts(&self) -> Result<(SceneParts, HashMap<String, String>), SceneFileError> {
        let wrong = |source| SceneFileError::Safetensors { path: self.path.into(), source };
        let (_, header) = SafeTensors::read_metadata(self.bytes).map_err(wrong)?;
        let metadata = header.metadata().clone().unwrap_or_default();
        let tensors = SafeTensors::deserialize(self.bytes).map_err(wrong)?;
        let entry = |key: &str| {
            metadata.get(key).map(String::as_str).ok_or_else(|| {
                self.content(format!("not a scene file: its metadata has no entry \"{key}\""))
            })
        };
        if entry("format")? != FORMAT {
            return Err(
                self.content(format!("format \"{}\" where {FORMAT} is needed", entry("format")?))
            );
        }
        if entry("version")? != VERSION {
            let version = entry("version")?;
            return Err(
                self.content(format!("scene version {version}; this program reads {VERSION}"))
            );
        }
        let representation = match entry("representation")? {
            "oneplane" => Representation::Oneplane,
            "oneplane_multi" => Representation::OneplaneMulti,
            "triplane" => Representation::Triplane,
            other => return Err(self.content(format!("unknown representation \"{other}\""))),
        };
        let activation = match entry("activation")? {
            "mipnerf" => DensityActivation::Mipnerf,
            "relu" => DensityActivation::Relu,
            other => return Err(self.content(format!("unknown activation \"{other}\""))),
        };
        let number = |key: &str| -> Result<f64, SceneFileError> {
            let text = entry(key)?;
            text.parse().map_err(|_| self.content(format!("{key} \"{text}\" is not a number")))
        };
        let sky = match tensors.names().iter().any(|name| name.starts_with("sky.")) {
            true => Some(SkyParts {
                style: self.tensor::<1>(&tensors, "sky.style")?.1,
                map: self.grid(&tensors, "sky.map")?,
            }),
            false => None,
        };
        let layer = |index: usize| self.layer(&tensors, LAYERS[index]);
        let parts = SceneParts {
            inputs: FieldInputs {
                map: self.grid(&tensors, "map")?,
                representation,
                activation,
                // Through the text, so that 0.8 comes back as the f32 nearest to it.
                scale: number("scale")? as f32,
            },
            head: PointHead {
                net0: layer(0)?,
                density: layer(1)?,
                feature: layer(2)?,
                style: layer(3)?,
                color: layer(4)?,
            },
            sky,
            metres_per_unit: number("metres_per_unit")?,
        };
        Ok((parts, metadata))
    }

    fn tensor<const RANK: usize>(
        &self,
        tensors: &SafeTensors<'_>,
        name: &str,
    ) -> Result<([usize; RANK], Vec<f32>), SceneFileError> {
        let view =
            tensors.tensor(name).map_err(|_| self.content(format!("no tensor \"{name}\"")))?;
        let shape = <[usize; RANK]>::try_from(view.shape()).map_err(|_| {
            self.content(format!("tensor \"{name}\" has shape {:?}, not {RANK} axes", view.shape()))
        })?;
        if view.dtype() != Dtype::F32 {
            return Err(self.content(format!("tensor \"{name}\" is {:?}, not F32", view.dtype())));
        }
        let values = view.data().as_chunks::<4>().0;
        Ok((shape, values.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()))
    }

    fn grid(&self, tensors: &SafeTensors<'_>, name: &str) -> Result<Grid, SceneFileError> {
        let ([channels, height, width], data) = self.tensor::<3>(tensors, name)?;
        Ok(Grid::new(channels, height, width, data))
    }

    fn layer(&self, tensors: &SafeTensors<'_>, name: &str) -> Result<Linear, SceneFileError> {
        let ([outputs, inputs], weight) =
            self.tensor::<2>(tensors, &format!("head.{name}.weight"))?;
        let (_, bias) = self.tensor::<1>(tensors, &format!("head.{name}.bias"))?;
        Ok(Linear { inputs, outputs, weight, bias })
    }
}
