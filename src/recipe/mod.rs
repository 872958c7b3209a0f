//! Recipes: chains of subcommands with their parameters, in TOML.
//!
//! ```toml
//! [paths]                      # relative to the recipe's folder; `--set out=DIR` replaces one
//! out = "../demo"
//!
//! [[step]]
//! command = "dsm-bench build"
//! lidar = "${out}/lidar"       # keys are the command's long flags and the names of its arguments
//! max-nan = 5                  # lists give several values, true and false turn switches on and off
//! ```
//!
//! A step with `each = { seed = [1, 2], size = ["small", "large"] }` runs once for each combination; `${seed}` and
//! `${size}` are then variables of that step.
//!
//! A recipe knows nothing of its commands: it asks their [`clap::Command`] which keys exist, which
//! take values and which are paths. So a new subcommand can be used in recipes as it is, and what
//! a step accepts is what the command line accepts.

mod arguments;
mod error;
mod value;
mod variables;

pub use arguments::{PathArgument, Step};
pub use error::{Error, Place};

use std::path::{Path, PathBuf};
use toml::Spanned;
use toml::de::{DeTable, DeValue};
use value::{Scalar, Value, kind};
use variables::{Values, Variables};

/// A recipe as written: nothing is filled in or checked against the commands yet.
#[derive(Clone, Debug)]
pub struct Recipe {
    path: PathBuf,
    /// Canonical folder of the recipe.
    base: PathBuf,
    description: Option<String>,
    closing: Option<(Scalar, Place)>,
    variables: Variables,
    steps: Vec<RawStep>,
}

/// A step as written.
#[derive(Clone, Debug)]
struct RawStep {
    command: Vec<String>,
    place: Place,
    /// Names with the values that the step runs for, and their line; the first name changes slowest.
    each: Vec<(String, Vec<Scalar>, usize)>,
    /// Key, value and line, in the order of the file.
    parameters: Vec<(String, Value, usize)>,
}

impl RawStep {
    /// The variables of each time that the step runs: the recipe's, and one of every combination of `each`.
    fn times(&self, values: &Values) -> Result<Vec<Values>, Error> {
        let mut times = vec![values.clone()];
        for (name, list, line) in &self.each {
            let place = Place { line: *line, ..self.place.clone() };
            if values.has(name) {
                return Err(Error::EachIsVariable { place, name: name.clone() });
            }
            let mut longer = Vec::with_capacity(times.len() * list.len());
            for before in &times {
                for item in list {
                    // Of the recipe's variables: names of `each` do not use each other.
                    longer.push(before.with(name, values.fill(item, name, &place)?));
                }
            }
            times = longer;
        }
        Ok(times)
    }
}

/// A recipe that is ready to run: every value filled in, every key checked.
#[derive(Clone, Debug)]
pub struct Chain {
    /// The steps in order.
    pub steps: Vec<Step>,
    /// What to say when all went well, if anything.
    pub closing: Option<String>,
}

const TOP_LEVEL: [&str; 5] = ["description", "paths", "variables", "step", "closing"];

impl Recipe {
    /// Reads a recipe.
    ///
    /// # Errors
    /// The file cannot be read, is no TOML, has keys that a recipe does not know, or no steps.
    pub fn read(path: &Path) -> Result<Self, Error> {
        let unreadable = |source| Error::Read { path: path.to_owned(), source };
        let text = std::fs::read_to_string(path).map_err(unreadable)?;
        let whole = std::fs::canonicalize(path).map_err(unreadable)?;
        let base = whole.parent().unwrap_or(Path::new("/"));
        Self::parse(path, base, &text)
    }

