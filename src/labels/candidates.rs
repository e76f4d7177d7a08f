//! Many ways to group the parts of a few shapes: the pool from which a labelling is chosen.

use super::criterion::{CREASE_SCALE, Criterion};
use super::discover::Prepared;
use super::joint::{Rows, combine, embedding, inter_shape, symmetric};
use crate::linalg::kmeans::kmeans;
use crate::segmentation::{PartGraph, merge_patches};
use std::collections::BTreeSet;

/// Starts of each k-means.
const N_STARTS: usize = 5;
/// Labellings kept by the beam search while merging, and at its end.
const BEAM_WIDTH: usize = 6;
const BEAM_KEPT: usize = 3;
/// Weights, relative to the mean descriptors of a part, of their spread and of the neighbours' means.
const SPREAD_WEIGHT: f64 = 0.5;
const CONTEXT_WEIGHT: f64 = 0.2;
const SHAPE_WEIGHT: f64 = 1.3;
/// Part vectors are clipped to this many standard deviations.
const CLIP: f64 = 3.0;

/// Three views of what makes parts alike: weights of the descriptor groups
/// sdf, agd, gc, q, pc, pos, hks, hksn, wks, up.
const WEIGHTINGS: [[f64; 10]; 3] = [
    [1.0, 0.7, 0.5, 0.3, 1.6, 1.4, 1.0, 1.0, 1.5, 1.5],
    [0.7, 0.5, 0.3, 0.2, 0.7, 0.5, 1.0, 1.5, 2.0, 1.0],
    [1.0, 0.3, 0.2, 0.2, 2.0, 0.5, 0.5, 0.5, 1.5, 1.5],
];

/// Labellings of all patches with exactly `k` labels, without duplicates up to renaming.
pub(super) fn pool(
    shapes: &Prepared<'_>,
    criterion: &Criterion,
    k: usize,
    seed: u64,
) -> Vec<Vec<u32>> {
    let granularities = [
        (2 * k + 4, &[0.2, 0.35, 0.5][..], 0),
        (3 * k + 6, &[0.35, 0.5][..], 2),
        (4 * k + 8, &[0.35, 0.5][..], 2),
    ];
    let sizes: Vec<usize> = granularities.iter().map(|g| g.0).collect();
    let merged: Vec<Vec<Vec<u32>>> = shapes
        .each()
        .map(|s| merge_patches(s.patches, s.patch_means, shapes.dim, &sizes))
        .collect();
    let mut found = Pool {
        k,
        seen: BTreeSet::new(),
        labellings: Vec::new(),
    };
    for (g, &(_, alphas, extra)) in granularities.iter().enumerate() {
        let parts = Parts::new(shapes, merged.iter().map(|m| &m[g]));
        for weighting in &WEIGHTINGS {
            let vectors = parts.vectors(shapes, weighting);
            let dim = vectors.len() / parts.len().max(1);
            let inter = inter_shape(&Rows {
                values: &vectors,
                dim,
                offsets: &parts.offsets,
            });
            let embeddings: Vec<_> = alphas
                .iter()
                .map(|alpha| embedding(&combine(&inter, &parts.touching, *alpha), k + extra + 1))
                .collect();
            for n_labels in k..=k + extra {
                let mut take = |points: &[f64], dim: usize| {
                    let of_part = kmeans(points, dim, &parts.weights, n_labels, seed, N_STARTS);
                    let of_patch = parts.patch_labels(&of_part);
                    found.add_merged(criterion, of_patch, n_labels);
                };
                take(&vectors, dim);
                for (values, basis, degrees) in &embeddings {
                    let width = n_labels.min(basis.ncols());
                    take(&row_normalised(basis, width), width);
                    let next = (n_labels + 1).min(basis.ncols());
                    take(&diffusion(values, basis, degrees, next), next - 1);
                }
            }
        }
    }
    found.labellings
}

struct Pool {
    k: usize,
    seen: BTreeSet<Vec<u32>>,
    labellings: Vec<Vec<u32>>,
}

impl Pool {
    /// Takes a labelling with `n_labels >= k` labels, after merging it down to k by beam search.
    fn add_merged(&mut self, criterion: &Criterion, labels: Vec<u32>, n_labels: usize) {
        let mut beam = vec![(criterion.pair_sums(&labels, n_labels), labels)];
        for size in (self.k + 1..=n_labels).rev() {
            let mut next = Vec::new();
            for (at, (sums, _)) in beam.iter().enumerate() {
                for a in 0..size {
                    for b in a + 1..size {
                        let merged = sums.merged(a, b);
                        next.push((criterion.score(&merged), at, a as u32, b as u32, merged));
                    }
                }
            }
            next.sort_by(|x, y| y.0.total_cmp(&x.0));
            next.truncate(if size - 1 > self.k {
                BEAM_WIDTH
            } else {
                BEAM_KEPT
            });
            beam = next
                .into_iter()
                .map(|(_, at, a, b, sums)| {
                    let rename = |l: &u32| match *l {
                        l if l == b => a,
                        l if l > b => l - 1,
                        l => l,
                    };
                    (sums, beam[at].1.iter().map(rename).collect())
                })
                .collect();
        }
        for (_, labels) in beam {
            self.add(labels);
        }
    }

    /// Takes a labelling unless a label is empty or the same partition is there already.
    fn add(&mut self, mut labels: Vec<u32>) {
        let mut names = vec![u32::MAX; labels.iter().max().map_or(0, |m| *m as usize + 1)];
        let mut next = 0;
        for l in &mut labels {
            let name = &mut names[*l as usize];
            if *name == u32::MAX {
                *name = next;
                next += 1;
            }
            *l = *name;
        }
        if next as usize == self.k && self.seen.insert(labels.clone()) {
            self.labellings.push(labels);
        }
    }
}

