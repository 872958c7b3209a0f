//! Tables of a settings file laid over a whole set of numbers, so that a file says only what it changes.

use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

/// What is wrong with a table: the key, its value, and what is served.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Fault {
    /// Path of the key below the table.
    pub(super) key: String,
    /// As written.
    pub(super) value: Value,
    /// What is served.
    pub(super) why: String,
}

/// `base` with what `table` says in place of its own.
pub(super) fn overlay<T>(base: &T, table: &toml::Table) -> Result<T, Fault>
where
    T: Serialize + DeserializeOwned,
{
    let fault = |why: String| Fault { key: String::new(), value: Value::Null, why };
    let mut whole = serde_json::to_value(base).map_err(|error| fault(error.to_string()))?;
    let changes = serde_json::to_value(table).map_err(|error| fault(error.to_string()))?;
    lay::<T>(&mut whole, &changes, &mut Vec::new())?;
    serde_json::from_value(whole).map_err(|error| fault(error.to_string()))
}

/// Lays one level over another. Each value is tried by itself, so that a message names the key that it is about.
fn lay<T: DeserializeOwned>(
    whole: &mut Value,
    changes: &Value,
    at: &mut Vec<String>,
) -> Result<(), Fault> {
    let empty = serde_json::Map::new();
    for (key, change) in changes.as_object().unwrap_or(&empty) {
        at.push(key.clone());
        let fault =
            |at: &[String], why: String| Fault { key: at.join("."), value: change.clone(), why };
        let Some(known) = place(whole, at) else {
            let keys = place(whole, &at[..at.len() - 1])
                .and_then(|above| above.as_object())
                .map(|map| map.keys().map(|key| format!("`{key}`")).collect::<Vec<_>>().join(", "));
            let why = format!("there is no such key; there are {}", keys.unwrap_or_default());
            return Err(fault(at, why));
        };
        if known.is_object() && change.is_object() {
            lay::<T>(whole, change, at)?;
        } else {
            *known = change.clone();
            serde_json::from_value::<T>(whole.clone())
                .map_err(|error| fault(at, error.to_string()))?;
        }
        at.pop();
    }
    Ok(())
}

/// The value at a path of keys.
fn place<'a>(whole: &'a mut Value, at: &[String]) -> Option<&'a mut Value> {
    at.iter().try_fold(whole, |value, key| value.get_mut(key.as_str()))
}
