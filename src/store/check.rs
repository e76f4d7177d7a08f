//! Verifies everything on disk against the catalog.

/// Something wrong, or worth knowing, about one file or row.
#[derive(Debug, Clone, PartialEq)]
pub struct Finding {
    /// File, relative to the library, or table and key.
    pub place: String,
    /// What is wrong.
    pub message: String,
    /// Whether data is lost or wrong; false for orphans that the next sweep removes.
    pub damage: bool,
}
