//! Why an operation on the library failed.

use super::likely::{did_you_mean, likeliest};
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
    /// `nearest` is what was probably meant.
    #[error("no {what} named {name:?}{}", did_you_mean(nearest.as_deref()))]
    NotFound {
        what: &'static str,
        name: String,
        nearest: Option<String>,
    },
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
    /// There is nothing of that name.
    pub(super) fn not_found(what: &'static str, name: impl Into<String>) -> Self {
        Self::NotFound {
            what,
            name: name.into(),
            nearest: None,
        }
    }

    /// There is none of that name among `known`, of which one may have been meant.
    pub(super) fn none_of(what: &'static str, name: &str, known: &[String]) -> Self {
        let nearest = likeliest(name, known.iter().map(String::as_str));
        Self::NotFound {
            what,
            name: name.to_owned(),
            nearest: nearest.map(str::to_owned),
        }
    }

    pub(super) fn invalid(reason: &'static str, message: String) -> Self {
        Self::InvalidArgument { reason, message }
    }
}

impl crate::store::FullDisk for LibraryError {
    fn is_full_disk(&self) -> bool {
        matches!(self, Self::Store(e) if e.is_full_disk())
    }
}
