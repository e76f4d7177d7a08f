//! Reads and writes the links between parts that persons made.

use super::reader::{Fields, Reader, Tx};
use super::schema::LINKS;
use crate::store::StoreError;
use crate::store::codec::{pack_u32, unpack_u32};
use crate::store::rows::{CollectionId, LinkEnd, LinkRow};
use rusqlite::params;

type Result<T> = std::result::Result<T, StoreError>;

fn link_row(fields: &Fields<'_>) -> Result<LinkRow> {
    Ok(LinkRow {
        id: fields.get("id")?,
        kind: fields.get("kind")?,
        ends: [
            LinkEnd {
                shape: fields.get("shape_a")?,
                part: fields.get("part_a")?,
                polygons: fields.unpack("polygons_a", unpack_u32)?,
            },
            LinkEnd {
                shape: fields.get("shape_b")?,
                part: fields.get("part_b")?,
                polygons: fields.unpack("polygons_b", unpack_u32)?,
            },
        ],
        person: fields.get("person")?,
        unix_ms: fields.get("unix_ms")?,
    })
}

impl Reader<'_> {
    /// The links between parts of a collection, the oldest first.
    pub fn links(&self, collection: CollectionId) -> Result<Vec<LinkRow>> {
        self.all(
            &LINKS,
            "WHERE collection_id = ?1 ORDER BY id",
            [collection],
            link_row,
        )
    }
}

impl Tx<'_> {
    /// Inserts a link and returns its id. With id 0 the link gets a new id, which no link had
    /// before.
    pub fn insert_link(&self, collection: CollectionId, link: &LinkRow) -> Result<i64> {
        let [a, b] = &link.ends;
        let row = params![
            (link.id > 0).then_some(link.id),
            collection,
            link.kind,
            a.shape,
            a.part,
            pack_u32(&a.polygons),
            b.shape,
            b.part,
            pack_u32(&b.polygons),
            link.person,
            link.unix_ms,
        ];
        self.insert(&LINKS, format!("{collection}, {}", link.kind), row)
    }

    /// Deletes a link.
    pub fn delete_link(&self, id: i64) -> Result<()> {
        self.change(&LINKS, id, "DELETE FROM links WHERE id = ?1", [id])
    }
}
