//! Where the network runs.

use crate::error::ModelError;
use std::fmt;
use std::str::FromStr;

/// A device, as `--device` names it: `cpu`, `cuda`, `cuda:1`, `wgpu`.
///
/// ```
/// use sat3d_model::Device;
///
/// assert_eq!("cuda:1".parse::<Device>()?, Device::Cuda(1));
/// assert_eq!(Device::default().to_string(), "cpu");
/// # Ok::<(), sat3d_model::ModelError>(())
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Device {
    /// The processor, all its cores.
    #[default]
    Cpu,
    /// An NVIDIA card by number (needs the feature `cuda`).
    Cuda(usize),
    /// The default graphics card through Vulkan, Metal or DirectX (needs the feature `wgpu`).
    Wgpu,
}

impl fmt::Display for Device {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Cpu => formatter.write_str("cpu"),
            Self::Cuda(index) => write!(formatter, "cuda:{index}"),
            Self::Wgpu => formatter.write_str("wgpu"),
        }
    }
}

impl FromStr for Device {
    type Err = ModelError;

    fn from_str(name: &str) -> Result<Self, ModelError> {
        let device = match name.split_once(':') {
            None if name == "cpu" => Some(Self::Cpu),
            None if name == "cuda" => Some(Self::Cuda(0)),
            None if name == "wgpu" => Some(Self::Wgpu),
            Some(("cuda", index)) => index.parse().ok().map(Self::Cuda),
            _ => None,
        };
        device.ok_or_else(|| ModelError::Device {
            name: name.into(),
            why: "unknown; one of cpu, cuda, cuda:<number>, wgpu".into(),
        })
    }
}

impl Device {
    /// The backend's handle of this device.
    ///
    /// # Errors
    /// [`ModelError::Device`] where the program was built without the device's feature.
    pub(crate) fn open(self) -> Result<burn::tensor::Device, ModelError> {
        match self {
            Self::Cpu => Ok(burn::tensor::Device::flex()),
            #[cfg(feature = "cuda")]
            Self::Cuda(index) => Ok(burn::tensor::Device::cuda(index)),
            #[cfg(not(feature = "cuda"))]
            Self::Cuda(_) => Err(self.left_out("cuda")),
            #[cfg(feature = "wgpu")]
            Self::Wgpu => Ok(burn::tensor::Device::wgpu(burn::tensor::DeviceKind::DefaultDevice)),
            #[cfg(not(feature = "wgpu"))]
            Self::Wgpu => Err(self.left_out("wgpu")),
        }
    }

    #[cfg(not(all(feature = "cuda", feature = "wgpu")))]
    fn left_out(self, feature: &str) -> ModelError {
        ModelError::Device {
            name: self.to_string(),
            why: format!("this program was built without it; build it with `--features {feature}`"),
        }
    }
}
