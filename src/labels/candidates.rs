//! The parts of a few shapes become many candidate labellings, among which discovery chooses.

use super::criterion::{CREASE_SCALE, Criterion};
use super::discover::{Prepared, PreparedShape};
use super::joint::{Rows, combine, diffusion, embedding, inter_shape, row_normalised, symmetric};
use crate::linalg::kmeans::kmeans;
use crate::segmentation::{PartGraph, merge_patches};
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::ops::RangeInclusive;

/// Number of starts of each k-means.
const N_STARTS: usize = 3;
/// Number of labellings that the beam search retains while merging, and returns.
const BEAM_WIDTH: usize = 6;
const BEAM_KEPT: usize = 3;
/// Weight of the spread of a part's descriptors, relative to their means; then the weight of the
/// neighbours' means.
const SPREAD_WEIGHT: f64 = 0.5;
const CONTEXT_WEIGHT: f64 = 0.2;
const SHAPE_WEIGHT: f64 = 1.3;
/// Part vectors are clipped to this number of standard deviations.
const CLIP: f64 = 3.0;

/// Three weightings of the descriptor groups for the similarity of parts. The groups are sdf, agd,
/// gc, q, pc, pos, hks, hksn, wks, up.
const WEIGHTINGS: [[f64; 10]; 3] = [
    [1.0, 0.7, 0.5, 0.3, 1.6, 1.4, 1.0, 1.0, 1.5, 1.5],
    [0.7, 0.5, 0.3, 0.2, 0.7, 0.5, 1.0, 1.5, 2.0, 1.0],
    [1.0, 0.3, 0.2, 0.2, 2.0, 0.5, 0.5, 0.5, 1.5, 1.5],
];

/// Returns labellings of all patches with exactly `k` labels, without duplicates up to renaming.
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
    let each: Vec<PreparedShape<'_>> = shapes.each().collect();
    let merged: Vec<Vec<Vec<u32>>> = each
        .par_iter()
        .map(|s| merge_patches(s.patches, s.patch_means, shapes.dim, &sizes))
        .collect();
    let mut found = Pool {
        k,
        seen: BTreeSet::new(),
        labellings: Vec::new(),
    };
    let parts: Vec<Parts> = (0..granularities.len())
        .map(|g| Parts::new(shapes, merged.iter().map(|m| &m[g])))
        .collect();
    let n_weightings = if shapes.learned_metric {
        1
    } else {
        WEIGHTINGS.len()
    };
    let views: Vec<(usize, &[f64; 10])> = (0..granularities.len())
        .flat_map(|g| WEIGHTINGS[..n_weightings].iter().map(move |w| (g, w)))
        .collect();
    let groupings: Vec<Vec<Grouping>> = views
        .par_iter()
        .map(|&(g, weighting)| {
            let (_, alphas, extra) = granularities[g];
            let vectors = parts[g].vectors(shapes, weighting);
            parts[g].groupings(&vectors, alphas, k..=k + extra, seed)
        })
        .collect();
    let groupings: Vec<Grouping> = groupings.into_iter().flatten().collect();
    let merged: Vec<Vec<Vec<u32>>> = groupings
        .into_par_iter()
        .map(|g| merged_to(k, criterion, g.of_patch, g.n_labels))
        .collect();
    for labels in merged.into_iter().flatten() {
        let mut of_shape = [labels];
        let area = |_, patch: u32| shapes.area[patch as usize];
        shapes.links.repair(&mut of_shape, k, area);
        of_shape.into_iter().for_each(|labels| found.add(labels));
    }
    found.labellings
}

/// A grouping of all patches.
struct Grouping {
    n_labels: usize,
    of_patch: Vec<u32>,
}

