//! Reads and writes labels of collections, versions of the labels of shapes, and their statistics.

use super::reader::{Fields, Reader, Tx, missing};
use super::schema::{LABEL_VERSIONS, LABELS, SHAPE_LABELS, SHAPE_STATS, SHAPES};
use crate::store::StoreError;
use crate::store::codec::{pack_bytes, pack_labels, unpack_bytes, unpack_labels};
use crate::store::rows::{CollectionId, LabelRow, LabelSummary, LabelVersionRow, ShapeId};
use rusqlite::params;
use std::collections::BTreeMap;

type Result<T> = std::result::Result<T, StoreError>;

/// The number of newest versions of the labels of one shape that stay readable. At one to ten
/// kilobytes for each version this bounds the history of a shape below the size of its arrays.
pub const KEPT_LABEL_VERSIONS: u64 = 64;

fn label_version_row(fields: &Fields<'_>) -> Result<LabelVersionRow> {
    Ok(LabelVersionRow {
        version: fields.get("version")?,
        sequence: fields.get("sequence")?,
        cause: fields.get("cause")?,
        proxy_labels: fields.unpack("proxy_labels", unpack_labels)?,
        proxy_probabilities: fields.unpack("proxy_probabilities", unpack_bytes)?,
        polygon_labels: fields.unpack("polygon_labels", unpack_labels)?,
        polygon_confidence: fields.unpack("polygon_confidence", unpack_bytes)?,
        sources_json: fields.get("sources")?,
    })
}

impl Reader<'_> {
    /// The labels of a collection by id, retired ones included.
    pub fn labels(&self, collection: CollectionId) -> Result<Vec<LabelRow>> {
        self.all(
            &LABELS,
            "WHERE collection_id = ?1 ORDER BY id",
            [collection],
            |fields| {
                let [zero, colour @ ..] = fields.get::<u32>("colour")?.to_be_bytes();
                if zero != 0 {
                    return Err(fields.damaged("colour", "more than 24 bits"));
                }
                Ok(LabelRow {
                    id: fields.get("id")?,
                    name: fields.get("name")?,
                    colour,
                    merged_into: fields.get("merged_into")?,
                })
            },
        )
    }

    /// The newest labels of a shape; `None` before the first.
    pub fn newest_labels(&self, shape: ShapeId) -> Result<Option<LabelVersionRow>> {
        let tail = "WHERE shape_id = ?1 ORDER BY version DESC";
        self.first(&LABEL_VERSIONS, tail, [shape], label_version_row)
    }

    /// One version of the labels of a shape; `None` if it is not (or no longer) stored.
    pub fn labels_at(&self, shape: ShapeId, version: u64) -> Result<Option<LabelVersionRow>> {
        let version = i64::try_from(version).unwrap_or(i64::MAX);
        let tail = "WHERE shape_id = ?1 AND version = ?2";
        self.first(
            &LABEL_VERSIONS,
            tail,
            params![shape, version],
            label_version_row,
        )
    }

    /// The stored versions of the labels of a shape, oldest first.
    pub fn kept_versions(&self, shape: ShapeId) -> Result<Vec<u64>> {
        let tail = "WHERE shape_id = ?1 ORDER BY version";
        self.all(&LABEL_VERSIONS, tail, [shape], |fields| {
            fields.get("version")
        })
    }

    /// Each label in the newest labels of a shape, with its share of the area.
    pub fn area_shares(&self, shape: ShapeId) -> Result<Vec<(u32, f64)>> {
        self.all(
            &SHAPE_LABELS,
            "WHERE shape_id = ?1 ORDER BY label",
            [shape],
            |fields| Ok((fields.get("label")?, fields.get("area_share")?)),
        )
    }

    /// For each label the number of shapes of a collection whose newest labels contain it, and the
    /// sum of its area shares there.
    pub fn label_uses(&self, collection: CollectionId) -> Result<BTreeMap<u32, (u64, f64)>> {
        let sql = "SELECT label, count(*), total(area_share)
                   FROM shape_labels JOIN shapes ON shapes.id = shape_id
                   WHERE collection_id = ?1 GROUP BY label";
        let mut statement = self.connection().prepare_cached(sql)?;
        let uses = statement.query_map([collection], |row| {
            Ok((row.get(0)?, (row.get(1)?, row.get(2)?)))
        })?;
        Ok(uses.collect::<rusqlite::Result<_>>()?)
    }

    /// The statistics of a shape, and their epoch.
    pub fn stats(&self, shape: ShapeId) -> Result<Option<(u64, Vec<u8>)>> {
        self.first(&SHAPE_STATS, "WHERE shape_id = ?1", [shape], |fields| {
            Ok((fields.get("epoch")?, fields.unpack("stats", unpack_bytes)?))
        })
    }

    /// Calls `visit` with shape, epoch and statistics of each shape of a collection that has some,
    /// in order of their ids, without loading all of them.
    pub fn each_stats(
        &self,
        collection: CollectionId,
        mut visit: impl FnMut(ShapeId, u64, &[u8]),
    ) -> Result<()> {
        let tail = "WHERE shape_id IN (SELECT id FROM shapes WHERE collection_id = ?1)
                    ORDER BY shape_id";
        self.each(&SHAPE_STATS, tail, [collection], |fields| {
            let stats = fields.unpack("stats", unpack_bytes)?;
            visit(fields.get("shape_id")?, fields.get("epoch")?, &stats);
            Ok(())
        })
    }
}

