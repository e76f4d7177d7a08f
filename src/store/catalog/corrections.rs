//! Reads and writes a person's changes, with the data for undoing them: pinned faces, and previous
//! labels.

use super::reader::{Fields, Reader, Tx};
use super::schema::{CORRECTIONS, LABELS_BEFORE, PINS};
use crate::store::StoreError;
use crate::store::codec::{pack_bytes, pack_labels, unpack_bytes, unpack_labels};
use crate::store::rows::{
    CollectionId, CorrectionRow, LabelSummary, LabelsBefore, ShapeId, ShapeRow,
};
use rusqlite::params;

type Result<T> = std::result::Result<T, StoreError>;

/// The kind of correction that does not change labels of shapes.
pub const KIND_NAME: &str = "name";

fn correction_row(fields: &Fields<'_>) -> Result<CorrectionRow> {
    Ok(CorrectionRow {
        id: fields.get("id")?,
        kind: fields.get("kind")?,
        detail_json: fields.get("detail")?,
        before: fields.unpack("before", unpack_bytes)?,
    })
}

impl Reader<'_> {
    /// The label that a person gave each polygon of a shape, -1 for none; `None`: the shape has no
    /// pins.
    pub fn pins(&self, shape: ShapeId) -> Result<Option<Vec<i32>>> {
        self.first(&PINS, "WHERE shape_id = ?1", [shape], |fields| {
            fields.unpack("polygon_labels", unpack_labels)
        })
    }

    /// The shapes of a collection that have pinned faces, in order of their ids.
    pub fn pinned_shapes(&self, collection: CollectionId) -> Result<Vec<ShapeId>> {
        let tail = "WHERE shape_id IN (SELECT id FROM shapes WHERE collection_id = ?1)
                    ORDER BY shape_id";
        self.all(&PINS, tail, [collection], |fields| fields.get("shape_id"))
    }

    /// The newest correction of a collection that was not undone.
    pub fn newest_correction(&self, collection: CollectionId) -> Result<Option<CorrectionRow>> {
        let tail = "WHERE collection_id = ?1 ORDER BY id DESC";
        self.first(&CORRECTIONS, tail, [collection], correction_row)
    }

    /// Corrections of a collection that can be undone.
    pub fn n_corrections(&self, collection: CollectionId) -> Result<u64> {
        let sql = "SELECT count(*) FROM corrections WHERE collection_id = ?1";
        self.number(sql, [collection])
    }

    /// The labels of the shapes that changed since a correction, as they were before it.
    pub fn labels_before(&self, correction: i64) -> Result<Vec<LabelsBefore>> {
        let tail = "WHERE correction_id = ?1 ORDER BY shape_id";
        self.all(&LABELS_BEFORE, tail, [correction], |fields| {
            let shares: String = fields.get("area_shares")?;
            Ok(LabelsBefore {
                shape: fields.get("shape_id")?,
                version: fields.get("version")?,
                summary: LabelSummary {
                    label_epoch: fields.get("label_epoch")?,
                    parts_json: fields.get("parts")?,
                    area_shares: shares_from_text(&shares)
                        .ok_or_else(|| fields.damaged("area_shares", "not label and share"))?,
                },
            })
        })
    }
}

impl Tx<'_> {
    /// Replaces the pinned faces of a shape; `None` removes them.
    pub fn set_pins(&self, shape: ShapeId, polygon_labels: Option<&[i32]>) -> Result<()> {
        self.execute("DELETE FROM pins WHERE shape_id = ?1", [shape])?;
        if let Some(labels) = polygon_labels {
            self.insert(&PINS, shape, params![shape, pack_labels(labels)])?;
        }
        Ok(())
    }

    /// Records a correction; from now on, previous versions of the labels that it changes are kept.
    pub fn insert_correction(
        &self,
        collection: CollectionId,
        kind: &str,
        detail_json: &str,
        before: &[u8],
    ) -> Result<i64> {
        let row = params![
            None::<i64>,
            collection,
            kind,
            detail_json,
            pack_bytes(before)
        ];
        self.insert(&CORRECTIONS, format!("{collection}, {kind}"), row)
    }

    /// Deletes a correction and the labels kept for it.
    pub fn delete_correction(&self, id: i64) -> Result<()> {
        self.change(
            &CORRECTIONS,
            id,
            "DELETE FROM corrections WHERE id = ?1",
            [id],
        )
    }

    /// Stores the newest labels of a shape, which are about to be replaced, with the newest
    /// correction that changes labels, unless the shape has already changed since that correction.
    pub(super) fn keep_for_undo(&self, shape: &ShapeRow) -> Result<()> {
        // A shape that replaces another continues its versions, but has no labels before its first.
        if self.labels_at(shape.id, shape.version)?.is_none() {
            return Ok(());
        }
        let newest = "SELECT id FROM corrections WHERE collection_id = ?1 AND kind <> ?2
                      ORDER BY id DESC LIMIT 1";
        let newest: Option<i64> = self.optional(newest, params![shape.collection, KIND_NAME])?;
        let Some(correction) = newest else {
            return Ok(());
        };
        let noted = "SELECT count(*) FROM labels_before WHERE correction_id = ?1 AND shape_id = ?2";
        if self.number(noted, params![correction, shape.id])? > 0 {
            return Ok(());
        }
        let shares = shares_to_text(&self.area_shares(shape.id)?);
        let row = params![
            correction,
            shape.id,
            shape.version,
            shape.label_epoch,
            shape.parts_json,
            shares,
        ];
        self.insert(&LABELS_BEFORE, format!("{correction}, {}", shape.id), row)?;
        Ok(())
    }
}

/// Formats labels and shares as text that parses exactly: `3 0.25 7 0.75`.
fn shares_to_text(shares: &[(u32, f64)]) -> String {
    let words: Vec<String> = shares
        .iter()
        .map(|(label, share)| format!("{label} {share}"))
        .collect();
    words.join(" ")
}

fn shares_from_text(text: &str) -> Option<Vec<(u32, f64)>> {
    let words: Vec<&str> = text.split_whitespace().collect();
    let (pairs, rest) = words.as_chunks::<2>();
    if !rest.is_empty() {
        return None;
    }
    pairs
        .iter()
        .map(|[label, share]| Some((label.parse().ok()?, share.parse().ok()?)))
        .collect()
}
