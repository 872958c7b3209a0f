//! Weights from a Hugging Face hub into its cache, in the layout of `huggingface_hub`.
//!
//! First a [`Plan`]: the commit, the files that a checkpoint needs, their sizes and hashes, and the
//! licence. Nothing is written before it is carried out. Then each file is received beside its place,
//! checked, and given its name; the weights come last of the files, and the branch is moved to the
//! commit when all of them are there. So nobody meets half a checkpoint.

mod blob;
mod error;
mod hub;
mod licence;

pub use error::FetchError;
pub use hub::Hub;
pub use licence::{Licence, LicenceFile};

use crate::batch::{Interrupt, Progress, write_atomic};
use crate::weights::cache::{Cache, Repository, is_commit};
use blob::Store;
use sat3d_model::weights::WEIGHTS_FILE;
use serde::Serialize;
use serde_json::Value;
use std::cell::Cell;
use std::path::{Path, PathBuf};

/// What is wanted of a hub.
#[derive(Clone, Debug)]
pub struct Wanted {
    /// Name on the hub, as `qian43/Sat3DGen`.
    pub repository: String,
    /// Branch, tag or commit.
    pub revision: String,
    /// Folder of the checkpoint in the repository, where there are several.
    pub subfolder: Option<String>,
}

/// A file that a checkpoint needs.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct RemoteFile {
    /// Name in the repository, with `/` between folders.
    pub path: String,
    /// Bytes.
    pub size: u64,
    /// SHA-256, which a hub knows of its large files.
    pub sha256: Option<String>,
    /// Git's hash of a small file (SHA-1 over `blob`, size and contents).
    pub git: Option<String>,
    /// Name of the contents in the cache.
    pub etag: String,
}

/// A file that is in the cache now.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct FetchedFile {
    /// Name in the repository.
    pub path: String,
    /// Bytes.
    pub size: u64,
    /// SHA-256 of the contents, as computed here.
    pub sha256: String,
    /// Bytes that came over the network; 0 where the cache had the file.
    pub received: u64,
}

impl FetchedFile {
    fn new(file: &RemoteFile, sha256: String, received: u64) -> Self {
        Self { path: file.path.clone(), size: file.size, sha256, received }
    }
}

/// What is in the cache after a fetch.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Fetched {
    /// The checkpoint's folder.
    pub folder: PathBuf,
    /// Its files, and those beside them.
    pub files: Vec<FetchedFile>,
}

/// What a fetch will do.
#[derive(Clone, Debug)]
pub struct Plan {
    /// As wanted.
    pub wanted: Wanted,
    /// The commit that the revision is at.
    pub commit: String,
    /// What the repository says about its licence.
    pub licence: Licence,
    /// The files, the weights last.
    pub files: Vec<RemoteFile>,
    /// Folder of the checkpoint in the repository; empty for its root.
    pub subfolder: String,
    cache: Cache,
    place: Repository,
}

impl Hub {
    /// Asks what a repository holds. Reads its listing and its licence, writes nothing.
    ///
    /// # Errors
    /// [`FetchError::Value`] for names that are none; [`FetchError::Network`],
    /// [`FetchError::Refused`] and [`FetchError::Answer`] of the hub; [`FetchError::NoCheckpoint`].
    pub fn plan(&self, cache: &Cache, wanted: &Wanted) -> Result<Plan, FetchError> {
        check_names(wanted)?;
        let name = wanted.repository.as_str();
        let listing = self.listing(name, &wanted.revision)?;
        let answer = |why: &str| FetchError::Answer {
            url: format!("{}/api/models/{name}", self.endpoint()),
            why: why.into(),
        };
        let commit = listing.get("sha").and_then(Value::as_str).filter(|commit| is_commit(commit));
        let Some(commit) = commit.map(str::to_owned) else {
            return Err(answer("names no commit (`sha`); is HF_ENDPOINT a Hugging Face hub?"));
        };
        let Some(siblings) = listing.get("siblings").and_then(Value::as_array) else {
            return Err(answer("lists no files (`siblings`)"));
        };
        let listed: Vec<(&str, &Value)> = siblings
            .iter()
            .filter_map(|file| Some((file.get("rfilename")?.as_str()?, file)))
            .collect();
        let paths: Vec<&str> = listed.iter().map(|(path, _)| *path).collect();
        let subfolder = checkpoint_of(&paths, wanted.subfolder.as_deref()).map_err(|why| {
            FetchError::NoCheckpoint { repository: name.into(), commit: commit.clone(), why }
        })?;
        let inside = |file: &str| {
            if subfolder.is_empty() { file.to_owned() } else { format!("{subfolder}/{file}") }
        };
        let about = paths.iter().filter(|path| **path == "README.md" || licence::is_licence(path));
        let mut chosen: Vec<String> = about.map(|path| (*path).to_owned()).collect();
        chosen.sort_unstable();
        let mut licences = Vec::new();
        let mut readme = String::new();
        for path in &chosen {
            let text = self.text(&self.file_url(name, &commit, path))?;
            if path == "README.md" {
                readme = text;
            } else {
                licences.push(LicenceFile { path: path.clone(), text });
            }
        }
        chosen.extend([inside("config.json"), inside(WEIGHTS_FILE)]);
        let mut files = Vec::new();
        for path in chosen {
            let entry = listed.iter().find(|(listed, _)| **listed == path).map(|(_, entry)| *entry);
            let url = self.file_url(name, &commit, &path);
            files.push(remote_file(path, entry.unwrap_or(&Value::Null), &url, &self.head(&url)?)?);
        }
        let card = listing.get("cardData").unwrap_or(&Value::Null);
        Ok(Plan {
            wanted: wanted.clone(),
            licence: Licence::new(card, &readme, licences),
            files,
            subfolder,
            place: cache.repository(name),
            cache: cache.clone(),
            commit,
        })
    }
}

