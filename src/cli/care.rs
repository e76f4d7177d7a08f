//! Flags of the commands for whoever looks after a daemon: keys, jobs, check, snapshots.

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

/// What to do with keys.
#[derive(Debug, Subcommand)]
pub(crate) enum KeysCommand {
    /// Make the daemon's pair of keys, or a client's, which may then connect
    Generate {
        /// The daemon's: server.key, server.pub and an empty allow list
        #[arg(long, conflicts_with = "name")]
        server: bool,
        /// The client's name
        #[arg(required_unless_present = "server")]
        name: Option<String>,
        /// What the client may do: read-only, ingest or admin
        #[arg(long, default_value = "ingest")]
        role: Role,
        /// The client's key file [default: NAME.key in the folder of keys]
        #[arg(long, value_name = "FILE", conflicts_with = "server")]
        out: Option<PathBuf>,
    },
    /// Let a client in that has made its own keys
    Allow {
        /// Its public key, or a file with it
        key: String,
        /// Its name
        name: String,
        /// What it may do: read-only, ingest or admin
        #[arg(long, default_value = "ingest")]
        role: Role,
    },
    /// List who may connect
    List,
    /// Let a client in no more; a running daemon refuses it within a second
    Revoke {
        /// Its name or public key
        who: String,
    },
}

/// `coseg jobs`
#[derive(Debug, Args)]
pub(crate) struct Jobs {
    /// Only shapes that failed, and why
    #[arg(long)]
    pub(crate) failed: bool,
    /// Only of this collection
    #[command(flatten)]
    pub(crate) of: OneCollection,
    /// At most this many jobs, the newest
    #[arg(long, short = 'n', value_name = "N")]
    pub(crate) limit: Option<u64>,
}

/// `coseg retry`
#[derive(Debug, Args)]
pub(crate) struct Retry {
    /// The job, as `coseg jobs --failed` lists it
    pub(crate) job: u64,
    /// Return when its failed shapes are queued
    #[arg(long)]
    pub(crate) no_wait: bool,
}

/// `coseg cancel`
#[derive(Debug, Args)]
pub(crate) struct Cancel {
    /// The jobs, as `coseg jobs` lists them
    #[arg(value_name = "JOB", required_unless_present = "collection")]
    pub(crate) jobs: Vec<u64>,
    /// Every job of this collection that is not finished
    #[arg(long, short, value_name = "NAME", conflicts_with = "jobs")]
    pub(crate) collection: Option<String>,
}

/// `coseg stop`
#[derive(Debug, Args)]
pub(crate) struct Stop {
    /// Return when the daemon has been told, not when it has ended
    #[arg(long)]
    pub(crate) no_wait: bool,
}

/// `coseg snapshot`
#[derive(Debug, Args)]
pub(crate) struct Snapshot {
    /// Folder to make
    pub(crate) to: PathBuf,
    /// Folder of the library [default: as `coseg config show` says]
    #[arg(long, value_name = "DIR")]
    pub(crate) library: Option<PathBuf>,
    /// Hard links in the place of copies: at once and without space, but damaged together
    #[arg(long)]
    pub(crate) link: bool,
}

/// `coseg restore`
#[derive(Debug, Args)]
pub(crate) struct Restore {
    /// The snapshot
    pub(crate) from: PathBuf,
    /// Folder of the library, missing or empty [default: as `coseg config show` says]
    #[arg(long, value_name = "DIR")]
    pub(crate) library: Option<PathBuf>,
}
