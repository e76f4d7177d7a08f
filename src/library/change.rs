//! Changes a collection; there is no other way. A [`Change`] is everything that becomes true
//! together. [`commit`] writes it in one transaction, together with the data that undoing it needs,
//! and then applies it to the collection in memory.

mod edits;
mod links;
mod log;
mod undoable;

pub(super) use edits::LabelEdit;
pub(super) use links::LinkEdit;
pub(super) use log::event;
pub(super) use undoable::Undoable;

use super::before::Before;
use super::collection::{
    Applied, Collection, KnownShape, ModelState, Propagation, Staleness, State,
};
use super::error::{LibraryError, Result};
use super::event::EventKind;
use super::labelling::{NewLabels, Relabelled, cause};
use super::once::{Request, once, unix_secs};
use super::reason::Reason;
use super::rows::{damaged, quality_to_json};
use crate::fmap::FunctionalMap;
use crate::store::{
    CollectionId, CollectionRow, ItemStatus, JobItemRow, MapRow, NewShapeRow, ObjectRow, ReviewRow,
    ShapeId, Store, Tx,
};
use std::collections::BTreeSet;

/// Everything that becomes true together. Fields are written, and their events logged, in this
/// order.
#[derive(Debug, Default)]
pub(super) struct Change {
    /// The queued item that the change settles. If it is no longer queued, nothing changes.
    pub(super) accepted: Option<JobItemRow>,
    /// The change by a person that this is, if it can be undone.
    pub(super) undoable: Option<Undoable>,
    /// A shape that is removed, and its name.
    pub(super) removed: Option<(ShapeId, String)>,
    /// The new up axis.
    pub(super) up: Option<String>,
    /// The event before those of labels.
    pub(super) opening: Option<EventKind>,
    /// Edits of links between parts.
    pub(super) links: Vec<LinkEdit>,
    /// Edits of labels of the collection.
    pub(super) labels: Vec<LabelEdit>,
    /// New pins of shapes; `None`: no face is pinned.
    pub(super) pins: Vec<(ShapeId, Option<Vec<i32>>)>,
    /// New verdicts on shapes; `None`: no verdict.
    pub(super) reviews: Vec<(ShapeId, Option<ReviewRow>)>,
    /// A shape that is added.
    pub(super) added: Option<Box<Addition>>,
    /// Maps between stored shapes.
    pub(super) maps: Vec<MapRow>,
    /// The event between those of labels and those of stored shapes.
    pub(super) closing: Option<EventKind>,
    /// Stored shapes with new labels.
    pub(super) relabelled: Vec<Relabelled>,
    /// Which shapes are stale afterwards.
    pub(super) staleness: Staleness,
    /// Shapes that are stale, or not, in spite of `staleness`.
    pub(super) stale: Vec<(ShapeId, bool)>,
    /// The new model.
    pub(super) model: Option<ModelState>,
    /// The new state.
    pub(super) state: Option<State>,
    /// Whether a job propagates the change to the stale shapes.
    pub(super) propagates: bool,
    /// The change by a person that this one undoes.
    pub(super) undone: Option<i64>,
}

/// A new shape with everything that is stored about it.
#[derive(Debug)]
pub(super) struct Addition {
    object: ObjectRow,
    shape: NewShapeRow,
    /// Its labels, with their version.
    labels: NewLabels,
    /// Maps from stored shapes to it.
    maps: Vec<(ShapeId, FunctionalMap)>,
}

/// A change that is written but not committed yet.
#[derive(Debug)]
pub(super) struct Written {
    /// The collection's new row.
    pub(super) row: CollectionRow,
    /// The job that propagates it; 0 without one.
    pub(super) job: u64,
    /// The new shape.
    added: Option<ShapeId>,
    /// The new state in `row`; `None` if it did not change.
    state: Option<State>,
}

impl Change {
    /// Adds the labels, maps and staleness of another relabelling to those of this one.
    pub(super) fn join(&mut self, other: Change) {
        self.maps.extend(other.maps);
        self.relabelled.extend(other.relabelled);
        self.stale.extend(other.stale);
    }
}

