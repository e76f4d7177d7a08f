//! Defines the flags of commands that correct labels.

use super::questions::Person;
use super::{InCollection, OneCollection};
use clap::Args;
use std::path::PathBuf;

/// `coseg correct`
#[derive(Debug, Args)]
pub(crate) struct Correct {
    /// The shape
    pub(crate) shape: String,
    /// File with one integer on each line, the label of each face of the shape's file in its order;
    /// -1 leaves a face unchanged. Also .npy, .seg and .json as written by `coseg export`
    #[arg(value_name = "LABELS", required_unless_present = "part")]
    pub(crate) labels: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) within: InCollection,
    /// Label one part, numbered from 0 as in `coseg show`, instead of reading a file
    #[arg(long, value_name = "N", requires = "label", conflicts_with = "labels")]
    pub(crate) part: Option<u32>,
    /// The label of that part: an id, or the name of an existing label
    #[arg(long, value_name = "LABEL", requires = "part")]
    pub(crate) label: Option<String>,
    /// There are no labels but those that persons used, so every face gets one of these
    #[arg(long, conflicts_with = "open")]
    pub(crate) closed: bool,
    /// Discovered labels that no labelled shape shows are labels too, as they are without --closed
    #[arg(long)]
    pub(crate) open: bool,
    #[command(flatten)]
    pub(crate) person: Person,
    /// Return once the correction is durable, before it has been propagated to the other shapes
    #[arg(long)]
    pub(crate) no_wait: bool,
}

/// `coseg merge`
#[derive(Debug, Args)]
pub(crate) struct Merge {
    /// The label that is retired: its id or name
    pub(crate) label: String,
    /// The label that replaces it: its id or name
    pub(crate) into: String,
    #[command(flatten)]
    pub(crate) within: InCollection,
}

/// `coseg split`
#[derive(Debug, Args)]
pub(crate) struct Split {
    /// The label to split, its id or name; it keeps the larger share
    pub(crate) label: String,
    #[command(flatten)]
    pub(crate) within: InCollection,
    /// Return once the label is split, before all shapes are labelled again
    #[arg(long)]
    pub(crate) no_wait: bool,
}

/// `coseg undo`
#[derive(Debug, Args)]
pub(crate) struct Undo {
    #[command(flatten)]
    pub(crate) of: OneCollection,
    /// Return once the change is undone, before later shapes are labelled again
    #[arg(long)]
    pub(crate) no_wait: bool,
}

/// `coseg suggest`
#[derive(Debug, Args)]
pub(crate) struct Suggest {
    #[command(flatten)]
    pub(crate) of: OneCollection,
    /// Do not wait for queued shapes and relabellings
    #[arg(long)]
    pub(crate) no_wait: bool,
}

/// `coseg render`
#[derive(Debug, Args)]
pub(crate) struct Render {
    #[command(flatten)]
    pub(crate) of: OneCollection,
    /// The PNG file to write
    #[arg(long, short, value_name = "FILE")]
    pub(crate) out: PathBuf,
    /// Maximum number of shapes, in the order of their arrival
    #[arg(long, value_name = "N")]
    pub(crate) max: Option<usize>,
    /// Do not wait for queued shapes and relabellings
    #[arg(long)]
    pub(crate) no_wait: bool,
}