/// The parts of all shapes at one granularity.
struct Parts {
    graphs: Vec<PartGraph>,
    /// Where the parts of each shape begin.
    offsets: Vec<usize>,
    /// Part, numbered through, of each patch, numbered through.
    part_of_patch: Vec<u32>,
    /// Roots of the area shares.
    weights: Vec<f64>,
    /// Affinity of touching parts.
    touching: sprs::CsMat<f64>,
}

impl Parts {
    fn new<'a>(shapes: &Prepared<'_>, part_of_patch: impl Iterator<Item = &'a Vec<u32>>) -> Self {
        let mut offsets = vec![0];
        let (mut graphs, mut numbered, mut weights, mut touching) =
            (vec![], vec![], vec![], vec![]);
        for (shape, of_patch) in shapes.each().zip(part_of_patch) {
            let graph = PartGraph::new(
                shape.surface,
                shape.patches,
                of_patch,
                &shape.features.data,
                shape.features.dim,
            );
            let offset = *offsets.last().unwrap_or(&0);
            numbered.extend(of_patch.iter().map(|p| offset as u32 + p));
            weights.extend(graph.area.iter().map(|a| a.sqrt()));
            let n = graph.len();
            for p in 0..n {
                touching.push((offset + p, offset + p, 1e-6));
                for q in p + 1..n {
                    let (length, creased) = (graph.boundary[p * n + q], graph.creased[p * n + q]);
                    if length > 0.0 {
                        let smaller = graph.area[p].min(graph.area[q]).sqrt().max(1e-6);
                        let w = length * (-creased / length / CREASE_SCALE).exp() / smaller;
                        touching.push((offset + p, offset + q, w));
                    }
                }
            }
            offsets.push(offset + n);
            graphs.push(graph);
        }
        let n = *offsets.last().unwrap_or(&0);
        let touching = symmetric(n, touching.into_iter());
        Self {
            graphs,
            offsets,
            part_of_patch: numbered,
            weights,
            touching,
        }
    }

    fn len(&self) -> usize {
        self.weights.len()
    }

    fn patch_labels(&self, of_part: &[u32]) -> Vec<u32> {
        self.part_of_patch
            .iter()
            .map(|p| of_part[*p as usize])
            .collect()
    }

    /// Part vectors `(n_parts, 3 dim + 11)`: standardised over all parts, then weighted by group.
    fn vectors(&self, shapes: &Prepared<'_>, weighting: &[f64; 10]) -> Vec<f64> {
        let mut column_weights = Vec::with_capacity(shapes.dim);
        for ((_, width), g) in super::features::groups(shapes.up_known)
            .iter()
            .zip(weighting)
        {
            column_weights.extend(std::iter::repeat_n(g / (*width as f64).sqrt(), *width));
        }
        let n_shape = PartGraph::N_SHAPE;
        type Block = (fn(&PartGraph) -> &[f64], Vec<f64>);
        let blocks: [Block; 4] = [
            (|g| &g.mean, column_weights.clone()),
            (
                |g| &g.spread,
                column_weights.iter().map(|w| w * SPREAD_WEIGHT).collect(),
            ),
            (
                |g| &g.context,
                column_weights.iter().map(|w| w * CONTEXT_WEIGHT).collect(),
            ),
            (
                |g| &g.shape,
                vec![SHAPE_WEIGHT / (n_shape as f64).sqrt(); n_shape],
            ),
        ];
        let total: usize = blocks.iter().map(|b| b.1.len()).sum();
        let mut out = vec![0.0; self.len() * total];
        let mut at = 0;
        for (values, weights) in blocks {
            let width = weights.len();
            for (c, weight) in weights.iter().enumerate() {
                let column: Vec<f64> = self
                    .graphs
                    .iter()
                    .flat_map(|g| values(g).chunks_exact(width).map(move |row| row[c]))
                    .collect();
                for (row, z) in standardised(&column, &self.weights).into_iter().enumerate() {
                    out[row * total + at + c] = z * weight;
                }
            }
            at += width;
        }
        out
    }
}

fn standardised(column: &[f64], weights: &[f64]) -> Vec<f64> {
    let total: f64 = weights.iter().sum();
    let mean = column.iter().zip(weights).map(|(x, w)| x * w).sum::<f64>() / total;
    let variance = column
        .iter()
        .zip(weights)
        .map(|(x, w)| w * (x - mean) * (x - mean))
        .sum::<f64>()
        / total;
    let deviation = variance.sqrt() + 1e-9;
    column
        .iter()
        .map(|x| ((x - mean) / deviation).clamp(-CLIP, CLIP))
        .collect()
}

/// The first `width` eigenvectors, rows scaled to length 1 (Ng, Jordan and Weiss 2001).
fn row_normalised(basis: &nalgebra::DMatrix<f64>, width: usize) -> Vec<f64> {
    let mut out = Vec::with_capacity(basis.nrows() * width);
    for row in basis.row_iter() {
        let norm = row.columns(0, width).norm().max(1e-9);
        out.extend(row.iter().take(width).map(|x| x / norm));
    }
    out
}

/// Diffusion coordinates after three steps, without the constant one (Coifman and Lafon 2006).
fn diffusion(
    values: &[f64],
    basis: &nalgebra::DMatrix<f64>,
    degrees: &[f64],
    width: usize,
) -> Vec<f64> {
    let mut out = Vec::with_capacity(basis.nrows() * (width - 1));
    for (row, degree) in basis.row_iter().zip(degrees) {
        out.extend(
            (1..width).map(|c| row[c] / degree.sqrt().max(1e-12) * values[c].max(0.0).powi(3)),
        );
    }
    out
}
