//! START HERE. Bytes become a [`Description`]; a description and a library snapshot become a [`Labelling`].

mod exemplars;
mod literal;
mod place;
mod questions;
mod recluster;
mod split;

pub use crate::description::{Description, DescriptionView, Params};
pub use coseg_geometry::describe::{
    ALGORITHM_VERSION, DescribeError, MeshSpectrum, N_HKS_TIMES, READING_VERSION, describe,
    spectrum_of,
};
pub use exemplars::{
    Given, Lesson, LessonMap, Taught, TeachOptions, label_taught, proxy_pins, teach,
};
pub use literal::literal;
pub use place::{
    Labelling, Prepared, Vote, carried, label, map, map_by_descriptors, map_from, unlikeness,
};
pub use questions::{
    AskedShape, Background, N_OFFERED, N_PARTS, Question, ShapeParts, next_question,
};
pub use recluster::{
    LabelChange, ReclusterOptions, Reclustering, Representative, batch, recluster,
};
pub use split::{split_faces, split_model};
