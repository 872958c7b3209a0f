//! Views of a scene as pictures: cameras, paths, frames, animations.
