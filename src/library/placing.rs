//! Places a described shape: relates it to a few known shapes, labels and commits it.

use super::advance::{fit_model, relabel_all};
use super::agreement::n_inconsistent;
use super::change::{Addition, Change, LabelEdit, commit};
use super::collection::Collection;
use super::collection::discovered::{self, NewShape, Plan};
use super::error::{LibraryError, Named, Result};
use super::facade::Library;
use super::labelling::{Relabelled, cause, new_labels_of};
use super::lookup::object_length;
use super::placement;
use super::reason::{Code, Reason};
use super::refusal::failure;
use super::rows::{report_to_json, to_json};
use super::sources::{FileView, Sources};
use super::submit::{Described, read_by_first_release};
use super::types::{Failure, ItemState, JobItem, NewShape as ShapeToAdd, Outcome, Placed};
use super::voting::Voted;
use crate::mesh::CleanReport;
use crate::pipeline::Description;
use crate::store::{
    ItemStatus, JobItemRow, Kept, NewShapeRow, ObjectRow, ShapeId, ShapeRow, Store, Tx,
};
use std::time::Instant;

/// Milliseconds that each stage took, in order.
struct Stages {
    done: Vec<(String, f64)>,
    since: Instant,
}

impl Stages {
    fn after(done: Vec<(String, f64)>) -> Self {
        Self {
            done,
            since: Instant::now(),
        }
    }

    /// Ends a stage.
    fn lap(&mut self, name: &str) {
        let ms = self.since.elapsed().as_secs_f64() * 1e3;
        self.done.push((name.to_owned(), ms));
        self.since = Instant::now();
    }
}

impl Library {
    /// Places a described item and commits it, or commits that it failed. Call it in the order of
    /// acceptance within a collection.
    ///
    /// # Errors
    /// The store fails, or the collection is deleted meanwhile. A shape that is refused is an
    /// [`ItemState::Failed`].
    pub fn place_item(
        &self,
        item: &JobItem,
        described: std::result::Result<Described, Failure>,
    ) -> Result<ItemState> {
        let Ok(collection) = self.collection_row(&item.collection) else {
            let gone = LibraryError::not_found(Named::Collection, &item.collection);
            return self.fail(item, failure(&gone));
        };
        self.with_collection(collection, |collection| {
            let row = self.item_row(item)?;
            if row.status != ItemStatus::Queued {
                return Ok(self.item(row)?.state);
            }
            let id = collection.id();
            let catalog = self.store.catalog();
            let existing: Option<ShapeRow> = catalog.read(|r| r.shape_by_name(id, &item.name))?;
            let read_again = |shape: &ShapeRow| {
                let found = described.as_ref().map(|d| &d.description.report);
                row.item.replace
                    && read_by_first_release(shape)
                    && found.is_ok_and(CleanReport::differs_from_first_release)
            };
            match &existing {
                Some(shape)
                    if shape.content_digest == row.item.original_digest && !read_again(shape) =>
                {
                    return self.unchanged(item, shape.version, collection.row().sequence);
                }
                Some(_) if !row.item.replace => return self.fail(item, taken(item)),
                _ => {}
            }
            match described {
                Err(why) => self.fail(item, why),
                Ok(described) => {
                    let placed =
                        place(&self.store, collection, &row, described, existing.as_ref())?;
                    self.note(&placed);
                    Ok(ItemState::Done(Box::new(placed)))
                }
            }
        })
    }

    /// Submits, describes and places one shape in this process.
    ///
    /// # Errors
    /// Those of [`Library::submit`]; [`LibraryError::Refused`] if the shape is refused.
    pub fn add(&self, collection: &str, shape: ShapeToAdd) -> Result<Placed> {
        let job = self.submit(collection, &self.store_originals(vec![shape])?, None)?;
        let item = &job.items[0];
        match self.place_item(item, self.describe_item(item, &|_| true))? {
            ItemState::Done(placed) => Ok(*placed),
            ItemState::Failed(why) => Err(LibraryError::Refused(why)),
            ItemState::Queued | ItemState::Running(_) | ItemState::Cancelled => {
                Err(LibraryError::FailedPrecondition {
                    reason: Reason::Cancelled,
                    message: format!("job {} was cancelled", job.id),
                })
            }
        }
    }