/// What listing and headers say about a file; they must not contradict each other.
fn remote_file(
    path: String,
    entry: &Value,
    url: &str,
    head: &hub::FileHead,
) -> Result<RemoteFile, FetchError> {
    let answer = |why: String| FetchError::Answer { url: url.into(), why };
    let hexadecimal = |text: &str, length: usize| {
        text.len() == length && text.bytes().all(|byte| byte.is_ascii_hexdigit())
    };
    let large = entry.get("lfs").filter(|large| large.is_object());
    let listed = large.and_then(|large| large.get("sha256")).and_then(Value::as_str);
    let listed = listed.filter(|hash| hexadecimal(hash, 64)).map(str::to_ascii_lowercase);
    let of_etag = Some(head.etag.to_ascii_lowercase()).filter(|etag| hexadecimal(etag, 64));
    if let (Some(listed), Some(of_etag)) = (&listed, &of_etag)
        && listed != of_etag
    {
        return Err(answer(format!("the listing says sha256 {listed}, the file {of_etag}")));
    }
    let listed_size = entry.get("size").and_then(Value::as_u64);
    let size = match (listed_size, head.size) {
        (Some(listed), Some(size)) if listed != size => {
            return Err(answer(format!("the listing says {listed} bytes, the file {size}")));
        }
        (listed, of_head) => listed.or(of_head),
    };
    let Some(size) = size else {
        return Err(answer("neither the listing nor the file says how large it is".into()));
    };
    let git = entry.get("blobId").and_then(Value::as_str).filter(|hash| hexadecimal(hash, 40));
    let sha256 = listed.or(of_etag);
    Ok(RemoteFile {
        path,
        size,
        // Of a large file, Git's hash is that of a note in its place.
        git: git.filter(|_| sha256.is_none()).map(str::to_owned),
        sha256,
        etag: head.etag.clone(),
    })
}

impl Plan {
    /// The folder that will hold the checkpoint.
    #[must_use]
    pub fn folder(&self) -> PathBuf {
        let snapshot = self.place.snapshot(&self.commit);
        if self.subfolder.is_empty() { snapshot } else { snapshot.join(&self.subfolder) }
    }

    /// Bytes that the cache lacks.
    #[must_use]
    pub fn missing(&self) -> u64 {
        let snapshot = self.place.snapshot(&self.commit);
        let lacks = |file: &RemoteFile| {
            let present = |path: &Path| blob::size(path) == Some(file.size);
            if present(&self.place.blob(&file.etag)) || present(&snapshot.join(&file.path)) {
                return 0;
            }
            let partial = self.place.blob(&format!("{}.incomplete", file.etag));
            file.size - blob::size(&partial).filter(|size| *size <= file.size).unwrap_or(0)
        };
        self.files.iter().map(lacks).sum()
    }

