//! The cache of the Hugging Face hub on disk, in the layout of its Python library `huggingface_hub`:
//!
//! ```text
//! models--qian43--Sat3DGen/blobs/<etag>            the files' contents
//! models--qian43--Sat3DGen/snapshots/<commit>/...  the files' names, links to blobs
//! models--qian43--Sat3DGen/refs/main               the commit of a branch
//! .locks/models--qian43--Sat3DGen/<etag>.lock      held while a blob is written
//! ```
//!
//! So weights that Python fetched are found here, and the other way round.

use std::ffi::OsString;
use std::io;
use std::path::{Path, PathBuf};

/// A cache folder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Cache {
    folder: PathBuf,
}

impl Cache {
    /// The cache in a folder, whether it exists or not.
    #[must_use]
    pub fn new(folder: &Path) -> Self {
        Self { folder: folder.into() }
    }

    /// The cache that the environment names, as `huggingface_hub` reads it: `HF_HUB_CACHE`, else
    /// `HUGGINGFACE_HUB_CACHE`, else `hub` in `HF_HOME`, else `huggingface/hub` in `XDG_CACHE_HOME`,
    /// else `~/.cache/huggingface/hub`; `~`, `$NAME` and `${NAME}` in them are expanded. Empty
    /// variables count as not set. `None` where there is no home folder either.
    #[must_use]
    pub fn from_environment() -> Option<Self> {
        Self::from_variables(&|name| std::env::var_os(name))
    }

    pub(super) fn from_variables(get: &dyn Fn(&str) -> Option<OsString>) -> Option<Self> {
        let set = |name: &str| get(name).filter(|value| !value.is_empty());
        let home = set("HOME").map(PathBuf::from).or_else(std::env::home_dir);
        let path = |name: &str| {
            let value = set(name)?;
            // What is not Unicode cannot be a pattern that somebody typed.
            let Some(text) = value.to_str() else { return Some(PathBuf::from(value)) };
            Some(PathBuf::from(expanded(text, home.as_deref(), get)))
        };
        let folder =
            path("HF_HUB_CACHE").or_else(|| path("HUGGINGFACE_HUB_CACHE")).or_else(|| {
                let library = path("HF_HOME").or_else(|| {
                    let caches =
                        path("XDG_CACHE_HOME").or_else(|| Some(home.as_ref()?.join(".cache")));
                    Some(caches?.join("huggingface"))
                });
                Some(library?.join("hub"))
            })?;
        Some(Self { folder })
    }

    /// The cache's folder.
    #[must_use]
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The place of a model repository, as `qian43/Sat3DGen`.
    #[must_use]
    pub fn repository(&self, name: &str) -> Repository {
        let name = format!("models--{}", name.replace('/', "--"));
        Repository { locks: self.folder.join(".locks").join(&name), folder: self.folder.join(name) }
    }
}

/// `~` and variables in a path, as Python's `expanduser` and `expandvars` do. Names of variables that
/// are not set stay as they are.
fn expanded(text: &str, home: Option<&Path>, get: &dyn Fn(&str) -> Option<OsString>) -> String {
    let mut rest = text.to_owned();
    if let (Some(home), Some(after)) = (home.and_then(Path::to_str), text.strip_prefix('~'))
        && (after.is_empty() || after.starts_with('/'))
    {
        rest = format!("{}{after}", home.trim_end_matches('/'));
    }
    let mut out = String::new();
    while let Some(dollar) = rest.find('$') {
        out.push_str(&rest[..dollar]);
        let after = &rest[dollar + 1..];
        let word = |text: &str| {
            text.find(|c: char| !(c.is_ascii_alphanumeric() || c == '_')).unwrap_or(text.len())
        };
        let (name, length) = match after.strip_prefix('{').and_then(|inner| inner.split_once('}')) {
            Some((name, _)) => (name, name.len() + 2),
            None => (&after[..word(after)], word(after)),
        };
        match get(name).filter(|_| !name.is_empty()).and_then(|value| value.into_string().ok()) {
            Some(value) => out.push_str(&value),
            None => out.push_str(&rest[dollar..=dollar + length]),
        }
        rest = after[length..].to_owned();
    }
    out + &rest
}

/// The place of one repository in a cache.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Repository {
    folder: PathBuf,
    locks: PathBuf,
}

impl Repository {
    /// The repository's folder.
    #[must_use]
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The file that holds the commit of a branch or tag.
    #[must_use]
    pub fn reference(&self, revision: &str) -> PathBuf {
        self.folder.join("refs").join(revision)
    }

    /// The folder of a commit's files.
    #[must_use]
    pub fn snapshot(&self, commit: &str) -> PathBuf {
        self.folder.join("snapshots").join(commit)
    }

    /// The contents of a file, by its etag.
    #[must_use]
    pub fn blob(&self, etag: &str) -> PathBuf {
        self.folder.join("blobs").join(etag)
    }

    /// The file that is locked while a blob is written.
    #[must_use]
    pub fn lock(&self, etag: &str) -> PathBuf {
        self.locks.join(format!("{etag}.lock"))
    }

    /// The commit that a branch or tag was at when it was last fetched; `None` where it never was.
    ///
    /// # Errors
    /// The file is there and cannot be read, or holds no commit.
    pub fn commit(&self, revision: &str) -> io::Result<Option<String>> {
        match std::fs::read_to_string(self.reference(revision)) {
            Ok(text) if is_commit(text.trim()) => Ok(Some(text.trim().to_owned())),
            Ok(text) => Err(io::Error::other(format!(
                "`{}` is no commit (40 hexadecimal digits); delete the file and fetch again",
                text.trim().chars().take(60).collect::<String>()
            ))),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }
}

/// Whether a text is a full commit hash.
#[must_use]
pub fn is_commit(text: &str) -> bool {
    text.len() == 40 && text.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'))
}

/// The snapshot that a repository's folder in a cache stands for: the one of `main`, or the only one.
pub(super) fn only_snapshot(folder: &Path) -> Option<PathBuf> {
    let snapshots = folder.join("snapshots");
    let main = std::fs::read_to_string(folder.join("refs").join(super::REVISION));
    if let Ok(commit) = main {
        return is_commit(commit.trim()).then(|| snapshots.join(commit.trim()));
    }
    let mut entries = std::fs::read_dir(snapshots).ok()?.filter_map(Result::ok);
    match (entries.next(), entries.next()) {
        (Some(entry), None) => Some(entry.path()),
        _ => None,
    }
}
