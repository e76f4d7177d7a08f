//! Holds the spectral basis of a shape, and provides the dense products that maps need.

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
    ///
    /// ```
    /// use coseg_geometry::fmap::Basis;
    ///
    /// let basis = Basis {
    ///     eigenvalues: &[0.0, 1.0],
    ///     eigenvectors: &[1.0, 2.0, 1.0, -2.0], // two vertices, two eigenvectors
    ///     n_eigenvectors: 2,
    ///     mass: &[0.5, 0.5],
    /// };
    /// assert_eq!(basis.rows(&[1, 0], 2), [1.0, -2.0, 1.0, 2.0]);
    /// assert_eq!(basis.leading(1), [1.0, 1.0]);
    /// ```
    ///
    /// # Panics
    /// If there are fewer than `k` or a vertex does not exist.
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
    ///
    /// ```
    /// use coseg_geometry::{SpectralMesh, mesh::icosphere, operators::Operator, spectrum::Options};
    ///
    /// let sphere = SpectralMesh::new(icosphere(2), Operator::Tufted, 4, &Options::default())?;
    /// // An eigenvector has one coefficient, its own.
    /// let third: Vec<f32> = sphere.basis().rows(&Vec::from_iter(0..162), 4);
    /// let third: Vec<f32> = third.chunks_exact(4).map(|row| row[2]).collect();
    /// let found = sphere.basis().project(&third, 1, 4);
    /// assert!((found[2] - 1.0).abs() < 1e-4 && found[1].abs() < 1e-4);
    /// # Ok::<_, coseg_geometry::SpectralMeshError>(())
    /// ```
    pub fn project(&self, values: &[f32], dim: usize, k: usize) -> Vec<f32> {
        let weighted: Vec<f32> = values
            .chunks_exact(dim.max(1))
            .zip(self.mass)
            .flat_map(|(row, m)| row.iter().map(move |x| x * m))
            .collect();
        transposed_product(&self.leading(k), &weighted, self.n_vertices(), k, dim)
    }
}

/// `a b` `(m, n)` with `a (m, inner)` and `b (inner, n)`, all row-major.
///
/// ```
/// use coseg_geometry::fmap::basis::product;
///
/// assert_eq!(product(&[1.0, 2.0, 3.0, 4.0], &[5.0, 6.0], 2, 2, 1), [17.0, 39.0]);
/// ```
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

/// `a bᵀ` `(m, n)` with `a (m, inner)` and `b (n, inner)`, all row-major.
///
/// ```
/// use coseg_geometry::fmap::basis::product_transposed;
///
/// assert_eq!(product_transposed(&[1.0, 2.0], &[3.0, 4.0, 5.0, 6.0], 1, 2, 2), [11.0, 17.0]);
/// ```
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

/// `aᵀ b` `(m, n)` with `a (inner, m)` and `b (inner, n)`, all row-major.
///
/// ```
/// use coseg_geometry::fmap::basis::transposed_product;
///
/// assert_eq!(transposed_product(&[1.0, 2.0], &[3.0, 4.0], 2, 1, 1), [11.0]);
/// ```
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
