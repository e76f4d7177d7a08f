//! The labels of a collection: discovered, carried, and kept.
//!
//! [`discover`] finds parts that recur over a few shapes while nothing is labelled. [`LabelModel`] is what a
//! collection has learnt of its labels. [`cut`] turns per-face evidence into a labelling with short
//! boundaries along concave creases.

mod boundary;
mod candidates;
mod criterion;
pub mod cut;
mod discover;
mod features;
mod joint;
mod model;
pub mod score;
mod up;

pub use boundary::refine_boundary;
pub use discover::{Discovery, DiscoveryInput, DiscoveryOptions, ShapeInput, discover};
pub use features::{Features, Normalisation};
pub use model::{Classifier, LabelModel, Statistics};
pub use up::estimate_up;
