//! Functional maps that are kept. A map goes when either of its shapes goes.

use super::reader::{Fields, Reader, Tx};
use super::schema::MAPS;
use crate::store::StoreError;
use crate::store::codec::{floats_from_blob, floats_to_blob, pack_u32, unpack_u32};
use crate::store::rows::{MapRow, ShapeId};
use rusqlite::params;

type Result<T> = std::result::Result<T, StoreError>;

fn map_row(fields: &Fields<'_>) -> Result<MapRow> {
    let row = MapRow {
        from: fields.get("from_shape")?,
        to: fields.get("to_shape")?,
        k1: fields.get("k1")?,
        k2: fields.get("k2")?,
        c_12: fields.unpack("c_12", floats_from_blob)?,
        p2p_21: fields.unpack("p2p_21", unpack_u32)?,
        quality_json: fields.get("quality")?,
    };
    let expected = u64::from(row.k1) * u64::from(row.k2);
    if row.c_12.len() as u64 != expected {
        let found = row.c_12.len();
        return Err(fields.damaged(
            "c_12",
            format!("{found} coefficients, but k2 · k1 = {expected}"),
        ));
    }
    Ok(row)
}

impl Reader<'_> {
    /// The map that carries functions on `from` to `to`.
    pub fn map(&self, from: ShapeId, to: ShapeId) -> Result<Option<MapRow>> {
        self.first(
            &MAPS,
            "WHERE from_shape = ?1 AND to_shape = ?2",
            [from, to],
            map_row,
        )
    }

    /// All maps that carry functions to a shape, in order of their sources' ids.
    pub fn maps_into(&self, to: ShapeId) -> Result<Vec<MapRow>> {
        self.all(
            &MAPS,
            "WHERE to_shape = ?1 ORDER BY from_shape",
            [to],
            map_row,
        )
    }

    /// The shapes that a shape's functions are carried to, in order of their ids.
    pub fn mapped_from(&self, from: ShapeId) -> Result<Vec<ShapeId>> {
        let sql = "SELECT to_shape FROM maps WHERE from_shape = ?1 ORDER BY to_shape";
        let mut statement = self.connection().prepare_cached(sql)?;
        let shapes = statement.query_map([from], |row| row.get(0))?;
        Ok(shapes.collect::<rusqlite::Result<_>>()?)
    }

    /// Which maps there are: from, to. Their rows are not read.
    pub fn map_keys(&self) -> Result<Vec<(ShapeId, ShapeId)>> {
        let mut statement = self.connection().prepare_cached(
            "SELECT from_shape, to_shape FROM maps ORDER BY from_shape, to_shape",
        )?;
        let keys = statement.query_map([], |row| Ok((row.get(0)?, row.get(1)?)))?;
        Ok(keys.collect::<rusqlite::Result<_>>()?)
    }
}

impl Tx<'_> {
    /// Inserts or replaces a map.
    pub fn put_map(&self, map: &MapRow) -> Result<()> {
        let (value, expected) = (map.c_12.len() as u64, u64::from(map.k1) * u64::from(map.k2));
        if value != expected {
            let what = "number of coefficients of the map";
            return Err(StoreError::Must {
                what,
                value,
                expected,
            });
        }
        self.delete_map(map.from, map.to)?;
        let key = format!("{}, {}", map.from, map.to);
        let (c_12, p2p_21) = (floats_to_blob(&map.c_12), pack_u32(&map.p2p_21));
        let row = params![
            map.from,
            map.to,
            map.k1,
            map.k2,
            c_12,
            p2p_21,
            map.quality_json
        ];
        self.insert(&MAPS, key, row)?;
        Ok(())
    }

    /// Forgets a map, if it is there.
    pub fn delete_map(&self, from: ShapeId, to: ShapeId) -> Result<()> {
        self.execute(
            "DELETE FROM maps WHERE from_shape = ?1 AND to_shape = ?2",
            [from, to],
        )?;
        Ok(())
    }
}
