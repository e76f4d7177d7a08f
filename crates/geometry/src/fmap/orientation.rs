//! Decides whether a functional map keeps the orientation of the surface or reverses it, as a
//! left-right mirrored map does.
//!
//! For functions f, g the function `n · (∇f × ∇g)` changes its sign with the orientation (Ren et
//! al. 2018, *Continuous and Orientation-preserving Correspondences via Functional Maps*). On a
//! triangle with corner values f, g its integral is half of `(f₁ − f₀)(g₂ − g₀) − (f₂ − f₀)(g₁ −
//! g₀)`. It needs neither lengths nor normals, only consistently oriented faces.

use super::basis::Basis;

/// Number of eigenfunctions whose gradients are crossed.
const N_CROSSED: usize = 9;
/// Number of eigenfunctions in which the results are expressed.
const N_EXPRESSED: usize = 20;

/// Coefficients of `n · (∇φ_i × ∇φ_j) / √(λ_i λ_j)` for pairs i < j of low eigenfunctions.
#[derive(Debug, Clone, PartialEq)]
pub struct Orientation {
    /// Crossed eigenfunctions, from the first that is not constant.
    p: usize,
    /// The first of them.
    first: usize,
    /// Eigenfunctions in which results are expressed.
    q: usize,
    /// `(p (p − 1) / 2, q)`, row-major.
    crossed: Vec<f32>,
    /// `1 / √λ` of the crossed ones.
    scale: Vec<f32>,
}

impl Orientation {
    /// Computes the orientation of a shape with faces `(m, 3)` over the vertices of its basis. O(m
    /// p² q).
    pub fn new(faces: &[[u32; 3]], basis: &Basis<'_>) -> Self {
        let k = basis.n_eigenvectors;
        let first = 1.min(k);
        let p = (k - first).min(N_CROSSED);
        let q = k.min(N_EXPRESSED);
        let scale: Vec<f32> = (first..first + p)
            .map(|i| (1.0 / basis.eigenvalues[i].max(1e-3).sqrt()) as f32)
            .collect();
        let n_pairs = p * p.saturating_sub(1) / 2;
        let mut crossed = vec![0.0f32; n_pairs * q];
        let width = k.min(q.max(first + p));
        let (mut centre, mut u, mut w) = (vec![0.0; q], vec![0.0; p], vec![0.0; p]);
        for face in faces {
            let [a, b, c] = face.map(|v| basis.row(v, width));
            for (i, x) in centre.iter_mut().enumerate() {
                *x = (a[i] + b[i] + c[i]) / 6.0;
            }
            for i in 0..p {
                let j = first + i;
                u[i] = (b[j] - a[j]) * scale[i];
                w[i] = (c[j] - a[j]) * scale[i];
            }
            let mut rows = crossed.chunks_exact_mut(q);
            for i in 0..p {
                for j in i + 1..p {
                    let turn = u[i] * w[j] - w[i] * u[j];
                    let Some(row) = rows.next() else { break };
                    for (sum, x) in row.iter_mut().zip(&centre) {
                        *sum += turn * x;
                    }
                }
            }
        }
        Self {
            p,
            first,
            q,
            crossed,
            scale,
        }
    }

    /// Number of pairs, of the eigenfunctions below `k`.
    fn pairs(&self, k: usize) -> impl Iterator<Item = (usize, usize, usize)> {
        let p = self.p;
        let below = k.saturating_sub(self.first);
        (0..p)
            .flat_map(move |i| (i + 1..p).map(move |j| (i, j)))
            .enumerate()
            .filter(move |(_, (_, j))| *j < below)
            .map(|(pair, (i, j))| (pair, i, j))
    }

    /// The crossed functions of the eigenfunctions below `k`, `(pairs, q)`, with q.
    fn crossed(&self, k: usize) -> (Vec<f32>, usize) {
        let row = |pair: usize| &self.crossed[pair * self.q..(pair + 1) * self.q];
        (
            self.pairs(k)
                .flat_map(|(pair, ..)| row(pair).iter().copied())
                .collect(),
            self.q,
        )
    }

