//! Reads and writes collections, their label models, and the event log of each name.
//!
//! Events belong to a collection's *name*: the log stays when the collection is deleted, and a new
//! collection of the same name continues it. So a sequence number never repeats, and a subscriber
//! that was disconnected during all of this sees the complete log.

use super::reader::{Fields, Reader, Tx, missing};
use super::schema::{COLLECTIONS, EVENTS, MODELS, STREAMS};
use crate::store::StoreError;
use crate::store::codec::{pack_bytes, unpack_bytes};
use crate::store::rows::{CollectionId, CollectionRow, EventRow, NewCollection};
use rusqlite::params;

type Result<T> = std::result::Result<T, StoreError>;

impl Reader<'_> {
    /// The collection of this name.
    pub fn collection(&self, name: &str) -> Result<Option<CollectionRow>> {
        self.first(&COLLECTIONS, "WHERE name = ?1", [name], |fields| {
            self.collection_row(fields)
        })
    }

    /// The collection with this id.
    pub fn collection_by_id(&self, id: CollectionId) -> Result<Option<CollectionRow>> {
        self.first(&COLLECTIONS, "WHERE id = ?1", [id], |fields| {
            self.collection_row(fields)
        })
    }

    /// Names of collections, at most `limit`.
    pub fn collection_names(&self, limit: u32) -> Result<Vec<String>> {
        self.names(
            "SELECT name FROM collections ORDER BY name LIMIT ?1",
            [limit],
        )
    }

    /// All collections by name.
    pub fn collections(&self) -> Result<Vec<CollectionRow>> {
        self.all(&COLLECTIONS, "ORDER BY name", [], |fields| {
            self.collection_row(fields)
        })
    }

    fn collection_row(&self, fields: &Fields<'_>) -> Result<CollectionRow> {
        let name: String = fields.get("name")?;
        Ok(CollectionRow {
            id: fields.get("id")?,
            n_parts: fields.get("n_parts")?,
            up: fields.get("up")?,
            operator: fields.get("operator")?,
            working_faces: fields.get("working_faces")?,
            sequence: self.sequence(&name)?,
            next_ordinal: fields.get("next_ordinal")?,
            next_label: fields.get("next_label")?,
            epoch: fields.get("epoch")?,
            state: fields.get("state")?,
            name,
        })
    }

    /// The stored label model of a collection.
    pub fn model(&self, collection: CollectionId) -> Result<Option<Vec<u8>>> {
        self.first(
            &MODELS,
            "WHERE collection_id = ?1",
            [collection],
            |fields| fields.unpack("model", unpack_bytes),
        )
    }

    /// Sequence number of the newest event under a name; 0 before the first.
    pub fn sequence(&self, name: &str) -> Result<u64> {
        let sequence = self.first(&STREAMS, "WHERE name = ?1", [name], |fields| {
            fields.get("sequence")
        })?;
        Ok(sequence.unwrap_or(0))
    }

    /// Events under a name after `sequence`, oldest first, at most `limit`. Deleted collections
    /// have events, too.
    pub fn events_since(&self, name: &str, sequence: u64, limit: usize) -> Result<Vec<EventRow>> {
        let tail = "WHERE stream_id = (SELECT id FROM streams WHERE name = ?1) AND sequence > ?2
                    ORDER BY sequence LIMIT ?3";
        let sequence = i64::try_from(sequence).unwrap_or(i64::MAX);
        let limit = i64::try_from(limit).unwrap_or(i64::MAX);
        self.all(&EVENTS, tail, params![name, sequence, limit], |fields| {
            Ok(EventRow {
                sequence: fields.get("sequence")?,
                kind: fields.get("kind")?,
                payload_json: fields.get("payload")?,
            })
        })
    }
}

