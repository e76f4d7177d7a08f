//! Defines the flags of commands for operators of a daemon: keys, jobs, check, snapshots.

use super::OneCollection;
use clap::{Args, Subcommand};
use coseg::ipc::keys::Role;
use std::path::PathBuf;

/// `coseg keys`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  coseg keys --dir keys generate --server              the daemon's keys
  coseg keys --dir keys generate laptop --role ingest  a client's
  coseg keys --dir keys revoke laptop")]
pub(crate) struct Keys {
    /// Folder of keys [default: security.keys of the configuration, else ~/.config/coseg/keys]
    #[arg(long, value_name = "DIR", global = true)]
    pub(crate) dir: Option<PathBuf>,
    #[command(subcommand)]
    pub(crate) command: KeysCommand,
}

/// The subcommands of `coseg keys`.
#[derive(Debug, Subcommand)]
pub(crate) enum KeysCommand {
    /// Generate the daemon's pair of keys, or those of a client, which may then connect
    Generate {
        /// Generate the daemon's keys: server.key, server.pub and an empty allow list
        #[arg(long, conflicts_with = "name")]
        server: bool,
        /// The client's name
        #[arg(required_unless_present = "server")]
        name: Option<String>,
        /// The client's role: read-only, ingest or admin
        #[arg(long, default_value = "ingest")]
        role: Role,
        /// The client's key file [default: NAME.key in the folder of keys]
        #[arg(long, value_name = "FILE", conflicts_with = "server")]
        out: Option<PathBuf>,
    },
    /// Allow a client that has generated its own keys to connect
    Allow {
        /// Its public key, or a file that contains it
        key: String,
        /// Its name
        name: String,
        /// Its role: read-only, ingest or admin
        #[arg(long, default_value = "ingest")]
        role: Role,
    },
    /// List the clients that may connect
    List,
    /// Revoke a client's key; a running daemon refuses it within a second
    Revoke {
        /// Its name or public key
        who: String,
    },
}

/// `coseg jobs`
#[derive(Debug, Args)]
pub(crate) struct Jobs {
    /// Only failed shapes, with their errors
    #[arg(long)]
    pub(crate) failed: bool,
    /// Only jobs of this collection
    #[command(flatten)]
    pub(crate) of: OneCollection,
    /// Maximum number of jobs; the newest are listed
    #[arg(long, short = 'n', value_name = "N")]
    pub(crate) limit: Option<u64>,
}

/// `coseg retry`
#[derive(Debug, Args)]
pub(crate) struct Retry {
    /// The job, as listed by `coseg jobs --failed`
    pub(crate) job: u64,
    /// Return once its failed shapes are queued
    #[arg(long)]
    pub(crate) no_wait: bool,
}

/// `coseg cancel`
#[derive(Debug, Args)]
pub(crate) struct Cancel {
    /// The jobs, as listed by `coseg jobs`
    #[arg(value_name = "JOB", required_unless_present = "collection")]
    pub(crate) jobs: Vec<u64>,
    /// All unfinished jobs of this collection
    #[arg(long, short, value_name = "NAME", conflicts_with = "jobs")]
    pub(crate) collection: Option<String>,
}

/// `coseg stop`
#[derive(Debug, Args)]
pub(crate) struct Stop {
    /// Return once the daemon has received the request, before it has ended
    #[arg(long)]
    pub(crate) no_wait: bool,
}

/// `coseg snapshot`
#[derive(Debug, Args)]
pub(crate) struct Snapshot {
    /// Folder to create for the copy
    pub(crate) to: PathBuf,
    /// Folder of the library [default: shown by `coseg config show`]
    #[arg(long, value_name = "DIR")]
    pub(crate) library: Option<PathBuf>,
    /// Use hard links instead of copies: fast and without extra space, but damage affects both
    #[arg(long)]
    pub(crate) link: bool,
}

/// `coseg restore`
#[derive(Debug, Args)]
pub(crate) struct Restore {
    /// The snapshot
    pub(crate) from: PathBuf,
    /// Folder of the library, missing or empty [default: shown by `coseg config show`]
    #[arg(long, value_name = "DIR")]
    pub(crate) library: Option<PathBuf>,
}
