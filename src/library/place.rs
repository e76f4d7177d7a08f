//! A described shape is placed: related to a few known shapes, labelled, and committed.

use super::commit::Commit;
use super::lane::{KnownShape, Lane};
use super::learnt::Learnt;
use super::relabel::face_ids;
use super::rows::{CollectionState, UpFound, damaged};
use super::{Described, Library, Outcome, Placed, Result, Source, Up};
use crate::fmap::{FunctionalMap, MapOptions};
use crate::labels::DiscoveryOptions;
use crate::pipeline::{
    DescriptionView, LabelChange, Labelling, Prepared, ReclusterOptions, Reclustering,
    Representative, Vote, label, map, recluster, unlikeness,
};
use crate::store::{
    Digest, JobItemRow, LabelVersionRow, MappedDescription, NewShapeRow, ObjectKind, ObjectRow,
    ShapeId, ShapeRow,
};
use std::time::Instant;

/// Most functional maps one addition computes.
pub const MAX_MAPS: usize = 5;
/// Most stored shapes that are clustered together, and so relabelled, by one addition; those that stale sources
/// of the new shape add to it are at most [`MAX_MAPS`].
pub const MAX_REPRESENTATIVES: usize = 40;
/// Shapes below which a collection is too small to judge a labelling: the new one is always taken.
const TOO_FEW: usize = 5;
/// By how much more a new labelling must be worth once only a sample of the shapes is clustered: a quarter of a nat, as if
/// boundaries were a quarter more concave. It knows no more than the one that is there, which was found on as many shapes, and
/// the best of hundreds of candidates on another sample always seems a little better.
const SAMPLE_GAIN: f64 = 0.25;
/// Growth of a collection from one re-clustering to the next.
const RECLUSTER_GROWTH: f64 = 1.4;

/// A stored shape that is used as a source: its arrays and its newest labels.
pub(super) struct Known {
    pub(super) row: ShapeRow,
    pub(super) mapped: MappedDescription,
    pub(super) labels: LabelVersionRow,
}

/// What an addition changes, before anything is written.
pub(super) struct Plan {
    pub(super) learnt: Learnt,
    pub(super) state: CollectionState,
    /// Labelling of the new shape, by the classes of `learnt`.
    pub(super) labelling: Labelling,
    /// Stored shapes with a new labelling.
    pub(super) relabelled: Vec<(Known, Labelling)>,
    pub(super) changes: Vec<LabelChange>,
    /// Scores before and after, and whether the new labels were taken.
    pub(super) reclustered: Option<(f64, f64, bool)>,
    /// Whether what a person said is to be learnt anew, now that the collection has grown.
    pub(super) teach_again: bool,
}

/// A shape that is clustered with the stored ones.
pub(super) struct NewShape<'a> {
    view: &'a DescriptionView<'a>,
    /// Of its original bytes.
    digest: Digest,
    /// Its labels by the model that there is.
    labelling: Option<&'a Labelling>,
}

/// Representatives that were clustered together.
pub(super) struct Clustered {
    /// Their indices in the lane.
    pub(super) chosen: Vec<usize>,
    pub(super) known: Vec<Known>,
    /// Where among them the new shape is.
    new_at: usize,
    /// What they say of the up axis.
    pub(super) up: UpFound,
    pub(super) outcome: Reclustering,
}

