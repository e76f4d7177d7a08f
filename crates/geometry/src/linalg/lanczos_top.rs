//! Computes the largest eigenpairs of a sparse symmetric matrix by Lanczos with full
//! re-orthogonalisation.
//!
//! It serves the affinity graphs of co-segmentation (a thousand rows, ten pairs), which need only a
//! good embedding. The Laplacian spectra that users see come from a block method with a proof of
//! completeness instead.

use nalgebra::{DMatrix, DVector, SymmetricEigen};
use sprs::CsMat;

/// The `k` algebraically largest eigenvalues of `matrix (n, n)`, descending, and their eigenvectors
/// `(n, k)`, orthonormal, each with its entry of largest magnitude positive. Started from the
/// constant vector plus a fixed small perturbation, so the result is deterministic. `k` is cut to
/// `n`.
///
/// ```
/// use coseg_geometry::linalg::lanczos_top::largest_eigenpairs;
///
/// let identity = sprs::CsMat::<f64>::eye(3);
/// let (values, vectors) = largest_eigenpairs(&identity, 5);
/// assert!(values.iter().all(|x| (x - 1.0).abs() < 1e-12));
/// assert_eq!(vectors.shape(), (3, 3));
/// ```
pub fn largest_eigenpairs(matrix: &CsMat<f64>, k: usize) -> (Vec<f64>, DMatrix<f64>) {
    let n = matrix.rows();
    let k = k.min(n);
    if n <= 96 || k * 3 >= n {
        return select(SymmetricEigen::new(dense(matrix)), k, None);
    }
    const TOLERANCE: f64 = 1e-9;
    let max_steps = n.min(600);
    let mut basis: Vec<DVector<f64>> = Vec::with_capacity(max_steps);
    let (mut alpha, mut beta): (Vec<f64>, Vec<f64>) = (Vec::new(), Vec::new());
    // The perturbation is a linear congruence: no eigenvector of interest is orthogonal to it.
    let mut v = DVector::from_fn(n, |i, _| {
        1.0 + 0.1 * (((i * 7919 + 13) % 1009) as f64 / 1009.0 - 0.5)
    });
    v /= v.norm();
    loop {
        let mut w = product(matrix, &v);
        alpha.push(w.dot(&v));
        basis.push(v);
        for _ in 0..2 {
            for b in &basis {
                let c = w.dot(b);
                w.axpy(-c, b, 1.0);
            }
        }
        let norm = w.norm();
        let m = basis.len();
        let done = m >= max_steps || norm < 1e-13;
        if done || (m >= 3 * k && m.is_multiple_of(20)) {
            let mut t = DMatrix::zeros(m, m);
            for i in 0..m {
                t[(i, i)] = alpha[i];
                if i + 1 < m {
                    t[(i, i + 1)] = beta[i];
                    t[(i + 1, i)] = beta[i];
                }
            }
            let ritz = SymmetricEigen::new(t);
            let order = descending(&ritz.eigenvalues, k);
            let converged = order
                .iter()
                .all(|&j| (norm * ritz.eigenvectors[(m - 1, j)]).abs() < TOLERANCE);
            if done || converged {
                let q = DMatrix::from_columns(&basis);
                return select(ritz, k, Some(&q));
            }
        }
        beta.push(norm);
        v = w / norm;
    }
}

fn product(matrix: &CsMat<f64>, x: &DVector<f64>) -> DVector<f64> {
    DVector::from_iterator(
        matrix.rows(),
        matrix
            .outer_iterator()
            .map(|row| row.iter().map(|(j, a)| a * x[j]).sum::<f64>()),
    )
}

fn dense(matrix: &CsMat<f64>) -> DMatrix<f64> {
    let mut d = DMatrix::zeros(matrix.rows(), matrix.cols());
    for (&a, (i, j)) in matrix {
        d[(i, j)] = a;
    }
    d
}

fn descending(values: &DVector<f64>, k: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by(|&a, &b| values[b].total_cmp(&values[a]));
    order.truncate(k);
    order
}

fn select(
    eigen: SymmetricEigen<f64, nalgebra::Dyn>,
    k: usize,
    basis: Option<&DMatrix<f64>>,
) -> (Vec<f64>, DMatrix<f64>) {
    let order = descending(&eigen.eigenvalues, k);
    let chosen = DMatrix::from_columns(
        &order
            .iter()
            .map(|&j| eigen.eigenvectors.column(j))
            .collect::<Vec<_>>(),
    );
    let mut vectors = basis.map_or(chosen.clone(), |q| q * &chosen);
    for mut column in vectors.column_iter_mut() {
        let largest = column
            .iter()
            .fold(0.0f64, |m, x| if x.abs() > m.abs() { *x } else { m });
        if largest < 0.0 {
            column.neg_mut();
        }
    }
    (
        order.iter().map(|&j| eigen.eigenvalues[j]).collect(),
        vectors,
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use sprs::TriMat;

    #[test]
    fn path_graph_has_its_known_spectrum() {
        // Adjacency of a path of n nodes: 2 cos(j π / (n + 1)).
        let n = 400;
        let mut t = TriMat::new((n, n));
        for i in 0..n - 1 {
            t.add_triplet(i, i + 1, 1.0);
            t.add_triplet(i + 1, i, 1.0);
        }
        let (values, vectors) = largest_eigenpairs(&t.to_csr(), 6);
        for (j, v) in values.iter().enumerate() {
            let exact = 2.0 * ((j + 1) as f64 * std::f64::consts::PI / (n as f64 + 1.0)).cos();
            assert!((v - exact).abs() < 1e-6, "{j}: {v} {exact}");
        }
        let gram = vectors.transpose() * &vectors;
        assert!((gram - DMatrix::identity(6, 6)).amax() < 1e-9);
    }
}
