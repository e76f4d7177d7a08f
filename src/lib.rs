//! Keeps a growing library of 3D shapes consistently segmented and labelled.
//!
//! Data flows one way. [`pipeline::describe`] turns the bytes of one mesh into a
//! [`pipeline::Description`] (pure, parallel, depends on the shape alone). [`pipeline::label`]
//! relates a description to a bounded number of known shapes and labels its faces (pure, serial per
//! collection). [`Library`] commits the result, which is the only effect. The daemon is a shell
//! around [`Library`].

// Modules are in the order of the data flow: a module names only modules before it
// (tests/it/tidy.rs).

// Geometry, a crate of its own: computes values from one or two meshes.
pub use coseg_geometry::{
    SpectralMesh, description, descriptors, fmap, linalg, mesh, operators, segmentation, sites,
    spectrum,
};

// Pure modules: values in, values out.
pub mod correspondence;
pub mod labels;
pub mod neighbors;
pub mod pipeline;
pub mod synth;

// Shell: modules that use files, sockets and clocks.
pub mod store;
pub mod library;
pub mod text;
pub mod ipc;
pub mod config;
pub mod viewer;
pub mod daemon;

pub use library::{Bundle, Library, label};

/// Runs the example of the README as a test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
