//! Results shown in a browser: a small web server on loopback and the page that it serves.
//!
//! [`Contents`] says what in a folder can be shown (3D Tiles tilesets, binary glTF meshes), [`Server`] serves it
//! with a page that needs no network: the page and its scripts are inside the program (sources in `viewer/` of
//! the repository). Nothing of the folder is changed, and nobody but this machine can ask:
//!
//! - only 127.0.0.1 is listened on, and the `Host` header must name it, so that no web site can reach the server
//!   through a name of its own that resolves to 127.0.0.1 (DNS rebinding);
//! - only GET and HEAD are answered, only with regular files below the folder (links are followed, and refused where
//!   they leave it), never hidden ones;
//! - the page's content security policy forbids it every other address.
//!
//! Requests are parsed by `httparse`, the parser of hyper. The blocking servers on crates.io either have no time-outs
//! and no bound on connections (`tiny_http`, last released in 2022, and what builds on it) or bring an async
//! runtime; what is left to do for GET and HEAD without a body is in this module.

mod contents;
mod files;
mod page;
mod request;
mod respond;
mod server;

pub use contents::{Contents, Item, ItemKind};
pub use server::{Limits, Served, Server};

use std::io;
use std::path::PathBuf;

/// What keeps a folder from being shown.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ViewerError {
    /// There is nothing at the path.
    #[error(
        "{path}: no such file or folder; give a 3D Tiles folder (with tileset.json), a .glb file, or a folder that holds such"
    )]
    Missing {
        /// The path.
        path: PathBuf,
    },
    /// The path is a file of another kind.
    #[error(
        "{path} is neither a tileset.json nor a .glb file; PLY and OBJ meshes open in other programs (docs/mesh.md), \
         and `sat3d infer --mesh glb` writes one that is shown here"
    )]
    NotShown {
        /// The file.
        path: PathBuf,
    },
    /// A tileset or a mesh that is broken.
    #[error("{path}: {problem}")]
    Broken {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// A folder without anything that can be shown.
    #[error(
        "{path} holds neither a tileset.json nor a .glb file (looked {levels} folders deep); `sat3d tile --tiles3d DIR` \
         and `sat3d infer --mesh glb` write them"
    )]
    Empty {
        /// The folder.
        path: PathBuf,
        /// How deep was looked.
        levels: usize,
    },
    /// A path below the folder that cannot be read.
    #[error("cannot read {path}")]
    Read {
        /// The path.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// The port is taken.
    #[error(
        "port {port} of 127.0.0.1 is in use by another program; leave out --port for a free one, or give another"
    )]
    PortInUse {
        /// The port.
        port: u16,
    },
    /// The port cannot be listened on for another reason.
    #[error("cannot listen on 127.0.0.1:{port}; leave out --port for a free one")]
    Listen {
        /// The port.
        port: u16,
        /// The cause.
        source: io::Error,
    },
}
