//! Reads and writes shapes and the rows of their object files.

use super::reader::{Fields, Reader, Tx, missing};
use super::schema::{OBJECTS, SHAPE_SIGNATURES, SHAPES};
use crate::store::codec::{floats_from_blob, floats_to_blob};
use crate::store::rows::{
    CollectionId, DescriptionRef, NewShapeRow, ObjectKind, ObjectRow, ShapeId, ShapeRow,
};
use crate::store::{Digest, StoreError};
use rusqlite::params;

type Result<T> = std::result::Result<T, StoreError>;

/// The condition that no shape or item needs a row of `objects`. Failed items count, since they may
/// be retried.
const UNREFERENCED: &str = "
    CASE kind
    WHEN 'description' THEN NOT EXISTS (
        SELECT 1 FROM shapes WHERE description_digest = objects.digest)
    ELSE NOT EXISTS (SELECT 1 FROM shapes WHERE content_digest = objects.digest)
        AND digest NOT IN (
            SELECT original_digest FROM job_items WHERE status IN ('queued', 'failed'))
    END";

pub(super) fn shape_row(fields: &Fields<'_>) -> Result<ShapeRow> {
    Ok(ShapeRow {
        id: fields.get("id")?,
        collection: fields.get("collection_id")?,
        name: fields.get("name")?,
        ordinal: fields.get("ordinal")?,
        content_digest: fields.get("content_digest")?,
        format: fields.get("format")?,
        description_digest: fields.get("description_digest")?,
        n_polygons: fields.get("n_polygons")?,
        area: fields.get("area")?,
        report_json: fields.get("report")?,
        version: fields.get("version")?,
        label_epoch: fields.get("label_epoch")?,
        stale: fields.get("stale")?,
        parts_json: fields.get("parts")?,
        sources_json: fields.get("sources")?,
        stored_bytes: fields.get("stored_bytes")?,
    })
}

/// States of verdicts, as the library writes them.
#[derive(Debug, Clone, Copy)]
pub struct ReviewedAs<'a> {
    /// The state of the wanted shapes.
    pub wanted: &'a str,
    /// The state of shapes that have pins and no verdict, as an earlier version left them.
    pub pinned: &'a str,
    /// The state of shapes that have neither.
    pub unseen: &'a str,
}

fn object_row(fields: &Fields<'_>) -> Result<ObjectRow> {
    Ok(ObjectRow {
        kind: fields.get("kind")?,
        digest: fields.get("digest")?,
        file: fields.get("file")?,
        length: fields.get("length")?,
        blake3: fields.get("blake3")?,
    })
}

