//! What is damaged is put aside, never deleted: files, and the catalog as it was before it was mended.

use super::catalog::{self, schema};
use super::disk::{Disk, RealDisk};
use super::lock::LibraryLock;
use super::{Store, StoreError};
use rusqlite::Connection;
use std::fs;
use std::path::Path;

/// The folder in a library for what was put aside.
pub const QUARANTINE: &str = "quarantine";

/// Rebuilds the indexes of a catalog whose structure is damaged, after putting a copy of it aside; true if it
/// was, and all is well now. No process may hold the library.
///
/// # Errors
/// The library is held, or the catalog is damaged in more than its indexes.
pub fn rebuild_indexes(dir: &Path) -> Result<bool, StoreError> {
    let _lock = LibraryLock::acquire(dir)?;
    let path = catalog::path_in(dir);
    let integrity = |connection: &Connection| -> Result<String, StoreError> {
        let found = connection.query_row("PRAGMA integrity_check(1)", [], |row| {
            row.get::<_, String>(0)
        });
        Ok(found?)
    };
    let connection = Connection::open(&path)?;
    schema::register_row_sum(&connection)?;
    schema::check_format(&connection, &path.display().to_string())?;
    if integrity(&connection).is_ok_and(|found| found == "ok") {
        return Ok(false);
    }
    // Into one file, so that the copy has all of it.
    connection.query_row("PRAGMA wal_checkpoint(TRUNCATE)", [], |_| Ok(()))?;
    let kept = dir.join(QUARANTINE);
    let make = |e| StoreError::io(&kept, e);
    RealDisk.create_dir(&kept).map_err(make)?;
    let mut n = 1;
    let copy = loop {
        let copy = kept.join(format!("catalog-{n}.db"));
        if !copy.exists() {
            break copy;
        }
        n += 1;
    };
    fs::copy(&path, &copy).map_err(|e| StoreError::io(&copy, e))?;
    connection.execute_batch("REINDEX")?;
    let found = integrity(&connection)?;
    if found == "ok" {
        return Ok(true);
    }
    Err(StoreError::Damaged {
        path: super::error::CATALOG_FILE.to_owned(),
        message: format!("{found}; rebuilding its indexes did not help"),
    })
}

impl Store {
    /// Moves a file, named relative to the library, into the quarantine; nothing if it is missing.
    ///
    /// # Errors
    /// The file cannot be moved.
    pub fn put_aside(&self, file: &str) -> Result<(), StoreError> {
        let from = self.dir().join(file);
        if !from.exists() {
            return Ok(());
        }
        let folder = self.dir().join(QUARANTINE);
        RealDisk
            .create_dir(&folder)
            .map_err(|e| StoreError::io(&folder, e))?;
        let to = folder.join(file.replace('/', "-"));
        fs::rename(&from, &to).map_err(|e| StoreError::io(&to, e))?;
        for folder in [Some(folder.as_path()), from.parent()]
            .into_iter()
            .flatten()
        {
            RealDisk
                .sync_dir(folder)
                .map_err(|e| StoreError::io(folder, e))?;
        }
        Ok(())
    }
}
