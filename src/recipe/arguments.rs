//! A step of a recipe as the arguments of its command.

use super::RawStep;
use super::error::{Error, Place};
use super::value::{Scalar, Value};
use super::variables::{Values, join};
use clap::{Arg, ArgAction, Command};
use sat3d_model::weights::BuiltIn;
use std::any::TypeId;
use std::path::{Path, PathBuf};

/// Commands that make no sense inside a chain.
const NO_STEPS: [&str; 3] = ["run", "completions", "help"];

/// Arguments that `sat3d run` gives to all its steps, or to none.
const WHOLE_CHAIN: [&str; 7] = ["explain", "json", "verbose", "quiet", "log", "help", "version"];

/// Arguments that name what a step makes, not what it needs.
const OUTPUTS: [&str; 7] = ["out", "output", "report", "csv", "parquet", "errors", "parts"];

/// Folders that relative paths belong to.
#[derive(Clone, Copy, Debug)]
pub(super) struct Folders<'a> {
    /// The recipe's.
    pub(super) base: &'a Path,
    /// The process's: paths below it are shown without it.
    pub(super) cwd: &'a Path,
}

impl Folders<'_> {
    /// A path of the recipe, as short as it can be said from the current folder.
    fn path(&self, text: &str) -> PathBuf {
        let path = join(self.base, text);
        match path.strip_prefix(self.cwd) {
            Ok(rest) if rest.as_os_str().is_empty() => PathBuf::from("."),
            Ok(rest) => rest.to_owned(),
            Err(_) => path,
        }
    }
}

/// A path among a step's arguments.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PathArgument {
    /// Key in the recipe, for example `lidar`.
    pub key: String,
    /// Relative to the current folder where it lies below it.
    pub path: PathBuf,
    /// Whether the step writes there (`out`, `output`).
    pub output: bool,
}

/// A step that is ready to run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Step {
    /// From 1; a step of the recipe with `each` counts as often as it runs.
    pub number: usize,
    /// `["dsm-bench", "build"]`.
    pub command: Vec<String>,
    /// Everything after the command.
    pub arguments: Vec<String>,
    /// The paths among them.
    pub paths: Vec<PathArgument>,
    /// Whether the command has `--explain`.
    pub explains: bool,
    /// Whether the command has `--json`.
    pub json: bool,
    place: Place,
}

impl Step {
    pub(super) fn resolve(
        raw: &RawStep,
        number: usize,
        values: &Values,
        root: &Command,
        folders: Folders<'_>,
    ) -> Result<Self, Error> {
        let command = find(raw, root)?;
        let mut flags: Vec<String> = Vec::new();
        let mut positionals: Vec<(usize, Vec<String>)> = Vec::new();
        let mut paths = Vec::new();
        for (key, value, line) in &raw.parameters {
            let place = Place { line: *line, ..raw.place.clone() };
            if WHOLE_CHAIN.contains(&key.as_str()) {
                return Err(Error::WholeChain { place, key: key.clone() });
            }
            let arg = command
                .get_arguments()
                .filter(|arg| !belongs_to_the_chain(arg))
                .find(|arg| keys(arg).contains(key))
                .ok_or_else(|| Error::UnknownKey {
                    place: place.clone(),
                    key: key.clone(),
                    known: known_keys(command),
                })?;
            let value = fill(value, key, values, &place)?;
            if let (Some(name), Value::One(Scalar::Boolean(on))) = (optional_value(arg), &value) {
                flags.extend(on.then_some(name));
                continue;
            }
            let is_path = arg.get_value_parser().type_id() == TypeId::of::<PathBuf>();
            let texts = texts(arg, key, &value, &place)?;
            let texts: Vec<String> = if is_path && arg.get_action().takes_values() {
                let full = texts.into_iter().map(|text| {
                    // A name where a folder could stand.
                    if BuiltIn::named(&text).is_some() {
                        return text;
                    }
                    let path = folders.path(&text);
                    let text = path.to_string_lossy().into_owned();
                    let output = OUTPUTS.contains(&arg.get_id().as_str());
                    paths.push(PathArgument { key: key.clone(), path, output });
                    text
                });
                full.collect()
            } else {
                texts
            };
            match arg.get_index() {
                Some(index) => positionals.push((index, texts)),
                None => flag(arg, &texts, &mut flags),
            }
        }
        positionals.sort_by_key(|(index, _)| *index);
        let mut arguments: Vec<String> =
            positionals.into_iter().flat_map(|(_, texts)| texts).collect();
        // Behind `--` a text that starts with a dash is no flag.
        if arguments.iter().any(|text| text.starts_with('-')) {
            flags.push("--".to_owned());
            flags.append(&mut arguments);
            arguments = flags;
        } else {
            arguments.append(&mut flags);
        }
        let has = |name: &str| command.get_arguments().any(|arg| arg.get_long() == Some(name));
        Ok(Self {
            number,
            command: raw.command.clone(),
            arguments,
            paths,
            explains: has("explain"),
            json: has("json"),
            place: raw.place.clone(),
        })
    }