    /// Parses the text of a recipe; its relative paths belong to the folder `base`, which is
    /// canonical.
    ///
    /// # Errors
    /// As [`read`](Self::read).
    pub fn parse(path: &Path, base: &Path, text: &str) -> Result<Self, Error> {
        let file = File { path, text };
        let table = DeTable::parse(text).map_err(|error| Error::Syntax {
            place: file.place(error.span().map_or(0, |span| span.start)),
            message: error.message().to_owned(),
        })?;
        let mut recipe = Self {
            path: path.to_owned(),
            base: base.to_owned(),
            description: None,
            closing: None,
            variables: Variables::default(),
            steps: Vec::new(),
        };
        for (key, value) in in_file_order(table.get_ref()) {
            let place = file.place(key.span().start);
            let name = key.get_ref().as_ref();
            match (name, value.get_ref()) {
                ("description", DeValue::String(text)) => {
                    recipe.description = Some(text.trim().to_owned());
                }
                ("closing", DeValue::String(text)) => {
                    let text = text.trim_end().to_owned();
                    recipe.closing = Some((Scalar::Text(text), place));
                }
                ("paths" | "variables", DeValue::Table(table)) => {
                    recipe.define(&file, table, name == "paths")?;
                }
                ("step", DeValue::Array(steps)) => {
                    for (index, step) in steps.iter().enumerate() {
                        recipe.steps.push(raw_step(&file, index + 1, step)?);
                    }
                }
                (known, value) if TOP_LEVEL.contains(&known) => {
                    return Err(Error::WrongType {
                        place,
                        key: known.to_owned(),
                        expected: match known {
                            "step" => "written as [[step]]".to_owned(),
                            "paths" | "variables" => format!("a table, [{known}]"),
                            _ => "a text".to_owned(),
                        },
                        found: kind(value),
                    });
                }
                (key, _) => {
                    return Err(Error::UnknownKey {
                        place,
                        key: key.to_owned(),
                        known: TOP_LEVEL.map(String::from).into(),
                    });
                }
            }
        }
        if recipe.steps.is_empty() {
            return Err(Error::NoSteps { path: path.to_owned() });
        }
        Ok(recipe)
    }

    /// What the recipe says it does.
    #[must_use]
    pub fn description(&self) -> Option<&str> {
        self.description.as_deref()
    }

    /// Where the recipe was read from.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Fills in all variables and turns every step into the arguments of its command. `settings`
    /// are `name=value`, as `--set` gives them, with paths relative to `cwd`; `root` is the whole
    /// command line.
    ///
    /// # Errors
    /// A setting or variable that does not exist, a command that does not, a key that its command
    /// does not have, a value of the wrong type. Whether the values are good is for the command's
    /// own parser to say.
    pub fn resolve(
        &self,
        settings: &[String],
        cwd: &Path,
        root: &clap::Command,
    ) -> Result<Chain, Error> {
        let values = self.variables.resolve(settings, &self.path, &self.base, cwd)?;
        // Flags that hold for every subcommand are handed down only when the command is built.
        let mut root = root.clone();
        root.build();
        let folders = arguments::Folders { base: &self.base, cwd };
        let mut steps = Vec::new();
        for raw in &self.steps {
            for values in raw.times(&values)? {
                let number = steps.len() + 1;
                steps.push(Step::resolve(raw, number, &values, &root, folders)?);
            }
        }
        let closing = match &self.closing {
            Some((text, place)) => {
                // Shown to a person, so paths below the current folder lose its name.
                let here = format!("{}/", cwd.display());
                Some(values.fill(text, "closing", place)?.text().replace(&here, ""))
            }
            None => None,
        };
        Ok(Chain { steps, closing })
    }

    fn define(&mut self, file: &File<'_>, table: &DeTable<'_>, paths: bool) -> Result<(), Error> {
        for (key, value) in in_file_order(table) {
            let place = file.place(key.span().start);
            let name = key.get_ref().as_ref();
            let wrong = |expected: &str, found| Error::WrongType {
                place: place.clone(),
                key: name.to_owned(),
                expected: expected.to_owned(),
                found,
            };
            let scalar = match Scalar::from_toml(value.get_ref()) {
                Ok(Scalar::Text(text)) => Scalar::Text(text),
                Ok(other) if paths => return Err(wrong("a path in quotes", other.kind())),
                Ok(other) => other,
                Err(found) => return Err(wrong("a text, a number, true or false", found)),
            };
            self.variables.define(name, scalar, place, paths)?;
        }
        Ok(())
    }
}

