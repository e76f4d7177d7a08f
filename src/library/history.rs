//! Undoes the newest change that a person made to a collection.

use super::before::{Before, Rest};
use super::change::{Change, LabelEdit, LinkEdit, commit_once};
use super::collection::{Collection, State};
use super::error::{LibraryError, Result};
use super::event::EventKind;
use super::facade::Library;
use super::labelling::{NewLabels, Relabelled, cause};
use super::once::{Request, answered, from_reply};
use super::reason::Reason;
use super::rows::{damaged, to_json};
use super::sources::Sources;
use super::types::RequestKey;
use crate::store::{CorrectionRow, LabelsBefore, LinkRow, ReviewRow, ShapeId};
use serde::{Deserialize, Serialize};

/// The result of undoing a change.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Undone {
    /// The kind of change: `correct`, `answer`, `approve`, `doubt`, `name`, `merge`, `split`,
    /// `up`, `choose`, `same`, `differ` or `unlink`.
    pub change: String,
    /// What the change concerned: a shape, a label, an axis, a proposal or two parts; empty in a
    /// reply that an earlier version stored.
    #[serde(default)]
    pub subject: String,
    /// Number of changes by persons that can still be undone.
    pub n_left: u64,
    /// Sequence number of the collection after it.
    pub sequence: u64,
}

impl Library {
    /// Undoes the newest change that a person made to a collection: a correction, a name, a merge,
    /// a split, another up axis, the choice of a proposal or a link. Shapes get the labels back
    /// that they had before it; shapes that were added since are relabelled. Can be repeated, back
    /// to the first change. Cannot itself be undone.
    ///
    /// # Errors
    /// There is no such collection, or nothing to undo.
    pub fn undo(&self, collection: &str, key: Option<&RequestKey>) -> Result<Undone> {
        let request = Request::of(key, &format!("undo {collection:?}"));
        let row = self.collection_row(collection)?;
        self.with_collection(row, |collection| {
            if let Some(reply) = answered(&self.store, &request)? {
                return from_reply(&reply);
            }
            let id = collection.id();
            let newest = self.store.catalog().read(|r| r.newest_correction(id))?;
            let Some(newest) = newest else {
                let name = &collection.row().name;
                return Err(LibraryError::FailedPrecondition {
                    reason: Reason::NothingToUndo,
                    message: format!(
                        "nothing was corrected in collection {name:?}, so nothing can be undone"
                    ),
                });
            };
            let labels_before = self.store.catalog().read(|r| r.labels_before(newest.id))?;
            let change = undoing(collection, &self.store, &newest, labels_before)?;
            let reply = commit_once(&self.store, collection, change, &request, |tx, now| {
                let undone = Undone {
                    change: newest.kind.clone(),
                    subject: subject(&newest.detail_json),
                    n_left: tx.n_corrections(id)?,
                    sequence: now.row.sequence,
                };
                Ok(to_json(&undone).into_bytes())
            })?;
            from_reply(&reply)
        })
    }
}

/// Returns the subject of a change from its stored details.
fn subject(detail: &str) -> String {
    let detail: serde_json::Value = serde_json::from_str(detail).unwrap_or_default();
    let found = ["shape", "label", "from", "proposal", "parts"]
        .iter()
        .find_map(|key| detail.get(key));
    match found {
        Some(serde_json::Value::String(name)) => name.clone(),
        Some(value) => value.to_string(),
        None => String::new(),
    }
}

