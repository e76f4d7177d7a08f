//! Shapes without labels become shapes with consistent labels: parts that recur, found together.
//!
//! Every shape's patches are merged into parts; the parts of all shapes are grouped in many ways (descriptor
//! clustering, spectral clustering of a joint graph after Sidi et al. 2011, *Unsupervised Co-Segmentation of a
//! Set of Shapes via Descriptor-Space Spectral Clustering*); the labelling is chosen by an unsupervised score
//! plus its consensus with the other good ones, then refined face by face.

use super::candidates::pool;
use super::criterion::Criterion;
use super::cut::cut;
use super::{Features, Statistics};
use crate::segmentation::{PatchGraph, Surface};
use nalgebra::DMatrix;

/// Temperature of the scores when the pool votes on its own members.
const TEMPERATURE: f64 = 0.1;
/// Weight of the consensus beside the score.
const CONSENSUS_WEIGHT: f64 = 0.5;
/// Rounds of classifier and cut, and the area share of change below which they stop.
const REFINEMENTS: usize = 2;
const SETTLED: f64 = 0.003;
/// Boundary strength and cap of the evidence (nats) in a refinement.
const STRENGTH: f64 = 5.0;
const CAP_NATS: f64 = 7.0;

/// One shape as discovery sees it.
#[derive(Debug, Clone, Copy)]
pub struct ShapeInput<'a> {
    /// Its dual graph.
    pub surface: &'a Surface,
    /// Its patches.
    pub patches: &'a PatchGraph,
    /// Its standardised face descriptors.
    pub features: &'a Features,
}

/// The shapes to be labelled together; features standardised alike.
#[derive(Debug, Clone)]
pub struct DiscoveryInput<'a> {
    /// The shapes.
    pub shapes: Vec<ShapeInput<'a>>,
    /// Whether the features end with the columns of a known up axis.
    pub up_known: bool,
}

/// How many labels, and the seed.
#[derive(Debug, Clone, PartialEq)]
pub struct DiscoveryOptions {
    /// Number of labels; `None`: estimated between 2 and `max_labels`.
    pub n_labels: Option<usize>,
    /// Most labels an estimate may give.
    pub max_labels: usize,
    /// Seed of every random start.
    pub seed: u64,
}

impl Default for DiscoveryOptions {
    fn default() -> Self {
        Self {
            n_labels: None,
            max_labels: 8,
            seed: 1,
        }
    }
}

/// A labelling of all shapes.
#[derive(Debug, Clone, PartialEq)]
pub struct Discovery {
    /// Label below `n_labels` of each face of each shape.
    pub labels: Vec<Vec<u32>>,
    /// Number of labels.
    pub n_labels: usize,
}

/// A shape with its mean descriptors by patch.
pub(super) struct PreparedShape<'a> {
    pub(super) surface: &'a Surface,
    pub(super) patches: &'a PatchGraph,
    pub(super) features: &'a Features,
    pub(super) patch_means: &'a [f64],
}

/// The input with what every step needs of it.
pub(super) struct Prepared<'a> {
    input: &'a DiscoveryInput<'a>,
    pub(super) dim: usize,
    pub(super) up_known: bool,
    means: Vec<f64>,
    /// Where the patches of each shape begin.
    offsets: Vec<usize>,
    /// Area share of each patch, summing to the number of shapes.
    area: Vec<f64>,
}

impl<'a> Prepared<'a> {
    fn new(input: &'a DiscoveryInput<'a>) -> Self {
        let dim = input.shapes.first().map_or(0, |s| s.features.dim);
        let (mut means, mut offsets, mut area) = (Vec::new(), vec![0], Vec::new());
        for s in &input.shapes {
            let n = s.patches.len();
            means.extend(
                s.surface
                    .patch_means(&s.patches.patch_of_face, n, &s.features.data, dim),
            );
            area.extend_from_slice(&s.patches.area);
            offsets.push(area.len());
        }
        Self {
            input,
            dim,
            up_known: input.up_known,
            means,
            offsets,
            area,
        }
    }

    pub(super) fn each(&self) -> impl Iterator<Item = PreparedShape<'_>> {
        self.input
            .shapes
            .iter()
            .zip(self.offsets.windows(2))
            .map(|(s, range)| PreparedShape {
                surface: s.surface,
                patches: s.patches,
                features: s.features,
                patch_means: &self.means[range[0] * self.dim..range[1] * self.dim],
            })
    }

    fn criterion(&self) -> Criterion {
        let patches: Vec<&PatchGraph> = self.input.shapes.iter().map(|s| s.patches).collect();
        Criterion::new(&patches, &self.means, self.dim, &self.offsets)
    }

    /// Label of most of each patch's area, over all shapes.
    fn majority(&self, labels: &[Vec<u32>], k: usize) -> Vec<u32> {
        let mut out = Vec::with_capacity(self.area.len());
        for (s, labels) in self.input.shapes.iter().zip(labels) {
            let mut area = vec![0.0; s.patches.len() * k];
            for (f, l) in labels.iter().enumerate() {
                area[s.patches.patch_of_face[f] as usize * k + *l as usize] += s.surface.area[f];
            }
            out.extend(area.chunks_exact(k).map(|row| {
                let most = (0..k).max_by(|&a, &b| row[a].total_cmp(&row[b]).then(b.cmp(&a)));
                most.unwrap_or(0) as u32
            }));
        }
        out
    }
}