impl Reader<'_> {
    /// The shape with this id.
    pub fn shape(&self, id: ShapeId) -> Result<Option<ShapeRow>> {
        self.first(&SHAPES, "WHERE id = ?1", [id], shape_row)
    }

    /// The shape of this name.
    pub fn shape_by_name(&self, collection: CollectionId, name: &str) -> Result<Option<ShapeRow>> {
        let tail = "WHERE collection_id = ?1 AND name = ?2";
        self.first(&SHAPES, tail, params![collection, name], shape_row)
    }

    /// Shapes by ordinal, after `after_ordinal`, at most `limit`; with `label`, only those whose
    /// newest labels contain it.
    pub fn shapes(
        &self,
        collection: CollectionId,
        after_ordinal: u64,
        limit: usize,
        label: Option<u32>,
    ) -> Result<Vec<ShapeRow>> {
        let after = i64::try_from(after_ordinal).unwrap_or(i64::MAX);
        let limit = i64::try_from(limit).unwrap_or(i64::MAX);
        match label {
            None => {
                let tail = "WHERE collection_id = ?1 AND ordinal > ?2 ORDER BY ordinal LIMIT ?3";
                self.all(&SHAPES, tail, params![collection, after, limit], shape_row)
            }
            Some(label) => {
                let tail = "WHERE collection_id = ?1 AND ordinal > ?2 AND EXISTS (
                              SELECT 1 FROM shape_labels WHERE shape_id = shapes.id AND label = ?4
                            ) ORDER BY ordinal LIMIT ?3";
                self.all(
                    &SHAPES,
                    tail,
                    params![collection, after, limit, label],
                    shape_row,
                )
            }
        }
    }

    /// As [`Reader::shapes`], of those with a verdict in one state.
    pub fn reviewed_shapes(
        &self,
        collection: CollectionId,
        (after_ordinal, limit): (u64, usize),
        label: Option<u32>,
        state: &ReviewedAs<'_>,
    ) -> Result<Vec<ShapeRow>> {
        let after = i64::try_from(after_ordinal).unwrap_or(i64::MAX);
        let limit = i64::try_from(limit).unwrap_or(i64::MAX);
        let tail = "WHERE collection_id = ?1 AND ordinal > ?2 AND (?4 IS NULL OR EXISTS (
                      SELECT 1 FROM shape_labels WHERE shape_id = shapes.id AND label = ?4))
                    AND coalesce((SELECT state FROM reviews WHERE shape_id = shapes.id),
                      CASE WHEN EXISTS (SELECT 1 FROM pins WHERE shape_id = shapes.id)
                      THEN ?6 ELSE ?7 END) = ?5 ORDER BY ordinal LIMIT ?3";
        let ReviewedAs {
            wanted,
            pinned,
            unseen,
        } = state;
        let values = params![collection, after, limit, label, wanted, pinned, unseen];
        self.all(&SHAPES, tail, values, shape_row)
    }

    /// The stale shape of lowest ordinal, in one collection or in all (the oldest collection
    /// first).
    pub fn next_stale(&self, collection: Option<CollectionId>) -> Result<Option<ShapeRow>> {
        match collection {
            Some(id) => {
                let tail = "WHERE stale AND collection_id = ?1 ORDER BY ordinal";
                self.first(&SHAPES, tail, [id], shape_row)
            }
            None => {
                let tail = "WHERE stale ORDER BY collection_id, ordinal";
                self.first(&SHAPES, tail, [], shape_row)
            }
        }
    }

    /// Stale shapes, by ordinal.
    pub fn stale_shapes(&self, collection: CollectionId) -> Result<Vec<ShapeId>> {
        let tail = "WHERE stale AND collection_id = ?1 ORDER BY ordinal";
        self.all(&SHAPES, tail, [collection], |fields| fields.get("id"))
    }

    /// Names of the first shapes of a collection, at most `limit`, without reading the rest of
    /// their rows.
    pub fn shape_names(&self, collection: CollectionId, limit: u32) -> Result<Vec<String>> {
        let sql = "SELECT name FROM shapes WHERE collection_id = ?1 ORDER BY ordinal LIMIT ?2";
        self.names(sql, params![collection, limit])
    }

    /// Number of shapes of a collection.
    pub fn n_shapes(&self, collection: CollectionId) -> Result<u64> {
        self.number(
            "SELECT count(*) FROM shapes WHERE collection_id = ?1",
            [collection],
        )
    }

    /// Number of stale shapes of a collection.
    pub fn n_stale(&self, collection: CollectionId) -> Result<u64> {
        let sql = "SELECT count(*) FROM shapes WHERE stale AND collection_id = ?1";
        self.number(sql, [collection])
    }

    /// Every shape of a collection by ordinal, with the object of its description.
    pub fn descriptions(&self, collection: CollectionId) -> Result<Vec<DescriptionRef>> {
        let tail = "WHERE collection_id = ?1 ORDER BY ordinal";
        self.all(&SHAPES, tail, [collection], |fields| {
            let digest: Digest = fields.get("description_digest")?;
            Ok(DescriptionRef {
                shape: fields.get("id")?,
                ordinal: fields.get("ordinal")?,
                name: fields.get("name")?,
                version: fields.get("version")?,
                object: self
                    .object(ObjectKind::Description, &digest)?
                    .ok_or_else(|| {
                        fields.damaged("description_digest", format!("no object {digest}"))
                    })?,
            })
        })
    }

    /// The global descriptor of one shape.
    pub fn signature(&self, shape: ShapeId) -> Result<Option<Vec<f32>>> {
        self.first(
            &SHAPE_SIGNATURES,
            "WHERE shape_id = ?1",
            [shape],
            |fields| fields.unpack("signature", floats_from_blob),
        )
    }

    /// Calls `visit` with the global descriptor of each shape of a collection, in order of their
    /// ids, without loading all of them.
    pub fn each_signature(
        &self,
        collection: CollectionId,
        mut visit: impl FnMut(ShapeId, &[f32]),
    ) -> Result<()> {
        let tail = "WHERE shape_id IN (SELECT id FROM shapes WHERE collection_id = ?1)
                    ORDER BY shape_id";
        self.each(&SHAPE_SIGNATURES, tail, [collection], |fields| {
            let signature = fields.unpack("signature", floats_from_blob)?;
            visit(fields.get("shape_id")?, &signature);
            Ok(())
        })
    }

    /// The object file of a digest; `None` if no such file was committed.
    pub fn object(&self, kind: ObjectKind, digest: &Digest) -> Result<Option<ObjectRow>> {
        let tail = "WHERE kind = ?1 AND digest = ?2";
        self.first(&OBJECTS, tail, params![kind, digest], object_row)
    }

    /// All object files.
    pub fn objects(&self) -> Result<Vec<ObjectRow>> {
        self.all(&OBJECTS, "ORDER BY kind, digest", [], object_row)
    }

    /// Whether there are object files that neither a shape nor a queued item needs.
    pub fn has_unreferenced_objects(&self) -> Result<bool> {
        let sql = format!("SELECT EXISTS (SELECT 1 FROM objects WHERE {UNREFERENCED})");
        Ok(self.number(&sql, [])? > 0)
    }

    /// Whether a row names this file.
    pub fn is_catalogued(&self, file: &str) -> Result<bool> {
        Ok(self.number("SELECT count(*) FROM objects WHERE file = ?1", [file])? > 0)
    }

    fn require_object(&self, kind: ObjectKind, digest: &Digest) -> Result<()> {
        match self.object(kind, digest)? {
            Some(_) => Ok(()),
            None => Err(missing(&OBJECTS, digest)),
        }
    }

    pub(super) fn require_original(&self, digest: &Digest) -> Result<()> {
        self.require_object(ObjectKind::Original, digest)
    }
}

