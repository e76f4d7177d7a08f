//! Fits the label model to the training shapes: a few representatives are labelled together.
//!
//! Every step is a change of its own, so that none takes long and a crash loses little. First,
//! descriptors are standardised. Then missing maps between the representatives are computed, for a
//! few shapes at a time. Last, the model is fitted to all of them at once.

use super::discovered::{MAX_MAPS, MAX_REPRESENTATIVES};
use super::kept::Kept;
use super::state::{Phase, Supervision};
use super::supervised::{propagated, with};
use super::up::UpFound;
use super::{Collection, ModelState};
use crate::labels::{Features, LabelModel, Normalisation, Overlap, Pinned, Statistics};
use crate::library::change::{Change, map_row};
use crate::library::error::Result;
use crate::library::labelling::{Relabelled, cause};
use crate::library::linked::{Linked, linked_shapes};
use crate::library::pins::{pinned_faces, pinned_share, pins_of, used_labels};
use crate::library::rows::{damaged, resolved};
use crate::library::sources::{Known, Sources};
use crate::library::types::LabelId;
use crate::library::voting::{IncomingMap, PreparedShape, new_map};
use crate::pipeline::{
    DescriptionView, DiscoveredLabels, FitMap, FitOptions, FitShape, FurtherEvidence, Prepared, fit,
};
use crate::segmentation::Surface;
use crate::store::LinkRow;
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::sync::Arc;

/// Maximum number of training shapes among the representatives to which the model is fitted.
const MAX_FITTED_TRAINING: usize = MAX_REPRESENTATIVES / 2;

/// Number of maps that one step computes in parallel, if so many are missing: enough for all
/// processors, and about a second of work on two.
const MAPS_A_STEP: usize = 40;

/// A representative to which the model is fitted.
struct Member {
    at: usize,
    known: Known,
    /// Label of each polygon that a person gave, -1 where none; empty if nothing is pinned.
    pins: Vec<i32>,
    pinned_classes: Vec<Option<u32>>,
    discovered: Vec<u8>,
}

/// The collection during a fit of a model to some of its shapes.
struct Fit<'a> {
    collection: &'a Collection,
    sources: &'a dyn Sources,
    supervision: &'a Supervision,
    model: &'a LabelModel,
    /// Indices of the representatives.
    chosen: Vec<usize>,
    links: Vec<LinkRow>,
}

/// Returns the next step of fitting the model; `None` if it is fitted, or if there is no model to
/// begin with.
pub(in crate::library) fn step(
    collection: &Collection,
    sources: &dyn Sources,
) -> Result<Option<Change>> {
    let supervision = collection.state().regime.supervision();
    let (Some(supervision), Some(model)) = (supervision, collection.label_model()) else {
        return Ok(None);
    };
    let links = sources.links(collection.id())?;
    let fit = Fit {
        collection,
        sources,
        supervision,
        model,
        chosen: members(collection, &links),
        links,
    };
    if supervision.phase() != Phase::Fitted && fit.labels()?.is_empty() {
        return fit.unfounded().map(Some);
    }
    match supervision.phase() {
        Phase::Fitted => Ok(None),
        Phase::Outdated => fit.standardised().map(Some),
        Phase::Standardised => {
            let known = fit.known()?;
            match fit.missing_maps(&known)? {
                Some(maps) => Ok(Some(maps)),
                None => fit.fitted(known).map(Some),
            }
        }
    }
}

/// Returns the shapes to which the model is fitted: training shapes and others, those with linked
/// parts and those of the least digests in each group, in the order of their digests.
pub(in crate::library) fn members(collection: &Collection, links: &[LinkRow]) -> Vec<usize> {
    let linked = linked_shapes(links);
    let shapes = collection.shapes().iter();
    let n_linked_others = shapes
        .filter(|s| !s.pinned && linked.contains(&s.id))
        .count();
    let n_training = MAX_FITTED_TRAINING.min(MAX_REPRESENTATIVES.saturating_sub(n_linked_others));
    let mut chosen = collection.representatives_with(&linked, n_training, &|s| s.pinned);
    let n_others = MAX_REPRESENTATIVES.saturating_sub(chosen.len());
    chosen.extend(collection.representatives_with(&linked, n_others, &|s| !s.pinned));
    chosen
}