    /// The whole command line: program, command, `extra` flags, arguments.
    pub fn words<'a>(&'a self, extra: &'a [&'a str]) -> impl Iterator<Item = &'a str> {
        let command = self.command.iter().map(String::as_str);
        let arguments = self.arguments.iter().map(String::as_str);
        // Before the arguments: behind a `--` among them a flag would be none.
        std::iter::once("sat3d").chain(command).chain(extra.iter().copied()).chain(arguments)
    }

    /// The command line as one would type it.
    #[must_use]
    pub fn command_line(&self) -> String {
        let words: Vec<String> = self.words(&[]).map(quoted).collect();
        words.join(" ")
    }

    /// The error of the command's own parser, with the place in the recipe.
    #[must_use]
    pub fn refused(&self, error: &clap::Error) -> Error {
        let text = error.render().to_string();
        let told = text.split("\n\nUsage:").next().unwrap_or_default();
        let told = told.split("\n\nFor more information").next().unwrap_or_default();
        let lines: Vec<&str> = told.lines().map(str::trim).filter(|l| !l.is_empty()).collect();
        let message = lines.join(" ");
        let message = message.strip_prefix("error: ").unwrap_or(&message).to_owned();
        Error::Arguments { place: self.place.clone(), message }
    }

    /// The first path that this step needs, that does not exist, and that an earlier step makes.
    #[must_use]
    pub fn waits_for<'a>(&'a self, earlier: &'a [Self]) -> Option<(&'a Path, &'a Self)> {
        self.paths.iter().filter(|path| !path.output && !path.path.exists()).find_map(|path| {
            let makes = |made: &&PathArgument| made.output && path.path.starts_with(&made.path);
            let maker = earlier.iter().find(|step| step.paths.iter().any(|p| makes(&p)))?;
            Some((path.path.as_path(), maker))
        })
    }
}

/// A word as a POSIX shell needs it.
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_alphanumeric() || "-_./=:,+@%".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        word.to_owned()
    } else {
        format!("'{}'", word.replace('\'', r"'\''"))
    }
}

/// The command of a step.
fn find<'a>(raw: &RawStep, root: &'a Command) -> Result<&'a Command, Error> {
    let unknown = || Error::UnknownCommand {
        place: raw.place.clone(),
        command: raw.command.join(" "),
        known: commands(root, ""),
    };
    let mut command = root;
    for word in &raw.command {
        command = command.find_subcommand(word).ok_or_else(unknown)?;
    }
    let first = raw.command.first().map_or("", String::as_str);
    if NO_STEPS.contains(&first) || !works_alone(command) {
        return Err(unknown());
    }
    Ok(command)
}

/// Whether a command does something without a subcommand: it has none, or takes arguments of its own
/// in their place (`eval` beside `eval merge`).
fn works_alone(command: &Command) -> bool {
    !command.has_subcommands() || command.is_args_conflicts_with_subcommands_set()
}

/// Every command that a step can run, in full.
fn commands(command: &Command, prefix: &str) -> Vec<String> {
    command
        .get_subcommands()
        .filter(|sub| !sub.is_hide_set() && !NO_STEPS.contains(&sub.get_name()))
        .flat_map(|sub| {
            let name = format!("{prefix}{}", sub.get_name());
            let below = commands(sub, &format!("{name} "));
            works_alone(sub).then_some(name).into_iter().chain(below)
        })
        .collect()
}

fn belongs_to_the_chain(arg: &Arg) -> bool {
    WHOLE_CHAIN.contains(&arg.get_id().as_str())
}

