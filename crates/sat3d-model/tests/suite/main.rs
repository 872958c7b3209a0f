//! All integration tests of the crate as one program, which is linked once. `cargo test -p sat3d-model --test suite parity::`
//! runs those of one file.

mod field_exactness;
mod mesh_network;
mod mesh_parity;
mod mesh_scene;
mod mesh_skimage;
mod mesh_support;
mod mesh_topology;
mod parity;
mod render_city;
mod render_numerics;
mod render_parity;
mod support;
