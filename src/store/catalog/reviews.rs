//! What persons think of the labels of shapes, and the parts that they did not want to label.

use super::reader::{Fields, Reader, Tx};
use super::schema::{PASSED_PARTS, REVIEWS};
use crate::store::StoreError;
use crate::store::rows::{CollectionId, PassedPart, ReviewRow, ShapeId};
use rusqlite::params;
use std::collections::HashMap;

type Result<T> = std::result::Result<T, StoreError>;

fn review_row(fields: &Fields<'_>) -> Result<ReviewRow> {
    Ok(ReviewRow {
        state: fields.get("state")?,
        reviewer: fields.get("reviewer")?,
        unix_ms: fields.get("unix_ms")?,
    })
}

impl Reader<'_> {
    /// The verdict on the labels of a shape; `None`: nobody gave one.
    pub fn review(&self, shape: ShapeId) -> Result<Option<ReviewRow>> {
        self.first(&REVIEWS, "WHERE shape_id = ?1", [shape], review_row)
    }

    /// The verdicts on the shapes of a collection.
    pub fn reviews(&self, collection: CollectionId) -> Result<HashMap<ShapeId, ReviewRow>> {
        let tail = "WHERE shape_id IN (SELECT id FROM shapes WHERE collection_id = ?1)
                    ORDER BY shape_id";
        let rows = self.all(&REVIEWS, tail, [collection], |fields| {
            Ok((fields.get("shape_id")?, review_row(fields)?))
        })?;
        Ok(rows.into_iter().collect())
    }

    /// Number of shapes of a collection with a verdict.
    pub fn n_reviews(&self, collection: CollectionId, state: &str) -> Result<u64> {
        let sql = "SELECT count(*) FROM shapes JOIN reviews ON shape_id = shapes.id
                   WHERE collection_id = ?1 AND state = ?2";
        self.number(sql, params![collection, state])
    }

    /// Number of shapes of a collection that have pins and no verdict, as an earlier version left
    /// them.
    pub fn n_pinned_without_review(&self, collection: CollectionId) -> Result<u64> {
        let sql = "SELECT count(*) FROM shapes JOIN pins ON shape_id = shapes.id
                   WHERE collection_id = ?1
                   AND NOT EXISTS (SELECT 1 FROM reviews WHERE shape_id = shapes.id)";
        self.number(sql, [collection])
    }

    /// The parts in a collection that persons did not want to label, by shape and part.
    pub fn passed_parts(&self, collection: CollectionId) -> Result<Vec<PassedPart>> {
        let tail = "WHERE shape_id IN (SELECT id FROM shapes WHERE collection_id = ?1)
                    ORDER BY shape_id, part";
        self.all(&PASSED_PARTS, tail, [collection], |fields| {
            Ok(PassedPart {
                shape: fields.get("shape_id")?,
                part: fields.get("part")?,
                why: fields.get("why")?,
            })
        })
    }
}

impl Tx<'_> {
    /// Replaces the verdict on the labels of a shape; `None`: nobody gave one.
    pub fn set_review(&self, shape: ShapeId, review: Option<&ReviewRow>) -> Result<()> {
        self.execute("DELETE FROM reviews WHERE shape_id = ?1", [shape])?;
        if let Some(review) = review {
            let row = params![shape, review.state, review.reviewer, review.unix_ms];
            self.insert(&REVIEWS, shape, row)?;
        }
        Ok(())
    }

    /// Notes that a person did not want to label a part.
    pub fn pass_part(&self, shape: ShapeId, part: u32, why: &str) -> Result<()> {
        let key = params![shape, part];
        self.execute(
            "DELETE FROM passed_parts WHERE shape_id = ?1 AND part = ?2",
            key,
        )?;
        self.insert(&PASSED_PARTS, shape, params![shape, part, why])?;
        Ok(())
    }
}
