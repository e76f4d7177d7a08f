//! Stores descriptions, originals and the catalog on disk.
//!
//! A library is a folder: `catalog.db` records what exists, `objects/` holds the arrays of each
//! description, `originals/` the original mesh files, `lock` names the process that holds the
//! library, and `tmp/` contains files that are being written. docs/format.md describes each.
//!
//! A commit takes three steps, so that no reader ever sees half of one:
//!
//! 1. [`Objects`] writes a file under `tmp/`, syncs it, renames it to its final name and syncs the
//!    folder. Up to here nothing is committed: a file without a row is an orphan.
//! 2. One [`Catalog`] transaction inserts the rows: the objects, the shape, its labels, the changed
//!    model, the events, the finished job item, the reply. **The catalog row is the only commit
//!    marker, and it is never durable before the data it names.**
//! 3. The reply and the events are sent only after the transaction has returned.
//!
//! A sync that fails makes the store read-only for the rest of the process ([`Health`]); a full
//! disk is a temporary error. Committed files never change. The catalog has one writer, and readers
//! never wait for it. Files without references are removed soon, and orphans of interrupted
//! processes after a day, never at start.

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
pub mod prepared;
pub mod quarantine;
mod reserve;
pub mod rows;
pub mod snapshot;

pub(crate) use array_file::{DATA_ALIGNMENT, header as array_file_header};
pub use array_file::{DescriptionFile, write_description};
pub use array_stream::ArrayStream;
pub use catalog::{Catalog, Reader, Tx};
pub use digest::{Digest, NotADigest};
pub use error::StoreError;
pub use health::Health;
pub use mapped::{ArrayFileError, MappedDescription, MappedFile};
pub use objects::{Kept, Objects};
pub use prepared::PreparedShapes;
pub use rows::{
    CandidatesRow, CollectionId, CollectionRow, CorrectionRow, ItemStatus, JobItemRow, LabelRow,
    LabelSummary, LabelVersionRow, LabelsBefore, LinkEnd, LinkRow, MapRow, NewCollection,
    NewJobItem, NewShapeRow, ObjectKind, ObjectRow, PassedPart, PointMapRow, ProposalRow,
    RequestRow, ReviewRow, ShapeId, ShapeRow,
};

use disk::{Disk, RealDisk};
use lock::LibraryLock;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// An open library folder, held by this process alone.
pub struct Store {
    objects: Objects,
    prepared: PreparedShapes,
    catalog: Catalog,
    health: Health,
    dir: PathBuf,
    // The last field, so that it is released after the catalog is closed. `None`: another process
    // holds it.
    lock: Option<LibraryLock>,
}

impl Store {
    /// Opens the library in `dir`; creates it if missing, readable by its owner's group at most.
    pub fn open(dir: &Path) -> Result<Self, StoreError> {
        create_library_folder(dir)?;
        let lock = LibraryLock::acquire(dir)?;
        Self::open_with(Catalog::open, dir, Some(lock))
    }

    /// Opens the library in `dir`, which another process holds, for the changes that this process
    /// may make on its behalf. The library must exist, in the current format.
    pub fn open_beside(dir: &Path) -> Result<Self, StoreError> {
        Self::open_with(Catalog::open_beside, dir, None)
    }

    fn open_with(
        open_catalog: fn(&Path, Health) -> Result<Catalog, StoreError>,
        dir: &Path,
        lock: Option<LibraryLock>,
    ) -> Result<Self, StoreError> {
        let health = Health::default();
        // Opened before the objects' folders, so that their sync of `dir` covers the catalog's
        // name.
        let catalog = open_catalog(&catalog::path_in(dir), health.clone())?;
        let disk: Arc<dyn Disk> = Arc::new(RealDisk);
        let objects = Objects::open(disk, dir, health.clone())?;
        if lock.is_some() {
            reserve::keep(dir);
        }
        Ok(Self {
            objects,
            prepared: PreparedShapes::default(),
            catalog,
            health,
            dir: dir.to_path_buf(),
            lock,
        })
    }

    /// Lets processes that this one starts from now on share the lock until they end: no other
    /// process opens the library while one of them may still write.
    pub fn share_lock(&self) -> Result<(), StoreError> {
        match &self.lock {
            Some(lock) => lock.share().map_err(|e| StoreError::io(&self.dir, e)),
            None => Ok(()),
        }
    }

    /// Records the endpoint of the holder for processes that find the library locked.
    pub fn tell_endpoint(&self, endpoint: &str) -> Result<(), StoreError> {
        match &self.lock {
            Some(lock) => lock
                .write_endpoint(endpoint)
                .map_err(|e| StoreError::io(&self.dir, e)),
            None => Ok(()),
        }
    }

    /// Shapes prepared for labelling.
    pub fn prepared(&self) -> &PreparedShapes {
        &self.prepared
    }

