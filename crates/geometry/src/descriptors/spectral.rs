//! Computes descriptors of points (heat and wave kernel signatures, global point signature) and of
//! the shape (ShapeDNA) from eigenpairs of the Laplacian.
//!
//! Sun, Ovsjanikov and Guibas 2009, *A Concise and Provably Informative Multi-Scale Signature Based
//! on Heat Diffusion*; Aubry, Schlickewei and Cremers 2011, *The Wave Kernel Signature*; Rustamov
//! 2007, *Laplace-Beltrami Eigenfunctions for Deformation Invariant Shape Representation*; Reuter,
//! Wolter and Peinecke 2006, *Laplace-Beltrami Spectra as Shape-DNA*. Sums of squares of
//! eigenvectors depend neither on their signs nor on the basis of an eigenspace.

use crate::linalg::squares::SquareWeights;
use nalgebra::DMatrix;

/// Eigenvalues up to this fraction of the largest one given are zero: solvers leave about 1e-10.
const ZERO: f64 = 1e-7;
/// The smallest eigenvalue that sets a time, for a mesh of area 1: at longer times the kernel is
/// constant.
const MIN_EIGENVALUE: f64 = 1e-3;
/// Width of the wave kernel's energy bands, in percent of the range of energies, from the paper.
const WAVE_WIDTH: f64 = 0.07;
/// Number of points whose rows of eigenvectors are processed together: few enough to stay in the
/// cache.
const BATCH: usize = 48;

/// Number of eigenvalues (ascending) that are zero: one for each component of the domain.
///
/// ```
/// use coseg_geometry::descriptors::null_space;
///
/// assert_eq!(null_space(&[0.0, 1e-12, 3.0]), 2);
/// assert_eq!(null_space(&[]), 0);
/// ```
pub fn null_space(eigenvalues: &[f64]) -> usize {
    let zero = eigenvalues.last().map_or(0.0, |last| ZERO * last.max(0.0));
    eigenvalues.iter().take_while(|&&x| x <= zero).count()
}

/// `n_times` times `(n_times,)` for [`hks`], ascending and log-uniform from `4 ln 10 / λ_last` to
/// `4 ln 10 / λ₂`, where λ₂ is the first eigenvalue above the null space. All 1 when there is none.
/// The unit is that of the area.
///
/// ```
/// use coseg_geometry::descriptors::hks_times;
///
/// let times = hks_times(&[0.0, 2.0, 8.0], 3);
/// let expected = [0.5, 1.0, 2.0].map(|x| x * std::f64::consts::LN_10);
/// assert!(times.iter().zip(expected).all(|(t, e)| (t - e).abs() < 1e-12));
/// assert_eq!(hks_times(&[0.0], 2), [1.0, 1.0]);
/// ```
pub fn hks_times(eigenvalues: &[f64], n_times: usize) -> Vec<f64> {
    let Some((second, last)) = ends(eigenvalues) else {
        return vec![1.0; n_times];
    };
    let (from, to) = (
        4.0 * std::f64::consts::LN_10 / last,
        4.0 * std::f64::consts::LN_10 / second,
    );
    let steps = n_times.saturating_sub(1).max(1) as f64;
    (0..n_times)
        .map(|j| from * (to / from).powf(j as f64 / steps))
        .collect()
}

/// The first eigenvalue above the null space and the last.
fn ends(eigenvalues: &[f64]) -> Option<(f64, f64)> {
    let first = *eigenvalues.get(null_space(eigenvalues))?;
    eigenvalues.last().map(|&last| (first, last))
}

/// Computes the heat and wave kernel signatures of points from their rows of eigenvectors in one
/// pass over the squares, as one matrix product with the exponentials.
#[derive(Debug)]
pub struct PointKernels {
    weights: SquareWeights,
    n_times: usize,
}