/// The keys by which a recipe can name an argument: its long flags, or its name where it has none.
fn keys(arg: &Arg) -> Vec<String> {
    let mut keys: Vec<String> = arg.get_long().map(str::to_owned).into_iter().collect();
    keys.extend(arg.get_all_aliases().unwrap_or_default().into_iter().map(str::to_owned));
    if keys.is_empty() {
        keys.push(arg.get_id().as_str().replace('_', "-"));
    }
    keys
}

fn known_keys(command: &Command) -> Vec<String> {
    command
        .get_arguments()
        .filter(|arg| !belongs_to_the_chain(arg) && !arg.is_hide_set())
        .filter_map(|arg| keys(arg).into_iter().next())
        .collect()
}

fn fill(value: &Value, key: &str, values: &Values, place: &Place) -> Result<Value, Error> {
    Ok(match value {
        Value::One(scalar) => Value::One(values.fill(scalar, key, place)?),
        Value::List(list) => Value::List(
            list.iter().map(|item| values.fill(item, key, place)).collect::<Result<_, _>>()?,
        ),
    })
}

/// The flag, if it may be given without its value: `true` then means that it is.
fn optional_value(arg: &Arg) -> Option<String> {
    let optional = arg.get_num_args().is_some_and(|range| range.min_values() == 0);
    let long = arg.get_long().filter(|_| optional && arg.get_action().takes_values())?;
    Some(format!("--{long}"))
}

/// The texts that an argument takes for a value; for a switch, one text per time it is given.
fn texts(arg: &Arg, key: &str, value: &Value, place: &Place) -> Result<Vec<String>, Error> {
    let wrong = |expected: &str| Error::WrongType {
        place: place.clone(),
        key: key.to_owned(),
        expected: expected.to_owned(),
        found: value.kind(),
    };
    match (arg.get_action(), value) {
        (ArgAction::SetTrue, Value::One(Scalar::Boolean(on))) => Ok(times(usize::from(*on))),
        // Given, such a flag turns something off; it has the name of what is turned off.
        (ArgAction::SetFalse, Value::One(Scalar::Boolean(on))) => Ok(times(usize::from(*on))),
        (ArgAction::SetTrue | ArgAction::SetFalse, _) => {
            Err(wrong("true or false: it is a switch"))
        }
        (ArgAction::Count, Value::One(Scalar::Number(count))) => {
            let count = count.parse::<u8>().map_err(|_| wrong("a small whole number"))?;
            Ok(times(count.into()))
        }
        (ArgAction::Count, _) => Err(wrong("a number: how many times the flag is given")),
        (_, Value::One(scalar)) => Ok(vec![scalar.text()]),
        (ArgAction::Append, Value::List(list)) => Ok(list.iter().map(Scalar::text).collect()),
        (_, Value::List(list)) => {
            let many = arg.get_num_args().is_some_and(|range| range.max_values() > 1);
            if many || arg.get_value_delimiter().is_some() {
                Ok(list.iter().map(Scalar::text).collect())
            } else {
                Err(wrong("one value"))
            }
        }
    }
}

fn times(count: usize) -> Vec<String> {
    vec![String::new(); count]
}

/// Writes a flag with its values.
fn flag(arg: &Arg, texts: &[String], out: &mut Vec<String>) {
    let Some(long) = arg.get_long() else { return };
    let name = format!("--{long}");
    if !arg.get_action().takes_values() {
        out.extend(texts.iter().map(|_| name.clone()));
        return;
    }
    // A value that starts with a dash must hang on its flag, lest it be taken for one.
    let one = |text: &String, out: &mut Vec<String>| {
        if text.starts_with('-') || arg.is_require_equals_set() {
            out.push(format!("{name}={text}"));
        } else {
            out.extend([name.clone(), text.clone()]);
        }
    };
    match (arg.get_action(), arg.get_value_delimiter()) {
        (_, Some(delimiter)) if !texts.is_empty() => {
            one(&texts.join(&delimiter.to_string()), out);
        }
        (ArgAction::Append, _) => texts.iter().for_each(|text| one(text, out)),
        _ => {
            if let Some((first, rest)) = texts.split_first() {
                one(first, out);
                out.extend_from_slice(rest);
            }
        }
    }
}
