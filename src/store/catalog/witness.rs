//! Stores the least number of changes that the catalog must contain in a small file beside it.
//!
//! Commits are in the write-ahead log until a checkpoint copies them into the catalog's file. To
//! SQLite, a log that was deleted, cut or exchanged looks like one that was never written, and the
//! catalog like an older one. So every commit is numbered, in a row of `meta`, and its number is
//! written to the witness once it is durable. Hence the witness never promises more than is
//! durable.
//!
//! The number is written in place and not synced: the writes of a process survive its end, and
//! after a loss of power the witness may promise less than the catalog contains, never more.
//! Checkpoints rewrite the file, synced, together with the number of changes in the catalog's file
//! alone: fewer changes there mean an older file under a newer log.

use super::reader::Reader;
use super::schema;
use crate::store::disk::{Disk, RealDisk};
use crate::store::error::CATALOG_FILE;
use crate::store::{Digest, StoreError};
use rusqlite::{Connection, ErrorCode, OpenFlags};
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

/// The file, in the library's folder.
pub(in crate::store) const WITNESS_FILE: &str = "catalog.commits";

/// The row of `meta` with the library's id.
pub(super) const LIBRARY_ID: &str = "library_id";

/// The row of `meta` that numbers commits.
pub(super) const COMMITS: &str = "commits";

/// The beginning of the file.
const MAGIC: &str = "coseg-commits 1";

/// Number of attempts to read a file that another process may be writing.
const N_LOOKS: usize = 3;

/// The least contents of the catalog.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::store) struct Witness {
    /// The library's id.
    pub(in crate::store) library: String,
    /// Commits that are in the catalog's file, without its log.
    pub(in crate::store) settled: u64,
    /// Commits that are in the file and its log together.
    pub(in crate::store) committed: u64,
}

/// The state of the witness file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::store) enum Found {
    /// No file: an older version created the library, or only the catalog was copied.
    Missing,
    /// The file is not a witness; the reason.
    Damaged(String),
    /// The file is a witness.
    Whole(Witness),
}

/// The difference between a catalog and its witness.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::store) struct Shortfall {
    /// A description of the loss.
    pub(in crate::store) what: String,
    /// Whether the log does not belong to the catalog's file and must not be used with it.
    pub(in crate::store) foreign_log: bool,
}

impl Shortfall {
    /// The error for opening the library.
    pub(in crate::store) fn refusal(self) -> StoreError {
        StoreError::Damaged {
            path: CATALOG_FILE.into(),
            message: format!(
                "{}. Nothing was changed. Put back what is missing (catalog.db and catalog.db-wal \
                 belong together), or restore a snapshot; `coseg check --repair` keeps a copy and \
                 continues with the rest",
                self.what
            ),
        }
    }
}

impl Witness {
    /// Reads the witness of the catalog at `catalog`.
    pub(in crate::store) fn read(catalog: &Path) -> Result<Found, StoreError> {
        let path = path_of(catalog);
        let mut found = Found::Missing;
        for _ in 0..N_LOOKS {
            found = match RealDisk.read(&path) {
                Ok(bytes) => Self::parse(&bytes),
                Err(e) if e.kind() == io::ErrorKind::NotFound => Found::Missing,
                Err(e) => return Err(StoreError::io(&path, e)),
            };
            if !matches!(found, Found::Damaged(_)) {
                break;
            }
        }
        Ok(found)
    }

    /// Replaces the witness durably.
    pub(in crate::store) fn write(&self, catalog: &Path) -> Result<(), StoreError> {
        let path = path_of(catalog);
        // Other processes may write it, after checkpoints of their own.
        let temporary = path.with_extension(format!("commits.{}", std::process::id()));
        let written = remove_if_there(&temporary)
            .and_then(|()| {
                let mut file = RealDisk.create(&temporary)?;
                file.write_all(self.text().as_bytes())?;
                file.sync()
            })
            .and_then(|()| RealDisk.rename(&temporary, &path))
            .and_then(|()| RealDisk.sync_dir(folder_of(catalog)))
            .inspect_err(|_| {
                let _ = std::fs::remove_file(&temporary);
            });
        written.map_err(|e| StoreError::io(&path, e))
    }

    /// Removes files of processes that ended while they wrote. Call it when holding the library,
    /// before others write.
    pub(in crate::store) fn tidy(catalog: &Path) -> Result<(), StoreError> {
        let folder = folder_of(catalog);
        let tidied = std::fs::read_dir(folder).and_then(|mut entries| {
            entries.try_for_each(|entry| {
                let entry = entry?;
                match entry
                    .file_name()
                    .to_string_lossy()
                    .strip_prefix(WITNESS_FILE)
                {
                    Some(rest) if rest.starts_with('.') => remove_if_there(&entry.path()),
                    _ => Ok(()),
                }
            })
        });
        tidied.map_err(|e| StoreError::io(folder, e))
    }

    /// Records that commit `committed` is durable, unless a later one is recorded already. Does
    /// nothing without an intact witness of this library.
    pub(in crate::store) fn advance(catalog: &Path, committed: u64) -> io::Result<()> {
        let opened = File::options()
            .read(true)
            .write(true)
            .open(path_of(catalog));
        let file = match opened {
            // The next checkpoint creates one.
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(()),
            opened => opened?,
        };
        let mut bytes = [0; 256];
        let n = file.read_at(&mut bytes, 0)?;
        let Found::Whole(mut witness) = Self::parse(&bytes[..n]) else {
            return Err(io::Error::other("it is damaged"));
        };
        if witness.committed < committed {
            witness.committed = committed;
            // The text has constant length and lies within one sector, so that after a loss of
            // power either the old or the new text remains.
            file.write_all_at(witness.text().as_bytes(), 0)?;
        }
        Ok(())
    }

