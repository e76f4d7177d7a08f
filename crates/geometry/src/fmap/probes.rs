//! Computes functions that are comparable between all shapes from the spectrum alone: wave and heat
//! kernel signatures.
//!
//! Each is centred and scaled to unit variance on its shape: its level depends on the class of the
//! shape, whereas its highs and lows correspond.

use super::basis::{Basis, product};
use crate::descriptors::{hks_times, wave_weights};

/// Number of eigenpairs from which signatures are computed, so that shapes with more have
/// comparable ones.
const MAX_EIGENPAIRS: usize = 100;

/// Functions at the vertices.
#[derive(Debug, Clone, PartialEq)]
pub struct Probes {
    /// `(n, dim)`, row-major.
    pub values: Vec<f32>,
    /// Columns.
    pub dim: usize,
}

impl Probes {
    /// Places both side by side, `(n, dim + others.dim)`; the mean square of the others is `weight`
    /// times that of these. A weight of 0 or less omits the others.
    ///
    /// ```
    /// use coseg_geometry::fmap::probes::Probes;
    ///
    /// let one = Probes { values: vec![1.0, -1.0], dim: 1 };
    /// let both = one.clone().beside(&one, 1.0);
    /// assert_eq!((both.dim, both.values), (2, vec![1.0, 1.0, -1.0, -1.0]));
    /// ```
    pub fn beside(self, others: &Self, weight: f32) -> Self {
        let dim = self.dim + others.dim;
        if others.dim == 0 || weight <= 0.0 {
            return self;
        }
        let scale = (weight * self.dim as f32 / others.dim as f32).sqrt();
        let rows = self.values.chunks_exact(self.dim);
        let values = rows
            .zip(others.values.chunks_exact(others.dim))
            .flat_map(|(a, b)| a.iter().copied().chain(b.iter().map(move |x| scale * x)));
        // This factor keeps the mean square over all columns at 1.
        let norm = (dim as f32 / (self.dim as f32 * (1.0 + weight))).sqrt();
        Self {
            values: values.map(|x| norm * x).collect(),
            dim,
        }
    }
}

/// `n_energies` wave kernel and `n_times` heat kernel signatures `(n, n_energies + n_times)`, the
/// latter as logarithms; mass-weighted mean 0 and variance 1 each. A constant function becomes 0.
///
/// ```
/// use coseg_geometry::fmap::probes::probes;
/// use coseg_geometry::{SpectralMesh, mesh::icosphere, operators::Operator, spectrum::Options};
///
/// let mut egg = icosphere(2);
/// egg.vertices.iter_mut().for_each(|[x, _, z]| *z *= 2.0 + 0.3 * *x);
/// let egg = SpectralMesh::new(egg, Operator::Tufted, 30, &Options::default())?;
/// let found = probes(&egg.basis(), 4, 2);
/// assert_eq!((found.dim, found.values.len()), (6, 162 * 6));
/// let rows = found.values.chunks_exact(6).zip(egg.basis().mass);
/// let variance: f32 = rows.map(|(row, mass)| mass * row[3] * row[3]).sum();
/// assert!((variance - 1.0).abs() < 1e-3);
/// # Ok::<_, coseg_geometry::SpectralMeshError>(())
/// ```
pub fn probes(basis: &Basis<'_>, n_energies: usize, n_times: usize) -> Probes {
    let k = basis.n_eigenvectors.min(MAX_EIGENPAIRS);
    let values = &basis.eigenvalues[..k];
    let dim = n_energies + n_times;
    let wave = wave_weights(values, n_energies);
    let times = hks_times(values, n_times);
    let mut weights = vec![0.0f32; k * dim];
    for i in 0..k {
        for j in 0..n_energies {
            weights[i * dim + j] = wave[(i, j)] as f32;
        }
        for (j, t) in times.iter().enumerate() {
            weights[i * dim + n_energies + j] = (-values[i] * t).exp() as f32;
        }
    }
    let squares: Vec<f32> = basis.leading(k).into_iter().map(|x| x * x).collect();
    let mut values = product(&squares, &weights, basis.n_vertices(), k, dim);
    for row in values.chunks_exact_mut(dim) {
        for x in &mut row[n_energies..] {
            *x = x.max(1e-6).ln();
        }
    }
    standardise(&mut values, dim, basis.mass);
    Probes { values, dim }
}

