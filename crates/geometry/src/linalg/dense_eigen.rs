//! Computes all eigenpairs of a dense symmetric matrix (divide and conquer, from `faer`).

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::evd::{ComputeEigenvectors, self_adjoint_evd, self_adjoint_evd_scratch};
use faer::{Mat, MatRef, Par};

/// The dense eigen solver did not converge on a matrix of this size.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the dense eigen solver did not converge on a matrix of {n} rows")]
pub struct DenseEigenError {
    /// Rows of the matrix.
    pub n: usize,
}

/// Eigenvalues `(n,)` ascending and orthonormal eigenvectors `(n, n)`, column-major, of the
/// symmetric matrix `a (n, n)`, of which the lower triangle is read. One thread; O(n³).
///
/// ```
/// use coseg_geometry::linalg::dense_eigen::symmetric_eigen;
///
/// let (values, vectors) = symmetric_eigen(&[2.0, -1.0, -1.0, 2.0], 2)?;
/// assert!((values[0] - 1.0).abs() < 1e-12 && (values[1] - 3.0).abs() < 1e-12);
/// assert!((vectors[(0, 0)] - vectors[(1, 0)]).abs() < 1e-12);
/// # Ok::<_, coseg_geometry::linalg::dense_eigen::DenseEigenError>(())
/// ```
pub fn symmetric_eigen(a: &[f64], n: usize) -> Result<(Vec<f64>, Mat<f64>), DenseEigenError> {
    let a = MatRef::from_column_major_slice(a, n, n);
    let mut values = Mat::<f64>::zeros(n, 1);
    let mut vectors = Mat::<f64>::zeros(n, n);
    let scratch =
        self_adjoint_evd_scratch::<f64>(n, ComputeEigenvectors::Yes, Par::Seq, Default::default());
    let mut memory = MemBuffer::new(scratch);
    self_adjoint_evd(
        a,
        values.as_mut().col_mut(0).as_diagonal_mut(),
        Some(vectors.as_mut()),
        Par::Seq,
        MemStack::new(&mut memory),
        Default::default(),
    )
    .map_err(|_| DenseEigenError { n })?;
    Ok(((0..n).map(|i| values[(i, 0)]).collect(), vectors))
}