    /// Carries the plan out. Every file is hashed, also those that the cache has; a damaged one is
    /// fetched anew, a partial one is continued.
    ///
    /// # Errors
    /// [`FetchError::Space`] before anything is received; the hub's errors; [`FetchError::Damaged`]
    /// for contents that are not those listed; [`FetchError::Full`], [`FetchError::Io`],
    /// [`FetchError::Interrupted`].
    pub fn fetch(
        &self,
        hub: &Hub,
        interrupt: &Interrupt,
        quiet: bool,
    ) -> Result<Fetched, FetchError> {
        let missing = self.missing();
        let folder = self.cache.folder();
        std::fs::create_dir_all(folder).map_err(FetchError::io(folder))?;
        if let Some(free) = free(folder).filter(|free| *free < missing) {
            return Err(FetchError::Space { folder: folder.into(), needed: missing, free });
        }
        let megabytes = usize::try_from(missing.div_ceil(MEGABYTE)).unwrap_or(usize::MAX);
        let progress = Progress::new("fetching", "MB", megabytes, quiet || missing == 0);
        let received = Cell::new(0_u64);
        let each = |bytes: u64| {
            let before = received.replace(received.get() + bytes);
            progress.add(received.get() / MEGABYTE - before / MEGABYTE);
        };
        let snapshot = self.place.snapshot(&self.commit);
        let links = !std::env::var("HF_HUB_DISABLE_SYMLINKS").is_ok_and(|set| hub::is_true(&set));
        let put = |file: &RemoteFile| {
            let url = hub.file_url(&self.wanted.repository, &self.commit, &file.path);
            let store = Store {
                hub,
                url: &url,
                repository: &self.place,
                snapshot: &snapshot,
                links,
                interrupt,
                each: &each,
            };
            store.put(file)
        };
        // The first error ends it; the bar goes before the error is said.
        let files: Result<Vec<FetchedFile>, FetchError> = self.files.iter().map(put).collect();
        progress.finish();
        let files = files?;
        if self.wanted.revision != self.commit {
            let reference = self.place.reference(&self.wanted.revision);
            let folder = reference.parent().unwrap_or(&reference);
            std::fs::create_dir_all(folder).map_err(FetchError::io(folder))?;
            write_atomic(&reference, self.commit.as_bytes()).map_err(FetchError::io(&reference))?;
        }
        Ok(Fetched { folder: self.folder(), files })
    }
}

/// Bytes of the unit that progress is counted in.
const MEGABYTE: u64 = 1_000_000;

/// Bytes that may still be written to a folder, where the system says so.
fn free(folder: &Path) -> Option<u64> {
    #[cfg(unix)]
    {
        let disk = rustix::fs::statvfs(folder).ok()?;
        Some(disk.f_bavail.saturating_mul(disk.f_frsize))
    }
    #[cfg(not(unix))]
    {
        let _ = folder;
        None
    }
}

/// Names go into addresses and into paths, so they must be plain.
fn check_names(wanted: &Wanted) -> Result<(), FetchError> {
    let plain = |part: &str| {
        let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
        !part.is_empty() && !part.starts_with('.') && part.chars().all(allowed)
    };
    let parts: Vec<&str> = wanted.repository.split('/').collect();
    if parts.len() != 2 || !parts.iter().all(|part| plain(part)) {
        let why = "a repository is OWNER/NAME, as qian43/Sat3DGen";
        return Err(FetchError::value("--repository", &wanted.repository, why));
    }
    if !wanted.revision.split('/').all(plain) {
        let why = "a revision is a branch, a tag or a commit";
        return Err(FetchError::value("--revision", &wanted.revision, why));
    }
    Ok(())
}

/// The folder of the checkpoint among the files of a repository: the root, or the only folder that
/// holds one. Of a training checkpoint the averaged weights, as [`sat3d_model::weights::locate`] has
/// it.
fn checkpoint_of(paths: &[&str], wanted: Option<&str>) -> Result<String, String> {
    let wanted = wanted.map(|folder| folder.trim_matches('/'));
    let folders: Vec<&str> = paths
        .iter()
        .filter_map(|path| path.strip_suffix(WEIGHTS_FILE))
        .filter(|folder| folder.is_empty() || folder.ends_with('/'))
        .map(|folder| folder.trim_end_matches('/'))
        .filter(|folder| is_relative(folder))
        .filter(|folder| {
            let config = if folder.is_empty() { String::new() } else { format!("{folder}/") };
            paths.contains(&format!("{config}config.json").as_str())
        })
        .collect();
    // The training checkpoint that a folder belongs to, and its rank there.
    let group = |folder: &str| -> (String, u8) {
        match folder.rsplit_once('/').unwrap_or(("", folder)) {
            (parent, "vqmodel_ema") => (parent.to_owned(), 1),
            (parent, "vqmodel") => (parent.to_owned(), 2),
            _ => (folder.to_owned(), 0),
        }
    };
    let mut groups: Vec<(String, u8, &str)> = folders
        .iter()
        .map(|folder| {
            let (group, rank) = group(folder);
            (group, rank, *folder)
        })
        .filter(|(group, _, folder)| {
            wanted.is_none_or(|wanted| group == wanted || *folder == wanted)
        })
        .collect();
    groups.sort_unstable();
    groups.dedup_by(|next, first| next.0 == first.0);
    match groups.as_slice() {
        [(_, _, only)] => Ok((*only).to_owned()),
        [] => Err(nothing(paths, wanted)),
        // The root counts before folders in it.
        [(root, _, folder), ..] if root.is_empty() => Ok((*folder).to_owned()),
        several => {
            let names: Vec<&str> = several.iter().map(|(group, ..)| group.as_str()).collect();
            Err(format!("it holds several; name one with --subfolder: {}", names.join(", ")))
        }
    }
}

