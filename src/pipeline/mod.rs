//! START HERE. Bytes become a [`Description`]; a description and a library snapshot become a placement.

mod description;
pub use description::{Description, DescriptionView, Params};
