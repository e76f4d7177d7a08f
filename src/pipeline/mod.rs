//! START HERE. Bytes become a [`Description`]; a description and a library snapshot become a [`Labelling`].

mod describe;
mod description;
mod place;
mod recluster;

pub use describe::{
    ALGORITHM_VERSION, DescribeError, MeshSpectrum, N_HKS_TIMES, describe, spectrum_of,
};
pub use description::{Description, DescriptionView, Params};
pub use place::{Labelling, Prepared, Vote, label, map};
pub use recluster::{
    LabelChange, MIN_GAIN, ReclusterOptions, Reclustering, Representative, recluster,
};