/// Says what a repository without a checkpoint has instead.
fn nothing(paths: &[&str], wanted: Option<&str>) -> String {
    let place = wanted.map(|folder| format!(" in {folder}")).unwrap_or_default();
    let weights = |path: &&&str| {
        [".safetensors", ".bin", ".pt", ".pth", ".ckpt"].iter().any(|end| path.ends_with(end))
    };
    let mut others: Vec<&str> = paths.iter().filter(weights).take(10).copied().collect();
    others.sort_unstable();
    let others = match others.is_empty() {
        true => "no weights of any kind are there".to_owned(),
        false => format!("there are {}, which are not read", others.join(", ")),
    };
    format!("no folder{place} has both config.json and {WEIGHTS_FILE}; {others}")
}

/// Whether a folder of a listing stays inside the snapshot.
fn is_relative(folder: &str) -> bool {
    folder.is_empty()
        || folder.split('/').all(|part| {
            !part.is_empty() && part != "." && part != ".." && !part.contains(['\\', ':', '\0'])
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn paths(folders: &[&str]) -> Vec<String> {
        let parts =
            |folder: &&str| ["config.json", WEIGHTS_FILE].map(|file| format!("{folder}{file}"));
        folders.iter().flat_map(parts).collect()
    }

    fn chosen(folders: &[&str], wanted: Option<&str>) -> Result<String, String> {
        let paths = paths(folders);
        checkpoint_of(&paths.iter().map(String::as_str).collect::<Vec<_>>(), wanted)
    }

    #[test]
    fn the_checkpoint_is_chosen_as_in_a_folder_on_disk() {
        assert_eq!(chosen(&[""], None), Ok(String::new()));
        assert_eq!(chosen(&["a/"], None), Ok("a".into()));
        assert_eq!(chosen(&["a/", "", "b/"], None), Ok(String::new()));
        assert_eq!(chosen(&["vqmodel/", "vqmodel_ema/"], None), Ok("vqmodel_ema".into()));
        let training = ["c-1/vqmodel/", "c-1/vqmodel_ema/"];
        assert_eq!(chosen(&training, None), Ok("c-1/vqmodel_ema".into()));
        assert_eq!(chosen(&training, Some("c-1/vqmodel")), Ok("c-1/vqmodel".into()));
        let two = ["c-1/vqmodel/", "c-2/vqmodel/"];
        assert!(chosen(&two, None).is_err_and(|why| why.contains("--subfolder: c-1, c-2")));
        assert_eq!(chosen(&two, Some("c-2/")), Ok("c-2/vqmodel".into()));
        assert!(chosen(&two, Some("c-3")).is_err_and(|why| why.contains("no folder in c-3 has")));
        let others = checkpoint_of(&["config.json", "model.bin"], None);
        assert!(others.is_err_and(|why| why.contains("there are model.bin, which")));
        // Half a checkpoint, a name that only ends alike, and a path out of the cache are none.
        assert!(checkpoint_of(&[WEIGHTS_FILE], None).is_err());
        let alike = format!("x{WEIGHTS_FILE}");
        assert!(checkpoint_of(&["config.json", &alike], None).is_err());
        for out in ["../", "/etc/", "a/../../b/", "a//b/", "C:\\x/"] {
            assert!(chosen(&[out], None).is_err(), "{out}");
        }
    }

    #[test]
    fn names_that_are_paths_are_refused() {
        let wanted = |repository: &str, revision: &str| {
            let (repository, revision) = (repository.to_owned(), revision.to_owned());
            check_names(&Wanted { repository, revision, subfolder: None })
        };
        assert!(wanted("qian43/Sat3DGen", "refs/pr/1").is_ok());
        for name in ["", "a", "a/b/c", "../b", "a/..", "a b/c", "/a", "https://a/b"] {
            assert!(wanted(name, "main").is_err(), "{name}");
        }
        for revision in ["", "..", "a/../b", "/main", "a b", "a?b"] {
            assert!(wanted("a/b", revision).is_err(), "{revision}");
        }
    }
}
