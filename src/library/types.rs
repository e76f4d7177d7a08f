//! The values that the library takes and returns: collections, shapes, labels, jobs, events.

use super::reason::{Code, Reason};
use super::verdict::{Review, ReviewState};
use crate::mesh::{CleanReport, Format};
use crate::operators::Operator;
use serde::{Deserialize, Serialize};

/// The id of a label: parts with the same label correspond across a collection. An id never
/// silently changes its meaning.
pub type LabelId = u32;

/// The up axis of a collection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[allow(missing_docs)]
pub enum Up {
    PlusX,
    MinusX,
    PlusY,
    MinusY,
    PlusZ,
    MinusZ,
    #[default]
    Unknown,
    /// Estimated from the shapes of the collection.
    Auto,
}

impl Up {
    const NAMES: [(Self, &'static str); 8] = [
        (Self::PlusX, "+x"),
        (Self::MinusX, "-x"),
        (Self::PlusY, "+y"),
        (Self::MinusY, "-y"),
        (Self::PlusZ, "+z"),
        (Self::MinusZ, "-z"),
        (Self::Unknown, "unknown"),
        (Self::Auto, "auto"),
    ];

    /// Returns the unit vector in input coordinates; `None` where the axis is not given.
    pub fn axis(self) -> Option<[f64; 3]> {
        let at = Self::NAMES
            .iter()
            .position(|n| n.0 == self)
            .filter(|i| *i < 6)?;
        let mut axis = [0.0; 3];
        axis[at / 2] = if at.is_multiple_of(2) { 1.0 } else { -1.0 };
        Some(axis)
    }

    /// Returns the value for a unit vector along an axis; `Unknown` for none.
    pub fn along(axis: Option<[f64; 3]>) -> Self {
        let given = Self::NAMES.iter().map(|n| n.0).take(6);
        axis.and_then(|a| given.clone().find(|up| up.axis() == Some(a)))
            .unwrap_or_default()
    }
}

impl std::fmt::Display for Up {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(
            Self::NAMES
                .iter()
                .find(|n| n.0 == *self)
                .map_or("unknown", |n| n.1),
        )
    }
}

impl std::str::FromStr for Up {
    type Err = String;

    fn from_str(s: &str) -> Result<Self, String> {
        let found = Self::NAMES.iter().find(|n| n.1.eq_ignore_ascii_case(s));
        found.map(|n| n.0).ok_or_else(|| {
            format!("up is {s:?}, but must be one of +x -x +y -y +z -z unknown auto")
        })
    }
}

/// The settings with which a collection is created.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct CollectionSpec {
    /// Unique in the library: 1 to 128 characters.
    pub name: String,
    /// Number of part kinds; `None`: estimated.
    pub n_parts: Option<u32>,
    /// The up axis.
    pub up: Up,
    /// The Laplacian.
    pub operator: Operator,
    /// Number of faces of the working-resolution proxy; 0: the default.
    pub working_faces: u32,
}

/// The present state of a collection.
#[derive(Debug, Clone, PartialEq)]
pub struct CollectionInfo {
    /// The settings with which it was created.
    pub spec: CollectionSpec,
    /// Sequence number of its newest event; 0 before the first.
    pub sequence: u64,
    /// Shapes in it.
    pub n_shapes: u64,
    /// Stored shapes whose labels wait to be recomputed.
    pub n_stale: u64,
    /// Its labels, retired ones included.
    pub labels: Vec<LabelInfo>,
    /// If the up axis is estimated and there are shapes: the estimate in force.
    pub up_estimate: Option<UpEstimate>,
    /// If the up axis is given, and at least half of the shapes stand clearly better along one
    /// other axis: that axis.
    pub up_disagrees: Option<UpEstimate>,
    /// Number of changes by persons that can be undone.
    pub n_undoable: u64,
    /// Number of its shapes with each verdict, in the order of [`ReviewState::ALL`].
    pub reviews: [(ReviewState, u64); 4],
}

/// An estimate of the up axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UpEstimate {
    /// A coordinate axis; unknown, and not used, if fewer than half of the shapes agree on one.
    pub up: Up,
    /// Share of the shapes that stand best along the most common axis, 0 to 1; by chance a sixth.
    pub agreement: f64,
}

