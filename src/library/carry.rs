//! What a person said of some shapes is carried to all others, after it was learnt: each is labelled on its own, from
//! maps and from what was learnt, which stays as it is until the next correction. Each shape ends with a commit.

use super::commit::{collection_row, map_row, put_relabelled};
use super::correct::{pin_polygons, pinned_faces};
use super::lane::Lane;
use super::learnt::Learnt;
use super::place::{Known, MAX_MAPS, Plan, next_recluster, sources_of};
use super::relabel::{Relabelled, area_shares, cause};
use super::rows::{Teaching, confidence_of_row};
use super::{LabelId, Library, Result, Source};
use crate::fmap::{Confidence, FunctionalMap, MapOptions};
use crate::labels::LabelModel;
use crate::pipeline::{
    DescriptionView, Labelling, Prepared, TeachOptions, Vote, label_taught, map,
};
use crate::store::{MapRow, ShapeId};
use rayon::prelude::*;

/// Most exemplars that vote for one shape; representatives fill up to [`MAX_MAPS`].
const MAX_EXEMPLAR_VOTES: usize = 3;

/// A new shape labelled from what was taught.
pub(super) struct PlacedTaught {
    pub(super) plan: Plan,
    pub(super) sources: Vec<Source>,
    pub(super) maps: Vec<(ShapeId, FunctionalMap)>,
}

/// A shape that votes: its arrays, what it says of its faces, and how much it is believed.
struct Voter {
    known: Known,
    probabilities: Vec<u8>,
    trust: f64,
}

/// What a map to a shape says, kept or new.
#[derive(Debug, Clone)]
pub(super) struct MapIn {
    pub(super) p2p_21: Vec<u32>,
    pub(super) confidence: Confidence,
}

impl Library {
    /// Labels a new shape from what was taught, after it was learnt; `None`: nothing was corrected yet.
    /// `lost_exemplar`: it replaces a shape that a person had labelled.
    pub(super) fn place_taught(
        &self,
        lane: &mut Lane,
        view: &DescriptionView<'_>,
        lost_exemplar: bool,
    ) -> Result<Option<PlacedTaught>> {
        while lane.state.teaching.as_ref().is_some_and(|t| t.pending) {
            self.teach_step(lane)?;
        }
        let (Some(teaching), Some(learnt)) = (&lane.state.teaching, &lane.learnt) else {
            return Ok(None);
        };
        let model = &learnt.model;
        let prepared = Prepared::new(view, model);
        let voters = self.voters(lane, view, None)?;
        let maps: Vec<FunctionalMap> = voters
            .par_iter()
            .map(|v| new_map(&v.known, (view, &prepared), model))
            .collect();
        let kept: Vec<MapIn> = maps.iter().map(MapIn::new).collect();
        let labelling = vote((view, &prepared), learnt, &voters, &kept, &[]);
        let known: Vec<Known> = voters.into_iter().map(|v| v.known).collect();
        let sources = sources_of(&known, &labelling.weights);
        let n_shapes = lane.shapes.len() as u64 + 1;
        let has_grown = n_shapes >= lane.state.next_recluster;
        let mut state = lane.state.clone();
        if has_grown {
            state.next_recluster = next_recluster(n_shapes);
        }
        let again = match has_grown || lost_exemplar {
            true => self.relearnt(lane, teaching)?,
            false => None,
        };
        let teach_again = again.is_some();
        if teach_again {
            state.teaching = again;
        }
        let plan = Plan {
            learnt: learnt.clone(),
            state,
            labelling,
            relabelled: Vec::new(),
            changes: Vec::new(),
            reclustered: None,
            teach_again,
        };
        let maps = known.iter().map(|k| k.row.id).zip(maps).collect();
        Ok(Some(PlacedTaught {
            plan,
            sources,
            maps,
        }))
    }

    /// How what a person said is learnt anew, now that there are more shapes, or fewer exemplars; `None`: there is
    /// nothing to learn from, and what was learnt stays.
    pub(super) fn relearnt(&self, lane: &Lane, teaching: &Teaching) -> Result<Option<Teaching>> {
        let vocabulary = self.vocabulary(lane, None)?;
        let can_learn = !vocabulary.labels.is_empty() || !teaching.closed;
        Ok(can_learn.then(|| Teaching {
            pending: true,
            normalised: false,
            closed: vocabulary.closed,
            ..teaching.clone()
        }))
    }

