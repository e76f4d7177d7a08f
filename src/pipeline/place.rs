//! A description and a snapshot of the library become labels: carried through functional maps from a few known
//! shapes, weighed against what the collection has learnt of its labels, and cut along creases.

use super::DescriptionView;
use crate::fmap::{FunctionalMap, MapOptions, MapShape, descriptor_zoomout};
use crate::labels::cut::cut;
use crate::labels::{Features, LabelModel, Statistics};
use crate::segmentation::Surface;

/// Probabilities below this count as this: one source must not veto what all others say.
pub(super) const FLOOR: f64 = 0.02;
/// Share of the carried vote, the rest being the label model's, in the log-linear mean.
const VOTE_SHARE: f64 = 0.5;
/// Boundary strength of the cut.
const STRENGTH: f64 = 3.0;
/// A vote loses weight with the descriptor residual of its map, relative to the best one's.
const RESIDUAL_SCALE: f64 = 0.3;

/// A shape with what labelling derives from its description under a label model.
#[derive(Debug, Clone)]
pub struct Prepared {
    /// Its dual graph.
    pub surface: Surface,
    /// Standardised face descriptors `(m, dim)`.
    pub features: Features,
    /// The same at its vertices `(n, dim)`.
    pub at_vertices: Vec<f32>,
}

impl Prepared {
    /// Prepares a shape.
    pub fn new(shape: &DescriptionView<'_>, model: &LabelModel) -> Self {
        let surface = Surface::new(&shape.mesh());
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
            eigenvectors: shape.eigenvectors,
            n_eigenvectors: shape.n_eigenvectors,
            mass: shape.mass,
            descriptors: &self.at_vertices,
            dim: self.features.dim,
        }
    }
}

/// Computes the functional map that carries functions, and so labels, from one shape to another.
pub fn map(
    from: (&DescriptionView<'_>, &Prepared),
    to: (&DescriptionView<'_>, &Prepared),
    options: &MapOptions,
) -> FunctionalMap {
    descriptor_zoomout(&from.1.map_shape(from.0), &to.1.map_shape(to.0), options)
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
    /// Descriptor residual of the map.
    pub residual: f64,
    /// How much its labels are believed: 1 if they were carried, more if a person gave them.
    pub trust: f64,
}

/// Labels of one shape, as classes of the label model.
#[derive(Debug, Clone, PartialEq)]
pub struct Labelling {
    /// Class of each face `(m,)`.
    pub classes: Vec<u32>,
    /// Probability of each class for each face `(m, k)`, 0 to 255: half the evidence, half the cut.
    pub probabilities: Vec<u8>,
    /// Weight of each vote, summing to 1 (empty without votes).
    pub weights: Vec<f64>,
}

impl Labelling {
    /// The labelling that `classes` and the evidence `posterior (m, k)` make.
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

    /// A labelling that is given, with the label model's opinion as evidence.
    pub fn given(classes: Vec<u32>, prepared: &Prepared, model: &LabelModel) -> Self {
        let k = model.labels.len();
        let log = model
            .statistics
            .classifier()
            .log_probabilities(&prepared.features);
        let posterior: Vec<f64> = log.iter().map(|p| p.exp()).collect();
        Self::new(classes, &posterior, Vec::new(), k)
    }

    /// What this shape adds to the label model.
    pub fn statistics(&self, prepared: &Prepared, k: usize) -> Statistics {
        let class = |f: usize| Some(self.classes[f]);
        Statistics::of_shape(&prepared.features, &prepared.surface.area, class, k)
    }
}

/// Labels a shape from votes and the label model: a vote and a cut, no spectrum, no new map.
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
    let (carried, weights) = carried(shape, votes, k);
    let mut unary = Vec::with_capacity(log_model.len());
    for (i, log) in log_model.iter().enumerate() {
        let learnt = -log.max(FLOOR.ln());
        unary.push(match carried.get(i) {
            Some(p) => -VOTE_SHARE * p.max(FLOOR).ln() + (1.0 - VOTE_SHARE) * learnt,
            None => learnt,
        });
    }
    let classes = cut(&prepared.surface, &unary, k, STRENGTH, None);
    let mut posterior: Vec<f64> = unary.iter().map(|u| (-u).exp()).collect();
    for row in posterior.chunks_exact_mut(k) {
        let sum: f64 = row.iter().sum();
        row.iter_mut().for_each(|p| *p /= sum);
    }
    Labelling::new(classes, &posterior, weights, k)
}

/// Label probabilities of each face `(m, k)` by the votes, and the weight of each vote.
pub(super) fn carried(
    shape: &DescriptionView<'_>,
    votes: &[Vote<'_>],
    k: usize,
) -> (Vec<f64>, Vec<f64>) {
    let Some(least) = votes.iter().map(|v| v.residual).min_by(f64::total_cmp) else {
        return (Vec::new(), Vec::new());
    };
    let mut weights: Vec<f64> = votes
        .iter()
        .map(|v| v.trust * (-(v.residual - least) / (RESIDUAL_SCALE * least + 1e-9)).exp())
        .collect();
    let sum: f64 = weights.iter().sum();
    weights.iter_mut().for_each(|w| *w /= sum);
    let mut at_vertices = vec![0.0; shape.vertices.len() * k];
    for (vote, weight) in votes.iter().zip(&weights) {
        let known = vertex_probabilities(vote, k);
        for (v, t) in vote.p2p.iter().enumerate() {
            let from = &known[*t as usize * k..(*t as usize + 1) * k];
            for (s, p) in at_vertices[v * k..(v + 1) * k].iter_mut().zip(from) {
                *s += weight * p;
            }
        }
    }
    let mut faces = Vec::with_capacity(shape.faces.len() * k);
    for face in shape.faces {
        for l in 0..k {
            faces.push(
                face.iter()
                    .map(|v| at_vertices[*v as usize * k + l])
                    .sum::<f64>()
                    / 3.0,
            );
        }
    }
    (faces, weights)
}

/// Probabilities at the vertices of a known shape: means over the faces around each.
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
