//! What a person said of some shapes is carried to all others, in steps that each end with a commit.
//!
//! First the collection learns: descriptors are standardised, maps between a few representatives are computed,
//! then the representatives are labelled together. After that every other shape is labelled on its own, from
//! maps and from what was learnt, which stays as it is until the next correction.

use super::commit::{collection_row, map_row, put_relabelled};
use super::correct::{area_shares, pin_polygons};
use super::lane::Lane;
use super::learnt::Learnt;
use super::place::{Known, MAX_MAPS, MAX_REPRESENTATIVES, Plan, next_recluster, sources_of};
use super::relabel::{NewLabels, Relabelled, cause, moves};
use super::rows::{Teaching, damaged, quality_from_json, to_json};
use super::{LabelId, Library, Result, Source, Up};
use crate::fmap::{FunctionalMap, MapOptions};
use crate::labels::{Features, LabelModel, Normalisation, Statistics, estimate_up};
use crate::pipeline::{
    DescriptionView, Labelling, Lesson, LessonMap, Prepared, TeachOptions, Vote, label_taught, map,
    proxy_pins, teach,
};
use crate::segmentation::Surface;
use crate::store::{ShapeId, Tx};
use rayon::prelude::*;
use std::collections::BTreeSet;

/// Most exemplars that vote for one shape; representatives fill up to [`MAX_MAPS`].
const MAX_EXEMPLAR_VOTES: usize = 3;
/// Most exemplars among the representatives that learn together.
const MAX_TAUGHT_EXEMPLARS: usize = MAX_REPRESENTATIVES / 2;

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
struct MapIn {
    p2p_21: Vec<u32>,
    residual: f64,
}

/// A shape that learns.
struct Pupil {
    at: usize,
    known: Known,
    /// Label of each polygon that a person gave, -1 where none; empty if nothing is pinned.
    pins: Vec<i32>,
    pinned_classes: Vec<Option<u32>>,
    discovered: Vec<u8>,
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
        let labelling = vote(view, &prepared, model, &voters, &kept, &[]);
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
        let labelling = vote(&view, &prepared, model, &voters, &kept, &pinned);
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

    /// One step of learning what a person said, ended by a commit.
    pub(super) fn teach_step(&self, lane: &mut Lane) -> Result<()> {
        let Some(teaching) = lane.state.teaching.clone() else {
            return Ok(());
        };
        let chosen = pupils(lane);
        if !teaching.normalised {
            return self.normalise(lane, &chosen);
        }
        let known: Vec<Known> = chosen
            .iter()
            .map(|at| self.known(lane.shapes[*at].id))
            .collect::<Result<_>>()?;
        for to in 0..chosen.len() {
            let wanted = self.lesson_sources(lane, &chosen, &known, to);
            let missing = self.store.catalog().read(|r| -> Result<_> {
                let mut missing = Vec::new();
                for from in wanted {
                    if r.map(known[from].row.id, known[to].row.id)?.is_none() {
                        missing.push(from);
                    }
                }
                Ok(missing)
            })?;
            if !missing.is_empty() {
                return self.map_lessons(lane, &known, &missing, to);
            }
        }
        self.teach_all(lane, teaching, &chosen, known)
    }

    /// Standardises descriptors over the shapes that learn.
    fn normalise(&self, lane: &mut Lane, chosen: &[usize]) -> Result<()> {
        let Some(learnt) = &lane.learnt else {
            return Ok(());
        };
        let known: Vec<Known> = chosen
            .iter()
            .map(|at| self.known(lane.shapes[*at].id))
            .collect::<Result<_>>()?;
        let views: Vec<DescriptionView<'_>> = known.iter().map(|k| k.mapped.view()).collect();
        let up = match lane.up() {
            Up::Auto => estimate_up(views.iter()).map(|found| found.0),
            given => given.axis(),
        };
        let parts: Vec<(Features, Surface)> = views
            .par_iter()
            .map(|v| (Features::raw(v, up), Surface::new(&v.mesh())))
            .collect();
        let weighted = parts.iter().map(|(f, s)| (f, s.area.as_slice()));
        let normalisation = Normalisation::fit(weighted, up.is_some());
        let (k, dim) = (learnt.model.labels.len(), normalisation.mean.len());
        let model = LabelModel {
            epoch: learnt.model.epoch + 1,
            labels: learnt.model.labels.clone(),
            normalisation,
            statistics: Statistics::empty(k, dim),
            up,
        };
        let learnt = Learnt::begin(model);
        let mut state = lane.state.clone();
        if let Some(teaching) = &mut state.teaching {
            teaching.normalised = true;
        }
        self.store.catalog().write(|tx| -> Result<()> {
            tx.set_model(lane.row.id, &learnt.encode())?;
            tx.set_epoch(lane.row.id, learnt.model.epoch)?;
            Ok(tx.set_state(lane.row.id, to_json(&state).as_bytes())?)
        })?;
        lane.row.epoch = learnt.model.epoch;
        lane.learnt = Some(learnt);
        lane.state = state;
        Ok(())
    }