impl Tx<'_> {
    /// Commits an object file whose bytes are durable; from now on it exists.
    pub fn insert_object(&self, row: &ObjectRow) -> Result<()> {
        self.execute(
            "INSERT INTO objects (kind, digest, file, length, blake3) VALUES (?1, ?2, ?3, ?4, ?5)
             ON CONFLICT (kind, digest) DO UPDATE
             SET file = excluded.file, length = excluded.length, blake3 = excluded.blake3",
            params![row.kind, row.digest, row.file, row.length, row.blake3],
        )?;
        Ok(())
    }

    /// Deletes the rows of object files that neither a shape nor a queued item needs, and returns
    /// the files.
    pub fn delete_unreferenced_objects(&self) -> Result<Vec<String>> {
        let sql = format!("DELETE FROM objects WHERE {UNREFERENCED} RETURNING file");
        let mut statement = self.connection().prepare_cached(&sql)?;
        let files = statement.query_map([], |row| row.get(0))?;
        Ok(files.collect::<rusqlite::Result<_>>()?)
    }

    /// Replaces the global descriptor of a shape, for instance one that cannot be read.
    pub fn put_signature(&self, shape: ShapeId, signature: &[f32]) -> Result<()> {
        self.execute("DELETE FROM shape_signatures WHERE shape_id = ?1", [shape])?;
        let signature = floats_to_blob(signature);
        self.insert(&SHAPE_SIGNATURES, shape, params![shape, signature])?;
        Ok(())
    }

    /// Inserts a shape, whose object files must be catalogued. It has no labels yet: the first
    /// [`Tx::put_labels`] makes version `new.version + 1`.
    pub fn insert_shape(&self, new: &NewShapeRow) -> Result<ShapeId> {
        self.require_original(&new.content_digest)?;
        self.require_object(ObjectKind::Description, &new.description_digest)?;
        let row = params![
            None::<i64>,
            new.collection,
            new.name,
            new.ordinal,
            new.content_digest,
            new.format,
            new.description_digest,
            new.n_polygons,
            new.area,
            new.report_json,
            new.version,
            0,
            false,
            "[]",
            "[]",
            new.stored_bytes,
        ];
        let key = format!("{}/{} ({})", new.collection, new.name, new.ordinal);
        let id = ShapeId(self.insert(&SHAPES, key, row)?);
        let signature = floats_to_blob(&new.signature);
        self.insert(&SHAPE_SIGNATURES, id, params![id, signature])?;
        Ok(id)
    }

    /// Deletes a shape with its labels, statistics and maps.
    pub fn delete_shape(&self, id: ShapeId) -> Result<()> {
        self.change(&SHAPES, id, "DELETE FROM shapes WHERE id = ?1", [id])
    }

    /// Sets whether the labels of one shape are stale.
    pub fn set_stale(&self, id: ShapeId, stale: bool) -> Result<()> {
        let sql = "UPDATE shapes SET stale = ?2 WHERE id = ?1";
        self.change(&SHAPES, id, sql, params![id, stale])
    }

    /// Marks the labels of every shape of a collection as stale; returns the number of stale
    /// shapes.
    pub fn mark_all_stale(&self, collection: CollectionId) -> Result<u64> {
        let sql = "UPDATE shapes SET stale = 1 WHERE collection_id = ?1 AND NOT stale";
        Ok(self.execute(sql, [collection])? as u64)
    }

    /// Marks shapes of a collection with labels of an epoch before `epoch` as stale; returns their
    /// number.
    pub fn mark_stale_before(&self, collection: CollectionId, epoch: u64) -> Result<u64> {
        let sql = "UPDATE shapes SET stale = 1
                   WHERE collection_id = ?1 AND label_epoch < ?2 AND NOT stale";
        Ok(self.execute(sql, params![collection, epoch])? as u64)
    }
}
