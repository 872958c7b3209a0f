//! What a repository says about its licence.

use serde::Serialize;
use serde_json::Value;

/// The licence of a repository, from every place where one may be stated.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Licence {
    /// In the repository's metadata: an identifier as `mit`, or `other`.
    pub stated: Option<String>,
    /// Name of a licence that is `other`.
    pub name: Option<String>,
    /// Where its text is.
    pub link: Option<String>,
    /// In the head of README.md, where that says another one.
    pub readme: Option<String>,
    /// Licence files, with their text.
    pub files: Vec<LicenceFile>,
}

/// A licence file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct LicenceFile {
    /// Name in the repository.
    pub path: String,
    /// Its text.
    pub text: String,
}

impl Licence {
    /// Puts together what the metadata (`cardData`), README.md and licence files say.
    pub(super) fn new(card: &Value, readme: &str, files: Vec<LicenceFile>) -> Self {
        let of_card = |key: &str| match card.get(key) {
            Some(Value::String(text)) if !text.is_empty() => Some(text.clone()),
            Some(Value::Array(list)) => {
                let list: Vec<&str> = list.iter().filter_map(Value::as_str).collect();
                (!list.is_empty()).then(|| list.join(", "))
            }
            _ => None,
        };
        let of_readme = |key| front_matter(readme, key);
        let stated = of_card("license");
        Self {
            readme: of_readme("license").filter(|own| stated.as_ref() != Some(own)),
            name: of_card("license_name").or_else(|| of_readme("license_name")),
            link: of_card("license_link").or_else(|| of_readme("license_link")),
            stated,
            files,
        }
    }

    /// The licence in one line.
    #[must_use]
    pub fn line(&self) -> String {
        let mut parts = Vec::new();
        if let Some(stated) = &self.stated {
            let name = self.name.as_ref().map(|name| format!(" ({name})")).unwrap_or_default();
            parts.push(format!("{stated}{name} in the repository's metadata"));
        }
        if let Some(readme) = &self.readme {
            parts.push(format!("{readme} in README.md"));
        }
        parts.extend(self.link.iter().cloned());
        parts.extend(self.files.iter().map(|file| format!("text in {}", file.path)));
        if parts.is_empty() { "none stated".into() } else { parts.join("; ") }
    }
}

/// A value at the head of a model card: `key: value` between two lines of dashes.
fn front_matter(readme: &str, key: &str) -> Option<String> {
    let mut lines = readme.trim_start_matches('\u{feff}').lines();
    if lines.next()?.trim_end() != "---" {
        return None;
    }
    lines
        .take_while(|line| line.trim_end() != "---")
        .find_map(|line| line.strip_prefix(key)?.strip_prefix(':'))
        .map(|value| value.trim().trim_matches(['"', '\'']).to_owned())
        .filter(|value| !value.is_empty())
}

/// Whether a file at the root of a repository is a licence or belongs to one.
pub(super) fn is_licence(path: &str) -> bool {
    let name = path.to_ascii_uppercase();
    let stem = name.split('.').next().unwrap_or_default();
    !path.contains('/')
        && ["LICENSE", "LICENCE", "NOTICE", "COPYING"].iter().any(|word| stem.starts_with(word))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn every_place_is_read_and_a_contradiction_is_shown() {
        let readme = "---\nlicense: 'mit'\ntags:\n- license: no\n---\nlicense: apache-2.0\n";
        let licence = Licence::new(&json!({"license": "mit"}), readme, Vec::new());
        assert_eq!(licence.line(), "mit in the repository's metadata");
        let licence = Licence::new(&json!({"license": "other"}), readme, Vec::new());
        assert_eq!(licence.line(), "other in the repository's metadata; mit in README.md");
        let file = LicenceFile { path: "LICENSE.txt".into(), text: String::new() };
        let card = json!({"license": ["a", "b"], "license_name": "c", "license_link": "https://d"});
        let licence = Licence::new(&card, "license: mit\n", vec![file]);
        let expected = "a, b (c) in the repository's metadata; https://d; text in LICENSE.txt";
        assert_eq!(licence.line(), expected);
        assert_eq!(Licence::new(&Value::Null, "", Vec::new()).line(), "none stated");
    }

    #[test]
    fn licence_files_are_known_by_name() {
        for name in ["LICENSE", "license.md", "LICENCE", "LICENSE-APACHE", "NOTICE.txt"] {
            assert!(is_licence(name), "{name}");
        }
        for name in ["src/LICENSE", "README.md", "config.json"] {
            assert!(!is_licence(name), "{name}");
        }
    }
}
