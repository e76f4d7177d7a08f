//! Keeps a growing library of 3D shapes consistently segmented and labelled.
//!
//! Data flows one way. [`pipeline::describe`] turns the bytes of one mesh into a [`pipeline::Description`]
//! (pure, parallel, depends on the shape alone). [`pipeline::place`] relates a description to a bounded
//! number of known shapes and labels its faces (pure, serial per collection). [`Library`] commits the
//! result: the one effect. The daemon is a shell around [`Library`].

// Pure: values in, values out.
pub mod correspondence;
pub mod descriptors;
pub mod fmap;
pub mod labels;
pub mod linalg;
pub mod mesh;
pub mod neighbors;
pub mod operators;
pub mod pipeline;
pub mod segmentation;
pub mod spectrum;
pub mod synth;

// Shell: files, sockets, clocks.
pub mod config;
pub mod daemon;
pub mod ipc;
pub mod library;
pub mod store;

pub use library::Library;
