//! Records all that exists (collections, shapes, labels, maps, jobs, requests and events) in one
//! SQLite file.
//!
//! One connection writes, behind a lock; a write is one transaction and durable when it returns
//! (`synchronous=FULL`). Readers have connections of their own and see the last commit at the
//! moment they began; with the write-ahead log readers and the writer never wait for each other.

mod collections;
mod corrections;
mod jobs;
mod labels;
mod links;
pub(in crate::store) mod log;
mod maps;
mod proposals;
mod reader;
mod reviews;
pub(crate) mod schema;
mod shapes;
pub(in crate::store) mod witness;

pub use corrections::KIND_NAME;
pub use labels::KEPT_LABEL_VERSIONS;
pub use reader::{Reader, Tx};
pub use schema::CATALOG_FORMAT;
pub use shapes::ReviewedAs;

use super::error::CATALOG_FILE;
use super::{Health, StoreError};
use rusqlite::config::DbConfig;
use rusqlite::{Connection, OpenFlags, TransactionBehavior, ffi};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use witness::{Found, Witness};

/// Other processes hold the file's lock only briefly (a worker that commits, a backup, `sqlite3`),
/// but a disk can be slow.
const BUSY_TIMEOUT: Duration = Duration::from_secs(60);

/// Memory for pages of each connection, in KiB. The kernel caches the rest of the file anyway; with
/// SQLite's default the connections of a daemon grow by 10 MB over its first thousands of
/// operations.
const PAGE_CACHE_KIB: i64 = 256;

/// Number of idle connections that are kept for the next readers; a burst opens more and closes
/// them again.
const KEPT_READERS: usize = 4;

/// The write-ahead log is copied into the file whenever it has grown by this size.
const CHECKPOINT_BYTES: u64 = 4 << 20;

/// Catalogs up to this size have their structure checked when they are opened, which takes a few
/// tenths of a second; larger ones are checked by `check` only.
const CHECKED_AT_OPEN_BYTES: u64 = 64 << 20;

/// The catalog of one library.
#[derive(Debug)]
pub struct Catalog {
    path: PathBuf,
    health: Health,
    /// Whether this process holds the library; otherwise it writes beside the process that does.
    holds: bool,
    writer: Mutex<Writer>,
    readers: Mutex<Vec<Connection>>,
}

#[derive(Debug)]
struct Writer {
    connection: Connection,
    /// Length of the write-ahead log at which the next checkpoint is due.
    checkpoint_at: u64,
}

impl Catalog {
    /// Opens the catalog at `path`, which is created if missing. The caller must hold the library's
    /// lock.
    pub fn open(path: &Path, health: Health) -> Result<Self, StoreError> {
        let log = log_of(path);
        if let Some(message) = log::damage(&log).map_err(|e| StoreError::io(&log, e))? {
            // Opening it would permanently delete the commits behind the damage.
            return Err(StoreError::Damaged {
                path: log.display().to_string(),
                message,
            });
        }
        if let Some(shortfall) = witness::shortfall(path)? {
            return Err(shortfall.refusal());
        }
        let mut connection = open_writer(path, OpenFlags::SQLITE_OPEN_CREATE)?;
        schema::prepare(&mut connection, &path.display().to_string())?;
        prepare_writer(&connection, path)?;
        refuse_writes_if_damaged(&connection, path, &health)?;
        if health.writable().is_ok() {
            bear_witness(&connection, path)?;
        }
        Ok(Self::over(connection, path, health, true))
    }

    /// Opens the catalog at `path`, which another process has opened and continues to use. Each
    /// process waits for the other's writes, a few seconds at most.
    pub fn open_beside(path: &Path, health: Health) -> Result<Self, StoreError> {
        let connection = open_writer(path, OpenFlags::empty())?;
        schema::check_format(&connection, &path.display().to_string())?;
        prepare_writer(&connection, path)?;
        Ok(Self::over(connection, path, health, false))
    }

    fn over(connection: Connection, path: &Path, health: Health, holds: bool) -> Self {
        let writer = Writer {
            connection,
            checkpoint_at: CHECKPOINT_BYTES,
        };
        Self {
            path: path.to_path_buf(),
            health,
            holds,
            writer: Mutex::new(writer),
            readers: Mutex::new(Vec::new()),
        }
    }

