//! A described shape and a collection become labels, without a store: the steps that placing
//! commits (`placing.rs`), and that a bundle computes without a library (`bundle`).

use super::collection::discovered::{self, NewShape, Plan};
use super::collection::{Collection, supervised};
use super::error::Result;
use super::labelling::{NewLabels, Original, new_labels};
use super::sources::{FileView, Sources};
use super::voting::Voted;
use crate::pipeline::Labelling;

/// A labelled shape that is not stored.
#[derive(Debug)]
pub(super) struct Placement {
    /// What its addition would change.
    pub(super) plan: Plan,
    pub(super) labels: NewLabels,
    /// Number of maps that votes came through.
    pub(super) n_maps: usize,
}

/// Returns the stored shapes whose labels must be up to date before [`label`] uses them.
pub(super) fn voters(
    collection: &Collection,
    sources: &dyn Sources,
    shape: FileView<'_>,
) -> Result<Vec<usize>> {
    let is_supervised = collection.state().regime.supervision().is_some();
    if is_supervised || collection.model().is_none() {
        return Ok(Vec::new());
    }
    discovered::sources_for(collection, sources, shape)
}

/// Labels a new shape through maps from the shapes `nearest` that [`voters`] returned or, after a
/// person labelled faces, from training shapes. The model must be fitted. Returns `None` without a
/// model.
pub(super) fn label(
    collection: &Collection,
    sources: &dyn Sources,
    shape: FileView<'_>,
    nearest: &[usize],
) -> Result<Option<Voted>> {
    if collection.state().regime.supervision().is_some() {
        return supervised::label_new(collection, sources, shape);
    }
    discovered::label_new(collection, sources, shape, nearest)
}

/// Returns whether [`plan`] clusters the representatives, none of which may be stale then.
pub(super) fn clusters(collection: &Collection) -> bool {
    let is_supervised = collection.state().regime.supervision().is_some();
    match collection.model() {
        None => true,
        Some(_) => !is_supervised && discovered::is_due(collection),
    }
}

/// Returns the plan of the addition of a shape that [`label`] labelled. `lost_training`: it
/// replaces a training shape.
pub(super) fn plan(
    collection: &Collection,
    sources: &dyn Sources,
    new: &NewShape<'_>,
    labelling: Option<Labelling>,
    lost_training: bool,
) -> Result<Plan> {
    let is_supervised = collection.state().regime.supervision().is_some();
    match (labelling, collection.model()) {
        (Some(labelling), Some(model)) if is_supervised => {
            supervised::plan(collection, sources, model, labelling, lost_training)
        }
        (labelling, _) => discovered::plan(collection, sources, new, labelling),
    }
}

/// Returns the labels of the new shape's polygons that follow from its plan.
pub(super) fn labels(
    sources: &dyn Sources,
    new: &NewShape<'_>,
    plan: &Plan,
    format: &str,
) -> Result<NewLabels> {
    let model = &plan.model.model;
    let original = Original {
        digest: &new.digest,
        format,
    };
    let ids = (&model.labels[..], model.epoch);
    new_labels(sources, new.arrays, &plan.labelling, ids, original)
}

/// Does all steps for a collection without stale shapes.
pub(super) fn placement(
    collection: &Collection,
    sources: &dyn Sources,
    new: &NewShape<'_>,
    format: &str,
) -> Result<Placement> {
    let nearest = voters(collection, sources, new.arrays)?;
    let voted = label(collection, sources, new.arrays, &nearest)?;
    let (labelling, voters, maps) = Voted::parts(voted);
    let plan = plan(collection, sources, new, labelling, false)?;
    let labels = labels(sources, new, &plan, format)?.voted_by(&voters);
    Ok(Placement {
        plan,
        labels,
        n_maps: maps.len(),
    })
}
