//! Defines the flags of commands that link parts.

use super::questions::Person;
use super::{InCollection, OneCollection};
use clap::Args;

/// `coseg same` and `coseg differ`
#[derive(Debug, Args)]
pub(crate) struct LinkParts {
    /// One part: SHAPE:NUMBER, numbered from 0 as in `coseg show`
    pub(crate) a: String,
    /// The other part
    pub(crate) b: String,
    #[command(flatten)]
    pub(crate) within: InCollection,
    #[command(flatten)]
    pub(crate) person: Person,
    /// Return once the link is durable, before all shapes are labelled again
    #[arg(long)]
    pub(crate) no_wait: bool,
}

/// `coseg links`
#[derive(Debug, Args)]
pub(crate) struct Links {
    #[command(flatten)]
    pub(crate) of: OneCollection,
    /// Only links of parts of this shape
    #[arg(long, value_name = "SHAPE")]
    pub(crate) shape: Option<String>,
}

/// `coseg unlink`
#[derive(Debug, Args)]
pub(crate) struct Unlink {
    /// The link's number, as `coseg links` lists it
    pub(crate) id: u64,
    #[command(flatten)]
    pub(crate) within: InCollection,
    /// Return once the link is removed, before all shapes are labelled again
    #[arg(long)]
    pub(crate) no_wait: bool,
}