/// Returns the change that undoes the newest change by a person.
fn undoing(
    collection: &Collection,
    sources: &dyn Sources,
    newest: &CorrectionRow,
    labels_before: Vec<LabelsBefore>,
) -> Result<Change> {
    let before = Before::decode(newest)?;
    let mut change = Change {
        opening: Some(EventKind::Undone {
            change: newest.kind.clone(),
        }),
        up: before.up.clone(),
        undone: Some(newest.id),
        ..Change::default()
    };
    for label in sources.labels(collection.id())? {
        change.labels.push(match before.label(label.id) {
            Some(old) => LabelEdit::Restored(old),
            // Its id is not used again, and remains resolvable.
            None => LabelEdit::Retired(label.id),
        });
    }
    let is_there = |shape: ShapeId| collection.position(shape).is_some();
    if let Some(links) = before.stored_links() {
        change.links = link_edits(links, &sources.links(collection.id())?, &is_there);
    }
    let Some(rest) = &before.rest else {
        return Ok(change);
    };
    change.relabelled = restored(collection, sources, rest, labels_before)?;
    for (shape, pins) in &rest.pins {
        if collection.position(ShapeId(*shape)).is_some() {
            change.pins.push((ShapeId(*shape), pins.clone()));
        }
    }
    for (shape, review) in &rest.reviews {
        if collection.position(ShapeId(*shape)).is_some() {
            let review = review.clone().map(ReviewRow::from);
            change.reviews.push((ShapeId(*shape), review));
        }
    }
    let mut state: State = rest.state();
    for shape in collection.shapes() {
        let is_newer = shape.ordinal >= rest.next_ordinal;
        let is_stale = is_newer || rest.stale.contains(&shape.id.0);
        change.stale.push((shape.id, is_stale));
        if is_newer {
            state.epoch.silent.push(shape.ordinal);
        }
    }
    change.state = Some(state);
    // Without a model before the change there were no shapes. The model of those added since stays.
    change.model = before.model()?;
    Ok(change)
}

/// Returns the edits that bring links back to those `before`, from those `now`. Links of shapes
/// that are not there any more stay away.
fn link_edits(
    before: Vec<LinkRow>,
    now: &[LinkRow],
    is_there: &dyn Fn(ShapeId) -> bool,
) -> Vec<LinkEdit> {
    let newer = now.iter().filter(|l| before.iter().all(|b| b.id != l.id));
    let mut edits: Vec<LinkEdit> = newer.map(|l| LinkEdit::TakenBack { id: l.id }).collect();
    let gone = before
        .into_iter()
        .filter(|b| now.iter().all(|l| l.id != b.id));
    let gone = gone.filter(|b| b.ends.iter().all(|e| is_there(e.shape)));
    edits.extend(gone.map(|row| LinkEdit::Restored { row }));
    edits
}

/// Returns the labels that a change replaced, as new versions.
fn restored(
    collection: &Collection,
    sources: &dyn Sources,
    rest: &Rest,
    labels_before: Vec<LabelsBefore>,
) -> Result<Vec<Relabelled>> {
    let mut out = Vec::new();
    for old in labels_before {
        let shapes = collection.shapes().iter();
        let mut older = shapes.filter(|s| s.ordinal < rest.next_ordinal);
        if !older.any(|s| s.id == old.shape) {
            continue;
        }
        let known = sources.known(old.shape)?;
        let row = sources.labels_at(old.shape, old.version)?;
        let gone = || {
            let message = format!("version {} of {} is gone", old.version, old.shape);
            damaged("labels_before", &message)
        };
        let labels = NewLabels {
            row: row.ok_or_else(gone)?,
            summary: old.summary,
        };
        out.push(Relabelled::new(&known, labels, cause::UNDO));
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::LinkEnd;

    #[test]
    fn links_come_back_as_they_were_unless_their_shapes_are_gone() {
        let link = |id| LinkRow {
            id,
            kind: "same".into(),
            ends: [1, 2].map(|shape| LinkEnd {
                shape: ShapeId(shape),
                part: 0,
                polygons: vec![0],
            }),
            person: String::new(),
            unix_ms: 0,
        };
        let edits = |is_there| {
            let edits = link_edits(vec![link(3), link(4)], &[link(4), link(5)], &|_| is_there);
            format!("{edits:?}")
        };
        let restored = format!("[TakenBack {{ id: 5 }}, Restored {{ row: {:?} }}]", link(3));
        assert_eq!(edits(true), restored);
        assert_eq!(edits(false), "[TakenBack { id: 5 }]");
    }
}
