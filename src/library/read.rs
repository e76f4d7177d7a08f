//! Reads shapes, labels, arrays, maps and events from the store. Nothing here writes.

use super::error::{LibraryError, Named, Result};
use super::event::{Event, EventKind};
use super::facade::Library;
use super::labelling::face_ids;
use super::lookup::{object_length, require_collection};
use super::review_rows::review_of_row;
use super::rows::{
    confidence_of_row, damaged, format_from_name, from_json, quality_from_json, report_from_json,
};
use super::sources::{Sources, mapped_shape};
use super::types::{LabelId, Labels, LibraryStats, MapInfo, PartMatch, ShapeInfo};
use super::verdict::{Review, ReviewState};
use super::voting::PreparedShape;
use crate::correspondence::{overlaps, part_of_vertex, parts};
use crate::fmap::Quality;
use crate::mesh::Format;
use crate::segmentation::Surface;
use crate::store::catalog::ReviewedAs;
use crate::store::rows::confidence_from_u8;
use crate::store::{LabelVersionRow, MappedDescription, ShapeRow};
use std::sync::atomic::Ordering;

impl Library {
    /// Returns shapes by ordinal, after `after_ordinal`, at most `limit`; with `label`, only those
    /// that have it.
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
        self.shapes_reviewed(collection, (after_ordinal, limit), label, None)
    }

    /// Does what [`Library::shapes`] does; with `review`, returns only shapes with this verdict.
    ///
    /// # Errors
    /// There is no such collection.
    pub fn shapes_reviewed(
        &self,
        collection: &str,
        (after_ordinal, limit): (u64, usize),
        label: Option<LabelId>,
        review: Option<ReviewState>,
    ) -> Result<Vec<ShapeInfo>> {
        let id = self.collection_row(collection)?.id;
        self.store.catalog().read(|r| {
            let rows = match review {
                None => r.shapes(id, after_ordinal, limit, label)?,
                Some(state) => {
                    let states = ReviewedAs {
                        wanted: state.name(),
                        pinned: ReviewState::Corrected.name(),
                        unseen: ReviewState::Unseen.name(),
                    };
                    r.reviewed_shapes(id, (after_ordinal, limit), label, &states)?
                }
            };
            let mut reviews = r.reviews(id)?;
            let pinned = r.pinned_shapes(id)?;
            let info = |row: ShapeRow| {
                let is_pinned = pinned.binary_search(&row.id).is_ok();
                let review = review_of_row(reviews.remove(&row.id), is_pinned)?;
                shape_info(row, review)
            };
            rows.into_iter().map(info).collect()
        })
    }

    /// Returns one shape.
    ///
    /// # Errors
    /// There is no such collection or shape.
    pub fn shape(&self, collection: &str, shape: &str) -> Result<ShapeInfo> {
        let row = self.shape_row(collection, shape)?.1;
        self.store.catalog().read(|r| {
            let is_pinned = r.pins(row.id)?.is_some();
            let review = review_of_row(r.review(row.id)?, is_pinned)?;
            shape_info(row, review)
        })
    }

    /// Returns the newest labels of a shape, or those of `version`.
    ///
    /// # Errors
    /// There is no such shape, or the version is not (or no longer) stored.
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
            .ok_or_else(|| LibraryError::not_found(Named::Version, name()))
    }

    /// Returns the bytes of a shape as they were sent, and their format.
    ///
    /// # Errors
    /// There is no such shape, or its file is damaged.
    pub fn original(&self, collection: &str, shape: &str) -> Result<(Vec<u8>, Format)> {
        let row = self.shape_row(collection, shape)?.1;
        let format = format_from_name(&row.format, "shapes.format")?;
        Ok((self.store.original(&row.content_digest)?, format))
    }

    /// Returns the number of bytes of the file of a shape, from which its memory can be planned.
    ///
    /// # Errors
    /// There is no such shape, or the catalog cannot be read.
    pub fn original_length(&self, collection: &str, shape: &str) -> Result<u64> {
        let (_, row) = self.shape_row(collection, shape)?;
        object_length(&self.store, &row.content_digest)
    }

    /// Maps the eigenvalues, eigenvectors, HKS and descriptors of a shape into memory, without a
    /// copy.
    ///
    /// # Errors
    /// There is no such shape, or its file is damaged.
    pub fn description(&self, collection: &str, shape: &str) -> Result<MappedDescription> {
        let (_, row) = self.shape_row(collection, shape)?;
        Ok(mapped_shape(&self.store, row.id)?.1)
    }

    /// Returns the arrays of [`Library::description`], with the newest label of each proxy face
    /// (-1: unlabelled) and their version, as of one moment.
    ///
    /// # Errors
    /// There is no such shape, or its file is damaged.
    pub fn labelled_proxy(
        &self,
        collection: &str,
        shape: &str,
    ) -> Result<(MappedDescription, Vec<i32>, u64)> {
        let (_, row) = self.shape_row(collection, shape)?;
        let (_, mapped, labels) = mapped_shape(&self.store, row.id)?;
        Ok((mapped, labels.proxy_labels, labels.version))
    }

    /// Returns the functional map that carries functions on `from` to `to`. Computes it if it is
    /// not stored.
    ///
    /// # Errors
    /// There is no such shape, or the collection has no label model yet.
    pub fn map(&self, collection: &str, from: &str, to: &str) -> Result<MapInfo> {
        if let Some(kept) = self.stored_map(collection, from, to)? {
            return Ok(kept);
        }
        let (_, a) = self.shape_row(collection, from)?;
        let (row, b) = self.shape_row(collection, to)?;
        let model = self.with_collection(row, |c| Ok(c.label_model().cloned()))?;
        let model = model.ok_or_else(|| damaged("collections", "shapes without a label model"))?;
        let (a, b) = (self.store.known(a.id)?, self.store.known(b.id)?);
        let shapes = [a.file(), b.file()].map(|file| PreparedShape::new(&self.store, file, &model));
        let found = shapes[0].map_to(&shapes[1]);
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

    /// Returns the map that [`Library::map`] returns, if it is stored. Computes nothing.
    ///
    /// # Errors
    /// There is no such shape, or the map is damaged.
    pub fn stored_map(&self, collection: &str, from: &str, to: &str) -> Result<Option<MapInfo>> {
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

    /// Returns the number of vertices of a shape's proxy.
    ///
    /// # Errors
    /// There is no such shape, or its description is damaged.
    pub fn n_proxy_vertices(&self, collection: &str, shape: &str) -> Result<usize> {
        let (_, row) = self.shape_row(collection, shape)?;
        Ok(self.store.known(row.id)?.view().vertices.len())
    }

    /// Returns which part of A matches which part of B under the map from A to B, by descending
    /// overlap, and the quality of the map. Parts are numbered as in [`ShapeInfo::parts`].
    ///
    /// # Errors
    /// Those of [`Library::map`].
    pub fn part_correspondence(
        &self,
        collection: &str,
        a: &str,
        b: &str,
    ) -> Result<(Vec<PartMatch>, Quality)> {
        let map = self.map(collection, a, b)?;
        let side = |name: &str| -> Result<_> {
            let known = self.store.known(self.shape_row(collection, name)?.1.id)?;
            let view = known.view();
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

    /// Returns the `limit` shapes nearest to a shape by global descriptor, with their distances,
    /// nearest first.
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
        let known = self.store.known(shape.id)?;
        let view = known.view();
        let ranked = self.with_collection(row, |collection| {
            let wanted = limit.saturating_add(1);
            let found = collection.nearest(view.signature, view.n_descriptors, wanted);
            Ok(found
                .into_iter()
                .map(|(at, d)| (collection.shapes()[at].id, d))
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

    /// Returns the labels of every shape and the collection's sequence number, as of one moment.
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

    /// Returns events of a collection after `sequence`, oldest first, at most `limit`.
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
                    let location = format!("events {collection}, {}", e.sequence);
                    let kind: EventKind = from_json(&e.payload_json, &location)?;
                    Ok(Event {
                        sequence: e.sequence,
                        kind,
                    })
                })
                .collect()
        })
    }

    /// Returns counters for the operator.
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

fn shape_info(row: ShapeRow, review: Review) -> Result<ShapeInfo> {
    let location = format!("shapes {}", row.name);
    Ok(ShapeInfo {
        ordinal: row.ordinal,
        version: row.version,
        stale: row.stale,
        n_polygons: row.n_polygons,
        area: row.area,
        content_digest: row.content_digest.to_string(),
        report: report_from_json(&row.report_json, &location)?,
        parts: from_json(&row.parts_json, &location)?,
        sources: from_json(&row.sources_json, &location)?,
        stored_bytes: row.stored_bytes,
        review,
        name: row.name,
    })
}