    /// Runs `change` in a transaction, which is durable when this returns `Ok`, and leaves no trace
    /// otherwise. Must not be called within a change, since the only writer is then busy.
    pub fn write<T, E: From<StoreError>>(
        &self,
        change: impl FnOnce(&Tx<'_>) -> Result<T, E>,
    ) -> Result<T, E> {
        self.health.writable()?;
        let mut writer = self.writer();
        let transaction = writer
            .connection
            .transaction_with_behavior(TransactionBehavior::Immediate)
            .map_err(|e| self.failed(e))?;
        let n_before = transaction.total_changes();
        let tx = Tx::new(&transaction);
        let value = change(&tx)?;
        let number = match transaction.total_changes() == n_before {
            true => None,
            false => Some(tx.number_commit(|| self.promised())?),
        };
        transaction.commit().map_err(|e| self.failed(e))?;
        let Some(number) = number else {
            return Ok(value);
        };
        // The witness advances only now, so that it promises nothing that is not durable.
        if let Err(error) = Witness::advance(&self.path, number) {
            tracing::warn!(%error, "{} cannot be written", witness::WITNESS_FILE);
        }
        // The change is durable even if the checkpoint fails: a failed sync stops later writes.
        if let Err(error) = self.checkpoint_if_due(&mut writer, number) {
            tracing::error!(%error, "the catalog's log could not be checkpointed");
        }
        Ok(value)
    }

    /// Runs `view` on the catalog in its present state; it does not see later commits.
    pub fn read<T, E: From<StoreError>>(
        &self,
        view: impl FnOnce(&Reader<'_>) -> Result<T, E>,
    ) -> Result<T, E> {
        let pooled = self.readers().pop();
        let mut connection = match pooled {
            Some(connection) => connection,
            None => open_reader(&self.path)?,
        };
        let value = {
            let transaction = connection.transaction().map_err(StoreError::from)?;
            view(&Reader::new(&transaction))
        };
        let mut readers = self.readers();
        if readers.len() < KEPT_READERS {
            readers.push(connection);
        }
        value
    }

    /// Copies the write-ahead log, whose newest commit has at least this number, into the file if
    /// it is long enough.
    fn checkpoint_if_due(&self, writer: &mut Writer, number: u64) -> Result<(), StoreError> {
        let length = std::fs::metadata(log_of(&self.path)).map_or(0, |metadata| metadata.len());
        if length < writer.checkpoint_at {
            return Ok(());
        }
        let copied = self.checkpoint(writer, number)?;
        writer.checkpoint_at = if copied { 0 } else { length } + CHECKPOINT_BYTES;
        Ok(())
    }

    /// Copies the log into the file and empties it, unless readers need it; returns whether it did.
    fn checkpoint(&self, writer: &Writer, number: u64) -> Result<bool, StoreError> {
        // The checkpoint does not wait for readers: frames that they need are copied the next time.
        writer.connection.busy_timeout(Duration::ZERO)?;
        let busy = writer
            .connection
            .query_row("PRAGMA wal_checkpoint(TRUNCATE)", [], |row| {
                row.get::<_, i64>(0)
            })
            .map_err(|e| self.failed(e));
        writer.connection.busy_timeout(BUSY_TIMEOUT)?;
        let copied = busy? == 0;
        if copied {
            let (library, old) = match Witness::read(&self.path)? {
                Found::Whole(old) => (old.library.clone(), Some(old)),
                // If the witness was removed, a new one is written.
                _ => (Reader::new(&writer.connection).library_id()?, None),
            };
            let at_least = |before: Option<u64>| number.max(before.unwrap_or(0));
            let witness = Witness {
                library,
                settled: at_least(old.as_ref().map(|w| w.settled)),
                committed: at_least(old.as_ref().map(|w| w.committed)),
            };
            if old.as_ref() != Some(&witness) {
                witness.write(&self.path).map_err(|error| match error {
                    StoreError::NoSpace { .. } => error,
                    error => self.health.stop(error.to_string()),
                })?;
            }
        }
        Ok(copied)
    }

    /// Empties the log, so that the file alone is the catalog. The process that holds the library
    /// calls it at its end, when no other process writes.
    pub fn settle(&self) {
        if !self.holds || self.health.writable().is_err() {
            return;
        }
        if let Err(error) = self.try_settle() {
            // The log stays, and the next process that opens the library reads it.
            tracing::warn!(%error, "the catalog's log was left as it is");
        }
    }

    fn try_settle(&self) -> Result<(), StoreError> {
        self.readers().clear();
        let writer = self.writer();
        let number = Reader::new(&writer.connection).n_commits()?;
        if self.checkpoint(&writer, number)? {
            // The log has been copied, so the process that closes the file last may remove the
            // empty log.
            let keep = DbConfig::SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE;
            writer.connection.set_db_config(keep, false)?;
        }
        Ok(())
    }

    /// The number up to which commits are known to be durable.
    fn promised(&self) -> u64 {
        match Witness::read(&self.path) {
            Ok(Found::Whole(witness)) => witness.committed,
            _ => 0,
        }
    }

    /// The error for a statement that syncs; a failed sync stops all writes.
    fn failed(&self, error: rusqlite::Error) -> StoreError {
        match error.sqlite_error().map(|e| e.extended_code) {
            Some(ffi::SQLITE_IOERR_FSYNC | ffi::SQLITE_IOERR_DIR_FSYNC) => self
                .health
                .stop(format!("fsync {}: {error}", self.path.display())),
            _ => error.into(),
        }
    }

    fn writer(&self) -> MutexGuard<'_, Writer> {
        // A panic in a change has rolled its transaction back.
        self.writer.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn readers(&self) -> MutexGuard<'_, Vec<Connection>> {
        self.readers.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Catalog {
    fn drop(&mut self) {
        self.settle();
    }
}

/// Ensures that a witness exists that matches the catalog.
fn bear_witness(connection: &Connection, path: &Path) -> Result<(), StoreError> {
    Witness::tidy(path)?;
    let reader = Reader::new(connection);
    let (library, committed) = match (reader.library_id(), reader.n_commits()) {
        (Ok(library), Ok(committed)) => (library, committed),
        // `check` names the damaged row.
        (Err(e), _) | (_, Err(e)) if e.is_damage() => return Ok(()),
        (Err(e), _) | (_, Err(e)) => return Err(e),
    };
    let settled = match Witness::read(path)? {
        Found::Whole(found) if found.committed == committed => return Ok(()),
        Found::Whole(found) => found.settled,
        Found::Missing => 0,
        Found::Damaged(what) => {
            tracing::warn!("{what}; it is rewritten from the catalog");
            0
        }
    };
    let witness = Witness {
        library,
        settled,
        committed,
    };
    match witness.write(path) {
        // A full disk must not prevent reading.
        Err(error @ StoreError::NoSpace { .. }) => {
            tracing::warn!(%error, "no witness of the catalog's log");
            Ok(())
        }
        other => other,
    }
}

/// A connection that may write.
fn open_writer(path: &Path, more: OpenFlags) -> Result<Connection, StoreError> {
    let flags = OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_NO_MUTEX | more;
    let connection = Connection::open_with_flags(path, flags)?;
    schema::register_row_sum(&connection)?;
    connection.busy_timeout(BUSY_TIMEOUT)?;
    // Negative: a size in KiB, rather than a number of pages.
    connection.pragma_update(None, "cache_size", -PAGE_CACHE_KIB)?;
    connection.pragma_update(None, "foreign_keys", true)?;
    // Only checkpoints copy the log into the file, because they check for failures.
    connection.set_db_config(DbConfig::SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, true)?;
    Ok(connection)
}

/// Sets how a connection commits.
fn prepare_writer(connection: &Connection, path: &Path) -> Result<(), StoreError> {
    let mode: String =
        connection.pragma_update_and_check(None, "journal_mode", "WAL", |row| row.get(0))?;
    if mode != "wal" {
        return Err(StoreError::Damaged {
            path: path.display().to_string(),
            message: format!("its file system allows journal mode {mode:?} only, not \"wal\""),
        });
    }
    connection.pragma_update(None, "synchronous", "FULL")?;
    // Without spills and automatic checkpoints, all syncs happen in COMMIT and in `checkpoint`,
    // where failures are detected.
    connection.pragma_update(None, "cache_spill", false)?;
    connection.pragma_update(None, "wal_autocheckpoint", 0)?;
    connection.set_prepared_statement_cache_capacity(128);
    Ok(())
}

/// Searches for structural damage, which a lookup may miss: a row behind a broken index seems to be
/// missing. Writes based on such a lookup (of a request that seems new) would increase the damage.
fn refuse_writes_if_damaged(
    connection: &Connection,
    path: &Path,
    health: &Health,
) -> Result<(), StoreError> {
    let length = std::fs::metadata(path)
        .map_err(|e| StoreError::io(path, e))?
        .len();
    if length > CHECKED_AT_OPEN_BYTES {
        return Ok(());
    }
    let found = connection
        .query_row("PRAGMA integrity_check(1)", [], |row| {
            row.get::<_, String>(0)
        })
        .map_err(StoreError::from);
    match found {
        Ok(found) if found == "ok" => Ok(()),
        Ok(found) => {
            health.stop(format!("{} is damaged: {found}", path.display()));
            Ok(())
        }
        Err(error) if error.is_damage() => {
            health.stop(error.to_string());
            Ok(())
        }
        Err(error) => Err(error),
    }
}

/// Opens a catalog for reading only, beside a process that may be writing it.
pub(super) fn open_reader(path: &Path) -> Result<Connection, StoreError> {
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let connection = Connection::open_with_flags(path, flags)?;
    schema::register_row_sum(&connection)?;
    connection.busy_timeout(BUSY_TIMEOUT)?;
    connection.pragma_update(None, "cache_size", -PAGE_CACHE_KIB)?;
    connection.set_prepared_statement_cache_capacity(64);
    schema::check_format(&connection, &path.display().to_string())?;
    Ok(connection)
}

/// The write-ahead log of the catalog at `path`.
pub(super) fn log_of(path: &Path) -> PathBuf {
    let mut log = path.to_path_buf().into_os_string();
    log.push("-wal");
    log.into()
}

/// The catalog's path in a library folder.
pub(super) fn path_in(library: &Path) -> PathBuf {
    library.join(CATALOG_FILE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::rows::{CollectionId, NewCollection};

    fn opened() -> (tempfile::TempDir, Catalog, CollectionId) {
        let dir = tempfile::tempdir().expect("a folder");
        let catalog = Catalog::open(&path_in(dir.path()), Health::default()).expect("opens");
        let new = NewCollection {
            name: "a".into(),
            ..NewCollection::default()
        };
        let id = catalog
            .write(|tx| tx.insert_collection(&new))
            .expect("inserted");
        (dir, catalog, id)
    }

    fn state(catalog: &Catalog, id: CollectionId) -> Vec<u8> {
        let row = catalog.read(|r| r.collection_by_id(id)).expect("readable");
        row.expect("there").state
    }

    #[test]
    fn a_full_disk_is_an_error_that_passes() {
        let (_dir, catalog, id) = opened();
        let limit = |pages: u32| {
            let writer = catalog.writer();
            let set = |row: &rusqlite::Row<'_>| row.get::<_, u32>(0);
            writer
                .connection
                .pragma_update_and_check(None, "max_page_count", pages, set)
                .expect("set");
        };
        limit(1);
        let big = vec![1; 1 << 20];
        let full = catalog.write(|tx| tx.set_state(id, &big));
        assert!(matches!(full, Err(StoreError::NoSpace { .. })), "{full:?}");
        assert_eq!(state(&catalog, id), b"");
        limit(1 << 20);
        catalog
            .write(|tx| tx.set_state(id, &big))
            .expect("there is space again");
        assert_eq!(state(&catalog, id), big);
    }

    #[test]
    fn a_failed_sync_ends_writing_and_not_reading() {
        let (_dir, catalog, id) = opened();
        let error = ffi::Error {
            code: rusqlite::ErrorCode::SystemIoFailure,
            extended_code: ffi::SQLITE_IOERR_FSYNC,
        };
        let failed = catalog.failed(rusqlite::Error::SqliteFailure(error, None));
        assert!(matches!(failed, StoreError::ReadOnly { .. }), "{failed}");
        let refused = catalog.write(|tx| tx.set_state(id, b"x"));
        assert!(
            matches!(refused, Err(StoreError::ReadOnly { .. })),
            "{refused:?}"
        );
        assert_eq!(state(&catalog, id), b"");
    }

    #[test]
    fn the_log_stays_bounded_even_beside_a_reader() {
        let (_dir, catalog, id) = opened();
        let log = catalog.path.with_file_name("catalog.db-wal");
        let write = || {
            for i in 0..40_u8 {
                catalog
                    .write(|tx| tx.set_state(id, &vec![i; 1 << 18]))
                    .expect("written");
            }
        };
        let length = || std::fs::metadata(&log).expect("there").len();
        write();
        assert!(length() <= CHECKPOINT_BYTES + (1 << 19), "{}", length());
        // While a reader keeps the log from being emptied, commits continue.
        let seen = catalog.read(|r| {
            let before = r.collection_by_id(id)?.expect("there").state;
            write();
            assert_eq!(r.collection_by_id(id)?.expect("there").state, before);
            Ok::<_, StoreError>(before)
        });
        assert_eq!(seen.expect("readable"), vec![39; 1 << 18]);
        write();
        write();
        assert!(length() <= 16 << 20, "{}", length());
    }
}