impl Library {
    /// Labels a described shape and commits it. `replaced` is taken out in the same commit.
    pub(super) fn place_described(
        &self,
        lane: &mut Lane,
        accepted: &JobItemRow,
        described: Described,
        replaced: Option<&ShapeRow>,
    ) -> Result<Placed> {
        let mut stages_ms = described.stages_ms;
        let mut clock = Instant::now();
        let mut lap = |name: &str| {
            stages_ms.push((name.to_string(), clock.elapsed().as_secs_f64() * 1e3));
            clock = Instant::now();
        };
        let description = described.description;
        let view = description.view();
        let digest = described.digest;
        // Until the commit.
        let _kept;
        let object = match described.stored {
            Some(stored) => stored,
            None => {
                let objects = self.store.objects();
                let put = objects.put_description(digest, &description, &described.params_json)?;
                lap("store");
                let row = ObjectRow::clone(&put);
                _kept = put;
                row
            }
        };
        let was_pinned = match replaced {
            Some(old) => self.forget(lane, old)?,
            None => false,
        };
        let mut n_relabelled = 0;
        let (mut maps, mut sources, mut labelling) = (Vec::new(), Vec::new(), None);
        let taught = self.place_taught(lane, &view, was_pinned)?;
        if lane.learnt.is_some() && taught.is_none() {
            let all: Vec<usize> = (0..lane.shapes.len()).collect();
            let nearest = self.most_alike(lane, &view, &all, MAX_MAPS)?;
            for &at in &nearest {
                n_relabelled += u32::from(self.relabel(lane, at)?);
            }
            if let Some(learnt) = &lane.learnt {
                let known: Vec<Known> = nearest
                    .iter()
                    .map(|at| self.known(lane.shapes[*at].id))
                    .collect::<Result<_>>()?;
                let carried = carry(&view, learnt, &known);
                sources = sources_of(&known, &carried.labelling.weights);
                maps = known.iter().map(|k| k.row.id).zip(carried.maps).collect();
                labelling = Some(carried.labelling);
            }
        }
        let n_inconsistent = self.n_inconsistent(&maps)?;
        lap("place");
        let due = lane.shapes.len() as u64 + 1 >= lane.state.next_recluster;
        let mut plan = match (taught, labelling, &lane.learnt) {
            (Some(taught), ..) => {
                (maps, sources) = (taught.maps, taught.sources);
                taught.plan
            }
            (None, Some(labelling), Some(learnt)) if !due => grown(lane, learnt, labelling, &view),
            (None, labelling, _) => {
                self.reclustered(lane, (&view, accepted.item.original_digest), labelling)?
            }
        };
        if plan.state.up_disagrees.is_none() && lane.up().axis().is_some() {
            // As in collections that were begun when nobody asked.
            plan.state.up_disagrees = self.up_found(lane, lane.up(), Some(&view))?.disagrees;
        }
        lap("recluster");
        n_relabelled += plan.relabelled.len() as u32;
        let original = || self.original_bytes(&accepted.item.original_digest);
        let labels = self.finish_labels(
            &view,
            &plan.labelling,
            &plan.learnt.model.labels,
            (&original, &accepted.item.format),
        )?;
        let relabelled = self.finish_relabelled(&plan.relabelled, &plan.learnt.model.labels)?;
        lap("boundary");
        let shape = NewShapeRow {
            collection: lane.row.id,
            name: accepted.item.name.clone(),
            ordinal: lane.row.next_ordinal,
            content_digest: accepted.item.original_digest,
            format: accepted.item.format.clone(),
            description_digest: digest,
            n_polygons: view.face_map.len() as u64,
            area: description.area,
            report_json: super::rows::report_to_json(&description.report).to_string(),
            version: replaced.map_or(0, |old| old.version),
            signature: description.signature.clone(),
            stored_bytes: object.length + self.object_length(&accepted.item.original_digest)?,
        };
        let placed = Placed {
            outcome: if replaced.is_some() {
                Outcome::Replaced
            } else {
                Outcome::Added
            },
            version: shape.version + 1,
            sequence: 0,
            n_maps: maps.len() as u32,
            n_relabelled,
            n_inconsistent,
            stages_ms,
        };
        let commit = Commit {
            object,
            shape,
            labels,
            sources,
            maps,
            relabelled,
            replaced,
            accepted,
            placed,
            plan,
        };
        let placed = self.commit(lane, commit, description.signature)?;
        self.note(&placed);
        Ok(placed)
    }

