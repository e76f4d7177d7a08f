//! START HERE. One shape goes from bytes to labels, in five steps:
//!
//! 1. [`describe`] turns the bytes of a mesh into a [`Description`]: the proxy mesh, its spectrum,
//!    descriptors and patches. A description depends on the bytes and [`Params`] alone, so many
//!    shapes are described in parallel, and a stored description is never recomputed.
//! 2. [`Prepared::new`] standardises the descriptors of a shape with the normalisation of the
//!    collection's [`LabelModel`].
//! 3. [`nearest`](crate::neighbors::SignatureMetric::nearest) ranks the known shapes by their
//!    signatures, and [`descriptor_distance`] ranks the nearest of these. At most five are sources,
//!    and [`map`] computes a functional map from each.
//! 4. [`label`] labels the proxy's faces. Each source casts a [`Vote`]: its label probabilities,
//!    transferred through its map ([`vote_probabilities`] decides the weight of each vote). Votes
//!    and the label model's probabilities are the evidence from which a [`cut`] makes a
//!    [`Labelling`] with short boundaries along creases.
//! 5. [`refine_boundary`] transfers the labels from the proxy to the faces of the input mesh.
//!
//! Steps 2 to 5 depend on the collection, so they are serial in each collection. The state of a
//! collection decides how its labels come about:
//!
//! * **Discovering**: nothing is labelled by hand. [`recluster`] labels a few representative shapes
//!   together, at the start and whenever the collection has grown 1.4 times, and builds the label
//!   model from them.
//! * **Supervised**: a person has corrected labels. [`fit`] fits the label model to the training
//!   shapes, and [`label_fitted`] takes the place of [`label`] for all other shapes.
//!   [`next_question`] chooses the part that a person should label next.
//!
//! [`split_model`] and [`split_faces`] split a label in two. [`yang_tian_baseline`] is the method
//! of the source paper, with which the others are compared.
//!
//! Everything here is pure: values in, values out. [`Library::place_item`] calls these functions
//! in order and commits their result; `src/library/voting.rs` builds the votes. `docs/methods.md`
//! has the methods with their papers and figures.
//!
//! [`LabelModel`]: crate::labels::LabelModel
//! [`Library::place_item`]: crate::Library::place_item
//! [`cut`]: crate::labels::cut::cut
//! [`refine_boundary`]: crate::labels::refine_boundary

mod place;
mod questions;
mod recluster;
mod split;
mod supervised;
mod yang_tian;

pub use crate::description::{Description, DescriptionView, Params};
pub use coseg_geometry::describe::{
    ALGORITHM_VERSION, DescribeError, MeshSpectrum, N_HKS_TIMES, READING_VERSION, describe,
    spectrum_of,
};
pub use place::{
    Labelling, Prepared, Vote, descriptor_distance, label, map, map_by_descriptors, map_from,
    vote_probabilities,
};
pub use questions::{
    Background, CandidateShape, N_OFFERED, N_PARTS, Question, ShapeParts, next_question,
};
pub use recluster::{
    LabelChange, ReclusterOptions, Reclustering, Representative, adopt, batch, proposal_candidates,
    proposals, recluster,
};
pub use split::{split_faces, split_model};
pub use supervised::{
    DiscoveredLabels, FitMap, FitOptions, FitShape, Fitted, FurtherEvidence, fit, label_fitted,
    proxy_pins,
};
pub use yang_tian::yang_tian_baseline;
