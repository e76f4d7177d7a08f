//! What a person said is learnt: a few representatives are labelled together, and the label model follows.
//!
//! Every step ends with a commit, so that none takes long and a crash loses little: descriptors are standardised,
//! missing maps between the representatives are computed one shape at a time, then all learn at once.

use super::carry::{MapIn, new_map, pinned_classes};
use super::commit::{collection_row, map_row, put_relabelled};
use super::lane::Lane;
use super::learnt::Learnt;
use super::place::{Known, MAX_MAPS, MAX_REPRESENTATIVES};
use super::relabel::Relabelled;
use super::rows::{Teaching, UpFound, damaged, to_json};
use super::{LabelId, Library, Result};
use crate::fmap::FunctionalMap;
use crate::labels::{Features, LabelModel, Normalisation, Statistics};
use crate::pipeline::{DescriptionView, Given, Lesson, LessonMap, Prepared, TeachOptions, teach};
use crate::segmentation::Surface;
use crate::store::Tx;
use rayon::prelude::*;
use std::collections::BTreeSet;

/// Most exemplars among the representatives that learn together.
const MAX_TAUGHT_EXEMPLARS: usize = MAX_REPRESENTATIVES / 2;

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
        let found = UpFound::of(lane.up(), &views.iter().collect::<Vec<_>>());
        let up = found.axis;
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
        let mut state = found.noted(lane.state.clone());
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
                maps.push((from, to, MapIn::of_row(row)?));
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
                confidence: &m.confidence,
            })
            .collect();
        let statistics = self.given(lane, &teaching, chosen, &model)?;
        let discovered = self.discovered_statistics(lane, &teaching, &model)?;
        let given = Given {
            statistics: &statistics,
            n_exemplars: lane.shapes.iter().filter(|s| s.pinned).count(),
            discovered: discovered.as_ref(),
        };
        let taught = teach(&lessons, &maps, &given, k, &TeachOptions::default());
        model.statistics = taught.statistics;
        let learnt = Learnt {
            prior: taught.prior,
            ..Learnt::begin(model)
        };
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

    /// Statistics of the labels as they were when discovery ended, where those labels do not count any more; `None` also
    /// if there were less than two.
    fn discovered_statistics(
        &self,
        lane: &Lane,
        teaching: &Teaching,
        model: &LabelModel,
    ) -> Result<Option<Statistics>> {
        let k = teaching.discovered_labels.len();
        if !teaching.closed || k < 2 {
            return Ok(None);
        }
        let mut discovered = Statistics::empty(k, model.normalisation.mean.len());
        for (ordinal, version) in &teaching.discovered {
            // Shapes may have been removed since, and old versions are not kept for ever.
            let Some(shape) = lane.shapes.iter().find(|s| s.ordinal == *ordinal) else {
                continue;
            };
            let old = self
                .store
                .catalog()
                .read(|r| r.labels_at(shape.id, *version))?;
            let Some(old) = old else {
                continue;
            };
            let known = self.known(shape.id)?;
            let prepared = Prepared::new(&known.mapped.view(), model);
            let most = |f: usize| {
                let row = &old.proxy_probabilities[f * k..(f + 1) * k];
                let best = (0..k).max_by(|&a, &b| row[a].cmp(&row[b]).then(b.cmp(&a)));
                best.map(|l| l as u32)
            };
            let (features, area) = (&prepared.features, &prepared.surface.area);
            discovered.accumulate(&Statistics::of_shape(features, area, most, k), 1.0);
        }
        Ok((discovered.total() > 0.0).then_some(discovered))
    }
}

/// The shapes that learn together: exemplars and others, of each those of the least digests, by these.
pub(super) fn pupils(lane: &Lane) -> Vec<usize> {
    let by_digest = lane.representatives(lane.shapes.len());
    let of = |pinned: bool, limit: usize| {
        let all = by_digest.iter().copied();
        let all = all.filter(|at| lane.shapes[*at].pinned == pinned);
        all.take(limit).collect::<Vec<usize>>()
    };
    let mut chosen = of(true, MAX_TAUGHT_EXEMPLARS);
    chosen.extend(of(false, MAX_REPRESENTATIVES - chosen.len()));
    chosen
}
