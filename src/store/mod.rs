//! Where descriptions, originals and the catalog live on disk.

pub mod check;
pub mod mapped;

/// Why the store refused or failed.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum StoreError {
    #[error("{path}: {source}")]
    Io { path: String, source: std::io::Error },
    #[error("{path}: {message}")]
    Damaged { path: String, message: String },
    #[error("catalog: {0}")]
    Catalog(#[from] rusqlite::Error),
    #[error("{path} is held by another process")]
    Locked { path: String },
    #[error("{path} has store format {found}, this version reads {supported}")]
    Version { path: String, found: u32, supported: u32 },
    #[error("writes are refused since {since}: {cause}")]
    ReadOnly { since: String, cause: String },
}
