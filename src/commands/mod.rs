//! Implements the subcommands, one file for each.

mod add;
mod approve;
mod ask;
mod check;
mod collections;
mod completions;
mod config;
mod confirm;
mod correct;
pub(crate) mod demo;
mod demo_ply;
pub(crate) mod describe;
mod describe_full;
mod events;
mod export;
mod export_mesh;
mod interrupt;
mod jobs;
mod keys;
mod label;
mod label_file;
mod labels;
mod links;
mod ls;
mod man;
mod map;
mod merge;
mod mesh_file;
mod mesh_files;
mod name;
mod nearest;
mod npy;
mod proposals;
mod publish;
mod render;
mod rm;
mod serve;
mod session;
mod show;
mod stats;
mod stop;
mod suggest;
pub(crate) mod synth;
mod top;
mod transfer;
mod undo;
mod usd;
mod values;
mod view;
mod wait;
mod watch;

use crate::cli::{Cli, Command, exit};
use coseg::config::ConfigError;
use coseg::daemon::ServeError;
use coseg::ipc::client::ClientError;
use coseg::ipc::endpoint::EndpointError;
use coseg::ipc::json;
use coseg::ipc::keys::KeyError;
use coseg::ipc::wire::{ErrorReason, LinkKind};
use coseg::library::{BundleError, LibraryError};
use session::Session;
use std::process::ExitCode;

