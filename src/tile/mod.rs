//! A city from one big picture: windows, averaged densities, one seamless surface.

pub mod city;
pub mod frame;
pub mod ground;
pub mod slabs;
pub mod spool;
pub mod surface;
pub mod tiles3d;
