//! Another up axis for a collection: what was derived along the old one is derived again along the new one.
//!
//! Descriptions are the same along every axis. What depends on it, five columns of face descriptors, is computed from them
//! whenever shapes are labelled; so the label model and the labels are all that has to follow.

use super::commit::{collection_row, event, label_change, put_relabelled};
use super::history::{Before, from_reply};
use super::lane::Lane;
use super::learnt::Learnt;
use super::place::next_recluster;
use super::relabel::Relabelled;
use super::rows::{CollectionState, to_json};
use super::{EventKind, Library, RequestKey, Result, Up};
use crate::pipeline::LabelChange;
use crate::store::{Digest, Tx};
use serde::{Deserialize, Serialize};

/// Kind of this change among those that can be undone.
const KIND_UP: &str = "up";

/// What became of a collection whose up axis was set.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct UpSet {
    /// Whether it was another one before; if not, nothing was done.
    pub changed: bool,
    /// Stored shapes whose labels wait to be recomputed.
    pub n_stale: u64,
    /// Sequence number of the collection after it.
    pub sequence: u64,
}

/// What changes with the up axis, before anything is written.
struct Turned {
    state: CollectionState,
    labels: NewLabelling,
}

/// How the labels of the collection follow.
enum NewLabelling {
    /// They stay: the same axis is in force as before, there is nothing to label, or nothing to learn from.
    Same,
    /// From the faces that persons labelled, once that has been learnt along the new axis.
    FromPersons,
    /// By a new clustering.
    Clustered {
        learnt: Box<Learnt>,
        scores: (f64, f64),
        changes: Vec<LabelChange>,
        relabelled: Vec<Relabelled>,
    },
}

impl Library {
    /// Sets which way is up in a collection. Where nobody has labelled faces its parts are clustered again, and the labels
    /// that are found along the new axis are taken; otherwise pinned faces keep their labels and all others follow from
    /// them. Shapes that remain to be done are stale afterwards. Can be undone.
    ///
    /// # Errors
    /// There is no such collection, or one of its shapes cannot be read.
    pub fn set_up(&self, collection: &str, up: Up, key: Option<&RequestKey>) -> Result<UpSet> {
        let request = Digest::of(format!("up {collection:?} {up}").as_bytes());
        let row = self.collection_row(collection)?;
        self.with_lane(row, |lane| {
            if let Some(reply) = self.answered(key, request)? {
                return from_reply(&reply);
            }
            let turned = match lane.up() == up {
                true => None,
                false => Some(self.turned(lane, up)?),
            };
            let reply = self.once(key, request, |tx| {
                let changed = turned.is_some();
                if let Some(turned) = turned {
                    put_turned(tx, lane, up, turned)?;
                }
                let done = UpSet {
                    changed,
                    n_stale: tx.n_stale(lane.row.id)?,
                    sequence: collection_row(tx, lane.row.id)?.sequence,
                };
                Ok(to_json(&done).into_bytes())
            })?;
            self.reload(lane)?;
            from_reply(&reply)
        })
    }

    /// What follows from another up axis.
    fn turned(&self, lane: &mut Lane, up: Up) -> Result<Turned> {
        let found = self.up_found(lane, up, None)?;
        let in_force = lane.learnt.as_ref().map(|l| l.model.up);
        let mut state = found.noted(lane.state.clone());
        if lane.shapes.is_empty() {
            // The next shape begins again, along the new axis.
            state.next_recluster = 0;
        }
        if lane.shapes.is_empty() || in_force == Some(found.axis) {
            let labels = NewLabelling::Same;
            return Ok(Turned { state, labels });
        }
        if let Some(teaching) = &lane.state.teaching {
            let mut again = self.relearnt(lane, teaching)?;
            if let Some(again) = again.as_mut().filter(|t| t.closed) {
                // What was discovered along the old axis is believed no longer: persons' labels are all there are.
                again.discovered.clear();
                again.discovered_labels.clear();
            }
            let labels = match again.is_some() {
                true => NewLabelling::FromPersons,
                false => NewLabelling::Same,
            };
            state.teaching = again.or(state.teaching);
            return Ok(Turned { state, labels });
        }
        // The labels that are there were found along an axis that a person calls wrong: they do not compete.
        let clustered = self.cluster(lane, up, f64::NEG_INFINITY, None)?;
        let outcome = clustered.outcome;
        let ordinals = clustered.chosen.iter().map(|at| lane.shapes[*at].ordinal);
        let state = clustered.up.noted(CollectionState {
            next_recluster: next_recluster(lane.shapes.len() as u64),
            representatives: ordinals.collect(),
            epoch_ordinal: lane.row.next_ordinal - 1,
            ..CollectionState::default()
        });
        let new: Vec<_> = clustered
            .known
            .into_iter()
            .zip(outcome.labellings)
            .collect();
        let labels = NewLabelling::Clustered {
            relabelled: self.finish_relabelled(&new, &outcome.model.labels)?,
            learnt: Box::new(Learnt::begin(outcome.model)),
            scores: outcome.scores,
            changes: outcome.changes,
        };
        Ok(Turned { state, labels })
    }
}

/// Writes another up axis with all that follows at once.
fn put_turned(tx: &Tx<'_>, lane: &Lane, up: Up, turned: Turned) -> Result<()> {
    let id = lane.row.id;
    let (from, to) = (lane.row.up.clone(), up.to_string());
    let before = Before::up(tx, lane)?;
    let detail = to_json(&serde_json::json!({ "from": from, "to": to }));
    tx.insert_correction(id, KIND_UP, &detail, &before.encode())?;
    tx.set_parameters(id, lane.row.n_parts, &to)?;
    event(tx, id, &EventKind::UpChanged { from, to })?;
    match turned.labels {
        NewLabelling::Same => {}
        NewLabelling::FromPersons => tx.mark_all_stale(id).map(|_| ())?,
        NewLabelling::Clustered {
            learnt,
            scores,
            changes,
            mut relabelled,
        } => {
            for change in &changes {
                label_change(tx, id, change)?;
            }
            let kind = EventKind::Reclustered {
                score_before: scores.0.is_finite().then_some(scores.0),
                score_after: scores.1,
                accepted: true,
            };
            event(tx, id, &kind)?;
            let epoch = learnt.model.epoch;
            for shape in &mut relabelled {
                put_relabelled(tx, id, shape, &[], epoch)?;
            }
            tx.mark_stale_before(id, epoch)?;
            tx.set_model(id, &learnt.encode())?;
            tx.set_epoch(id, epoch)?;
        }
    }
    Ok(tx.set_state(id, to_json(&turned.state).as_bytes())?)
}
