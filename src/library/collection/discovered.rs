//! Discovers labels until a person changes some. A new shape is labelled by the votes of the
//! nearest shapes and by the label model. The parts of representatives are clustered again as the
//! collection grows.

use super::state::Epoch;
use super::up::UpFound;
use super::{Collection, ModelState, Staleness, State};
use crate::labels::DiscoveryOptions;
use crate::library::change::Change;
use crate::library::error::Result;
use crate::library::event::EventKind;
use crate::library::labelling::{Relabelled, cause, face_ids, new_labels_of};
use crate::library::linked::{Linked, linked_shapes};
use crate::library::sources::{FileView, Known, Sources};
use crate::library::types::Up;
use crate::library::voting::{
    IncomingMap, PreparedShape, Voted, Voter, new_maps, rank_candidates, sources_of, votes,
};
use crate::pipeline::{
    DescriptionView, LabelChange, Labelling, ReclusterOptions, Reclustering, Representative, label,
    recluster,
};
use crate::store::{Digest, LinkRow, ShapeId};

/// Maximum number of functional maps that one addition computes.
pub const MAX_MAPS: usize = 5;
/// Maximum number of stored shapes that one addition clusters together and therefore relabels.
/// Stale sources of the new shape add at most [`MAX_MAPS`] to it.
pub const MAX_REPRESENTATIVES: usize = 40;
/// Number of shapes below which a collection is too small to judge a labelling, so that the new one
/// is always accepted.
const TOO_FEW: usize = 5;
/// Least gain of a new labelling, once only a sample of the shapes is clustered: a quarter of a
/// nat, as if boundaries were a quarter more concave. The new labelling has no more evidence than
/// the labelling in force, which was found on as many shapes, and the best of hundreds of
/// candidates on another sample always seems a little better.
const SAMPLE_GAIN: f64 = 0.25;
/// Growth of a collection from one re-clustering to the next.
const RECLUSTER_GROWTH: f64 = 1.4;

/// A described shape that is not stored yet.
#[derive(Debug, Clone, Copy)]
pub(in crate::library) struct NewShape<'a> {
    pub(in crate::library) arrays: FileView<'a>,
    /// Digest of its original bytes.
    pub(in crate::library) digest: Digest,
}

/// What an addition changes, before boundaries are refined and anything is written.
#[derive(Debug)]
pub(in crate::library) struct Plan {
    pub(in crate::library) model: ModelState,
    pub(in crate::library) state: State,
    /// Labelling of the new shape, by the classes of `model`.
    pub(in crate::library) labelling: Labelling,
    /// Stored shapes with their new labellings.
    pub(in crate::library) relabelled: Vec<(Known, Labelling)>,
    pub(in crate::library) changes: Vec<LabelChange>,
    pub(in crate::library) reclustered: Option<EventKind>,
    pub(in crate::library) staleness: Staleness,
}

/// The representatives that were clustered together.
#[derive(Debug)]
pub(in crate::library) struct Clustered {
    /// Their indices in the collection.
    chosen: Vec<usize>,
    known: Vec<Known>,
    /// Position of the new shape among them.
    new_at: usize,
    /// Evidence of them about the up axis.
    up: UpFound,
    outcome: Reclustering,
}

/// Returns the least gain of a new labelling over the labelling in force in a collection of so many
/// shapes. It is zero while all shapes are clustered, each time with many new ones: a margin would
/// retain labels that were found with less evidence.
pub fn min_gain(n_shapes: usize) -> f64 {
    match n_shapes {
        0..=TOO_FEW => f64::NEG_INFINITY,
        n if n <= MAX_REPRESENTATIVES + 1 => 0.0,
        _ => SAMPLE_GAIN,
    }
}

/// Returns the number of shapes at which a collection is clustered next: 1, 2, 3, 4, 5, 7, 10, 14,
/// 20, 28, 39, 55, …
pub fn next_recluster(n_shapes: u64) -> u64 {
    if n_shapes < TOO_FEW as u64 {
        return n_shapes + 1;
    }
    (n_shapes as f64 * RECLUSTER_GROWTH).round() as u64
}

/// Returns the shapes that vote for a new one. They must not be stale then.
pub(in crate::library) fn sources_for(
    collection: &Collection,
    sources: &dyn Sources,
    shape: FileView<'_>,
) -> Result<Vec<usize>> {
    let all: Vec<usize> = (0..collection.shapes().len()).collect();
    rank_candidates(collection, sources, shape, &all, MAX_MAPS)
}