impl PointKernels {
    /// For the heat kernel at `times` and the wave kernel at `n_energies` energies, uniform in log
    /// λ from the first of the `eigenvalues` `(k,)` above the null space to the last. O(k (times +
    /// energies)).
    ///
    /// ```
    /// use coseg_geometry::descriptors::PointKernels;
    ///
    /// let kernels = PointKernels::new(&[0.0, 1.0], &[0.0, 2.0], 0);
    /// let mut out = [0.0; 2];
    /// // One point, where the eigenvectors are 1 and 3: Σ exp(−λ t) φ².
    /// kernels.of_rows(&[1.0, 3.0], 2, &mut out);
    /// assert_eq!(out[0], 1.0 + 9.0);
    /// assert!((out[1] - (1.0 + 9.0 * (-2.0_f64).exp())).abs() < 1e-12);
    /// ```
    pub fn new(eigenvalues: &[f64], times: &[f64], n_energies: usize) -> Self {
        let wave = wave_weights(eigenvalues, n_energies);
        let n_times = times.len();
        let weight = |i: usize, j: usize| match times.get(j) {
            Some(t) => (-eigenvalues[i] * t).exp(),
            None => wave[(i, j - n_times)],
        };
        Self {
            weights: SquareWeights::new(eigenvalues.len(), n_times + n_energies, weight),
            n_times,
        }
    }

    /// Number of times plus number of energies.
    pub fn n_columns(&self) -> usize {
        self.weights.n_out()
    }

    /// Number of times.
    pub fn n_times(&self) -> usize {
        self.n_times
    }

    /// Multiplications and additions for a point.
    pub fn flops(&self) -> usize {
        self.weights.flops()
    }

    /// The kernels of rows of eigenvectors, `width` numbers apart, of which the first k count:
    /// first at all times, then at all energies, `(rows, n_columns)`.
    ///
    /// # Panics
    /// If `out` has a different number of rows.
    pub fn of_rows(&self, rows: &[f64], width: usize, out: &mut [f64]) {
        self.weights.apply(rows, width, out);
    }

    /// The kernels of a matrix `(n, k)` of eigenvectors: `(n, n_columns)`, row-major. Columns
    /// beyond the k-th do not count.
    ///
    /// ```
    /// use coseg_geometry::descriptors::{PointKernels, hks};
    /// use nalgebra::DMatrix;
    ///
    /// let (values, times) = ([0.0, 1.0], [0.5, 2.0]);
    /// let vectors = DMatrix::from_row_slice(2, 2, &[1.0, 1.0, 1.0, -1.0]);
    /// let found = PointKernels::new(&values, &times, 0).of_matrix(&vectors);
    /// let single: Vec<f32> = found.iter().map(|x| *x as f32).collect();
    /// assert_eq!(single, hks(&values, &vectors, &times));
    /// ```
    ///
    /// # Panics
    /// If there are fewer than k columns.
    pub fn of_matrix(&self, eigenvectors: &DMatrix<f64>) -> Vec<f64> {
        let (n, k) = (eigenvectors.nrows(), self.weights.n_in());
        let mut out = vec![0.0; n * self.n_columns()];
        let mut rows = vec![0.0; BATCH * k];
        for first in (0..n).step_by(BATCH) {
            let count = BATCH.min(n - first);
            for i in 0..k {
                let column = &eigenvectors.as_slice()[i * n + first..][..count];
                for (v, x) in column.iter().enumerate() {
                    rows[v * k + i] = *x;
                }
            }
            let width = self.n_columns();
            let out = &mut out[first * width..(first + count) * width];
            self.of_rows(&rows[..count * k], k, out);
        }
        out
    }
}

/// Heat kernel signature `(n, times)`, row-major: `Σ_i exp(−λ_i t) φ_i(x)²`, over the pairs for
/// which both a value `(k,)` and a vector `(n, k)` are given. Positive; the unit is 1 / area, and
/// for large times it is 1 over the area of the component. O(n k times), as one matrix product.
///
/// ```
/// use coseg_geometry::descriptors::{hks, hks_times};
/// use coseg_geometry::{SpectralMesh, mesh::icosphere, operators::Operator, spectrum::Options};
///
/// let sphere = SpectralMesh::new(icosphere(3), Operator::Tufted, 16, &Options::default())?;
/// let times = hks_times(&sphere.spectrum.eigenvalues, 10);
/// let values = hks(&sphere.spectrum.eigenvalues, &sphere.spectrum.eigenvectors, &times);
/// // On a sphere all points are alike.
/// for row in values.chunks_exact(10) {
///     assert!(row.iter().zip(&values).all(|(x, first)| (x / first - 1.0).abs() < 0.05));
/// }
/// # Ok::<_, coseg_geometry::SpectralMeshError>(())
/// ```
pub fn hks(eigenvalues: &[f64], eigenvectors: &DMatrix<f64>, times: &[f64]) -> Vec<f32> {
    let k = eigenvalues.len().min(eigenvectors.ncols());
    let kernels = PointKernels::new(&eigenvalues[..k], times, 0);
    to_single(&kernels.of_matrix(eigenvectors))
}

