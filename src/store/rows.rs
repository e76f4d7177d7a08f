//! The catalog's rows as plain values. Text and bytes that only the library understands stay opaque.

use super::Digest;
use rusqlite::types::{FromSql, FromSqlError, FromSqlResult, ToSql, ToSqlOutput, ValueRef};

/// A collection, by its row; never used again after it is deleted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct CollectionId(pub i64);

/// A shape, by its row; never used again after it is deleted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ShapeId(pub i64);

/// A new collection.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct NewCollection {
    /// Unique in the library.
    pub name: String,
    /// Number of part kinds; `None`: estimated.
    pub n_parts: Option<u32>,
    /// Which way is up, as the library writes it.
    pub up: String,
    /// Which Laplacian, as the library writes it.
    pub operator: String,
    /// Faces of the proxies.
    pub working_faces: u32,
    /// Whatever the library keeps with the collection.
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
    /// Which way is up, as the library writes it.
    pub up: String,
    /// Which Laplacian, as the library writes it.
    pub operator: String,
    /// Faces of the proxies.
    pub working_faces: u32,
    /// Sequence number of its newest event; 0 before the first under this name.
    pub sequence: u64,
    /// Ordinal of the next shape, from 1.
    pub next_ordinal: u64,
    /// Id of the next label, from 0.
    pub next_label: u32,
    /// Generation of its labels.
    pub epoch: u64,
    /// Whatever the library keeps with the collection.
    pub state: Vec<u8>,
}

/// What an object file holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum ObjectKind {
    /// The arrays of a description.
    Description,
    /// The bytes of a mesh file, compressed.
    Original,
}

/// An object file that counts: this row is its commit marker.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ObjectRow {
    /// What it holds.
    pub kind: ObjectKind,
    /// Digest of the description (see [`Digest::of_description`]) or of the original bytes.
    pub digest: Digest,
    /// Its path below the library's folder.
    pub file: String,
    /// Bytes in the file.
    pub length: u64,
    /// BLAKE3 of the file's bytes.
    pub blake3: Digest,
}

/// A new shape. Its labels follow in the same transaction.
#[derive(Debug, Clone, PartialEq)]
pub struct NewShapeRow {
    /// Which collection.
    pub collection: CollectionId,
    /// Unique in the collection.
    pub name: String,
    /// Position in the order of arrival, unique in the collection.
    pub ordinal: u64,
    /// BLAKE3 of the original bytes; its object must be catalogued.
    pub content_digest: Digest,
    /// Format of the original bytes, as the library writes it.
    pub format: String,
    /// Digest of the description; its object must be catalogued.
    pub description_digest: Digest,
    /// Polygons of the input.
    pub n_polygons: u64,
    /// Area in squared input units.
    pub area: f64,
    /// What cleaning found and did.
    pub report_json: String,
    /// Version its labels go on from: 0, or more if it replaces a shape.
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
    /// Which collection.
    pub collection: CollectionId,
    /// Unique in the collection.
    pub name: String,
    /// Position in the order of arrival, unique in the collection.
    pub ordinal: u64,
    /// BLAKE3 of the original bytes.
    pub content_digest: Digest,
    /// Format of the original bytes, as the library writes it.
    pub format: String,
    /// Digest of the description.
    pub description_digest: Digest,
    /// Polygons of the input.
    pub n_polygons: u64,
    /// Area in squared input units.
    pub area: f64,
    /// What cleaning found and did.
    pub report_json: String,
    /// Version of its newest labels.
    pub version: u64,
    /// Epoch of the collection for which its labels were computed.
    pub label_epoch: u64,
    /// Whether its labels wait to be recomputed.
    pub stale: bool,
    /// Its parts, as the library writes them.
    pub parts_json: String,
    /// The shapes its labels were carried from, as the library writes them.
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
    /// From 1; each is the one before plus 1.
    pub version: u64,
    /// Sequence number of the event that announced it.
    pub sequence: u64,
    /// The rule that made it.
    pub cause: String,
    /// Label of each proxy face `(m,)`; -1 is unlabelled.
    pub proxy_labels: Vec<i32>,
    /// Probability of each label for each proxy face `(m, k)`, see [`confidence_to_u8`]; the order of the
    /// labels is that of the collection's model.
    pub proxy_probabilities: Vec<u8>,
    /// Label of each input polygon `(n_polygons,)`; -1 is unlabelled.
    pub polygon_labels: Vec<i32>,
    /// Probability of the label of each input polygon `(n_polygons,)`, see [`confidence_to_u8`].
    pub polygon_confidence: Vec<u8>,
    /// The shapes the labels were carried from, as the library writes them.
    pub sources_json: String,
}

/// What a shape's row says of its newest labels.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LabelSummary {
    /// Epoch of the collection for which the labels were computed.
    pub label_epoch: u64,
    /// The parts, as the library writes them.
    pub parts_json: String,
    /// Each label the shape carries, with its share of the area.
    pub area_shares: Vec<(u32, f64)>,
}

