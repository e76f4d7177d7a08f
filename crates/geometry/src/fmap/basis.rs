//! The spectral basis of a shape, and the dense products that maps are made of.

use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};

/// Spectrum of a shape of total mass 1.
#[derive(Debug, Clone, Copy)]
pub struct Basis<'a> {
    /// Eigenvalues, ascending; at least as many as eigenvectors.
    pub eigenvalues: &'a [f64],
    /// Mass-orthonormal eigenvectors `(n, n_eigenvectors)`, row-major.
    pub eigenvectors: &'a [f32],
    /// Columns of `eigenvectors`.
    pub n_eigenvectors: usize,
    /// Lumped mass `(n,)`.
    pub mass: &'a [f32],
}

impl Basis<'_> {
    /// Number of vertices.
    pub fn n_vertices(&self) -> usize {
        self.mass.len()
    }

    /// The first `k` eigenvectors at a vertex.
    ///
    /// # Panics
    /// If there are fewer than `k` or the vertex does not exist.
    pub fn row(&self, vertex: u32, k: usize) -> &[f32] {
        let from = vertex as usize * self.n_eigenvectors;
        &self.eigenvectors[from..from + self.n_eigenvectors][..k]
    }

    /// The first `k` eigenvectors at some vertices `(vertices, k)`, row-major.
    pub fn rows(&self, vertices: &[u32], k: usize) -> Vec<f32> {
        let mut rows = Vec::with_capacity(vertices.len() * k);
        for &v in vertices {
            rows.extend_from_slice(self.row(v, k));
        }
        rows
    }

    /// The first `k` eigenvectors `(n, k)`, row-major.
    pub fn leading(&self, k: usize) -> Vec<f32> {
        super::samples::columns(self.eigenvectors, self.n_eigenvectors.max(1), k)
    }

    /// Coefficients `(k, dim)` of functions `values (n, dim)`: `Φᵀ A values`, all row-major.
    pub fn project(&self, values: &[f32], dim: usize, k: usize) -> Vec<f32> {
        let weighted: Vec<f32> = values
            .chunks_exact(dim.max(1))
            .zip(self.mass)
            .flat_map(|(row, m)| row.iter().map(move |x| x * m))
            .collect();
        transposed_product(&self.leading(k), &weighted, self.n_vertices(), k, dim)
    }
}

/// `a b` with `a (m, inner)` and `b (inner, n)`, all row-major.
pub fn product(a: &[f32], b: &[f32], m: usize, inner: usize, n: usize) -> Vec<f32> {
    let mut out = vec![0.0; m * n];
    matmul(
        MatMut::from_row_major_slice_mut(&mut out, m, n),
        Accum::Replace,
        MatRef::from_row_major_slice(a, m, inner),
        MatRef::from_row_major_slice(b, inner, n),
        1.0,
        Par::Seq,
    );
    out
}

/// `a bᵀ` with `a (m, inner)` and `b (n, inner)`, all row-major.
pub fn product_transposed(a: &[f32], b: &[f32], m: usize, inner: usize, n: usize) -> Vec<f32> {
    let mut out = vec![0.0; m * n];
    matmul(
        MatMut::from_row_major_slice_mut(&mut out, m, n),
        Accum::Replace,
        MatRef::from_row_major_slice(a, m, inner),
        MatRef::from_row_major_slice(b, n, inner).transpose(),
        1.0,
        Par::Seq,
    );
    out
}

/// `aᵀ b` with `a (inner, m)` and `b (inner, n)`, all row-major.
pub fn transposed_product(a: &[f32], b: &[f32], inner: usize, m: usize, n: usize) -> Vec<f32> {
    let mut out = vec![0.0; m * n];
    matmul(
        MatMut::from_row_major_slice_mut(&mut out, m, n),
        Accum::Replace,
        MatRef::from_row_major_slice(a, inner, m).transpose(),
        MatRef::from_row_major_slice(b, inner, n),
        1.0,
        Par::Seq,
    );
    out
}