/// Wave kernel signature `(n, n_energies)`, row-major: for energies uniform in log λ from the first
/// eigenvalue above the null space to the last, the mean of `φ_i(x)²` under a Gaussian about the
/// energy. The unit is 1 / area. Zero when no eigenvalue is above the null space.
///
/// ```
/// use coseg_geometry::descriptors::wks;
/// use coseg_geometry::{SpectralMesh, mesh::icosphere, operators::Operator, spectrum::Options};
///
/// let sphere = SpectralMesh::new(icosphere(2), Operator::Tufted, 16, &Options::default())?;
/// let values = wks(&sphere.spectrum.eigenvalues, &sphere.spectrum.eigenvectors, 20);
/// assert_eq!(values.len(), 162 * 20);
/// // Its mean over the surface is 1 at each energy, since eigenvectors are mass-orthonormal.
/// let rows = values.chunks_exact(20).zip(&sphere.laplacian.mass);
/// let mean: f64 = rows.map(|(row, mass)| mass * f64::from(row[7])).sum();
/// assert!((mean - 1.0).abs() < 1e-4);
/// # Ok::<_, coseg_geometry::SpectralMeshError>(())
/// ```
pub fn wks(eigenvalues: &[f64], eigenvectors: &DMatrix<f64>, n_energies: usize) -> Vec<f32> {
    let k = eigenvalues.len().min(eigenvectors.ncols());
    let kernels = PointKernels::new(&eigenvalues[..k], &[], n_energies);
    to_single(&kernels.of_matrix(eigenvectors))
}

/// Global point signature `(n, dims)`, row-major: `φ_i(x) / √λ_i` for the first `dims` eigenvalues
/// above the null space; zero beyond the last. Signs are those of the eigenvectors. It has no unit:
/// it does not depend on the scale of the mesh.
///
/// ```
/// use coseg_geometry::descriptors::gps;
/// use coseg_geometry::{SpectralMesh, mesh::icosphere, operators::Operator, spectrum::Options};
///
/// let sphere = SpectralMesh::new(icosphere(3), Operator::Tufted, 4, &Options::default())?;
/// let points = gps(&sphere.spectrum.eigenvalues, &sphere.spectrum.eigenvectors, 3);
/// // Three dimensions of a sphere's embedding are a sphere again, of squared radius 3 / 8π.
/// let square = 3.0 / (8.0 * std::f32::consts::PI);
/// for p in points.chunks_exact(3) {
///     assert!((p.iter().map(|x| x * x).sum::<f32>() / square - 1.0).abs() < 0.05);
/// }
/// # Ok::<_, coseg_geometry::SpectralMeshError>(())
/// ```
pub fn gps(eigenvalues: &[f64], eigenvectors: &DMatrix<f64>, dims: usize) -> Vec<f32> {
    let k = eigenvalues.len().min(eigenvectors.ncols());
    let scales = gps_scales(&eigenvalues[..k], dims);
    let skip = null_space(&eigenvalues[..k]);
    let mut result = Vec::with_capacity(eigenvectors.nrows() * dims);
    for v in 0..eigenvectors.nrows() {
        result.extend(scales.iter().zip(skip..).map(|(scale, i)| match i < k {
            true => (eigenvectors[(v, i)] * scale) as f32,
            false => 0.0,
        }));
    }
    result
}

/// `1 / √λ_i` of the first `dims` eigenvalues above the null space, by which a row of eigenvectors,
/// from there on, is scaled to its global point signature; zero beyond the last.
///
/// ```
/// assert_eq!(coseg_geometry::descriptors::gps_scales(&[0.0, 4.0, 16.0], 3), [0.5, 0.25, 0.0]);
/// ```
pub fn gps_scales(eigenvalues: &[f64], dims: usize) -> Vec<f64> {
    let above = &eigenvalues[null_space(eigenvalues)..];
    (0..dims)
        .map(|i| above.get(i).map_or(0.0, |l| 1.0 / l.sqrt()))
        .collect()
}

/// ShapeDNA `(n,)`: logarithms of the first `n` eigenvalues above the null space, for a mesh of
/// area 1. Where there are fewer the last one is repeated; 0 when there is none.
///
/// ```
/// use coseg_geometry::descriptors::shape_dna;
///
/// assert_eq!(shape_dna(&[0.0, 1.0, std::f64::consts::E], 3), [0.0, 1.0, 1.0]);
/// assert_eq!(shape_dna(&[0.0], 2), [0.0, 0.0]);
/// ```
pub fn shape_dna(eigenvalues: &[f64], n: usize) -> Vec<f32> {
    let above = &eigenvalues[null_space(eigenvalues)..];
    let at = |i: usize| above.get(i).or(above.last()).map_or(0.0, |x| x.ln() as f32);
    (0..n).map(at).collect()
}

