//! `coseg man` prints the manual page, generated from `--help`.

use super::{CommandError, Outcome};
use crate::cli::Cli;
use clap::CommandFactory as _;
use clap_mangen::Man;
use std::io::Write as _;
use std::path::Path;

pub(crate) fn run(out: Option<&Path>) -> Outcome {
    let Some(directory) = out else {
        let mut page = Vec::new();
        Man::new(Cli::command())
            .render(&mut page)
            .map_err(CommandError::Output)?;
        let mut out = std::io::stdout().lock();
        out.write_all(&page)
            .and_then(|()| out.flush())
            .map_err(CommandError::Output)?;
        return Ok(true);
    };
    let file = |source| CommandError::File {
        path: directory.display().to_string(),
        source,
    };
    std::fs::create_dir_all(directory).map_err(file)?;
    clap_mangen::generate_to(Cli::command(), directory).map_err(file)?;
    eprintln!("manual pages written to {}", directory.display());
    Ok(true)
}
