//! The variables of a recipe: `[paths]` and `[variables]`, used as `${name}`.

use super::error::{Error, Place};
use super::value::Scalar;
use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};

/// One variable as defined in the recipe.
#[derive(Clone, Debug)]
struct Variable {
    value: Scalar,
    place: Place,
    /// From `[paths]`: relative values belong to the recipe's folder.
    path: bool,
}

/// All variables of a recipe.
#[derive(Clone, Debug, Default)]
pub(super) struct Variables(BTreeMap<String, Variable>);

impl Variables {
    pub(super) fn define(
        &mut self,
        name: &str,
        value: Scalar,
        place: Place,
        path: bool,
    ) -> Result<(), Error> {
        if self.0.contains_key(name) {
            return Err(Error::DefinedTwice { place, name: name.to_owned() });
        }
        self.0.insert(name.to_owned(), Variable { value, place, path });
        Ok(())
    }

    fn names(&self) -> Vec<String> {
        self.0.keys().cloned().collect()
    }

    /// The variables with their final values: `settings` (`name=value`, as `--set` gives them)
    /// replace the recipe's, and uses of other variables are filled in.
    ///
    /// Relative paths of the recipe belong to `base` (its folder), those of `settings` to `cwd`.
    pub(super) fn resolve(
        &self,
        settings: &[String],
        recipe: &Path,
        base: &Path,
        cwd: &Path,
    ) -> Result<Values, Error> {
        let mut variables = self.clone();
        for setting in settings {
            let (name, value) = setting
                .split_once('=')
                .ok_or_else(|| Error::SettingForm { setting: setting.clone() })?;
            let name = name.trim();
            let Some(variable) = variables.0.get_mut(name) else {
                return Err(Error::SettingName {
                    path: recipe.to_owned(),
                    name: name.to_owned(),
                    known: self.names(),
                });
            };
            // A `$` on the command line is the shell's business, not a use of a variable.
            let value = value.replace("${", "$${");
            variable.value = match (&variable.value, value.as_str()) {
                (Scalar::Boolean(_), "true") => Scalar::Boolean(true),
                (Scalar::Boolean(_), "false") => Scalar::Boolean(false),
                _ if variable.path => {
                    Scalar::Text(join(cwd, &value).to_string_lossy().into_owned())
                }
                // Whether it is a number is for the step that uses it to say.
                _ => Scalar::Text(value),
            };
        }
        let mut values = Values(BTreeMap::new());
        for name in variables.0.keys() {
            variables.value_of(name, base, &mut values, &mut Vec::new())?;
        }
        Ok(values)
    }

    /// Resolves one variable and, before it, those that it uses.
    fn value_of(
        &self,
        name: &str,
        base: &Path,
        values: &mut Values,
        open: &mut Vec<String>,
    ) -> Result<(), Error> {
        let Some(variable) = self.0.get(name) else { return Ok(()) };
        if values.0.contains_key(name) {
            return Ok(());
        }
        let place = variable.place.clone();
        if open.iter().any(|n| n == name) {
            open.push(name.to_owned());
            return Err(Error::Cycle { place, name: name.to_owned(), chain: open.join(" -> ") });
        }
        open.push(name.to_owned());
        if let Scalar::Text(text) = &variable.value {
            for part in parts(text, name, &place)? {
                match part {
                    Part::Variable(used) if !self.0.contains_key(used) => {
                        return Err(Error::UnknownVariable {
                            place,
                            key: name.to_owned(),
                            name: used.to_owned(),
                            known: self.names(),
                        });
                    }
                    Part::Variable(used) => self.value_of(used, base, values, open)?,
                    Part::Text(_) => {}
                }
            }
        }
        let mut value = values.fill(&variable.value, name, &place)?;
        if let (true, Scalar::Text(text)) = (variable.path, &value) {
            value = Scalar::Text(join(base, text).to_string_lossy().into_owned());
        }
        open.pop();
        values.0.insert(name.to_owned(), value);
        Ok(())
    }
}

/// Variables with their final values.
#[derive(Clone, Debug)]
pub(super) struct Values(BTreeMap<String, Scalar>);

impl Values {
    /// Whether there is a variable of this name.
    pub(super) fn has(&self, name: &str) -> bool {
        self.0.contains_key(name)
    }

    /// These, and one more.
    pub(super) fn with(&self, name: &str, value: Scalar) -> Self {
        let mut more = self.clone();
        more.0.insert(name.to_owned(), value);
        more
    }

    /// `value` with every `${name}` filled in. A text that is one variable and nothing else takes
    /// that variable's type, so that `zoom = "${zoom}"` stays a number.
    pub(super) fn fill(&self, value: &Scalar, key: &str, place: &Place) -> Result<Scalar, Error> {
        let Scalar::Text(text) = value else { return Ok(value.clone()) };
        let get = |name: &str| {
            self.0.get(name).ok_or_else(|| Error::UnknownVariable {
                place: place.clone(),
                key: key.to_owned(),
                name: name.to_owned(),
                known: self.0.keys().cloned().collect(),
            })
        };
        let parts = parts(text, key, place)?;
        if let [Part::Variable(name)] = parts[..] {
            return get(name).cloned();
        }
        let mut filled = String::new();
        for part in parts {
            match part {
                Part::Text(text) => filled.push_str(text),
                Part::Variable(name) => filled.push_str(&get(name)?.text()),
            }
        }
        Ok(Scalar::Text(filled))
    }
}