/// The reasons why a command failed.
#[derive(Debug, thiserror::Error)]
pub(crate) enum CommandError {
    /// The daemon did not answer, or refused.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// Keys are unusable.
    #[error(transparent)]
    Keys(#[from] KeyError),
    /// The configuration is wrong.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The daemon did not start.
    #[error(transparent)]
    Serve(#[from] ServeError),
    /// A library could not be used without a daemon.
    #[error(transparent)]
    Library(#[from] LibraryError),
    /// A bundle could not be written or opened.
    #[error(transparent)]
    Bundle(#[from] BundleError),
    /// Logging cannot be set up.
    #[error(transparent)]
    Telemetry(#[from] crate::telemetry::TelemetryError),
    /// Shapes could not be generated.
    #[error(transparent)]
    Synth(#[from] synth::SynthError),
    /// The arguments are invalid.
    #[error("{0}")]
    Usage(String),
    /// Several collections are possible, and none was named.
    #[error("there are several collections, choose one with --collection: {0}")]
    Ambiguous(String),
    /// The command failed.
    #[error("{0}")]
    Failed(String),
    /// A file could not be read or written.
    #[error("{path}: {source}")]
    File {
        /// The file.
        path: String,
        /// The cause.
        source: std::io::Error,
    },
    /// The reader of stdout has closed it.
    #[error("stdout: {0}")]
    Output(std::io::Error),
}

impl CommandError {
    /// The exit code, as documented in `coseg --help`.
    pub(crate) fn exit_code(&self) -> ExitCode {
        let code = match self {
            Self::Client(ClientError::NoAnswer { .. }) => exit::NO_ANSWER,
            Self::Client(ClientError::Endpoint(_))
            | Self::Usage(_)
            | Self::Ambiguous(_)
            | Self::Config(_) => exit::USAGE,
            Self::Serve(ServeError::Start(e)) if e.is_configuration() => exit::USAGE,
            Self::Output(e) if e.kind() == std::io::ErrorKind::BrokenPipe => 0,
            Self::Client(_)
            | Self::Serve(_)
            | Self::Library(_)
            | Self::Bundle(_)
            | Self::Telemetry(_)
            | Self::Keys(_)
            | Self::Synth(_)
            | Self::Failed(_)
            | Self::File { .. }
            | Self::Output(_) => exit::FAILED,
        };
        ExitCode::from(code)
    }

    /// The next step for the user, unless the message already implies it.
    pub(crate) fn advice(&self) -> Option<&'static str> {
        let refusal = match self {
            Self::Client(ClientError::NoAnswer { .. }) => {
                return Some("start one with `coseg serve`, or give its address with --endpoint");
            }
            Self::Client(ClientError::Refused(e)) => e,
            _ => return None,
        };
        Some(match refusal.reason() {
            ErrorReason::NoCollection => "`coseg ls` lists the collections",
            ErrorReason::NoShape => "`coseg ls NAME` lists the shapes of a collection",
            ErrorReason::NoLabel | ErrorReason::LabelMerged => {
                "`coseg show --collection NAME` lists the labels"
            }
            ErrorReason::ProposalsChanged => "`coseg proposals NAME` lists the present ones",
            ErrorReason::LinkContradicts | ErrorReason::LinkLimit | ErrorReason::NoLink => {
                "`coseg links` lists the links, and `coseg unlink` removes one"
            }
            ErrorReason::PartIndex => "`coseg show SHAPE` lists the parts",
            ErrorReason::Draining => "start the daemon again; it resumes the accepted work",
            ErrorReason::ReadOnly | ErrorReason::Damaged => {
                "look at the daemon's log, then run `coseg check`"
            }
            ErrorReason::NoSpace => "make room on the disk of the library; nothing was lost",
            _ => return None,
        })
    }

    /// Whether no message should be printed.
    pub(crate) fn is_silent(&self) -> bool {
        matches!(self, Self::Output(e) if e.kind() == std::io::ErrorKind::BrokenPipe)
    }
}

impl From<EndpointError> for CommandError {
    fn from(e: EndpointError) -> Self {
        Self::Client(e.into())
    }
}

/// Whether the command succeeded for all its items; messages about the others were printed.
pub(crate) type Outcome = Result<bool, CommandError>;

/// Runs one command.
pub(crate) fn run(cli: Cli) -> Result<ExitCode, CommandError> {
    let session = || Session::open(&cli.global);
    let done = match &cli.command {
        Command::Serve(args) => serve::run(args, &cli.global),
        Command::Check(args) => check::run(args, &cli.global),
        Command::Snapshot(args) => check::snapshot(args, &cli.global),
        Command::Restore(args) => check::restore(args, &cli.global),
        Command::Describe(args) => describe::run(args, &cli.global),
        Command::Config(args) => config::run(args, &cli.global),
        Command::Label(args) => label::run(args, &cli.global),
        Command::Add(args) => add::run(args, session()?),
        Command::Wait(args) => wait::run(args, session()?),
        Command::Ls(args) => ls::run(args, session()?),
        Command::Show(args) => show::run(args, session()?),
        Command::Labels(args) => labels::run(args, session()?),
        Command::Export(args) => export::run(args, session()?),
        Command::Publish(args) => publish::run(args, session()?),
        Command::Render(args) => render::run(args, session()?),
        Command::Map(args) => map::run(args, session()?),
        Command::Transfer(args) => transfer::run(args, session()?),
        Command::Nearest(args) => nearest::run(args, session()?),
        Command::Rm(args) => rm::run(args, session()?),
        Command::Watch(args) => watch::run(args, session()?),
        Command::Events(args) => events::run(args, session()?),
        Command::Name(args) => name::run(args, session()?),
        Command::Suggest(args) => suggest::run(args, session()?),
        Command::Ask(args) => ask::run(args, session()?),
        Command::Answer(args) => ask::answer(args, session()?),
        Command::Approve(args) => approve::run(args, session()?),
        Command::Correct(args) => correct::run(args, session()?),
        Command::Merge(args) => merge::merge(args, session()?),
        Command::Split(args) => merge::split(args, session()?),
        Command::Proposals(args) => proposals::run(args, session()?),
        Command::Choose(args) => proposals::choose(args, session()?),
        Command::Same(args) => links::link(args, LinkKind::Same, session()?),
        Command::Differ(args) => links::link(args, LinkKind::Differ, session()?),
        Command::Links(args) => links::list(args, session()?),
        Command::Unlink(args) => links::unlink(args, session()?),
        Command::Undo(args) => undo::run(args, session()?),
        Command::Collections(args) => collections::run(args, session()?),
        Command::Synth(args) => synth::run(args, cli.global.json)
            .map(|()| true)
            .map_err(Into::into),
        Command::Demo(args) => demo::run(args, &cli.global),
        Command::Jobs(args) => jobs::jobs(args, session()?),
        Command::Retry(args) => jobs::retry(args, session()?),
        Command::Cancel(args) => jobs::cancel(args, session()?),
        Command::Keys(args) => keys::run(args, &cli.global),
        Command::Worker => return Ok(coseg::daemon::run_worker()),
        Command::View(args) => view::run(args, session()?),
        Command::Stats => stats::run(session()?),
        Command::Top(args) => top::run(args, session()?),
        Command::Completions { shell } => completions::run(*shell),
        Command::Man { out } => man::run(out.as_deref()),
        Command::Stop(args) => stop::run(args, session()?),
        Command::Usd(args) => usd::run(args, &cli.global),
    }?;
    Ok(ExitCode::from(if done { 0 } else { exit::FAILED }))
}
