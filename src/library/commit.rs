//! The one effect of an addition: a transaction that names everything that became true together.

use super::lane::{KnownShape, Lane};
use super::place::Plan;
use super::relabel::{NewLabels, Relabelled};
use super::rows::{label_colour, quality_to_json, to_json};
use super::{EventKind, Library, LibraryError, Placed, Result, Source};
use crate::fmap::FunctionalMap;
use crate::pipeline::LabelChange;
use crate::store::{
    CollectionId, CollectionRow, ItemStatus, JobItemRow, LabelRow, MapRow, NewShapeRow, ObjectRow,
    ShapeId, ShapeRow, Tx,
};

/// An addition, ready to be written.
pub(super) struct Commit<'a> {
    pub(super) object: ObjectRow,
    pub(super) shape: NewShapeRow,
    pub(super) labels: NewLabels,
    pub(super) sources: Vec<Source>,
    pub(super) maps: Vec<(ShapeId, FunctionalMap)>,
    pub(super) relabelled: Vec<Relabelled>,
    pub(super) replaced: Option<&'a ShapeRow>,
    pub(super) accepted: &'a JobItemRow,
    pub(super) placed: Placed,
    pub(super) plan: Plan,
}

impl Library {
    /// Writes an addition and brings the lane up to it.
    pub(super) fn commit(
        &self,
        lane: &mut Lane,
        mut commit: Commit<'_>,
        signature: Vec<f32>,
    ) -> Result<Placed> {
        let collection = lane.row.id;
        let accepted = commit.plan.reclustered.is_some_and(|r| r.2);
        let blob = commit.plan.learnt.encode();
        let (id, row) = self.store.catalog().write(|tx| -> Result<_> {
            still_queued(tx, commit.accepted)?;
            if let Some(old) = commit.replaced {
                tx.delete_shape(old.id)?;
                event(
                    tx,
                    collection,
                    &EventKind::ShapeRemoved {
                        shape: old.name.clone(),
                    },
                )?;
            }
            tx.insert_object(&commit.object)?;
            commit.shape.ordinal = tx.take_ordinal(collection)?;
            let id = tx.insert_shape(&commit.shape)?;
            for change in &commit.plan.changes {
                label_change(tx, collection, change)?;
            }
            let epoch = commit.plan.learnt.model.epoch;
            let added = EventKind::ShapeAdded {
                shape: commit.shape.name.clone(),
                version: commit.placed.version,
                area_shares: commit.labels.summary.area_shares.clone(),
            };
            commit.labels.row.version = commit.placed.version;
            commit.labels.row.sequence = event(tx, collection, &added)?;
            commit.labels.row.cause = "added".into();
            commit.labels.row.sources_json = to_json(&commit.sources);
            commit.labels.summary.label_epoch = epoch;
            tx.put_labels(id, &commit.labels.row, &commit.labels.summary)?;
            for (from, map) in &commit.maps {
                tx.put_map(&map_row(*from, id, map))?;
            }
            if let Some((before, after, accepted)) = commit.plan.reclustered {
                let score_before = before.is_finite().then_some(before);
                let kind = EventKind::Reclustered {
                    score_before,
                    score_after: after,
                    accepted,
                };
                event(tx, collection, &kind)?;
            }
            for relabelled in &mut commit.relabelled {
                put_relabelled(tx, collection, relabelled, &[], epoch)?;
            }
            if accepted {
                tx.mark_stale_before(collection, epoch)?;
            }
            if commit.plan.teach_again {
                tx.mark_all_stale(collection)?;
            }
            tx.set_model(collection, &blob)?;
            tx.set_epoch(collection, epoch)?;
            tx.set_state(collection, to_json(&commit.plan.state).as_bytes())?;
            let row = collection_row(tx, collection)?;
            commit.placed.sequence = row.sequence;
            let (job, index) = (commit.accepted.job, commit.accepted.index);
            tx.set_item(job, index, ItemStatus::Done, Some(&to_json(&commit.placed)))?;
            Ok((id, row))
        })?;
        if accepted {
            for shape in &mut lane.shapes {
                shape.stale = !commit.plan.state.representatives.contains(&shape.ordinal);
            }
        }
        if commit.plan.teach_again {
            lane.shapes.iter_mut().for_each(|s| s.stale = true);
        }
        lane.shapes
            .push(KnownShape::fresh(id, &commit.shape, signature));
        if let (true, Some(new)) = (commit.plan.teach_again, lane.shapes.last_mut()) {
            new.stale = true;
        }
        lane.row = row;
        lane.learnt = Some(commit.plan.learnt);
        lane.state = commit.plan.state;
        Ok(commit.placed)
    }