/// Merges the labels of a labelling with `n_labels >= k` labels until `k` are left, by beam search,
/// and returns the best results.
fn merged_to(k: usize, criterion: &Criterion, labels: Vec<u32>, n_labels: usize) -> Vec<Vec<u32>> {
    let mut beam = vec![(criterion.pair_sums(&labels, n_labels), labels)];
    for size in (k + 1..=n_labels).rev() {
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
        next.truncate(if size - 1 > k { BEAM_WIDTH } else { BEAM_KEPT });
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
    beam.into_iter().map(|(_, labels)| labels).collect()
}

struct Pool {
    k: usize,
    seen: BTreeSet<Vec<u32>>,
    labellings: Vec<Vec<u32>>,
}

impl Pool {
    /// Adds a labelling, unless it has an empty label or the pool contains the same partition.
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
    /// Index of the first part of each shape.
    offsets: Vec<usize>,
    /// For each patch of all shapes, in order, the index of its part.
    part_of_patch: Vec<u32>,
    /// Square roots of the area shares.
    weights: Vec<f64>,
    /// Affinity of parts that touch.
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

    /// Groups the parts into each number of labels: by their vectors, and by the joint graph with
    /// each share of the intra-shape graph.
    fn groupings(
        &self,
        vectors: &[f64],
        alphas: &[f64],
        sizes: RangeInclusive<usize>,
        seed: u64,
    ) -> Vec<Grouping> {
        let dim = vectors.len() / self.len().max(1);
        let inter = inter_shape(&Rows {
            values: vectors,
            dim,
            offsets: &self.offsets,
        });
        let most = sizes.end() + 1;
        let embeddings: Vec<_> = alphas
            .iter()
            .map(|alpha| embedding(&combine(&inter, &self.touching, *alpha), most))
            .collect();
        let mut found = Vec::new();
        for n_labels in sizes {
            let mut take = |points: &[f64], dim: usize| {
                let of_part = kmeans(points, dim, &self.weights, n_labels, seed, N_STARTS);
                found.push(Grouping {
                    n_labels,
                    of_patch: self.patch_labels(&of_part),
                });
            };
            take(vectors, dim);
            for (values, basis, degrees) in &embeddings {
                let width = n_labels.min(basis.ncols());
                take(&row_normalised(basis, width), width);
                let next = (n_labels + 1).min(basis.ncols());
                take(&diffusion(values, basis, degrees, next), next - 1);
            }
        }
        found
    }

    fn patch_labels(&self, of_part: &[u32]) -> Vec<u32> {
        self.part_of_patch
            .iter()
            .map(|p| of_part[*p as usize])
            .collect()
    }

    /// Returns part vectors `(n_parts, 3 dim + 11)`. They are standardised over all parts and
    /// weighted by descriptor group. In a learned metric, where columns are comparable, they are
    /// scaled as a whole instead.
    fn vectors(&self, shapes: &Prepared<'_>, weighting: &[f64; 10]) -> Vec<f64> {
        let mut column_weights = Vec::with_capacity(shapes.dim);
        for ((_, width), g) in super::features::groups(shapes.up_known)
            .iter()
            .zip(weighting)
        {
            column_weights.extend(std::iter::repeat_n(g / (*width as f64).sqrt(), *width));
        }
        let n_shape = PartGraph::N_SHAPE;
        let shape_weights = vec![SHAPE_WEIGHT / (n_shape as f64).sqrt(); n_shape];
        type Block<'b> = (fn(&PartGraph) -> &[f64], f64, &'b [f64]);
        let blocks: [Block<'_>; 4] = [
            (|g| &g.mean, 1.0, &column_weights),
            (|g| &g.spread, SPREAD_WEIGHT, &column_weights),
            (|g| &g.context, CONTEXT_WEIGHT, &column_weights),
            (|g| &g.shape, 1.0, &shape_weights),
        ];
        let total: usize = blocks.iter().map(|b| b.2.len()).sum();
        let mut out = vec![0.0; self.len() * total];
        let mut at = 0;
        for (b, (values, share, weights)) in blocks.into_iter().enumerate() {
            let width = weights.len();
            let as_a_whole = shapes.learned_metric && b < 3;
            let columns: Vec<Column> = (0..width)
                .map(|c| {
                    let values = self
                        .graphs
                        .iter()
                        .flat_map(|g| values(g).chunks_exact(width).map(move |row| row[c]));
                    Column::new(values.collect(), &self.weights)
                })
                .collect();
            let variance: f64 = columns.iter().map(|c| c.variance).sum();
            let norm: f64 = weights.iter().map(|w| w * w).sum();
            let as_one = (variance / norm).sqrt() + 1e-9;
            for (c, (column, weight)) in columns.iter().zip(weights).enumerate() {
                let (deviation, clip, weight) = if as_a_whole {
                    (as_one, f64::INFINITY, 1.0)
                } else {
                    (column.variance.sqrt() + 1e-9, CLIP, *weight)
                };
                for (row, z) in column.scaled(deviation, clip, share * weight).enumerate() {
                    out[row * total + at + c] = z;
                }
            }
            at += width;
        }
        out
    }
}

/// One column of part vectors, centred.
struct Column {
    centred: Vec<f64>,
    variance: f64,
}

impl Column {
    fn new(mut values: Vec<f64>, weights: &[f64]) -> Self {
        let total: f64 = weights.iter().sum();
        let mean = values.iter().zip(weights).map(|(x, w)| x * w).sum::<f64>() / total;
        values.iter_mut().for_each(|x| *x -= mean);
        let variance = values
            .iter()
            .zip(weights)
            .map(|(x, w)| w * x * x)
            .sum::<f64>()
            / total;
        Self {
            centred: values,
            variance,
        }
    }

    /// Divides by `deviation`, clips at `clip` and multiplies by `weight`.
    fn scaled(&self, deviation: f64, clip: f64, weight: f64) -> impl Iterator<Item = f64> {
        let scale = move |x: &f64| weight * (x / deviation).clamp(-clip, clip);
        self.centred.iter().map(scale)
    }
}
