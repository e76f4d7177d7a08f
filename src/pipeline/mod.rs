//! START HERE. Bytes become a [`Description`]; a description and a library snapshot become a [`Labelling`].

mod describe;
mod place;
mod recluster;

pub use crate::description::{Description, DescriptionView, Params};
pub use describe::{
    ALGORITHM_VERSION, DescribeError, MeshSpectrum, N_HKS_TIMES, describe, spectrum_of,
};
pub use place::{Labelling, Prepared, Vote, label, map};
pub use recluster::{
    LabelChange, MIN_GAIN, ReclusterOptions, Reclustering, Representative, batch, recluster,
};
