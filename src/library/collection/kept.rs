//! Discovered labels that shapes can still have after a person labelled whole shapes: those that no
//! labelled face shows.

use super::Collection;
use super::state::{Supervision, Vocabulary};
use crate::library::change::LabelEdit;
use crate::library::rows::resolved;
use crate::library::types::LabelId;
use crate::pipeline::{DiscoveredLabels, LabelChange};
use crate::store::LabelRow;

/// The discovered labels that a fit keeps.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Kept {
    /// Id of each class behind those of the person.
    ids: Vec<LabelId>,
    /// Discovered labels with another id than before, because a person gave theirs to other faces:
    /// the index of each, its old id and its new one.
    renumbered: Vec<(usize, LabelId, LabelId)>,
}

impl Kept {
    /// Decides which of the discovered labels stay labels of their own beside those that persons
    /// `given`, and writes the classes that stand for them into `discovered`. Costs no cut.
    pub(super) fn decide(
        collection: &Collection,
        supervision: &Supervision,
        rows: &[LabelRow],
        given: &[LabelId],
        discovered: &mut DiscoveredLabels,
    ) -> Self {
        let labels = &supervision.discovered().labels;
        let n_shapes = supervision.discovered().versions.len();
        let not_shown = discovered
            .overlap
            .not_shown(&discovered.statistics, n_shapes);
        let mut kept = Self::default();
        let mut own = Vec::new();
        for at in not_shown.iter().copied() {
            let id = labels[at];
            if resolved(rows, id) != id || supervision.vocabulary() == Vocabulary::Closed {
                continue;
            }
            let taken = given.contains(&id);
            if taken && is_named(rows, id) {
                continue;
            }
            let stays = if taken {
                let new = collection.row().next_label + kept.renumbered.len() as u32;
                kept.renumbered.push((at, id, new));
                new
            } else {
                id
            };
            own.push((at, (given.len() + kept.ids.len()) as u32));
            kept.ids.push(stays);
        }
        // What a person merged into another label means that label.
        for at in not_shown {
            let into = resolved(rows, labels[at]);
            let class = given.iter().chain(&kept.ids).position(|l| *l == into);
            if let Some(class) = class.filter(|_| into != labels[at]) {
                own.push((at, class as u32));
            }
        }
        discovered.own = own;
        kept
    }

    /// Returns the ids of the classes behind those of the person.
    pub(super) fn ids(&self) -> &[LabelId] {
        &self.ids
    }

    /// Returns the supervision with the new ids of the discovered labels.
    pub(super) fn supervision(&self, supervision: Supervision) -> Supervision {
        let new = self.renumbered.iter().map(|(at, _, new)| (*at, *new));
        supervision.keeping(&self.ids, new)
    }

    /// Returns the edits that put the labels of a new model into use in place of those of an old
    /// one. A correction has put the labels of persons into use already.
    pub(super) fn edits(&self, old: &[LabelId], new: &[LabelId]) -> Vec<LabelEdit> {
        let mut edits = Vec::new();
        for (_, from, into) in &self.renumbered {
            let (from, into) = (*from, *into);
            edits.push(LabelChange::Created(into).into());
            edits.push(LabelChange::Split { from, into }.into());
        }
        let is_renumbered = |label: &LabelId| self.renumbered.iter().any(|r| r.2 == *label);
        let back = self.ids.iter().filter(|l| !old.contains(l));
        let back = back.filter(|l| !is_renumbered(l));
        edits.extend(back.map(|label| LabelEdit::Used(*label)));
        let gone = old.iter().filter(|l| !new.contains(l));
        edits.extend(gone.map(|label| LabelEdit::Retired(*label)));
        edits
    }
}

/// Returns whether a person named the label with this id.
fn is_named(rows: &[LabelRow], id: LabelId) -> bool {
    rows.iter().any(|l| l.id == id && l.name.is_some())
}
