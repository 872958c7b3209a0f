//! One file into the cache: locked, received or continued, checked, named.

use super::hub::{ATTEMPTS, Hub};
use super::{FetchError, FetchedFile, RemoteFile};
use crate::batch::{Interrupt, sync_folder};
use crate::weights::cache::Repository;
use sha1::Sha1;
use sha2::{Digest, Sha256};
use std::fmt::Write as _;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{self, ErrorKind, Read, Seek, SeekFrom, Write as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Bytes that are read, hashed and written at a time.
const CHUNK: usize = 1 << 20;

/// All that storing a file needs to know.
pub(super) struct Store<'a> {
    pub hub: &'a Hub,
    /// Address of the file.
    pub url: &'a str,
    pub repository: &'a Repository,
    /// The folder of the commit.
    pub snapshot: &'a Path,
    /// Whether names in the snapshot may be links.
    pub links: bool,
    pub interrupt: &'a Interrupt,
    /// Told of bytes that were received.
    pub each: &'a dyn Fn(u64),
}

impl Store<'_> {
    /// Brings a file into the cache, or finds it there; either way its contents were hashed.
    pub fn put(&self, file: &RemoteFile) -> Result<FetchedFile, FetchError> {
        let blob = self.repository.blob(&file.etag);
        let name = self.snapshot.join(&file.path);
        let lock = self.repository.lock(&file.etag);
        for path in [&blob, &name, &lock] {
            let folder = path.parent().unwrap_or(path);
            std::fs::create_dir_all(folder).map_err(FetchError::io(folder))?;
        }
        // Released when the file is closed. `huggingface_hub` takes the same lock.
        let _held = self.lock(&lock)?;
        for (index, present) in [&blob, &name].into_iter().enumerate() {
            if size(present) != Some(file.size) {
                continue;
            }
            let mut hashes = Hashes::new(file.size);
            let mut open = File::open(present).map_err(FetchError::io(present))?;
            hashes.read(&mut open, self.interrupt).map_err(|error| self.failed(present, error))?;
            match self.check(file, hashes) {
                Ok(sha256) => {
                    if index == 0 {
                        self.name(&blob, &name)?;
                    }
                    return Ok(FetchedFile::new(file, sha256, 0));
                }
                Err(error) => tracing::warn!("in the cache, {error}; fetching it anew"),
            }
        }
        let (sha256, received) = self.receive(file, &blob)?;
        self.name(&blob, &name)?;
        Ok(FetchedFile::new(file, sha256, received))
    }

    /// Waits for whoever else fetches the same contents.
    fn lock(&self, path: &Path) -> Result<File, FetchError> {
        let file = OpenOptions::new().create(true).append(true).open(path);
        let file = file.map_err(FetchError::io(path))?;
        let mut said = false;
        loop {
            match file.try_lock() {
                Ok(()) => return Ok(file),
                Err(TryLockError::WouldBlock) => {
                    if !std::mem::replace(&mut said, true) {
                        tracing::warn!("{}: another fetch is at work; waiting", path.display());
                    }
                    if self.interrupt.requested() {
                        return Err(FetchError::Interrupted);
                    }
                    std::thread::sleep(Duration::from_millis(100));
                }
                // Some network folders have no locks. Two fetches may then spoil each other's partial
                // file, which the hash finds.
                Err(TryLockError::Error(error)) => {
                    tracing::debug!("{}: no lock: {error}", path.display());
                    return Ok(file);
                }
            }
        }
    }

    /// Receives a file into `<blob>.incomplete`, continuing what is there, and renames it.
    fn receive(&self, file: &RemoteFile, blob: &Path) -> Result<(String, u64), FetchError> {
        let partial = self.repository.blob(&format!("{}.incomplete", file.etag));
        let continued = size(&partial).is_some_and(|size| size > 0);
        let (mut hashes, mut received) = self.contents(file, &partial)?;
        if continued && self.check(file, hashes.clone()).is_err() {
            // What was there belonged to something else, or was damaged: once more from the start.
            std::fs::remove_file(&partial).map_err(FetchError::io(&partial))?;
            let again = self.contents(file, &partial)?;
            hashes = again.0;
            received += again.1;
        }
        let sha256 = self.check(file, hashes).inspect_err(|_| {
            // A second attempt must not begin with it.
            let _ = std::fs::remove_file(&partial);
        })?;
        std::fs::rename(&partial, blob).map_err(FetchError::io(blob))?;
        sync_folder(blob.parent().unwrap_or(blob)).map_err(FetchError::io(blob))?;
        Ok((sha256, received))
    }

    /// The whole of a file in `partial`, synced; its hashes, and the bytes that were received.
    fn contents(&self, file: &RemoteFile, partial: &Path) -> Result<(Hashes, u64), FetchError> {
        let failed = |error| self.failed(partial, error);
        let open =
            OpenOptions::new().read(true).write(true).create(true).truncate(false).open(partial);
        let mut output = open.map_err(failed)?;
        let mut hashes = Hashes::new(file.size);
        if output.metadata().map_err(failed)?.len() > file.size {
            output.set_len(0).map_err(failed)?;
        }
        hashes.read(&mut output, self.interrupt).map_err(failed)?;
        let (mut received, mut attempt) = (0, 1);
        while hashes.length < file.size {
            let mut response = self.hub.get(self.url, hashes.length)?;
            let range = response.headers().get("content-range").and_then(|v| v.to_str().ok());
            let continues =
                range.is_some_and(|range| range.starts_with(&format!("bytes {}-", hashes.length)));
            if hashes.length > 0 && !(response.status().as_u16() == 206 && continues) {
                // The server sends all of it, or does not know the range.
                output.set_len(0).map_err(failed)?;
                output.seek(SeekFrom::Start(0)).map_err(failed)?;
                hashes = Hashes::new(file.size);
                if response.status().as_u16() != 200 {
                    response = self.hub.get(self.url, 0)?;
                }
            }
            let before = hashes.length;
            let mut body = response.body_mut().with_config().limit(u64::MAX).reader();
            let broke = self.copy(file, &mut body, &mut output, &mut hashes).map_err(failed)?;
            received += hashes.length - before;
            if hashes.length >= file.size {
                break;
            }
            // A connection that brings something may break as often as it likes.
            if hashes.length > before {
                attempt = 1;
            } else if attempt == ATTEMPTS {
                let why = broke.unwrap_or_else(|| {
                    format!("the answer ends at byte {} of {}", hashes.length, file.size)
                });
                return Err(FetchError::Network { url: self.url.into(), why });
            }
            self.hub.wait(&mut attempt, None);
        }
        output.sync_all().map_err(failed)?;
        Ok((hashes, received))
    }

    /// Copies an answer's body, at most a chunk beyond the file's size. `Ok(Some(why))` where the
    /// connection broke, an error where the disk did.
    fn copy(
        &self,
        file: &RemoteFile,
        body: &mut dyn Read,
        output: &mut File,
        hashes: &mut Hashes,
    ) -> io::Result<Option<String>> {
        let mut chunk = vec![0; CHUNK];
        while hashes.length <= file.size {
            if self.interrupt.requested() {
                return Err(io::Error::from(ErrorKind::Interrupted));
            }
            let count = match body.read(&mut chunk) {
                Ok(0) => break,
                Ok(count) => count,
                Err(error) if error.kind() == ErrorKind::Interrupted => continue,
                Err(error) => return Ok(Some(error.to_string())),
            };
            output.write_all(&chunk[..count])?;
            hashes.update(&chunk[..count]);
            (self.each)(count as u64);
        }
        Ok(None)
    }

    /// The SHA-256 of contents that are those that the hub lists.
    fn check(&self, file: &RemoteFile, hashes: Hashes) -> Result<String, FetchError> {
        let damaged = |what, found: &str, expected: &str| FetchError::Damaged {
            file: file.path.clone(),
            what,
            found: found.into(),
            expected: expected.into(),
            endpoint: self.hub.endpoint().into(),
        };
        if hashes.length != file.size {
            let (found, expected) = (hashes.length.to_string(), file.size.to_string());
            return Err(damaged("size", &found, &expected));
        }
        let (sha256, git) = hashes.finish();
        match (&file.sha256, &file.git) {
            (Some(expected), _) if *expected != sha256 => Err(damaged("sha256", &sha256, expected)),
            (None, Some(expected)) if *expected != git => {
                Err(damaged("Git's hash", &git, expected))
            }
            _ => Ok(sha256),
        }
    }

    /// Gives a blob its name in the snapshot: a relative link, or where there are none the file
    /// itself, as `huggingface_hub` does.
    fn name(&self, blob: &Path, name: &Path) -> Result<(), FetchError> {
        let same = |a: &Path, b: &Path| {
            a.canonicalize().is_ok_and(|a| b.canonicalize().is_ok_and(|b| a == b))
        };
        if same(blob, name) {
            return Ok(());
        }
        let folder = name.parent().unwrap_or(name);
        if self.links && self.link(blob, name, folder).is_ok() {
            return sync_folder(folder).map_err(FetchError::io(folder));
        }
        std::fs::rename(blob, name).map_err(FetchError::io(name))?;
        sync_folder(folder).map_err(FetchError::io(folder))
    }

    fn link(&self, blob: &Path, name: &Path, folder: &Path) -> io::Result<()> {
        // From snapshots/<commit>/a/b up to the repository's folder.
        let below = folder.strip_prefix(self.repository.folder()).map_err(io::Error::other)?;
        let mut target: PathBuf = below.components().map(|_| "..").collect();
        target.push("blobs");
        target.push(blob.file_name().unwrap_or_default());
        // A link cannot replace a file, a rename can.
        let temporary = tempfile::Builder::new().prefix(".link.").tempdir_in(folder)?;
        let link = temporary.path().join("link");
        // Relative to where it will lie, one level up.
        symlink(&target, &link)?;
        std::fs::rename(&link, name)
    }

    fn failed(&self, path: &Path, error: io::Error) -> FetchError {
        if self.interrupt.requested() {
            return FetchError::Interrupted;
        }
        FetchError::io(path)(error)
    }
}

