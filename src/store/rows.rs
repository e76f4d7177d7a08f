//! Represents the catalog's rows as plain values. Text and bytes that only the library interprets
//! are opaque.

use super::Digest;
use rusqlite::types::{FromSql, FromSqlError, FromSqlResult, ToSql, ToSqlOutput, ValueRef};

/// The row id of a collection; never reused after the collection is deleted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct CollectionId(pub i64);

/// The row id of a shape; never reused after the shape is deleted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ShapeId(pub i64);

/// A new collection.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct NewCollection {
    /// Unique in the library.
    pub name: String,
    /// Number of part kinds; `None`: estimated.
    pub n_parts: Option<u32>,
    /// The up axis, in the library's format.
    pub up: String,
    /// The Laplacian, in the library's format.
    pub operator: String,
    /// Number of faces of the proxies.
    pub working_faces: u32,
    /// The library's opaque state of the collection.
    pub state: Vec<u8>,
}

/// A collection.
#[derive(Debug, Clone, PartialEq)]
pub struct CollectionRow {
    /// Its id.
    pub id: CollectionId,
    /// Unique in the library.
    pub name: String,
    /// Number of part kinds; `None`: estimated.
    pub n_parts: Option<u32>,
    /// The up axis, in the library's format.
    pub up: String,
    /// The Laplacian, in the library's format.
    pub operator: String,
    /// Number of faces of the proxies.
    pub working_faces: u32,
    /// Sequence number of its newest event; 0 before the first under this name.
    pub sequence: u64,
    /// Ordinal of the next shape, from 1.
    pub next_ordinal: u64,
    /// Id of the next label, from 0.
    pub next_label: u32,
    /// Generation of its labels.
    pub epoch: u64,
    /// The library's opaque state of the collection.
    pub state: Vec<u8>,
}

/// Candidates for proposals with one number of labels.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CandidatesRow {
    /// Number of labels.
    pub n_labels: u32,
    /// The shapes that are divided, in the library's format.
    pub basis: String,
    /// The candidates, in the library's format.
    pub found: Vec<u8>,
}

/// A division of some shapes into labels, of which a person can choose one.
#[derive(Debug, Clone, PartialEq)]
pub struct ProposalRow {
    /// Its number, from 1.
    pub n: u32,
    /// The shapes that are divided, in the library's format.
    pub basis: String,
    /// Number of labels.
    pub n_labels: u32,
    /// Its value.
    pub value: f64,
    /// Label of each face of each shape, in the library's format.
    pub labels: Vec<u8>,
}

/// The kinds of object files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum ObjectKind {
    /// The arrays of a description.
    Description,
    /// The bytes of a mesh file, compressed.
    Original,
}

/// A committed object file: this row is its commit marker.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ObjectRow {
    /// Its kind.
    pub kind: ObjectKind,
    /// Digest of the description (see [`Digest::of_description`]) or of the original bytes.
    pub digest: Digest,
    /// Its path below the library's folder.
    pub file: String,
    /// Size of the file in bytes.
    pub length: u64,
    /// BLAKE3 of the file's bytes.
    pub blake3: Digest,
}

/// A new shape. Its labels follow in the same transaction.
#[derive(Debug, Clone, PartialEq)]
pub struct NewShapeRow {
    /// Its collection.
    pub collection: CollectionId,
    /// Unique in the collection.
    pub name: String,
    /// Position in the order of arrival, unique in the collection.
    pub ordinal: u64,
    /// BLAKE3 of the original bytes; its object must be catalogued.
    pub content_digest: Digest,
    /// Format of the original bytes, in the library's notation.
    pub format: String,
    /// Digest of the description; its object must be catalogued.
    pub description_digest: Digest,
    /// Number of polygons of the input.
    pub n_polygons: u64,
    /// Area in squared input units.
    pub area: f64,
    /// The findings and actions of cleaning.
    pub report_json: String,
    /// The version that its labels continue from: 0, or more if it replaces a shape.
    pub version: u64,
    /// Global descriptor by which neighbours are ranked.
    pub signature: Vec<f32>,
    /// Bytes of its array file and of its compressed original.
    pub stored_bytes: u64,
}

/// A shape.
#[derive(Debug, Clone, PartialEq)]
pub struct ShapeRow {
    /// Its id.
    pub id: ShapeId,
    /// Its collection.
    pub collection: CollectionId,
    /// Unique in the collection.
    pub name: String,
    /// Position in the order of arrival, unique in the collection.
    pub ordinal: u64,
    /// BLAKE3 of the original bytes.
    pub content_digest: Digest,
    /// Format of the original bytes, in the library's notation.
    pub format: String,
    /// Digest of the description.
    pub description_digest: Digest,
    /// Number of polygons of the input.
    pub n_polygons: u64,
    /// Area in squared input units.
    pub area: f64,
    /// The findings and actions of cleaning.
    pub report_json: String,
    /// Version of its newest labels.
    pub version: u64,
    /// Epoch of the collection for which its labels were computed.
    pub label_epoch: u64,
    /// Whether its labels are stale and wait to be recomputed.
    pub stale: bool,
    /// Its parts, in the library's format.
    pub parts_json: String,
    /// The shapes from which its labels were propagated, in the library's format.
    pub sources_json: String,
    /// Bytes of its array file and of its compressed original.
    pub stored_bytes: u64,
}