/// Mean curvature of the surface `vertices (n, 3)`, `faces (m, 3)`, smoothed to `n_scales` degrees
/// `(n, n_scales)`. It is positive where the surface bulges outward, so it distinguishes a chest
/// from a back, unlike any intrinsic function. Mass-weighted mean 0 and variance 1 each.
///
/// `Δx = 2 H n`, with coordinates x in the eigenbasis damped by `exp(−λ t)`.
///
/// ```
/// use coseg_geometry::fmap::probes::curvature_probes;
/// use coseg_geometry::{SpectralMesh, mesh::icosphere, operators::Operator, spectrum::Options};
///
/// let mut egg = icosphere(2);
/// egg.vertices.iter_mut().for_each(|[_, _, z]| *z *= 2.0);
/// let egg = SpectralMesh::new(egg, Operator::Tufted, 60, &Options::default())?;
/// let points: Vec<[f32; 3]> = egg.mesh.vertices.iter().map(|p| p.map(|x| x as f32)).collect();
/// let found = curvature_probes(&points, &egg.mesh.faces, &egg.basis(), 1);
/// // An ellipsoid is most curved at its ends.
/// let most = (0..162).max_by(|a, b| found.values[*a].total_cmp(&found.values[*b])).unwrap();
/// assert!(points[most][2].abs() > 0.9 * points.iter().fold(0.0, |m, p| p[2].max(m)));
/// # Ok::<_, coseg_geometry::SpectralMeshError>(())
/// ```
pub fn curvature_probes(
    vertices: &[[f32; 3]],
    faces: &[[u32; 3]],
    basis: &Basis<'_>,
    n_scales: usize,
) -> Probes {
    let k = basis.n_eigenvectors.min(MAX_EIGENPAIRS);
    let n = basis.n_vertices();
    let normals = outward_normals(vertices, faces);
    let coefficients = basis.project(vertices.as_flattened(), 3, k);
    let values = &basis.eigenvalues[..k];
    let last = values.last().copied().unwrap_or(1.0).max(1e-12);
    let mut weights = vec![0.0f32; k * 3 * n_scales];
    for i in 0..k {
        for s in 0..n_scales {
            let time = 4.0f64.powi(s as i32) / last;
            let damped = (values[i] * (-values[i] * time).exp()) as f32;
            for c in 0..3 {
                weights[(i * n_scales + s) * 3 + c] = damped * coefficients[i * 3 + c];
            }
        }
    }
    let flow = product(&basis.leading(k), &weights, n, k, 3 * n_scales);
    let mut values: Vec<f32> = flow
        .chunks_exact(3 * n_scales)
        .zip(&normals)
        .flat_map(|(row, normal)| {
            row.chunks_exact(3)
                .map(move |x| x[0] * normal[0] + x[1] * normal[1] + x[2] * normal[2])
        })
        .collect();
    standardise(&mut values, n_scales, basis.mass);
    Probes {
        values,
        dim: n_scales,
    }
}

/// Unit normals at vertices, flipped if the surface as a whole encloses a negative volume, so that
/// they point outward.
fn outward_normals(vertices: &[[f32; 3]], faces: &[[u32; 3]]) -> Vec<[f32; 3]> {
    let mut normals = vec![[0.0f32; 3]; vertices.len()];
    let mut volume = 0.0f64;
    for face in faces {
        let [a, b, c] = face.map(|v| vertices[v as usize]);
        let (u, w): ([f32; 3], [f32; 3]) = (
            std::array::from_fn(|i| b[i] - a[i]),
            std::array::from_fn(|i| c[i] - a[i]),
        );
        let cross: [f32; 3] = std::array::from_fn(|i| {
            u[(i + 1) % 3] * w[(i + 2) % 3] - u[(i + 2) % 3] * w[(i + 1) % 3]
        });
        volume += (0..3).map(|i| f64::from(a[i] * cross[i])).sum::<f64>();
        for v in face {
            for (n, x) in normals[*v as usize].iter_mut().zip(cross) {
                *n += x;
            }
        }
    }
    let sign = if volume < 0.0 { -1.0 } else { 1.0 };
    for n in &mut normals {
        let norm = n.iter().map(|x| x * x).sum::<f32>().sqrt().max(1e-20);
        n.iter_mut().for_each(|x| *x *= sign / norm);
    }
    normals
}

/// Makes the mass-weighted mean of each column of `values (n, dim)` 0 and its variance 1, with the
/// `mass (n,)`; a constant column becomes 0.
///
/// ```
/// let mut values = [1.0, 5.0, 3.0, 5.0]; // two rows; the second column is constant
/// coseg_geometry::fmap::probes::standardise(&mut values, 2, &[0.5, 0.5]);
/// assert_eq!(values, [-1.0, 0.0, 1.0, 0.0]);
/// ```
pub fn standardise(values: &mut [f32], dim: usize, mass: &[f32]) {
    let total: f64 = mass.iter().map(|m| f64::from(*m)).sum();
    let (mut mean, mut square) = (vec![0.0f64; dim], vec![0.0f64; dim]);
    for (row, m) in values.chunks_exact(dim).zip(mass) {
        let m = f64::from(*m) / total;
        for (c, x) in row.iter().enumerate() {
            mean[c] += m * f64::from(*x);
            square[c] += m * f64::from(*x) * f64::from(*x);
        }
    }
    for row in values.chunks_exact_mut(dim) {
        for (c, x) in row.iter_mut().enumerate() {
            let variance = square[c] - mean[c] * mean[c];
            let least = 1e-10 * square[c].max(1e-12);
            let scale = if variance > least {
                variance.sqrt().recip()
            } else {
                0.0
            };
            *x = ((f64::from(*x) - mean[c]) * scale) as f32;
        }
    }
}
