//! A description and a snapshot of the library become labels. Functional maps transfer labels from
//! a few known shapes as votes; these are combined with the label model of the collection, and a
//! cut places boundaries along creases.

use super::DescriptionView;
use crate::fmap::{
    Confidence, FunctionalMap, MapOptions, MapShape, descriptor_zoomout, descriptor_zoomout_from,
    nearest_descriptors,
};
use crate::labels::cut::{STRENGTH, cut};
use crate::labels::{Features, LabelModel, Statistics};
use crate::linalg::nearest::nearest_rows;
use crate::segmentation::Surface;
use std::sync::Arc;

/// Probabilities below this count as this, so that one source cannot veto all others.
pub(super) const FLOOR: f64 = 0.02;
/// Share of the votes in the log-linear mean with the label model.
const VOTE_SHARE: f64 = 0.5;
/// The weight of a vote at a vertex is this power of the odds that it is right there.
const ODDS_POWER: f64 = 2.0;
/// Confidence is clamped to this value and to one minus this value.
const MOST_CERTAIN: f64 = 0.98;

/// A shape with the values that labelling derives from its description under a label model.
#[derive(Debug, Clone)]
pub struct Prepared {
    /// Its dual graph.
    pub surface: Arc<Surface>,
    /// Standardised face descriptors `(m, dim)`.
    pub features: Features,
    /// Standardised descriptors at the vertices `(n, dim)`.
    pub at_vertices: Vec<f32>,
}

impl Prepared {
    /// Prepares a shape.
    pub fn new(shape: &DescriptionView<'_>, model: &LabelModel) -> Self {
        Self::on(Arc::new(Surface::new(&shape.mesh())), shape, model)
    }

    /// Prepares a shape whose surface was computed before.
    pub fn on(surface: Arc<Surface>, shape: &DescriptionView<'_>, model: &LabelModel) -> Self {
        let features = model
            .normalisation
            .standardise(&Features::raw(shape, model.up));
        let at_vertices = features.at_vertices(shape.vertices.len(), shape.faces, &surface.area);
        Self {
            surface,
            features,
            at_vertices,
        }
    }

    fn map_shape<'a>(&'a self, shape: &DescriptionView<'a>) -> MapShape<'a> {
        MapShape {
            eigenvalues: shape.eigenvalues,
            eigenvectors: shape.eigenvectors,
            n_eigenvectors: shape.n_eigenvectors,
            mass: shape.mass,
            faces: shape.faces,
            descriptors: &self.at_vertices,
            dim: self.features.dim,
        }
    }
}

