//! Refines a functional map to an orthogonal one that agrees with its pointwise map (Ovsjanikov et
//! al. 2012, section 6.2).

use super::basis::Basis;
use super::convert::{functional, pointwise};
use nalgebra::DMatrix;

/// Repeats `rounds` times: pointwise map, functional map, nearest orthogonal map. `c_12 (k2, k1)`
/// and the result are row-major. O(rounds n1 n2 k2).
///
/// ```
/// use coseg_geometry::fmap::icp::icp;
/// use coseg_geometry::{SpectralMesh, mesh::icosphere, operators::Operator, spectrum::Options};
///
/// let sphere = SpectralMesh::new(icosphere(2), Operator::Tufted, 4, &Options::default())?;
/// // A point reflection, disturbed, comes back as an exact one.
/// let c = [1.0, 0., 0., 0., 0., -0.9, 0.1, 0., 0., 0., -1.1, 0., 0., 0., 0.05, -1.0];
/// let found = icp(&sphere.basis(), &sphere.basis(), &c, 4, 5);
/// for (i, x) in found.iter().enumerate() {
///     let expected = if i == 0 { 1.0 } else if i % 5 == 0 { -1.0 } else { 0.0 };
///     assert!((x - expected).abs() < 1e-3);
/// }
/// # Ok::<_, coseg_geometry::SpectralMeshError>(())
/// ```
///
/// # Panics
/// If there are fewer than `k1` or `k2` eigenvectors.
pub fn icp(one: &Basis<'_>, two: &Basis<'_>, c_12: &[f32], k1: usize, rounds: usize) -> Vec<f32> {
    let k2 = c_12.len() / k1.max(1);
    let mut c = c_12.to_vec();
    for _ in 0..rounds {
        let p2p_21 = pointwise(one, two, &c, k1);
        c = nearest_orthogonal(&functional(one, two, &p2p_21, k1, k2), k1);
    }
    c
}

/// The matrix with orthonormal rows or columns, whichever are fewer, that is nearest to `c (k2,
/// k1)`; row-major.
///
/// ```
/// use coseg_geometry::fmap::icp::nearest_orthogonal;
///
/// let found = nearest_orthogonal(&[3.0, 0.0, 0.0, -0.2], 2);
/// let expected = [1.0, 0.0, 0.0, -1.0];
/// assert!(found.iter().zip(expected).all(|(x, e)| (x - e).abs() < 1e-6));
/// ```
pub fn nearest_orthogonal(c: &[f32], k1: usize) -> Vec<f32> {
    let k2 = c.len() / k1.max(1);
    let svd = DMatrix::from_fn(k2, k1, |i, j| f64::from(c[i * k1 + j])).svd(true, true);
    let (Some(u), Some(v)) = (svd.u, svd.v_t) else {
        unreachable!("invariant: both factors were requested")
    };
    let product = u * v;
    product.transpose().iter().map(|x| *x as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::super::basis::transposed_product;
    use super::super::convert::functional;
    use super::super::test_shapes::cycle;
    use super::{icp, nearest_orthogonal};

    #[test]
    fn the_result_is_orthogonal() {
        let c: Vec<f32> = (0..20).map(|i| ((i * 7 % 11) as f32).sin()).collect();
        let q = nearest_orthogonal(&c, 4);
        let gram = transposed_product(&q, &q, 5, 4, 4);
        for (i, g) in gram.iter().enumerate() {
            let one = f32::from(u8::from(i / 4 == i % 4));
            assert!((g - one).abs() < 1e-5);
        }
    }

    #[test]
    fn a_disturbed_isometry_is_found_again() {
        let (a, b) = (cycle(200, 0), cycle(200, 31));
        let p2p: Vec<u32> = (0..200).map(|v| (v + 31) % 200).collect();
        let c = functional(&a.basis(), &b.basis(), &p2p, 11, 11);
        let disturbed: Vec<f32> = c
            .iter()
            .enumerate()
            .map(|(i, x)| x + 0.05 * ((i * i) as f32).sin())
            .collect();
        let found = icp(&a.basis(), &b.basis(), &disturbed, 11, 5);
        let error: f32 = found.iter().zip(&c).map(|(x, y)| (x - y).powi(2)).sum();
        assert!(error < 1e-6, "{error}");
    }
}
