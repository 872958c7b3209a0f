//! Values of a recipe, without what TOML has and a command line has not.

use toml::de::DeValue;

/// One value as a command line knows it. A number is kept as it was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Scalar {
    Text(String),
    Number(String),
    Boolean(bool),
}

impl Scalar {
    /// The value as an argument.
    pub(super) fn text(&self) -> String {
        match self {
            Self::Text(text) | Self::Number(text) => text.clone(),
            Self::Boolean(value) => value.to_string(),
        }
    }

    /// A scalar, or what else the value is.
    pub(super) fn from_toml(value: &DeValue<'_>) -> Result<Self, &'static str> {
        match value {
            DeValue::String(text) => Ok(Self::Text(text.to_string())),
            DeValue::Integer(number) if number.radix() == 10 => {
                Ok(Self::Number(number.as_str().to_owned()))
            }
            DeValue::Integer(number) => i128::from_str_radix(number.as_str(), number.radix())
                .map(|value| Self::Number(value.to_string()))
                .map_err(|_| "a number that is too large"),
            DeValue::Float(number) => Ok(Self::Number(number.as_str().to_owned())),
            DeValue::Boolean(value) => Ok(Self::Boolean(*value)),
            other => Err(kind(other)),
        }
    }

    /// The value's type, for messages.
    pub(super) const fn kind(&self) -> &'static str {
        match self {
            Self::Text(_) => "a text",
            Self::Number(_) => "a number",
            Self::Boolean(_) => "true or false",
        }
    }
}

/// A TOML value's type, for messages.
pub(super) const fn kind(value: &DeValue<'_>) -> &'static str {
    match value {
        DeValue::String(_) => "a text",
        DeValue::Integer(_) | DeValue::Float(_) => "a number",
        DeValue::Boolean(_) => "true or false",
        DeValue::Datetime(_) => "a date",
        DeValue::Array(_) => "a list",
        DeValue::Table(_) => "a table",
    }
}

/// A scalar or a list of scalars.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Value {
    One(Scalar),
    List(Vec<Scalar>),
}

impl Value {
    pub(super) fn from_toml(value: &DeValue<'_>) -> Result<Self, &'static str> {
        match value {
            DeValue::Array(list) => list
                .iter()
                .map(|item| Scalar::from_toml(item.get_ref()))
                .collect::<Result<_, _>>()
                .map(Self::List)
                .map_err(|_| "a list of more than plain values"),
            other => Scalar::from_toml(other).map(Self::One),
        }
    }

    pub(super) const fn kind(&self) -> &'static str {
        match self {
            Self::One(scalar) => scalar.kind(),
            Self::List(_) => "a list",
        }
    }
}