    /// The pupils that vote for pupil `to`: the nearest exemplars, and the nearest others.
    fn lesson_sources(
        &self,
        lane: &Lane,
        chosen: &[usize],
        known: &[Known],
        to: usize,
    ) -> Vec<usize> {
        let view = known[to].mapped.view();
        let nearest = |pinned: bool, limit: usize| {
            let among: Vec<usize> = chosen
                .iter()
                .copied()
                .filter(|at| lane.shapes[*at].pinned == pinned && *at != chosen[to])
                .collect();
            lane.nearest_among(&among, view.signature, view.n_descriptors, limit)
        };
        let position = |(at, _): (usize, f64)| chosen.iter().position(|c| *c == at);
        let exemplars = nearest(true, MAX_MAPS).into_iter();
        exemplars
            .chain(nearest(false, MAX_MAPS))
            .filter_map(position)
            .collect()
    }

    /// Computes and keeps the maps from some pupils to one.
    fn map_lessons(
        &self,
        lane: &Lane,
        known: &[Known],
        missing: &[usize],
        to: usize,
    ) -> Result<()> {
        let Some(learnt) = &lane.learnt else {
            return Ok(());
        };
        let view = known[to].mapped.view();
        let prepared = Prepared::new(&view, &learnt.model);
        let maps: Vec<FunctionalMap> = missing
            .par_iter()
            .map(|from| new_map(&known[*from], (&view, &prepared), &learnt.model))
            .collect();
        self.store.catalog().write(|tx| -> Result<()> {
            for (from, map) in missing.iter().zip(&maps) {
                tx.put_map(&map_row(known[*from].row.id, known[to].row.id, map))?;
            }
            Ok(())
        })
    }

