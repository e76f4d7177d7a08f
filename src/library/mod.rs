//! The library: collections of shapes on disk, in process. The daemon is a shell around it.
//!
//! Every method that changes something returns after the change is durable.

mod types;
pub use types::{
    CollectionInfo, CollectionSpec, Event, EventKind, Failure, ItemState, Job, JobItem, LabelId, LabelInfo,
    LabelMove, Labels, LibraryStats, MapInfo, NewShape, Outcome, PartInfo, PartMatch, Placed, RequestKey,
    ShapeInfo, Source, Up,
};

use crate::pipeline::Description;
use crate::store::check::Finding;
use crate::store::mapped::MappedDescription;
use std::path::Path;

/// Why an operation on the library failed.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum LibraryError {
    /// Names what is wrong and the limit. `reason` is stable: `BAD_NAME`, `N_PARTS_RANGE`, ...
    #[error("{message}")]
    InvalidArgument { reason: &'static str, message: String },
    #[error("no {what} named {name:?}")]
    NotFound { what: &'static str, name: String },
    #[error("{message}")]
    AlreadyExists { reason: &'static str, message: String },
    #[error("{message}")]
    FailedPrecondition { reason: &'static str, message: String },
    /// The store is damaged at the place named.
    #[error("{message}")]
    DataLoss { message: String },
    #[error(transparent)]
    Store(#[from] crate::store::StoreError),
}

type Result<T> = std::result::Result<T, LibraryError>;

/// An open library. One process at a time holds it (a lock file says so).
pub struct Library {}

#[allow(missing_docs, unused_variables, clippy::missing_errors_doc)]
impl Library {
    /// Opens the library in `dir`, which is created if it is missing.
    pub fn open(dir: &Path) -> Result<Self> { unimplemented!() }

    // --- collections
    pub fn create_collection(&self, spec: &CollectionSpec, key: Option<&RequestKey>) -> Result<CollectionInfo> { unimplemented!() }
    pub fn collections(&self) -> Result<Vec<CollectionInfo>> { unimplemented!() }
    pub fn collection(&self, name: &str) -> Result<CollectionInfo> { unimplemented!() }
    pub fn delete_collection(&self, name: &str, key: Option<&RequestKey>) -> Result<()> { unimplemented!() }
    pub fn name_label(&self, collection: &str, label: LabelId, name: &str, key: Option<&RequestKey>) -> Result<LabelInfo> { unimplemented!() }

    // --- adding: submit (durable), then describe (pure, any thread), then place (serial per collection)
    /// Stores the bytes and a job; the same key gives the same job again.
    pub fn submit(&self, collection: &str, shapes: Vec<NewShape>, key: Option<&RequestKey>) -> Result<Job> { unimplemented!() }
    pub fn job(&self, id: u64) -> Result<Job> { unimplemented!() }
    /// Items not yet done, in order of acceptance: what a daemon takes up again when it starts.
    pub fn queued_items(&self) -> Result<Vec<JobItem>> { unimplemented!() }
    /// Marks the items of a job that have not begun as cancelled.
    pub fn cancel(&self, job: u64) -> Result<Job> { unimplemented!() }
    /// The pure stage. `stage` is told each stage's name as it begins; returning false stops the work.
    pub fn describe_item(&self, item: &JobItem, stage: &dyn Fn(&str) -> bool) -> std::result::Result<Described, Failure> { unimplemented!() }
    /// Places and commits. Must be called in the order of acceptance within a collection.
    pub fn place_item(&self, item: &JobItem, described: std::result::Result<Described, Failure>) -> Result<ItemState> { unimplemented!() }
    /// Submit, describe and place in one call, for in-process use.
    pub fn add(&self, collection: &str, shape: NewShape) -> Result<Placed> { unimplemented!() }
    /// Recomputes the labels of one stale shape of the collection, or of any if `None`. False: none was stale.
    pub fn relabel_next(&self, collection: Option<&str>) -> Result<bool> { unimplemented!() }

    // --- reading
    /// Shapes by ordinal, after `after_ordinal`, at most `limit`; with `label`, only those that carry it.
    pub fn shapes(&self, collection: &str, after_ordinal: u64, limit: usize, label: Option<LabelId>) -> Result<Vec<ShapeInfo>> { unimplemented!() }
    pub fn shape(&self, collection: &str, shape: &str) -> Result<ShapeInfo> { unimplemented!() }
    /// The newest labels, or those of `version`.
    pub fn labels(&self, collection: &str, shape: &str, version: Option<u64>) -> Result<Labels> { unimplemented!() }
    /// The bytes as they were sent, and their format.
    pub fn original(&self, collection: &str, shape: &str) -> Result<(Vec<u8>, crate::mesh::Format)> { unimplemented!() }
    /// Eigenvalues, eigenvectors, HKS, descriptors: mapped, not copied.
    pub fn description(&self, collection: &str, shape: &str) -> Result<MappedDescription> { unimplemented!() }
    pub fn map(&self, collection: &str, from: &str, to: &str) -> Result<MapInfo> { unimplemented!() }
    pub fn part_correspondence(&self, collection: &str, a: &str, b: &str) -> Result<(Vec<PartMatch>, crate::fmap::Quality)> { unimplemented!() }
    /// The `limit` nearest shapes with their distances, nearest first.
    pub fn nearest(&self, collection: &str, shape: &str, limit: usize) -> Result<Vec<(String, f64)>> { unimplemented!() }
    /// Every shape's name, version and the collection's sequence, as of one moment.
    pub fn labels_snapshot(&self, collection: &str) -> Result<(u64, Vec<(String, Labels)>)> { unimplemented!() }
    pub fn events_since(&self, collection: &str, sequence: u64, limit: usize) -> Result<Vec<Event>> { unimplemented!() }
    pub fn stats(&self) -> Result<LibraryStats> { unimplemented!() }

    // --- removing
    pub fn remove(&self, collection: &str, shape: &str, key: Option<&RequestKey>) -> Result<()> { unimplemented!() }

    // --- care
    /// Verifies everything on disk against the catalog.
    pub fn check(dir: &Path) -> Result<Vec<Finding>> { unimplemented!() }
}

/// A description with the milliseconds each stage took.
#[derive(Debug, Clone)]
pub struct Described {
    /// What was computed.
    pub description: Description,
    /// Stage and milliseconds, in order.
    pub stages_ms: Vec<(String, f64)>,
}