    /// On `other`, the crossed functions of the eigenfunctions of this shape below `k`, transferred
    /// by `c_12` `(rows, columns)`: `(pairs, other.q)`.
    fn transferred_then_crossed(
        &self,
        other: &Self,
        c_12: &[f32],
        columns: usize,
        k: usize,
    ) -> Vec<f32> {
        let rows = c_12.len() / columns.max(1);
        let c = |a: usize, i: usize| c_12[a * columns + i];
        let there = other.pairs(rows.min(k)).count();
        let mut minors = Vec::new();
        for (_, i, j) in self.pairs(k.min(columns)) {
            let (ci, cj) = (self.first + i, self.first + j);
            minors.extend(other.pairs(rows.min(k)).map(|(_, a, b)| {
                let (ra, rb) = (other.first + a, other.first + b);
                let minor = c(ra, ci) * c(rb, cj) - c(rb, ci) * c(ra, cj);
                minor * self.scale[i] * self.scale[j] / (other.scale[a] * other.scale[b])
            }));
        }
        let (crossed, q) = other.crossed(rows.min(k));
        let n = minors.len() / there.max(1);
        super::basis::product(&minors, &crossed, n, there, q)
    }

    /// The agreement of a map from this shape to `other` with orientation, −1 (reverses) to 1
    /// (keeps): the cosine between transferred crossed functions and crossed transferred functions.
    /// 0 where neither can be decided. `c_12 (rows, columns)` is row-major.
    ///
    /// ```
    /// use coseg_geometry::fmap::orientation::Orientation;
    /// use coseg_geometry::{SpectralMesh, mesh::icosphere, operators::Operator, spectrum::Options};
    ///
    /// let sphere = SpectralMesh::new(icosphere(2), Operator::Tufted, 4, &Options::default())?;
    /// let sense = Orientation::new(&sphere.mesh.faces, &sphere.basis());
    /// let identity = [1.0, 0., 0., 0., 0., 1.0, 0., 0., 0., 0., 1.0, 0., 0., 0., 0., 1.0];
    /// let reflection = [1.0, 0., 0., 0., 0., -1.0, 0., 0., 0., 0., -1.0, 0., 0., 0., 0., -1.0];
    /// assert!(sense.agreement(&sense, &identity, 4) > 0.99);
    /// assert!(sense.agreement(&sense, &reflection, 4) < -0.99);
    /// # Ok::<_, coseg_geometry::SpectralMeshError>(())
    /// ```
    pub fn agreement(&self, other: &Self, c_12: &[f32], columns: usize) -> f64 {
        let rows = c_12.len() / columns.max(1);
        let (q1, q2) = (self.q.min(columns), other.q.min(rows));
        let (from, _) = self.crossed(columns);
        let back = self.transferred_then_crossed(other, c_12, columns, columns);
        let (mut dot, mut left, mut right) = (0.0f64, 0.0f64, 0.0f64);
        for (from, back) in from.chunks_exact(self.q).zip(back.chunks_exact(other.q)) {
            for (r, &back) in back[..q2].iter().enumerate() {
                let row = &c_12[r * columns..r * columns + q1];
                let transferred: f32 = row.iter().zip(from).map(|(c, f)| c * f).sum();
                dot += f64::from(transferred * back);
                left += f64::from(transferred * transferred);
                right += f64::from(back * back);
            }
        }
        dot / (left * right).sqrt().max(1e-30)
    }

    /// Crossed functions that correspond under `c_12 (k, k)` at samples of both shapes, `(n1,
    /// dim)`, `(n2, dim)` and dim, of mean squared norm 1; `rows` are eigenvectors `(n, stride)`
    /// there. Unlike the eigenfunctions below k, they distinguish the sides of the surface that a
    /// reflection exchanges.
    pub fn at_samples(
        &self,
        other: &Self,
        c_12: &[f32],
        k: usize,
        one: (&[f32], usize),
        two: (&[f32], usize),
    ) -> (Vec<f32>, Vec<f32>, usize) {
        let (from, q1) = self.crossed(k);
        let back = self.transferred_then_crossed(other, c_12, k, k);
        let dim = from.len() / q1.max(1);
        let evaluate = |crossed: &[f32], q: usize, (rows, stride): (&[f32], usize)| {
            let n = rows.len() / stride;
            let q_used = q.min(stride);
            let crossed = super::samples::columns(crossed, q, q_used);
            let rows = super::samples::columns(rows, stride, q_used);
            let mut x = super::basis::product_transposed(&rows, &crossed, n, q_used, dim);
            let square: f32 = x.iter().map(|v| v * v).sum::<f32>() / n.max(1) as f32;
            let scale = square.max(1e-20).sqrt().recip();
            x.iter_mut().for_each(|v| *v *= scale);
            x
        };
        (evaluate(&from, q1, one), evaluate(&back, other.q, two), dim)
    }
}