/// A probability from 0 to 1 in steps of 1/255, the resolution that is stored; others are clamped,
/// and what is not a number counts as 0.
pub fn confidence_to_u8(probability: f32) -> u8 {
    // A cast from float saturates and takes NaN to 0.
    (probability * 255.0).round() as u8
}

/// The probability that [`confidence_to_u8`] stored.
pub fn confidence_from_u8(stored: u8) -> f32 {
    f32::from(stored) / 255.0
}

/// A label of a collection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LabelRow {
    /// Its id.
    pub id: u32,
    /// A name a person gave.
    pub name: Option<String>,
    /// sRGB colour.
    pub colour: [u8; 3],
    /// The label this one was merged into.
    pub merged_into: Option<u32>,
}

/// Something a person changed in a collection, as long as it can be undone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CorrectionRow {
    /// Its id, growing in the order of the changes.
    pub id: i64,
    /// What kind of change, as the library writes it.
    pub kind: String,
    /// What was changed, as the library writes it.
    pub detail_json: String,
    /// What the library needs to undo it.
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

/// The newest labels a shape had before a correction.
#[derive(Debug, Clone, PartialEq)]
pub struct LabelsBefore {
    /// Which shape.
    pub shape: ShapeId,
    /// Version of its labels then; it stays readable as long as the correction can be undone.
    pub version: u64,
    /// What its row said of them.
    pub summary: LabelSummary,
}

/// A functional map that is kept.
#[derive(Debug, Clone, PartialEq)]
pub struct MapRow {
    /// Functions on this shape are carried
    pub from: ShapeId,
    /// to this one.
    pub to: ShapeId,
    /// Columns of `c_12`.
    pub k1: u32,
    /// Rows of `c_12`.
    pub k2: u32,
    /// `c_12 (k2, k1)`, row-major.
    pub c_12: Vec<f32>,
    /// `p2p_21 (n2,)`: for each proxy vertex of `to` a proxy vertex of `from`.
    pub p2p_21: Vec<u32>,
    /// What to expect of it at each proxy vertex of `to`, as the library writes it; empty in a map that was kept before that
    /// was known.
    pub confidence: Vec<u8>,
    /// How good it is, as the library writes it.
    pub quality_json: String,
}

/// A map between points that is kept.
#[derive(Debug, Clone, PartialEq)]
pub struct PointMapRow {
    /// Rows and columns of `c_12`.
    pub k: u32,
    /// `c_12 (k, k)`, row-major.
    pub c_12: Vec<f32>,
    /// `p2p_21 (n2,)`: for each proxy vertex of the second shape a proxy vertex of the first.
    pub p2p_21: Vec<u32>,
    /// For each proxy vertex of the second shape 1 if something corresponds to it, else 0.
    pub matched: Vec<u8>,
    /// How good it is, as the library writes it.
    pub detail_json: String,
}

/// Shapes that were accepted together.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JobRow {
    /// Its id, from 1, growing in the order of acceptance.
    pub id: u64,
    /// Name of the collection.
    pub collection: String,
    /// When it was accepted, in seconds since 1970.
    pub created_unix_secs: u64,
}

/// A shape of a new job.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewJobItem {
    /// The shape's name.
    pub name: String,
    /// BLAKE3 of the original bytes; their object must be catalogued.
    pub original_digest: Digest,
    /// Format of the original bytes, as the library writes it.
    pub format: String,
    /// Whether other bytes under the same name are replaced.
    pub replace: bool,
}

/// How far a shape of a job is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ItemStatus {
    /// Not done; taken up again after a restart.
    Queued,
    /// Labelled and durable.
    Done,
    /// Refused.
    Failed,
    /// Cancelled before it was placed.
    Cancelled,
}

/// A shape of a job.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JobItemRow {
    /// Which job.
    pub job: u64,
    /// Position in the job, from 0.
    pub index: u32,
    /// Name of the job's collection.
    pub collection: String,
    /// As it was accepted.
    pub item: NewJobItem,
    /// How far it is.
    pub status: ItemStatus,
    /// What became of it, as the library writes it.
    pub detail_json: Option<String>,
}

/// A request that was answered: its effect is durable exactly if this row is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RequestRow {
    /// Who asked.
    pub client_id: String,
    /// Which request of theirs.
    pub request_id: String,
    /// Digest of the request, to tell a repeat from another request under the same id.
    pub request_digest: Digest,
    /// The reply, as it was sent.
    pub reply: Vec<u8>,
    /// When it was answered, in seconds since 1970.
    pub created_unix_secs: u64,
}

/// Something that happened under a collection's name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EventRow {
    /// Position in the log of the name, from 1, without gaps.
    pub sequence: u64,
    /// What happened, for people who look into the catalog.
    pub kind: String,
    /// The event, as the library writes it.
    pub payload_json: String,
}

/// Counters over the whole catalog.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Totals {
    /// Collections.
    pub n_collections: u64,
    /// Shapes.
    pub n_shapes: u64,
    /// Shapes whose labels wait to be recomputed.
    pub n_stale: u64,
    /// Job items not yet done.
    pub n_queued: u64,
    /// Bytes of all catalogued object files.
    pub object_bytes: u64,
    /// Bytes of the catalog itself.
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
