//! The library: collections of shapes on disk, in process. The daemon is a shell around it.
//!
//! Every method that changes something returns after the change is durable. Shapes are submitted (their bytes
//! become durable), described (pure, on any thread) and placed (one after the other within a collection):
//! [`Library::add`] does all three.
//!
//! ```
//! use coseg::library::{CollectionSpec, NewShape};
//! use coseg::{Library, mesh::Format};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let folder = tempfile::tempdir()?;
//! let library = Library::open(folder.path())?;
//! let spec = CollectionSpec { name: "boxes".into(), n_parts: Some(2), ..Default::default() };
//! library.create_collection(&spec, None)?;
//! let cube = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1\n\
//!             f 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n";
//! let shape = NewShape {
//!     name: "cube".into(),
//!     bytes: cube.into(),
//!     format: Format::Obj,
//!     replace: false,
//! };
//! library.add("boxes", shape)?;
//! let labels = library.labels("boxes", "cube", None)?;
//! assert_eq!(labels.labels.len(), 6); // one for each face of the file, in its order
//! # Ok(())
//! # }
//! ```

mod agreement;
mod apart;
mod carry;
mod collections;
mod commit;
mod correct;
mod error;
mod history;
pub mod isolate;
mod jobs;
mod lane;
mod learnt;
pub mod likely;
mod merge;
mod names;
mod place;
mod points;
mod read;
mod relabel;
mod repair;
mod rows;
mod submit;
mod suggest;
mod teach;
mod types;
mod upright;

pub use agreement::Disagreement;
pub use apart::{HandedOver, state_from_json, state_to_json};
pub use collections::MAX_PARTS;
pub use correct::{Corrected, Correction, MAX_LABEL, MAX_LABELS};
pub use error::LibraryError;
pub use history::Undone;
pub use jobs::JobFilter;
pub use names::{check_shape_name, shown};
pub use place::{MAX_MAPS, MAX_REPRESENTATIVES, min_gain, next_recluster};
pub use points::{PointRequest, PolygonValues};
pub use repair::Repaired;
pub use rows::report_to_json;
pub use submit::{KeptShapes, Submission};
pub use suggest::Suggestion;
pub use types::{
    Carrying, CollectionInfo, CollectionSpec, Event, EventKind, Failure, FailureSubject, ItemState,
    Job, JobItem, LabelId, LabelInfo, LabelMove, Labels, LibraryStats, MapInfo, NewShape, Outcome,
    PartInfo, PartMatch, Placed, RequestKey, ShapeInfo, Source, Up, UpEstimate,
};
pub use upright::UpSet;

use crate::pipeline::Description;
use crate::store::check::Finding;
use crate::store::snapshot::Snapshot;
use crate::store::{CollectionId, CollectionRow, Digest, ObjectRow, Store};
use lane::Lane;
use std::collections::HashMap;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

type Result<T> = std::result::Result<T, LibraryError>;

/// An open library. One process at a time holds it (a lock file says so).
pub struct Library {
    store: Store,
    lanes: Mutex<HashMap<CollectionId, Arc<Mutex<Option<Lane>>>>>,
    /// Stage of the items that are being described, by job and index.
    running: Mutex<HashMap<(u64, u32), String>>,
    max_maps: AtomicU64,
    max_relabelled: AtomicU64,
}

/// How the work on one shape is done: here, or in another process.
pub type Describer<'a> =
    dyn Fn(&isolate::DescribeJob<'_>, &dyn Fn(&str) -> bool) -> isolate::Described + 'a;

/// A description with what the library needs to commit it.
#[derive(Debug, Clone)]
pub struct Described {
    /// What was computed.
    pub description: Description,
    /// Stage and milliseconds, in order.
    pub stages_ms: Vec<(String, f64)>,
    digest: Digest,
    params_json: String,
    /// Its file, if it is stored already.
    stored: Option<ObjectRow>,
}

impl Library {
    /// Opens the library in `dir`, which is created if it is missing.
    ///
    /// # Errors
    /// The folder is held by another process, cannot be written, or is of a newer format.
    pub fn open(dir: &Path) -> Result<Self> {
        Ok(Self::over(Store::open(dir)?))
    }

    fn over(store: Store) -> Self {
        Self {
            store,
            lanes: Mutex::default(),
            running: Mutex::default(),
            max_maps: AtomicU64::new(0),
            max_relabelled: AtomicU64::new(0),
        }
    }

    /// Verifies everything on disk against the catalog, of a library that no process holds.
    ///
    /// # Errors
    /// There is no library in `dir`, or it is held or unreadable.
    pub fn check(dir: &Path) -> Result<Vec<Finding>> {
        Ok(crate::store::check::check(dir)?)
    }

    /// Copies the library in `from`, also while it is in use, to `to`, and verifies the copy: a snapshot, or the
    /// restoring of one.
    ///
    /// # Errors
    /// There is no library in `from`, something in `to`, or the copy cannot be written.
    pub fn copy(from: &Path, to: &Path, link: bool) -> Result<Snapshot> {
        Ok(crate::store::snapshot::copy(from, to, link)?)
    }

    /// The store, for care: its health and the sweep of orphans.
    pub fn store(&self) -> &Store {
        &self.store
    }

    /// Runs `work` on the lane of a collection, alone. After an error, and after another process has changed the
    /// collection, the lane is read anew, so that it cannot differ from the catalog.
    fn with_lane<T>(
        &self,
        row: CollectionRow,
        work: impl FnOnce(&mut Lane) -> Result<T>,
    ) -> Result<T> {
        let slot = Arc::clone(
            self.lanes
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .entry(row.id)
                .or_default(),
        );
        let mut slot = slot.lock().unwrap_or_else(PoisonError::into_inner);
        // As it is now that nobody else is at it: the caller's may be older.
        let name = row.name;
        let row = self
            .store
            .catalog()
            .read(|r| r.collection_by_id(row.id).map_err(LibraryError::from))?;
        let row = row.ok_or_else(|| LibraryError::not_found("collection", name))?;
        let mut lane = match slot.take() {
            Some(lane) if lane.row == row => lane,
            _ => self.store.catalog().read(|r| Lane::load(r, row))?,
        };
        let done = work(&mut lane)?;
        *slot = Some(lane);
        Ok(done)
    }

    fn collection_row(&self, name: &str) -> Result<CollectionRow> {
        self.store
            .catalog()
            .read(|r| read::require_collection(r, name))
    }

    fn note(&self, placed: &Placed) {
        self.max_maps
            .fetch_max(placed.n_maps.into(), Ordering::Relaxed);
        self.max_relabelled
            .fetch_max(placed.n_relabelled.into(), Ordering::Relaxed);
    }

    /// The bytes of a mesh file by their digest.
    fn original_bytes(&self, digest: &Digest) -> Result<Vec<u8>> {
        Ok(self
            .store
            .objects()
            .original(&self.object(crate::store::ObjectKind::Original, digest)?)?)
    }

    fn object(
        &self,
        kind: crate::store::ObjectKind,
        digest: &Digest,
    ) -> Result<crate::store::ObjectRow> {
        let row = self
            .store
            .catalog()
            .read(|r| r.object(kind, digest).map_err(LibraryError::from))?;
        row.ok_or_else(|| rows::damaged("objects", &format!("no row for {digest}")))
    }
}
