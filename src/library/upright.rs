//! Changes the up axis of a collection, and derives its labels again along the new one.
//!
//! Descriptions do not depend on the axis. Five columns of face descriptors do, and are computed
//! from descriptions whenever shapes are labelled; so only the label model and the labels must
//! follow.

use super::advance::relabel_all;
use super::change::{Change, Undoable, commit_once};
use super::collection::discovered;
use super::collection::up::UpFound;
use super::collection::{Collection, Regime, Staleness, supervised};
use super::error::Result;
use super::event::EventKind;
use super::facade::Library;
use super::once::{Request, answered, from_reply};
use super::rows::to_json;
use super::sources::Sources;
use super::types::{RequestKey, Up};
use serde::{Deserialize, Serialize};

/// The result of setting the up axis of a collection.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct UpSet {
    /// Whether the axis was another one before; if not, nothing was done.
    pub changed: bool,
    /// Stored shapes whose labels wait to be recomputed.
    pub n_stale: u64,
    /// Sequence number of the collection after it.
    pub sequence: u64,
}

impl Library {
    /// Sets the up axis of a collection. If nobody has labelled faces, its parts are clustered
    /// again, and the labels that are found along the new axis are accepted. Otherwise pinned faces
    /// keep their labels, and all others follow from them. Shapes that remain to be relabelled are
    /// stale afterwards. Can be undone.
    ///
    /// # Errors
    /// There is no such collection, or one of its shapes cannot be read.
    pub fn set_up(&self, collection: &str, up: Up, key: Option<&RequestKey>) -> Result<UpSet> {
        let request = Request::of(key, &format!("up {collection:?} {up}"));
        let row = self.collection_row(collection)?;
        self.with_collection(row, |collection| {
            if let Some(reply) = answered(&self.store, &request)? {
                return from_reply(&reply);
            }
            let changed = collection.up() != up;
            let change = match changed {
                true => self.turned(collection, up)?,
                false => Change::default(),
            };
            let reply = commit_once(&self.store, collection, change, &request, |tx, now| {
                let done = UpSet {
                    changed,
                    n_stale: tx.n_stale(now.row.id)?,
                    sequence: now.row.sequence,
                };
                Ok(to_json(&done).into_bytes())
            })?;
            from_reply(&reply)
        })
    }

    /// Returns the change that follows from another up axis.
    fn turned(&self, collection: &mut Collection, up: Up) -> Result<Change> {
        let found = discovered::up_found(collection, &self.store, up, None)?;
        let in_force = collection.label_model().map(|m| m.up);
        let is_same = collection.shapes().is_empty() || in_force == Some(found.axis);
        let is_supervised = collection.state().regime.supervision().is_some();
        let change = if is_same || is_supervised {
            without_clustering(collection, &self.store, found, is_same)?
        } else {
            let links = self.store.links(collection.id())?;
            let chosen = discovered::representatives(collection, &links);
            relabel_all(&self.store, collection, &chosen)?;
            discovered::turn(collection, &self.store, up)?
        };
        let (from, to) = (collection.row().up.clone(), up.to_string());
        Ok(Change {
            undoable: Some(Undoable::Up {
                from: from.clone(),
                to: to.clone(),
            }),
            up: Some(to.clone()),
            opening: Some(EventKind::UpChanged { from, to }),
            ..change
        })
    }
}

/// Returns the change if nothing is clustered. With `is_same`, labels stay, because there are no
/// shapes, or the same axis is in force as before. Otherwise labels follow from the training
/// shapes, once the model is fitted along the new axis.
fn without_clustering(
    collection: &Collection,
    sources: &dyn Sources,
    found: UpFound,
    is_same: bool,
) -> Result<Change> {
    let mut state = collection.state().clone().with_up(&found);
    if collection.shapes().is_empty() {
        // The next shape begins the collection again, along the new axis.
        state.next_recluster = 0;
    }
    let mut staleness = Staleness::AsLabelled;
    let refit = match is_same {
        true => None,
        false => supervised::refit(collection, sources, None)?,
    };
    if let Some(supervision) = refit {
        // Where a person labelled whole shapes, labels that were discovered along the old axis
        // count no longer.
        state.regime = Regime::Supervised(match supervision.is_open() {
            true => supervision,
            false => supervision.without_discovered(),
        });
        staleness = Staleness::All;
    }
    Ok(Change {
        staleness,
        state: Some(state),
        ..Change::default()
    })
}
