//! Refines labellings of patches, and learns a metric from them, without computing on faces.
//!
//! Alternating between a linear classifier and a cut on the about 80 patches of a shape costs a
//! hundredth of what it costs on its faces, so every candidate can be refined before one is chosen.
//! The scatter within the labels of the best candidates shows which descriptors vary within a part.
//! Parts are then grouped once more in the metric that weighs these descriptors down (linear
//! discriminant analysis; Ding and Li 2007, *Adaptive dimension reduction using discriminant
//! analysis and K-means clustering*, alternate the two).

use super::Features;
use super::cut::cut;
use super::discover::Prepared;
use super::links::Links;
use crate::segmentation::{PatchGraph, Surface, SurfaceEdge};
use nalgebra::{Cholesky, DMatrix};
use std::collections::BTreeMap;

/// Rounds of classifier and cut.
const ROUNDS: usize = 3;
/// Boundary strength; then the upper limit of the evidence, in nats; as in the refinement of faces.
const STRENGTH: f64 = 5.0;
const CAP_NATS: f64 = 7.0;
/// Share of the mean variance that is mixed into the scatter within labels: for a classifier; then
/// for a metric.
const SHRINKAGE: f64 = 0.02;
const METRIC_SHRINKAGE: f64 = 0.1;

/// The patches of all shapes as one sample of descriptors, and the patches of each shape as a small
/// surface.
pub(super) struct Patchwise<'a> {
    dim: usize,
    /// Descriptors `(dim, n_patches)` and area shares of the patches.
    means: DMatrix<f64>,
    area: &'a [f64],
    offsets: &'a [usize],
    /// Area-weighted sum of outer products `(dim, dim)`.
    moment: DMatrix<f64>,
    surfaces: Vec<Surface>,
    links: &'a Links,
}

impl<'a> Patchwise<'a> {
    pub(super) fn new(shapes: &'a Prepared<'_>) -> Self {
        let dim = shapes.dim;
        let means = DMatrix::from_column_slice(dim, shapes.area.len(), &shapes.means);
        let mut weighted = means.clone();
        for (mut column, a) in weighted.column_iter_mut().zip(&shapes.area) {
            column *= a.sqrt();
        }
        Self {
            dim,
            moment: &weighted * weighted.transpose(),
            means,
            area: &shapes.area,
            offsets: &shapes.offsets,
            links: &shapes.links,
            surfaces: shapes
                .each()
                .map(|s| coarse(s.surface, s.patches))
                .collect(),
        }
    }

    /// Returns area `(k,)`, mean descriptors `(dim, k)` and scatter within labels `(dim, dim)` of a
    /// labelling.
    fn scatter(&self, labels: &[u32], k: usize) -> (Vec<f64>, DMatrix<f64>, DMatrix<f64>) {
        let mut counts = vec![0.0; k];
        let mut sums = DMatrix::zeros(self.dim, k);
        for ((l, a), x) in labels.iter().zip(self.area).zip(self.means.column_iter()) {
            counts[*l as usize] += a;
            sums.column_mut(*l as usize).axpy(*a, &x, 1.0);
        }
        let total: f64 = counts.iter().sum();
        let mut mean = sums.clone();
        for (mut column, n) in mean.column_iter_mut().zip(&counts) {
            column /= n.max(1e-12);
        }
        let within = (&self.moment - sums * mean.transpose()) / total.max(1e-300);
        (counts, mean, within)
    }

    /// Refines a labelling by some rounds of linear classifier and cut. Returns it unchanged if a
    /// label would be lost.
    pub(super) fn refine(&self, given: &[u32], k: usize) -> Vec<u32> {
        let mut labels = given.to_vec();
        for _ in 0..ROUNDS {
            let (counts, mean, within) = self.scatter(&labels, k);
            let Some(factor) = Cholesky::new(shrunk(within, SHRINKAGE)) else {
                break;
            };
            let weights = factor.solve(&mean);
            let total: f64 = counts.iter().sum();
            let bias: Vec<f64> = (0..k)
                .map(|l| {
                    let half = weights.column(l).dot(&mean.column(l)) / 2.0;
                    (counts[l] / total.max(1e-300)).max(1e-9).ln() - half
                })
                .collect();
            let scores = self.means.tr_mul(&weights);
            let evidence = |p: usize| -> Vec<f64> {
                let row: Vec<f64> = (0..k).map(|l| scores[(p, l)] + bias[l]).collect();
                let top = row.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                let log_sum = row.iter().map(|s| (s - top).exp()).sum::<f64>().ln() + top;
                row.iter().map(|s| (log_sum - s).min(CAP_NATS)).collect()
            };
            let fixed = self.decided(&evidence, k);
            let mut next = Vec::with_capacity(labels.len());
            for (surface, range) in self.surfaces.iter().zip(self.offsets.windows(2)) {
                let unary: Vec<f64> = (range[0]..range[1]).flat_map(evidence).collect();
                let fixed = fixed.as_ref().map(|f| &f[range[0]..range[1]]);
                next.extend(cut(surface, &unary, k, STRENGTH, fixed));
            }
            let settled = next == labels;
            labels = next;
            if settled {
                break;
            }
        }
        let lost = (0..k as u32).any(|l| !labels.contains(&l));
        if lost { given.to_vec() } else { labels }
    }

