//! Chooses farthest-point samples of a shape, each with the mass of its cell; they represent all
//! vertices while a map is small.
//!
//! Eldar et al. 1997, *The Farthest Point Strategy for Progressive Image Sampling*. Samples are
//! ordered, so the first half of them are samples too.

use super::basis::Basis;
use crate::mesh::EdgeGraph;
use crate::mesh::geodesic::Distances;

/// Vertices that represent the others.
#[derive(Debug, Clone, PartialEq)]
pub struct Samples {
    /// In the order in which they were chosen.
    pub vertices: Vec<u32>,
    /// Mass of the vertices that are nearest to each.
    pub mass: Vec<f32>,
    /// Nearest sample of each vertex `(n,)`, as an index into `vertices`.
    pub nearest: Vec<u32>,
}

/// The first `count` samples (or all vertices, if there are fewer) for each of the ascending
/// `counts`, by distance along edges, from the vertex that is farthest from vertex 0. Masses are
/// those of the vertices `(n,)`, summed over cells. O(n count) in the worst case, with a small
/// constant.
///
/// ```
/// use coseg_geometry::fmap::samples::farthest_point_samples;
/// use coseg_geometry::mesh::{EdgeGraph, icosphere};
///
/// let sphere = icosphere(2);
/// let found = farthest_point_samples(&EdgeGraph::new(&sphere, &[]), &[1.0; 162], &[2, 10]);
/// // The first two are opposite, and are also the first two of ten.
/// let [a, b] = [0, 1].map(|i| sphere.vertices[found[0].vertices[i] as usize]);
/// assert!((0..3).all(|i| (a[i] + b[i]).abs() < 0.5));
/// assert_eq!(found[1].vertices[..2], found[0].vertices);
/// assert_eq!(found[1].mass.iter().sum::<f32>(), 162.0);
/// ```
pub fn farthest_point_samples(graph: &EdgeGraph, mass: &[f32], counts: &[usize]) -> Vec<Samples> {
    let n = mass.len();
    let mut distances = Distances::default();
    distances.reset(n);
    let mut nearest = vec![0u32; n];
    let mut vertices = Vec::new();
    let mut next = if n > 0 {
        farthest(&graph.dijkstra(0))
    } else {
        0
    };
    let mut found = Vec::with_capacity(counts.len());
    for &count in counts {
        while vertices.len() < count.min(n) {
            let number = vertices.len() as u32;
            vertices.push(next);
            distances.spread(
                next,
                |v| graph.neighbors(v).iter().copied(),
                |v| nearest[v as usize] = number,
            );
            next = farthest(&distances.values);
        }
        let mut cell = vec![0.0f32; vertices.len()];
        for (s, m) in nearest.iter().zip(mass) {
            cell[*s as usize] += m;
        }
        found.push(Samples {
            vertices: vertices.clone(),
            mass: cell,
            nearest: nearest.clone(),
        });
    }
    found
}

/// The farthest vertex; unreached ones come first, and the lowest one on ties.
fn farthest(distances: &[f64]) -> u32 {
    let mut best = (0, f64::NEG_INFINITY);
    for (v, &d) in distances.iter().enumerate() {
        if d > best.1 {
            best = (v, d);
        }
    }
    best.0 as u32
}

/// A basis at samples, prepared for projections: `C = (Φᵀ M Φ)⁻¹ Φᵀ M f` for the first k columns,
/// any k.
#[derive(Debug, Clone)]
pub struct SampledBasis {
    /// Samples.
    pub n: usize,
    /// Columns.
    pub k: usize,
    /// Eigenvectors at the samples `(n, k)`, row-major.
    pub rows: Vec<f32>,
    /// The eigenvectors times mass.
    weighted: Vec<f32>,
    /// Lower Cholesky factor of `Φᵀ M Φ`, row-major `(k, k)`: its leading block is the factor of
    /// the leading block.
    factor: Vec<f64>,
}

