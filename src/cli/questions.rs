//! What a person types to answer questions and to give verdicts.

use super::{InCollection, OneCollection};
use clap::{ArgGroup, Args, ValueEnum};
use std::path::PathBuf;

/// Who answers, corrects or approves.
#[derive(Debug, Args)]
pub(crate) struct Person {
    /// Who does it, as reviews say [default: the user's name]
    #[arg(long, value_name = "NAME")]
    pub(crate) by: Option<String>,
}

impl Person {
    /// The name; empty if there is none.
    pub(crate) fn name(&self) -> String {
        let user = || std::env::var("USER").unwrap_or_default();
        self.by.clone().unwrap_or_else(user)
    }
}

/// `coseg ask`
#[derive(Debug, Args)]
pub(crate) struct Ask {
    #[command(flatten)]
    pub(crate) of: OneCollection,
    /// Draw the shape of each question to this PNG file, with the part in colour
    #[arg(long, value_name = "FILE")]
    pub(crate) png: Option<PathBuf>,
    /// Ask again about parts that were passed over
    #[arg(long)]
    pub(crate) passed: bool,
    #[command(flatten)]
    pub(crate) person: Person,
}

/// `coseg answer`
#[derive(Debug, Args)]
#[command(group = ArgGroup::new("answer").required(true))]
pub(crate) struct AnswerQuestion {
    /// The part, as `coseg ask` names it: SHAPE:NUMBER
    pub(crate) part: String,
    /// Its label: an id, or the name of a label that is there
    #[arg(group = "answer")]
    pub(crate) label: Option<String>,
    /// The name of its label, which is created if it is not there
    #[arg(long, value_name = "NAME", group = "answer")]
    pub(crate) new: Option<String>,
    /// Do not ask about it again
    #[arg(long, group = "answer")]
    pub(crate) skip: bool,
    /// It has more than one label
    #[arg(long, group = "answer")]
    pub(crate) cut_wrongly: bool,
    #[command(flatten)]
    pub(crate) within: InCollection,
    #[command(flatten)]
    pub(crate) person: Person,
}

/// `coseg approve`
#[derive(Debug, Args)]
pub(crate) struct Approve {
    /// The shape
    pub(crate) shape: String,
    #[command(flatten)]
    pub(crate) within: InCollection,
    /// Note instead that something is wrong with it, and change no label
    #[arg(long)]
    pub(crate) doubtful: bool,
    #[command(flatten)]
    pub(crate) person: Person,
    /// Return once the verdict is durable, before it has been propagated to the other shapes
    #[arg(long)]
    pub(crate) no_wait: bool,
}

/// A verdict to list shapes by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Verdict {
    /// Nobody gave one
    Unseen,
    /// A person labelled some faces
    Corrected,
    /// A person found all labels right
    Approved,
    /// A person found something wrong that is still there
    Doubtful,
}
