//! `coseg-bench` compares labels and maps with known ones, and measures time.

mod ask;
mod transfer;
mod error;
mod labels;
mod made;
mod maps;
mod partial;
mod print;
mod proposals;
mod session;
mod signatures;
mod stream;

use clap::{Args, Parser, Subcommand};
use error::Outcome;
use std::process::ExitCode;
use std::time::Duration;

/// The allocator of the daemon, so that both are measured under equal conditions.
#[global_allocator]
static ALLOCATOR: tikv_jemallocator::Jemalloc = tikv_jemallocator::Jemalloc;

/// Exit code of an invalid command line, as in `coseg`.
const USAGE: u8 = 2;

/// Measures the accuracy and the speed of coseg's labels and maps.
#[derive(Debug, Parser)]
#[command(name = "coseg-bench", version, arg_required_else_help = true)]
struct Cli {
    #[command(flatten)]
    global: Global,
    #[command(subcommand)]
    bench: Bench,
}

/// Flags of every measurement.
#[derive(Debug, Clone, Args)]
struct Global {
    /// Seconds to wait for an answer of the bench's own daemon; at least 120
    #[arg(long, global = true, value_name = "SECONDS", default_value_t = 120,
          value_parser = clap::value_parser!(u64).range(1..=86_400))]
    timeout: u64,
    /// Print only JSON on stdout
    #[arg(long, global = true)]
    json: bool,
}

impl Global {
    /// Time limit for an answer; it is generous because other work may share the machine.
    fn patience(&self) -> Duration {
        Duration::from_secs(self.timeout.max(120))
    }
}

#[derive(Debug, Subcommand)]
enum Bench {
    /// Label meshes with known parts, streamed one by one, and compare
    Labels(labels::BenchLabels),
    /// Stream meshes with known parts, answer questions about parts by the truth, and compare
    Ask(ask::BenchAsk),
    /// Map meshes with known correspondence to each other, and compare
    Maps(maps::BenchMaps),
    /// Time the signatures of points, in comparison with copying the eigenvectors
    Signatures(signatures::BenchSignatures),
    /// The bench's own daemon starts this program again for each of its workers
    #[command(hide = true)]
    Worker,
}

fn run(cli: &Cli) -> Outcome {
    match &cli.bench {
        Bench::Labels(args) => labels::run(args, &cli.global),
        Bench::Ask(args) => ask::run(args, &cli.global),
        Bench::Maps(args) => maps::run(args, &cli.global),
        Bench::Signatures(args) => signatures::run(args, &cli.global),
        Bench::Worker => unreachable!("invariant: main hands workers over before"),
    }
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    if matches!(cli.bench, Bench::Worker) {
        return coseg::daemon::run_worker();
    }
    match run(&cli) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(e) if e.is_silent() => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("coseg-bench: {e}");
            ExitCode::from(if e.is_usage() { USAGE } else { 1 })
        }
    }
}
