//! What is wrong in an input: which file, which line, which field, and what was expected.

use serde::Serialize;
use std::fmt;

/// Longest piece of input that a problem quotes, in characters.
const QUOTED: usize = 80;

/// One thing that is wrong with the input.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Problem {
    /// File, relative to the folder that is read.
    pub file: String,
    /// Line, from 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub line: Option<u32>,
    /// Field of the line, from 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub field: Option<u32>,
    /// What kind of problem.
    pub kind: ProblemKind,
    /// What is wrong, with the value found and what was expected.
    pub message: String,
}

/// Kinds of problems.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum ProblemKind {
    /// The file or folder cannot be read.
    Unreadable,
    /// The line or the file is not UTF-8 text.
    NotText,
    /// A line has another number of fields than its format.
    FieldCount,
    /// A field should be a number and is none.
    Number,
    /// A name says no position.
    Name,
    /// A position lies outside what Web Mercator covers.
    Position,
    /// The city of a pair cannot be told.
    City,
    /// A line repeats an earlier one with other values; the earlier one counts.
    Conflict,
    /// A line repeats an earlier one exactly; harmless.
    Duplicate,
}

impl ProblemKind {
    /// Whether something of the input was lost. An exact repetition loses nothing.
    #[must_use]
    pub const fn is_failure(self) -> bool {
        !matches!(self, Self::Duplicate)
    }
}

impl Problem {
    /// A problem of a whole file.
    pub fn of_file(file: &str, kind: ProblemKind, message: impl Into<String>) -> Self {
        Self { file: file.to_owned(), line: None, field: None, kind, message: message.into() }
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.file)?;
        if let Some(line) = self.line {
            write!(f, ":{line}")?;
        }
        if let Some(field) = self.field {
            write!(f, ", field {field}")?;
        }
        write!(f, ": {}", self.message)
    }
}

/// A piece of input for a message: cut when long, control characters escaped.
pub(super) fn quoted(text: &str) -> String {
    let mut out: String = text.chars().take(QUOTED).flat_map(char::escape_debug).collect();
    if text.chars().nth(QUOTED).is_some() {
        out.push_str("...");
    }
    format!("`{out}`")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_problem_reads_like_a_compiler_message() {
        let problem = Problem {
            file: "splits/Seattle/a.txt".to_owned(),
            line: Some(7),
            field: Some(3),
            kind: ProblemKind::Number,
            message: format!("{} is not a number", quoted("4O\t")),
        };
        assert_eq!(problem.to_string(), r"splits/Seattle/a.txt:7, field 3: `4O\t` is not a number");
        assert_eq!(
            serde_json::to_value(&problem).expect("serialises")["kind"],
            serde_json::json!("number")
        );
    }

    #[test]
    fn long_values_are_cut_between_characters() {
        assert_eq!(quoted(&"\u{e9}".repeat(100)), format!("`{}...`", "\u{e9}".repeat(80)));
    }
}