    /// The object files.
    pub fn objects(&self) -> &Objects {
        &self.objects
    }

    /// The catalog.
    pub fn catalog(&self) -> &Catalog {
        &self.catalog
    }

    /// Whether writes are refused, with the time and the cause.
    pub fn health(&self) -> &Health {
        &self.health
    }

    /// The library's folder.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// Releases object files that neither a shape nor a queued item needs: deletes their rows now,
    /// and leaves the files to [`Store::reclaim`]. Returns their number.
    pub fn release_unreferenced(&self) -> Result<usize, StoreError> {
        // Searched with a reader first, since there is usually nothing to release and the writer
        // stays free.
        if !self
            .catalog
            .read(|reader| reader.has_unreferenced_objects())?
        {
            return Ok(0);
        }
        let released =
            self.freeing(|| self.catalog.write(|tx| tx.delete_unreferenced_objects()))?;
        let n_files = released.len();
        tracing::debug!(n_files, "released unreferenced object files");
        self.objects.let_go(released);
        Ok(n_files)
    }

    /// Removes files that this process released at least `grace` ago, unless a row names them again
    /// or a writer is about to do so. Returns the removed files; none while any process copies the
    /// library.
    pub fn reclaim(&self, grace: Duration) -> Result<Vec<String>, StoreError> {
        let mut files = Vec::new();
        for file in self.objects.let_go_since(grace) {
            if self.is_catalogued(&file)? {
                self.objects.still_needed(&file);
            } else {
                files.push(file);
            }
        }
        if files.is_empty() {
            return Ok(files);
        }
        let Some(_removing) = lock::try_removing(&self.dir)? else {
            return Ok(Vec::new());
        };
        self.bury_interrupted_commits()?;
        let mut removed = Vec::new();
        for file in files {
            if self
                .objects
                .remove(&file, |file| self.is_catalogued(file))?
            {
                removed.push(file);
            }
        }
        Ok(removed)
    }

    /// Removes unneeded data: the rows of unreferenced object files now, and files without a row
    /// once they have been orphans for `min_age` (for files of other processes, the file's age
    /// counts). Returns the removed files.
    ///
    /// A daemon should call it about hourly with [`objects::ORPHAN_AGE`], never at start.
    pub fn sweep_orphans(&self, min_age: Duration) -> Result<Vec<String>, StoreError> {
        self.release_unreferenced()?;
        let Some(_removing) = lock::try_removing(&self.dir)? else {
            return Ok(Vec::new());
        };
        self.bury_interrupted_commits()?;
        self.objects.sweep(min_age, |file| self.is_catalogued(file))
    }

    /// Mesh files that no row names.
    pub(crate) fn uncatalogued_originals(&self) -> Result<Vec<String>, StoreError> {
        let folder = self.dir.join(ObjectKind::Original.folder());
        let files = RealDisk.files(&folder);
        let mut found = Vec::new();
        for entry in files.map_err(|e| StoreError::io(&folder, e))? {
            let file = objects::relative(&self.dir, &entry.path);
            if !self.is_catalogued(&file)? {
                found.push(file);
            }
        }
        Ok(found)
    }

    /// Runs a change that frees space; on a full disk repeats it, using the reserved space.
    pub fn freeing<T, E: FullDisk>(
        &self,
        mut change: impl FnMut() -> Result<T, E>,
    ) -> Result<T, E> {
        match change() {
            Err(e) if e.is_full_disk() && reserve::give_up(&self.dir) => change(),
            done => done,
        }
    }

    /// Reserves space for changes that free space, if there is enough.
    pub fn keep_reserve(&self) {
        reserve::keep(&self.dir);
    }

    fn is_catalogued(&self, file: &str) -> Result<bool, StoreError> {
        self.catalog.read(|reader| reader.is_catalogued(file))
    }

    /// A process that was killed at the end of its commit may have left the commit complete in the
    /// log, invisible until recovery after a crash. Recovery must not bring back rows whose files
    /// are gone by then; the commit that this function makes overwrites it.
    fn bury_interrupted_commits(&self) -> Result<(), StoreError> {
        self.freeing(|| self.catalog.write(|tx| tx.touch()))
    }
}

/// Errors that may mean that the disk is full.
pub trait FullDisk: From<StoreError> {
    /// Whether the disk is full and nothing was changed.
    fn is_full_disk(&self) -> bool;
}

impl FullDisk for StoreError {
    fn is_full_disk(&self) -> bool {
        matches!(self, Self::NoSpace { .. })
    }
}

/// Creates the folder and its parents, with durable names.
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
    // Folders like / may not be readable for everyone; syncing their names is then not possible.
    match RealDisk.sync_dir(parent) {
        Err(e) if e.kind() != std::io::ErrorKind::PermissionDenied => {
            Err(StoreError::io(parent, e))
        }
        _ => Ok(()),
    }
}
