//! The errors of the store.

use rusqlite::ErrorCode;
use std::path::Path;

/// The reason why the store refused or failed.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // the messages say it
pub enum StoreError {
    #[error("{path}: {source}")]
    Io {
        path: String,
        source: std::io::Error,
    },
    /// The disk is full. The operation changed nothing, and succeeds once there is space.
    #[error("{path}: no space left on the device")]
    NoSpace { path: String },
    #[error("{path}: {message}")]
    Damaged { path: String, message: String },
    /// A row of the catalog differs from what was written.
    #[error("catalog: {table} {key}: {message}")]
    DamagedRow {
        table: &'static str,
        key: String,
        message: String,
    },
    #[error("catalog: {table} has no row {key}")]
    Missing { table: &'static str, key: String },
    #[error("catalog: {table} already has a row {key}")]
    Exists { table: &'static str, key: String },
    #[error("catalog: {table} {key} refers to a row that does not exist")]
    Dangling { table: &'static str, key: String },
    #[error("catalog: the {what} is {value}, but must be {expected}")]
    Must {
        what: &'static str,
        value: u64,
        expected: u64,
    },
    #[error(transparent)]
    Array(#[from] super::mapped::ArrayFileError),
    #[error("catalog: {0}")]
    Catalog(rusqlite::Error),
    #[error("{path} is held by {holder}")]
    Locked { path: String, holder: String },
    #[error("{path} has store format {found}, this version reads {supported}")]
    Version {
        path: String,
        found: u32,
        supported: u32,
    },
    #[error("writes are refused since {since}: {cause}")]
    ReadOnly { since: String, cause: String },
}

/// The name of the catalog's file in errors.
pub(super) const CATALOG_FILE: &str = "catalog.db";

impl StoreError {
    /// The error for an input or output error at `path`; a full disk gets a variant of its own.
    pub(crate) fn io(path: &Path, source: std::io::Error) -> Self {
        let path = path.display().to_string();
        if is_no_space(&source) {
            Self::NoSpace { path }
        } else {
            Self::Io { path, source }
        }
    }

    /// Whether data on disk are lost or wrong, as opposed to a temporary refusal.
    pub fn is_damage(&self) -> bool {
        matches!(self, Self::Damaged { .. } | Self::DamagedRow { .. })
    }
}

/// A full disk or an exhausted quota.
pub(super) fn is_no_space(error: &std::io::Error) -> bool {
    use std::io::ErrorKind;
    matches!(
        error.kind(),
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded
    )
}

impl From<rusqlite::Error> for StoreError {
    fn from(error: rusqlite::Error) -> Self {
        let path = || CATALOG_FILE.to_string();
        match error.sqlite_error_code() {
            Some(ErrorCode::DiskFull) => Self::NoSpace { path: path() },
            Some(ErrorCode::DatabaseCorrupt | ErrorCode::NotADatabase) => Self::Damaged {
                path: path(),
                message: error.to_string(),
            },
            _ => Self::Catalog(error),
        }
    }
}
