//! Converts functional maps to pointwise maps and back.
//!
//! Ovsjanikov et al. 2012, *Functional Maps*; Ezuz and Ben-Chen 2017, *Deblurring and Denoising of
//! Maps between Shapes*. A vertex is represented by its delta function; the distance of two
//! vertices is that of their deltas in a spectral basis.

use super::basis::{Basis, product, product_transposed};
use crate::linalg::nearest::nearest_rows;

/// `c_12 (k2, k1)` of a pointwise map `p2p_21 (n2,)`: `Φ₂ᵀ A₂ Φ₁[p2p_21]`, row-major. It transfers
/// coefficients on shape 1 to coefficients on shape 2. O(n2 k1 k2).
///
/// ```
/// use coseg_geometry::fmap::convert::functional;
/// use coseg_geometry::{SpectralMesh, mesh::icosphere, operators::Operator, spectrum::Options};
///
/// let sphere = SpectralMesh::new(icosphere(2), Operator::Tufted, 4, &Options::default())?;
/// let points = &sphere.mesh.vertices;
/// // The map of the sphere that takes each vertex to the opposite one.
/// let opposite = |p: &[f64; 3]| {
///     points.iter().position(|q| (0..3).all(|i| (p[i] + q[i]).abs() < 1e-9)).unwrap() as u32
/// };
/// let p2p: Vec<u32> = points.iter().map(opposite).collect();
/// let c = functional(&sphere.basis(), &sphere.basis(), &p2p, 4, 4);
/// // Constants stay as they are; the next three eigenfunctions, x, y and z, change their signs.
/// for (i, expected) in [1.0, -1.0, -1.0, -1.0].into_iter().enumerate() {
///     assert!((c[i * 4 + i] - expected).abs() < 1e-3);
/// }
/// # Ok::<_, coseg_geometry::SpectralMeshError>(())
/// ```
///
/// # Panics
/// If there are fewer eigenvectors, or a vertex of the map does not exist.
pub fn functional(
    one: &Basis<'_>,
    two: &Basis<'_>,
    p2p_21: &[u32],
    k1: usize,
    k2: usize,
) -> Vec<f32> {
    two.project(&one.rows(p2p_21, k1), k1, k2)
}

/// `p2p_21 (n2,)` of a functional map `c_12 (k2, k1)`: for each row of `Φ₂` the nearest row of `Φ₁
/// c_12ᵀ`, as in ZoomOut and pyFM; the lowest vertex on ties. O(n1 n2 k2).
///
/// ```
/// use coseg_geometry::fmap::convert::pointwise;
/// use coseg_geometry::{SpectralMesh, mesh::icosphere, operators::Operator, spectrum::Options};
///
/// let sphere = SpectralMesh::new(icosphere(2), Operator::Tufted, 4, &Options::default())?;
/// // Minus one for the three coordinates: each vertex goes to the opposite one.
/// let c = [1.0, 0., 0., 0., 0., -1.0, 0., 0., 0., 0., -1.0, 0., 0., 0., 0., -1.0];
/// let p2p = pointwise(&sphere.basis(), &sphere.basis(), &c, 4);
/// for (p, image) in sphere.mesh.vertices.iter().zip(&p2p) {
///     let q = sphere.mesh.vertices[*image as usize];
///     assert!((0..3).all(|i| (p[i] + q[i]).abs() < 1e-9));
/// }
/// # Ok::<_, coseg_geometry::SpectralMeshError>(())
/// ```
///
/// # Panics
/// If `k1` is 0 or larger than the number of eigenvectors, or shape 1 has no vertices.
pub fn pointwise(one: &Basis<'_>, two: &Basis<'_>, c_12: &[f32], k1: usize) -> Vec<u32> {
    let k2 = c_12.len() / k1;
    let targets = product_transposed(&one.leading(k1), c_12, one.n_vertices(), k1, k2);
    nearest_rows(&two.leading(k2), &targets, k2)
}

/// Like [`pointwise`], by the adjoint: for each row of `Φ₂ c_12` the nearest row of `Φ₁`. The two
/// are equal for an orthogonal map only.
///
/// ```
/// use coseg_geometry::fmap::convert::{pointwise, pointwise_adjoint};
/// use coseg_geometry::{SpectralMesh, mesh::icosphere, operators::Operator, spectrum::Options};
///
/// let sphere = SpectralMesh::new(icosphere(2), Operator::Tufted, 4, &Options::default())?;
/// let c = [1.0, 0., 0., 0., 0., -1.0, 0., 0., 0., 0., -1.0, 0., 0., 0., 0., -1.0];
/// let basis = sphere.basis();
/// assert_eq!(pointwise_adjoint(&basis, &basis, &c, 4), pointwise(&basis, &basis, &c, 4));
/// # Ok::<_, coseg_geometry::SpectralMeshError>(())
/// ```
///
/// # Panics
/// Like [`pointwise`].
pub fn pointwise_adjoint(one: &Basis<'_>, two: &Basis<'_>, c_12: &[f32], k1: usize) -> Vec<u32> {
    let k2 = c_12.len() / k1;
    let queries = product(&two.leading(k2), c_12, two.n_vertices(), k2, k1);
    nearest_rows(&queries, &one.leading(k1), k1)
}

#[cfg(test)]
mod tests {
    use super::super::test_shapes::cycle;
    use super::{functional, pointwise, pointwise_adjoint};

    #[test]
    fn there_and_back_is_the_same_map() {
        let (a, b) = (cycle(120, 0), cycle(120, 17));
        let p2p: Vec<u32> = (0..120).map(|v| (v + 17) % 120).collect();
        let c = functional(&a.basis(), &b.basis(), &p2p, 9, 11);
        assert_eq!(c.len(), 99);
        let c = functional(&a.basis(), &b.basis(), &p2p, 11, 11);
        assert_eq!(pointwise(&a.basis(), &b.basis(), &c, 11), p2p);
        assert_eq!(pointwise_adjoint(&a.basis(), &b.basis(), &c, 11), p2p);
        // A turned cycle is an isometry: the map is orthogonal.
        for i in 0..11 {
            let norm: f32 = (0..11).map(|j| c[i * 11 + j].powi(2)).sum();
            assert!((norm - 1.0).abs() < 1e-4, "row {i}: {norm}");
        }
    }
}
