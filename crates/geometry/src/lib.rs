//! Turns a triangle mesh into its Laplacian spectrum, descriptors, patches and functional maps.
//!
//! Every function takes values and returns values: the crate opens no file, reads no clock and no
//! environment, and prints nothing. Random starts are seeded, so the same input gives the same
//! output on any number of threads.
//!
//! The modules come in the order in which data flows; a module names only modules before it.

#![doc = include_str!("../README.md")]

pub mod linalg;
pub mod mesh;
pub mod operators;
pub mod geodesics;
pub mod spectrum;
pub mod description;
pub mod descriptors;
pub mod segmentation;
pub mod describe;
pub mod fmap;
pub mod sites;
pub mod spectral_mesh;

pub use spectral_mesh::{SpectralMesh, SpectralMeshError};
