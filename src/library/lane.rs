//! The serial state of one collection while shapes are placed into it.

use super::learnt::Learnt;
use super::rows::{CollectionState, damaged};
use super::{Result, Up};
use crate::neighbors::SignatureMetric;
use crate::store::{CollectionRow, Digest, Reader, ShapeId};

/// A stored shape, as far as placing others needs it without opening its file.
#[derive(Debug, Clone)]
pub(super) struct KnownShape {
    pub(super) id: ShapeId,
    pub(super) ordinal: u64,
    /// Of the original bytes.
    pub(super) digest: Digest,
    pub(super) stale: bool,
    /// Whether a person labelled faces of it.
    pub(super) pinned: bool,
    pub(super) signature: Vec<f32>,
}

/// One collection, read from the catalog when it is first needed and kept in step with every commit.
#[derive(Debug)]
pub(super) struct Lane {
    pub(super) row: CollectionRow,
    pub(super) state: CollectionState,
    pub(super) learnt: Option<Learnt>,
    /// By ordinal.
    pub(super) shapes: Vec<KnownShape>,
}

impl Lane {
    /// The lane of a collection, as the catalog has it.
    pub(super) fn load(reader: &Reader<'_>, row: CollectionRow) -> Result<Self> {
        let place = format!("collections {}", row.name);
        let state = CollectionState::of(&row)?;
        let learnt = match reader.model(row.id)? {
            Some(bytes) => Some(Learnt::decode(&bytes).map_err(|e| damaged(&place, &e))?),
            None => None,
        };
        let mut signatures = std::collections::HashMap::new();
        reader.each_signature(row.id, |id, signature| {
            signatures.insert(id, signature.to_vec());
        })?;
        let pinned = reader.pinned_shapes(row.id)?;
        let mut shapes = Vec::new();
        for s in reader.shapes(row.id, 0, usize::MAX, None)? {
            let signature = signatures.remove(&s.id);
            let signature = signature
                .ok_or_else(|| damaged(&place, &format!("{} has no signature", s.name)))?;
            shapes.push(KnownShape {
                id: s.id,
                ordinal: s.ordinal,
                digest: s.content_digest,
                stale: s.stale,
                pinned: pinned.binary_search(&s.id).is_ok(),
                signature,
            });
        }
        Ok(Self {
            row,
            state,
            learnt,
            shapes,
        })
    }

    /// Which way is up, as the collection was created.
    pub(super) fn up(&self) -> Up {
        self.row.up.parse().unwrap_or_default()
    }

    /// Whether a shape's labels are part of the model of this epoch.
    pub(super) fn informs(&self, shape: &KnownShape) -> bool {
        let is_newer = shape.ordinal > self.state.epoch_ordinal;
        let counts = is_newer && !self.state.silent.contains(&shape.ordinal)
            || self.state.representatives.contains(&shape.ordinal);
        counts && self.state.teaching.is_none()
    }

    /// Indices of the shapes nearest to a signature, nearest first.
    pub(super) fn nearest(
        &self,
        signature: &[f32],
        n_descriptors: usize,
        limit: usize,
    ) -> Vec<(usize, f64)> {
        let all: Vec<usize> = (0..self.shapes.len()).collect();
        self.nearest_among(&all, signature, n_descriptors, limit)
    }

    /// Those of the shapes `among` that are nearest to a signature, nearest first.
    pub(super) fn nearest_among(
        &self,
        among: &[usize],
        signature: &[f32],
        n_descriptors: usize,
        limit: usize,
    ) -> Vec<(usize, f64)> {
        let Some(learnt) = &self.learnt else {
            return Vec::new();
        };
        let metric = SignatureMetric::new(&learnt.model.normalisation, n_descriptors);
        let signatures = among.iter().map(|at| self.shapes[*at].signature.as_slice());
        let found = metric.nearest(signature, signatures, limit).into_iter();
        found.map(|(i, distance)| (among[i], distance)).collect()
    }

    /// Shapes to be clustered together, at most `limit`: those of the least digests, which are a random choice that does not
    /// depend on the order of arrival and changes little as the collection grows; by their digests.
    pub(super) fn representatives(&self, limit: usize) -> Vec<usize> {
        let mut all: Vec<usize> = (0..self.shapes.len()).collect();
        all.sort_by_key(|&at| (self.shapes[at].digest, self.shapes[at].ordinal));
        all.truncate(limit);
        all
    }
}
