//! Labels every shape on its own, after a person has labelled faces: by the votes of the nearest
//! training shapes and of the shapes to which the model was fitted, and by that model, which stays
//! until the training shapes change.

use super::discovered::{MAX_MAPS, Plan, next_recluster};
use super::state::{Discovered, Regime, Supervision, Vocabulary};
use super::{Collection, ModelState, Staleness, State};
use crate::fmap::FunctionalMap;
use crate::labels::LabelModel;
use crate::library::change::{Change, map_row};
use crate::library::error::Result;
use crate::library::labelling::{NewLabels, Relabelled, area_shares, cause, new_labels_of};
use crate::library::pins::{Instead, pin_polygons, pinned_faces, pins_of, used_labels};
use crate::library::sources::{FileView, Known, Sources};
use crate::library::voting::{
    IncomingMap, PreparedShape, Voted, Voter, new_map, new_maps, one_hot, rank_candidates,
    sources_of, votes,
};
use crate::pipeline::{FitOptions, Labelling, label_fitted};
use crate::store::ShapeId;
use rayon::prelude::*;

/// Maximum number of training shapes that vote for one shape. Shapes to which the model was fitted
/// fill up to [`MAX_MAPS`].
const MAX_TRAINING_VOTES: usize = 3;

/// Returns the discovered labels that remain evidence when discovery ends.
pub(in crate::library) fn discovered(
    collection: &Collection,
    sources: &dyn Sources,
) -> Result<Discovered> {
    let mut discovered = Discovered::default();
    if let Some(model) = collection.label_model() {
        discovered.labels.clone_from(&model.labels);
        let representatives = &collection.state().epoch.representatives;
        let shapes = collection.shapes().iter();
        for shape in shapes.filter(|s| representatives.contains(&s.ordinal) && !s.stale) {
            let version = sources.version(shape.id)?;
            discovered.versions.push((shape.ordinal, version));
        }
    }
    Ok(discovered)
}

/// Returns the state after a person labelled faces: the model must be fitted.
pub(in crate::library) fn corrected(
    collection: &Collection,
    sources: &dyn Sources,
    vocabulary: Vocabulary,
) -> Result<State> {
    let supervision = match collection.state().regime.supervision() {
        Some(supervision) => supervision.clone().outdated(vocabulary),
        None => Supervision::begun(vocabulary, discovered(collection, sources)?),
    };
    Ok(with(collection, supervision))
}

/// Returns the supervision after a person renamed labels: discovery has ended, and the model stays.
pub(in crate::library) fn renamed(
    collection: &Collection,
    sources: &dyn Sources,
) -> Result<Supervision> {
    Ok(match collection.state().regime.supervision() {
        Some(supervision) => supervision.clone(),
        None => Supervision::renamed(discovered(collection, sources)?),
    })
}

/// Returns the collection's state under another supervision.
pub(in crate::library) fn with(collection: &Collection, supervision: Supervision) -> State {
    State {
        regime: Regime::Supervised(supervision),
        ..collection.state().clone()
    }
}

/// Returns the supervision under which the model is fitted again, after shapes were added or, with
/// `removed`, a training shape was removed. Returns `None` if there is nothing to fit to; then the
/// model stays.
pub(in crate::library) fn refit(
    collection: &Collection,
    sources: &dyn Sources,
    removed: Option<ShapeId>,
) -> Result<Option<Supervision>> {
    let Some(supervision) = collection.state().regime.supervision() else {
        return Ok(None);
    };
    let used = used_labels(collection, sources, removed.map(Instead::Removed))?;
    let is_discovered = supervision.is_open() && !supervision.discovered().labels.is_empty();
    let can_fit = !used.labels.is_empty() || is_discovered;
    Ok(can_fit.then(|| supervision.clone().outdated(used.vocabulary)))
}

/// Labels a new shape by a fitted model. Returns `None` if the collection is not supervised.
pub(in crate::library) fn label_new(
    collection: &Collection,
    sources: &dyn Sources,
    shape: FileView<'_>,
) -> Result<Option<Voted>> {
    let supervised = collection.state().regime.supervision().is_some();
    let Some(model) = collection.model().filter(|_| supervised) else {
        return Ok(None);
    };
    let voters = voters(collection, sources, shape, None)?;
    let shape = PreparedShape::new(sources, shape, &model.model);
    let maps = new_maps(sources, &voters, &shape, &model.model);
    let incoming: Vec<IncomingMap> = maps.iter().map(IncomingMap::from).collect();
    let labelling = labelled(&shape, model, &voters, &incoming, &[]);
    Ok(Some(Voted::new(labelling, &voters, maps)))
}

/// Returns the plan of an addition with its labelling. `lost_training`: the shape replaces a
/// training shape.
pub(in crate::library) fn plan(
    collection: &Collection,
    sources: &dyn Sources,
    model: &ModelState,
    labelling: Labelling,
    lost_training: bool,
) -> Result<Plan> {
    let n_shapes = collection.shapes().len() as u64 + 1;
    let has_grown = n_shapes >= collection.state().next_recluster;
    let mut state = collection.state().clone();
    if has_grown {
        state.next_recluster = next_recluster(n_shapes);
    }
    let mut staleness = Staleness::AsLabelled;
    if (has_grown || lost_training)
        && let Some(supervision) = refit(collection, sources, None)?
    {
        state.regime = Regime::Supervised(supervision);
        staleness = Staleness::All;
    }
    Ok(Plan {
        model: model.clone(),
        state,
        labelling,
        relabelled: Vec::new(),
        changes: Vec::new(),
        reclustered: None,
        staleness,
    })
}