    fn text(&self) -> String {
        let Self {
            library,
            settled,
            committed,
        } = self;
        let text = format!("{MAGIC} {library} {settled:020} {committed:020}");
        format!(
            "{text} {}\n",
            &Digest::of(text.as_bytes()).to_string()[..16]
        )
    }

    fn parse(bytes: &[u8]) -> Found {
        let parsed = std::str::from_utf8(bytes).ok().and_then(|text| {
            let mut words = text.strip_prefix(MAGIC)?.split_whitespace();
            let witness = Self {
                library: words.next()?.to_owned(),
                settled: words.next()?.parse().ok()?,
                committed: words.next()?.parse().ok()?,
            };
            (witness.text() == text).then_some(witness)
        });
        match parsed {
            Some(witness) => Found::Whole(witness),
            None => Found::Damaged(format!("{WITNESS_FILE} is damaged")),
        }
    }
}

/// The library and the number of commits that a catalog contains.
#[derive(Debug, Default, PartialEq, Eq)]
struct Contents {
    library: String,
    commits: u64,
}

/// The difference between the catalog at `catalog` and its witness, if any. It changes no file, and
/// may run beside a writer.
///
/// A catalog that damage makes unreadable has no shortfall: other checks find the damage.
pub(in crate::store) fn shortfall(catalog: &Path) -> Result<Option<Shortfall>, StoreError> {
    // The witness is read before the catalog, which may gain commits meanwhile.
    let Found::Whole(witness) = Witness::read(catalog)? else {
        return Ok(None);
    };
    let promised = witness.committed;
    let lacks = |what: String| {
        Ok(Some(Shortfall {
            what,
            foreign_log: false,
        }))
    };
    match std::fs::metadata(catalog) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => {
            return lacks(format!(
                "the catalog is missing, with the {promised} changes that it held"
            ));
        }
        Err(e) => return Err(StoreError::io(catalog, e)),
        Ok(_) => {}
    }
    if let Ok(alone) = contents_without_log(catalog) {
        let foreign = alone.library != witness.library && !alone.library.is_empty();
        if foreign {
            return lacks(format!(
                "the catalog is that of another library ({}, where {} was)",
                alone.library, witness.library
            ));
        }
        // Its pages are older than the log assumes, so together they would be inconsistent.
        if alone.commits < witness.settled {
            return Ok(Some(Shortfall {
                what: format!(
                    "catalog.db holds {} changes where {} were put into it: an older file was put \
                     in its place",
                    alone.commits, witness.settled
                ),
                foreign_log: true,
            }));
        }
    }
    let Some(found) = contents(catalog)? else {
        return Ok(None);
    };
    if found.library != witness.library {
        return Ok(Some(Shortfall {
            what: "catalog.db-wal is the log of another catalog".into(),
            foreign_log: true,
        }));
    }
    if found.commits < promised {
        return lacks(format!(
            "catalog.db with its log holds {} changes of {promised} that were acknowledged: the \
             log (catalog.db-wal) is missing, was cut or is an older one",
            found.commits
        ));
    }
    Ok(None)
}

/// The contents of the catalog, including its log; `None` if damage makes it unreadable.
fn contents(catalog: &Path) -> Result<Option<Contents>, StoreError> {
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let has_log = std::fs::metadata(super::log_of(catalog)).is_ok_and(|log| log.len() > 0);
    // SQLite would create a missing log.
    let read = match has_log {
        true => Connection::open_with_flags(catalog, flags)
            .map_err(StoreError::from)
            .and_then(|connection| contents_of(&connection)),
        false => contents_without_log(catalog),
    };
    match read {
        Ok(found) => Ok(Some(found)),
        Err(e) if e.is_damage() => Ok(None),
        // Its tables are not those of a catalog; the check of its format has a better message.
        Err(StoreError::Catalog(e)) if e.sqlite_error_code() == Some(ErrorCode::Unknown) => {
            Ok(None)
        }
        Err(e) => Err(e),
    }
}

/// The contents of the catalog's file without its log; opened as immutable.
fn contents_without_log(catalog: &Path) -> Result<Contents, StoreError> {
    use std::os::unix::ffi::OsStrExt as _;
    let mut uri = String::from("file:");
    for byte in catalog.as_os_str().as_bytes() {
        match byte {
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'/' | b'.' | b'_' | b'-' => {
                uri.push(char::from(*byte));
            }
            other => uri.push_str(&format!("%{other:02X}")),
        }
    }
    uri.push_str("?immutable=1");
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY
        | OpenFlags::SQLITE_OPEN_NO_MUTEX
        | OpenFlags::SQLITE_OPEN_URI;
    contents_of(&Connection::open_with_flags(uri, flags)?)
}

fn contents_of(connection: &Connection) -> Result<Contents, StoreError> {
    connection.busy_timeout(super::BUSY_TIMEOUT)?;
    schema::register_row_sum(connection)?;
    let n_tables: i64 =
        connection.query_row("SELECT count(*) FROM sqlite_schema", [], |row| row.get(0))?;
    if n_tables == 0 {
        return Ok(Contents::default());
    }
    let reader = Reader::new(connection);
    Ok(Contents {
        library: reader.meta(LIBRARY_ID)?.unwrap_or_default(),
        commits: reader.n_commits()?,
    })
}

fn remove_if_there(path: &Path) -> io::Result<()> {
    match std::fs::remove_file(path) {
        Err(e) if e.kind() != io::ErrorKind::NotFound => Err(e),
        _ => Ok(()),
    }
}

fn path_of(catalog: &Path) -> PathBuf {
    catalog.with_file_name(WITNESS_FILE)
}

fn folder_of(catalog: &Path) -> &Path {
    match catalog.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}
