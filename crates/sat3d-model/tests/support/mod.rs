//! What the parity tests share: goldens, feature maps, comparison.
#![allow(dead_code, reason = "each test file uses a part")]

use safetensors::SafeTensors;
use sat3d_model::Grid;
use sat3d_model::field::{DensityActivation, FieldInputs, Linear, PointHead, Representation};
use std::path::PathBuf;

/// A safetensors file in memory.
pub struct Tensors(Vec<u8>);

impl Tensors {
    pub fn open(path: &std::path::Path) -> Option<Self> {
        std::fs::read(path).ok().map(Self)
    }

    fn view<T>(&self, name: &str, read: impl Fn(&[u8]) -> T) -> (Vec<usize>, T) {
        let tensors = SafeTensors::deserialize(&self.0).unwrap();
        let view = tensors.tensor(name).unwrap_or_else(|_| panic!("no tensor {name}"));
        (view.shape().to_vec(), read(view.data()))
    }

    pub fn has(&self, name: &str) -> bool {
        SafeTensors::deserialize(&self.0).unwrap().tensor(name).is_ok()
    }

    pub fn f32(&self, name: &str) -> Vec<f32> {
        self.view(name, |b| b.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()).1
    }

    pub fn f64(&self, name: &str) -> Vec<f64> {
        self.view(name, |b| b.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect()).1
    }

    pub fn i64(&self, name: &str) -> Vec<i64> {
        self.view(name, |b| b.as_chunks::<8>().0.iter().map(|b| i64::from_le_bytes(*b)).collect()).1
    }

    pub fn u8(&self, name: &str) -> Vec<u8> {
        self.view(name, <[u8]>::to_vec).1
    }

    pub fn shape(&self, name: &str) -> Vec<usize> {
        self.view(name, |_| ()).0
    }

    pub fn grid(&self, name: &str) -> Grid {
        let shape = self.shape(name);
        let [c, h, w] = shape[shape.len() - 3..] else { panic!("{name}: {shape:?}") };
        Grid::new(c, h, w, self.f32(name))
    }

    fn linear(&self, name: &str) -> Linear {
        let weight = format!("mlp.{name}.weight");
        let shape = self.shape(&weight);
        let bias = self.f32(&format!("mlp.{name}.bias"));
        Linear { inputs: shape[1], outputs: shape[0], weight: self.f32(&weight), bias }
    }

    pub fn head(&self) -> PointHead {
        PointHead {
            net0: self.linear("net0"),
            density: self.linear("net1_density"),
            feature: self.linear("net1_feature"),
            style: self.linear("style_squ"),
            color: self.linear("grd_color_convert"),
        }
    }
}

/// The folder of goldens: `SAT3D_GOLDENS`, else `shared/goldens` beside the repository.
pub fn goldens() -> PathBuf {
    std::env::var_os("SAT3D_GOLDENS").map_or_else(
        || PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/goldens")),
        PathBuf::from,
    )
}

/// A golden of one configuration, or a line that says what was skipped.
pub fn golden(config: &str, stage: &str) -> Option<Tensors> {
    let path = goldens().join(config).join(format!("{stage}.safetensors"));
    let file = Tensors::open(&path);
    if file.is_none() {
        eprintln!("SKIPPED {config} {stage}: no {}", path.display());
    }
    file
}

/// Feature map, point head, sky map and sky code of one configuration. The goldens hold only samples of
/// the map, so it comes from a file `<config>.safetensors` in `SAT3D_PLANES` (keys `map`, `sky` with
/// its zero columns, `w_sky` and the head's `mlp.*`), which any implementation of the network can write.
pub struct Case {
    pub inputs: FieldInputs,
    pub head: PointHead,
    pub sky: Grid,
    pub style: Vec<f32>,
}

pub fn case(config: &str) -> Option<Case> {
    let Some(folder) = std::env::var_os("SAT3D_PLANES") else {
        eprintln!("SKIPPED {config}: SAT3D_PLANES names no folder of feature maps");
        return None;
    };
    let path = PathBuf::from(folder).join(format!("{config}.safetensors"));
    let Some(file) = Tensors::open(&path) else {
        eprintln!("SKIPPED {config}: no {}", path.display());
        return None;
    };
    let representation = match config {
        "tiny_triplane" => Representation::Triplane,
        _ => Representation::Oneplane,
    };
    let inputs = FieldInputs {
        map: file.grid("map"),
        representation,
        activation: DensityActivation::Mipnerf,
        scale: 0.8,
    };
    let (sky, style) = (file.grid("sky"), file.f32("w_sky"));
    Some(Case { inputs, head: file.head(), sky, style })
}

/// Relative L2 error and largest single error; the first must be within `tolerance`.
#[track_caller]
pub fn compare(name: &str, got: &[f32], want: &[f32], tolerance: f64) {
    assert_eq!(got.len(), want.len(), "{name}");
    let (mut error, mut norm, mut worst) = (0.0, 0.0, 0.0_f64);
    for (got, want) in got.iter().zip(want) {
        let difference = f64::from(*got) - f64::from(*want);
        error += difference * difference;
        norm += f64::from(*want) * f64::from(*want);
        // `max` would swallow a NaN.
        worst = if difference.abs() <= worst { worst } else { difference.abs() };
    }
    let relative = (error / f64::max(norm, 1e-60)).sqrt();
    eprintln!("{name:44} relative L2 {relative:.2e}  largest {worst:.2e}");
    assert!(relative <= tolerance, "{name}: relative L2 {relative:e} above {tolerance:e}");
    assert!(worst.is_finite(), "{name}: {worst}");
}

/// The values of a whole tensor that a golden has kept (`X:s`).
pub fn sampled(values: &[f32], count: usize) -> Vec<f32> {
    (0..count).map(|k| values[(k * 1_000_003) % values.len()]).collect()
}
