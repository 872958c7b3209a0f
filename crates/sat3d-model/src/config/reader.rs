//! Typed access to JSON objects that knows the path of each key, for messages.

use crate::error::ModelError;
use serde_json::{Map, Value};

/// Largest count accepted: far above any network, far below overflow of products.
const LARGEST: u64 = 1 << 20;

/// One object of the config and where it lies.
pub(super) struct Reader<'a> {
    object: &'a Map<String, Value>,
    path: String,
    origin: &'a str,
}

impl<'a> Reader<'a> {
    /// The outermost object; anything else reads as an empty one.
    pub(super) fn root(value: &'a Value, origin: &'a str) -> Self {
        static EMPTY: std::sync::LazyLock<Map<String, Value>> = std::sync::LazyLock::new(Map::new);
        Self { object: value.as_object().unwrap_or(&EMPTY), path: String::new(), origin }
    }

    fn path(&self, key: &str) -> String {
        if self.path.is_empty() { key.into() } else { format!("{}.{key}", self.path) }
    }

    /// A value that is there; null counts as absent.
    fn get(&self, key: &str) -> Option<&'a Value> {
        self.object.get(key).filter(|value| !value.is_null())
    }

    fn shown(&self, key: &str) -> String {
        self.object.get(key).map_or_else(|| "(absent)".into(), Value::to_string)
    }

    fn wrong_type(&self, key: &str, wanted: &str) -> ModelError {
        ModelError::ConfigSyntax {
            origin: self.origin.into(),
            message: format!("`{}` = {}: expected {wanted}", self.path(key), self.shown(key)),
        }
    }

    fn missing(&self, key: &str) -> ModelError {
        ModelError::ConfigSyntax {
            origin: self.origin.into(),
            message: format!("`{}` is missing", self.path(key)),
        }
    }

    pub(super) fn unsupported(&self, key: &str, served: &str) -> ModelError {
        ModelError::Unsupported {
            key: self.path(key),
            value: self.shown(key),
            served: served.into(),
        }
    }

    pub(super) fn invalid(&self, key: &str, why: &str) -> ModelError {
        ModelError::InvalidConfig { key: self.path(key), value: self.shown(key), why: why.into() }
    }

    pub(super) fn object(&self, key: &str) -> Result<Option<Self>, ModelError> {
        let Some(value) = self.get(key) else { return Ok(None) };
        let object = value.as_object().ok_or_else(|| self.wrong_type(key, "an object"))?;
        Ok(Some(Self { object, path: self.path(key), origin: self.origin }))
    }

    pub(super) fn required_object(&self, key: &str) -> Result<Self, ModelError> {
        self.object(key)?.ok_or_else(|| self.missing(key))
    }

    pub(super) fn text(&self, key: &str) -> Result<Option<&'a str>, ModelError> {
        let Some(value) = self.get(key) else { return Ok(None) };
        value.as_str().map(Some).ok_or_else(|| self.wrong_type(key, "a string"))
    }

    pub(super) fn flag(&self, key: &str) -> Result<Option<bool>, ModelError> {
        let Some(value) = self.get(key) else { return Ok(None) };
        value.as_bool().map(Some).ok_or_else(|| self.wrong_type(key, "true or false"))
    }

    pub(super) fn number(&self, key: &str) -> Result<Option<f64>, ModelError> {
        let Some(value) = self.get(key) else { return Ok(None) };
        value.as_f64().map(Some).ok_or_else(|| self.wrong_type(key, "a number"))
    }

    /// A whole number from 0.
    pub(super) fn natural(&self, key: &str) -> Result<Option<usize>, ModelError> {
        let Some(value) = self.get(key) else { return Ok(None) };
        natural(value).map(Some).ok_or_else(|| self.wrong_type(key, "a whole number"))
    }

    /// A whole number from 1.
    pub(super) fn count(&self, key: &str) -> Result<Option<usize>, ModelError> {
        match self.natural(key)? {
            Some(0) => Err(self.wrong_type(key, "a whole number above 0")),
            other => Ok(other),
        }
    }

    pub(super) fn required_count(&self, key: &str) -> Result<usize, ModelError> {
        self.count(key)?.ok_or_else(|| self.missing(key))
    }

    /// A list of whole numbers from 1.
    pub(super) fn counts(&self, key: &str) -> Result<Option<Vec<usize>>, ModelError> {
        let Some(value) = self.get(key) else { return Ok(None) };
        value
            .as_array()
            .and_then(|list| {
                list.iter().map(|item| natural(item).filter(|&count| count > 0)).collect()
            })
            .map(Some)
            .ok_or_else(|| self.wrong_type(key, "a list of whole numbers above 0"))
    }

    /// Refuses a text that is (or by default would be) anything but `served`.
    pub(super) fn only_text(
        &self,
        key: &str,
        default: &str,
        served: &str,
    ) -> Result<(), ModelError> {
        if self.text(key)?.unwrap_or(default) == served {
            return Ok(());
        }
        Err(self.unsupported(key, &format!("{served:?}")))
    }
}

fn natural(value: &Value) -> Option<usize> {
    let number = value.as_u64().filter(|&number| number <= LARGEST)?;
    usize::try_from(number).ok()
}