#[cfg(unix)]
fn symlink(target: &Path, link: &Path) -> io::Result<()> {
    std::os::unix::fs::symlink(target, link)
}

#[cfg(windows)]
fn symlink(target: &Path, link: &Path) -> io::Result<()> {
    std::os::windows::fs::symlink_file(target, link)
}

#[cfg(not(any(unix, windows)))]
fn symlink(_: &Path, _: &Path) -> io::Result<()> {
    Err(io::Error::from(ErrorKind::Unsupported))
}

/// Bytes of a file, following links; `None` where there is none.
pub(super) fn size(path: &Path) -> Option<u64> {
    std::fs::metadata(path).ok().filter(std::fs::Metadata::is_file).map(|data| data.len())
}

/// Both names that a hub has for contents, while they are read.
#[derive(Clone)]
struct Hashes {
    length: u64,
    sha256: Sha256,
    git: Sha1,
}

impl Hashes {
    /// Git hashes the size first.
    fn new(size: u64) -> Self {
        let mut git = Sha1::new();
        git.update(format!("blob {size}\0"));
        Self { length: 0, sha256: Sha256::new(), git }
    }

    fn update(&mut self, bytes: &[u8]) {
        self.length += bytes.len() as u64;
        self.sha256.update(bytes);
        self.git.update(bytes);
    }

    /// Takes in the rest of a file.
    fn read(&mut self, file: &mut File, interrupt: &Interrupt) -> io::Result<()> {
        let mut chunk = vec![0; CHUNK];
        loop {
            match file.read(&mut chunk)? {
                0 => return Ok(()),
                count => self.update(&chunk[..count]),
            }
            if interrupt.requested() {
                return Err(io::Error::from(ErrorKind::Interrupted));
            }
        }
    }

    fn finish(self) -> (String, String) {
        (hex(&self.sha256.finalize()), hex(&self.git.finalize()))
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        // Writing to a String cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `printf 'hello\n' | git hash-object --stdin` and `printf 'hello\n' | sha256sum`.
    #[test]
    fn contents_have_the_names_that_git_and_sha256sum_give() {
        let mut hashes = Hashes::new(6);
        hashes.update(b"hel");
        hashes.update(b"lo\n");
        let (sha256, git) = hashes.finish();
        assert_eq!(git, "ce013625030ba8dba906f756967f9e9ca394464a");
        assert_eq!(sha256, "5891b5b522d5df086d0ff0b110fbd9d21bb4fc7163af34d08286a2e846f6be03");
    }
}
