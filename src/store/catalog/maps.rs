//! Reads and writes stored functional maps, for parts and between points. A map is deleted together
//! with either of its shapes.

use super::reader::{Fields, Reader, Tx};
use super::schema::{MAP_CONFIDENCE, MAPS, POINT_MAPS};
use crate::store::StoreError;
use crate::store::codec::{
    floats_from_blob, floats_to_blob, pack_bytes, pack_u32, unpack_bytes, unpack_u32,
};
use crate::store::rows::{MapRow, PointMapRow, ShapeId};
use rusqlite::params;

/// Maximum number of stored maps between points; the oldest are deleted first.
pub(super) const MAX_POINT_MAPS: u64 = 500;

type Result<T> = std::result::Result<T, StoreError>;

fn map_row(fields: &Fields<'_>) -> Result<MapRow> {
    let row = MapRow {
        from: fields.get("from_shape")?,
        to: fields.get("to_shape")?,
        k1: fields.get("k1")?,
        k2: fields.get("k2")?,
        c_12: fields.unpack("c_12", floats_from_blob)?,
        p2p_21: fields.unpack("p2p_21", unpack_u32)?,
        confidence: Vec::new(),
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

fn point_map_row(fields: &Fields<'_>) -> Result<PointMapRow> {
    let row = PointMapRow {
        k: fields.get("k")?,
        c_12: fields.unpack("c_12", floats_from_blob)?,
        p2p_21: fields.unpack("p2p_21", unpack_u32)?,
        matched: fields.unpack("matched", unpack_bytes)?,
        detail_json: fields.get("detail")?,
    };
    let (found, expected) = (row.c_12.len() as u64, u64::from(row.k).pow(2));
    if found != expected {
        let text = format!("{found} coefficients, but k · k = {expected}");
        return Err(fields.damaged("c_12", text));
    }
    let (found, expected) = (row.matched.len(), row.p2p_21.len());
    if found != expected {
        let text = format!("{found} vertices, but the map has {expected}");
        return Err(fields.damaged("matched", text));
    }
    Ok(row)
}

impl Reader<'_> {
    /// The map that transfers functions on `from` to `to`.
    pub fn map(&self, from: ShapeId, to: ShapeId) -> Result<Option<MapRow>> {
        let found = self.first(
            &MAPS,
            "WHERE from_shape = ?1 AND to_shape = ?2",
            [from, to],
            map_row,
        )?;
        found.map(|row| self.with_confidence(row)).transpose()
    }

    /// Whether there is a map that carries functions on `from` to `to`.
    pub fn has_map(&self, from: ShapeId, to: ShapeId) -> Result<bool> {
        let sql = "SELECT EXISTS (SELECT 1 FROM maps WHERE from_shape = ?1 AND to_shape = ?2)";
        Ok(self.number(sql, [from, to])? > 0)
    }

    fn with_confidence(&self, mut row: MapRow) -> Result<MapRow> {
        let found = self.first(
            &MAP_CONFIDENCE,
            "WHERE from_shape = ?1 AND to_shape = ?2",
            [row.from, row.to],
            |fields| fields.unpack("of_vertex", unpack_bytes),
        )?;
        if let Some(confidence) = found {
            let (found, expected) = (confidence.len(), row.p2p_21.len());
            if found != expected {
                return Err(StoreError::DamagedRow {
                    table: MAP_CONFIDENCE.name,
                    key: format!("{}, {}", row.from, row.to),
                    message: format!("{found} vertices, but the map has {expected}"),
                });
            }
            row.confidence = confidence;
        }
        Ok(row)
    }

    /// The stored maps between points for a request in the library's format, best first; empty if
    /// there are none.
    pub fn point_maps(
        &self,
        from: ShapeId,
        to: ShapeId,
        request: &str,
    ) -> Result<Vec<PointMapRow>> {
        self.all(
            &POINT_MAPS,
            "WHERE from_shape = ?1 AND to_shape = ?2 AND request = ?3 ORDER BY rank",
            params![from, to, request],
            point_map_row,
        )
    }

    /// The keys of stored maps between points: from, to, request. Their rows are not read.
    pub fn point_map_keys(&self) -> Result<Vec<(ShapeId, ShapeId, String)>> {
        let mut statement = self.connection().prepare_cached(
            "SELECT DISTINCT from_shape, to_shape, request FROM point_maps
             ORDER BY from_shape, to_shape, request",
        )?;
        let key = |row: &rusqlite::Row<'_>| -> rusqlite::Result<(ShapeId, ShapeId, String)> {
            Ok((row.get(0)?, row.get(1)?, row.get(2)?))
        };
        let keys = statement.query_map([], key)?;
        Ok(keys.collect::<rusqlite::Result<_>>()?)
    }

    /// All maps that transfer functions to a shape, in order of their sources' ids.
    pub fn maps_into(&self, to: ShapeId) -> Result<Vec<MapRow>> {
        let tail = "WHERE to_shape = ?1 ORDER BY from_shape";
        let rows = self.all(&MAPS, tail, [to], map_row)?;
        rows.into_iter()
            .map(|row| self.with_confidence(row))
            .collect()
    }

    /// The shapes that receive a shape's functions, in order of their ids.
    pub fn mapped_from(&self, from: ShapeId) -> Result<Vec<ShapeId>> {
        let sql = "SELECT to_shape FROM maps WHERE from_shape = ?1 ORDER BY to_shape";
        let mut statement = self.connection().prepare_cached(sql)?;
        let shapes = statement.query_map([from], |row| row.get(0))?;
        Ok(shapes.collect::<rusqlite::Result<_>>()?)
    }

    /// The keys of stored maps: from, to. Their rows are not read.
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
        self.insert(&MAPS, key.clone(), row)?;
        if !map.confidence.is_empty() {
            let confidence = pack_bytes(&map.confidence);
            let row = params![map.from, map.to, confidence];
            self.insert(&MAP_CONFIDENCE, key, row)?;
        }
        Ok(())
    }

    /// Stores the maps between points for a request, best first, and replaces earlier ones. Of more
    /// than [`MAX_POINT_MAPS`] the oldest are deleted.
    pub fn put_point_maps(
        &self,
        from: ShapeId,
        to: ShapeId,
        request: &str,
        maps: &[PointMapRow],
    ) -> Result<()> {
        self.delete_point_maps(from, to, request)?;
        for (rank, map) in maps.iter().enumerate() {
            let (c_12, p2p_21) = (floats_to_blob(&map.c_12), pack_u32(&map.p2p_21));
            let (rank, matched) = (rank as u64, pack_bytes(&map.matched));
            let row = params![
                from,
                to,
                request,
                rank,
                map.k,
                c_12,
                p2p_21,
                matched,
                map.detail_json
            ];
            self.insert(&POINT_MAPS, format!("{from}, {to}, {request}, {rank}"), row)?;
        }
        self.execute(
            "DELETE FROM point_maps WHERE rowid <= (SELECT max(rowid) FROM point_maps) - ?1",
            [MAX_POINT_MAPS],
        )?;
        Ok(())
    }

    /// Deletes the maps between points for a request, if they exist.
    pub fn delete_point_maps(&self, from: ShapeId, to: ShapeId, request: &str) -> Result<()> {
        self.execute(
            "DELETE FROM point_maps WHERE from_shape = ?1 AND to_shape = ?2 AND request = ?3",
            params![from, to, request],
        )?;
        Ok(())
    }

    /// Deletes a map, if it exists.
    pub fn delete_map(&self, from: ShapeId, to: ShapeId) -> Result<()> {
        self.execute(
            "DELETE FROM maps WHERE from_shape = ?1 AND to_shape = ?2",
            [from, to],
        )?;
        Ok(())
    }
}