/// A shape of a collection and the object that holds its description.
#[derive(Debug, Clone, PartialEq)]
pub struct DescriptionRef {
    /// Its id.
    pub shape: ShapeId,
    /// Position in the order of arrival.
    pub ordinal: u64,
    /// Its name.
    pub name: String,
    /// Version of its newest labels.
    pub version: u64,
    /// Its array file.
    pub object: ObjectRow,
}

/// One version of the labels of a shape.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LabelVersionRow {
    /// The version, from 1; versions are consecutive.
    pub version: u64,
    /// Sequence number of the event that announced it.
    pub sequence: u64,
    /// The rule that caused it.
    pub cause: String,
    /// Label of each proxy face `(m,)`; -1 is unlabelled.
    pub proxy_labels: Vec<i32>,
    /// Probability of each label for each proxy face `(m, k)`, see [`confidence_to_u8`]; the order
    /// of the labels is that of the collection's model.
    pub proxy_probabilities: Vec<u8>,
    /// Label of each input polygon `(n_polygons,)`; -1 is unlabelled.
    pub polygon_labels: Vec<i32>,
    /// Probability of the label of each input polygon `(n_polygons,)`, see [`confidence_to_u8`].
    pub polygon_confidence: Vec<u8>,
    /// The shapes from which the labels were propagated, in the library's format.
    pub sources_json: String,
}

/// The summary of a shape's newest labels in its row.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LabelSummary {
    /// Epoch of the collection for which the labels were computed.
    pub label_epoch: u64,
    /// The parts, in the library's format.
    pub parts_json: String,
    /// Each label of the shape, with its share of the area.
    pub area_shares: Vec<(u32, f64)>,
}

/// Converts a probability from 0 to 1 to steps of 1/255, the stored resolution; values outside are
/// clamped, and NaN counts as 0.
pub fn confidence_to_u8(probability: f32) -> u8 {
    // A cast from float saturates and converts NaN to 0.
    (probability * 255.0).round() as u8
}

/// Converts a probability stored by [`confidence_to_u8`] back.
pub fn confidence_from_u8(stored: u8) -> f32 {
    f32::from(stored) / 255.0
}

/// A label of a collection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LabelRow {
    /// Its name, if a person gave one.
    pub id: u32,
    /// A name a person gave.
    pub name: Option<String>,
    /// sRGB colour.
    pub colour: [u8; 3],
    /// The label that it was merged into.
    pub merged_into: Option<u32>,
}

/// A change of a collection by a person, as long as it can be undone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CorrectionRow {
    /// Its id; ids grow in the order of the changes.
    pub id: i64,
    /// The kind of change, in the library's notation.
    pub kind: String,
    /// The details of the change, in the library's format.
    pub detail_json: String,
    /// The data that the library needs to undo it.
    pub before: Vec<u8>,
}

/// A person's verdict on the labels of a shape.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ReviewRow {
    /// What it is, as the library writes it.
    pub state: String,
    /// Who gave it, as the person said; may be empty.
    pub reviewer: String,
    /// When, in milliseconds since 1970.
    pub unix_ms: u64,
}

/// A part that a person was asked about and did not label.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PassedPart {
    /// Its shape.
    pub shape: ShapeId,
    /// Its number.
    pub part: u32,
    /// Why, as the library writes it.
    pub why: String,
}

/// A part of a shape that is linked to another one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LinkEnd {
    /// Its shape.
    pub shape: ShapeId,
    /// Its number when it was linked. Parts are numbered again whenever labels change.
    pub part: u32,
    /// Its polygons, ascending.
    pub polygons: Vec<u32>,
}

/// A link between two parts, as a person made it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LinkRow {
    /// Its id; ids grow in the order of the links. 0: not stored yet.
    pub id: i64,
    /// What it demands, as the library writes it.
    pub kind: String,
    /// The two parts.
    pub ends: [LinkEnd; 2],
    /// Who made it, as the person said; may be empty.
    pub person: String,
    /// When, in milliseconds since 1970.
    pub unix_ms: u64,
}

/// The newest labels a shape had before a correction.
#[derive(Debug, Clone, PartialEq)]
pub struct LabelsBefore {
    /// The shape.
    pub shape: ShapeId,
    /// Version of its labels at that time; it stays readable as long as the correction can be
    /// undone.
    pub version: u64,
    /// The summary of these labels in the shape's row.
    pub summary: LabelSummary,
}

