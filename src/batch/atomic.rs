//! Outputs appear whole or not at all.

use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use tempfile::NamedTempFile;

/// A file that replaces its target only when it is complete: unique temporary file in the same
/// folder, flush, fsync, rename. Dropped without [`commit`](Self::commit), it leaves nothing.
#[derive(Debug)]
pub struct AtomicFile {
    temporary: NamedTempFile,
    target: PathBuf,
}

impl AtomicFile {
    /// Opens a temporary file beside `target`; the folder must exist.
    ///
    /// # Errors
    /// The folder is missing or not writable.
    pub fn create(target: &Path) -> io::Result<Self> {
        let folder = folder_of(target);
        let name = target.file_name().unwrap_or_default().to_string_lossy();
        let temporary = tempfile::Builder::new()
            .prefix(&format!(".{name}."))
            .suffix(".part")
            .tempfile_in(folder)?;
        Ok(Self { temporary, target: target.to_owned() })
    }

    /// The open file.
    pub fn file(&mut self) -> &mut File {
        self.temporary.as_file_mut()
    }

    /// Path of the temporary file, for writers that want a name.
    #[must_use]
    pub fn path(&self) -> &Path {
        self.temporary.path()
    }

    /// Flushes to disk and renames onto the target. The rename itself is durable after
    /// [`sync_folder`]; a batch calls that once for many files.
    ///
    /// # Errors
    /// Any error of writing, syncing or renaming; the target is then as it was.
    pub fn commit(mut self) -> io::Result<()> {
        self.temporary.flush()?;
        let file = self.temporary.as_file();
        // Temporary files are private by default; outputs get what the umask allows.
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            file.set_permissions(std::fs::Permissions::from_mode(0o666 & !umask()))?;
        }
        file.sync_all()?;
        self.temporary.persist(&self.target).map_err(|e| e.error)?;
        Ok(())
    }
}

/// Writes `bytes` to `target` so that it appears whole or not at all, and syncs the folder.
///
/// # Errors
/// Any error of writing, syncing or renaming; the target is then as it was.
pub fn write_atomic(target: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = AtomicFile::create(target)?;
    file.file().write_all(bytes)?;
    file.commit()?;
    sync_folder(folder_of(target))
}

/// Makes renames in a folder durable.
///
/// # Errors
/// The folder cannot be opened or synced.
pub fn sync_folder(folder: &Path) -> io::Result<()> {
    // Folders can be opened and synced on Unix only; elsewhere the rename is as durable as it gets.
    if cfg!(unix) { File::open(folder)?.sync_all() } else { Ok(()) }
}

pub(super) fn folder_of(target: &Path) -> &Path {
    match target.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

/// The process's file mode mask, read once (reading it any other way means changing it).
#[cfg(unix)]
pub(super) fn umask() -> u32 {
    static MASK: std::sync::OnceLock<u32> = std::sync::OnceLock::new();
    *MASK.get_or_init(|| {
        std::fs::read_to_string("/proc/self/status")
            .ok()
            .and_then(|status| {
                let line = status.lines().find_map(|l| l.strip_prefix("Umask:"))?;
                u32::from_str_radix(line.trim(), 8).ok()
            })
            .unwrap_or(0o022)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dropped_file_leaves_nothing_and_a_committed_one_replaces() {
        let folder = tempfile::tempdir().expect("a folder");
        let target = folder.path().join("x.bin");
        write_atomic(&target, b"old").expect("writes");
        {
            let mut half = AtomicFile::create(&target).expect("opens");
            half.file().write_all(b"half").expect("writes");
        }
        assert_eq!(std::fs::read(&target).expect("reads"), b"old");
        assert_eq!(std::fs::read_dir(folder.path()).expect("lists").count(), 1);
        write_atomic(&target, b"new").expect("writes");
        assert_eq!(std::fs::read(&target).expect("reads"), b"new");
    }

    #[test]
    fn a_missing_folder_is_an_error() {
        assert!(write_atomic(Path::new("/no/such/folder/x"), b"").is_err());
    }
}
