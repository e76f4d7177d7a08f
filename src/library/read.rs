//! What the library says: shapes, labels, arrays, maps, events.

use super::relabel::face_ids;
use super::rows::{
    confidence_of_row, damaged, format_from_name, from_json, quality_from_json, report_from_json,
    to_json,
};
use super::{
    Event, EventKind, LabelId, Labels, Library, LibraryError, LibraryStats, MapInfo, PartMatch,
    RequestKey, Result, ShapeInfo,
};
use crate::correspondence::{overlaps, part_of_vertex, parts};
use crate::fmap::{MapOptions, Quality};
use crate::mesh::Format;
use crate::pipeline::{Prepared, map};
use crate::segmentation::Surface;
use crate::store::rows::confidence_from_u8;
use crate::store::{CollectionRow, Digest, LabelVersionRow, MappedDescription, Reader, ShapeRow};
use std::sync::atomic::Ordering;

/// Names among which one that was probably meant is looked for, so that a wrong name costs little
/// in any library.
const MAX_COMPARED: u32 = 5_000;

impl Library {
    /// Shapes by ordinal, after `after_ordinal`, at most `limit`; with `label`, only those that carry it.
    ///
    /// # Errors
    /// There is no such collection.
    pub fn shapes(
        &self,
        collection: &str,
        after_ordinal: u64,
        limit: usize,
        label: Option<LabelId>,
    ) -> Result<Vec<ShapeInfo>> {
        let id = self.collection_row(collection)?.id;
        self.store.catalog().read(|r| {
            r.shapes(id, after_ordinal, limit, label)?
                .into_iter()
                .map(shape_info)
                .collect()
        })
    }

    /// One shape.
    ///
    /// # Errors
    /// There is no such collection or shape.
    pub fn shape(&self, collection: &str, shape: &str) -> Result<ShapeInfo> {
        shape_info(self.shape_row(collection, shape)?.1)
    }

    /// The newest labels of a shape, or those of `version`.
    ///
    /// # Errors
    /// There is no such shape, or the version is not (or no longer) kept.
    pub fn labels(&self, collection: &str, shape: &str, version: Option<u64>) -> Result<Labels> {
        let row = self.shape_row(collection, shape)?.1;
        let found = self.store.catalog().read(|r| -> Result<_> {
            Ok(match version {
                Some(v) => r.labels_at(row.id, v)?,
                None => r.newest_labels(row.id)?,
            })
        })?;
        let name = || format!("{} of shape {shape:?}", version.unwrap_or(row.version));
        found
            .map(labels)
            .ok_or_else(|| LibraryError::not_found("version", name()))
    }

    /// The bytes of a shape as they were sent, and their format.
    ///
    /// # Errors
    /// There is no such shape, or its file is damaged.
    pub fn original(&self, collection: &str, shape: &str) -> Result<(Vec<u8>, Format)> {
        let row = self.shape_row(collection, shape)?.1;
        let format = format_from_name(&row.format, "shapes.format")?;
        Ok((self.original_bytes(&row.content_digest)?, format))
    }

    /// Bytes of the file of a shape, for whoever plans its memory.
    ///
    /// # Errors
    /// There is no such shape, or the catalog cannot be read.
    pub fn original_length(&self, collection: &str, shape: &str) -> Result<u64> {
        self.object_length(&self.shape_row(collection, shape)?.1.content_digest)
    }

    /// Eigenvalues, eigenvectors, HKS, descriptors of a shape: mapped, not copied.
    ///
    /// # Errors
    /// There is no such shape, or its file is damaged.
    pub fn description(&self, collection: &str, shape: &str) -> Result<MappedDescription> {
        let (_, row) = self.shape_row(collection, shape)?;
        Ok(self.known(row.id)?.mapped)
    }

    /// What [`Library::description`] gives, with the newest label of each proxy face (-1: unlabelled) and their
    /// version, as of one moment.
    ///
    /// # Errors
    /// There is no such shape, or its file is damaged.
    pub fn labelled_proxy(
        &self,
        collection: &str,
        shape: &str,
    ) -> Result<(MappedDescription, Vec<i32>, u64)> {
        let (_, row) = self.shape_row(collection, shape)?;
        let known = self.known(row.id)?;
        Ok((
            known.mapped,
            known.labels.proxy_labels,
            known.labels.version,
        ))
    }

