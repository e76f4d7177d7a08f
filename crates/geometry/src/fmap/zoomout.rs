//! Enlarges a small map step by step: ZoomOut (Melzi et al. 2019, *ZoomOut: Spectral Upsampling for
//! Efficient Shape Correspondence*).

use super::basis::Basis;
use super::convert::{functional, pointwise};
use super::samples::{SampledBasis, columns};
use crate::linalg::nearest::nearest_rows;

/// ZoomOut as published, on all vertices: alternates `rounds` times a pointwise map and a
/// functional map that is larger by `step`, then computes the pointwise map of the last. `c_12` is
/// `(k, k)`, row-major, and so is the result, with `k + rounds step` rows; `p2p_21 (n2,)` gives for
/// each vertex of shape 2 a vertex of shape 1. O(rounds n1 n2 k).
///
/// ```
/// use coseg_geometry::fmap::zoomout;
/// use coseg_geometry::{SpectralMesh, mesh::icosphere, operators::Operator, spectrum::Options};
///
/// let sphere = SpectralMesh::new(icosphere(2), Operator::Tufted, 16, &Options::default())?;
/// // A point reflection, known by three coordinates alone, grows to sixteen eigenfunctions.
/// let small = [1.0, 0., 0., 0., 0., -1.0, 0., 0., 0., 0., -1.0, 0., 0., 0., 0., -1.0];
/// let (large, p2p_21) = zoomout(&sphere.basis(), &sphere.basis(), &small, 4, 4, 3);
/// assert_eq!((large.len(), p2p_21.len()), (16 * 16, 162));
/// // Of degree 2 are five even functions, of degree 3 seven odd ones.
/// assert!((4..9).all(|i| (large[17 * i] - 1.0).abs() < 1e-3));
/// assert!((9..16).all(|i| (large[17 * i] + 1.0).abs() < 1e-3));
/// # Ok::<_, coseg_geometry::SpectralMeshError>(())
/// ```
///
/// # Panics
/// If there are fewer than `k + rounds step` eigenvectors.
pub fn zoomout(
    one: &Basis<'_>,
    two: &Basis<'_>,
    c_12: &[f32],
    k: usize,
    step: usize,
    rounds: usize,
) -> (Vec<f32>, Vec<u32>) {
    let (mut c, mut k) = (c_12.to_vec(), k);
    for _ in 0..rounds {
        let p2p_21 = pointwise(one, two, &c, k);
        k += step;
        c = functional(one, two, &p2p_21, k, k);
    }
    let p2p_21 = pointwise(one, two, &c, k);
    (c, p2p_21)
}

/// ZoomOut on samples, through the sizes `ks`: grows `c_12 (k, k)` to a map of the last size,
/// row-major. Functional maps are fitted by weighted least squares at the samples.
///
/// ```
/// use coseg_geometry::fmap::samples::{SampledBasis, farthest_point_samples};
/// use coseg_geometry::fmap::zoomout_sampled;
/// use coseg_geometry::mesh::{EdgeGraph, icosphere};
/// use coseg_geometry::{SpectralMesh, operators::Operator, spectrum::Options};
///
/// let sphere = SpectralMesh::new(icosphere(3), Operator::Tufted, 16, &Options::default())?;
/// let graph = EdgeGraph::new(&sphere.mesh, &[]);
/// let samples = farthest_point_samples(&graph, sphere.basis().mass, &[100]).remove(0);
/// let sampled = SampledBasis::new(&sphere.basis(), &samples.vertices, &samples.mass, 16);
/// // The identity of the sphere stays the identity.
/// let small = [1.0, 0., 0., 0., 0., 1.0, 0., 0., 0., 0., 1.0, 0., 0., 0., 0., 1.0];
/// let large = zoomout_sampled(&sampled, &sampled, &small, 4, &[9, 16]);
/// assert!((0..16).all(|i| (large[17 * i] - 1.0).abs() < 1e-3));
/// # Ok::<_, coseg_geometry::SpectralMeshError>(())
/// ```
///
/// # Panics
/// If a size is larger than the number of columns of a sampled basis.
pub fn zoomout_sampled(
    one: &SampledBasis,
    two: &SampledBasis,
    c_12: &[f32],
    k: usize,
    ks: &[usize],
) -> Vec<f32> {
    let (mut c, mut k) = (c_12.to_vec(), k);
    for &next in ks {
        let targets = super::basis::product_transposed(&one.leading(k), &c, one.n, k, k);
        let p2p_21 = nearest_rows(&two.leading(k), &targets, k);
        let rows = columns(&one.rows, one.k, next);
        let pulled = super::transfer::pulled_back(&p2p_21, &rows, next);
        c = two.fit(&pulled, next, next);
        k = next;
    }
    c
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_small_exact_map_grows_to_a_large_one() {
        use super::super::test_shapes::cycle as curve;
        let (a, b) = (curve(150, 0), curve(150, 23));
        let p2p: Vec<u32> = (0..150).map(|v| (v + 23) % 150).collect();
        let c = functional(&a.basis(), &b.basis(), &p2p, 3, 3);
        let (large, found) = zoomout(&a.basis(), &b.basis(), &c, 3, 2, 4);
        assert_eq!((large.len(), found), (121, p2p.clone()));
        // Corresponding samples: each third vertex of one shape, and its match on the other.
        let ids = |turn: u32| (0..50).map(|i| (3 * i + turn) % 150).collect::<Vec<u32>>();
        let mass = vec![1.0 / 50.0; 50];
        let one = SampledBasis::new(&a.basis(), &ids(23), &mass, 11);
        let two = SampledBasis::new(&b.basis(), &ids(0), &mass, 11);
        let sampled = zoomout_sampled(&one, &two, &c, 3, &[5, 7, 9, 11]);
        let error: f32 = sampled
            .iter()
            .zip(&large)
            .map(|(x, y)| (x - y).powi(2))
            .sum();
        assert!(error < 1e-4, "{error}");
    }
}
