//! What a person changed can be undone: the state of the collection before each change, and the way back.

use super::commit::{collection_row, event};
use super::lane::Lane;
use super::relabel::{cause, moves};
use super::rows::{CollectionState, damaged, from_json, to_json};
use super::{EventKind, Library, LibraryError, RequestKey, Result};
use crate::store::{
    CorrectionRow, Digest, LabelRow, LabelSummary, LabelVersionRow, Reader, ShapeId,
};
use serde::{Deserialize, Serialize};

/// What was undone.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Undone {
    /// The change: `correct`, `name`, `merge`, `split` or `up`.
    pub change: String,
    /// Changes by a person that can still be undone.
    pub n_left: u64,
    /// Sequence number of the collection after it.
    pub sequence: u64,
}

/// A collection as it was before a change by a person.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Before {
    labels: Vec<StoredLabel>,
    /// `None`: the change concerns names only.
    rest: Option<Rest>,
    /// Which way was up, if the change concerns that.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    up: Option<String>,
    #[serde(skip)]
    model: Vec<u8>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct StoredLabel {
    id: u32,
    name: Option<String>,
    colour: [u8; 3],
    merged_into: Option<u32>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Rest {
    state: CollectionState,
    epoch: u64,
    /// Shapes of this ordinal and above came later.
    next_ordinal: u64,
    /// Shapes whose labels waited to be recomputed.
    stale: Vec<i64>,
    /// Pinned faces of the shapes that the change touches.
    pins: Vec<(i64, Option<Vec<i32>>)>,
}

impl Before {
    /// Before a label gets a name.
    pub(super) fn names(labels: Vec<LabelRow>) -> Self {
        Self {
            labels: labels.into_iter().map(StoredLabel::from).collect(),
            rest: None,
            up: None,
            model: Vec::new(),
        }
    }

    /// Before another way is up.
    pub(super) fn up(reader: &Reader<'_>, lane: &Lane) -> Result<Self> {
        Ok(Self {
            up: Some(lane.row.up.clone()),
            ..Self::labels(reader, lane, &[])?
        })
    }

    /// Before a change that touches the pinned faces of `shapes`.
    pub(super) fn labels(reader: &Reader<'_>, lane: &Lane, shapes: &[ShapeId]) -> Result<Self> {
        let stale = reader.stale_shapes(lane.row.id)?;
        let pins = shapes.iter().map(|s| Ok((s.0, reader.pins(*s)?)));
        let rest = Rest {
            state: lane.state.clone(),
            epoch: lane.row.epoch,
            next_ordinal: lane.row.next_ordinal,
            stale: stale.into_iter().map(|s| s.0).collect(),
            pins: pins.collect::<Result<_>>()?,
        };
        Ok(Self {
            rest: Some(rest),
            model: reader.model(lane.row.id)?.unwrap_or_default(),
            ..Self::names(reader.labels(lane.row.id)?)
        })
    }

    /// Length of the text (u32), the text, the model.
    pub(super) fn encode(&self) -> Vec<u8> {
        let text = to_json(self);
        let n = u32::try_from(text.len()).expect("invariant: the state is less than 4 GiB");
        [&n.to_le_bytes(), text.as_bytes(), &self.model].concat()
    }

    fn decode(row: &CorrectionRow) -> Result<Self> {
        let place = format!("corrections {}", row.id);
        let bad = || damaged(&place, "before is cut");
        let (n, bytes) = row.before.split_first_chunk::<4>().ok_or_else(bad)?;
        let n = u32::from_le_bytes(*n) as usize;
        let (text, model) = bytes.split_at_checked(n).ok_or_else(bad)?;
        let text = std::str::from_utf8(text).map_err(|e| damaged(&place, &e.to_string()))?;
        let before: Self = from_json(text, &place)?;
        Ok(Self {
            model: model.to_vec(),
            ..before
        })
    }
}

impl From<LabelRow> for StoredLabel {
    fn from(row: LabelRow) -> Self {
        Self {
            id: row.id,
            name: row.name,
            colour: row.colour,
            merged_into: row.merged_into,
        }
    }
}

/// Labels of a shape as they were, ready to become the newest again.
struct Restored {
    shape: ShapeId,
    labels: LabelVersionRow,
    summary: LabelSummary,
    event: EventKind,
}

impl Library {
    /// Undoes the newest change that a person made to a collection: a correction, a name, a merge, a split or another up axis.
    /// Shapes have the labels again that they had before it; those that came since are labelled anew. May be repeated, back
    /// to the first change; cannot itself be undone.
    ///
    /// # Errors
    /// There is no such collection, or nothing to undo.
    pub fn undo(&self, collection: &str, key: Option<&RequestKey>) -> Result<Undone> {
        let request = Digest::of(format!("undo {collection:?}").as_bytes());
        let row = self.collection_row(collection)?;
        self.with_lane(row, |lane| {
            if let Some(reply) = self.answered(key, request)? {
                return from_reply(&reply);
            }
            let newest = self.store.catalog().read(|r| r.newest_correction(lane.row.id))?;
            let Some(newest) = newest else {
                return Err(LibraryError::FailedPrecondition {
                    reason: "NOTHING_TO_UNDO",
                    message: format!("nothing was corrected in collection {collection:?}, so nothing can be undone"),
                });
            };
            let before = Before::decode(&newest)?;
            let restored = match &before.rest {
                Some(rest) => self.restored(lane, newest.id, rest)?,
                None => Vec::new(),
            };
            let reply = self.once(key, request, |tx| {
                let id = lane.row.id;
                let undone = EventKind::Undone {
                    change: newest.kind.clone(),
                };
                event(tx, id, &undone)?;
                for label in tx.labels(id)? {
                    let old = before.labels.iter().find(|l| l.id == label.id);
                    match old {
                        Some(old) => tx.put_label(id, &old.clone().into())?,
                        // Its id is not used again, and stays resolvable.
                        None => {
                            event(tx, id, &EventKind::LabelRetired { label: label.id })?;
                        }
                    }
                }
                for mut shape in restored {
                    shape.labels.sequence = event(tx, id, &shape.event)?;
                    tx.put_labels(shape.shape, &shape.labels, &shape.summary)?;
                }
                if let Some(rest) = &before.rest {
                    for (shape, pins) in &rest.pins {
                        if tx.shape(ShapeId(*shape))?.is_some() {
                            tx.set_pins(ShapeId(*shape), pins.as_deref())?;
                        }
                    }
                    let mut state = rest.state.clone();
                    for shape in &lane.shapes {
                        let is_newer = shape.ordinal >= rest.next_ordinal;
                        let stale = is_newer || rest.stale.contains(&shape.id.0);
                        tx.set_stale(shape.id, stale)?;
                        if is_newer {
                            state.silent.push(shape.ordinal);
                        }
                    }
                    tx.set_state(id, to_json(&state).as_bytes())?;
                    tx.set_model(id, &before.model)?;
                    tx.set_epoch(id, rest.epoch)?;
                }
                if let Some(up) = &before.up {
                    tx.set_parameters(id, lane.row.n_parts, up)?;
                }
                // Only now: the labels above were not to be noted with an older change.
                tx.delete_correction(newest.id)?;
                let undone = Undone {
                    change: newest.kind.clone(),
                    n_left: tx.n_corrections(id)?,
                    sequence: collection_row(tx, id)?.sequence,
                };
                Ok(to_json(&undone).into_bytes())
            })?;
            self.reload(lane)?;
            from_reply(&reply)
        })
    }

    /// The labels that a change replaced, ready to be put back.
    fn restored(&self, lane: &Lane, correction: i64, rest: &Rest) -> Result<Vec<Restored>> {
        let kept = self.store.catalog().read(|r| r.labels_before(correction))?;
        let mut out = Vec::new();
        for old in kept {
            let is_there =
                |s: &&super::lane::KnownShape| s.id == old.shape && s.ordinal < rest.next_ordinal;
            if !lane.shapes.iter().any(|s| is_there(&s)) {
                continue;
            }
            let known = self.known(old.shape)?;
            let labels = self
                .store
                .catalog()
                .read(|r| r.labels_at(old.shape, old.version))?;
            let labels = labels.ok_or_else(|| {
                damaged(
                    "labels_before",
                    &format!("version {} of {} is gone", old.version, old.shape),
                )
            })?;
            let version = known.row.version + 1;
            let event = EventKind::LabelsChanged {
                shape: known.row.name.clone(),
                version,
                cause: cause::UNDO.into(),
                moves: moves(
                    &known.labels.polygon_labels,
                    &labels.polygon_labels,
                    known.mapped.view().polygon_area,
                ),
            };
            out.push(Restored {
                shape: old.shape,
                labels: LabelVersionRow {
                    version,
                    cause: cause::UNDO.into(),
                    ..labels
                },
                summary: old.summary,
                event,
            });
        }
        Ok(out)
    }

    /// The reply to a request that was answered before.
    pub(super) fn answered(
        &self,
        key: Option<&RequestKey>,
        request: Digest,
    ) -> Result<Option<Vec<u8>>> {
        let Some(key) = key else { return Ok(None) };
        let there = self.store.catalog().read(|r| {
            Ok::<_, LibraryError>(r.request(&key.client_id, &key.request_id)?.is_some())
        })?;
        // Compares the requests.
        there
            .then(|| self.once(Some(key), request, |_| Ok(Vec::new())))
            .transpose()
    }

    /// Reads the lane anew, after a change of many of its shapes.
    pub(super) fn reload(&self, lane: &mut Lane) -> Result<()> {
        let id = lane.row.id;
        *lane = self.store.catalog().read(|r| {
            let row = r.collection_by_id(id)?;
            let row = row.ok_or_else(|| damaged("collections", &format!("row {id} is gone")))?;
            Lane::load(r, row)
        })?;
        Ok(())
    }
}

impl From<StoredLabel> for LabelRow {
    fn from(label: StoredLabel) -> Self {
        Self {
            id: label.id,
            name: label.name,
            colour: label.colour,
            merged_into: label.merged_into,
        }
    }
}

/// A reply as it was stored.
pub(super) fn from_reply<T: for<'de> Deserialize<'de>>(reply: &[u8]) -> Result<T> {
    let text = std::str::from_utf8(reply).map_err(|e| damaged("requests", &e.to_string()))?;
    from_json(text, "requests")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_before_reads_back() {
        let label = LabelRow {
            id: 3,
            name: Some("leg".into()),
            colour: [1, 2, 3],
            merged_into: None,
        };
        let rest = Rest {
            state: CollectionState::default(),
            epoch: 4,
            next_ordinal: 9,
            stale: vec![7],
            pins: vec![(5, Some(vec![-1, 3])), (6, None)],
        };
        let before = Before {
            rest: Some(rest),
            model: vec![1, 2, 3],
            ..Before::names(vec![label])
        };
        let mut row = CorrectionRow {
            id: 1,
            kind: "correct".into(),
            detail_json: "{}".into(),
            before: before.encode(),
        };
        assert_eq!(Before::decode(&row).expect("decodes"), before);
        row.before.truncate(20);
        assert!(Before::decode(&row).is_err());
    }
}