impl SampledBasis {
    /// Samples a basis at the given vertices with their masses. It has fewer columns if there are
    /// fewer eigenvectors, or if the samples are too few to distinguish them.
    ///
    /// ```
    /// use coseg_geometry::fmap::samples::SampledBasis;
    /// use coseg_geometry::{SpectralMesh, mesh::icosphere, operators::Operator, spectrum::Options};
    ///
    /// let sphere = SpectralMesh::new(icosphere(2), Operator::Tufted, 9, &Options::default())?;
    /// let every_third: Vec<u32> = (0..162).step_by(3).collect();
    /// let sampled = SampledBasis::new(&sphere.basis(), &every_third, &[1.0; 54], 9);
    /// assert_eq!((sampled.n, sampled.k), (54, 9));
    /// // An eigenfunction is found again by its values at the samples.
    /// let second: Vec<f32> = sampled.rows.chunks_exact(9).map(|row| row[1]).collect();
    /// let coefficients = sampled.fit(&second, 1, 9);
    /// assert!((coefficients[1] - 1.0).abs() < 1e-3 && coefficients[2].abs() < 1e-3);
    /// # Ok::<_, coseg_geometry::SpectralMeshError>(())
    /// ```
    pub fn new(basis: &Basis<'_>, vertices: &[u32], mass: &[f32], k: usize) -> Self {
        let k = k.min(basis.n_eigenvectors).min(vertices.len()).max(1);
        let rows = basis.rows(vertices, k);
        let weighted: Vec<f32> = rows
            .chunks_exact(k)
            .zip(mass)
            .flat_map(|(row, m)| row.iter().map(move |x| x * m))
            .collect();
        let gram = super::basis::transposed_product(&rows, &weighted, vertices.len(), k, k);
        let (factor, sound) = cholesky(&gram, k);
        let mut this = Self {
            n: vertices.len(),
            k,
            rows,
            weighted,
            factor,
        };
        if sound < k {
            this = this.cut(sound.max(1));
        }
        this
    }

    /// The first `k` columns.
    fn cut(&self, k: usize) -> Self {
        Self {
            n: self.n,
            k,
            rows: self.leading(k),
            weighted: columns(&self.weighted, self.k, k),
            factor: self
                .factor
                .chunks_exact(self.k)
                .take(k)
                .flat_map(|r| r[..k].iter().copied())
                .collect(),
        }
    }

    /// The first `k` columns `(n, k)`, row-major.
    pub fn leading(&self, k: usize) -> Vec<f32> {
        columns(&self.rows, self.k, k)
    }

    /// Coefficients `(k, dim)` of functions given at the samples `(n, dim)`, by least squares
    /// weighted by mass. See [`SampledBasis::new`] for an example.
    pub fn fit(&self, values: &[f32], dim: usize, k: usize) -> Vec<f32> {
        let weighted = columns(&self.weighted, self.k, k);
        let right = super::basis::transposed_product(&weighted, values, self.n, k, dim);
        let mut x: Vec<f64> = right.into_iter().map(f64::from).collect();
        let l = |i: usize, j: usize| self.factor[i * self.k + j];
        for i in 0..k {
            for j in 0..i {
                let (above, row) = x.split_at_mut(i * dim);
                axpy(&mut row[..dim], -l(i, j), &above[j * dim..(j + 1) * dim]);
            }
            scale(&mut x[i * dim..(i + 1) * dim], 1.0 / l(i, i));
        }
        for i in (0..k).rev() {
            for j in i + 1..k {
                let (row, below) = x.split_at_mut((i + 1) * dim);
                let from = (j - i - 1) * dim;
                axpy(&mut row[i * dim..], -l(j, i), &below[from..from + dim]);
            }
            scale(&mut x[i * dim..(i + 1) * dim], 1.0 / l(i, i));
        }
        x.into_iter().map(|v| v as f32).collect()
    }
}

fn axpy(y: &mut [f64], a: f64, x: &[f64]) {
    for (y, x) in y.iter_mut().zip(x) {
        *y += a * x;
    }
}

fn scale(y: &mut [f64], a: f64) {
    for y in y {
        *y *= a;
    }
}

/// The first `k` of `stride` columns, row-major.
pub(super) fn columns(values: &[f32], stride: usize, k: usize) -> Vec<f32> {
    if k == stride {
        return values.to_vec();
    }
    let mut cut = Vec::with_capacity(values.len() / stride * k);
    for row in values.chunks_exact(stride) {
        cut.extend_from_slice(&row[..k]);
    }
    cut
}

/// Lower factor `(k, k)` of a symmetric matrix, row-major, and the number of leading rows that are
/// positive definite.
fn cholesky(a: &[f32], k: usize) -> (Vec<f64>, usize) {
    const LEAST: f64 = 1e-4;
    let mut l = vec![0.0; k * k];
    for i in 0..k {
        for j in 0..=i {
            let mut sum = f64::from(a[i * k + j]);
            for c in 0..j {
                sum -= l[i * k + c] * l[j * k + c];
            }
            if i == j {
                if sum <= LEAST * f64::from(a[i * k + i]) {
                    return (l, i);
                }
                l[i * k + i] = sum.sqrt();
            } else {
                l[i * k + j] = sum / l[j * k + j];
            }
        }
    }
    (l, k)
}
