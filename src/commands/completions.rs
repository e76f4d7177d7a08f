//! `coseg completions` prints a script that lets a shell complete commands and flags.

use super::{CommandError, Outcome};
use crate::cli::Cli;
use clap::CommandFactory as _;
use clap_complete::{Shell, generate};
use std::io::Write as _;

pub(crate) fn run(shell: Shell) -> Outcome {
    let mut script = Vec::new();
    generate(shell, &mut Cli::command(), "coseg", &mut script);
    let mut out = std::io::stdout().lock();
    out.write_all(&script)
        .and_then(|()| out.flush())
        .map_err(CommandError::Output)?;
    Ok(true)
}
