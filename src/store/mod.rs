//! Where descriptions, originals and the catalog live on disk.
//!
//! A library is a folder: `catalog.db` says what exists, `objects/` holds the arrays of each
//! description, `originals/` the bytes that were sent, `lock` says who holds it, and `tmp/` what is
//! being written. docs/format.md describes each.
//!
//! How something is committed, and why nothing half is ever seen:
//!
//! 1. [`Objects`] writes a file under `tmp/`, syncs it, renames it to its place and syncs the
//!    folder. Up to here nothing has happened: a file without a row is an orphan.
//! 2. One [`Catalog`] transaction inserts the rows: the objects, the shape, its labels, the changed
//!    model, the events, the finished job item, the reply. **The catalog row is the only commit
//!    marker, and it is never durable before the data it names.**
//! 3. Only when the transaction has returned is anybody told.
//!
//! A sync that fails makes the store read-only for as long as the process lives ([`Health`]); a full
//! disk is an error that passes. Committed files never change. The catalog has one writer, and
//! readers never wait for it. Orphans are swept when they are a day old, never at start.

pub mod agreement;
mod array_file;
pub mod array_stream;
pub mod catalog;
pub mod check;
mod codec;
mod digest;
pub mod disk;
mod error;
#[cfg(test)]
mod faulty;
mod health;
pub mod lock;
pub mod mapped;
pub mod objects;
pub mod quarantine;
pub mod rows;
pub mod snapshot;

pub use array_file::{DescriptionFile, write_description};
pub use array_stream::ArrayStream;
pub use catalog::{Catalog, Reader, Tx};
pub use digest::{Digest, NotADigest};
pub use error::StoreError;
pub use health::Health;
pub use mapped::MappedDescription;
pub use objects::Objects;
pub use rows::{
    CollectionId, CollectionRow, CorrectionRow, ItemStatus, JobItemRow, LabelRow, LabelSummary,
    LabelVersionRow, LabelsBefore, MapRow, NewCollection, NewJobItem, NewShapeRow, ObjectKind,
    ObjectRow, PointMapRow, RequestRow, ShapeId, ShapeRow,
};

use disk::{Disk, RealDisk};
use lock::LibraryLock;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// An open library folder, held by this process alone.
pub struct Store {
    objects: Objects,
    catalog: Catalog,
    health: Health,
    dir: PathBuf,
    // Last, so that it is released after the catalog is closed. None: another process holds it.
    lock: Option<LibraryLock>,
}

impl Store {
    /// Opens the library in `dir`, which is created, readable by its owner's group at most, if it
    /// is missing.
    pub fn open(dir: &Path) -> Result<Self, StoreError> {
        create_library_folder(dir)?;
        let lock = LibraryLock::acquire(dir)?;
        Self::open_with(Catalog::open, dir, Some(lock))
    }

    /// Opens the library in `dir`, which another process holds, to change what that process lets this one change. It must
    /// be there, in the current format.
    pub fn open_beside(dir: &Path) -> Result<Self, StoreError> {
        Self::open_with(Catalog::open_beside, dir, None)
    }

    fn open_with(
        open_catalog: fn(&Path, Health) -> Result<Catalog, StoreError>,
        dir: &Path,
        lock: Option<LibraryLock>,
    ) -> Result<Self, StoreError> {
        let health = Health::default();
        // Before the objects' folders, so that their sync of `dir` covers the catalog's name.
        let catalog = open_catalog(&catalog::path_in(dir), health.clone())?;
        let disk: Arc<dyn Disk> = Arc::new(RealDisk);
        let objects = Objects::open(disk, dir, health.clone())?;
        Ok(Self {
            objects,
            catalog,
            health,
            dir: dir.to_path_buf(),
            lock,
        })
    }

    /// Lets the processes that this one starts from now on hold the library too, until they end: nobody else opens it
    /// while one of them may still write.
    pub fn share_lock(&self) -> Result<(), StoreError> {
        match &self.lock {
            Some(lock) => lock.share().map_err(|e| StoreError::io(&self.dir, e)),
            None => Ok(()),
        }
    }

    /// Tells whoever finds the library held where its holder listens.
    pub fn tell_endpoint(&self, endpoint: &str) -> Result<(), StoreError> {
        match &self.lock {
            Some(lock) => lock
                .tell(endpoint)
                .map_err(|e| StoreError::io(&self.dir, e)),
            None => Ok(()),
        }
    }

    /// The object files.
    pub fn objects(&self) -> &Objects {
        &self.objects
    }

    /// The catalog.
    pub fn catalog(&self) -> &Catalog {
        &self.catalog
    }

    /// Whether writes are refused, and since when and why.
    pub fn health(&self) -> &Health {
        &self.health
    }

    /// The library's folder.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// Removes what nothing needs any more: the rows of unreferenced object files now, files
    /// without a row once they have been orphans for `min_age` (of what this process did not do
    /// itself, the file's age counts). Returns the removed files.
    ///
    /// For a daemon to call about hourly with [`objects::ORPHAN_AGE`], never at start.
    pub fn sweep_orphans(&self, min_age: Duration) -> Result<Vec<String>, StoreError> {
        // Held before the rows are gone: a reader that found the row may still open the file.
        let released = self.catalog.write(|tx| {
            let files = tx.delete_unreferenced_objects()?;
            self.objects.hold(files.iter().cloned());
            Ok::<_, StoreError>(files)
        })?;
        tracing::debug!(
            n_files = released.len(),
            "released unreferenced object files"
        );
        let catalogued = |file: &str| self.catalog.read(|reader| reader.is_catalogued(file));
        self.objects.sweep(min_age, catalogued)
    }
}

/// Creates the folder and its parents, names durable.
fn create_library_folder(dir: &Path) -> Result<(), StoreError> {
    use std::os::unix::fs::DirBuilderExt;
    if dir.is_dir() {
        return Ok(());
    }
    let parent = match dir.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    create_library_folder(parent)?;
    let created = std::fs::DirBuilder::new().mode(0o750).create(dir);
    match created {
        Err(e) if e.kind() != std::io::ErrorKind::AlreadyExists => {
            return Err(StoreError::io(dir, e));
        }
        _ => {}
    }
    // Folders like / may not be opened by everyone; then their names are not ours to sync.
    match RealDisk.sync_dir(parent) {
        Err(e) if e.kind() != std::io::ErrorKind::PermissionDenied => {
            Err(StoreError::io(parent, e))
        }
        _ => Ok(()),
    }
}
