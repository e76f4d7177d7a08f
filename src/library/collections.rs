//! Creates, lists and deletes collections, and names their labels.

use super::change::{Change, LabelEdit, Undoable, commit_once, event};
use super::collection::State;
use super::error::{LibraryError, Named, Result};
use super::event::EventKind;
use super::facade::Library;
use super::lookup::require_collection;
use super::names::check_name;
use super::once::{Request, answered, from_reply, once};
use super::reason::Reason;
use super::rows::{damaged, operator_from_name, operator_name, to_json};
use super::sources::Sources;
use super::types::{
    CollectionInfo, CollectionSpec, LabelId, LabelInfo, RequestKey, Up, UpEstimate,
};
use super::verdict::ReviewState;
use crate::pipeline::Params;
use crate::store::{CollectionId, CollectionRow, LabelRow, NewCollection, Reader, Tx};
use std::collections::BTreeMap;

const MAX_NAME: usize = 128;
const MAX_LABEL_NAME: usize = 128;
/// Maximum number of part kinds of a collection.
pub const MAX_PARTS: u32 = 64;
pub(super) const WORKING_FACES: std::ops::RangeInclusive<u32> = 200..=100_000;

impl Library {
    /// Creates a collection. A repeated request with the same key returns the same collection.
    ///
    /// # Errors
    /// A name or number is out of range, or the name is taken.
    pub fn create_collection(
        &self,
        spec: &CollectionSpec,
        key: Option<&RequestKey>,
    ) -> Result<CollectionInfo> {
        check_name("collection", &spec.name, MAX_NAME)?;
        if let Some(n) = spec.n_parts.filter(|n| !(1..=MAX_PARTS).contains(n)) {
            let message = format!("the number of parts is {n}, but must be 1 to {MAX_PARTS}");
            return Err(LibraryError::invalid(Reason::NPartsRange, message));
        }
        let working_faces = match spec.working_faces {
            0 => Params::default().working_faces,
            n if WORKING_FACES.contains(&n) => n,
            n => {
                let (least, most) = (WORKING_FACES.start(), WORKING_FACES.end());
                let message = format!("working_faces is {n}, but must be {least} to {most}");
                return Err(LibraryError::invalid(Reason::WorkingFacesRange, message));
            }
        };
        let request = Request::of(key, &to_json(&format!("create {spec:?}")));
        let create = |tx: &Tx<'_>| {
            if tx.collection(&spec.name)?.is_some() {
                return Err(LibraryError::AlreadyExists {
                    reason: Reason::CollectionExists,
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
        };
        self.store
            .catalog()
            .write(|tx| once(tx, &request, create))?;
        self.collection(&spec.name)
    }

    /// Returns all collections by name.
    ///
    /// # Errors
    /// The catalog cannot be read.
    pub fn collections(&self) -> Result<Vec<CollectionInfo>> {
        self.store
            .catalog()
            .read(|r| r.collections()?.into_iter().map(|c| info(r, c)).collect())
    }

    /// Returns one collection.
    ///
    /// # Errors
    /// There is no collection of this name.
    pub fn collection(&self, name: &str) -> Result<CollectionInfo> {
        let row = self.collection_row(name)?;
        self.store.catalog().read(|r| info(r, row))
    }

    /// Deletes a collection with all its shapes.
    ///
    /// # Errors
    /// There is no collection of this name.
    pub fn delete_collection(&self, name: &str, key: Option<&RequestKey>) -> Result<()> {
        let request = Request::of(key, &format!("delete {name:?}"));
        // Stays empty if the request is repeated, because another collection may have the name by
        // then.
        let deleted = std::cell::Cell::new(None);
        let delete = |tx: &Tx<'_>| {
            let row = require_collection(tx, name)?;
            event(tx, row.id, &EventKind::CollectionDeleted)?;
            tx.delete_collection(row.id)?;
            deleted.set(Some(row.id));
            Ok(Vec::new())
        };
        let catalog = self.store.catalog();
        self.store
            .freeing(|| catalog.write(|tx| once(tx, &request, delete)))?;
        if let Some(id) = deleted.take() {
            self.forget_collection(id);
        }
        Ok(())
    }

    /// Names a label.
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
        let request = Request::of(key, &format!("name {collection:?} {label} {name:?}"));
        self.with_collection(row, |collection| {
            let id = collection.id();
            let reply = match answered(&self.store, &request)? {
                Some(reply) => reply,
                None => {
                    let change = naming(self.store.labels(id)?, label, name)?;
                    commit_once(&self.store, collection, change, &request, |tx, _| {
                        Ok(to_json(&label_in(tx, id, label)?).into_bytes())
                    })?
                }
            };
            if reply.is_empty() {
                // An earlier version stored only that there was a reply.
                return self.store.catalog().read(|r| label_in(r, id, label));
            }
            from_reply(&reply)
        })
    }
}

