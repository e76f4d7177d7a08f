//! A small file beside the catalog says how many changes it must at least hold.
//!
//! Commits are in the write-ahead log until a checkpoint copies them into the catalog's file. A log
//! that is deleted, cut or exchanged looks to SQLite like one that was never written, and the
//! catalog like an older one. So every commit is numbered, in a row of `meta`, and after it is
//! durable its number goes into the witness, which therefore never promises more than is durable.
//!
//! The number is written in place and not synced: a process that ends keeps what it wrote, and
//! after a loss of power the witness may promise less than there is, never more. Checkpoints write
//! the file anew, synced, and with it how many changes are in the catalog's file alone: fewer there
//! mean an older file under a newer log.

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

/// The row of `meta` that says which library it is.
pub(super) const LIBRARY_ID: &str = "library_id";

/// The row of `meta` that numbers commits.
pub(super) const COMMITS: &str = "commits";

/// How the file begins.
const MAGIC: &str = "coseg-commits 1";

/// Reads of a file that may be written meanwhile.
const N_LOOKS: usize = 3;

/// What the catalog must at least hold.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::store) struct Witness {
    /// The library's id.
    pub(in crate::store) library: String,
    /// Commits that are in the catalog's file, without its log.
    pub(in crate::store) settled: u64,
    /// Commits that are in the file and its log together.
    pub(in crate::store) committed: u64,
}

/// What was found in the place of the witness.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::store) enum Found {
    /// None: an older version made the library, or a copy has the catalog alone.
    Missing,
    /// Something else; why.
    Damaged(String),
    /// A witness.
    Whole(Witness),
}

/// How a catalog falls short of its witness.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::store) struct Shortfall {
    /// What happened, in words.
    pub(in crate::store) what: String,
    /// Whether the log does not belong to the catalog's file and must not be used with it.
    pub(in crate::store) foreign_log: bool,
}

impl Shortfall {
    /// The error of whoever wanted to open the library.
    pub(in crate::store) fn refusal(self) -> StoreError {
        StoreError::Damaged {
            path: CATALOG_FILE.into(),
            message: format!(
                "{}. Nothing was changed. Put back what is missing (catalog.db and catalog.db-wal \
                 belong together), or restore a snapshot; `coseg check --repair` keeps a copy and \
                 goes on with what is there",
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

    /// Writes it, durably, in the place of the one that is there.
    pub(in crate::store) fn write(&self, catalog: &Path) -> Result<(), StoreError> {
        let path = path_of(catalog);
        // Others may be at it, after checkpoints of theirs.
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

    /// Removes what processes left that ended while they wrote it. For whoever holds the library, before others write.
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

    /// Notes that commit `committed` is durable, unless a later one is noted already. Without a whole
    /// witness of this library there is nothing to note it in.
    pub(in crate::store) fn advance(catalog: &Path, committed: u64) -> io::Result<()> {
        let opened = File::options()
            .read(true)
            .write(true)
            .open(path_of(catalog));
        let file = match opened {
            // The next checkpoint makes one.
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
            // Of one length always and within one sector, so that a loss of power leaves the old or
            // the new.
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

/// What a catalog says of itself.
#[derive(Debug, Default, PartialEq, Eq)]
struct Said {
    library: String,
    commits: u64,
}

/// How the catalog at `catalog` falls short of its witness, if it does. Changes nothing, and may be
/// asked beside a writer.
///
/// What cannot be read for damage falls short of nothing: others find that.
pub(in crate::store) fn shortfall(catalog: &Path) -> Result<Option<Shortfall>, StoreError> {
    // Before the catalog, which meanwhile may have gained more.
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
    if let Ok(alone) = said_by_file_alone(catalog) {
        let foreign = alone.library != witness.library && !alone.library.is_empty();
        if foreign {
            return lacks(format!(
                "the catalog is that of another library ({}, where {} was)",
                alone.library, witness.library
            ));
        }
        // Its pages are older than the log supposes: together they would be a mixture.
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
    let Some(said) = said(catalog)? else {
        return Ok(None);
    };
    if said.library != witness.library {
        return Ok(Some(Shortfall {
            what: "catalog.db-wal is the log of another catalog".into(),
            foreign_log: true,
        }));
    }
    if said.commits < promised {
        return lacks(format!(
            "catalog.db with its log holds {} changes of {promised} that were acknowledged: the log \
             (catalog.db-wal) is missing, was cut or is an older one",
            said.commits
        ));
    }
    Ok(None)
}

/// What the catalog says, log included; `None` if that cannot be read for damage.
fn said(catalog: &Path) -> Result<Option<Said>, StoreError> {
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let has_log = std::fs::metadata(super::log_of(catalog)).is_ok_and(|log| log.len() > 0);
    // SQLite would make a log where there is none.
    let read = match has_log {
        true => Connection::open_with_flags(catalog, flags)
            .map_err(StoreError::from)
            .and_then(|connection| said_by(&connection)),
        false => said_by_file_alone(catalog),
    };
    match read {
        Ok(said) => Ok(Some(said)),
        Err(e) if e.is_damage() => Ok(None),
        // Its tables are not those of a catalog, which the check of its format says better.
        Err(StoreError::Catalog(e)) if e.sqlite_error_code() == Some(ErrorCode::Unknown) => {
            Ok(None)
        }
        Err(e) => Err(e),
    }
}

/// What the catalog's file says without its log: it is read as one that does not change.
fn said_by_file_alone(catalog: &Path) -> Result<Said, StoreError> {
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
    said_by(&Connection::open_with_flags(uri, flags)?)
}

fn said_by(connection: &Connection) -> Result<Said, StoreError> {
    connection.busy_timeout(super::BUSY_TIMEOUT)?;
    schema::register_row_sum(connection)?;
    let n_tables: i64 =
        connection.query_row("SELECT count(*) FROM sqlite_schema", [], |row| row.get(0))?;
    if n_tables == 0 {
        return Ok(Said::default());
    }
    let reader = Reader::new(connection);
    Ok(Said {
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