    /// One step towards the labels that follow from what a person said: of what is to be learnt first, else of the
    /// stale shape at `at`. Whether there was one.
    pub(super) fn relabel_taught(&self, lane: &mut Lane, at: usize) -> Result<bool> {
        if !lane.shapes[at].stale {
            return Ok(false);
        }
        if lane.state.teaching.as_ref().is_some_and(|t| t.pending) {
            self.teach_step(lane)?;
            return Ok(true);
        }
        let Some(learnt) = &lane.learnt else {
            return Ok(false);
        };
        let model = &learnt.model;
        let id = lane.shapes[at].id;
        let (known, pins) = if lane.shapes[at].pinned {
            self.pinned(id)?
        } else {
            (self.known(id)?, Vec::new())
        };
        if !pins.is_empty() && pins.iter().all(|p| *p >= 0) {
            self.store
                .catalog()
                .write(|tx| -> Result<()> { Ok(tx.set_stale(id, false)?) })?;
            lane.shapes[at].stale = false;
            return Ok(true);
        }
        let view = known.mapped.view();
        let prepared = Prepared::new(&view, model);
        let voters = self.voters(lane, &view, Some(at))?;
        let into = self.maps_into(&voters, (id, &view, &prepared), model)?;
        let pinned = pinned_classes(&view, &pins, &model.labels);
        let kept: Vec<MapIn> = into.iter().map(|(m, _)| m.clone()).collect();
        let labelling = vote((&view, &prepared), learnt, &voters, &kept, &pinned);
        let epoch = model.epoch;
        let mut relabelled = self.carried(&known, &labelling, &model.labels, &pins)?;
        let from: Vec<ShapeId> = voters.iter().map(|v| v.known.row.id).collect();
        let known: Vec<Known> = voters.into_iter().map(|v| v.known).collect();
        let sources = sources_of(&known, &labelling.weights);
        let collection = lane.row.id;
        lane.row = self.store.catalog().write(|tx| -> Result<_> {
            for (from, (_, new)) in from.iter().zip(&into) {
                if let Some(new) = new {
                    tx.put_map(&map_row(*from, id, new))?;
                }
            }
            put_relabelled(tx, collection, &mut relabelled, &sources, epoch)?;
            collection_row(tx, collection)
        })?;
        lane.shapes[at].stale = false;
        Ok(true)
    }

    /// The shapes that vote for a shape: exemplars, and representatives that have learnt.
    fn voters(
        &self,
        lane: &Lane,
        view: &DescriptionView<'_>,
        but: Option<usize>,
    ) -> Result<Vec<Voter>> {
        let (Some(teaching), Some(learnt)) = (&lane.state.teaching, &lane.learnt) else {
            return Ok(Vec::new());
        };
        let labels = &learnt.model.labels;
        let nearest = |wanted: &dyn Fn(usize) -> bool, limit: usize| {
            let among: Vec<usize> = (0..lane.shapes.len())
                .filter(|at| Some(*at) != but && wanted(*at))
                .collect();
            self.most_alike(lane, view, &among, limit)
        };
        let is_taught = |at: usize| teaching.taught.contains(&lane.shapes[at].ordinal);
        let exemplars = nearest(&|at| lane.shapes[at].pinned, MAX_EXEMPLAR_VOTES)?;
        let others = nearest(
            &|at| !lane.shapes[at].pinned && is_taught(at),
            MAX_MAPS - exemplars.len(),
        )?;
        let mut voters = Vec::new();
        for at in exemplars.into_iter().chain(others) {
            let shape = &lane.shapes[at];
            if !shape.pinned {
                let known = self.known(shape.id)?;
                voters.push(Voter {
                    probabilities: known.labels.proxy_probabilities.clone(),
                    known,
                    trust: 1.0,
                });
                continue;
            }
            let (known, pins) = self.pinned(shape.id)?;
            let classes = pinned_classes(&known.mapped.view(), &pins, labels);
            let whole = classes.iter().all(Option::is_some);
            let probabilities = match is_taught(at) && !whole {
                true => known.labels.proxy_probabilities.clone(),
                false => one_hot(&classes, labels.len()),
            };
            voters.push(Voter {
                probabilities,
                known,
                trust: TeachOptions::default().exemplar_trust,
            });
        }
        Ok(voters)
    }