    /// The `limit` shapes `among` some whose maps to a shape promise most, best first: twice as many are taken by their
    /// signatures, and compared vertex by vertex.
    pub(super) fn most_alike(
        &self,
        lane: &Lane,
        view: &DescriptionView<'_>,
        among: &[usize],
        limit: usize,
    ) -> Result<Vec<usize>> {
        let nearest = lane.nearest_among(among, view.signature, view.n_descriptors, 2 * limit);
        let nearest: Vec<usize> = nearest.into_iter().map(|(at, _)| at).collect();
        let Some(learnt) = lane.learnt.as_ref().filter(|_| nearest.len() > limit) else {
            return Ok(nearest);
        };
        let shape = Prepared::new(view, &learnt.model);
        let mut found = Vec::with_capacity(nearest.len());
        for at in nearest {
            let known = self.known(lane.shapes[at].id)?;
            let known = Prepared::new(&known.mapped.view(), &learnt.model);
            found.push((unlikeness(&known, &shape), at));
        }
        found.sort_by(|a, b| a.0.total_cmp(&b.0));
        found.truncate(limit);
        Ok(found.into_iter().map(|(_, at)| at).collect())
    }

    /// A stored shape with its arrays and newest labels.
    pub(super) fn known(&self, id: ShapeId) -> Result<Known> {
        let gone = |what: &str| damaged("shapes", &format!("{what} of row {id} is gone"));
        let (row, object, labels) = self.store.catalog().read(|r| -> Result<_> {
            let row = r.shape(id)?.ok_or_else(|| gone("name"))?;
            let object = r.object(ObjectKind::Description, &row.description_digest)?;
            let labels = r.newest_labels(id)?.ok_or_else(|| gone("newest labels"))?;
            Ok((row, object.ok_or_else(|| gone("description"))?, labels))
        })?;
        let mapped = self.store.objects().open_description(&object)?;
        Ok(Known {
            row,
            mapped,
            labels,
        })
    }