/// Maps the shapes `nearest` to a new one and labels it; `None` without a model.
pub(in crate::library) fn label_new(
    collection: &Collection,
    sources: &dyn Sources,
    shape: FileView<'_>,
    nearest: &[usize],
) -> Result<Option<Voted>> {
    let Some(model) = collection.label_model() else {
        return Ok(None);
    };
    let voter = |at: &usize| {
        let known = sources.known(collection.shapes()[*at].id)?;
        Ok(Voter::new(known, model))
    };
    let voters: Vec<Voter> = nearest.iter().map(voter).collect::<Result<_>>()?;
    let shape = PreparedShape::new(sources, shape, model);
    let maps = new_maps(sources, &voters, &shape, model);
    let incoming: Vec<IncomingMap> = maps.iter().map(IncomingMap::from).collect();
    let labelling = label(
        &shape.view,
        &shape.prepared,
        model,
        &votes(&voters, &incoming),
    );
    Ok(Some(Voted::new(labelling, &voters, maps)))
}

/// Returns whether the addition of one more shape clusters the collection again. It does not once
/// a person has chosen a proposal.
pub(in crate::library) fn is_due(collection: &Collection) -> bool {
    collection.state().chosen.is_none() && has_grown(collection)
}

fn has_grown(collection: &Collection) -> bool {
    collection.shapes().len() as u64 + 1 >= collection.state().next_recluster
}

/// Returns the plan of an addition. `labelling` is that of [`label_new`]. Where clustering is due,
/// no representative may be stale.
pub(in crate::library) fn plan(
    collection: &Collection,
    sources: &dyn Sources,
    new: &NewShape<'_>,
    labelling: Option<Labelling>,
) -> Result<Plan> {
    match (labelling, collection.model()) {
        (Some(labelling), Some(model)) if !is_due(collection) => {
            Ok(grown(collection, sources, model, labelling, new.arrays))
        }
        (labelling, _) => reclustered(collection, sources, new, labelling),
    }
}

/// Returns the plan of an addition without a re-clustering.
fn grown(
    collection: &Collection,
    sources: &dyn Sources,
    model: &ModelState,
    labelling: Labelling,
    shape: FileView<'_>,
) -> Plan {
    let mut model = model.clone();
    let mut state = collection.state().clone();
    if has_grown(collection) && state.chosen.is_some() {
        // New proposals are made, but none of them is accepted by itself.
        state.next_recluster = next_recluster(collection.shapes().len() as u64 + 1);
        state.clustered = Some(collection.row().next_ordinal);
    }
    let prepared = sources.prepared(shape, &model.model);
    let statistics = labelling.statistics(&prepared, model.model.labels.len());
    model.model.statistics.accumulate(&statistics, 1.0);
    Plan {
        model,
        state,
        labelling,
        relabelled: Vec::new(),
        changes: Vec::new(),
        reclustered: None,
        staleness: Staleness::AsLabelled,
    }
}

/// Clusters the parts of the representatives and the new shape again.
fn reclustered(
    collection: &Collection,
    sources: &dyn Sources,
    new: &NewShape<'_>,
    labelling: Option<Labelling>,
) -> Result<Plan> {
    let n_shapes = collection.shapes().len() + 1;
    let with = Some((new, labelling.as_ref()));
    let links = sources.links(collection.id())?;
    let up = collection.up();
    let found = cluster(collection, sources, (up, &links), min_gain(n_shapes), with)?;
    let next_recluster = next_recluster(n_shapes as u64);
    let event = found.event(found.outcome.accepted);
    if let (false, Some(labelling), Some(model)) =
        (found.outcome.accepted, labelling, collection.model())
    {
        // The epoch continues. Stale shapes are labelled by the model and the representatives of
        // its beginning, whether that happens before or after this addition.
        let mut plan = grown(collection, sources, model, labelling, new.arrays);
        plan.state.next_recluster = next_recluster;
        plan.state.clustered = Some(collection.row().next_ordinal);
        plan.state.up_disagrees = found.up.disagrees;
        plan.reclustered = Some(event);
        return Ok(plan);
    }
    let next_ordinal = collection.row().next_ordinal;
    let state = found.epoch(collection, next_recluster, next_ordinal, Some(next_ordinal));
    let mut labellings = found.outcome.labellings;
    let labelling = labellings.remove(found.new_at);
    Ok(Plan {
        model: ModelState::begin(found.outcome.model),
        state,
        labelling,
        relabelled: found.known.into_iter().zip(labellings).collect(),
        staleness: match found.outcome.accepted {
            true => Staleness::AllOthers,
            false => Staleness::AsLabelled,
        },
        changes: found.outcome.changes,
        reclustered: Some(event),
    })
}

impl Clustered {
    /// Returns the event of the re-clustering, and whether its labels were accepted.
    fn event(&self, accepted: bool) -> EventKind {
        let (before, after) = self.outcome.scores;
        EventKind::Reclustered {
            score_before: before.is_finite().then_some(before),
            score_after: after,
            accepted,
        }
    }