/// Writes a change in one transaction together with the rows that `finish` writes, and then applies
/// it to the collection.
///
/// # Errors
/// The store fails, or the collection was deleted meanwhile; then nothing is written.
pub(super) fn commit<T>(
    store: &Store,
    collection: &mut Collection,
    mut change: Change,
    finish: impl FnOnce(&Tx<'_>, &Written) -> Result<T>,
) -> Result<T> {
    let (written, value) = store.catalog().write(|tx| -> Result<_> {
        let written = change.write(tx, collection)?;
        let value = finish(tx, &written)?;
        Ok((written, value))
    })?;
    collection.apply(change.applied(written));
    Ok(value)
}

/// Commits the change of a request that takes effect once. Returns the reply that `finish` makes,
/// or the stored reply of an earlier repeat.
pub(super) fn commit_once(
    store: &Store,
    collection: &mut Collection,
    mut change: Change,
    request: &Request<'_>,
    finish: impl FnOnce(&Tx<'_>, &Written) -> Result<Vec<u8>>,
) -> Result<Vec<u8>> {
    let mut written = None;
    let reply = store.catalog().write(|tx| {
        once(tx, request, |tx| {
            let now = change.write(tx, collection)?;
            let reply = finish(tx, &now)?;
            written = Some(now);
            Ok(reply)
        })
    })?;
    if let Some(written) = written {
        collection.apply(change.applied(written));
    }
    Ok(reply)
}

impl Change {
    fn write(&mut self, tx: &Tx<'_>, collection: &Collection) -> Result<Written> {
        let id = collection.id();
        if tx.collection_by_id(id)?.is_none() {
            return Err(LibraryError::deleted(&collection.row().name));
        }
        if let Some(accepted) = &self.accepted {
            still_queued(tx, accepted)?;
        }
        if let Some(undoable) = &self.undoable {
            let pinned = self.pins.iter().map(|p| p.0);
            let touched: BTreeSet<ShapeId> =
                pinned.chain(self.reviews.iter().map(|r| r.0)).collect();
            let touched: Vec<ShapeId> = touched.into_iter().collect();
            let before = match undoable {
                Undoable::Name => Before::names(tx.labels(id)?),
                Undoable::Up { .. } => Before::up(tx, collection)?,
                Undoable::Link { .. } | Undoable::Unlink { .. } => Before::links(tx, collection)?,
                _ => Before::labels(tx, collection, &touched)?,
            };
            tx.insert_correction(id, undoable.kind(), &undoable.detail(), &before.encode())?;
        }
        if let Some((shape, name)) = &self.removed {
            tx.delete_shape(*shape)?;
            event(
                tx,
                id,
                &EventKind::ShapeRemoved {
                    shape: name.clone(),
                },
            )?;
        }
        if let Some(up) = &self.up {
            tx.set_parameters(id, collection.row().n_parts, up)?;
        }
        if let Some(opening) = &self.opening {
            event(tx, id, opening)?;
        }
        for edit in &self.links {
            edit.write(tx, id)?;
        }
        for edit in &self.labels {
            edit.write(tx, id)?;
        }
        for (shape, pins) in &self.pins {
            tx.set_pins(*shape, pins.as_deref())?;
        }
        for (shape, review) in &self.reviews {
            tx.set_review(*shape, review.as_ref())?;
        }
        let added = self.added.as_mut().map(|a| a.write(tx, id)).transpose()?;
        for map in &self.maps {
            tx.put_map(map)?;
        }
        if let Some(closing) = &self.closing {
            event(tx, id, closing)?;
        }
        for shape in &mut self.relabelled {
            put_relabelled(tx, id, shape)?;
        }
        self.write_staleness(tx, collection)?;
        self.write_model(tx, collection)?;
        let job = self.write_state(tx, collection)?;
        if let Some(undone) = self.undone {
            // Last, because the labels above must not be recorded with an older change.
            tx.delete_correction(undone)?;
        }
        let row = tx.collection_by_id(id)?;
        let row = row.ok_or_else(|| LibraryError::deleted(&collection.row().name))?;
        let state = match row.state == collection.row().state {
            true => None,
            // Decoded from the row, because numbers may lose their last bit in text.
            false => Some(State::of(&row)?),
        };
        Ok(Written {
            row,
            job,
            added,
            state,
        })
    }

    fn write_staleness(&self, tx: &Tx<'_>, collection: &Collection) -> Result<()> {
        let id = collection.id();
        match self.staleness {
            Staleness::AsLabelled => {}
            Staleness::AllOthers => {
                let model = self.model.as_ref().or(collection.model());
                let epoch = model.map_or(0, |m| m.model.epoch);
                tx.mark_stale_before(id, epoch)?;
            }
            Staleness::Unchanged => {
                for shape in &self.relabelled {
                    let at = collection.position(shape.shape);
                    let stale = at.is_some_and(|at| collection.shapes()[at].stale);
                    tx.set_stale(shape.shape, stale)?;
                }
            }
            Staleness::All => {
                tx.mark_all_stale(id)?;
            }
        }
        for (shape, stale) in &self.stale {
            tx.set_stale(*shape, *stale)?;
        }
        Ok(())
    }

    /// Writes the model, and replaces it by the decoded one: only half of each symmetric matrix is
    /// stored, and the other half may differ in its last bits.
    fn write_model(&mut self, tx: &Tx<'_>, collection: &Collection) -> Result<()> {
        let Some(model) = &self.model else {
            return Ok(());
        };
        let bytes = model.encode();
        tx.set_model(collection.id(), &bytes)?;
        tx.set_epoch(collection.id(), model.model.epoch)?;
        let location = format!("collections {}", collection.row().name);
        self.model = Some(ModelState::decode(&bytes).map_err(|e| damaged(&location, &e))?);
        Ok(())
    }

    /// Writes the state, and the job that propagates the change. Returns the job; 0 without one.
    fn write_state(&mut self, tx: &Tx<'_>, collection: &Collection) -> Result<u64> {
        let id = collection.id();
        let mut job = 0;
        if self.propagates {
            let n_shapes = tx.n_stale(id)?;
            job = tx.insert_job(&collection.row().name, unix_secs(), &[])?;
            let state = self.state.get_or_insert_with(|| collection.state().clone());
            state.propagation = Some(Propagation { job, n_shapes });
        }
        if let Some(state) = &self.state {
            tx.set_state(id, &state.encode())?;
        }
        Ok(job)
    }

    /// Returns the effect of the change on the collection in memory.
    fn applied(self, written: Written) -> Applied {
        let added = self
            .added
            .zip(written.added)
            .map(|(addition, id)| KnownShape {
                id,
                ordinal: addition.shape.ordinal,
                digest: addition.shape.content_digest,
                stale: false,
                pinned: false,
                signature: addition.shape.signature,
            });
        Applied {
            row: written.row,
            state: written.state,
            model: self.model,
            removed: self.removed.map(|r| r.0),
            added,
            pinned: self.pins.iter().map(|p| (p.0, p.1.is_some())).collect(),
            labelled: self.relabelled.iter().map(|r| r.shape).collect(),
            staleness: self.staleness,
            stale: self.stale,
        }
    }
}

impl Addition {
    pub(super) fn new(
        object: ObjectRow,
        shape: NewShapeRow,
        labels: NewLabels,
        maps: Vec<(ShapeId, FunctionalMap)>,
    ) -> Box<Self> {
        Box::new(Self {
            object,
            shape,
            labels,
            maps,
        })
    }

    fn write(&mut self, tx: &Tx<'_>, collection: CollectionId) -> Result<ShapeId> {
        tx.insert_object(&self.object)?;
        self.shape.ordinal = tx.take_ordinal(collection)?;
        let id = tx.insert_shape(&self.shape)?;
        let labels = &mut self.labels;
        let added = EventKind::ShapeAdded {
            shape: self.shape.name.clone(),
            version: labels.row.version,
            area_shares: labels.summary.area_shares.clone(),
        };
        labels.row.sequence = event(tx, collection, &added)?;
        labels.row.cause = cause::ADDED.into();
        tx.put_labels(id, &labels.row, &labels.summary)?;
        for (from, map) in &self.maps {
            tx.put_map(&map_row(*from, id, map))?;
        }
        Ok(id)
    }
}

/// Refuses an item that was cancelled while it was placed, so that it is either cancelled or
/// placed.
fn still_queued(tx: &Tx<'_>, accepted: &JobItemRow) -> Result<()> {
    let item = tx.job_item(accepted.job, accepted.index)?;
    if item.is_some_and(|i| i.status == ItemStatus::Queued) {
        return Ok(());
    }
    let message = format!("item {} of job {} is over", accepted.index, accepted.job);
    let reason = Reason::Cancelled;
    Err(LibraryError::FailedPrecondition { reason, message })
}

/// Writes new labels of a stored shape, and the event with the areas that moved.
fn put_relabelled(tx: &Tx<'_>, collection: CollectionId, shape: &mut Relabelled) -> Result<()> {
    let labels = &mut shape.labels;
    let changed = EventKind::LabelsChanged {
        shape: shape.name.clone(),
        version: labels.row.version,
        cause: labels.row.cause.clone(),
        moves: shape.moves.clone(),
    };
    labels.row.sequence = event(tx, collection, &changed)?;
    Ok(tx.put_labels(shape.shape, &labels.row, &labels.summary)?)
}

/// Returns the row of a map.
pub(super) fn map_row(from: ShapeId, to: ShapeId, map: &FunctionalMap) -> MapRow {
    MapRow {
        from,
        to,
        k1: map.k1 as u32,
        k2: map.k2 as u32,
        c_12: map.c_12.clone(),
        p2p_21: map.p2p_21.clone(),
        confidence: map.confidence.of_vertex.clone(),
        quality_json: quality_to_json(&map.quality),
    }
}
