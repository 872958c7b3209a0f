//! Folders that appear whole or not at all.

#[cfg(unix)]
use super::atomic::umask;
use super::atomic::{folder_of, sync_folder};
use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// A folder that grows beside its target and takes the target's place when it is complete. Dropped without
/// [`commit`](Self::commit), it leaves nothing.
#[derive(Debug)]
pub struct AtomicFolder {
    temporary: TempDir,
    target: PathBuf,
}

impl AtomicFolder {
    /// Begins an empty folder beside `target`, whose parent must exist. Whether what stands at `target` may be
    /// replaced is the caller's to decide.
    ///
    /// # Errors
    /// The parent is missing or not writable.
    pub fn create(target: &Path) -> io::Result<Self> {
        let temporary = beside(target, ".part")?;
        Ok(Self { temporary, target: target.to_owned() })
    }

    /// Writes a file of the folder, and the folders above it, durably.
    ///
    /// # Errors
    /// Any error of writing or syncing, with the file's place in its message.
    pub fn write(&self, name: &str, bytes: &[u8]) -> io::Result<()> {
        let path = self.temporary.path().join(name);
        let write = || {
            if let Some(folder) = path.parent() {
                std::fs::create_dir_all(folder)?;
            }
            let mut file = File::create(&path)?;
            file.write_all(bytes)?;
            file.sync_all()
        };
        write().map_err(|error| {
            let at = self.target.join(name);
            io::Error::new(error.kind(), format!("{}: {error}", at.display()))
        })
    }

    /// Has a file of the folder written by its path, and the folders above it made; then makes it durable.
    ///
    /// # Errors
    /// What `write` returns; any error of making folders or syncing, with the file's place in its message.
    pub fn file(&self, name: &str, write: impl FnOnce(&Path) -> io::Result<()>) -> io::Result<()> {
        let path = self.temporary.path().join(name);
        let all = || {
            if let Some(folder) = path.parent() {
                std::fs::create_dir_all(folder)?;
            }
            write(&path)?;
            let file = File::open(&path)?;
            // Libraries that write through a temporary file leave it private.
            #[cfg(unix)]
            {
                use std::os::unix::fs::PermissionsExt;
                file.set_permissions(std::fs::Permissions::from_mode(0o666 & !umask()))?;
            }
            file.sync_all()
        };
        all().map_err(|error| {
            let at = self.target.join(name);
            io::Error::new(error.kind(), format!("{}: {error}", at.display()))
        })
    }

    /// Where the folder grows.
    #[must_use]
    pub fn path(&self) -> &Path {
        self.temporary.path()
    }

    /// Puts the folder in its place; an older one there is removed.
    ///
    /// # Errors
    /// Any error of syncing or renaming; the target is then as it was.
    pub fn commit(self) -> io::Result<()> {
        sync_tree(self.temporary.path())?;
        // A folder cannot be renamed onto one that holds files: the old one steps aside first.
        let aside = if self.target.exists() {
            let aside = beside(&self.target, ".old")?;
            let old = aside.path().join("folder");
            std::fs::rename(&self.target, &old)?;
            Some((aside, old))
        } else {
            None
        };
        if let Err(error) = std::fs::rename(self.temporary.path(), &self.target) {
            if let Some((_, old)) = &aside {
                // Best effort: the error that counts is the first one.
                let _ = std::fs::rename(old, &self.target);
            }
            return Err(error);
        }
        // Its folder is elsewhere now.
        let _ = self.temporary.keep();
        sync_folder(folder_of(&self.target))
    }
}

/// A temporary folder beside a target, with the permissions of an output.
fn beside(target: &Path, suffix: &str) -> io::Result<TempDir> {
    let name = target.file_name().unwrap_or_default().to_string_lossy();
    let prefix = format!(".{name}.");
    let mut builder = tempfile::Builder::new();
    builder.prefix(&prefix).suffix(suffix);
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        // Temporary folders are private by default; outputs get what the umask allows.
        builder.permissions(std::fs::Permissions::from_mode(0o777));
    }
    builder.tempdir_in(folder_of(target))
}

fn sync_tree(folder: &Path) -> io::Result<()> {
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        if entry.file_type()?.is_dir() {
            sync_tree(&entry.path())?;
        }
    }
    sync_folder(folder)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dropped_folder_leaves_nothing_and_a_committed_one_replaces() {
        let parent = tempfile::tempdir().expect("a folder");
        let target = parent.path().join("x");
        let first = AtomicFolder::create(&target).expect("opens");
        first.write("a/b.bin", b"old").expect("writes");
        first.write("gone.bin", b"old").expect("writes");
        assert!(!target.exists());
        first.commit().expect("commits");
        {
            let half = AtomicFolder::create(&target).expect("opens");
            half.write("a/b.bin", b"half").expect("writes");
        }
        assert_eq!(std::fs::read(target.join("a/b.bin")).expect("reads"), b"old");
        let second = AtomicFolder::create(&target).expect("opens");
        second.write("a/b.bin", b"new").expect("writes");
        second.commit().expect("commits");
        assert_eq!(std::fs::read(target.join("a/b.bin")).expect("reads"), b"new");
        assert!(!target.join("gone.bin").exists());
        assert_eq!(std::fs::read_dir(parent.path()).expect("lists").count(), 1);
    }

    #[test]
    fn errors_name_the_file() {
        assert!(AtomicFolder::create(Path::new("/no/such/folder/x")).is_err());
        let parent = tempfile::tempdir().expect("a folder");
        let folder = AtomicFolder::create(&parent.path().join("x")).expect("opens");
        folder.write("a", b"").expect("writes");
        let error = folder.write("a/b", b"").expect_err("a is a file");
        assert!(error.to_string().contains("x/a/b"), "{error}");
    }
}