    /// The functional map that carries functions on `from` to `to`: a kept one, or else computed now.
    ///
    /// # Errors
    /// There is no such shape, or the collection has no label model yet.
    pub fn map(&self, collection: &str, from: &str, to: &str) -> Result<MapInfo> {
        if let Some(kept) = self.kept_map(collection, from, to)? {
            return Ok(kept);
        }
        let (_, a) = self.shape_row(collection, from)?;
        let (row, b) = self.shape_row(collection, to)?;
        let model = self.with_lane(row, |lane| {
            Ok(lane.learnt.as_ref().map(|l| l.model.clone()))
        })?;
        let model = model.ok_or_else(|| damaged("collections", "shapes without a label model"))?;
        let (a, b) = (self.known(a.id)?, self.known(b.id)?);
        let (one, two) = (a.mapped.view(), b.mapped.view());
        let prepared = [Prepared::new(&one, &model), Prepared::new(&two, &model)];
        let found = map(
            (&one, &prepared[0]),
            (&two, &prepared[1]),
            &MapOptions::default(),
        );
        let (k1, k2) = (found.k1, found.k2);
        Ok(MapInfo {
            c_12: found.c_12,
            k2,
            k1,
            p2p_21: found.p2p_21,
            confidence: found.confidence,
            quality: found.quality,
        })
    }

    /// What [`Library::map`] gives if it is kept: nothing is computed.
    ///
    /// # Errors
    /// There is no such shape, or the map is damaged.
    pub fn kept_map(&self, collection: &str, from: &str, to: &str) -> Result<Option<MapInfo>> {
        let (_, a) = self.shape_row(collection, from)?;
        let (_, b) = self.shape_row(collection, to)?;
        let kept = self
            .store
            .catalog()
            .read(|r| r.map(a.id, b.id).map_err(LibraryError::from))?;
        let Some(m) = kept else { return Ok(None) };
        let quality = quality_from_json(&m.quality_json, &format!("maps {from} {to}"))?;
        let confidence = confidence_of_row(&m)?;
        let (k1, k2) = (m.k1 as usize, m.k2 as usize);
        Ok(Some(MapInfo {
            c_12: m.c_12,
            k2,
            k1,
            p2p_21: m.p2p_21,
            confidence,
            quality,
        }))
    }

    /// Vertices of a shape's proxy.
    ///
    /// # Errors
    /// There is no such shape, or its description is damaged.
    pub fn n_proxy_vertices(&self, collection: &str, shape: &str) -> Result<usize> {
        let (_, row) = self.shape_row(collection, shape)?;
        Ok(self.known(row.id)?.mapped.view().vertices.len())
    }

    /// Which part of A matches which part of B under the map from A to B, by descending overlap, and how good the
    /// map is. Parts are numbered as in [`ShapeInfo::parts`].
    ///
    /// # Errors
    /// As [`Library::map`].
    pub fn part_correspondence(
        &self,
        collection: &str,
        a: &str,
        b: &str,
    ) -> Result<(Vec<PartMatch>, Quality)> {
        let map = self.map(collection, a, b)?;
        let side = |name: &str| -> Result<_> {
            let known = self.known(self.shape_row(collection, name)?.1.id)?;
            let view = known.mapped.view();
            let surface = Surface::new(&view.mesh());
            let pieces = parts(&surface, &face_ids(&known.labels.proxy_labels));
            let n = view.vertices.len();
            let of_vertex = part_of_vertex(&pieces, n, view.faces, &surface.area);
            Ok((pieces.label, of_vertex, view.mass.to_vec()))
        };
        let (label_a, part_a, _) = side(a)?;
        let (label_b, part_b, mass_b) = side(b)?;
        let matches = overlaps(&part_a, &part_b, &map.p2p_21, &mass_b)
            .into_iter()
            .map(|(part_a, part_b, overlap)| PartMatch {
                part_a,
                part_b,
                label_a: label_a[part_a as usize],
                label_b: label_b[part_b as usize],
                overlap,
            })
            .collect();
        Ok((matches, map.quality))
    }