fn raw_step(file: &File<'_>, number: usize, step: &Spanned<DeValue<'_>>) -> Result<RawStep, Error> {
    let mut place = file.place(step.span().start);
    place.step = Some((number, "".into()));
    let Some(table) = step.get_ref().as_table() else {
        return Err(Error::WrongType {
            place,
            key: "step".to_owned(),
            expected: "written as [[step]]".to_owned(),
            found: kind(step.get_ref()),
        });
    };
    let command = match table.get("command") {
        Some(command) => {
            place.line = file.line(command.span().start);
            command.get_ref().as_str().ok_or_else(|| Error::WrongType {
                place: place.clone(),
                key: "command".to_owned(),
                expected: "a text".to_owned(),
                found: kind(command.get_ref()),
            })?
        }
        None => return Err(Error::MissingCommand { place }),
    };
    let command: Vec<String> = command.split_whitespace().map(ToOwned::to_owned).collect();
    place.step = Some((number, command.join(" ").into()));
    let (mut parameters, mut each) = (Vec::new(), Vec::new());
    for (key, value) in in_file_order(table) {
        let name = key.get_ref().as_ref();
        let line = file.line(key.span().start);
        match name {
            "command" => continue,
            "each" => {
                each = combinations(file, &Place { line, ..place.clone() }, value.get_ref())?;
                continue;
            }
            _ => {}
        }
        let value = Value::from_toml(value.get_ref()).map_err(|found| Error::WrongType {
            place: Place { line, ..place.clone() },
            key: name.to_owned(),
            expected: "a text, a number, true, false, or a list of those".to_owned(),
            found,
        })?;
        parameters.push((name.to_owned(), value, line));
    }
    Ok(RawStep { command, place, each, parameters })
}

/// The table `each` of a step: names, the values of each, and their lines.
fn combinations(
    file: &File<'_>,
    place: &Place,
    each: &DeValue<'_>,
) -> Result<Vec<(String, Vec<Scalar>, usize)>, Error> {
    let wrong = |line, key: &str, expected: &str, found| Error::WrongType {
        place: Place { line, ..place.clone() },
        key: key.to_owned(),
        expected: expected.to_owned(),
        found,
    };
    let DeValue::Table(table) = each else {
        let expected = "a table of lists, as { seed = [1, 2, 3] }";
        return Err(wrong(place.line, "each", expected, kind(each)));
    };
    let mut all = Vec::new();
    for (key, value) in in_file_order(table) {
        let (name, line) = (key.get_ref().as_ref(), file.line(key.span().start));
        let list = match Value::from_toml(value.get_ref()) {
            Ok(Value::List(list)) if list.is_empty() => Err("an empty list"),
            Ok(Value::List(list)) => Ok(list),
            Ok(one) => Err(one.kind()),
            Err(found) => Err(found),
        };
        let list = list.map_err(|found| {
            wrong(line, name, "a list of texts, numbers, true or false, with at least one", found)
        })?;
        all.push((name.to_owned(), list, line));
    }
    Ok(all)
}

/// The entries of a table in the order in which they are written.
fn in_file_order<'t, 'i>(
    table: &'t DeTable<'i>,
) -> Vec<(&'t Spanned<std::borrow::Cow<'i, str>>, &'t Spanned<DeValue<'i>>)> {
    let mut entries: Vec<_> = table.iter().collect();
    entries.sort_by_key(|(key, _)| key.span().start);
    entries
}

/// A recipe's text, to turn positions into lines.
struct File<'a> {
    path: &'a Path,
    text: &'a str,
}

impl File<'_> {
    fn line(&self, position: usize) -> usize {
        let position = position.min(self.text.len());
        self.text.as_bytes()[..position].iter().filter(|byte| **byte == b'\n').count() + 1
    }

    fn place(&self, position: usize) -> Place {
        Place { path: self.path.into(), line: self.line(position), step: None }
    }
}

#[cfg(test)]
mod tests;
