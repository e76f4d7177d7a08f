//! START HERE. Bytes become a [`Description`]; a description and a library snapshot become a [`Labelling`].

mod description;
mod place;
mod recluster;

pub use description::{Description, DescriptionView, Params};
pub use place::{Labelling, Prepared, Vote, label, map};
pub use recluster::{
    LabelChange, MIN_GAIN, ReclusterOptions, Reclustering, Representative, recluster,
};