impl Tx<'_> {
    /// Creates a collection; it continues the log of an earlier collection of the same name.
    pub fn insert_collection(&self, new: &NewCollection) -> Result<CollectionId> {
        self.execute(
            "INSERT INTO streams (name, sequence) VALUES (?1, 0) ON CONFLICT (name) DO NOTHING",
            [&new.name],
        )?;
        let stream = self.number("SELECT id FROM streams WHERE name = ?1", [&new.name])?;
        let row = params![
            None::<i64>,
            new.name,
            stream,
            new.n_parts,
            new.up,
            new.operator,
            new.working_faces,
            1,
            0,
            0,
            new.state,
        ];
        Ok(CollectionId(self.insert(&COLLECTIONS, &new.name, row)?))
    }

    /// Deletes a collection with its shapes, labels and maps. Its events stay.
    pub fn delete_collection(&self, id: CollectionId) -> Result<()> {
        self.change(
            &COLLECTIONS,
            id,
            "DELETE FROM collections WHERE id = ?1",
            [id],
        )
    }

    /// Replaces the label model.
    pub fn set_model(&self, id: CollectionId, model: &[u8]) -> Result<()> {
        let blob = pack_bytes(model);
        self.execute("DELETE FROM models WHERE collection_id = ?1", [id])?;
        self.insert(&MODELS, id, params![id, blob])?;
        Ok(())
    }

    /// Replaces the library's opaque state of the collection.
    pub fn set_state(&self, id: CollectionId, state: &[u8]) -> Result<()> {
        let sql = "UPDATE collections SET state = ?2 WHERE id = ?1";
        self.change(&COLLECTIONS, id, sql, params![id, state])
    }

    /// Sets the generation of the collection's labels.
    pub fn set_epoch(&self, id: CollectionId, epoch: u64) -> Result<()> {
        let sql = "UPDATE collections SET epoch = ?2 WHERE id = ?1";
        self.change(&COLLECTIONS, id, sql, params![id, epoch])
    }

    /// Sets the number of part kinds and the up axis.
    pub fn set_parameters(&self, id: CollectionId, n_parts: Option<u32>, up: &str) -> Result<()> {
        let sql = "UPDATE collections SET n_parts = ?2, up = ?3 WHERE id = ?1";
        self.change(&COLLECTIONS, id, sql, params![id, n_parts, up])
    }

    /// The next ordinal of a collection; it is never used again.
    pub fn take_ordinal(&self, id: CollectionId) -> Result<u64> {
        let taken = "UPDATE collections SET next_ordinal = next_ordinal + 1 WHERE id = ?1
                     RETURNING next_ordinal - 1";
        self.returned(id, taken, params![id])
    }

    /// The first of `count` new label ids of a collection; they are never used again.
    pub fn take_labels(&self, id: CollectionId, count: u32) -> Result<u32> {
        let taken = "UPDATE collections SET next_label = next_label + ?2 WHERE id = ?1
                     RETURNING next_label - ?2";
        self.returned(id, taken, params![id, count])
    }

    /// Ensures that new labels have ids above `label`, which a person has chosen.
    pub fn reserve_label(&self, id: CollectionId, label: u32) -> Result<()> {
        let sql = "UPDATE collections SET next_label = max(next_label, ?2) WHERE id = ?1";
        self.change(&COLLECTIONS, id, sql, params![id, u64::from(label) + 1])
    }

    fn returned<T: rusqlite::types::FromSql>(
        &self,
        id: CollectionId,
        sql: &str,
        params: impl rusqlite::Params,
    ) -> Result<T> {
        self.optional(sql, params)?
            .ok_or_else(|| missing(&COLLECTIONS, id))
    }

    /// Appends an event to the log of the collection's name and returns its sequence number.
    pub fn append_event(&self, id: CollectionId, kind: &str, payload_json: &str) -> Result<u64> {
        let stream: i64 = self.returned(
            id,
            "SELECT stream_id FROM collections WHERE id = ?1",
            params![id],
        )?;
        let sequence = self.number(
            "UPDATE streams SET sequence = sequence + 1 WHERE id = ?1 RETURNING sequence",
            [stream],
        )?;
        let key = format!("{stream}, {sequence}");
        self.insert(&EVENTS, key, params![stream, sequence, kind, payload_json])?;
        Ok(sequence)
    }
}
