//! The `coseg` command: the daemon and its clients.

mod cli;
mod commands;
mod telemetry;

use clap::Parser as _;
use std::process::ExitCode;

/// Gives memory back after bursts of work, where the system's allocator keeps it in its arenas.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    let cli = cli::Cli::parse();
    match commands::run(cli) {
        Ok(code) => code,
        Err(e) => {
            if !e.is_silent() {
                eprintln!("coseg: {e}");
            }
            e.exit_code()
        }
    }
}