    /// The `limit` shapes nearest to a shape by global descriptor, with their distances, nearest first.
    ///
    /// # Errors
    /// There is no such collection or shape.
    pub fn nearest(
        &self,
        collection: &str,
        shape: &str,
        limit: usize,
    ) -> Result<Vec<(String, f64)>> {
        let (row, shape) = self.shape_row(collection, shape)?;
        let known = self.known(shape.id)?;
        let view = known.mapped.view();
        let ranked = self.with_lane(row, |lane| {
            let wanted = limit.saturating_add(1);
            let found = lane.nearest(view.signature, view.n_descriptors, wanted);
            Ok(found
                .into_iter()
                .map(|(at, d)| (lane.shapes[at].id, d))
                .collect::<Vec<_>>())
        })?;
        self.store.catalog().read(|r| {
            let others = ranked.iter().filter(|(id, _)| *id != shape.id).take(limit);
            let mut out = Vec::new();
            for (id, distance) in others {
                if let Some(other) = r.shape(*id)? {
                    out.push((other.name, *distance));
                }
            }
            Ok(out)
        })
    }

    /// Labels of every shape and the collection's sequence, as of one moment.
    ///
    /// # Errors
    /// There is no such collection.
    pub fn labels_snapshot(&self, collection: &str) -> Result<(u64, Vec<(String, Labels)>)> {
        self.store.catalog().read(|r| {
            let row = require_collection(r, collection)?;
            let mut out = Vec::new();
            for shape in r.shapes(row.id, 0, usize::MAX, None)? {
                if let Some(found) = r.newest_labels(shape.id)? {
                    out.push((shape.name, labels(found)));
                }
            }
            Ok((row.sequence, out))
        })
    }

    /// Events of a collection after `sequence`, oldest first, at most `limit`.
    ///
    /// # Errors
    /// The catalog cannot be read. A name that never was a collection has no events.
    pub fn events_since(
        &self,
        collection: &str,
        sequence: u64,
        limit: usize,
    ) -> Result<Vec<Event>> {
        self.store.catalog().read(|r| {
            let rows = r.events_since(collection, sequence, limit)?;
            rows.into_iter()
                .map(|e| {
                    let place = format!("events {collection}, {}", e.sequence);
                    let kind: EventKind = from_json(&e.payload_json, &place)?;
                    Ok(Event {
                        sequence: e.sequence,
                        kind,
                    })
                })
                .collect()
        })
    }

    /// Counters for the operator.
    ///
    /// # Errors
    /// The catalog cannot be read.
    pub fn stats(&self) -> Result<LibraryStats> {
        let totals = self
            .store
            .catalog()
            .read(|r| r.totals().map_err(LibraryError::from))?;
        Ok(LibraryStats {
            n_collections: totals.n_collections,
            n_shapes: totals.n_shapes,
            n_queued: totals.n_queued,
            n_stale: totals.n_stale,
            stored_bytes: totals.object_bytes,
            catalog_bytes: totals.catalog_bytes,
            max_relabelled: self.max_relabelled.load(Ordering::Relaxed),
            max_maps: self.max_maps.load(Ordering::Relaxed),
        })
    }

    /// Removes a shape with its labels and maps; what it taught the label model is taken back. Labels of other
    /// shapes stay as they are.
    ///
    /// # Errors
    /// There is no such shape.
    pub fn remove(&self, collection: &str, shape: &str, key: Option<&RequestKey>) -> Result<()> {
        self.store
            .freeing(|| self.remove_once(collection, shape, key))
    }

