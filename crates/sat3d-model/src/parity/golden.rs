//! The reference's numbers: the published folder, or the samples of it that are built in.

use super::{ParityError, Set};
use crate::preprocess::Image8;
use safetensors::SafeTensors;
use safetensors::tensor::TensorView;
use std::borrow::Cow;
use std::path::PathBuf;

/// Stride, in values, between the samples that stand for a large tensor (`X:s`).
const STRIDE: usize = 1_000_003;

const COMMON: &[u8] = include_bytes!("../../fixtures/parity/common.safetensors");
const TINY: &[u8] = include_bytes!("../../fixtures/parity/tiny.safetensors");
const TINY_TRIPLANE: &[u8] = include_bytes!("../../fixtures/parity/tiny_triplane.safetensors");

/// Where the numbers are.
pub(super) enum Goldens {
    /// The published set's folder.
    Folder(PathBuf),
    /// In this program.
    BuiltIn,
}

impl Goldens {
    /// One file of the set, as `04_ortho`; `common` lies above the sets.
    pub fn file(&self, set: Set, name: &'static str) -> Result<File, ParityError> {
        match self {
            Self::Folder(root) => {
                let folder = if name == "common" { root.clone() } else { root.join(set.name()) };
                let path = folder.join(name).with_extension("safetensors");
                let bytes = std::fs::read(&path)
                    .map_err(|source| ParityError::Io { path: path.clone(), source })?;
                let origin = path.display().to_string();
                Ok(File { name, bytes: bytes.into(), prefix: String::new(), origin })
            }
            Self::BuiltIn => {
                let (bytes, prefix) = match (name, set) {
                    ("common", _) => (COMMON, String::new()),
                    (_, Set::TinyTriplane) => (TINY_TRIPLANE, format!("{name}/")),
                    _ => (TINY, format!("{name}/")),
                };
                Ok(File { name, bytes: bytes.into(), prefix, origin: "built in".into() })
            }
        }
    }
}

/// One file's tensors.
pub(super) struct File {
    /// Its name in the published set.
    pub name: &'static str,
    bytes: Cow<'static, [u8]>,
    prefix: String,
    origin: String,
}

/// What the reference has of a tensor.
pub(super) struct Expected {
    /// Its values, or samples of them.
    pub values: Vec<f64>,
    /// Shape of the whole tensor, without axes of length 1.
    pub shape: Vec<usize>,
    sampled: bool,
}

impl Expected {
    /// Those of our values that the reference's stand beside.
    pub fn picked(&self, ours: &[f64]) -> Vec<f64> {
        if self.sampled {
            (0..self.values.len()).map(|k| ours[k * STRIDE % ours.len()]).collect()
        } else {
            ours.to_vec()
        }
    }
}

impl File {
    fn damaged(&self, item: &str, why: impl Into<String>) -> ParityError {
        ParityError::Damaged { origin: self.origin.clone(), item: item.into(), why: why.into() }
    }

