//! A bundle: one immutable file with everything that labels a new shape of a collection as it was
//! at one moment. [`label`] gives a mesh the labels that the library would give it if it arrived
//! then, through the same steps (`placement.rs`), without a store.
//!
//! docs/format.md describes the file.

mod content;
mod error;
mod file;
mod label;
mod open;
mod publish;
mod sound;

pub use content::{Bundle, BundleInfo, BundledLabel};
pub use error::BundleError;
pub use file::{ArrayFile, BundleFile, BundleHead, write_bundle};
pub use label::{LabelledMesh, label};
pub use publish::MIN_DISCOVERED_SHAPES;
