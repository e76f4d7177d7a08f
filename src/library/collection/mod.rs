//! One collection in memory: the aggregate that decides, without touching the catalog, which labels
//! follow from the stored data.
//!
//! [`discovered`] and [`supervised`] compute changes from a `&Collection` and its [`Sources`];
//! [`super::change::commit`] writes them, and the collection then applies them. Nothing else
//! changes a collection: its fields are private, and [`Collection::apply`] and
//! [`Collection::set_aside`] are the only methods with `&mut self`.

pub(super) mod chosen;
pub(super) mod discovered;
pub(super) mod fit;
mod kept;
mod model_state;
pub(super) mod state;
mod stored;
pub(super) mod supervised;
pub(super) mod up;

pub(super) use model_state::ModelState;
pub(super) use state::{Propagation, Regime, State};
pub(super) use stored::StoredState;

use super::error::Result;
use super::rows::damaged;
use super::types::Up;
use crate::labels::LabelModel;
use crate::neighbors::SignatureMetric;
use crate::store::{CollectionId, CollectionRow, Digest, Reader, ShapeId};
use std::collections::BTreeSet;

/// A stored shape, with the fields that placing others needs without opening its file.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct KnownShape {
    pub(super) id: ShapeId,
    pub(super) ordinal: u64,
    /// Digest of the original bytes.
    pub(super) digest: Digest,
    pub(super) stale: bool,
    /// Whether a person labelled faces of it.
    pub(super) pinned: bool,
    pub(super) signature: Vec<f32>,
}

/// One collection, which is read from the catalog when it is first needed, and is equal to it after
/// every commit.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Collection {
    row: CollectionRow,
    state: State,
    model: Option<ModelState>,
    /// By ordinal.
    shapes: Vec<KnownShape>,
}

/// Which shapes are stale after a change, except for those that it names.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) enum Staleness {
    /// Shapes with new labels are not stale; the others stay as they are.
    #[default]
    AsLabelled,
    /// All shapes are stale except those with new labels.
    AllOthers,
    /// Every shape stays as it is, because labels are only renamed.
    Unchanged,
    /// All shapes are stale.
    All,
}

/// The effect of a durable change on the collection in memory.
#[derive(Debug)]
pub(super) struct Applied {
    /// The new row.
    pub(super) row: CollectionRow,
    /// The state in that row; `None` if it did not change.
    pub(super) state: Option<State>,
    /// The new model; `None` if it did not change.
    pub(super) model: Option<ModelState>,
    pub(super) removed: Option<ShapeId>,
    pub(super) added: Option<KnownShape>,
    /// Shapes whose pins changed, and whether they still have any.
    pub(super) pinned: Vec<(ShapeId, bool)>,
    /// Stored shapes with new labels.
    pub(super) labelled: Vec<ShapeId>,
    pub(super) staleness: Staleness,
    /// Shapes that are stale, or not, in spite of `staleness`.
    pub(super) stale: Vec<(ShapeId, bool)>,
}

