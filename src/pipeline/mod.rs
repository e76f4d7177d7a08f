//! START HERE. Bytes become a [`Description`]; a description and a library snapshot become a [`Labelling`].

mod supervised;
mod yang_tian;
mod place;
mod questions;
mod recluster;
mod split;

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
    LabelChange, ReclusterOptions, Reclustering, Representative, batch, recluster,
};
pub use split::{split_faces, split_model};
pub use supervised::{
    FitMap, FitOptions, FitShape, Fitted, FurtherEvidence, fit, label_fitted, proxy_pins,
};
pub use yang_tian::yang_tian_baseline;
