//! `sat3d train`: settings, data, the loop with its checkpoints, and the log.
//!
//! The model crate's [`crate::model::train`] knows losses and gradients; here are files.