impl Collection {
    /// Loads a collection from the catalog.
    pub(super) fn load(reader: &Reader<'_>, row: CollectionRow) -> Result<Self> {
        let location = format!("collections {}", row.name);
        let state = State::of(&row)?;
        let model = match reader.model(row.id)? {
            Some(bytes) => Some(ModelState::decode(&bytes).map_err(|e| damaged(&location, &e))?),
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
                .ok_or_else(|| damaged(&location, &format!("{} has no signature", s.name)))?;
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
            model,
            shapes,
        })
    }

    /// Makes a collection of values that were published.
    pub(super) fn published(
        row: CollectionRow,
        model: ModelState,
        shapes: Vec<KnownShape>,
    ) -> Result<Self> {
        Ok(Self {
            state: State::of(&row)?,
            row,
            model: Some(model),
            shapes,
        })
    }

    pub(super) fn id(&self) -> CollectionId {
        self.row.id
    }

    pub(super) fn row(&self) -> &CollectionRow {
        &self.row
    }

    pub(super) fn state(&self) -> &State {
        &self.state
    }

    pub(super) fn model(&self) -> Option<&ModelState> {
        self.model.as_ref()
    }

    /// Returns the label model with all shapes added so far.
    pub(super) fn label_model(&self) -> Option<&LabelModel> {
        self.model.as_ref().map(|m| &m.model)
    }

    /// Returns the stored shapes by ordinal. Other functions refer to them by index.
    pub(super) fn shapes(&self) -> &[KnownShape] {
        &self.shapes
    }

    /// Returns the index of a shape.
    pub(super) fn position(&self, id: ShapeId) -> Option<usize> {
        self.shapes.iter().position(|s| s.id == id)
    }

    /// Returns the up axis as it was set.
    pub(super) fn up(&self) -> Up {
        self.row.up.parse().unwrap_or_default()
    }

    /// Returns the indices of the shapes nearest to a signature, nearest first.
    pub(super) fn nearest(
        &self,
        signature: &[f32],
        n_descriptors: usize,
        limit: usize,
    ) -> Vec<(usize, f64)> {
        let all: Vec<usize> = (0..self.shapes.len()).collect();
        self.nearest_among(&all, signature, n_descriptors, limit)
    }

    /// Returns those of the shapes `among` that are nearest to a signature, nearest first.
    pub(super) fn nearest_among(
        &self,
        among: &[usize],
        signature: &[f32],
        n_descriptors: usize,
        limit: usize,
    ) -> Vec<(usize, f64)> {
        let Some(model) = self.label_model() else {
            return Vec::new();
        };
        let metric = SignatureMetric::new(&model.normalisation, n_descriptors);
        let signatures = among.iter().map(|at| self.shapes[*at].signature.as_slice());
        let found = metric.nearest(signature, signatures, limit).into_iter();
        found.map(|(i, distance)| (among[i], distance)).collect()
    }

    /// Returns the shapes to be clustered together, at most `limit`: those of the least digests, in
    /// this order. This is a random choice that does not depend on the order of arrival and changes
    /// little as the collection grows.
    pub(super) fn representatives(&self, limit: usize) -> Vec<usize> {
        let mut all: Vec<usize> = (0..self.shapes.len()).collect();
        all.sort_by_key(|&at| (self.shapes[at].digest, self.shapes[at].ordinal));
        all.truncate(limit);
        all
    }

    /// Returns shapes that are `wanted`, in the order of their digests: those with an id in
    /// `first`, and those of the least digests until there are `limit`.
    pub(super) fn representatives_with(
        &self,
        first: &BTreeSet<ShapeId>,
        limit: usize,
        wanted: &dyn Fn(&KnownShape) -> bool,
    ) -> Vec<usize> {
        let mut all = self.representatives(self.shapes.len());
        all.retain(|at| wanted(&self.shapes[*at]));
        let is_first = |at: &usize| first.contains(&self.shapes[*at].id);
        let n_first = all.iter().filter(|at| is_first(at)).count();
        let mut n_others = limit.saturating_sub(n_first);
        all.retain(|at| {
            let is_other = !is_first(at);
            let is_chosen = !is_other || n_others > 0;
            n_others -= usize::from(is_chosen && is_other);
            is_chosen
        });
        all
    }

    /// Removes a shape that is about to be replaced, so that it neither votes nor trains, and sets
    /// the model without the shape. The commit of the new shape removes the old one from the
    /// catalog; if that fails, the collection is reloaded.
    pub(super) fn set_aside(&mut self, id: ShapeId, model: Option<ModelState>) {
        self.shapes.retain(|s| s.id != id);
        if model.is_some() {
            self.model = model;
        }
    }

    /// Applies a change that was committed.
    pub(super) fn apply(&mut self, change: Applied) {
        self.row = change.row;
        if let Some(state) = change.state {
            self.state = state;
        }
        if change.model.is_some() {
            self.model = change.model;
        }
        self.shapes.retain(|s| Some(s.id) != change.removed);
        for shape in &mut self.shapes {
            let is_labelled = change.labelled.contains(&shape.id);
            shape.stale = match change.staleness {
                Staleness::AsLabelled => shape.stale && !is_labelled,
                Staleness::AllOthers => !is_labelled,
                Staleness::Unchanged => shape.stale,
                Staleness::All => true,
            };
        }
        if let Some(mut added) = change.added {
            added.stale = change.staleness == Staleness::All;
            self.shapes.push(added);
        }
        for (id, is_pinned) in change.pinned {
            if let Some(shape) = self.shapes.iter_mut().find(|s| s.id == id) {
                shape.pinned = is_pinned;
            }
        }
        for (id, is_stale) in change.stale {
            if let Some(shape) = self.shapes.iter_mut().find(|s| s.id == id) {
                shape.stale = is_stale;
            }
        }
    }
}

#[cfg(test)]
mod tests;