/// Returns the change that names a label.
fn naming(labels: Vec<LabelRow>, label: LabelId, name: &str) -> Result<Change> {
    let row = find_label(&labels, label)?.clone();
    let taken =
        |l: &&LabelRow| l.id != label && l.merged_into.is_none() && l.name.as_deref() == Some(name);
    if let Some(other) = labels.iter().find(taken) {
        return Err(LibraryError::AlreadyExists {
            reason: Reason::NameTaken,
            message: format!("label {} is named {name:?} already", other.id),
        });
    }
    Ok(Change {
        undoable: Some(Undoable::Name),
        labels: vec![LabelEdit::Named(row, name.to_owned())],
        ..Change::default()
    })
}

/// Reads a label.
pub(super) fn label_in(
    reader: &Reader<'_>,
    collection: CollectionId,
    label: LabelId,
) -> Result<LabelInfo> {
    let labels = reader.labels(collection)?;
    let row = reader.collection_by_id(collection)?;
    let row = row.ok_or_else(|| damaged("collections", &format!("{collection} is gone")))?;
    let uses = LabelUses::new(reader, &row, &State::of(&row)?)?;
    Ok(uses.info(find_label(&labels, label)?.clone()))
}

/// Finds a label among those of a collection, in use or not.
pub(super) fn find_label(labels: &[LabelRow], label: LabelId) -> Result<&LabelRow> {
    let found = labels.iter().find(|l| l.id == label);
    found.ok_or_else(|| LibraryError::not_found(Named::Label, label.to_string()))
}

/// How much a collection's labels are used, and by whom.
struct LabelUses {
    /// Number of shapes with each label, and the sum of their area shares.
    uses: BTreeMap<LabelId, (u64, f64)>,
    n_shapes: u64,
    kept: Vec<LabelId>,
}

impl LabelUses {
    fn new(reader: &Reader<'_>, row: &CollectionRow, state: &State) -> Result<Self> {
        let supervision = state.regime.supervision();
        Ok(Self {
            uses: reader.label_uses(row.id)?,
            n_shapes: reader.n_shapes(row.id)?,
            kept: supervision.map_or_else(Vec::new, |s| s.discovered().kept.clone()),
        })
    }

    fn info(&self, row: LabelRow) -> LabelInfo {
        let (n_shapes, area) = self.uses.get(&row.id).copied().unwrap_or_default();
        LabelInfo {
            unclaimed: row.name.is_none()
                && row.merged_into.is_none()
                && self.kept.contains(&row.id),
            id: row.id,
            name: row.name,
            colour: row.colour,
            merged_into: row.merged_into,
            n_shapes,
            area_share: area / self.n_shapes.max(1) as f64,
        }
    }
}

/// Counts the shapes of a collection by verdict.
fn review_counts(reader: &Reader<'_>, id: CollectionId) -> Result<[(ReviewState, u64); 4]> {
    let mut counts = ReviewState::ALL.map(|state| (state, 0));
    let mut n_unseen = reader.n_shapes(id)?;
    for (state, n) in &mut counts {
        let n_given = reader.n_reviews(id, state.name())?;
        let n_implied = match state {
            ReviewState::Corrected => reader.n_pinned_without_review(id)?,
            _ => 0,
        };
        *n = n_given + n_implied;
        n_unseen = n_unseen.saturating_sub(*n);
    }
    counts[0].1 += n_unseen;
    Ok(counts)
}

fn info(reader: &Reader<'_>, row: CollectionRow) -> Result<CollectionInfo> {
    let location = format!("collections {}", row.name);
    let labels = reader.labels(row.id)?.into_iter();
    let state = State::of(&row)?;
    let uses = LabelUses::new(reader, &row, &state)?;
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
        reviews: review_counts(reader, row.id)?,
        sequence: row.sequence,
        n_shapes: uses.n_shapes,
        n_stale: reader.n_stale(row.id)?,
        labels: labels.map(|l| uses.info(l)).collect(),
        spec: CollectionSpec {
            n_parts: row.n_parts,
            up: row.up.parse::<Up>().map_err(|e| damaged(&location, &e))?,
            operator: operator_from_name(&row.operator, &location)?,
            working_faces: row.working_faces,
            name: row.name,
        },
    })
}
