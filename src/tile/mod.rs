//! A city from one big picture: windows, averaged densities, one seamless surface.

pub mod city;
pub mod dsm;
pub mod frame;
pub mod seams;
pub mod slabs;
pub mod surface;
pub mod tiles3d;