    /// Labels the pupils together, and commits what they have learnt.
    fn teach_all(
        &self,
        lane: &mut Lane,
        mut teaching: Teaching,
        chosen: &[usize],
        known: Vec<Known>,
    ) -> Result<()> {
        let Some(learnt) = &lane.learnt else {
            return Ok(());
        };
        let vocabulary = self.vocabulary(lane, None)?;
        let mut labels: Vec<LabelId> = vocabulary.labels.iter().copied().collect();
        if !teaching.closed {
            let discovered = self.resolved(lane, &teaching.discovered_labels)?;
            labels.extend(discovered);
            labels = labels
                .into_iter()
                .collect::<BTreeSet<_>>()
                .into_iter()
                .collect();
        }
        let k = labels.len();
        let mut model = LabelModel {
            labels,
            ..learnt.model.clone()
        };
        let mut maps = Vec::new();
        for to in 0..chosen.len() {
            for from in self.lesson_sources(lane, chosen, &known, to) {
                let (a, b) = (known[from].row.id, known[to].row.id);
                let row = self.store.catalog().read(|r| r.map(a, b))?;
                let row = row.ok_or_else(|| damaged("maps", &format!("{a} to {b} is gone")))?;
                maps.push((from, to, MapIn::of_row(row.p2p_21, &row.quality_json)?));
            }
        }
        let pupils = self.pupils(lane, &teaching, chosen, known, &model.labels)?;
        let views: Vec<DescriptionView<'_>> =
            pupils.iter().map(|p| p.known.mapped.view()).collect();
        let prepared: Vec<Prepared> = views.par_iter().map(|v| Prepared::new(v, &model)).collect();
        let lessons: Vec<Lesson<'_>> = pupils
            .iter()
            .zip(&views)
            .zip(&prepared)
            .map(|((p, shape), prepared)| Lesson {
                shape: *shape,
                prepared,
                pinned: &p.pinned_classes,
                discovered: &p.discovered,
            })
            .collect();
        let maps: Vec<LessonMap<'_>> = maps
            .iter()
            .map(|(from, to, m)| LessonMap {
                from: *from,
                to: *to,
                p2p: &m.p2p_21,
                residual: m.residual,
            })
            .collect();
        let given = self.given(lane, &teaching, chosen, &model)?;
        let taught = teach(&lessons, &maps, &given, k, &TeachOptions::default());
        model.statistics = taught.statistics;
        let learnt = Learnt::begin(model);
        let changed: Vec<(usize, Result<Relabelled>)> = pupils
            .par_iter()
            .zip(&taught.labellings)
            .filter(|(p, _)| p.pins.is_empty() || p.pins.iter().any(|l| *l < 0))
            .map(|(p, labelling)| {
                let labels = &learnt.model.labels;
                (p.at, self.carried(&p.known, labelling, labels, &p.pins))
            })
            .collect();
        let mut relabelled = Vec::with_capacity(changed.len());
        for (at, result) in changed {
            relabelled.push((at, result?));
        }
        teaching.pending = false;
        teaching.taught = chosen.iter().map(|at| lane.shapes[*at].ordinal).collect();
        let mut state = lane.state.clone();
        state.teaching = Some(teaching);
        let epoch = learnt.model.epoch;
        let collection = lane.row.id;
        lane.row = self.store.catalog().write(|tx: &Tx<'_>| -> Result<_> {
            for (_, shape) in &mut relabelled {
                put_relabelled(tx, collection, shape, &[], epoch)?;
            }
            for at in chosen {
                tx.set_stale(lane.shapes[*at].id, false)?;
            }
            tx.set_model(collection, &learnt.encode())?;
            tx.set_state(collection, to_json(&state).as_bytes())?;
            collection_row(tx, collection)
        })?;
        for at in chosen {
            lane.shapes[*at].stale = false;
        }
        lane.learnt = Some(learnt);
        lane.state = state;
        Ok(())
    }

    /// What the shapes that learn know beforehand.
    fn pupils(
        &self,
        lane: &Lane,
        teaching: &Teaching,
        chosen: &[usize],
        known: Vec<Known>,
        labels: &[LabelId],
    ) -> Result<Vec<Pupil>> {
        let mut pupils = Vec::with_capacity(known.len());
        for (at, known) in chosen.iter().zip(known) {
            let shape = &lane.shapes[*at];
            let pins = match shape.pinned {
                true => self.pinned(shape.id)?.1,
                false => Vec::new(),
            };
            let version = teaching.discovered.iter().find(|d| d.0 == shape.ordinal);
            let discovered = match version {
                Some((_, version)) if !teaching.closed => {
                    self.discovered_probabilities(lane, teaching, &known, *version, labels)?
                }
                _ => Vec::new(),
            };
            pupils.push(Pupil {
                at: *at,
                pinned_classes: pinned_classes(&known.mapped.view(), &pins, labels),
                known,
                pins,
                discovered,
            });
        }
        Ok(pupils)
    }

    /// Probabilities `(m, k)` of discovered labels, as of when discovery ended.
    fn discovered_probabilities(
        &self,
        lane: &Lane,
        teaching: &Teaching,
        known: &Known,
        version: u64,
        labels: &[LabelId],
    ) -> Result<Vec<u8>> {
        let old = self
            .store
            .catalog()
            .read(|r| r.labels_at(known.row.id, version))?;
        let old = old.ok_or_else(|| {
            damaged(
                "label_versions",
                &format!("version {version} of {} is gone", known.row.id),
            )
        })?;
        let n_old = teaching.discovered_labels.len();
        let resolved = self.resolved(lane, &teaching.discovered_labels)?;
        let column: Vec<Option<usize>> = resolved
            .iter()
            .map(|label| labels.iter().position(|l| l == label))
            .collect();
        let mut out = vec![0u8; known.mapped.view().faces.len() * labels.len()];
        let rows = out.chunks_exact_mut(labels.len());
        for (row, was) in rows.zip(old.proxy_probabilities.chunks_exact(n_old.max(1))) {
            for (probability, column) in was.iter().zip(&column) {
                if let Some(column) = column {
                    row[*column] = row[*column].saturating_add(*probability);
                }
            }
        }
        Ok(out)
    }

    /// The labels that ids stand for, after merging.
    pub(super) fn resolved(&self, lane: &Lane, ids: &[LabelId]) -> Result<Vec<LabelId>> {
        let rows = self.store.catalog().read(|r| r.labels(lane.row.id))?;
        let into = |id: LabelId| rows.iter().find(|l| l.id == id).and_then(|l| l.merged_into);
        let resolve = |id: &LabelId| {
            let mut id = *id;
            // Chains are as long as there are labels at most.
            for _ in 0..rows.len() {
                match into(id) {
                    Some(next) => id = next,
                    None => break,
                }
            }
            id
        };
        Ok(ids.iter().map(resolve).collect())
    }

    /// Statistics of pinned faces of exemplars that are not among the pupils, and of discovered labels that count.
    fn given(
        &self,
        lane: &Lane,
        teaching: &Teaching,
        chosen: &[usize],
        model: &LabelModel,
    ) -> Result<Statistics> {
        let (k, dim) = (model.labels.len(), model.normalisation.mean.len());
        let mut given = Statistics::empty(k, dim);
        let options = TeachOptions::default();
        for (at, shape) in lane.shapes.iter().enumerate() {
            let is_exemplar = shape.pinned && !chosen.contains(&at);
            let version = teaching.discovered.iter().find(|d| d.0 == shape.ordinal);
            let version = version.filter(|_| !teaching.closed);
            if !is_exemplar && version.is_none() {
                continue;
            }
            let known = self.known(shape.id)?;
            let view = known.mapped.view();
            let prepared = Prepared::new(&view, model);
            let pins = match shape.pinned {
                true => self.pinned(shape.id)?.1,
                false => Vec::new(),
            };
            let pinned = pinned_classes(&view, &pins, &model.labels);
            let of = |class: &dyn Fn(usize) -> Option<u32>| {
                Statistics::of_shape(&prepared.features, &prepared.surface.area, class, k)
            };
            if is_exemplar {
                given.accumulate(&of(&|f| pinned[f]), options.pinned_weight);
            }
            if let Some((_, version)) = version {
                let old =
                    self.discovered_probabilities(lane, teaching, &known, *version, &model.labels)?;
                let most = |f: usize| {
                    let row = &old[f * k..(f + 1) * k];
                    let best = (0..k).max_by(|&a, &b| row[a].cmp(&row[b]).then(b.cmp(&a)))?;
                    let is_pinned = pinned.get(f).is_some_and(Option::is_some);
                    (row[best] > 0 && !is_pinned).then_some(best as u32)
                };
                given.accumulate(&of(&most), 1.0);
            }
        }
        Ok(given)
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
            lane.nearest_among(&among, view.signature, view.n_descriptors, limit)
        };
        let is_taught = |at: usize| teaching.taught.contains(&lane.shapes[at].ordinal);
        let exemplars = nearest(&|at| lane.shapes[at].pinned, MAX_EXEMPLAR_VOTES);
        let others = nearest(
            &|at| !lane.shapes[at].pinned && is_taught(at),
            MAX_MAPS - exemplars.len(),
        );
        let mut voters = Vec::new();
        for (at, _) in exemplars.into_iter().chain(others) {
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
                Some(row) => Some(MapIn::of_row(row.p2p_21, &row.quality_json)?),
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
        let view = known.mapped.view();
        let original = || self.original_bytes(&known.row.content_digest);
        let mut new: NewLabels =
            self.finish_labels(&view, labelling, labels, (&original, &known.row.format))?;
        if !pins.is_empty() {
            pin_polygons(&mut new.row, pins);
            new.summary.area_shares = area_shares(&view, &new.row.polygon_labels);
        }
        new.row.version = known.row.version + 1;
        let moves = moves(
            &known.labels.polygon_labels,
            &new.row.polygon_labels,
            view.polygon_area,
        );
        Ok(Relabelled {
            shape: known.row.id,
            name: known.row.name.clone(),
            labels: new,
            moves,
            cause: cause::CARRYING,
        })
    }
}

