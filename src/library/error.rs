//! Defines the errors of operations on the library.

use super::likely::{did_you_mean, likeliest};
use super::reason::{Code, Reason};
use super::types::{Failure, FailureSubject};
use crate::store::StoreError;

pub(super) type Result<T> = std::result::Result<T, LibraryError>;

/// An error of an operation on the library.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // the messages say it
pub enum LibraryError {
    /// The message names the value and the limit. `reason` is stable.
    #[error("{message}")]
    InvalidArgument { reason: Reason, message: String },
    /// The same for one location in the input.
    #[error("{message}")]
    InvalidFace {
        reason: Reason,
        message: String,
        subject: FailureSubject,
    },
    /// `nearest` is the name that was probably meant.
    #[error("no {what} named {name:?}{}", did_you_mean(nearest.as_deref()))]
    NotFound {
        what: Named,
        name: String,
        nearest: Option<String>,
    },
    #[error("{message}")]
    AlreadyExists { reason: Reason, message: String },
    #[error("{message}")]
    FailedPrecondition { reason: Reason, message: String },
    /// A shape was refused.
    #[error("{}", .0.message)]
    Refused(Failure),
    #[error(transparent)]
    Store(#[from] StoreError),
}

/// A thing that the library looks up by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum Named {
    Collection,
    Shape,
    Label,
    Job,
    JobItem,
    Version,
    Link,
}

impl std::fmt::Display for Named {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Collection => "collection",
            Self::Shape => "shape",
            Self::Label => "label",
            Self::Job => "job",
            Self::JobItem => "job item",
            Self::Version => "version",
            Self::Link => "link",
        })
    }
}

impl From<&LibraryError> for Failure {
    fn from(error: &LibraryError) -> Self {
        let (code, reason) = match error {
            LibraryError::InvalidArgument { reason, .. }
            | LibraryError::InvalidFace { reason, .. } => (Code::InvalidArgument, *reason),
            LibraryError::NotFound { what, .. } => (
                Code::NotFound,
                match what {
                    Named::Collection => Reason::NoCollection,
                    Named::Shape => Reason::NoShape,
                    Named::Label => Reason::NoLabel,
                    Named::Job => Reason::NoJob,
                    Named::Version => Reason::NoVersion,
                    Named::Link => Reason::NoLink,
                    Named::JobItem => Reason::Unspecified,
                },
            ),
            LibraryError::AlreadyExists { reason, .. } => (Code::AlreadyExists, *reason),
            LibraryError::FailedPrecondition { reason, .. } => (Code::FailedPrecondition, *reason),
            LibraryError::Refused(failure) => return failure.clone(),
            LibraryError::Store(StoreError::NoSpace { .. }) => {
                (Code::ResourceExhausted, Reason::NoSpace)
            }
            LibraryError::Store(StoreError::ReadOnly { .. }) => {
                (Code::FailedPrecondition, Reason::ReadOnly)
            }
            LibraryError::Store(e) if e.is_damage() => (Code::DataLoss, Reason::Damaged),
            LibraryError::Store(_) => (Code::Internal, Reason::Store),
        };
        Self {
            code,
            reason,
            message: error.to_string(),
            subject: match error {
                LibraryError::InvalidFace { subject, .. } => Some(*subject),
                _ => None,
            },
        }
    }
}

impl LibraryError {
    /// Makes the error for a name that does not exist.
    pub(super) fn not_found(what: Named, name: impl Into<String>) -> Self {
        Self::NotFound {
            what,
            name: name.into(),
            nearest: None,
        }
    }

    /// Makes the error for a name that is not among `known`. The error suggests the most similar of
    /// them.
    pub(super) fn none_of(what: Named, name: &str, known: &[String]) -> Self {
        let nearest = likeliest(name, known.iter().map(String::as_str));
        Self::NotFound {
            what,
            name: name.to_owned(),
            nearest: nearest.map(str::to_owned),
        }
    }

    /// Makes the error for a collection that was deleted during its use.
    pub(super) fn deleted(collection: &str) -> Self {
        Self::FailedPrecondition {
            reason: Reason::Gone,
            message: format!("collection {collection:?} was deleted meanwhile"),
        }
    }

    pub(super) fn invalid(reason: Reason, message: String) -> Self {
        Self::InvalidArgument { reason, message }
    }
}

impl crate::store::FullDisk for LibraryError {
    fn is_full_disk(&self) -> bool {
        matches!(self, Self::Store(e) if e.is_full_disk())
    }
}
