//! Makes a proposal that a person chose the labels of a collection.

use super::discovered::MAX_REPRESENTATIVES;
use super::state::Epoch;
use super::{Collection, ModelState, Staleness, State};
use crate::labels::{DiscoveryOptions, Proposal};
use crate::library::change::Change;
use crate::library::error::Result;
use crate::library::labelling::{Relabelled, cause, face_ids, new_labels_of};
use crate::library::linked::Linked;
use crate::library::sources::{Known, Sources};
use crate::pipeline::{ReclusterOptions, Representative, adopt};

/// Returns the shapes that proposals divide, in the order of their digests: the representatives
/// when clustering was last due.
pub(in crate::library) fn divided(collection: &Collection) -> Vec<usize> {
    let newest = collection.state().clustered_ordinal();
    let all = collection.representatives(collection.shapes().len());
    let known = all.into_iter();
    let old = known.filter(|at| collection.shapes()[*at].ordinal <= newest);
    old.take(MAX_REPRESENTATIVES).collect()
}

/// Returns the change that makes a division of the shapes `at`, none of which may be stale, the
/// labels. They are the representatives of a new epoch, and all other shapes become stale.
pub(in crate::library) fn choose(
    collection: &Collection,
    sources: &dyn Sources,
    at: &[usize],
    division: Proposal,
) -> Result<Change> {
    let shapes = collection.shapes();
    let known = at.iter().map(|at| sources.known(shapes[*at].id));
    let known: Vec<Known> = known.collect::<Result<_>>()?;
    let old = collection.label_model();
    let stored: Vec<&Known> = known.iter().collect();
    let links = Linked::new(sources, &sources.links(collection.id())?)?;
    let ids: Vec<Vec<u32>> = known
        .iter()
        .map(|k| face_ids(&k.labels.proxy_labels))
        .collect();
    let representatives: Vec<Representative<'_>> = known
        .iter()
        .zip(&ids)
        .map(|(k, labels)| Representative {
            shape: k.view(),
            labels,
        })
        .collect();
    let options = ReclusterOptions {
        discovery: DiscoveryOptions::default(),
        up: old.and_then(|m| m.up),
        min_gain: f64::NEG_INFINITY,
        next_label: collection.row().next_label,
        links: links.demands(sources, &stored, &[]),
    };
    let n_labels = division.n_labels as u32;
    let epoch = old.map_or(0, |m| m.epoch) + 1;
    let outcome = adopt(&representatives, old, epoch, &options, division);
    drop(representatives);
    let model = outcome.model;
    let mut relabelled = Vec::new();
    for (known, labelling) in known.iter().zip(&outcome.labellings) {
        let labels = new_labels_of(sources, known, labelling, (&model.labels, model.epoch))?;
        relabelled.push(Relabelled::new(known, labels, cause::CHOICE));
    }
    let state = State {
        epoch: Epoch {
            representatives: at.iter().map(|at| shapes[*at].ordinal).collect(),
            last_ordinal: collection.row().next_ordinal - 1,
            silent: Vec::new(),
        },
        clustered: Some(collection.state().clustered_ordinal()),
        chosen: Some(n_labels),
        ..collection.state().clone()
    };
    Ok(Change {
        labels: outcome.changes.into_iter().map(Into::into).collect(),
        relabelled,
        model: Some(ModelState::begin(model)),
        state: Some(state),
        staleness: Staleness::AllOthers,
        ..Change::default()
    })
}
