//! Collections: created, described, deleted; their labels named.

use super::commit::event;
use super::history::{Before, from_reply};
use super::names::check_name;
use super::rows::{CollectionState, damaged, operator_from_name, operator_name, to_json};
use super::{
    CollectionInfo, CollectionSpec, EventKind, LabelId, LabelInfo, Library, LibraryError,
    RequestKey, Result, Up, UpEstimate,
};
use crate::pipeline::Params;
use crate::store::catalog::KIND_NAME;
use crate::store::{CollectionRow, Digest, LabelRow, NewCollection, Reader, Tx};
use std::sync::PoisonError;

const MAX_NAME: usize = 128;
const MAX_LABEL_NAME: usize = 128;
/// Most kinds of parts that a collection can be told to have.
pub const MAX_PARTS: u32 = 64;
const WORKING_FACES: std::ops::RangeInclusive<u32> = 200..=100_000;

impl Library {
    /// Creates a collection. The same key gives the same collection again.
    ///
    /// # Errors
    /// A name or number out of range, or a name that is taken.
    pub fn create_collection(
        &self,
        spec: &CollectionSpec,
        key: Option<&RequestKey>,
    ) -> Result<CollectionInfo> {
        check_name("collection", &spec.name, MAX_NAME)?;
        if let Some(n) = spec.n_parts.filter(|n| !(1..=MAX_PARTS).contains(n)) {
            let message = format!("the number of parts is {n}, but must be 1 to {MAX_PARTS}");
            return Err(LibraryError::invalid("N_PARTS_RANGE", message));
        }
        let working_faces = match spec.working_faces {
            0 => Params::default().working_faces,
            n if WORKING_FACES.contains(&n) => n,
            n => {
                let (least, most) = (WORKING_FACES.start(), WORKING_FACES.end());
                let message = format!("working_faces is {n}, but must be {least} to {most}");
                return Err(LibraryError::invalid("WORKING_FACES_RANGE", message));
            }
        };
        let request = Digest::of(to_json(&format!("create {spec:?}")).as_bytes());
        self.once(key, request, |tx| {
            if tx.collection(&spec.name)?.is_some() {
                return Err(LibraryError::AlreadyExists {
                    reason: "COLLECTION_EXISTS",
                    message: format!("a collection named {:?} is there already", spec.name),
                });
            }
            let id = tx.insert_collection(&NewCollection {
                name: spec.name.clone(),
                n_parts: spec.n_parts,
                up: spec.up.to_string(),
                operator: operator_name(spec.operator).into(),
                working_faces,
                state: Vec::new(),
            })?;
            event(tx, id, &EventKind::CollectionCreated)?;
            Ok(Vec::new())
        })?;
        self.collection(&spec.name)
    }

    /// All collections by name.
    ///
    /// # Errors
    /// The catalog cannot be read.
    pub fn collections(&self) -> Result<Vec<CollectionInfo>> {
        self.store
            .catalog()
            .read(|r| r.collections()?.into_iter().map(|c| info(r, c)).collect())
    }

    /// One collection.
    ///
    /// # Errors
    /// There is none of the name.
    pub fn collection(&self, name: &str) -> Result<CollectionInfo> {
        let row = self.collection_row(name)?;
        self.store.catalog().read(|r| info(r, row))
    }

