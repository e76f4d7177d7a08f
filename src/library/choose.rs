//! Makes the proposal that a person chooses the labels of a collection.

use super::advance::relabel_all;
use super::change::{Change, Undoable, commit_once};
use super::collection::{Collection, Regime, chosen};
use super::error::{LibraryError, Result};
use super::event::EventKind;
use super::facade::Library;
use super::once::{Request, answered, from_reply};
use super::proposals::{StoredProposals, division, nothing_proposed, stored};
use super::reason::Reason;
use super::rows::to_json;
use super::types::RequestKey;
use crate::store::{ProposalRow, ShapeId};
use serde::{Deserialize, Serialize};

/// The result of choosing a proposal.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Chosen {
    /// Number of labels of the proposal.
    pub n_labels: u32,
    /// Stored shapes whose labels wait to be recomputed from it.
    pub n_stale: u64,
    /// Sequence number of the collection after it.
    pub sequence: u64,
}

impl Library {
    /// Makes a proposal the labels of a collection. The shapes that it divides get their labels in
    /// one commit, all others are relabelled from them. Label ids are taken over by area. From then
    /// on, clustering makes new proposals, but no new labels. Can be undone.
    ///
    /// `set` is [`Proposals::set`](super::Proposals::set) of the list that the person saw; empty:
    /// the newest ones.
    ///
    /// # Errors
    /// There is no such collection or proposal; other ones were made since; or a person has
    /// labelled the collection, whose labels follow from that.
    pub fn choose(
        &self,
        collection: &str,
        n: u32,
        set: &str,
        key: Option<&RequestKey>,
    ) -> Result<Chosen> {
        let request = Request::of(key, &format!("choose {collection:?} {n} {set:?}"));
        let row = self.collection_row(collection)?;
        self.with_collection(row, |collection| {
            if let Some(reply) = answered(&self.store, &request)? {
                return from_reply(&reply);
            }
            let (change, n_labels) = self.choice(collection, n, set)?;
            let reply = commit_once(&self.store, collection, change, &request, |tx, now| {
                let done = Chosen {
                    n_labels,
                    n_stale: tx.n_stale(now.row.id)?,
                    sequence: now.row.sequence,
                };
                Ok(to_json(&done).into_bytes())
            })?;
            from_reply(&reply)
        })
    }

    /// Returns the change that makes a proposal the labels, and the number of its labels.
    fn choice(&self, collection: &mut Collection, n: u32, set: &str) -> Result<(Change, u32)> {
        let name = collection.row().name.clone();
        if collection.state().regime != Regime::Discovering {
            return Err(LibraryError::FailedPrecondition {
                reason: Reason::LabelledByPerson,
                message: format!(
                    "a person labelled collection {name:?}, and its labels follow from that; \
                     a proposal can be chosen after these changes are undone"
                ),
            });
        }
        let id = collection.id();
        let stored = self.store.catalog().read(|r| stored(r, id))?;
        let stored = stored.ok_or_else(|| nothing_proposed(collection.row()))?;
        if !set.is_empty() && set != stored.set {
            return Err(LibraryError::FailedPrecondition {
                reason: Reason::ProposalsChanged,
                message: format!(
                    "collection {name:?} has other proposals now than set {set:?}; list them again"
                ),
            });
        }
        let row = stored.find(&name, n)?;
        let (at, kept) = self.kept(collection, &stored)?;
        if at.is_empty() {
            return Err(nothing_proposed(collection.row()));
        }
        relabel_all(&self.store, collection, &at)?;
        let division = division(&stored, row, &kept);
        let change = chosen::choose(collection, &self.store, &at, division)?;
        let change = Change {
            undoable: Some(Undoable::Choose { proposal: n }),
            opening: Some(event(row)),
            ..change
        };
        Ok((change, row.n_labels))
    }

    /// Returns the indices of the divided shapes that are still there, and which these are.
    fn kept(
        &self,
        collection: &Collection,
        stored: &StoredProposals,
    ) -> Result<(Vec<usize>, Vec<bool>)> {
        let (mut at, mut kept) = (Vec::new(), Vec::new());
        for (id, n_faces) in stored.basis.shapes.iter().zip(&stored.n_faces) {
            let id = ShapeId(*id);
            let found = match self.divided_shape(id, *n_faces)? {
                Some(_) => collection.position(id),
                None => None,
            };
            kept.push(found.is_some());
            at.extend(found);
        }
        Ok((at, kept))
    }
}

fn event(row: &ProposalRow) -> EventKind {
    EventKind::Chosen {
        proposal: row.n,
        n_labels: row.n_labels,
        value: row.value,
    }
}
