//! What a person types to correct labels.

use super::questions::Person;
use super::{InCollection, OneCollection};
use clap::Args;
use std::path::PathBuf;

/// `coseg correct`
#[derive(Debug, Args)]
pub(crate) struct Correct {
    /// The shape
    pub(crate) shape: String,
    /// An integer a line for each face of the shape's file, in its order: its label; -1 leaves it
    /// alone. Also .npy, .seg and .json as `coseg export` writes them
    #[arg(value_name = "LABELS", required_unless_present = "part")]
    pub(crate) labels: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) within: InCollection,
    /// Label one part, numbered from 0 as `coseg show` lists them, instead of reading a file
    #[arg(long, value_name = "N", requires = "label", conflicts_with = "labels")]
    pub(crate) part: Option<u32>,
    /// The label of that part: an id, or the name of a label that is there
    #[arg(long, value_name = "LABEL", requires = "part")]
    pub(crate) label: Option<String>,
    #[command(flatten)]
    pub(crate) person: Person,
    /// Return when the correction is durable, not when it is carried to the other shapes
    #[arg(long)]
    pub(crate) no_wait: bool,
}

/// `coseg merge`
#[derive(Debug, Args)]
pub(crate) struct Merge {
    /// The label that goes: its id or name
    pub(crate) label: String,
    /// The label that stands for both: its id or name
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
    /// Return when the label is split, not when all shapes are labelled anew
    #[arg(long)]
    pub(crate) no_wait: bool,
}

/// `coseg undo`
#[derive(Debug, Args)]
pub(crate) struct Undo {
    #[command(flatten)]
    pub(crate) of: OneCollection,
    /// Return when the change is undone, not when shapes that came since are labelled anew
    #[arg(long)]
    pub(crate) no_wait: bool,
}

/// `coseg suggest`
#[derive(Debug, Args)]
pub(crate) struct Suggest {
    #[command(flatten)]
    pub(crate) of: OneCollection,
    /// Do not wait for shapes and relabellings that are queued
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
    /// At most this many shapes, in the order of their arrival
    #[arg(long, value_name = "N")]
    pub(crate) max: Option<usize>,
    /// Do not wait for shapes and relabellings that are queued
    #[arg(long)]
    pub(crate) no_wait: bool,
}