    fn remove_once(&self, collection: &str, shape: &str, key: Option<&RequestKey>) -> Result<()> {
        let request = Digest::of(format!("remove {collection:?} {shape:?}").as_bytes());
        let row = self.collection_row(collection)?;
        self.with_lane(row, |lane| {
            if let Some(key) = key {
                let answered = self.store.catalog().read(|r| -> Result<_> {
                    Ok(r.request(&key.client_id, &key.request_id)?.is_some())
                })?;
                if answered {
                    self.once(Some(key), request, |_| Ok(Vec::new()))?;
                    return Ok(());
                }
            }
            let (_, gone) = self.shape_row(collection, shape)?;
            let before = self.vocabulary(lane, None)?;
            let was_pinned = self.forget(lane, &gone)?;
            let after = self.vocabulary(lane, None)?;
            let again = match &lane.state.teaching {
                Some(teaching) if was_pinned => self.relearnt(lane, teaching)?,
                _ => None,
            };
            let retired = before.labels.difference(&after.labels);
            let retired: Vec<LabelId> = retired
                .copied()
                .filter(|_| again.as_ref().is_some_and(|t| t.closed))
                .collect();
            let teach_again = again.is_some();
            if teach_again {
                lane.state.teaching = again;
            }
            let blob = lane.learnt.as_ref().map(super::learnt::Learnt::encode);
            let id = lane.row.id;
            self.once(key, request, |tx| {
                tx.delete_shape(gone.id)?;
                super::commit::event(
                    tx,
                    id,
                    &EventKind::ShapeRemoved {
                        shape: shape.into(),
                    },
                )?;
                for label in &retired {
                    super::commit::event(tx, id, &EventKind::LabelRetired { label: *label })?;
                }
                if teach_again {
                    tx.mark_all_stale(id)?;
                }
                if let Some(blob) = &blob {
                    tx.set_model(id, blob)?;
                }
                tx.set_state(id, to_json(&lane.state).as_bytes())?;
                Ok(Vec::new())
            })?;
            if teach_again {
                self.reload(lane)?;
            }
            lane.row = self.collection_row(collection)?;
            Ok(())
        })
    }

    /// Recomputes the labels of one stale shape of the collection, or of any if `None`; false: none was stale.
    ///
    /// # Errors
    /// There is no such collection, or the store fails.
    pub fn relabel_next(&self, collection: Option<&str>) -> Result<bool> {
        let wanted = collection
            .map(|name| self.collection_row(name))
            .transpose()?;
        let next = self.store.catalog().read(|r| -> Result<_> {
            let Some(shape) = r.next_stale(wanted.map(|c| c.id))? else {
                return Ok(None);
            };
            Ok(r.collection_by_id(shape.collection)?
                .map(|row| (row, shape.id)))
        })?;
        let Some((row, id)) = next else {
            return Ok(false);
        };
        self.with_lane(row, |lane| {
            let at = lane.shapes.iter().position(|s| s.id == id);
            at.map_or(Ok(false), |at| self.relabel(lane, at))
        })
    }

    pub(super) fn shape_row(
        &self,
        collection: &str,
        shape: &str,
    ) -> Result<(CollectionRow, ShapeRow)> {
        self.store.catalog().read(|r| {
            let row = require_collection(r, collection)?;
            let found = r.shape_by_name(row.id, shape)?;
            match found {
                Some(found) => Ok((row, found)),
                None => {
                    let known = r.shape_names(row.id, MAX_COMPARED)?;
                    Err(LibraryError::none_of("shape", shape, &known))
                }
            }
        })
    }
}

/// The collection of that name; if there is none, the error says which may have been meant.
pub(super) fn require_collection(reader: &Reader<'_>, name: &str) -> Result<CollectionRow> {
    if let Some(row) = reader.collection(name)? {
        return Ok(row);
    }
    let known = reader.collection_names(MAX_COMPARED)?;
    Err(LibraryError::none_of("collection", name, &known))
}

fn labels(row: LabelVersionRow) -> Labels {
    Labels {
        version: row.version,
        labels: row.polygon_labels,
        confidence: row
            .polygon_confidence
            .into_iter()
            .map(confidence_from_u8)
            .collect(),
    }
}

fn shape_info(row: ShapeRow) -> Result<ShapeInfo> {
    let place = format!("shapes {}", row.name);
    Ok(ShapeInfo {
        ordinal: row.ordinal,
        version: row.version,
        stale: row.stale,
        n_polygons: row.n_polygons,
        area: row.area,
        content_digest: row.content_digest.to_string(),
        report: report_from_json(&row.report_json, &place)?,
        parts: from_json(&row.parts_json, &place)?,
        sources: from_json(&row.sources_json, &place)?,
        stored_bytes: row.stored_bytes,
        name: row.name,
    })
}
