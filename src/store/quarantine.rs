//! Moves damaged data aside instead of deleting it: files, and the catalog before its repair.

use super::catalog::witness::{self, Found, Shortfall, Witness};
use super::catalog::{self, log, schema};
use super::disk::{Disk, RealDisk};
use super::lock::LibraryLock;
use super::{Store, StoreError};
use rusqlite::Connection;
use std::fs;
use std::path::{Path, PathBuf};

/// The folder in a library for data that was moved aside.
pub const QUARANTINE: &str = "quarantine";

/// Rebuilds the indexes of a catalog with a damaged structure, after copying it to the quarantine.
/// Returns true if the structure was damaged and is now intact. No process may hold the library.
///
/// # Errors
/// If the library is held, or the damage is not limited to indexes.
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
    // A checkpoint into one file makes the copy complete.
    connection.query_row("PRAGMA wal_checkpoint(TRUNCATE)", [], |_| Ok(()))?;
    keep_catalog(dir)?;
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

/// Accepts the present state of a catalog that lacks changes because its log is damaged, missing,
/// cut or of another time; the previous files are moved aside. Returns a description of the loss,
/// if any. No process may hold the library.
///
/// # Errors
/// If the library is held, or has no catalog to continue with.
pub fn accept_loss(dir: &Path) -> Result<Option<String>, StoreError> {
    let _lock = LibraryLock::acquire(dir)?;
    let path = catalog::path_in(dir);
    let log_path = catalog::log_of(&path);
    let damaged = log::damage(&log_path).map_err(|e| StoreError::io(&log_path, e))?;
    let shortfall = witness::shortfall(&path)?;
    let what = match (&damaged, &shortfall) {
        (None, None) => return Ok(None),
        (_, Some(shortfall)) => shortfall.what.clone(),
        (Some(damaged), None) => damaged.clone(),
    };
    let refused = || StoreError::Damaged {
        path: super::error::CATALOG_FILE.to_owned(),
        message: format!("{what}; there is nothing to go on with: restore a snapshot"),
    };
    if !path.exists() {
        return Err(refused());
    }
    let copy = keep_catalog(dir)?;
    let foreign_log = |s: &Shortfall| s.foreign_log;
    if shortfall.as_ref().is_some_and(foreign_log) {
        let mut index = path.clone().into_os_string();
        index.push("-shm");
        for file in [&log_path, &PathBuf::from(index)] {
            match fs::remove_file(file) {
                Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                    return Err(StoreError::io(file, e));
                }
                _ => {}
            }
        }
    }
    let connection = catalog::open_reader(&path)?;
    let reader = catalog::Reader::new(&connection);
    let (library, committed) = (reader.library_id()?, reader.n_commits()?);
    if let Found::Whole(old) = Witness::read(&path)?
        && old.library != library
    {
        return Err(refused());
    }
    drop(connection);
    // Copies the rest of the log into the file.
    let connection = Connection::open(&path)?;
    connection.query_row("PRAGMA wal_checkpoint(TRUNCATE)", [], |_| Ok(()))?;
    drop(connection);
    let witness = Witness {
        library,
        settled: committed,
        committed,
    };
    witness.write(&path)?;
    let copy = copy.strip_prefix(dir).unwrap_or(&copy).display();
    Ok(Some(format!(
        "{what}; the library continues from change {committed}, and {copy} has the previous files"
    )))
}

/// Copies the catalog and its log into the quarantine; returns the path of the copy.
fn keep_catalog(dir: &Path) -> Result<PathBuf, StoreError> {
    let path = catalog::path_in(dir);
    let kept = dir.join(QUARANTINE);
    let make = |e| StoreError::io(&kept, e);
    RealDisk.create_dir(&kept).map_err(make)?;
    let free = |n: &u32| !kept.join(format!("catalog-{n}.db")).exists();
    let n = (1..).find(free).expect("invariant: numbers do not end");
    let copy = kept.join(format!("catalog-{n}.db"));
    for (from, to) in [
        (path.clone(), copy.clone()),
        (catalog::log_of(&path), catalog::log_of(&copy)),
    ] {
        match fs::copy(&from, &to) {
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => {}
            Err(e) => return Err(StoreError::io(&to, e)),
            Ok(_) => {
                let synced = fs::File::open(&to).and_then(|f| f.sync_all());
                synced.map_err(|e| StoreError::io(&to, e))?;
            }
        }
    }
    RealDisk.sync_dir(&kept).map_err(make)?;
    Ok(copy)
}

impl Store {
    /// Moves a file, named relative to the library, into the quarantine; does nothing if it is
    /// missing.
    ///
    /// # Errors
    /// If the file cannot be moved.
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
