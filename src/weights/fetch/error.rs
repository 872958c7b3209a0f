//! Why a fetch failed, and what to do about it.

use std::path::{Path, PathBuf};

/// An error of `sat3d model fetch`.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FetchError {
    /// The environment forbids the network.
    #[error(
        "{variable} is set, so nothing is fetched; unset it, or name a checkpoint folder that is \
         already here with --weights or SAT3D_WEIGHTS"
    )]
    Offline {
        /// The variable that says so.
        variable: &'static str,
    },
    /// An argument or a variable makes no sense.
    #[error("{what} `{value}`: {why}")]
    Value {
        /// The argument, the variable, or the field of an answer.
        what: &'static str,
        /// Its value.
        value: String,
        /// What is wrong with it.
        why: String,
    },
    /// The server cannot be reached, or the connection broke and stayed broken.
    #[error(
        "{url}: {why}; try again when the network is there (what was received is kept), name a mirror \
         with HF_ENDPOINT or a proxy with HTTPS_PROXY, or copy a checkpoint folder from elsewhere \
         and name it with --weights"
    )]
    Network {
        /// The address.
        url: String,
        /// The reason.
        why: String,
    },
    /// The server answered with an error.
    #[error("{url}: status {status}: {why}")]
    Refused {
        /// The address.
        url: String,
        /// HTTP status.
        status: u16,
        /// What it means, and what to do.
        why: String,
    },
    /// The server's answer is not what a hub answers.
    #[error("{url}: {why}")]
    Answer {
        /// The address.
        url: String,
        /// What is wrong with the answer.
        why: String,
    },
    /// The repository holds no checkpoint that is served.
    #[error("{repository} at {commit} holds no checkpoint: {why}")]
    NoCheckpoint {
        /// Name on the hub.
        repository: String,
        /// The commit.
        commit: String,
        /// What was looked for and what is there.
        why: String,
    },
    /// The disk has less room than the files need.
    #[error(
        "{}: {needed} bytes are to be fetched and {free} are free; make room, or name another cache \
         with --cache or HF_HUB_CACHE",
        folder.display()
    )]
    Space {
        /// The cache.
        folder: PathBuf,
        /// Bytes to fetch.
        needed: u64,
        /// Bytes free.
        free: u64,
    },
    /// The disk became full while a file was written.
    #[error(
        "{}: the disk is full; what was received is kept: make room and run the same command again, \
         or name another cache with --cache or HF_HUB_CACHE",
        path.display()
    )]
    Full {
        /// The file.
        path: PathBuf,
    },
    /// What was received is not what the hub lists.
    #[error(
        "{file}: {what} is {found}, and the hub lists {expected}; nothing was put into the cache; \
         run the same command again, and if that changes nothing, ask whoever runs {endpoint}"
    )]
    Damaged {
        /// Name of the file in the repository.
        file: String,
        /// `size` or the name of a hash.
        what: &'static str,
        /// As received.
        found: String,
        /// As listed.
        expected: String,
        /// The hub.
        endpoint: String,
    },
    /// A file could not be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        #[source]
        source: std::io::Error,
    },
    /// Ctrl-C.
    #[error("interrupted; what was received is kept: the same command continues")]
    Interrupted,
}

impl FetchError {
    pub(super) fn value(what: &'static str, value: &str, why: &str) -> Self {
        Self::Value { what, value: value.into(), why: why.into() }
    }

    /// An [`FetchError::Io`], or [`FetchError::Full`], for `map_err`.
    pub(super) fn io(path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.as_ref().to_path_buf();
        move |source| match source.kind() {
            std::io::ErrorKind::StorageFull | std::io::ErrorKind::QuotaExceeded => {
                Self::Full { path }
            }
            _ => Self::Io { path, source },
        }
    }

    /// What a status means at the hub. `code` is its own word for it, `said` its message, `token`
    /// whether one was sent.
    pub(super) fn refused(url: &str, status: u16, code: &str, said: &str, token: bool) -> Self {
        let with = if token {
            "the token in HF_TOKEN may not read it"
        } else {
            "no token was sent: set HF_TOKEN if it is private"
        };
        let why = match (status, code) {
            (404, "RevisionNotFound") => {
                "no such branch, tag or commit; name another with --revision".to_owned()
            }
            (404, "EntryNotFound") => "the repository has no such file".to_owned(),
            (_, "GatedRepo") | (403, _) => format!(
                "access has to be granted: open the repository's page in a browser, accept its \
                 conditions, and set HF_TOKEN to a token that may read it{}",
                if token { " (one was sent)" } else { "" }
            ),
            // The hub answers 401 for names that do not exist, so as not to tell what does.
            (401 | 404, _) => {
                format!("no such repository, or a private one; check --repository; {with}")
            }
            (429, _) => "too many requests; wait some minutes, then run the same command".into(),
            (500.., _) => "the server has a problem; run the same command later".into(),
            _ => "refused".into(),
        };
        let said = if said.is_empty() { String::new() } else { format!(" (it says: {said})") };
        Self::Refused { url: url.into(), status, why: why + &said }
    }
}