    /// Clusters the parts of the representatives and the new shape anew.
    fn reclustered(
        &self,
        lane: &mut Lane,
        (view, digest): (&DescriptionView<'_>, Digest),
        labelling: Option<Labelling>,
    ) -> Result<Plan> {
        let new = NewShape {
            view,
            digest,
            labelling: labelling.as_ref(),
        };
        let n_shapes = lane.shapes.len() + 1;
        let found = self.cluster(lane, lane.up(), min_gain(n_shapes), Some(&new))?;
        let next_recluster = next_recluster(n_shapes as u64);
        let scores = found.outcome.scores;
        let reclustered = Some((scores.0, scores.1, found.outcome.accepted));
        if let (false, Some(labelling), Some(learnt)) =
            (found.outcome.accepted, labelling, &lane.learnt)
        {
            // The epoch goes on: what is stale is labelled by the model and the representatives that
            // made it so, whether that happens before or after this.
            let mut plan = grown(lane, learnt, labelling, view);
            plan.state.next_recluster = next_recluster;
            plan.state.up_disagrees = found.up.disagrees;
            plan.reclustered = reclustered;
            return Ok(plan);
        }
        let mut labellings = found.outcome.labellings;
        let labelling = labellings.remove(found.new_at);
        let ordinals = found
            .chosen
            .iter()
            .map(|at| lane.shapes[*at].ordinal)
            .chain([lane.row.next_ordinal]);
        let state = found.up.noted(CollectionState {
            next_recluster,
            representatives: ordinals.collect(),
            epoch_ordinal: lane.row.next_ordinal,
            ..CollectionState::default()
        });
        Ok(Plan {
            learnt: Learnt::begin(found.outcome.model),
            state,
            labelling,
            relabelled: found.known.into_iter().zip(labellings).collect(),
            changes: found.outcome.changes,
            reclustered,
            teach_again: false,
        })
    }

    /// Clusters the parts of the representatives, and of a new shape if there is one, along the axis that is `up`.
    pub(super) fn cluster(
        &self,
        lane: &mut Lane,
        up: Up,
        min_gain: f64,
        new: Option<&NewShape<'_>>,
    ) -> Result<Clustered> {
        let chosen = lane.representatives(MAX_REPRESENTATIVES);
        for &at in &chosen {
            self.relabel(lane, at)?;
        }
        let known: Vec<Known> = chosen
            .iter()
            .map(|at| self.known(lane.shapes[*at].id))
            .collect::<Result<_>>()?;
        let old = lane.learnt.as_ref().map(|l| &l.model);
        let ids = |labelling: &Labelling| -> Vec<u32> {
            let labels = old.map_or(&[][..], |m| &m.labels);
            labelling
                .classes
                .iter()
                .map(|c| labels[*c as usize])
                .collect()
        };
        let new_ids = new.and_then(|n| n.labelling).map(ids).unwrap_or_default();
        let known_ids: Vec<Vec<u32>> = known
            .iter()
            .map(|k| face_ids(&k.labels.proxy_labels))
            .collect();
        let mut shapes: Vec<Representative<'_>> = known
            .iter()
            .zip(&known_ids)
            .map(|(k, labels)| Representative {
                shape: k.mapped.view(),
                labels,
            })
            .collect();
        let mut new_at = chosen.len();
        if let Some(new) = new {
            // The new shape, too, has its place by its digest.
            new_at = chosen.partition_point(|at| lane.shapes[*at].digest <= new.digest);
            let new = Representative {
                shape: *new.view,
                labels: &new_ids,
            };
            shapes.insert(new_at, new);
        }
        let up = UpFound::of(up, &shapes.iter().map(|s| &s.shape).collect::<Vec<_>>());
        let options = ReclusterOptions {
            discovery: DiscoveryOptions {
                n_labels: lane.row.n_parts.map(|n| n as usize),
                ..DiscoveryOptions::default()
            },
            up: up.axis,
            min_gain,
            next_label: lane.row.next_label,
        };
        let outcome = recluster(&shapes, old, old.map_or(0, |m| m.epoch) + 1, &options);
        Ok(Clustered {
            chosen,
            known,
            new_at,
            up,
            outcome,
        })
    }

    /// What the representatives, and a new shape if there is one, say where `up` is given.
    pub(super) fn up_found(
        &self,
        lane: &Lane,
        up: Up,
        new: Option<&DescriptionView<'_>>,
    ) -> Result<UpFound> {
        let chosen = lane.representatives(MAX_REPRESENTATIVES);
        let known: Vec<Known> = chosen
            .iter()
            .map(|at| self.known(lane.shapes[*at].id))
            .collect::<Result<_>>()?;
        let views: Vec<DescriptionView<'_>> = known.iter().map(|k| k.mapped.view()).collect();
        Ok(UpFound::of(
            up,
            &views.iter().chain(new).collect::<Vec<_>>(),
        ))
    }

    /// Takes a shape out of the lane, before it is replaced or removed. Whether a person had labelled faces of it.
    pub(super) fn forget(&self, lane: &mut Lane, shape: &ShapeRow) -> Result<bool> {
        let Some(at) = lane.shapes.iter().position(|s| s.id == shape.id) else {
            return Ok(false);
        };
        let informs = lane.informs(&lane.shapes[at]);
        if let Some(learnt) = lane.learnt.as_mut().filter(|_| informs) {
            let known = self.known(shape.id)?;
            let view = known.mapped.view();
            let prepared = Prepared::new(&view, &learnt.model);
            let classes = classes_of(&known.labels.proxy_labels, &learnt.model.labels);
            let given = Labelling::given(classes, &prepared, &learnt.model);
            let statistics = given.statistics(&prepared, learnt.model.labels.len());
            learnt.model.statistics.accumulate(&statistics, -1.0);
        }
        Ok(lane.shapes.remove(at).pinned)
    }
}

/// By how much more than the labelling that is there a new one must be worth in a collection of so many shapes. Nothing while
/// all of them are clustered, each time with many that were not there before: a margin would keep what was found when there
/// was less to go by.
pub fn min_gain(n_shapes: usize) -> f64 {
    match n_shapes {
        0..=TOO_FEW => f64::NEG_INFINITY,
        n if n <= MAX_REPRESENTATIVES + 1 => 0.0,
        _ => SAMPLE_GAIN,
    }
}

/// Number of shapes at which a collection is clustered next: 1, 2, 3, 4, 5, 7, 10, 14, 20, 28, 39, 55, …
pub fn next_recluster(n_shapes: u64) -> u64 {
    if n_shapes < TOO_FEW as u64 {
        return n_shapes + 1;
    }
    (n_shapes as f64 * RECLUSTER_GROWTH).round() as u64
}

/// An addition that is no occasion to cluster anew.
fn grown(lane: &Lane, learnt: &Learnt, labelling: Labelling, view: &DescriptionView<'_>) -> Plan {
    let mut learnt = learnt.clone();
    let prepared = Prepared::new(view, &learnt.model);
    let statistics = labelling.statistics(&prepared, learnt.model.labels.len());
    learnt.model.statistics.accumulate(&statistics, 1.0);
    Plan {
        learnt,
        state: lane.state.clone(),
        labelling,
        relabelled: Vec::new(),
        changes: Vec::new(),
        reclustered: None,
        teach_again: false,
    }
}

/// A labelling with the maps it was carried through.
struct Carried {
    labelling: Labelling,
    maps: Vec<FunctionalMap>,
}

/// Maps every known shape to the new one and labels it.
fn carry(view: &DescriptionView<'_>, learnt: &Learnt, known: &[Known]) -> Carried {
    let model = &learnt.model;
    let prepared = Prepared::new(view, model);
    let maps: Vec<FunctionalMap> = known
        .iter()
        .map(|k| {
            let from = k.mapped.view();
            let source = Prepared::new(&from, model);
            map((&from, &source), (view, &prepared), &MapOptions::default())
        })
        .collect();
    let views: Vec<DescriptionView<'_>> = known.iter().map(|k| k.mapped.view()).collect();
    let votes: Vec<Vote<'_>> = known
        .iter()
        .zip(&views)
        .zip(&maps)
        .map(|((k, v), m)| Vote {
            faces: v.faces,
            probabilities: &k.labels.proxy_probabilities,
            p2p: &m.p2p_21,
            confidence: &m.confidence,
            trust: 1.0,
        })
        .collect();
    let labelling = label(view, &prepared, model, &votes);
    Carried { labelling, maps }
}

/// The sources of a labelling with the weights of their votes.
pub(super) fn sources_of(known: &[Known], weights: &[f64]) -> Vec<Source> {
    known
        .iter()
        .zip(weights)
        .map(|(k, w)| Source {
            shape: k.row.name.clone(),
            version: k.row.version,
            weight: *w,
        })
        .collect()
}

/// Classes of a model, given label ids; an id the model does not know counts as the first class.
pub(super) fn classes_of(ids: &[i32], labels: &[u32]) -> Vec<u32> {
    ids.iter()
        .map(|id| {
            labels
                .iter()
                .position(|l| i64::from(*l) == i64::from(*id))
                .unwrap_or(0) as u32
        })
        .collect()
}

impl KnownShape {
    /// The shape as it is when it has just been labelled.
    pub(super) fn fresh(id: ShapeId, row: &NewShapeRow, signature: Vec<f32>) -> Self {
        Self {
            id,
            ordinal: row.ordinal,
            digest: row.content_digest,
            stale: false,
            pinned: false,
            signature,
        }
    }
}