impl Clone for MapIn {
    fn clone(&self) -> Self {
        Self {
            p2p_21: self.p2p_21.clone(),
            residual: self.residual,
        }
    }
}

impl MapIn {
    fn new(map: &FunctionalMap) -> Self {
        Self {
            p2p_21: map.p2p_21.clone(),
            residual: map.quality.descriptor_residual,
        }
    }

    fn of_row(p2p_21: Vec<u32>, quality_json: &str) -> Result<Self> {
        let residual = quality_from_json(quality_json, "maps")?.descriptor_residual;
        Ok(Self { p2p_21, residual })
    }
}

/// The shapes that learn together: exemplars, and others spread evenly over the order of arrival.
pub(super) fn pupils(lane: &Lane) -> Vec<usize> {
    let spread = |all: Vec<usize>, limit: usize| -> Vec<usize> {
        let n = all.len();
        if n <= limit {
            return all;
        }
        (0..limit).map(|i| all[i * n / limit]).collect()
    };
    let of = |pinned: bool| {
        (0..lane.shapes.len())
            .filter(|at| lane.shapes[*at].pinned == pinned)
            .collect()
    };
    let mut chosen = spread(of(true), MAX_TAUGHT_EXEMPLARS);
    chosen.extend(spread(of(false), MAX_REPRESENTATIVES - chosen.len()));
    chosen.sort_unstable();
    chosen
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
    let class = |pin: &i32| {
        let found = labels.iter().position(|l| i64::from(*l) == i64::from(*pin));
        found.map(|c| c as u32)
    };
    let classes: Vec<Option<u32>> = pins.iter().map(class).collect();
    proxy_pins(view, &classes, labels.len())
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

fn new_map(
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
    view: &DescriptionView<'_>,
    prepared: &Prepared,
    model: &LabelModel,
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
            residual: map.residual,
            trust: voter.trust,
        })
        .collect();
    let options = TeachOptions::default();
    label_taught(view, prepared, &model.statistics, &votes, pinned, &options)
}