    /// Settles an item whose shape is already stored.
    fn unchanged(&self, item: &JobItem, version: u64, sequence: u64) -> Result<ItemState> {
        let placed = Placed {
            outcome: Outcome::Unchanged,
            version,
            sequence,
            n_maps: 0,
            n_relabelled: 0,
            n_inconsistent: 0,
            stages_ms: Vec::new(),
        };
        self.store.catalog().write(|tx| -> Result<()> {
            let detail = to_json(&placed);
            Ok(tx.set_item(item.job, item.index, ItemStatus::Done, Some(&detail))?)
        })?;
        Ok(ItemState::Done(Box::new(placed)))
    }

    fn fail(&self, item: &JobItem, why: Failure) -> Result<ItemState> {
        let cancelled = why.code == Code::Cancelled;
        let status = if cancelled {
            ItemStatus::Cancelled
        } else {
            ItemStatus::Failed
        };
        self.store.catalog().write(|tx| -> Result<()> {
            Ok(tx.set_item(item.job, item.index, status, Some(&to_json(&why)))?)
        })?;
        Ok(if cancelled {
            ItemState::Cancelled
        } else {
            ItemState::Failed(why)
        })
    }
}

/// Labels a described shape and commits it. `replaced` is removed in the same commit.
fn place(
    store: &Store,
    collection: &mut Collection,
    accepted: &JobItemRow,
    described: Described,
    replaced: Option<&ShapeRow>,
) -> Result<Placed> {
    let ((object, _kept), mut stages) = store_description(store, &described)?;
    let new = NewShape {
        arrays: FileView {
            view: described.description.view(),
            file: object.blake3,
        },
        digest: accepted.item.original_digest,
    };
    let (outcome, version) = match replaced {
        Some(old) => (Outcome::Replaced, old.version + 1),
        None => (Outcome::Added, 1),
    };
    let lost_training = replaced.map_or(Ok(false), |old| set_aside(store, collection, old.id))?;
    let (voted, n_fresh) = label_new(store, collection, new.arrays)?;
    let (labelling, sources, maps) = Voted::parts(voted);
    let n_inconsistent = n_inconsistent(store, &maps)?;
    stages.lap("place");
    let plan = plan(store, collection, &new, labelling, lost_training)?;
    stages.lap("recluster");
    let labels = placement::labels(store, &new, &plan, &accepted.item.format)?;
    let mut labels = labels.voted_by(&sources);
    labels.row.version = version;
    let relabelled = relabelled(store, &plan)?;
    stages.lap("boundary");
    let placed = Placed {
        outcome,
        version,
        sequence: 0,
        n_maps: maps.len() as u32,
        n_relabelled: n_fresh + relabelled.len() as u32,
        n_inconsistent,
        stages_ms: stages.done,
    };
    let shape = shape_row(
        store,
        collection,
        accepted,
        &described,
        &object,
        version - 1,
    )?;
    let addition = Addition::new(object, shape, labels, maps);
    let change = change(plan, addition, relabelled, accepted, replaced);
    commit(store, collection, change, |tx, now| {
        settle(tx, accepted, placed, now.row.sequence)
    })
}

/// Records that an item is done.
fn settle(tx: &Tx<'_>, accepted: &JobItemRow, mut placed: Placed, sequence: u64) -> Result<Placed> {
    placed.sequence = sequence;
    let (job, index) = (accepted.job, accepted.index);
    tx.set_item(job, index, ItemStatus::Done, Some(&to_json(&placed)))?;
    Ok(placed)
}

/// Makes a description durable. Returns its object, and a guard that protects its file until the
/// commit.
fn store_description(
    store: &Store,
    described: &Described,
) -> Result<((ObjectRow, Option<Kept>), Stages)> {
    let mut stages = Stages::after(described.stages_ms.clone());
    if let Some(stored) = &described.stored {
        return Ok(((stored.clone(), None), stages));
    }
    let objects = store.objects();
    let (digest, params) = (described.digest, &described.params_json);
    let kept = objects.put_description(digest, &described.description, params)?;
    stages.lap("store");
    Ok(((ObjectRow::clone(&kept), Some(kept)), stages))
}

