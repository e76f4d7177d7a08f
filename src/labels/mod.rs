//! The labels of a collection: discovered, and fitted to corrections.
//!
//! [`discover`] finds parts that recur over a few shapes while nothing is labelled. [`LabelModel`]
//! classifies faces by the labels of a collection. [`PriorLabels`] translates the labels that were
//! discovered before a person labelled anything. [`cut`] turns per-face evidence into a labelling
//! with short boundaries along concave creases. [`Links`] are demands of a person that every
//! labelling meets.

mod baselines;
mod boundary;
mod candidates;
mod criterion;
pub mod cut;
mod discover;
mod features;
mod joint;
mod judge;
mod links;
mod model;
mod patchwise;
mod prior;
mod propose;
pub mod score;
#[cfg(test)]
mod test_shapes;
mod up;

pub use baselines::{Baseline, baseline};
pub use boundary::refine_boundary;
pub use discover::{Discovery, DiscoveryInput, DiscoveryOptions, ShapeInput, discover};
pub use features::{Features, Normalisation};
pub use links::{LinkedFaces, Links};
pub use model::{Classifier, LabelModel, Statistics};
pub use prior::{Overlap, Pinned, PriorLabels};
pub use propose::{
    Candidate, N_PROPOSALS, PROPOSED_LABELS, Proposal, agreement, candidates, propose,
};
pub use up::{UpVote, contradicting_up, estimate_up};