    /// Writes the new labels of a shape that was stale.
    pub(super) fn commit_relabelled(
        &self,
        lane: &mut Lane,
        mut relabelled: Relabelled,
        sources: &[Source],
        epoch: u64,
    ) -> Result<()> {
        let collection = lane.row.id;
        lane.row = self.store.catalog().write(|tx| -> Result<_> {
            put_relabelled(tx, collection, &mut relabelled, sources, epoch)?;
            collection_row(tx, collection)
        })?;
        Ok(())
    }
}

/// Refuses what was cancelled while it was placed, so that it is either cancelled or placed.
fn still_queued(tx: &Tx<'_>, accepted: &JobItemRow) -> Result<()> {
    let item = tx.job_item(accepted.job, accepted.index)?;
    if item.is_some_and(|i| i.status == ItemStatus::Queued) {
        return Ok(());
    }
    let message = format!("item {} of job {} is over", accepted.index, accepted.job);
    let reason = "CANCELLED";
    Err(LibraryError::FailedPrecondition { reason, message })
}

/// Appends an event to a collection's log and returns its sequence number.
pub(super) fn event(tx: &Tx<'_>, collection: CollectionId, kind: &EventKind) -> Result<u64> {
    let name = match kind {
        EventKind::CollectionCreated => "collection_created",
        EventKind::CollectionDeleted => "collection_deleted",
        EventKind::ShapeAdded { .. } => "shape_added",
        EventKind::ShapeRemoved { .. } => "shape_removed",
        EventKind::LabelsChanged { .. } => "labels_changed",
        EventKind::LabelCreated { .. } => "label_created",
        EventKind::LabelMerged { .. } => "label_merged",
        EventKind::LabelSplit { .. } => "label_split",
        EventKind::LabelNamed { .. } => "label_named",
        EventKind::LabelRetired { .. } => "label_retired",
        EventKind::Corrected { .. } => "corrected",
        EventKind::Undone { .. } => "undone",
        EventKind::UpChanged { .. } => "up_changed",
        EventKind::Reclustered { .. } => "reclustered",
    };
    Ok(tx.append_event(collection, name, &to_json(kind))?)
}

/// Writes new labels of a stored shape and says which faces changed.
pub(super) fn put_relabelled(
    tx: &Tx<'_>,
    collection: CollectionId,
    relabelled: &mut Relabelled,
    sources: &[Source],
    epoch: u64,
) -> Result<()> {
    let labels = &mut relabelled.labels;
    labels.summary.label_epoch = epoch;
    let changed = EventKind::LabelsChanged {
        shape: relabelled.name.clone(),
        version: labels.row.version,
        cause: relabelled.cause.into(),
        moves: relabelled.moves.clone(),
    };
    labels.row.sequence = event(tx, collection, &changed)?;
    labels.row.cause = relabelled.cause.into();
    labels.row.sources_json = to_json(&sources);
    Ok(tx.put_labels(relabelled.shape, &labels.row, &labels.summary)?)
}

pub(super) fn label_change(
    tx: &Tx<'_>,
    collection: CollectionId,
    change: &LabelChange,
) -> Result<()> {
    match *change {
        LabelChange::Created(id) => {
            let taken = tx.take_labels(collection, 1)?;
            assert_eq!(
                taken, id,
                "invariant: new labels are numbered as they are created"
            );
            let row = LabelRow {
                id,
                name: None,
                colour: label_colour(id),
                merged_into: None,
            };
            tx.put_label(collection, &row)?;
            event(tx, collection, &EventKind::LabelCreated { label: id })?;
        }
        LabelChange::Merged { from, into } => {
            if let Some(row) = tx.labels(collection)?.into_iter().find(|l| l.id == from) {
                tx.put_label(
                    collection,
                    &LabelRow {
                        merged_into: Some(into),
                        ..row
                    },
                )?;
            }
            event(tx, collection, &EventKind::LabelMerged { from, into })?;
        }
        LabelChange::Split { from, into } => {
            event(
                tx,
                collection,
                &EventKind::LabelSplit {
                    from,
                    into: vec![into],
                },
            )?;
        }
    }
    Ok(())
}

/// The row of a collection that is known to be there.
pub(super) fn collection_row(tx: &Tx<'_>, id: CollectionId) -> Result<CollectionRow> {
    tx.collection_by_id(id)?
        .ok_or_else(|| super::rows::damaged("collections", &format!("row {id} is gone")))
}

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
