//! The method of the source paper, as published: the baseline for all other methods here.
//!
//! Yang and Tian, *Unsupervised Co-segmentation of 3D Shapes via Functional Maps*. The basis is 50
//! eigenfunctions of the mesh Laplacian of eq. (6). Every shape is divided on its own, by k-means
//! on its global point signatures, into as many parts as there are labels. Maps are the
//! least-squares solution for 100 heat kernel signatures. Parts take the label of the corresponding
//! part of a reference shape. The paper leaves the choice of the reference open; here it is the
//! shape whose maps to all others have the least residual.

use super::spectrum_of;
use super::{DescribeError, DescriptionView, N_HKS_TIMES, Params};
use crate::descriptors::{gps, hks, hks_times};
use crate::linalg::assignment::assignment;
use crate::linalg::kmeans::kmeans;
use crate::mesh::bridges;
use crate::operators::Operator;
use nalgebra::DMatrix;
use rayon::prelude::{IntoParallelRefIterator, ParallelIterator};

/// Number of eigenfunctions in the basis.
const N_EIGENFUNCTIONS: u32 = 50;
/// Number of starts of each k-means.
const N_STARTS: usize = 10;
/// Singular values below this share of the greatest one count as zero, because signatures at 100
/// times are nearly dependent.
const RANK_TOLERANCE: f64 = 1e-9;

/// A shape divided into parts in its spectral basis.
struct Divided {
    /// `(n, k)`, `ΦᵀAΦ = I`.
    basis: DMatrix<f64>,
    mass: Vec<f64>,
    /// Coefficients of the heat kernel signatures `(k, times)`.
    coefficients: DMatrix<f64>,
    /// Their pseudo-inverse `(times, k)`.
    inverse: DMatrix<f64>,
    /// Part of each vertex `(n,)`, below the number of labels.
    parts: Vec<u32>,
}

impl Divided {
    fn new(shape: &DescriptionView<'_>, k: usize, seed: u64) -> Result<Self, DescribeError> {
        let mesh = shape.mesh();
        let params = Params {
            operator: Operator::MeshLaplace,
            n_eigenpairs: N_EIGENFUNCTIONS,
            ..Params::default()
        };
        let found = spectrum_of(&mesh, &bridges(&mesh), &params, &|_| true)?;
        let mass = found.operator.mass;
        let spectrum = found.spectrum.into_spectrum();
        let (values, basis) = (spectrum.eigenvalues, spectrum.eigenvectors);
        let signatures = hks(&values, &basis, &hks_times(&values, N_HKS_TIMES));
        let n = mass.len();
        let weighted = DMatrix::from_fn(n, N_HKS_TIMES, |v, t| {
            mass[v] * f64::from(signatures[v * N_HKS_TIMES + t])
        });
        let coefficients = basis.tr_mul(&weighted);
        let dims = basis.ncols().saturating_sub(1);
        let points: Vec<f64> = gps(&values, &basis, dims)
            .into_iter()
            .map(f64::from)
            .collect();
        let tolerance = RANK_TOLERANCE * coefficients.norm();
        let inverse = coefficients.clone().pseudo_inverse(tolerance);
        Ok(Self {
            parts: kmeans(&points, dims, &mass, k, seed, N_STARTS),
            inverse: inverse.expect("invariant: the tolerance is not negative"),
            coefficients,
            basis,
            mass,
        })
    }

    /// Returns the functional map `c_12` from this shape to another.
    fn map_to(&self, other: &Self) -> DMatrix<f64> {
        &other.coefficients * &self.inverse
    }

    /// Returns the residual of the other's signatures under `c_12`, relative to their norm.
    fn residual(&self, other: &Self) -> f64 {
        let left = self.map_to(other) * &self.coefficients - &other.coefficients;
        left.norm() / other.coefficients.norm().max(1e-300)
    }

    /// Returns, for each part of another shape, the corresponding part of this one, one to one, by
    /// the mapped indicators of this shape's parts.
    fn corresponding(&self, other: &Self, k: usize) -> Vec<u32> {
        let mut mine = DMatrix::zeros(self.mass.len(), k);
        for (v, p) in self.parts.iter().enumerate() {
            mine[(v, *p as usize)] = self.mass[v];
        }
        let mapped = &other.basis * (self.map_to(other) * self.basis.tr_mul(&mine));
        let mut cost = vec![0.0; k * k];
        for (v, p) in other.parts.iter().enumerate() {
            for l in 0..k {
                cost[*p as usize * k + l] -= other.mass[v] * mapped[(v, l)];
            }
        }
        let matched = assignment(&cost, k, k).into_iter();
        matched.map(|l| l.unwrap_or(0) as u32).collect()
    }
}

/// Returns a label below `k` for each proxy face of each shape. Deterministic for a given seed.
/// Maps all pairs of shapes, with matrices of 50 rows.
///
/// # Errors
/// A shape has no mesh Laplacian, or its spectrum cannot be proved complete.
pub fn yang_tian_baseline(
    shapes: &[DescriptionView<'_>],
    k: usize,
    seed: u64,
) -> Result<Vec<Vec<u32>>, DescribeError> {
    let divided: Vec<Divided> = shapes
        .par_iter()
        .map(|s| Divided::new(s, k, seed))
        .collect::<Result<_, _>>()?;
    let residuals: Vec<f64> = divided
        .par_iter()
        .map(|from| divided.iter().map(|to| from.residual(to)).sum())
        .collect();
    let reference =
        (0..divided.len()).min_by(|&a, &b| residuals[a].total_cmp(&residuals[b]).then(a.cmp(&b)));
    let Some(reference) = reference.map(|r| &divided[r]) else {
        return Ok(Vec::new());
    };
    let labels = divided.iter().zip(shapes).map(|(d, shape)| {
        let label = reference.corresponding(d, k);
        let at = |v: u32| label[d.parts[v as usize] as usize];
        let faces = shape.faces.iter().map(|f| {
            let [a, b, c] = f.map(at);
            if b == c { b } else { a }
        });
        faces.collect()
    });
    Ok(labels.collect())
}
