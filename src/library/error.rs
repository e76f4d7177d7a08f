//! Why an operation on the library failed.

use super::{Failure, FailureSubject};
use crate::store::StoreError;

/// Why an operation on the library failed.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // the messages say it
pub enum LibraryError {
    /// Names what is wrong and the limit. `reason` is stable.
    #[error("{message}")]
    InvalidArgument {
        reason: &'static str,
        message: String,
    },
    /// The same, of one place in the input.
    #[error("{message}")]
    InvalidFace {
        reason: &'static str,
        message: String,
        subject: FailureSubject,
    },
    #[error("no {what} named {name:?}")]
    NotFound { what: &'static str, name: String },
    #[error("{message}")]
    AlreadyExists {
        reason: &'static str,
        message: String,
    },
    #[error("{message}")]
    FailedPrecondition {
        reason: &'static str,
        message: String,
    },
    /// A shape was refused.
    #[error("{}", .0.message)]
    Refused(Failure),
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl LibraryError {
    pub(super) fn invalid(reason: &'static str, message: String) -> Self {
        Self::InvalidArgument { reason, message }
    }
}

impl crate::store::FullDisk for LibraryError {
    fn is_full_disk(&self) -> bool {
        matches!(self, Self::Store(e) if e.is_full_disk())
    }
}