/// A label of a collection.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LabelInfo {
    /// Its id.
    pub id: LabelId,
    /// The name that a person gave it.
    pub name: Option<String>,
    /// sRGB colour.
    pub colour: [u8; 3],
    /// The label this one was merged into; `None` while it is in use.
    pub merged_into: Option<LabelId>,
    /// Number of shapes that have it.
    pub n_shapes: u64,
    /// Mean over all shapes of the share of their area that has it, 0 to 1. 0 in a reply that an
    /// earlier version stored.
    #[serde(default)]
    pub area_share: f64,
    /// Whether it is a discovered label that stays beside those of persons, because no labelled
    /// shape shows it and nobody has named it.
    #[serde(default)]
    pub unclaimed: bool,
}

/// A shape to be added.
#[derive(Debug, Clone)]
pub struct NewShape {
    /// Unique in the collection: 1 to 255 characters, no `/`, no control characters.
    pub name: String,
    /// The bytes of the file.
    pub bytes: Vec<u8>,
    /// Their format.
    pub format: Format,
    /// Whether other bytes under the same name are replaced.
    pub replace: bool,
}

/// Names one request of one client, for at least 24 h.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct RequestKey {
    /// The client.
    pub client_id: String,
    /// The request of this client.
    pub request_id: String,
}

/// The present state of a shape.
#[derive(Debug, Clone, PartialEq)]
pub struct ShapeInfo {
    /// Its name.
    pub name: String,
    /// Position in the order of arrival, from 1; never reused.
    pub ordinal: u64,
    /// Version of its labels, from 1.
    pub version: u64,
    /// Whether its labels wait to be recomputed.
    pub stale: bool,
    /// Polygons of the input.
    pub n_polygons: u64,
    /// Area in squared input units.
    pub area: f64,
    /// BLAKE3 of the original bytes, hexadecimal.
    pub content_digest: String,
    /// What cleaning found and did.
    pub report: CleanReport,
    /// Its parts: connected pieces of one label, largest first.
    pub parts: Vec<PartInfo>,
    /// The shapes that voted for its labels.
    pub sources: Vec<Source>,
    /// Bytes of its array file and of its compressed original.
    pub stored_bytes: u64,
    /// A person's verdict on its labels.
    pub review: Review,
}

/// A connected piece of one shape with one label.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PartInfo {
    /// Its label.
    pub label: LabelId,
    /// Share of the shape's area.
    pub area_share: f64,
    /// Mean probability of its label, 0 to 1.
    pub confidence: f64,
}

/// A shape that voted for the labels of another one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Source {
    /// Its name.
    pub shape: String,
    /// Version of its labels that was used.
    pub version: u64,
    /// Weight of its vote, summing to 1 over the sources.
    pub weight: f64,
}

/// Labels of the polygons of the bytes that were sent, in their order.
#[derive(Debug, Clone, PartialEq)]
pub struct Labels {
    /// Version of the labels.
    pub version: u64,
    /// `(n_polygons,)`; -1 is unlabelled.
    pub labels: Vec<i32>,
    /// Probability of the label, `(n_polygons,)`.
    pub confidence: Vec<f32>,
}

/// State of one shape of a job.
#[derive(Debug, Clone, PartialEq)]
pub enum ItemState {
    /// Not yet begun.
    Queued,
    /// Being described or placed; with the name of the stage.
    Running(String),
    /// Labelled and durable.
    Done(Box<Placed>),
    /// Refused, with the reason.
    Failed(Failure),
    /// Cancelled before it was placed.
    Cancelled,
}

/// The reason why a shape was refused.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Failure {
    /// The kind of the failure.
    pub code: Code,
    /// A stable reason within the code.
    pub reason: Reason,
    /// For people: the value and the limit.
    pub message: String,
    /// Location in the input, if there is one.
    #[serde(default)]
    pub subject: Option<FailureSubject>,
}

/// A location in the input of a shape that was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum FailureSubject {
    /// A face (polygon), from 0.
    Face(u64),
    /// A vertex, from 0.
    Vertex(u64),
    /// A line of the file, from 1.
    Line(u64),
}