impl Tx<'_> {
    /// Inserts or replaces a label of a collection.
    pub fn put_label(&self, collection: CollectionId, label: &LabelRow) -> Result<()> {
        let [red, green, blue] = label.colour;
        let colour = u32::from_be_bytes([0, red, green, blue]);
        self.execute(
            "DELETE FROM labels WHERE collection_id = ?1 AND id = ?2",
            params![collection, label.id],
        )?;
        let row = params![collection, label.id, label.name, colour, label.merged_into];
        self.insert(&LABELS, format!("{collection}, {}", label.id), row)?;
        Ok(())
    }

    /// Makes these the newest labels of a shape: stores the version, updates the shape's row (which
    /// is then not stale), and deletes versions beyond [`KEPT_LABEL_VERSIONS`] that no undo needs.
    ///
    /// The version must be the shape's plus 1, with as many labels as the shape has polygons.
    pub fn put_labels(
        &self,
        shape: ShapeId,
        labels: &LabelVersionRow,
        summary: &LabelSummary,
    ) -> Result<()> {
        let row = self.shape(shape)?.ok_or_else(|| missing(&SHAPES, shape))?;
        let must = |what, value, expected| match value == expected {
            true => Ok(()),
            false => Err(StoreError::Must {
                what,
                value,
                expected,
            }),
        };
        must("version of the labels", labels.version, row.version + 1)?;
        must(
            "number of polygon labels",
            labels.polygon_labels.len() as u64,
            row.n_polygons,
        )?;
        must(
            "number of polygon confidences",
            labels.polygon_confidence.len() as u64,
            row.n_polygons,
        )?;
        must(
            "remainder of proxy probabilities by proxy faces",
            (labels.proxy_probabilities.len() % labels.proxy_labels.len().max(1)) as u64,
            0,
        )?;
        self.keep_for_undo(&row)?;
        self.insert(
            &LABEL_VERSIONS,
            format!("{shape}, {}", labels.version),
            params![
                shape,
                labels.version,
                labels.sequence,
                labels.cause,
                pack_labels(&labels.proxy_labels),
                pack_bytes(&labels.proxy_probabilities),
                pack_labels(&labels.polygon_labels),
                pack_bytes(&labels.polygon_confidence),
                labels.sources_json,
            ],
        )?;
        self.change(
            &SHAPES,
            shape,
            "UPDATE shapes SET version = ?2, label_epoch = ?3, stale = 0, parts = ?4, sources = ?5
             WHERE id = ?1",
            params![
                shape,
                labels.version,
                summary.label_epoch,
                summary.parts_json,
                labels.sources_json,
            ],
        )?;
        self.execute("DELETE FROM shape_labels WHERE shape_id = ?1", [shape])?;
        for &(label, area_share) in &summary.area_shares {
            let key = format!("{shape}, {label}");
            self.insert(&SHAPE_LABELS, key, params![shape, label, area_share])?;
        }
        let oldest = (labels.version + 1).saturating_sub(KEPT_LABEL_VERSIONS);
        self.execute(
            "DELETE FROM label_versions WHERE shape_id = ?1 AND version < ?2 AND NOT EXISTS (
               SELECT 1 FROM labels_before
               WHERE labels_before.shape_id = ?1 AND labels_before.version = \
               label_versions.version)",
            params![shape, oldest],
        )?;
        Ok(())
    }

    /// Replaces the statistics of a shape.
    pub fn put_stats(&self, shape: ShapeId, epoch: u64, stats: &[u8]) -> Result<()> {
        let blob = pack_bytes(stats);
        self.delete_stats(shape)?;
        self.insert(&SHAPE_STATS, shape, params![shape, epoch, blob])?;
        Ok(())
    }

    /// Deletes the statistics of a shape, if it has any.
    pub fn delete_stats(&self, shape: ShapeId) -> Result<()> {
        self.execute("DELETE FROM shape_stats WHERE shape_id = ?1", [shape])?;
        Ok(())
    }
}