/// Takes a shape out of the collection before it is replaced. Returns whether a person had labelled
/// it.
fn set_aside(store: &Store, collection: &mut Collection, id: ShapeId) -> Result<bool> {
    let at = collection.position(id);
    let was_pinned = at.is_some_and(|at| collection.shapes()[at].pinned);
    let model = discovered::model_without(collection, store, id)?;
    collection.set_aside(id, model);
    Ok(was_pinned)
}

/// Labels a new shape through maps, after fitting the model or relabelling stale voters where
/// necessary. Returns the labelling, or `None` without a model, and the number of shapes that were
/// relabelled for it.
fn label_new(
    store: &Store,
    collection: &mut Collection,
    shape: FileView<'_>,
) -> Result<(Option<Voted>, u32)> {
    fit_model(store, collection)?;
    let nearest = placement::voters(collection, store, shape)?;
    let n_fresh = relabel_all(store, collection, &nearest)?;
    let voted = placement::label(collection, store, shape, &nearest)?;
    Ok((voted, n_fresh))
}

/// Returns the plan of the changes that follow from the addition of a labelled shape.
fn plan(
    store: &Store,
    collection: &mut Collection,
    new: &NewShape<'_>,
    labelling: Option<crate::pipeline::Labelling>,
    lost_training: bool,
) -> Result<Plan> {
    if placement::clusters(collection) {
        let links = store.links(collection.id())?;
        let chosen = discovered::representatives(collection, &links);
        relabel_all(store, collection, &chosen)?;
    }
    let mut plan = placement::plan(collection, store, new, labelling, lost_training)?;
    if plan.state.up_disagrees.is_none() && collection.up().axis().is_some() {
        // No disagreement is known, perhaps because an earlier release began the collection without
        // this check.
        let found =
            discovered::up_found(collection, store, collection.up(), Some(&new.arrays.view))?;
        plan.state.up_disagrees = found.disagrees;
    }
    Ok(plan)
}

fn relabelled(store: &Store, plan: &Plan) -> Result<Vec<Relabelled>> {
    let model = &plan.model.model;
    let ids = (&model.labels[..], model.epoch);
    let shapes = plan.relabelled.iter().map(|(known, labelling)| {
        let labels = new_labels_of(store, known, labelling, ids)?;
        Ok(Relabelled::new(known, labels, cause::RECLUSTERING))
    });
    shapes.collect()
}

/// Returns the row of a new shape. Its labels have the version after `version`.
fn shape_row(
    store: &Store,
    collection: &Collection,
    accepted: &JobItemRow,
    described: &Described,
    object: &ObjectRow,
    version: u64,
) -> Result<NewShapeRow> {
    let description: &Description = &described.description;
    let original = accepted.item.original_digest;
    Ok(NewShapeRow {
        collection: collection.id(),
        name: accepted.item.name.clone(),
        ordinal: collection.row().next_ordinal,
        content_digest: original,
        format: accepted.item.format.clone(),
        description_digest: described.digest,
        n_polygons: description.face_map.len() as u64,
        area: description.area,
        report_json: report_to_json(&description.report).to_string(),
        version,
        signature: description.signature.clone(),
        stored_bytes: object.length + object_length(store, &original)?,
    })
}

/// Returns the change that adds the shape.
fn change(
    plan: Plan,
    addition: Box<Addition>,
    relabelled: Vec<Relabelled>,
    accepted: &JobItemRow,
    replaced: Option<&ShapeRow>,
) -> Change {
    Change {
        accepted: Some(accepted.clone()),
        removed: replaced.map(|old| (old.id, old.name.clone())),
        labels: plan.changes.into_iter().map(LabelEdit::from).collect(),
        added: Some(addition),
        closing: plan.reclustered,
        relabelled,
        staleness: plan.staleness,
        model: Some(plan.model),
        state: Some(plan.state),
        ..Change::default()
    }
}

fn taken(item: &JobItem) -> Failure {
    Failure {
        code: Code::AlreadyExists,
        reason: Reason::NameTaken,
        message: format!(
            "collection {:?} has a shape named {:?} with other bytes; replace it or \
             choose another name",
            item.collection, item.name
        ),
        subject: None,
    }
}