/// Relabels a stale shape by a fitted model. Returns `None` if it is not stale.
pub(in crate::library) fn relabel(
    collection: &Collection,
    sources: &dyn Sources,
    at: usize,
) -> Result<Option<Change>> {
    let shape = &collection.shapes()[at];
    let Some(model) = collection.model().filter(|_| shape.stale) else {
        return Ok(None);
    };
    let pins = match shape.pinned {
        true => pins_of(sources, shape.id)?,
        false => Vec::new(),
    };
    if !pins.is_empty() && pins.iter().all(|p| *p >= 0) {
        return Ok(Some(Change {
            stale: vec![(shape.id, false)],
            ..Change::default()
        }));
    }
    let known = sources.known(shape.id)?;
    let prepared = PreparedShape::new(sources, known.file(), &model.model);
    let voters = voters(collection, sources, known.file(), Some(at))?;
    let maps = maps_into(sources, &voters, &known, &prepared, &model.model)?;
    let pinned = pinned_faces(&prepared.view, &pins, &model.model.labels);
    let incoming: Vec<IncomingMap> = maps.iter().map(|(m, _)| m.clone()).collect();
    let labelling = labelled(&prepared, model, &voters, &incoming, &pinned);
    let labels = propagated(sources, &known, &labelling, &model.model, &pins)?;
    let labels = labels.voted_by(&sources_of(&voters, &labelling.weights));
    let new = voters.iter().zip(&maps);
    let new = new.filter_map(|(voter, (_, new))| {
        let from = voter.known.row.id;
        new.as_ref().map(|map| map_row(from, shape.id, map))
    });
    Ok(Some(Change {
        maps: new.collect(),
        relabelled: vec![Relabelled::new(&known, labels, cause::PROPAGATION)],
        ..Change::default()
    }))
}

/// Returns the labels of a stored shape that follow from a labelling and from its pins.
pub(in crate::library) fn propagated(
    sources: &dyn Sources,
    known: &Known,
    labelling: &Labelling,
    model: &LabelModel,
    pins: &[i32],
) -> Result<NewLabels> {
    let mut new = new_labels_of(sources, known, labelling, (&model.labels, model.epoch))?;
    if !pins.is_empty() {
        pin_polygons(&mut new.row, pins);
        new.summary.area_shares = area_shares(&known.view(), &new.row.polygon_labels);
    }
    Ok(new)
}

/// Returns the shapes that vote for a shape, itself excluded: training shapes, and shapes to which
/// the model was fitted.
fn voters(
    collection: &Collection,
    sources: &dyn Sources,
    shape: FileView<'_>,
    exclude: Option<usize>,
) -> Result<Vec<Voter>> {
    let supervision = collection.state().regime.supervision();
    let (Some(supervision), Some(model)) = (supervision, collection.label_model()) else {
        return Ok(Vec::new());
    };
    let shapes = collection.shapes();
    let nearest = |wanted: &dyn Fn(usize) -> bool, limit: usize| {
        let among: Vec<usize> = (0..shapes.len())
            .filter(|at| Some(*at) != exclude && wanted(*at))
            .collect();
        rank_candidates(collection, sources, shape, &among, limit)
    };
    let is_trained = |at: usize| supervision.trained().contains(&shapes[at].ordinal);
    let training = nearest(&|at| shapes[at].pinned, MAX_TRAINING_VOTES)?;
    let others = nearest(
        &|at| !shapes[at].pinned && is_trained(at),
        MAX_MAPS - training.len(),
    )?;
    let trust = FitOptions::default().training_trust;
    let mut voters = Vec::new();
    for at in training.into_iter().chain(others) {
        let known = sources.known(shapes[at].id)?;
        if !shapes[at].pinned {
            voters.push(Voter::new(known, model));
            continue;
        }
        let pins = pins_of(sources, shapes[at].id)?;
        let classes = pinned_faces(&known.view(), &pins, &model.labels);
        let whole = classes.iter().all(Option::is_some);
        let probabilities = match is_trained(at) && !whole {
            true => None,
            false => Some(one_hot(&classes, model.labels.len())),
        };
        voters.push(Voter::training(known, probabilities, trust, model));
    }
    Ok(voters)
}

/// Returns the maps from the voters to a stored shape: the stored ones, and new ones, which are to
/// be stored.
fn maps_into(
    sources: &dyn Sources,
    voters: &[Voter],
    known: &Known,
    shape: &PreparedShape<'_>,
    model: &LabelModel,
) -> Result<Vec<(IncomingMap, Option<FunctionalMap>)>> {
    let mut stored = Vec::with_capacity(voters.len());
    for voter in voters {
        let row = sources.map(voter.known.row.id, known.row.id)?;
        stored.push(row.map(IncomingMap::of_row).transpose()?);
    }
    let maps = voters.par_iter().zip(stored).map(|(voter, stored)| {
        if let Some(stored) = stored {
            return (stored, None);
        }
        let new = new_map(sources, &voter.known, shape, model);
        (IncomingMap::from(&new), Some(new))
    });
    Ok(maps.collect())
}

/// Labels a shape by votes and the fitted model.
fn labelled(
    shape: &PreparedShape<'_>,
    model: &ModelState,
    voters: &[Voter],
    maps: &[IncomingMap],
    pinned: &[Option<u32>],
) -> Labelling {
    let fitted = (&model.model.statistics, model.prior.as_ref());
    let votes = votes(voters, maps);
    let options = FitOptions::default();
    label_fitted(
        &shape.view,
        &shape.prepared,
        fitted,
        &votes,
        pinned,
        &options,
    )
}