/// Computes the functional map that carries functions, and therefore labels, from one shape to
/// another.
pub fn map(
    from: (&DescriptionView<'_>, &Prepared),
    to: (&DescriptionView<'_>, &Prepared),
    options: &MapOptions,
) -> FunctionalMap {
    descriptor_zoomout(&from.1.map_shape(from.0), &to.1.map_shape(to.0), options)
}

/// Computes a map like [`map`], but starts from a map `c_12 (k, k1)` instead of nearest neighbours
/// of descriptors.
pub fn map_from(
    from: (&DescriptionView<'_>, &Prepared),
    to: (&DescriptionView<'_>, &Prepared),
    start: (&[f32], usize),
    options: &MapOptions,
) -> FunctionalMap {
    let (one, two) = (from.1.map_shape(from.0), to.1.map_shape(to.0));
    descriptor_zoomout_from(&one, &two, start, options)
}

/// Returns the baseline of maps: for each vertex of a shape the vertex of a known one with the
/// nearest descriptors, and the expected correctness.
pub fn map_by_descriptors(
    from: (&DescriptionView<'_>, &Prepared),
    to: (&DescriptionView<'_>, &Prepared),
) -> (Vec<u32>, Confidence) {
    nearest_descriptors(&from.1.map_shape(from.0), &to.1.map_shape(to.0))
}

/// Returns the mean squared difference of descriptors between a sample of a shape's vertices and
/// the most similar of a sample of a known shape's vertices. It predicts which maps transfer labels
/// well, without computing one. About `2 · 200 · 600 · dim` flops.
pub fn descriptor_distance(known: &Prepared, shape: &Prepared) -> f64 {
    const N_COMPARED: (usize, usize) = (600, 200);
    let dim = shape.features.dim;
    let some = |x: &[f32], count: usize| -> Vec<f32> {
        let n = x.len() / dim;
        let rows = (0..n).step_by((n / count).max(1));
        rows.flat_map(|v| x[v * dim..(v + 1) * dim].iter().copied())
            .collect()
    };
    let targets = some(&known.at_vertices, N_COMPARED.0);
    let queries = some(&shape.at_vertices, N_COMPARED.1);
    let nearest = nearest_rows(&queries, &targets, dim);
    let rows = queries.chunks_exact(dim).zip(&nearest);
    let sum: f64 = rows
        .map(|(x, t)| {
            let y = &targets[*t as usize * dim..(*t as usize + 1) * dim];
            x.iter()
                .zip(y)
                .map(|(x, y)| f64::from((x - y) * (x - y)))
                .sum::<f64>()
        })
        .sum();
    sum / nearest.len().max(1) as f64
}

/// Labels that a known shape offers through a map to the shape being labelled.
#[derive(Debug, Clone, Copy)]
pub struct Vote<'a> {
    /// Faces of the known shape.
    pub faces: &'a [[u32; 3]],
    /// Its label probabilities `(m, k)`, 0 to 255.
    pub probabilities: &'a [u8],
    /// For each vertex of the shape being labelled a vertex of the known one.
    pub p2p: &'a [u32],
    /// Expected correctness of the map at each vertex.
    pub confidence: &'a Confidence,
    /// Factor of the vote's weight: 1 if its labels were propagated, more if a person gave them.
    pub trust: f64,
}

/// Labels of one shape, as classes of the label model.
#[derive(Debug, Clone, PartialEq)]
pub struct Labelling {
    /// Class of each face `(m,)`.
    pub classes: Vec<u32>,
    /// Probability of each class for each face `(m, k)`, 0 to 255: the mean of the evidence and the
    /// result of the cut.
    pub probabilities: Vec<u8>,
    /// Weight of each vote; the weights sum to 1. Empty without votes.
    pub weights: Vec<f64>,
}

impl Labelling {
    /// Combines `classes` and the evidence `posterior (m, k)`.
    pub(super) fn new(classes: Vec<u32>, posterior: &[f64], weights: Vec<f64>, k: usize) -> Self {
        let probabilities = posterior
            .iter()
            .enumerate()
            .map(|(i, p)| {
                let cut = f64::from(u8::from(classes[i / k] as usize == i % k));
                ((0.5 * cut + 0.5 * p) * 255.0).round() as u8
            })
            .collect();
        Self {
            classes,
            probabilities,
            weights,
        }
    }

    /// Makes a labelling of given classes, with the label model as evidence.
    pub fn given(classes: Vec<u32>, prepared: &Prepared, model: &LabelModel) -> Self {
        let k = model.labels.len();
        let log = model
            .statistics
            .classifier()
            .log_probabilities(&prepared.features);
        let posterior: Vec<f64> = log.iter().map(|p| p.exp()).collect();
        Self::new(classes, &posterior, Vec::new(), k)
    }

    /// Returns the statistics that this shape adds to the label model.
    pub fn statistics(&self, prepared: &Prepared, k: usize) -> Statistics {
        let class = |f: usize| Some(self.classes[f]);
        Statistics::of_shape(&prepared.features, &prepared.surface.area, class, k)
    }
}

/// Labels a shape from votes and the label model, with one cut. Computes neither a spectrum nor a
/// map.
pub fn label(
    shape: &DescriptionView<'_>,
    prepared: &Prepared,
    model: &LabelModel,
    votes: &[Vote<'_>],
) -> Labelling {
    let k = model.labels.len();
    let log_model = model
        .statistics
        .classifier()
        .log_probabilities(&prepared.features);
    let (voted, weights) = vote_probabilities(shape, votes, k);
    let unary = blended(&log_model, &voted, VOTE_SHARE, k);
    let classes = cut(&prepared.surface, &unary, k, STRENGTH, None);
    let mut posterior: Vec<f64> = unary.iter().map(|u| (-u).exp()).collect();
    for row in posterior.chunks_exact_mut(k) {
        let sum: f64 = row.iter().sum();
        row.iter_mut().for_each(|p| *p /= sum);
    }
    Labelling::new(classes, &posterior, weights, k)
}

/// Returns the cost of each class for each face `(m, k)`: the log-linear mean of the votes, which
/// have the share `share`, and the label model's `log_model`; or the latter alone where there is no
/// vote.
pub(super) fn blended(log_model: &[f64], voted: &[f64], share: f64, k: usize) -> Vec<f64> {
    let mut unary = Vec::with_capacity(log_model.len());
    for (f, row) in log_model.chunks_exact(k).enumerate() {
        let votes = voted.get(f * k..(f + 1) * k).unwrap_or_default();
        let any = votes.iter().any(|p| *p > 0.0);
        unary.extend(row.iter().enumerate().map(|(l, log)| {
            let fitted = -log.max(FLOOR.ln());
            match any {
                true => -share * votes[l].max(FLOOR).ln() + (1.0 - share) * fitted,
                false => fitted,
            }
        }));
    }
    unary
}

/// Returns the label probabilities of each face `(m, k)` by the votes, 0 where nothing corresponds,
/// and the share of each vote in the total.
pub fn vote_probabilities(
    shape: &DescriptionView<'_>,
    votes: &[Vote<'_>],
    k: usize,
) -> (Vec<f64>, Vec<f64>) {
    if votes.is_empty() {
        return (Vec::new(), Vec::new());
    }
    let n = shape.vertices.len();
    let weight = |vote: &Vote<'_>, v: usize| {
        let certainty = vote.confidence.at(v)?;
        let p = certainty.clamp(1.0 - MOST_CERTAIN, MOST_CERTAIN);
        Some(vote.trust * (p / (1.0 - p)).powf(ODDS_POWER))
    };
    let mut total = vec![0.0; n];
    for vote in votes {
        for (v, sum) in total.iter_mut().enumerate() {
            *sum += weight(vote, v).unwrap_or(0.0);
        }
    }
    let mut at_vertices = vec![0.0; n * k];
    let mut weights = vec![0.0; votes.len()];
    for (vote, share) in votes.iter().zip(&mut weights) {
        let known = vertex_probabilities(vote, k);
        for (v, t) in vote.p2p.iter().enumerate() {
            let Some(weight) = weight(vote, v) else {
                continue;
            };
            let weight = weight / total[v];
            *share += weight * f64::from(shape.mass[v]);
            let from = &known[*t as usize * k..(*t as usize + 1) * k];
            for (s, p) in at_vertices[v * k..(v + 1) * k].iter_mut().zip(from) {
                *s += weight * p;
            }
        }
    }
    let sum: f64 = weights.iter().sum();
    weights.iter_mut().for_each(|w| *w /= sum.max(1e-300));
    let mut faces = Vec::with_capacity(shape.faces.len() * k);
    for face in shape.faces {
        let matched = face.iter().filter(|v| total[**v as usize] > 0.0).count();
        for l in 0..k {
            let sum: f64 = face.iter().map(|v| at_vertices[*v as usize * k + l]).sum();
            faces.push(sum / matched.max(1) as f64);
        }
    }
    (faces, weights)
}

/// Returns probabilities at the vertices of a known shape: means over the adjacent faces.
fn vertex_probabilities(vote: &Vote<'_>, k: usize) -> Vec<f64> {
    let n = vote
        .faces
        .iter()
        .flatten()
        .max()
        .map_or(0, |v| *v as usize + 1);
    let mut sum = vec![0.0; n * k];
    for (f, face) in vote.faces.iter().enumerate() {
        for v in face {
            for l in 0..k {
                sum[*v as usize * k + l] += f64::from(vote.probabilities[f * k + l]);
            }
        }
    }
    for row in sum.chunks_exact_mut(k) {
        let total: f64 = row.iter().sum::<f64>().max(1e-300);
        row.iter_mut().for_each(|p| *p /= total);
    }
    sum
}
