//! Defines the errors of writing and opening bundles.

use crate::store::Digest;
use std::path::Path;

/// The reason why a bundle could not be written or opened.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // the messages say it
pub enum BundleError {
    #[error("{path}: {source}")]
    Io {
        path: String,
        source: std::io::Error,
    },
    #[error("{path} is no bundle of `coseg publish`: {message}")]
    NotABundle { path: String, message: String },
    #[error(
        "{path} has bundle format {found}, this version reads {supported}: publish the collection \
         again with this version, or label with the version that published it"
    )]
    Version {
        path: String,
        found: String,
        supported: u32,
    },
    #[error(
        "{path} holds descriptions by {found}, this version computes {supported}: publish the \
         collection again with this version, or label with the version that published it"
    )]
    Algorithm {
        path: String,
        found: String,
        supported: String,
    },
    #[error("{path} is damaged: {message}; copy it again from its source, or publish it again")]
    Damaged { path: String, message: String },
    #[error("the array file of {shape:?} has BLAKE3 {found}, but {expected} was published")]
    File {
        shape: String,
        found: Digest,
        expected: Digest,
    },
}

impl BundleError {
    pub(super) fn io(path: &Path, source: std::io::Error) -> Self {
        Self::Io {
            path: path.display().to_string(),
            source,
        }
    }

    pub(super) fn not_a_bundle(path: &Path, message: impl Into<String>) -> Self {
        Self::NotABundle {
            path: path.display().to_string(),
            message: message.into(),
        }
    }

    pub(super) fn damaged(path: &Path, message: impl Into<String>) -> Self {
        Self::Damaged {
            path: path.display().to_string(),
            message: message.into(),
        }
    }
}
