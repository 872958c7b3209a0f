//! What can go wrong between a checkpoint folder and an image of features.

use std::fmt::Write as _;
use std::path::PathBuf;

/// An error of the model crate; each says the file or key, the value, and what is served instead.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ModelError {
    /// A file could not be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        #[source]
        source: std::io::Error,
    },
    /// Neither the folder nor the places inside it hold a checkpoint.
    #[error("{}: no checkpoint here: {why}", folder.display())]
    NoCheckpoint {
        /// The folder that was asked for.
        folder: PathBuf,
        /// What was looked for.
        why: String,
    },
    /// `config.json` is not JSON, or a value in it has the wrong type.
    #[error("{origin}: {message}")]
    ConfigSyntax {
        /// The file, or "config".
        origin: String,
        /// What is wrong, and where.
        message: String,
    },
    /// The checkpoint belongs to another program.
    #[error(
        "{origin}: `_class_name` is {found}: not a Sat3DGen checkpoint (served: \"Sat3DGen\", \
         \"VAE_finetune\")"
    )]
    ClassName {
        /// The file, or "config".
        origin: String,
        /// The class named there, in quotes, or "missing".
        found: String,
    },
    /// A switch asks for something that exists upstream and is not served here.
    #[error("config: `{key}` = {value} is not served; served: {served}")]
    Unsupported {
        /// Path of the key, as in `opt.network.sr_factor`.
        key: String,
        /// The value found, as JSON.
        value: String,
        /// What can be there instead.
        served: String,
    },
    /// A value contradicts another one or makes no network.
    #[error("config: `{key}` = {value}: {why}")]
    InvalidConfig {
        /// Path of the key.
        key: String,
        /// The value found, as JSON.
        value: String,
        /// What it has to fulfil.
        why: String,
    },
    /// The safetensors file is cut off or damaged.
    #[error("{}: not a whole safetensors file: {why}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        why: String,
    },
    /// The tensors are not those that the config describes.
    #[error("{}: the tensors do not fit the config:{}", path.display(), mismatch.listed())]
    Tensors {
        /// The file.
        path: PathBuf,
        /// All of what is wrong.
        mismatch: Box<Mismatch>,
    },
    /// The device does not exist, or this program was built without it.
    #[error("device `{name}`: {why}")]
    Device {
        /// As asked for.
        name: String,
        /// Why not, and what to do.
        why: String,
    },
    /// An input of a stage has the wrong shape.
    #[error("{what}: expected {expected}, got {found}")]
    Shape {
        /// Which input of which stage.
        what: &'static str,
        /// The shape it has to have.
        expected: String,
        /// The shape it has.
        found: String,
    },
    /// The configured model has no such part (super-resolution with `sr_factor` 1).
    #[error("this model has no {part}: {why}")]
    Absent {
        /// The part.
        part: &'static str,
        /// The switch that left it out.
        why: String,
    },
    /// The network's output and the point head make no scene.
    #[error(transparent)]
    Scene(#[from] crate::scene::SceneError),
    /// The compute backend failed, for want of memory for example.
    #[error("{stage} on the device: {why}")]
    Backend {
        /// The stage that ran.
        stage: &'static str,
        /// The backend's reason.
        why: String,
    },
}

impl ModelError {
    /// An [`ModelError::Io`] for `map_err`.
    pub(crate) fn io(path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { path, source }
    }
}

/// How the tensors of a file differ from those that its config describes. Never empty inside an
/// error.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Mismatch {
    /// Keys that the config needs and the file lacks.
    pub missing: Vec<String>,
    /// Keys that the file has and the config has no place for.
    pub extra: Vec<String>,
    /// Key, expected shape, shape found.
    pub misshaped: Vec<(String, Vec<usize>, Vec<usize>)>,
    /// Key and element type, where it is none of F32, F16 and BF16.
    pub mistyped: Vec<(String, String)>,
}

impl Mismatch {
    /// Whether there is nothing to complain about.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.missing.is_empty()
            && self.extra.is_empty()
            && self.misshaped.is_empty()
            && self.mistyped.is_empty()
    }

    fn listed(&self) -> String {
        let mut text = String::new();
        // Writing to a String cannot fail.
        for (name, keys) in [("missing", &self.missing), ("extra", &self.extra)] {
            if !keys.is_empty() {
                let _ = write!(text, "\n  {} {name}: {}", keys.len(), keys.join(", "));
            }
        }
        if !self.misshaped.is_empty() {
            let _ = write!(text, "\n  {} of another shape:", self.misshaped.len());
            for (key, expected, found) in &self.misshaped {
                let _ = write!(text, "\n    {key}: expected {expected:?}, found {found:?}");
            }
        }
        if !self.mistyped.is_empty() {
            let _ =
                write!(text, "\n  {} of another type than F32, F16, BF16:", self.mistyped.len());
            for (key, found) in &self.mistyped {
                let _ = write!(text, "\n    {key}: {found}");
            }
        }
        text
    }
}
