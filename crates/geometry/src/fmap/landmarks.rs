//! Computes probe functions from points that a person matched: the heat that starts at each, at
//! every vertex.
//!
//! Ovsjanikov et al. 2012, section 5.1, with heat kernels in place of indicator functions, which
//! are not smooth.

use super::basis::{Basis, product_transposed};
use super::probes::{Probes, standardise};

/// Times of each kernel, as multiples of the time at which the heat of the largest eigenvalue in
/// use has decayed.
const TIMES: [f64; 3] = [2.0, 8.0, 32.0];
/// Eigenpairs in use.
const MAX_EIGENPAIRS: usize = 60;

/// Logarithms of heat kernels from each of the `landmarks`, standardised: `(n, 3 landmarks)`. Each
/// is greatest at its landmark.
///
/// ```
/// use coseg_geometry::fmap::landmarks::landmark_probes;
/// use coseg_geometry::{SpectralMesh, mesh::icosphere, operators::Operator, spectrum::Options};
///
/// let sphere = SpectralMesh::new(icosphere(2), Operator::Tufted, 30, &Options::default())?;
/// let probes = landmark_probes(&sphere.basis(), &[17]);
/// assert_eq!((probes.dim, probes.values.len()), (3, 162 * 3));
/// let hottest = (0..162).max_by(|a, b| probes.values[3 * a].total_cmp(&probes.values[3 * b]));
/// assert_eq!(hottest, Some(17));
/// # Ok::<_, coseg_geometry::SpectralMeshError>(())
/// ```
///
/// # Panics
/// If a landmark is not a vertex.
pub fn landmark_probes(basis: &Basis<'_>, landmarks: &[u32]) -> Probes {
    let k = basis.n_eigenvectors.min(MAX_EIGENPAIRS);
    let dim = landmarks.len() * TIMES.len();
    let last = basis.eigenvalues[..k]
        .last()
        .copied()
        .unwrap_or(1.0)
        .max(1e-12);
    let mut sources = Vec::with_capacity(dim * k);
    for &vertex in landmarks {
        for time in TIMES {
            let heat = |x: f64| (-x.max(0.0) * time / last).exp() as f32;
            let row = basis.row(vertex, k).iter().zip(basis.eigenvalues);
            sources.extend(row.map(|(phi, &x)| phi * heat(x)));
        }
    }
    let mut values = product_transposed(&basis.leading(k), &sources, basis.n_vertices(), k, dim);
    values.iter_mut().for_each(|x| *x = x.max(1e-3).ln());
    standardise(&mut values, dim, basis.mass);
    Probes { values, dim }
}

#[cfg(test)]
mod tests {
    use super::super::test_shapes::cycle;
    use super::landmark_probes;

    #[test]
    fn heat_is_greatest_where_it_starts_and_moves_with_the_shape() {
        let (a, b) = (cycle(100, 0), cycle(100, 30));
        let x = landmark_probes(&a.basis(), &[30, 75]);
        let y = landmark_probes(&b.basis(), &[0, 45]);
        assert_eq!((x.dim, x.values.len()), (6, 600));
        for v in 0..100 {
            for c in 0..6 {
                let (p, q) = (x.values[((v + 30) % 100) * 6 + c], y.values[v * 6 + c]);
                assert!((p - q).abs() < 1e-3);
                let source = if c < 3 { 30 } else { 75 };
                assert!(x.values[v * 6 + c] <= x.values[source * 6 + c] + 1e-5);
            }
        }
    }
}