    /// Returns the state at the beginning of the epoch.
    fn epoch(
        &self,
        collection: &Collection,
        next_recluster: u64,
        last_ordinal: u64,
        new: Option<u64>,
    ) -> State {
        let ordinals = self
            .chosen
            .iter()
            .map(|at| collection.shapes()[*at].ordinal);
        let state = State {
            next_recluster,
            epoch: Epoch {
                representatives: ordinals.chain(new).collect(),
                last_ordinal,
                silent: Vec::new(),
            },
            ..State::default()
        };
        state.with_up(&self.up)
    }
}

/// Returns the stored shapes to be clustered together: those with linked parts, and others up to
/// [`MAX_REPRESENTATIVES`].
pub(in crate::library) fn representatives(
    collection: &Collection,
    links: &[LinkRow],
) -> Vec<usize> {
    collection.representatives_with(&linked_shapes(links), MAX_REPRESENTATIVES, &|_| true)
}

/// Clusters the parts of the representatives, none of which may be stale, along the axis `up` and
/// as links demand; with a new shape, if there is one, and its labels by the model in force.
fn cluster(
    collection: &Collection,
    sources: &dyn Sources,
    (up, links): (Up, &[LinkRow]),
    min_gain: f64,
    new: Option<(&NewShape<'_>, Option<&Labelling>)>,
) -> Result<Clustered> {
    let chosen = representatives(collection, links);
    let known = known_of(collection, sources, &chosen)?;
    let stored: Vec<&Known> = known.iter().collect();
    let mut demands = Linked::new(sources, links)?.demands(sources, &stored, &[]);
    let old = collection.label_model();
    let ids = |labelling: &Labelling| -> Vec<u32> {
        let labels = old.map_or(&[][..], |m| &m.labels);
        let classes = labelling.classes.iter();
        classes.map(|c| labels[*c as usize]).collect()
    };
    let new_ids = new.and_then(|(_, labelling)| labelling);
    let new_ids = new_ids.map(ids).unwrap_or_default();
    let known_ids: Vec<Vec<u32>> = known
        .iter()
        .map(|k| face_ids(&k.labels.proxy_labels))
        .collect();
    let mut shapes: Vec<Representative<'_>> = known
        .iter()
        .zip(&known_ids)
        .map(|(k, labels)| Representative {
            shape: k.view(),
            labels,
        })
        .collect();
    let mut new_at = chosen.len();
    if let Some((new, _)) = new {
        // The position of the new shape, too, follows from its digest.
        new_at = chosen.partition_point(|at| collection.shapes()[*at].digest <= new.digest);
        let new = Representative {
            shape: new.arrays.view,
            labels: &new_ids,
        };
        shapes.insert(new_at, new);
        let faces = demands.groups.iter_mut().flat_map(|g| &mut g.faces);
        faces
            .filter(|f| f.0 >= new_at)
            .for_each(|(shape, _)| *shape += 1);
    }
    let up = UpFound::of(up, &shapes.iter().map(|s| &s.shape).collect::<Vec<_>>());
    let options = ReclusterOptions {
        discovery: DiscoveryOptions {
            n_labels: (collection.state().chosen.or(collection.row().n_parts)).map(|n| n as usize),
            ..DiscoveryOptions::default()
        },
        up: up.axis,
        min_gain,
        next_label: collection.row().next_label,
        links: demands,
    };
    let outcome = recluster(&shapes, old, old.map_or(0, |m| m.epoch) + 1, &options);
    drop(shapes);
    Ok(Clustered {
        chosen,
        known,
        new_at,
        up,
        outcome,
    })
}

fn known_of(
    collection: &Collection,
    sources: &dyn Sources,
    chosen: &[usize],
) -> Result<Vec<Known>> {
    let known = chosen
        .iter()
        .map(|at| sources.known(collection.shapes()[*at].id));
    known.collect()
}

/// Returns the evidence of the representatives, and of a new shape if there is one, about the up
/// axis.
pub(in crate::library) fn up_found(
    collection: &Collection,
    sources: &dyn Sources,
    up: Up,
    new: Option<&DescriptionView<'_>>,
) -> Result<UpFound> {
    let chosen = representatives(collection, &sources.links(collection.id())?);
    let known = known_of(collection, sources, &chosen)?;
    let views: Vec<DescriptionView<'_>> = known.iter().map(Known::view).collect();
    Ok(UpFound::of(
        up,
        &views.iter().chain(new).collect::<Vec<_>>(),
    ))
}

/// Clusters the representatives, none of which may be stale, along another up axis. The labels in
/// force do not compete, because they were found along an axis that a person calls wrong.
pub(in crate::library) fn turn(
    collection: &Collection,
    sources: &dyn Sources,
    up: Up,
) -> Result<Change> {
    again(collection, sources, up, &sources.links(collection.id())?)
}

/// Clusters the representatives, none of which may be stale, as `links` demand. The labels in force
/// do not compete, because they need not obey.
pub(in crate::library) fn relinked(
    collection: &Collection,
    sources: &dyn Sources,
    links: &[LinkRow],
) -> Result<Change> {
    again(collection, sources, collection.up(), links)
}

fn again(
    collection: &Collection,
    sources: &dyn Sources,
    up: Up,
    links: &[LinkRow],
) -> Result<Change> {
    let found = cluster(collection, sources, (up, links), f64::NEG_INFINITY, None)?;
    let next = next_recluster(collection.shapes().len() as u64);
    let state = State {
        chosen: collection.state().chosen,
        ..found.epoch(collection, next, collection.row().next_ordinal - 1, None)
    };
    let closing = Some(found.event(true));
    let model = found.outcome.model;
    let mut relabelled = Vec::new();
    for (known, labelling) in found.known.iter().zip(&found.outcome.labellings) {
        let labels = new_labels_of(sources, known, labelling, (&model.labels, model.epoch))?;
        relabelled.push(Relabelled::new(known, labels, cause::RECLUSTERING));
    }
    Ok(Change {
        labels: found.outcome.changes.into_iter().map(Into::into).collect(),
        closing,
        relabelled,
        model: Some(ModelState::begin(model)),
        state: Some(state),
        staleness: Staleness::AllOthers,
        ..Change::default()
    })
}

/// Relabels a stale shape from stored maps and the model with which its epoch began: a vote and a
/// cut. Returns `None` if it is not stale. The result depends on neither the time nor the order in
/// which stale shapes are labelled, because only representatives vote, which are never stale.
pub(in crate::library) fn relabel(
    collection: &Collection,
    sources: &dyn Sources,
    at: usize,
) -> Result<Option<Change>> {
    let shape = &collection.shapes()[at];
    let Some(model) = collection.model().filter(|_| shape.stale) else {
        return Ok(None);
    };
    let model = model.base_model();
    let known = sources.known(shape.id)?;
    let is_source = |from: ShapeId| {
        let shape = collection.shapes().iter().find(|s| s.id == from);
        shape.is_some_and(|s| {
            let representatives = &collection.state().epoch.representatives;
            representatives.contains(&s.ordinal)
        })
    };
    let (mut voters, mut maps) = (Vec::new(), Vec::new());
    for map in sources.maps_into(shape.id)? {
        if is_source(map.from) {
            voters.push(Voter::new(sources.known(map.from)?, &model));
            maps.push(IncomingMap::of_row(map)?);
        }
    }
    let prepared = PreparedShape::new(sources, known.file(), &model);
    let votes = votes(&voters, &maps);
    let labelling = label(&prepared.view, &prepared.prepared, &model, &votes);
    let labels = new_labels_of(sources, &known, &labelling, (&model.labels, model.epoch))?;
    let labels = labels.voted_by(&sources_of(&voters, &labelling.weights));
    let relabelled = Relabelled::new(&known, labels, cause::RECLUSTERING);
    Ok(Some(Change {
        relabelled: vec![relabelled],
        ..Change::default()
    }))
}

/// Returns the model without a shape; `None` if the shape is not part of it.
pub(in crate::library) fn model_without(
    collection: &Collection,
    sources: &dyn Sources,
    id: ShapeId,
) -> Result<Option<ModelState>> {
    let informs = |at: usize| {
        let state = collection.state();
        let informs = state.epoch.informs(collection.shapes()[at].ordinal);
        informs && state.regime.supervision().is_none()
    };
    let is_there = collection.position(id).is_some_and(informs);
    let Some(mut model) = collection.model().filter(|_| is_there).cloned() else {
        return Ok(None);
    };
    let known = sources.known(id)?;
    let shape = PreparedShape::new(sources, known.file(), &model.model);
    let classes = classes_of(&known.labels.proxy_labels, &model.model.labels);
    let given = Labelling::given(classes, &shape.prepared, &model.model);
    let statistics = given.statistics(&shape.prepared, model.model.labels.len());
    model.model.statistics.accumulate(&statistics, -1.0);
    Ok(Some(model))
}

/// Returns the classes of label ids in a model. An id that the model does not know counts as the
/// first class.
fn classes_of(ids: &[i32], labels: &[u32]) -> Vec<u32> {
    let class = |id: &i32| {
        let found = labels.iter().position(|l| i64::from(*l) == i64::from(*id));
        found.unwrap_or(0) as u32
    };
    ids.iter().map(class).collect()
}