/// One shape of a job.
#[derive(Debug, Clone, PartialEq)]
pub struct JobItem {
    /// Id of the job.
    pub job: u64,
    /// Position in the job, from 0.
    pub index: u32,
    /// Name of the collection.
    pub collection: String,
    /// The shape's name.
    pub name: String,
    /// Its state.
    pub state: ItemState,
    /// Number of times that the work on it ended its process, while it is queued.
    pub attempts: u32,
}

/// Shapes that were accepted together, or a correction that is propagated to the other shapes.
#[derive(Debug, Clone, PartialEq)]
pub struct Job {
    /// Its id.
    pub id: u64,
    /// Name of the collection.
    pub collection: String,
    /// Its shapes in order; none if it propagates a correction.
    pub items: Vec<JobItem>,
    /// Progress of the propagation, if the job propagates a correction.
    pub propagation: Option<PropagationProgress>,
}

/// Progress of the propagation of a correction.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PropagationProgress {
    /// Number of shapes to which it is propagated; 0 once a later change has replaced it.
    pub n_shapes: u64,
    /// Number of shapes that wait for it.
    pub n_left: u64,
}

impl PropagationProgress {
    /// Returns the share that is done, 0 to 1.
    pub fn progress(&self) -> f64 {
        1.0 - self.n_left as f64 / self.n_shapes.max(1) as f64
    }
}

/// Outcome of the addition of a shape.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[allow(missing_docs)]
pub enum Outcome {
    Added,
    /// Same name, same bytes: nothing was done.
    Unchanged,
    Replaced,
}

/// A shape that was labelled and committed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Placed {
    /// What was done.
    pub outcome: Outcome,
    /// Version of its labels.
    pub version: u64,
    /// Sequence number of the collection after the commit.
    pub sequence: u64,
    /// Number of functional maps that were computed.
    pub n_maps: u32,
    /// Number of stored shapes that this addition relabelled.
    pub n_relabelled: u32,
    /// Number of computed maps that do not agree with the maps between the shapes they come from.
    #[serde(default)]
    pub n_inconsistent: u32,
    /// Milliseconds by stage, in order: parse, clean, proxy, laplacian, spectrum, descriptors, ...
    pub stages_ms: Vec<(String, f64)>,
}

/// A functional map between two shapes of a collection, with its quality.
#[derive(Debug, Clone, PartialEq)]
pub struct MapInfo {
    /// `c_12 (k2, k1)`, row-major: coefficients on `from` to coefficients on `to`.
    pub c_12: Vec<f32>,
    /// Rows.
    pub k2: usize,
    /// Columns.
    pub k1: usize,
    /// `p2p_21 (n2,)`: for each proxy vertex of `to` a proxy vertex of `from`.
    pub p2p_21: Vec<u32>,
    /// Expected correctness at each proxy vertex of `to`, and where nothing corresponds.
    pub confidence: crate::fmap::Confidence,
    /// Quality of the map.
    pub quality: crate::fmap::Quality,
}

/// A match between a part of one shape and a part of another.
#[derive(Debug, Clone, PartialEq)]
pub struct PartMatch {
    /// Index into the parts of the first shape.
    pub part_a: u32,
    /// Index into the parts of the second shape.
    pub part_b: u32,
    /// Label of the part of the first shape.
    pub label_a: LabelId,
    /// Label of the part of the second shape.
    pub label_b: LabelId,
    /// Intersection over union of the parts' areas under the map.
    pub overlap: f64,
}

/// Counters for the operator.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LibraryStats {
    /// Number of collections.
    pub n_collections: u64,
    /// Number of shapes.
    pub n_shapes: u64,
    /// Number of job items that are not done.
    pub n_queued: u64,
    /// Stored shapes whose labels wait to be recomputed.
    pub n_stale: u64,
    /// Number of bytes of array files and originals.
    pub stored_bytes: u64,
    /// Number of bytes of the catalog.
    pub catalog_bytes: u64,
    /// Maximum number of stored shapes that one addition relabelled since start.
    pub max_relabelled: u64,
    /// Maximum number of functional maps that one addition computed since start.
    pub max_maps: u64,
}