/// Heat kernel signature over the heat trace at `n_times` times, then wave kernel signature at
/// `n_energies` energies, of rows of eigenvectors as for [`PointKernels::of_rows`].
pub(super) fn relative_kernels(
    eigenvalues: &[f64],
    n_times: usize,
    n_energies: usize,
) -> PointKernels {
    let k = eigenvalues.len();
    let mut weights = DMatrix::zeros(k, n_times + n_energies);
    if let Some((second, last)) = ends(eigenvalues) {
        let from = 4.0 * std::f64::consts::LN_10 / last;
        let ratio = last / second.max(MIN_EIGENVALUE).min(last);
        let steps = (n_times - 1).max(1) as f64;
        for j in 0..n_times {
            let time = from * ratio.powf(j as f64 / steps);
            let heat = |i: usize| (-eigenvalues[i].max(0.0) * time).exp();
            let trace: f64 = (0..k).map(heat).sum();
            for i in 0..k {
                weights[(i, j)] = heat(i) / trace;
            }
        }
    }
    weights
        .columns_mut(n_times, n_energies)
        .copy_from(&wave_weights(eigenvalues, n_energies));
    PointKernels {
        weights: SquareWeights::new(k, n_times + n_energies, |i, j| weights[(i, j)]),
        n_times,
    }
}

/// Weight of each eigenpair at each energy `(k, n_energies)`. Columns sum to 1, or are 0 when no
/// eigenvalue is above the null space.
///
/// ```
/// let weights = coseg_geometry::descriptors::wave_weights(&[0.0, 1.0, 2.0, 4.0], 3);
/// assert_eq!(weights.shape(), (4, 3));
/// assert!(weights.row(0).iter().all(|w| *w == 0.0)); // the null space has no energy
/// assert!(weights.column_iter().all(|c| (c.sum() - 1.0).abs() < 1e-12));
/// ```
pub fn wave_weights(eigenvalues: &[f64], n_energies: usize) -> DMatrix<f64> {
    let k = eigenvalues.len();
    let skip = null_space(eigenvalues);
    let mut weights = DMatrix::zeros(k, n_energies);
    let logs: Vec<f64> = eigenvalues[skip..].iter().map(|x| x.ln()).collect();
    let (Some(&low), Some(&high)) = (logs.first(), logs.last()) else {
        return weights;
    };
    // With a single energy the width does not matter.
    let width = (WAVE_WIDTH * (high - low)).max(f64::MIN_POSITIVE.sqrt());
    let steps = n_energies.saturating_sub(1).max(1) as f64;
    for j in 0..n_energies {
        let energy = low + (high - low) * j as f64 / steps;
        let exponent = |log: f64| -0.5 * ((energy - log) / width).powi(2);
        // Weights are relative to the nearest eigenvalue: in a gap wider than the bands all would
        // vanish.
        let most = logs
            .iter()
            .map(|&l| exponent(l))
            .fold(f64::NEG_INFINITY, f64::max);
        let total: f64 = logs.iter().map(|&l| (exponent(l) - most).exp()).sum();
        for (i, &log) in logs.iter().enumerate() {
            weights[(skip + i, j)] = (exponent(log) - most).exp() / total;
        }
    }
    weights
}