    /// Deletes a collection with all its shapes.
    ///
    /// # Errors
    /// There is none of the name.
    pub fn delete_collection(&self, name: &str, key: Option<&RequestKey>) -> Result<()> {
        let request = Digest::of(format!("delete {name:?}").as_bytes());
        // Stays empty where the request is repeated: another collection may have the name by then.
        let deleted = std::cell::Cell::new(None);
        let delete = |tx: &Tx<'_>| {
            let row = super::read::require_collection(tx, name)?;
            event(tx, row.id, &EventKind::CollectionDeleted)?;
            tx.delete_collection(row.id)?;
            deleted.set(Some(row.id));
            Ok(Vec::new())
        };
        self.store.freeing(|| self.once(key, request, delete))?;
        if let Some(id) = deleted.take() {
            // Ids are not used again. Who is at its lane still has it, and finds no collection.
            let mut lanes = self.lanes.lock().unwrap_or_else(PoisonError::into_inner);
            lanes.remove(&id);
        }
        Ok(())
    }

    /// Gives a label a name.
    ///
    /// # Errors
    /// There is no such collection or label, or the name is out of range.
    pub fn name_label(
        &self,
        collection: &str,
        label: LabelId,
        name: &str,
        key: Option<&RequestKey>,
    ) -> Result<LabelInfo> {
        check_name("label", name, MAX_LABEL_NAME)?;
        let row = self.collection_row(collection)?;
        let request = Digest::of(format!("name {collection:?} {label} {name:?}").as_bytes());
        let reply = self.with_lane(row, |lane| {
            self.once(key, request, |tx| {
                let mut known = find_label(tx, lane.row.id, label)?;
                let labels = tx.labels(lane.row.id)?;
                let taken = |l: &&LabelRow| {
                    l.id != label && l.merged_into.is_none() && l.name.as_deref() == Some(name)
                };
                if let Some(other) = labels.iter().find(taken) {
                    return Err(LibraryError::AlreadyExists {
                        reason: "NAME_TAKEN",
                        message: format!("label {} is named {name:?} already", other.id),
                    });
                }
                let before = Before::names(labels);
                tx.insert_correction(lane.row.id, KIND_NAME, "{}", &before.encode())?;
                known.name = Some(name.to_string());
                tx.put_label(lane.row.id, &known)?;
                event(
                    tx,
                    lane.row.id,
                    &EventKind::LabelNamed {
                        label,
                        name: name.into(),
                    },
                )?;
                Ok(to_json(&label_in(tx, lane.row.id, label)?).into_bytes())
            })
        })?;
        if reply.is_empty() {
            // An earlier version kept no more of its answer than that there was one.
            return self.label_of(&self.collection_row(collection)?, label);
        }
        from_reply(&reply)
    }

    /// A label as it stands.
    pub(super) fn label_of(&self, row: &CollectionRow, label: LabelId) -> Result<LabelInfo> {
        self.store.catalog().read(|r| label_in(r, row.id, label))
    }
}

/// A label as a reader sees it.
pub(super) fn label_in(
    reader: &Reader<'_>,
    collection: crate::store::CollectionId,
    label: LabelId,
) -> Result<LabelInfo> {
    let uses = reader.label_uses(collection)?;
    let n_shapes = uses.get(&label).copied().unwrap_or(0);
    Ok(label_info(find_label(reader, collection, label)?, n_shapes))
}

/// A label of a collection, in use or not.
pub(super) fn find_label(
    reader: &Reader<'_>,
    collection: crate::store::CollectionId,
    label: LabelId,
) -> Result<crate::store::LabelRow> {
    let found = reader
        .labels(collection)?
        .into_iter()
        .find(|l| l.id == label);
    found.ok_or_else(|| LibraryError::not_found("label", label.to_string()))
}

/// A label with the number of shapes that carry it.
pub(super) fn label_info(row: crate::store::LabelRow, n_shapes: u64) -> LabelInfo {
    LabelInfo {
        id: row.id,
        name: row.name,
        colour: row.colour,
        merged_into: row.merged_into,
        n_shapes,
    }
}

fn info(reader: &Reader<'_>, row: CollectionRow) -> Result<CollectionInfo> {
    let place = format!("collections {}", row.name);
    let uses = reader.label_uses(row.id)?;
    let labels = reader.labels(row.id)?.into_iter();
    let state = CollectionState::of(&row)?;
    Ok(CollectionInfo {
        up_estimate: state.up.map(|up| UpEstimate {
            up: Up::along(up.vote().trusted()),
            agreement: up.agreement,
        }),
        up_disagrees: state.up_disagrees.and_then(|other| {
            let axis = other.vote().trusted()?;
            Some(UpEstimate {
                up: Up::along(Some(axis)),
                agreement: other.agreement,
            })
        }),
        n_undoable: reader.n_corrections(row.id)?,
        sequence: row.sequence,
        n_shapes: reader.n_shapes(row.id)?,
        n_stale: reader.n_stale(row.id)?,
        labels: labels
            .map(|l| {
                let n_shapes = uses.get(&l.id).copied().unwrap_or(0);
                label_info(l, n_shapes)
            })
            .collect(),
        spec: CollectionSpec {
            n_parts: row.n_parts,
            up: row.up.parse::<Up>().map_err(|e| damaged(&place, &e))?,
            operator: operator_from_name(&row.operator, &place)?,
            working_faces: row.working_faces,
            name: row.name,
        },
    })
}