    /// Returns the class of each patch that demands decide; `None` if nothing is demanded.
    fn decided(&self, evidence: &dyn Fn(usize) -> Vec<f64>, k: usize) -> Option<Vec<Option<u32>>> {
        if self.links.is_empty() {
            return None;
        }
        let costs = self.links.costs(k, |_, patch, class| {
            self.area[patch as usize] * evidence(patch as usize)[class]
        });
        let classes = self.links.classes(&costs, k);
        self.links.fixed(&classes, &[self.area.len()]).pop()
    }

    /// Returns the metric in which the labels of some labellings have isotropic scatter on average:
    /// a `(dim, dim)` factor L of the inverse scatter within labels, `W⁻¹ = L Lᵀ`, to be applied as
    /// `Lᵀ x`.
    pub(super) fn metric(&self, labellings: &[&Vec<u32>], k: usize) -> Option<DMatrix<f64>> {
        let mut within = DMatrix::zeros(self.dim, self.dim);
        for labels in labellings {
            within += self.scatter(labels, k).2;
        }
        within /= labellings.len().max(1) as f64;
        let inverse = Cholesky::new(shrunk(within, METRIC_SHRINKAGE))?.inverse();
        Cholesky::new(inverse).map(|factor| factor.unpack())
    }
}

/// Returns descriptors in a metric.
pub(super) fn in_metric(features: &Features, metric: &DMatrix<f64>) -> Features {
    let dim = features.dim;
    let rows = features.data.iter().map(|x| f64::from(*x));
    let x = DMatrix::from_iterator(dim, features.data.len() / dim.max(1), rows);
    let y = metric.tr_mul(&x);
    Features {
        data: y.iter().map(|v| *v as f32).collect(),
        dim,
    }
}

/// Adds `share` of the mean variance of a scatter matrix to its diagonal.
fn shrunk(mut scatter: DMatrix<f64>, share: f64) -> DMatrix<f64> {
    let dim = scatter.nrows();
    let ridge = share * scatter.trace() / dim.max(1) as f64;
    scatter *= 1.0 - share;
    for c in 0..dim {
        scatter[(c, c)] += ridge.max(1e-9);
    }
    scatter
}

/// Returns the patches of a shape as the faces of a small surface. Boundaries between them cost as
/// much as on the faces, relative to the evidence.
fn coarse(surface: &Surface, patches: &PatchGraph) -> Surface {
    let mut costs = BTreeMap::<[u32; 2], (f64, f64)>::new();
    for e in &surface.edges {
        let [a, b] = e.faces.map(|f| patches.patch_of_face[f as usize]);
        if a != b {
            let sum = costs.entry([a.min(b), a.max(b)]).or_default();
            sum.0 += e.boundary_cost;
            sum.1 += e.length;
        }
    }
    let scale = patches.len() as f64 / surface.n_faces().max(1) as f64;
    Surface {
        area: patches.area.clone(),
        centroids: vec![[0.0; 3]; patches.len()],
        edges: costs
            .into_iter()
            .map(|(faces, (cost, length))| SurfaceEdge {
                faces,
                length,
                crease: 0.0,
                boundary_cost: scale * cost,
            })
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::super::test_shapes::Strips;
    use super::*;

    #[test]
    fn wrong_patches_are_put_right_and_no_label_is_lost() {
        let strips = Strips::new(20, 3, 0.3);
        let input = strips.input();
        let shapes = Prepared::new(&input);
        let truth: Vec<u32> = (0..20).flat_map(|_| (0..18).map(|p| p / 6)).collect();
        let mut spoilt = truth.clone();
        for p in (0..spoilt.len()).step_by(7) {
            spoilt[p] = (spoilt[p] + 1) % 3;
        }
        let patchwise = Patchwise::new(&shapes);
        assert_eq!(patchwise.refine(&spoilt, 3), truth);
        // A fourth label on one patch of one shape would be lost, so the labelling stays unchanged.
        let mut lone = truth.clone();
        lone[0] = 3;
        assert!(patchwise.refine(&lone, 4).contains(&3));
    }

    #[test]
    fn labels_are_round_in_their_own_metric() {
        let strips = Strips::new(4, 3, 0.3);
        let input = strips.input();
        let shapes = Prepared::new(&input);
        let truth: Vec<u32> = (0..4).flat_map(|_| (0..18).map(|p| p / 6)).collect();
        let patchwise = Patchwise::new(&shapes);
        let within = patchwise.scatter(&truth, 3).2;
        let metric = patchwise.metric(&[&truth], 3).unwrap();
        let round = metric.transpose() * shrunk(within, METRIC_SHRINKAGE) * &metric;
        let off = (&round - DMatrix::identity(92, 92)).norm();
        assert!(off < 1e-6, "{off}");
    }
}
