//! Defines the flags of commands about proposals.

use super::OneCollection;
use clap::Args;
use std::path::PathBuf;

/// `coseg proposals`
#[derive(Debug, Args)]
pub(crate) struct Proposals {
    #[command(flatten)]
    pub(crate) of: OneCollection,
    /// Draw each proposal to DIR/1.png, DIR/2.png and so on; the folder is created if missing
    #[arg(long, value_name = "DIR")]
    pub(crate) png: Option<PathBuf>,
    /// Maximum number of shapes of a picture, in the order of their arrival
    #[arg(long, value_name = "N", requires = "png")]
    pub(crate) max: Option<usize>,
    /// Do not wait until the proposals for the present labels are made
    #[arg(long)]
    pub(crate) no_wait: bool,
}

/// `coseg choose`
#[derive(Debug, Args)]
pub(crate) struct Choose {
    /// The collection
    pub(crate) collection: String,
    /// The number of the proposal, as `coseg proposals` lists it
    #[arg(value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) proposal: u32,
    /// Return once the choice is durable, before all shapes are labelled again
    #[arg(long)]
    pub(crate) no_wait: bool,
}