impl Fit<'_> {
    fn known(&self) -> Result<Vec<Known>> {
        let shapes = self.collection.shapes();
        let known = self
            .chosen
            .iter()
            .map(|at| self.sources.known(shapes[*at].id));
        known.collect()
    }

    /// Ends a fit without labels of persons, because the training shapes were removed before it.
    /// All shapes keep their labels. The model stays or, if its descriptors are already
    /// standardised, follows from these labels.
    fn unfounded(&self) -> Result<Change> {
        let shapes = self.collection.shapes();
        let mut model = self.model.clone();
        if self.supervision.phase() == Phase::Standardised {
            for known in self.known()? {
                let prepared = self.sources.prepared(known.file(), &model);
                let class = |f: usize| {
                    let label = i64::from(known.labels.proxy_labels[f]);
                    let found = model.labels.iter().position(|l| i64::from(*l) == label);
                    found.map(|c| c as u32)
                };
                let (features, area) = (&prepared.features, &prepared.surface.area);
                let k = model.labels.len();
                let of_shape = Statistics::of_shape(features, area, class, k);
                model.statistics.accumulate(&of_shape, 1.0);
            }
        }
        let trained = self.chosen.iter().map(|at| shapes[*at].ordinal).collect();
        let supervision = self.supervision.clone().fitted(trained);
        Ok(Change {
            stale: shapes.iter().map(|s| (s.id, false)).collect(),
            model: Some(ModelState::begin(model)),
            state: Some(with(self.collection, supervision)),
            ..Change::default()
        })
    }

    /// Standardises descriptors over the representatives.
    fn standardised(&self) -> Result<Change> {
        let known = self.known()?;
        let views: Vec<DescriptionView<'_>> = known.iter().map(Known::view).collect();
        let found = UpFound::of(self.collection.up(), &views.iter().collect::<Vec<_>>());
        let up = found.axis;
        let parts: Vec<(Features, Arc<Surface>)> = known
            .par_iter()
            .map(|k| (Features::raw(&k.view(), up), self.sources.surface(k.file())))
            .collect();
        let weighted = parts.iter().map(|(f, s)| (f, s.area.as_slice()));
        let normalisation = Normalisation::fit(weighted, up.is_some());
        let (k, dim) = (self.model.labels.len(), normalisation.mean.len());
        let model = LabelModel {
            epoch: self.model.epoch + 1,
            labels: self.model.labels.clone(),
            normalisation,
            statistics: Statistics::empty(k, dim),
            up,
        };
        let supervision = self.supervision.clone().standardised();
        Ok(Change {
            model: Some(ModelState::begin(model)),
            state: Some(with(self.collection, supervision).with_up(&found)),
            ..Change::default()
        })
    }

    /// Returns the members that vote for member `to`: the nearest training shapes, and the nearest
    /// others.
    fn voters_of(&self, known: &[Known], to: usize) -> Vec<usize> {
        let shapes = self.collection.shapes();
        let view = known[to].view();
        let nearest = |pinned: bool| {
            let others = self.chosen.iter().copied();
            let among: Vec<usize> = others
                .filter(|at| shapes[*at].pinned == pinned && *at != self.chosen[to])
                .collect();
            let (signature, n) = (view.signature, view.n_descriptors);
            self.collection
                .nearest_among(&among, signature, n, MAX_MAPS)
        };
        let position = |(at, _): (usize, f64)| self.chosen.iter().position(|c| *c == at);
        let training = nearest(true).into_iter();
        training
            .chain(nearest(false))
            .filter_map(position)
            .collect()
    }

    /// Computes missing maps between members: all to one member, and to further members until there
    /// are [`MAPS_A_STEP`]. Returns `None` if no map is missing.
    fn missing_maps(&self, known: &[Known]) -> Result<Option<Change>> {
        let mut missing = Vec::new();
        for to in 0..known.len() {
            for from in self.voters_of(known, to) {
                if !self.sources.has_map(known[from].row.id, known[to].row.id)? {
                    missing.push((from, to));
                }
            }
            if missing.len() >= MAPS_A_STEP {
                break;
            }
        }
        if missing.is_empty() {
            return Ok(None);
        }
        let maps = missing.par_iter().map(|(from, to)| {
            let (from, to) = (&known[*from], &known[*to]);
            let shape = PreparedShape::new(self.sources, to.file(), self.model);
            let map = new_map(self.sources, from, &shape, self.model);
            map_row(from.row.id, to.row.id, &map)
        });
        Ok(Some(Change {
            maps: maps.collect(),
            ..Change::default()
        }))
    }

    /// Labels the representatives together and fits the model to them.
    fn fitted(&self, known: Vec<Known>) -> Result<Change> {
        let given = self.labels()?;
        let maps = self.incoming_maps(&known)?;
        let members = self.members(known, &given)?;
        let views: Vec<DescriptionView<'_>> = members.iter().map(|m| m.known.view()).collect();
        let prepared: Vec<Arc<Prepared>> = members
            .par_iter()
            .map(|m| self.sources.prepared(m.known.file(), self.model))
            .collect();
        let mut discovered = self.discovered_labels(&members, &prepared, given.len())?;
        let rows = self.sources.labels(self.collection.id())?;
        let kept = discovered.as_mut().map(|discovered| {
            Kept::decide(self.collection, self.supervision, &rows, &given, discovered)
        });
        let kept = kept.unwrap_or_default();
        let labels: Vec<LabelId> = given.iter().chain(kept.ids()).copied().collect();
        let edits = kept.edits(&self.model.labels, &labels);
        let k = labels.len();
        let mut model = LabelModel {
            labels,
            ..self.model.clone()
        };
        let linked = Linked::new(self.sources, &self.links)?;
        let known: Vec<&Known> = members.iter().map(|m| &m.known).collect();
        let links = linked.demands(self.sources, &known, &model.labels);
        let fit_shapes: Vec<FitShape<'_>> = members
            .iter()
            .zip(&views)
            .zip(&prepared)
            .map(|((m, shape), prepared)| FitShape {
                shape: *shape,
                prepared,
                pinned: &m.pinned_classes,
                discovered: &m.discovered,
            })
            .collect();
        let maps: Vec<FitMap<'_>> = maps
            .iter()
            .map(|(from, to, m)| FitMap {
                from: *from,
                to: *to,
                p2p: m.p2p_21(),
                confidence: m.confidence(),
            })
            .collect();
        let statistics = self.evidence_elsewhere(&model)?;
        let further = FurtherEvidence {
            statistics: &statistics,
            n_training: self.n_training(&members)?,
            discovered: discovered.as_ref(),
            links: &links,
        };
        let fitted = fit(&fit_shapes, &maps, &further, k, &FitOptions::default());
        model.statistics = fitted.statistics;
        let model = ModelState {
            prior: fitted.prior,
            ..ModelState::begin(model)
        };
        let changed: Vec<Result<Relabelled>> = members
            .par_iter()
            .zip(&fitted.labellings)
            .filter(|(m, _)| m.pins.is_empty() || m.pins.iter().any(|l| *l < 0))
            .map(|(m, labelling)| {
                let labels = propagated(self.sources, &m.known, labelling, &model.model, &m.pins)?;
                Ok(Relabelled::new(&m.known, labels, cause::PROPAGATION))
            })
            .collect();
        let shapes = self.collection.shapes();
        let trained = members.iter().map(|m| shapes[m.at].ordinal).collect();
        let supervision = kept.supervision(self.supervision.clone()).fitted(trained);
        Ok(Change {
            labels: edits,
            relabelled: changed.into_iter().collect::<Result<_>>()?,
            stale: members.iter().map(|m| (m.known.row.id, false)).collect(),
            model: Some(model),
            state: Some(with(self.collection, supervision)),
            ..Change::default()
        })
    }

    /// Returns the labels of the new model's classes, without discovered ones that are kept because
    /// no labelled face shows them.
    fn labels(&self) -> Result<Vec<LabelId>> {
        let used = used_labels(self.collection, self.sources, None)?;
        let mut labels: BTreeSet<LabelId> = used.labels;
        if self.supervision.is_open() {
            labels.extend(self.resolved_discovered()?);
        }
        Ok(labels.into_iter().collect())
    }

    /// Returns the stored maps between the members.
    fn incoming_maps(&self, known: &[Known]) -> Result<Vec<(usize, usize, IncomingMap)>> {
        let mut maps = Vec::new();
        for to in 0..known.len() {
            for from in self.voters_of(known, to) {
                let (a, b) = (known[from].row.id, known[to].row.id);
                let row = self.sources.map(a, b)?;
                let row = row.ok_or_else(|| damaged("maps", &format!("{a} to {b} is gone")))?;
                maps.push((from, to, IncomingMap::of_row(row)?));
            }
        }
        Ok(maps)
    }

    /// Returns the representatives with their pins and their discovered labels.
    fn members(&self, known: Vec<Known>, labels: &[LabelId]) -> Result<Vec<Member>> {
        let mut members = Vec::with_capacity(known.len());
        for (at, known) in self.chosen.iter().zip(known) {
            let shape = &self.collection.shapes()[*at];
            let pins = self.pins(*at)?;
            let version = self.supervision.discovered().version_of(shape.ordinal);
            let discovered = match version.filter(|_| self.supervision.is_open()) {
                Some(version) => self.discovered_probabilities(&known, version, labels)?,
                None => Vec::new(),
            };
            members.push(Member {
                at: *at,
                pinned_classes: pinned_faces(&known.view(), &pins, labels),
                known,
                pins,
                discovered,
            });
        }
        Ok(members)
    }

    fn pins(&self, at: usize) -> Result<Vec<i32>> {
        let shape = &self.collection.shapes()[at];
        match shape.pinned {
            true => pins_of(self.sources, shape.id),
            false => Ok(Vec::new()),
        }
    }

    /// Returns the probabilities `(m, k)` of the discovered labels at the end of discovery.
    fn discovered_probabilities(
        &self,
        known: &Known,
        version: u64,
        labels: &[LabelId],
    ) -> Result<Vec<u8>> {
        let id = known.row.id;
        let old = self.sources.labels_at(id, version)?;
        let gone = || {
            damaged(
                "label_versions",
                &format!("version {version} of {id} is gone"),
            )
        };
        let old = old.ok_or_else(gone)?;
        let n_old = self.supervision.discovered().labels.len();
        let resolved = self.resolved_discovered()?;
        let column: Vec<Option<usize>> = resolved
            .iter()
            .map(|label| labels.iter().position(|l| l == label))
            .collect();
        let mut out = vec![0u8; known.view().faces.len() * labels.len()];
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

    /// Returns the discovered labels, each resolved to the label into which it was merged.
    fn resolved_discovered(&self) -> Result<Vec<LabelId>> {
        let rows = self.sources.labels(self.collection.id())?;
        let labels = self.supervision.discovered().labels.iter();
        Ok(labels.map(|label| resolved(&rows, *label)).collect())
    }

    /// Returns statistics of the pinned faces of training shapes outside the fit, and of discovered
    /// labels where shapes still have them.
    fn evidence_elsewhere(&self, model: &LabelModel) -> Result<Statistics> {
        let (k, dim) = (model.labels.len(), model.normalisation.mean.len());
        let mut evidence = Statistics::empty(k, dim);
        let options = FitOptions::default();
        for (at, shape) in self.collection.shapes().iter().enumerate() {
            let is_training = shape.pinned && !self.chosen.contains(&at);
            let version = self.supervision.discovered().version_of(shape.ordinal);
            let version = version.filter(|_| self.supervision.is_open());
            if !is_training && version.is_none() {
                continue;
            }
            let known = self.sources.known(shape.id)?;
            let shape = PreparedShape::new(self.sources, known.file(), model);
            let pinned = pinned_faces(&shape.view, &self.pins(at)?, &model.labels);
            let of = |class: &dyn Fn(usize) -> Option<u32>| {
                let prepared = &shape.prepared;
                Statistics::of_shape(&prepared.features, &prepared.surface.area, class, k)
            };
            if is_training {
                evidence.accumulate(&of(&|f| pinned[f]), options.pinned_weight);
            }
            if let Some(version) = version {
                let old = self.discovered_probabilities(&known, version, &model.labels)?;
                let most = |f: usize| {
                    let row = &old[f * k..(f + 1) * k];
                    let best = most_likely(row)?;
                    let is_pinned = pinned.get(f).is_some_and(Option::is_some);
                    (row[best] > 0 && !is_pinned).then_some(best as u32)
                };
                evidence.accumulate(&of(&most), 1.0);
            }
        }
        Ok(evidence)
    }

    /// Returns the number of training shapes, each weighted by the share of its area that is
    /// pinned.
    fn n_training(&self, members: &[Member]) -> Result<f64> {
        let mut n = 0.0;
        for (at, shape) in self.collection.shapes().iter().enumerate() {
            if !shape.pinned {
                continue;
            }
            n += match members.iter().find(|m| m.at == at) {
                Some(member) => pinned_share(&member.known.view(), &member.pins),
                None => pinned_share(&self.sources.known(shape.id)?.view(), &self.pins(at)?),
            };
        }
        Ok(n)
    }

    /// Returns the discovered labels beside the person's classes on the members, if a person
    /// labelled whole shapes; `None` also if there were fewer than two discovered labels.
    fn discovered_labels(
        &self,
        members: &[Member],
        prepared: &[Arc<Prepared>],
        k: usize,
    ) -> Result<Option<DiscoveredLabels>> {
        let Some(statistics) = self.discovered_statistics()? else {
            return Ok(None);
        };
        let pinned = members.iter().zip(prepared);
        let pinned = pinned.filter(|(m, _)| !m.pinned_classes.is_empty());
        let pinned = pinned.map(|(member, prepared)| Pinned {
            surface: &prepared.surface,
            features: &prepared.features,
            classes: &member.pinned_classes,
        });
        Ok(Some(DiscoveredLabels {
            overlap: Overlap::new(&statistics, pinned, k),
            statistics,
            own: Vec::new(),
        }))
    }

    /// Returns statistics of the discovered labels at the end of discovery.
    fn discovered_statistics(&self) -> Result<Option<Statistics>> {
        let model = self.model;
        let k = self.supervision.discovered().labels.len();
        if self.supervision.is_open() || k < 2 {
            return Ok(None);
        }
        let mut discovered = Statistics::empty(k, model.normalisation.mean.len());
        for (ordinal, version) in &self.supervision.discovered().versions {
            // Shapes may have been removed since, and old versions are deleted at some time.
            let shapes = self.collection.shapes();
            let Some(shape) = shapes.iter().find(|s| s.ordinal == *ordinal) else {
                continue;
            };
            let Some(old) = self.sources.labels_at(shape.id, *version)? else {
                continue;
            };
            let known = self.sources.known(shape.id)?;
            let prepared = self.sources.prepared(known.file(), model);
            let most = |f: usize| {
                let row = &old.proxy_probabilities[f * k..(f + 1) * k];
                most_likely(row).map(|l| l as u32)
            };
            let (features, area) = (&prepared.features, &prepared.surface.area);
            discovered.accumulate(&Statistics::of_shape(features, area, most, k), 1.0);
        }
        Ok((discovered.total() > 0.0).then_some(discovered))
    }
}

/// Returns the class of the highest probability; of equal ones the first.
fn most_likely(row: &[u8]) -> Option<usize> {
    (0..row.len()).max_by(|&a, &b| row[a].cmp(&row[b]).then(b.cmp(&a)))
}