/// Converts to single precision.
fn to_single(values: &[f64]) -> Vec<f32> {
    values.iter().map(|&x| x as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::{gps, hks, hks_times, null_space, relative_kernels, shape_dna, wks};
    use nalgebra::DMatrix;

    /// A path of four points: eigenvalues 2 − 2 cos(πi/4), eigenvectors cosines.
    fn path() -> (Vec<f64>, DMatrix<f64>) {
        let angle = |i: usize| std::f64::consts::PI * i as f64 / 4.0;
        let values = (0..4).map(|i| 2.0 - 2.0 * angle(i).cos()).collect();
        let vectors = DMatrix::from_fn(4, 4, |v, i| {
            let scale: f64 = if i == 0 { 0.5 } else { 0.5_f64.sqrt() };
            scale * ((v as f64 + 0.5) * angle(i)).cos()
        });
        (values, vectors)
    }

    fn kernels(
        values: &[f64],
        vectors: &DMatrix<f64>,
        n_times: usize,
        n_energies: usize,
    ) -> Vec<f64> {
        relative_kernels(values, n_times, n_energies).of_matrix(vectors)
    }

    #[test]
    fn times_run_from_the_last_eigenvalue_to_the_first_above_zero() {
        let times = hks_times(&[-1e-12, 1e-11, 0.5, 2.0, 8.0], 100);
        let c = 4.0 * 10.0_f64.ln();
        assert_eq!(times.len(), 100);
        assert!((times[0] - c / 8.0).abs() < 1e-12 && (times[99] - c / 0.5).abs() < 1e-9);
        let ratio = times[1] / times[0];
        assert!(
            times
                .windows(2)
                .all(|w| (w[1] / w[0] - ratio).abs() < 1e-12)
        );
    }

    #[test]
    fn hks_is_the_diagonal_of_the_heat_operator() {
        let (values, vectors) = path();
        for t in [0.1, 1.0, 3.0] {
            let heat = &vectors
                * DMatrix::from_diagonal(&nalgebra::DVector::from_fn(4, |i, _| {
                    (-values[i] * t).exp()
                }))
                * vectors.transpose();
            let h = hks(&values, &vectors, &[t, 2.0 * t]);
            for v in 0..4 {
                assert!((f64::from(h[2 * v]) - heat[(v, v)]).abs() < 1e-6);
            }
        }
        // At time 0 all heat is at its source; in the limit it is uniform.
        let h = hks(&values, &vectors, &[0.0, 1e9]);
        assert!(
            h.chunks(2)
                .all(|r| (r[0] - 1.0).abs() < 1e-6 && (r[1] - 0.25).abs() < 1e-6)
        );
    }

    #[test]
    fn kernels_are_weighted_means_of_squares() {
        let (values, vectors) = path();
        let n = 4;
        let all = kernels(&values, &vectors, 3, 5);
        // Squares of an orthonormal vector sum to 1 over the points, and so do their means.
        for j in 0..8 {
            let sum: f64 = (0..n).map(|v| all[v * 8 + j]).sum();
            assert!((sum - 1.0).abs() < 1e-12, "column {j}: {sum}");
        }
        let w = wks(&values, &vectors, 5);
        for v in 0..n {
            for j in 0..5 {
                assert!((f64::from(w[v * 5 + j]) - all[v * 8 + 3 + j]).abs() < 1e-6);
            }
        }
        // The lowest energy has the lowest vibration, the highest energy the highest.
        for v in 0..n {
            assert!((f64::from(w[v * 5]) - vectors[(v, 1)].powi(2)).abs() < 1e-3);
            assert!((f64::from(w[v * 5 + 4]) - vectors[(v, 3)].powi(2)).abs() < 1e-3);
        }
    }

    #[test]
    fn gps_and_shape_dna_leave_out_the_null_space() {
        let (values, vectors) = path();
        assert_eq!(null_space(&values), 1);
        let g = gps(&values, &vectors, 5);
        for v in 0..4 {
            assert_eq!(
                g[5 * v + 1],
                (vectors[(v, 2)] * (1.0 / values[2].sqrt())) as f32
            );
            assert_eq!(g[5 * v + 3..5 * v + 5], [0.0, 0.0]);
        }
        let dna = shape_dna(&values, 5);
        for (x, i) in dna.iter().zip([1, 2, 3, 3, 3]) {
            assert_eq!(*x, values[i].ln() as f32);
        }
    }

    #[test]
    fn spectra_with_nothing_in_them_give_numbers() {
        for k in 0..3 {
            let values = vec![0.0; k];
            let vectors = DMatrix::from_element(5, k, 1.0);
            let times = hks_times(&values, 7);
            assert!(hks(&values, &vectors, &times).iter().all(|x| x.is_finite()));
            assert!(wks(&values, &vectors, 6).iter().all(|x| *x == 0.0));
            assert!(gps(&values, &vectors, 3).iter().all(|x| *x == 0.0));
            assert_eq!(shape_dna(&values, 2), [0.0, 0.0]);
            assert!(kernels(&values, &vectors, 3, 4).iter().all(|x| *x == 0.0));
        }
        let one = kernels(&[0.0, 2.0], &DMatrix::from_element(3, 2, 0.5), 3, 4);
        assert!(one.iter().all(|x| (x - 0.25).abs() < 1e-12));
    }
}