enum Part<'a> {
    Text(&'a str),
    Variable(&'a str),
}

/// Cuts a text at its `${name}`; `$${` is a literal `${`.
fn parts<'a>(text: &'a str, key: &str, place: &Place) -> Result<Vec<Part<'a>>, Error> {
    let mut parts = Vec::new();
    let mut rest = text;
    while let Some(at) = rest.find("${") {
        if rest[..at].ends_with('$') {
            parts.push(Part::Text(&rest[..at - 1]));
            parts.push(Part::Text("${"));
            rest = &rest[at + 2..];
            continue;
        }
        let end = rest[at..].find('}').ok_or_else(|| Error::Unterminated {
            place: place.clone(),
            key: key.to_owned(),
            text: text.to_owned(),
        })?;
        if at > 0 {
            parts.push(Part::Text(&rest[..at]));
        }
        parts.push(Part::Variable(rest[at + 2..at + end].trim()));
        rest = &rest[at + end + 1..];
    }
    if !rest.is_empty() {
        parts.push(Part::Text(rest));
    }
    Ok(parts)
}

/// `base/relative` without `.`, and with the leading `..` of `relative` taken off `base`, which is
/// canonical: there a `..` is the parent folder and no way through a symbolic link.
pub(super) fn join(base: &Path, relative: &str) -> PathBuf {
    let relative = Path::new(relative);
    if relative.is_absolute() {
        return relative.to_owned();
    }
    let mut joined = base.to_owned();
    let mut leading = true;
    for component in relative.components() {
        match component {
            Component::CurDir => {}
            Component::ParentDir if leading => {
                joined.pop();
            }
            other => {
                leading = false;
                joined.push(other);
            }
        }
    }
    joined
}

#[cfg(test)]
mod tests {
    use super::*;

    fn place() -> Place {
        Place { path: Path::new("r.toml").into(), line: 1, step: None }
    }

    fn variables(list: &[(&str, &str, bool)]) -> Variables {
        let mut variables = Variables::default();
        for (name, value, path) in list {
            let value = Scalar::Text((*value).to_owned());
            variables.define(name, value, place(), *path).expect("defined once");
        }
        variables
    }

    fn resolve(list: &[(&str, &str, bool)], settings: &[&str]) -> Result<Values, Error> {
        let settings: Vec<String> = settings.iter().map(ToString::to_string).collect();
        let recipe = Path::new("r.toml");
        variables(list).resolve(&settings, recipe, Path::new("/base/here"), Path::new("/cwd"))
    }

    fn fill(values: &Values, text: &str) -> String {
        values.fill(&Scalar::Text(text.into()), "key", &place()).expect("fills").text()
    }

    #[test]
    fn variables_use_each_other_in_any_order_and_paths_belong_to_the_recipe() {
        let values = resolve(
            &[("a", "${z}/x", true), ("z", "../data", true), ("name", "n-${z}", false)],
            &[],
        )
        .expect("resolves");
        assert_eq!(fill(&values, "${a}"), "/base/data/x");
        assert_eq!(fill(&values, "${name}"), "n-/base/data");
        assert_eq!(fill(&values, "${a}/tile.tif"), "/base/data/x/tile.tif");
        assert_eq!(fill(&values, "cost $${a} $5"), "cost ${a} $5");
    }

    #[test]
    fn settings_replace_values_and_their_paths_belong_to_the_current_folder() {
        let list = [("out", "../demo", true), ("dsm", "${out}/dsm", true)];
        let values = resolve(&list, &["out=here"]).expect("resolves");
        assert_eq!(fill(&values, "${dsm}"), "/cwd/here/dsm");
        let values = resolve(&list, &["out=/abs/${x}"]).expect("resolves");
        assert_eq!(fill(&values, "${dsm}"), "/abs/${x}/dsm");
        assert!(matches!(resolve(&list, &["ou=x"]), Err(Error::SettingName { .. })));
        assert!(matches!(resolve(&list, &["out"]), Err(Error::SettingForm { .. })));
    }

    #[test]
    fn bad_uses_are_refused() {
        let cycle = resolve(&[("a", "${b}", false), ("b", "x${a}", false)], &[]);
        assert!(
            matches!(&cycle, Err(Error::Cycle { chain, .. }) if chain == "a -> b -> a"),
            "{cycle:?}"
        );
        assert!(matches!(
            resolve(&[("a", "${no}", false)], &[]),
            Err(Error::UnknownVariable { .. })
        ));
        assert!(matches!(resolve(&[("a", "x${no", false)], &[]), Err(Error::Unterminated { .. })));
    }

    #[test]
    fn joining_keeps_inner_parents() {
        let base = Path::new("/a/b");
        assert_eq!(join(base, "./../c/../d"), Path::new("/a/c/../d"));
        assert_eq!(join(base, "/x"), Path::new("/x"));
        assert_eq!(join(base, "."), base);
    }
}