    fn read<T>(
        &self,
        key: &str,
        take: impl FnOnce(&TensorView<'_>) -> Option<T>,
    ) -> Result<Option<T>, ParityError> {
        let tensors = SafeTensors::deserialize(&self.bytes)
            .map_err(|error| self.damaged("header", error.to_string()))?;
        let name = format!("{}{key}", self.prefix);
        match tensors.tensor(&name) {
            Ok(view) => match take(&view) {
                Some(value) => Ok(Some(value)),
                None => Err(self.damaged(key, format!("elements of type {:?}", view.dtype()))),
            },
            Err(_) => Ok(None),
        }
    }

    /// Whether the file has this tensor, whole or in samples.
    pub fn has(&self, key: &str) -> Result<bool, ParityError> {
        let whole = self.read(key, |_| Some(()))?;
        Ok(whole.is_some() || self.read(&format!("{key}:s"), |_| Some(()))?.is_some())
    }

    /// A whole tensor's values.
    pub fn values(&self, key: &str) -> Result<Vec<f64>, ParityError> {
        self.read(key, numbers)?.ok_or_else(|| self.damaged(key, "not there"))
    }

    /// A whole tensor's values, as they were computed.
    pub fn singles(&self, key: &str) -> Result<Vec<f32>, ParityError> {
        Ok(self.values(key)?.into_iter().map(|value| value as f32).collect())
    }

    /// Indices or sizes.
    pub fn counts(&self, key: &str) -> Result<Vec<usize>, ParityError> {
        Ok(self.values(key)?.into_iter().map(|value| value as usize).collect())
    }

    /// A tensor to compare with, whole or in samples.
    pub fn expected(&self, key: &str) -> Result<Expected, ParityError> {
        let squeezed = |shape: &[usize]| shape.iter().copied().filter(|side| *side != 1).collect();
        let whole = self.read(key, |view| Some((numbers(view)?, squeezed(view.shape()))))?;
        if let Some((values, shape)) = whole {
            return Ok(Expected { values, shape, sampled: false });
        }
        let values = self.values(&format!("{key}:s"))?;
        let shape = squeezed(&self.counts(&format!("{key}:shape"))?);
        Ok(Expected { values, shape, sampled: true })
    }
}

/// Values of any of the types that the set has; each fits an f64.
fn numbers(view: &TensorView<'_>) -> Option<Vec<f64>> {
    use safetensors::Dtype;
    let data = view.data();
    let (fours, eights) = (data.as_chunks::<4>().0, data.as_chunks::<8>().0);
    Some(match view.dtype() {
        Dtype::F32 => fours.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect(),
        Dtype::F64 => eights.iter().map(|b| f64::from_le_bytes(*b)).collect(),
        Dtype::I64 => eights.iter().map(|b| i64::from_le_bytes(*b) as f64).collect(),
        _ => return None,
    })
}

/// The images that the numbers were computed from; always built in.
#[derive(Clone, Copy)]
pub(super) enum Picture {
    /// The satellite image, 640 x 640.
    Satellite,
    /// The same after Pillow's bicubic, 256 x 256.
    SatelliteResized,
    /// The panorama after Pillow's bicubic, 512 x 128.
    Panorama,
    /// Its sky mask, 1024 x 512.
    SkyMask,
    /// The mask resized to 512 x 128 by the nearest pixel.
    SkyMaskNearest,
}

impl Picture {
    /// Decodes the picture.
    pub fn load(self) -> Result<Image8, ParityError> {
        let (name, bytes): (_, &[u8]) = match self {
            Self::Satellite => (
                "satellite image",
                include_bytes!("../../fixtures/inputs/satellite_47.6_-122.33.png"),
            ),
            Self::SatelliteResized => {
                ("resized image", include_bytes!("../../fixtures/sat_resized_256.png"))
            }
            Self::Panorama => {
                ("panorama", include_bytes!("../../fixtures/parity/pano_resized.png"))
            }
            Self::SkyMask => {
                ("sky mask", include_bytes!("../../fixtures/inputs/panorama_sky_mask.png"))
            }
            Self::SkyMaskNearest => {
                ("nearest sky mask", include_bytes!("../../fixtures/parity/mask_nearest.png"))
            }
        };
        let damaged = |why: String| ParityError::Damaged {
            origin: "built in".into(),
            item: name.into(),
            why,
        };
        let decode = || -> Result<(png::OutputInfo, Vec<u8>), png::DecodingError> {
            let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info()?;
            let mut data = vec![0; reader.output_buffer_size().unwrap_or(0)];
            let info = reader.next_frame(&mut data)?;
            data.truncate(info.buffer_size());
            Ok((info, data))
        };
        let (info, data) = decode().map_err(|error| damaged(error.to_string()))?;
        let channels = info.color_type.samples();
        Ok(Image8::new(info.width as usize, info.height as usize, channels, data)?)
    }
}
