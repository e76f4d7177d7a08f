//! Opens a library. It holds the store, and the collections in memory, each of which one thread
//! uses at a time.

use super::collection::Collection;
use super::error::{LibraryError, Named, Result};
use super::lookup::{require_collection, require_shape};
use super::remembered::RememberedParts;
use super::types::Placed;
use crate::store::check::Finding;
use crate::store::snapshot::Snapshot;
use crate::store::{CollectionId, CollectionRow, ShapeRow, Store};
use std::collections::HashMap;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

/// A collection in memory; `None` until the next user loads it.
type Slot = Arc<Mutex<Option<Collection>>>;

/// An open library. One process at a time holds it; a lock file ensures that.
pub struct Library {
    pub(super) store: Store,
    collections: Mutex<HashMap<CollectionId, Slot>>,
    /// Stage of the items that are being described, by job and index.
    pub(super) running: Mutex<HashMap<(u64, u32), String>>,
    pub(super) max_maps: AtomicU64,
    pub(super) max_relabelled: AtomicU64,
    /// Parts of shapes, remembered from recent questions.
    pub(super) parts: RememberedParts,
}

impl Library {
    /// Opens the library in `dir`, and creates the folder if it does not exist.
    ///
    /// # Errors
    /// Another process holds the folder, it cannot be written, or its format is newer.
    pub fn open(dir: &Path) -> Result<Self> {
        Ok(Self::over(Store::open(dir)?))
    }

    pub(super) fn over(store: Store) -> Self {
        Self {
            store,
            collections: Mutex::default(),
            running: Mutex::default(),
            max_maps: AtomicU64::new(0),
            max_relabelled: AtomicU64::new(0),
            parts: RememberedParts::default(),
        }
    }

    /// Verifies all files of a library against the catalog. No process may hold the library.
    ///
    /// # Errors
    /// There is no library in `dir`, or it is held or unreadable.
    pub fn check(dir: &Path) -> Result<Vec<Finding>> {
        Ok(crate::store::check::check(dir)?)
    }

    /// Copies the library in `from`, also during its use, to `to`, and verifies the copy. This
    /// makes or restores a snapshot.
    ///
    /// # Errors
    /// There is no library in `from`, `to` is not empty, or the copy cannot be written.
    pub fn copy(from: &Path, to: &Path, link: bool) -> Result<Snapshot> {
        Ok(crate::store::snapshot::copy(from, to, link)?)
    }

    /// Returns the store, for its health and the sweep of orphans.
    pub fn store(&self) -> &Store {
        &self.store
    }

    /// Runs `work` with exclusive use of a collection. The collection is reloaded after an error,
    /// and after another process has changed it, so it never differs from the catalog.
    pub(super) fn with_collection<T>(
        &self,
        row: CollectionRow,
        work: impl FnOnce(&mut Collection) -> Result<T>,
    ) -> Result<T> {
        let slot = self.slot(row.id);
        let mut slot = slot.lock().unwrap_or_else(PoisonError::into_inner);
        // Reads the row again now that nobody else uses the collection, because the caller's may be
        // older.
        let (id, name) = (row.id, row.name);
        let row = self.row_of(id)?;
        let row = row.ok_or_else(|| LibraryError::not_found(Named::Collection, &name))?;
        let mut collection = match slot.take() {
            Some(collection) if *collection.row() == row => collection,
            _ => self.store.catalog().read(|r| Collection::load(r, row))?,
        };
        match work(&mut collection) {
            Ok(done) => {
                *slot = Some(collection);
                Ok(done)
            }
            // Any error may follow from the deletion of the collection, which waits for nobody.
            Err(LibraryError::Store(_)) if self.row_of(id)?.is_none() => {
                Err(LibraryError::deleted(&name))
            }
            Err(error) => Err(error),
        }
    }

    /// Runs `work` while nothing in this process uses a collection, so that another process can use
    /// it.
    ///
    /// # Errors
    /// There is no such collection.
    pub fn with_exclusive<T>(&self, collection: &str, work: impl FnOnce() -> T) -> Result<T> {
        let slot = self.slot(self.collection_row(collection)?.id);
        let mut slot = slot.lock().unwrap_or_else(PoisonError::into_inner);
        // The other process loads a copy of its own, and one copy in memory is enough.
        *slot = None;
        Ok(work())
    }

    fn slot(&self, id: CollectionId) -> Slot {
        let mut all = self
            .collections
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        Arc::clone(all.entry(id).or_default())
    }

    /// Removes a deleted collection from memory. A thread that still uses it finds no row.
    pub(super) fn forget_collection(&self, id: CollectionId) {
        let mut all = self
            .collections
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        all.remove(&id);
    }

    fn row_of(&self, id: CollectionId) -> Result<Option<CollectionRow>> {
        let catalog = self.store.catalog();
        catalog.read(|r| r.collection_by_id(id).map_err(LibraryError::from))
    }

    pub(super) fn collection_row(&self, name: &str) -> Result<CollectionRow> {
        self.store.catalog().read(|r| require_collection(r, name))
    }

    pub(super) fn shape_row(
        &self,
        collection: &str,
        shape: &str,
    ) -> Result<(CollectionRow, ShapeRow)> {
        let catalog = self.store.catalog();
        catalog.read(|r| require_shape(r, collection, shape))
    }

    pub(super) fn note(&self, placed: &Placed) {
        self.max_maps
            .fetch_max(placed.n_maps.into(), Ordering::Relaxed);
        self.max_relabelled
            .fetch_max(placed.n_relabelled.into(), Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests;