/// Labels the faces of all shapes consistently. Deterministic for given options. The cost grows with the
/// square of the number of parts (about 25 a shape): meant for up to a few dozen shapes.
pub fn discover(input: &DiscoveryInput<'_>, options: &DiscoveryOptions) -> Discovery {
    if options.n_labels == Some(1) || input.shapes.is_empty() {
        let labels = input
            .shapes
            .iter()
            .map(|s| vec![0; s.surface.n_faces()])
            .collect();
        return Discovery {
            labels,
            n_labels: 1,
        };
    }
    let shapes = Prepared::new(input);
    let criterion = shapes.criterion();
    let range = match options.n_labels {
        Some(k) => k..=k,
        None => 2..=options.max_labels.max(2),
    };
    let chosen = range
        .filter_map(|k| {
            let labels = choose(&shapes, &criterion, k, options.seed)?;
            Some((criterion.score(&criterion.pair_sums(&labels, k)), k, labels))
        })
        .reduce(|best, next| if next.0 > best.0 { next } else { best });
    let Some((_, k, of_patch)) = chosen else {
        // Fewer patches than labels: each patch its own.
        let labels = input
            .shapes
            .iter()
            .map(|s| s.patches.patch_of_face.clone())
            .collect();
        let n_labels = input
            .shapes
            .iter()
            .map(|s| s.patches.len())
            .max()
            .unwrap_or(1);
        return Discovery { labels, n_labels };
    };
    let of_face: Vec<Vec<u32>> = input
        .shapes
        .iter()
        .zip(&shapes.offsets)
        .map(|(s, o)| {
            s.patches
                .patch_of_face
                .iter()
                .map(|p| of_patch[o + *p as usize])
                .collect()
        })
        .collect();
    Discovery {
        labels: refine(input, of_face, k),
        n_labels: k,
    }
}

/// The score of a face labelling with labels below `k`, as [`discover`] would judge it; comparable between
/// labellings of the same shapes.
pub fn labelling_score(input: &DiscoveryInput<'_>, labels: &[Vec<u32>], k: usize) -> f64 {
    let shapes = Prepared::new(input);
    let criterion = shapes.criterion();
    criterion.score(&criterion.pair_sums(&shapes.majority(labels, k), k))
}

/// The labelling of patches with the best score plus consensus; `None` if there is none with `k` labels.
fn choose(shapes: &Prepared<'_>, criterion: &Criterion, k: usize, seed: u64) -> Option<Vec<u32>> {
    let labellings = pool(shapes, criterion, k, seed);
    let scores: Vec<f64> = labellings
        .iter()
        .map(|l| criterion.score(&criterion.pair_sums(l, k)))
        .collect();
    let consensus = consensus(&labellings, &scores, &shapes.area, k);
    let total: Vec<f64> = scores
        .iter()
        .zip(&consensus)
        .map(|(s, c)| s + CONSENSUS_WEIGHT * c)
        .collect();
    let best = (0..total.len()).max_by(|&a, &b| total[a].total_cmp(&total[b]).then(b.cmp(&a)))?;
    labellings.into_iter().nth(best)
}

/// For each labelling the mean normalised mutual information with all of them, weighted by the softmax of the
/// scores; areas weigh the patches.
fn consensus(labellings: &[Vec<u32>], scores: &[f64], area: &[f64], k: usize) -> Vec<f64> {
    let top = scores.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let mut weights: Vec<f64> = scores
        .iter()
        .map(|s| ((s - top) / TEMPERATURE).exp())
        .collect();
    let sum: f64 = weights.iter().sum();
    weights.iter_mut().for_each(|w| *w /= sum);
    let total: f64 = area.iter().sum();
    let n = labellings.len();
    let mut indicator = DMatrix::<f64>::zeros(area.len(), n * k);
    for (c, labels) in labellings.iter().enumerate() {
        for (p, l) in labels.iter().enumerate() {
            indicator[(p, c * k + *l as usize)] = (area[p] / total).sqrt();
        }
    }
    let joint = indicator.transpose() * &indicator;
    let entropy = |p: f64| if p > 0.0 { -p * p.ln() } else { 0.0 };
    let own: Vec<f64> = (0..n)
        .map(|c| (0..k).map(|l| entropy(joint[(c * k + l, c * k + l)])).sum())
        .collect();
    (0..n)
        .map(|a| {
            (0..n)
                .map(|b| {
                    let block = joint.view((a * k, b * k), (k, k));
                    let both: f64 = block.iter().map(|p| entropy(*p)).sum();
                    weights[b] * (own[a] + own[b] - both) / (own[a] * own[b]).sqrt().max(1e-9)
                })
                .sum()
        })
        .collect()
}

/// Alternates a linear classifier of all faces and a cut of each shape.
fn refine(input: &DiscoveryInput<'_>, mut labels: Vec<Vec<u32>>, k: usize) -> Vec<Vec<u32>> {
    for _ in 0..REFINEMENTS {
        let dim = input.shapes[0].features.dim;
        let mut statistics = Statistics::empty(k, dim);
        for (s, labels) in input.shapes.iter().zip(&labels) {
            let of_shape =
                Statistics::of_shape(s.features, &s.surface.area, |f| Some(labels[f]), k);
            statistics.accumulate(&of_shape, 1.0);
        }
        let classifier = statistics.classifier();
        let mut changed = 0.0;
        for (s, labels) in input.shapes.iter().zip(&mut labels) {
            let unary: Vec<f64> = classifier
                .log_probabilities(s.features)
                .into_iter()
                .map(|p| (-p).min(CAP_NATS))
                .collect();
            let next = cut(s.surface, &unary, k, STRENGTH, None);
            let moved = (0..next.len()).filter(|&f| next[f] != labels[f]);
            changed += moved.map(|f| s.surface.area[f]).sum::<f64>();
            *labels = next;
        }
        if changed / (input.shapes.len() as f64) < SETTLED {
            break;
        }
    }
    labels
}
