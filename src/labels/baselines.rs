//! Baselines for `coseg-bench labels`: other methods on the same descriptors.
//!
//! Each of them groups the patches of all shapes at once into k clusters. It has no classifier, no
//! cut and no choice among candidates.

use super::discover::{DiscoveryInput, Prepared};
use super::joint::{Rows, diffusion, embedding, inter_shape, row_normalised, symmetric};
use crate::linalg::kmeans::kmeans;
use nalgebra::{Cholesky, DMatrix};
use std::collections::BTreeMap;

/// Number of starts of each k-means.
const N_STARTS: usize = 5;
/// Ridge of the self-representation, relative to the mean squared norm of a patch.
const RIDGE: f64 = 0.1;
/// Number of strongest links that are retained for each patch.
const N_LINKS: usize = 20;

/// A method of other authors that labels shapes together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Baseline {
    /// k-means on patch descriptors.
    PatchKMeans,
    /// Clustering in the diffusion space of the patches: Sidi et al. 2011, *Unsupervised
    /// Co-Segmentation of a Set of Shapes via Descriptor-Space Spectral Clustering*.
    Diffusion,
    /// Represents each patch by the others: Hu, Fan and Liu 2012, *Co-Segmentation of 3D Shapes via
    /// Subspace Clustering*. Uses least squares (Lu et al. 2012), which has a closed form.
    Subspace,
}

impl Baseline {
    /// All baselines with their names in a table.
    pub const ALL: [(Self, &'static str); 3] = [
        (Self::PatchKMeans, "patch k-means"),
        (Self::Diffusion, "diffusion space (DSSC-style)"),
        (Self::Subspace, "subspace clustering (style)"),
    ];
}

/// Returns a label below `k` for each face of each shape. Deterministic for a given seed.
pub fn baseline(which: Baseline, input: &DiscoveryInput<'_>, k: usize, seed: u64) -> Vec<Vec<u32>> {
    if input.shapes.is_empty() {
        return Vec::new();
    }
    let shapes = Prepared::new(input);
    let of_patch = match which {
        Baseline::PatchKMeans => {
            let clusters = kmeans(&shapes.means, shapes.dim, &shapes.area, k, seed, N_STARTS);
            return shapes.on_faces(&clusters);
        }
        Baseline::Diffusion => {
            let graph = inter_shape(&Rows {
                values: &shapes.means,
                dim: shapes.dim,
                offsets: &shapes.offsets,
            });
            let (values, basis, degrees) = embedding(&graph, k + 1);
            let width = (k + 1).min(basis.ncols());
            let points = diffusion(&values, &basis, &degrees, width);
            kmeans(&points, width - 1, &shapes.area, k, seed, N_STARTS)
        }
        Baseline::Subspace => {
            let (_, basis, _) = embedding(&self_representation(&shapes), k);
            let width = k.min(basis.ncols());
            let points = row_normalised(&basis, width);
            kmeans(&points, width, &shapes.area, k, seed, N_STARTS)
        }
    };
    shapes.on_faces(&of_patch)
}

/// Computes the affinity `|Z| + |Z|ᵀ` of the Z that minimises `‖X − X Z‖² + λ‖Z‖²`, restricted to
/// the strongest links of each patch.
fn self_representation(shapes: &Prepared<'_>) -> sprs::CsMat<f64> {
    let n = shapes.area.len();
    let x = DMatrix::from_column_slice(shapes.dim, n, &shapes.means);
    let mut gram = &x * x.transpose();
    let ridge = RIDGE * gram.trace() / n.max(1) as f64 + 1e-9;
    for c in 0..shapes.dim {
        gram[(c, c)] += ridge;
    }
    // (XᵀX + λ)⁻¹ XᵀX = Xᵀ (X Xᵀ + λ)⁻¹ X
    let solved = Cholesky::new(gram).map_or_else(|| x.clone(), |factor| factor.solve(&x));
    let mut links = BTreeMap::<(usize, usize), f64>::new();
    for i in 0..n {
        let row = x.tr_mul(&solved.column(i));
        let mut order: Vec<usize> = (0..n).filter(|j| *j != i).collect();
        order.sort_by(|&a, &b| row[b].abs().total_cmp(&row[a].abs()).then(a.cmp(&b)));
        for &j in order.iter().take(N_LINKS) {
            *links.entry((i.min(j), i.max(j))).or_default() += row[j].abs();
        }
    }
    symmetric(n, links.into_iter().map(|((i, j), w)| (i, j, w)))
}

#[cfg(test)]
mod tests {
    use super::super::test_shapes::Strips;
    use super::*;

    #[test]
    fn parts_with_descriptors_of_their_own_are_found_by_all() {
        let strips = Strips::new(4, 3, 0.3);
        for (which, name) in Baseline::ALL {
            let labels = baseline(which, &strips.input(), 3, 1);
            let right = strips.right(&labels);
            assert!(right > 0.95, "{name}: {right}");
            assert_eq!(labels, baseline(which, &strips.input(), 3, 1), "{name}");
        }
    }
}
