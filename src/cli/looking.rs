//! Defines the flags of commands that show a library or the daemon.

use super::OneCollection;
use clap::Args;
use std::ffi::OsString;
use std::path::PathBuf;

/// `coseg view`
#[derive(Debug, Args)]
pub(crate) struct View {
    #[command(flatten)]
    pub(crate) of: OneCollection,
    /// The HTML file to write
    #[arg(long, short, value_name = "FILE")]
    pub(crate) out: PathBuf,
    /// Maximum number of shapes, in the order of their arrival
    #[arg(long, value_name = "N")]
    pub(crate) max: Option<usize>,
    /// Number of shapes with eigenfunctions and heat kernel signature, about 70 kB each
    #[arg(long, value_name = "N", default_value_t = 40)]
    pub(crate) functions: usize,
    /// Number of shapes with functional maps, two for each, of about 7 kB
    #[arg(long, value_name = "N", default_value_t = 40)]
    pub(crate) maps: usize,
    /// Do not wait for queued shapes and relabellings
    #[arg(long)]
    pub(crate) no_wait: bool,
}

/// `coseg top`
#[derive(Debug, Args)]
pub(crate) struct Top {
    /// Seconds between updates
    #[arg(long, short, value_name = "SECONDS", default_value = "1", value_parser = super::seconds)]
    pub(crate) interval: std::time::Duration,
    /// Exit after this many updates
    #[arg(long, short = 'n', value_name = "N")]
    pub(crate) limit: Option<u64>,
}

/// `coseg usd`
#[derive(Debug, Args)]
pub(crate) struct Usd {
    /// `label`, `correct` or `--help`, and their arguments
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, required = true)]
    pub(crate) arguments: Vec<OsString>,
}
