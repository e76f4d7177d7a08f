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
/// Candidates that are refined before the choice is made.
const SHORTLIST: usize = 8;
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
    /// Its value: score plus consensus.
    pub value: f64,
    /// The value of the labelling that is there, judged by the same candidates; negative infinity without one.
    pub current_value: f64,
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

    /// A labelling of all patches, face by face.
    fn on_faces(&self, of_patch: &[u32]) -> Vec<Vec<u32>> {
        let shapes = self.input.shapes.iter().zip(&self.offsets);
        shapes
            .map(|(s, o)| {
                s.patches
                    .patch_of_face
                    .iter()
                    .map(|p| of_patch[o + *p as usize])
                    .collect()
            })
            .collect()
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
///
/// `current` is the labelling that is there, if any, with its number of labels; it is judged beside the new one.
pub fn discover(
    input: &DiscoveryInput<'_>,
    options: &DiscoveryOptions,
    current: Option<(&[Vec<u32>], usize)>,
) -> Discovery {
    if options.n_labels == Some(1) || input.shapes.is_empty() {
        let labels = input
            .shapes
            .iter()
            .map(|s| vec![0; s.surface.n_faces()])
            .collect();
        let current_value = if current.is_some() {
            0.0
        } else {
            f64::NEG_INFINITY
        };
        return Discovery {
            labels,
            n_labels: 1,
            value: 0.0,
            current_value,
        };
    }
    let shapes = Prepared::new(input);
    let criterion = shapes.criterion();
    let range = match options.n_labels {
        Some(k) => k..=k,
        None => 2..=options.max_labels.max(2),
    };
    let chosen = range
        .filter_map(|k| choose(&shapes, &criterion, k, options.seed, current))
        .reduce(|best, next| if next.value > best.value { next } else { best });
    chosen.unwrap_or_else(|| {
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
        Discovery {
            labels,
            n_labels,
            value: 0.0,
            current_value: f64::NEG_INFINITY,
        }
    })
}

/// Judges labellings: by the criterion, and by how much they agree with what the good candidates agree on.
struct Judge<'a> {
    criterion: &'a Criterion,
    /// Candidate labellings of all patches, and the softmax of their scores.
    candidates: Vec<Vec<u32>>,
    weights: Vec<f64>,
    area: &'a [f64],
    k: usize,
}

impl<'a> Judge<'a> {
    fn new(criterion: &'a Criterion, candidates: Vec<Vec<u32>>, area: &'a [f64], k: usize) -> Self {
        let scores: Vec<f64> = candidates
            .iter()
            .map(|l| criterion.score(&criterion.pair_sums(l, k)))
            .collect();
        let top = scores.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let mut weights: Vec<f64> = scores
            .iter()
            .map(|s| ((s - top) / TEMPERATURE).exp())
            .collect();
        let sum: f64 = weights.iter().sum();
        weights.iter_mut().for_each(|w| *w /= sum);
        Self {
            criterion,
            candidates,
            weights,
            area,
            k,
        }
    }

    /// Score plus weighted consensus of each labelling of all patches, with labels below `k`.
    fn values(&self, labellings: &[Vec<u32>], k: usize) -> Vec<f64> {
        let consensus = self.consensus(labellings, k);
        labellings
            .iter()
            .zip(consensus)
            .map(|(l, c)| {
                self.criterion.score(&self.criterion.pair_sums(l, k)) + CONSENSUS_WEIGHT * c
            })
            .collect()
    }

    /// For each labelling the mean normalised mutual information with the candidates; areas weigh the patches.
    fn consensus(&self, labellings: &[Vec<u32>], k: usize) -> Vec<f64> {
        let (mine, theirs) = (
            self.indicator(labellings, k),
            self.indicator(&self.candidates, self.k),
        );
        let joint = mine.transpose() * &theirs;
        let entropy = |p: f64| if p > 0.0 { -p * p.ln() } else { 0.0 };
        let own = |m: &DMatrix<f64>, c: usize, k: usize| -> f64 {
            (0..k)
                .map(|l| entropy(m.column(c * k + l).norm_squared()))
                .sum()
        };
        let their_own: Vec<f64> = (0..self.candidates.len())
            .map(|c| own(&theirs, c, self.k))
            .collect();
        (0..labellings.len())
            .map(|a| {
                let my_own = own(&mine, a, k);
                let agreement = |b: usize| {
                    let block = joint.view((a * k, b * self.k), (k, self.k));
                    let both: f64 = block.iter().map(|p| entropy(*p)).sum();
                    (my_own + their_own[b] - both) / (my_own * their_own[b]).sqrt().max(1e-9)
                };
                (0..self.candidates.len())
                    .map(|b| self.weights[b] * agreement(b))
                    .sum()
            })
            .collect()
    }

    /// Column `c k + l` holds the roots of the area shares of the patches that labelling c gives label l.
    fn indicator(&self, labellings: &[Vec<u32>], k: usize) -> DMatrix<f64> {
        let total: f64 = self.area.iter().sum();
        let mut indicator = DMatrix::zeros(self.area.len(), labellings.len() * k);
        for (c, labels) in labellings.iter().enumerate() {
            for (p, l) in labels.iter().enumerate() {
                indicator[(p, c * k + *l as usize)] = (self.area[p] / total).sqrt();
            }
        }
        indicator
    }
}

/// The best labelling with `k` labels: the best candidates are refined face by face, and judged again as what they
/// became. `None` if there is no candidate.
fn choose(
    shapes: &Prepared<'_>,
    criterion: &Criterion,
    k: usize,
    seed: u64,
    current: Option<(&[Vec<u32>], usize)>,
) -> Option<Discovery> {
    let candidates = pool(shapes, criterion, k, seed);
    let judge = Judge::new(criterion, candidates, &shapes.area, k);
    let values = judge.values(&judge.candidates, k);
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by(|&a, &b| values[b].total_cmp(&values[a]).then(a.cmp(&b)));
    let refined: Vec<Vec<Vec<u32>>> = order
        .iter()
        .take(SHORTLIST)
        .map(|&c| refine(shapes.input, shapes.on_faces(&judge.candidates[c]), k))
        .collect();
    let as_patches: Vec<Vec<u32>> = refined.iter().map(|l| shapes.majority(l, k)).collect();
    let values = judge.values(&as_patches, k);
    let best =
        (0..values.len()).max_by(|&a, &b| values[a].total_cmp(&values[b]).then(b.cmp(&a)))?;
    let current_value = current.map_or(f64::NEG_INFINITY, |(labels, n)| {
        judge.values(&[shapes.majority(labels, n)], n)[0]
    });
    let labels = refined.into_iter().nth(best)?;
    Some(Discovery {
        labels,
        n_labels: k,
        value: values[best],
        current_value,
    })
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
