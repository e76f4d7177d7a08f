//! Scores a labelling of patches without ground truth.
//!
//! A good labelling has its boundaries along concave creases, and gives one label to patches that
//! are similar or touch, more than chance would. The score is `½ ln(concavity) + ln(modularity)`.
//! Concavity is the length-weighted mean crease on label boundaries, relative to that on all patch
//! boundaries. Modularity is the share of affinity within labels above its expectation in the joint
//! patch graph (Newman and Girvan 2004). The plain share within labels would reward one label that
//! covers most of every shape, and could not compare different numbers of labels.

use super::joint::{Rows, combine, inter_shape, symmetric};
use crate::segmentation::PatchGraph;
use sprs::CsMat;

/// Weight of the log of the concavity in the score.
const CONCAVITY_WEIGHT: f64 = 0.5;
/// Share of the intra-shape graph in the joint patch graph.
const ALPHA: f64 = 0.5;
/// Crease at which the affinity of two touching patches has fallen to 1/e.
pub(super) const CREASE_SCALE: f64 = 0.1;

/// The patches of all shapes in one numbering, with their boundaries and affinities.
pub(super) struct Criterion {
    boundaries: Vec<(u32, u32, f64, f64)>,
    mean_crease: f64,
    /// Affinity of each pair of patches that has one, the lower number first.
    affinity: Vec<(u32, u32, f64)>,
}

/// Sums over pairs of labels `(k, k)`: length of boundaries, length weighted by crease, affinity.
#[derive(Clone)]
pub(super) struct PairSums {
    k: usize,
    length: Vec<f64>,
    creased: Vec<f64>,
    affinity: Vec<f64>,
}

impl Criterion {
    /// Builds the criterion for the patches of some shapes with the mean descriptors `means
    /// (n_patches, dim)`.
    pub(super) fn new(
        patches: &[&PatchGraph],
        means: &[f64],
        dim: usize,
        offsets: &[usize],
    ) -> Self {
        let mut boundaries = Vec::new();
        let mut intra = Vec::new();
        for (graph, &offset) in patches.iter().zip(offsets) {
            let total: f64 = graph.edges.iter().map(|e| e.1).sum();
            let mean_length = total / graph.edges.len().max(1) as f64;
            for &([a, b], length, crease) in &graph.edges {
                let (i, j) = (offset + a as usize, offset + b as usize);
                boundaries.push((i as u32, j as u32, length, length * crease));
                intra.push((
                    i,
                    j,
                    length / mean_length.max(1e-300) * (-crease / CREASE_SCALE).exp(),
                ));
            }
        }
        let n = *offsets.last().unwrap_or(&0);
        let intra = symmetric(n, intra.into_iter());
        let inter = inter_shape(&Rows {
            values: means,
            dim,
            offsets,
        });
        let length: f64 = boundaries.iter().map(|b| b.2).sum();
        let creased: f64 = boundaries.iter().map(|b| b.3).sum();
        Self {
            boundaries,
            mean_crease: creased / length.max(1e-300),
            affinity: pairs(&combine(&inter, &intra, ALPHA)),
        }
    }

    /// Computes the pair sums of a labelling of all patches with labels below `k`.
    pub(super) fn pair_sums(&self, labels: &[u32], k: usize) -> PairSums {
        let mut sums = PairSums {
            k,
            length: vec![0.0; k * k],
            creased: vec![0.0; k * k],
            affinity: vec![0.0; k * k],
        };
        for &(i, j, length, creased) in &self.boundaries {
            let (a, b) = (labels[i as usize] as usize, labels[j as usize] as usize);
            for at in [a * k + b, b * k + a] {
                sums.length[at] += length;
                sums.creased[at] += creased;
            }
        }
        let mut once = vec![0.0; k * k];
        for &(i, j, w) in &self.affinity {
            once[labels[i as usize] as usize * k + labels[j as usize] as usize] += w;
        }
        for a in 0..k {
            for b in 0..k {
                sums.affinity[a * k + b] = once[a * k + b] + once[b * k + a];
            }
        }
        sums
    }

    /// Returns the log of the concavity of the label boundaries: their length-weighted mean crease,
    /// relative to that of all patch boundaries.
    pub(super) fn log_concavity(&self, sums: &PairSums) -> f64 {
        let boundary = sums.between(&sums.creased) / sums.between(&sums.length).max(1e-9);
        let concavity = boundary / self.mean_crease.max(1e-300);
        concavity.max(1e-3).ln()
    }

    /// Computes the score of a labelling from its pair sums. Higher is better, also between
    /// different numbers of labels.
    pub(super) fn score(&self, sums: &PairSums) -> f64 {
        let k = sums.k;
        let total: f64 = sums.affinity.iter().sum::<f64>().max(1e-300);
        let modularity: f64 = (0..k)
            .map(|l| {
                let volume: f64 = sums.affinity[l * k..(l + 1) * k].iter().sum();
                sums.affinity[l * k + l] / total - (volume / total).powi(2)
            })
            .sum();
        CONCAVITY_WEIGHT * self.log_concavity(sums) + modularity.max(1e-6).ln()
    }
}

/// The entries above the diagonal of a symmetric matrix.
fn pairs(matrix: &CsMat<f64>) -> Vec<(u32, u32, f64)> {
    let entries = matrix.iter().filter(|(_, (i, j))| i < j);
    entries
        .map(|(w, (i, j))| (i as u32, j as u32, *w))
        .collect()
}

impl PairSums {
    /// Sums the entries between different labels.
    fn between(&self, m: &[f64]) -> f64 {
        m.iter().sum::<f64>() - (0..self.k).map(|l| m[l * self.k + l]).sum::<f64>()
    }

    /// Returns the sums after label `b` was merged into `a` and labels above `b` moved down by one.
    pub(super) fn merged(&self, a: usize, b: usize) -> Self {
        let k = self.k - 1;
        let place = |l: usize| match l.cmp(&b) {
            std::cmp::Ordering::Less => l,
            std::cmp::Ordering::Equal => {
                if a > b {
                    a - 1
                } else {
                    a
                }
            }
            std::cmp::Ordering::Greater => l - 1,
        };
        let shrink = |m: &[f64]| {
            let mut out = vec![0.0; k * k];
            for i in 0..self.k {
                for j in 0..self.k {
                    out[place(i) * k + place(j)] += m[i * self.k + j];
                }
            }
            out
        };
        Self {
            k,
            length: shrink(&self.length),
            creased: shrink(&self.creased),
            affinity: shrink(&self.affinity),
        }
    }
}
