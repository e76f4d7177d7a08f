//! The errors of a measurement.

use coseg::daemon::StartError;
use coseg::ipc::client::ClientError;
use coseg::library::LibraryError;
use std::path::Path;

/// The reason why a measurement failed.
#[derive(Debug, thiserror::Error)]
pub(crate) enum BenchError {
    /// The daemon did not answer, or refused.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// The daemon did not start.
    #[error(transparent)]
    Start(#[from] StartError),
    /// The daemon's library could not be read after it had ended.
    #[error(transparent)]
    Library(#[from] LibraryError),
    /// The command line is wrong.
    #[error("{0}")]
    Usage(String),
    /// A step failed.
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

impl BenchError {
    /// The error for a file that could not be read or written.
    pub(crate) fn file(path: &Path, source: std::io::Error) -> Self {
        Self::File {
            path: path.display().to_string(),
            source,
        }
    }

    /// Whether the command line must be changed.
    pub(crate) fn is_usage(&self) -> bool {
        matches!(self, Self::Usage(_))
    }

    /// Whether no message should be printed, because the reader of a pipe has closed it.
    pub(crate) fn is_silent(&self) -> bool {
        matches!(self, Self::Output(e) if e.kind() == std::io::ErrorKind::BrokenPipe)
    }
}

/// Whether every shape was labelled; failures of single shapes are in the figures.
pub(crate) type Outcome = Result<bool, BenchError>;