    /// Maps from the voters to a stored shape: those that are kept, and new ones to be kept.
    fn maps_into(
        &self,
        voters: &[Voter],
        (id, view, prepared): (ShapeId, &DescriptionView<'_>, &Prepared),
        model: &LabelModel,
    ) -> Result<Vec<(MapIn, Option<FunctionalMap>)>> {
        let mut kept = Vec::with_capacity(voters.len());
        for voter in voters {
            let row = self
                .store
                .catalog()
                .read(|r| r.map(voter.known.row.id, id))?;
            kept.push(match row {
                Some(row) => Some(MapIn::of_row(row)?),
                None => None,
            });
        }
        Ok(voters
            .par_iter()
            .zip(kept)
            .map(|(voter, kept)| match kept {
                Some(kept) => (kept, None),
                None => {
                    let new = new_map(&voter.known, (view, prepared), model);
                    (MapIn::new(&new), Some(new))
                }
            })
            .collect())
    }

    /// A labelling as a new version of a stored shape's labels.
    pub(super) fn carried(
        &self,
        known: &Known,
        labelling: &Labelling,
        labels: &[LabelId],
        pins: &[i32],
    ) -> Result<Relabelled> {
        let mut new = self.finish_known(known, labelling, labels)?;
        if !pins.is_empty() {
            pin_polygons(&mut new.row, pins);
            let view = known.mapped.view();
            new.summary.area_shares = area_shares(&view, &new.row.polygon_labels);
        }
        Ok(Relabelled::new(known, new, cause::CARRYING))
    }
}

impl MapIn {
    fn new(map: &FunctionalMap) -> Self {
        Self {
            p2p_21: map.p2p_21.clone(),
            confidence: map.confidence.clone(),
        }
    }

    pub(super) fn of_row(row: MapRow) -> Result<Self> {
        Ok(Self {
            confidence: confidence_of_row(&row)?,
            p2p_21: row.p2p_21,
        })
    }
}

/// Class of each proxy face that is pinned; empty if nothing is.
pub(super) fn pinned_classes(
    view: &DescriptionView<'_>,
    pins: &[i32],
    labels: &[LabelId],
) -> Vec<Option<u32>> {
    if pins.is_empty() {
        return Vec::new();
    }
    pinned_faces(view, pins, labels)
}

/// Probabilities `(m, k)` that say what is pinned, and nothing elsewhere.
fn one_hot(classes: &[Option<u32>], k: usize) -> Vec<u8> {
    let mut out = vec![0; classes.len() * k];
    for (row, class) in out.chunks_exact_mut(k).zip(classes) {
        if let Some(class) = class {
            row[*class as usize] = u8::MAX;
        }
    }
    out
}

pub(super) fn new_map(
    from: &Known,
    to: (&DescriptionView<'_>, &Prepared),
    model: &LabelModel,
) -> FunctionalMap {
    let view = from.mapped.view();
    let source = Prepared::new(&view, model);
    map((&view, &source), to, &MapOptions::default())
}

/// Labels a shape by the votes of others and what was learnt.
fn vote(
    (view, prepared): (&DescriptionView<'_>, &Prepared),
    learnt: &Learnt,
    voters: &[Voter],
    maps: &[MapIn],
    pinned: &[Option<u32>],
) -> Labelling {
    let views: Vec<DescriptionView<'_>> = voters.iter().map(|v| v.known.mapped.view()).collect();
    let votes: Vec<Vote<'_>> = voters
        .iter()
        .zip(&views)
        .zip(maps)
        .map(|((voter, view), map)| Vote {
            faces: view.faces,
            probabilities: &voter.probabilities,
            p2p: &map.p2p_21,
            confidence: &map.confidence,
            trust: voter.trust,
        })
        .collect();
    let options = TeachOptions::default();
    let known = (&learnt.model.statistics, learnt.prior.as_ref());
    label_taught(view, prepared, known, &votes, pinned, &options)
}