/// A stored functional map.
#[derive(Debug, Clone, PartialEq)]
pub struct MapRow {
    /// The shape whose functions are transferred.
    pub from: ShapeId,
    /// The shape that receives them.
    pub to: ShapeId,
    /// Columns of `c_12`.
    pub k1: u32,
    /// Rows of `c_12`.
    pub k2: u32,
    /// `c_12 (k2, k1)`, row-major.
    pub c_12: Vec<f32>,
    /// `p2p_21 (n2,)`: for each proxy vertex of `to` a proxy vertex of `from`.
    pub p2p_21: Vec<u32>,
    /// Its confidence at each proxy vertex of `to`, in the library's format; empty in a map that
    /// was stored before format 3.
    pub confidence: Vec<u8>,
    /// Its quality, in the library's format.
    pub quality_json: String,
}

/// A stored map between points.
#[derive(Debug, Clone, PartialEq)]
pub struct PointMapRow {
    /// Rows and columns of `c_12`.
    pub k: u32,
    /// `c_12 (k, k)`, row-major.
    pub c_12: Vec<f32>,
    /// `p2p_21 (n2,)`: for each proxy vertex of the second shape a proxy vertex of the first.
    pub p2p_21: Vec<u32>,
    /// For each proxy vertex of the second shape 1 if it has a counterpart, else 0.
    pub matched: Vec<u8>,
    /// Its quality, in the library's format.
    pub detail_json: String,
}

/// Shapes that were accepted together.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JobRow {
    /// Its id, from 1, growing in the order of acceptance.
    pub id: u64,
    /// Name of the collection.
    pub collection: String,
    /// The time of acceptance, in seconds since 1970.
    pub created_unix_secs: u64,
}

/// A shape of a new job.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewJobItem {
    /// The shape's name.
    pub name: String,
    /// BLAKE3 of the original bytes; their object must be catalogued.
    pub original_digest: Digest,
    /// Format of the original bytes, in the library's notation.
    pub format: String,
    /// Whether the shape replaces one of the same name with other bytes.
    pub replace: bool,
}

/// The status of a shape of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ItemStatus {
    /// Unfinished; resumed after a restart.
    Queued,
    /// Labelled and durable.
    Done,
    /// Failed or refused.
    Failed,
    /// Cancelled before it was placed.
    Cancelled,
}

/// A shape of a job.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JobItemRow {
    /// Its job.
    pub job: u64,
    /// Position in the job, from 0.
    pub index: u32,
    /// Name of the job's collection.
    pub collection: String,
    /// The accepted shape.
    pub item: NewJobItem,
    /// Its status.
    pub status: ItemStatus,
    /// Its result, in the library's format.
    pub detail_json: Option<String>,
}

/// An answered request: its effect is durable if and only if this row exists.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RequestRow {
    /// The client.
    pub client_id: String,
    /// The client's id of the request.
    pub request_id: String,
    /// Digest of the request, which distinguishes a repetition from another request with the same
    /// id.
    pub request_digest: Digest,
    /// The reply in its original bytes.
    pub reply: Vec<u8>,
    /// The time of the answer, in seconds since 1970.
    pub created_unix_secs: u64,
}

/// An event under a collection's name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EventRow {
    /// Position in the log of the name, from 1, without gaps.
    pub sequence: u64,
    /// The kind of event, for people who examine the catalog.
    pub kind: String,
    /// The event, in the library's format.
    pub payload_json: String,
}

/// Counters over the whole catalog.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Totals {
    /// Number of collections.
    pub n_collections: u64,
    /// Number of shapes.
    pub n_shapes: u64,
    /// Number of stale shapes.
    pub n_stale: u64,
    /// Number of unfinished job items.
    pub n_queued: u64,
    /// Size of all catalogued object files in bytes.
    pub object_bytes: u64,
    /// Size of the catalog itself in bytes.
    pub catalog_bytes: u64,
}

/// An enum that is stored as a word.
macro_rules! stored_as_word {
    ($type:ident { $($variant:ident = $word:literal),+ $(,)? }) => {
        impl ToSql for $type {
            fn to_sql(&self) -> rusqlite::Result<ToSqlOutput<'_>> {
                Ok(ToSqlOutput::from(match self { $(Self::$variant => $word),+ }))
            }
        }

        impl FromSql for $type {
            fn column_result(value: ValueRef<'_>) -> FromSqlResult<Self> {
                match value.as_str()? {
                    $($word => Ok(Self::$variant),)+
                    _ => Err(FromSqlError::InvalidType),
                }
            }
        }
    };
}

stored_as_word!(ObjectKind { Description = "description", Original = "original" });
stored_as_word!(ItemStatus {
    Queued = "queued",
    Done = "done",
    Failed = "failed",
    Cancelled = "cancelled",
});

/// A row id.
macro_rules! stored_as_integer {
    ($type:ident) => {
        impl ToSql for $type {
            fn to_sql(&self) -> rusqlite::Result<ToSqlOutput<'_>> {
                Ok(ToSqlOutput::from(self.0))
            }
        }

        impl FromSql for $type {
            fn column_result(value: ValueRef<'_>) -> FromSqlResult<Self> {
                value.as_i64().map(Self)
            }
        }

        impl std::fmt::Display for $type {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                self.0.fmt(f)
            }
        }
    };
}

stored_as_integer!(CollectionId);
stored_as_integer!(ShapeId);
