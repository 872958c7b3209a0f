//! What can be wrong with a recipe, where, and what to do about it.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

/// A place in a recipe: file, line and step.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Place {
    /// The recipe.
    pub path: Box<Path>,
    /// Line, from 1.
    pub line: usize,
    /// Number (from 1) and command of the step, where there is one.
    pub step: Option<(usize, Box<str>)>,
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.path.display(), self.line)?;
        match &self.step {
            Some((number, command)) if command.is_empty() => write!(f, ": step {number}"),
            Some((number, command)) => write!(f, ": step {number} ({command})"),
            None => Ok(()),
        }
    }
}

/// Why a recipe cannot run. [`help`](Self::help) says what to do.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The file cannot be read.
    #[error("cannot read the recipe {}: {source}", path.display())]
    Read {
        /// The recipe.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// The file is no TOML.
    #[error("{place}: not TOML: {message}")]
    Syntax {
        /// Where.
        place: Place,
        /// What the parser says.
        message: String,
    },
    /// There is no `[[step]]`.
    #[error("{}: the recipe has no steps", path.display())]
    NoSteps {
        /// The recipe.
        path: PathBuf,
    },
    /// A step without `command`.
    #[error("{place}: the step has no `command`")]
    MissingCommand {
        /// Where.
        place: Place,
    },
    /// A command that sat3d does not have.
    #[error("{place}: unknown command `{command}`")]
    UnknownCommand {
        /// Where.
        place: Place,
        /// As written.
        command: String,
        /// The commands a step can run.
        known: Vec<String>,
    },
    /// A key that means nothing here.
    #[error("{place}: unknown key `{key}`")]
    UnknownKey {
        /// Where.
        place: Place,
        /// As written.
        key: String,
        /// The keys that mean something here.
        known: Vec<String>,
    },
    /// A key that is given to `sat3d run` itself, for all steps at once.
    #[error("{place}: `{key}` holds for the whole chain and cannot be set in one step")]
    WholeChain {
        /// Where.
        place: Place,
        /// As written.
        key: String,
    },
    /// A value of the wrong type.
    #[error("{place}: `{key}` is {found}, but must be {expected}")]
    WrongType {
        /// Where.
        place: Place,
        /// The key.
        key: String,
        /// What it must be.
        expected: String,
        /// What it is.
        found: &'static str,
    },
    /// `${name}` of a variable that is not defined.
    #[error("{place}: `{key}` uses the variable `${{{name}}}`, which is not defined")]
    UnknownVariable {
        /// Where.
        place: Place,
        /// The key whose value uses it.
        key: String,
        /// The variable.
        name: String,
        /// The variables that are defined.
        known: Vec<String>,
    },
    /// `${` without `}`.
    #[error("{place}: `{key}` has a `${{` without its `}}`: {text:?}")]
    Unterminated {
        /// Where.
        place: Place,
        /// The key.
        key: String,
        /// The value.
        text: String,
    },
    /// Variables that are defined by each other.
    #[error("{place}: the variable `{name}` is defined by itself ({chain})")]
    Cycle {
        /// Where.
        place: Place,
        /// The variable.
        name: String,
        /// The way around, `a -> b -> a`.
        chain: String,
    },
    /// One name in both `[paths]` and `[variables]`.
    #[error("{place}: `{name}` is defined in [paths] and in [variables]")]
    DefinedTwice {
        /// Where the second is.
        place: Place,
        /// The variable.
        name: String,
    },
    /// A name in a step's `each` that is a variable of the recipe, too.
    #[error("{place}: `{name}` in `each` is a variable of the recipe, too")]
    EachIsVariable {
        /// Where.
        place: Place,
        /// The name.
        name: String,
    },
    /// `--set` without `=`.
    #[error("--set `{setting}` is no setting")]
    SettingForm {
        /// As written.
        setting: String,
    },
    /// `--set` of a variable that the recipe does not define.
    #[error("--set `{name}`: {} defines no such variable", path.display())]
    SettingName {
        /// The recipe.
        path: PathBuf,
        /// As written.
        name: String,
        /// The variables that are defined.
        known: Vec<String>,
    },
    /// The step's own command refuses its arguments.
    #[error("{place}: {message}")]
    Arguments {
        /// Where.
        place: Place,
        /// What the command's parser says.
        message: String,
    },
}

impl Error {
    /// What to do about it, where the message alone does not say.
    #[must_use]
    pub fn help(&self) -> Option<String> {
        let help = match self {
            Self::NoSteps { .. } => {
                "add one:\n    [[step]]\n    command = \"dsm-bench build\"\n    lidar = \"tiles\""
                    .into()
            }
            Self::MissingCommand { .. } => {
                "name the subcommand, for example command = \"vigor ingest\"".into()
            }
            Self::UnknownCommand { command, known, .. } => choices(command, known, "commands"),
            Self::UnknownKey { key, known, .. } => choices(key, known, "keys"),
            Self::UnknownVariable { name, known, .. } | Self::SettingName { name, known, .. } => {
                if known.is_empty() {
                    "the recipe defines no variables; add a [paths] or [variables] table".into()
                } else {
                    choices(name, known, "variables")
                }
            }
            Self::WholeChain { key, .. } => format!("give it to the chain: sat3d run --{key} ..."),
            Self::Unterminated { .. } => "write ${name}, or $${ for a literal ${".into(),
            Self::SettingForm { .. } => "write --set name=value".into(),
            Self::DefinedTwice { .. } | Self::EachIsVariable { .. } => {
                "rename one of the two".into()
            }
            Self::Read { .. }
            | Self::Syntax { .. }
            | Self::WrongType { .. }
            | Self::Cycle { .. }
            | Self::Arguments { .. } => return None,
        };
        Some(help)
    }
}

/// `did you mean ...?` where something is near, then everything there is.
fn choices(name: &str, known: &[String], what: &str) -> String {
    let all = format!("{what}: {}", known.join(", "));
    nearest(name, known)
        .map_or_else(|| all.clone(), |near| format!("did you mean `{near}`? ({all})"))
}

/// The name most like `name`, if any is like it at all. Dashes, underscores and spaces are alike.
fn nearest<'a>(name: &str, known: &'a [String]) -> Option<&'a str> {
    let plain = |text: &str| text.to_lowercase().replace(['_', ' '], "-");
    let wanted = plain(name);
    known
        .iter()
        .map(|candidate| (strsim::jaro_winkler(&wanted, &plain(candidate)), candidate.as_str()))
        .filter(|(likeness, _)| *likeness > 0.8)
        // The first of equals, so that the answer does not depend on the order of a sort.
        .fold(None, |best: Option<(f64, &str)>, next| match best {
            Some(best) if best.0 >= next.0 => Some(best),
            _ => Some(next),
        })
        .map(|(_, candidate)| candidate)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_name_is_found_and_a_far_one_is_not_offered() {
        let known: Vec<String> = ["max-nan", "zoom", "lidar"].map(String::from).into();
        assert_eq!(nearest("max_nan", &known), Some("max-nan"));
        assert_eq!(nearest("lidr", &known), Some("lidar"));
        assert_eq!(nearest("MAX-NAN", &known), Some("max-nan"));
        assert_eq!(nearest("threads", &known), None);
    }
}
