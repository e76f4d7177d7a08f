//! Refines two functional maps, there and back, by each other: bijective ZoomOut.
//!
//! Ren et al. 2020, *MapTree: Recovering Multiple Solutions in the Space of Maps*. The distance of
//! a vertex v of shape 2 and a vertex u of shape 1 is that of `[Φ₂, Φ₂ C₂₁ᵀ](v)` and `[Φ₁ C₁₂ᵀ,
//! Φ₁](u)`: it compares them in the basis of shape 2 by the map there, and in that of shape 1 by
//! the map back. Nearest neighbours in both directions come from one product, and each map keeps
//! the other from collapsing onto a part of the surface.

use super::basis::{product, product_transposed, transposed_product};
use super::orientation::Orientation;
use super::samples::{SampledBasis, columns};
use crate::linalg::nearest::nearest_both;

/// Functional and pointwise maps of the same size in both directions.
#[derive(Debug, Clone, PartialEq)]
pub struct Pair {
    /// Rows and columns of both.
    pub k: usize,
    /// `(k, k)`, row-major.
    pub c_12: Vec<f32>,
    /// `(k, k)`, row-major.
    pub c_21: Vec<f32>,
}

/// Descriptors at the samples of both shapes, which the nearest-neighbour search includes.
#[derive(Debug, Clone, Copy)]
pub struct Guidance<'a> {
    /// `(n1, dim)`, row-major, of mean squared norm 1.
    pub one: &'a [f32],
    /// `(n2, dim)`.
    pub two: &'a [f32],
    /// Columns.
    pub dim: usize,
    /// Mean squared norm relative to the spectral coordinates.
    pub weight: f32,
}

/// The orientation that a map must keep or reverse while it is small.
#[derive(Debug, Clone, Copy)]
pub struct Turn<'a> {
    /// Of shape 1.
    pub one: &'a Orientation,
    /// Of shape 2.
    pub two: &'a Orientation,
    /// 1 to keep, −1 to reverse it.
    pub sign: f32,
    /// Mean squared norm of the crossed functions relative to the spectral coordinates.
    pub weight: f32,
    /// The largest size of a map for which orientation is imposed.
    pub k_max: usize,
}

/// The columns that are searched together with the spectral coordinates, at the samples of both
/// shapes.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Hints {
    one: Vec<f32>,
    two: Vec<f32>,
    dim: usize,
}

impl Hints {
    /// The columns for the next search of `pair`. Spectral coordinates in both bases have a mean
    /// squared norm of about 2k.
    fn new(
        pair: &Pair,
        one: &SampledBasis,
        two: &SampledBasis,
        guidance: Option<&Guidance<'_>>,
        turn: Option<&Turn<'_>>,
    ) -> Self {
        let scale = |weight: f32| (weight * 2.0 * pair.k as f32).sqrt();
        let crossed = turn.map(|t| {
            let (rows_1, rows_2) = ((&one.rows[..], one.k), (&two.rows[..], two.k));
            let (x1, x2, dim) = t.one.at_samples(t.two, &pair.c_12, pair.k, rows_1, rows_2);
            (x1, x2, dim, scale(t.weight), t.sign)
        });
        // Columns at the samples of shape 1 and of shape 2, their number, and their scale.
        let (mut ones, mut twos) = (Vec::new(), Vec::new());
        if let Some(g) = guidance.filter(|g| g.weight > 0.0) {
            ones.push((g.one, g.dim, scale(g.weight)));
            twos.push((g.two, g.dim, scale(g.weight)));
        }
        if let Some((x1, x2, dim, scale, sign)) = &crossed {
            ones.push((x1, *dim, *scale));
            twos.push((x2, *dim, scale * sign));
        }
        Self {
            dim: ones.iter().map(|(_, dim, _)| dim).sum(),
            one: side_by_side(&ones, one.n),
            two: side_by_side(&twos, two.n),
        }
    }
}

/// Joins matrices of `n` rows, each with its number of columns and a factor, to one, `(n, sum of
/// their columns)`.
fn side_by_side(parts: &[(&[f32], usize, f32)], n: usize) -> Vec<f32> {
    let dim: usize = parts.iter().map(|(_, dim, _)| dim).sum();
    let mut rows = Vec::with_capacity(n * dim);
    for v in 0..n {
        for (x, dim, scale) in parts {
            rows.extend(x[v * dim..(v + 1) * dim].iter().map(|x| scale * x));
        }
    }
    rows
}

impl Pair {
    /// The identity in the first `k` eigenfunctions with these signs.
    pub fn from_signs(signs: &[f32]) -> Self {
        let k = signs.len();
        let c: Vec<f32> = (0..k * k)
            .map(|i| if i / k == i % k { signs[i % k] } else { 0.0 })
            .collect();
        Self {
            k,
            c_12: c.clone(),
            c_21: c,
        }
    }

    /// The pointwise maps `p2p_21 (n2,)` and `p2p_12 (n1,)` between samples.
    pub fn pointwise(
        &self,
        one: &SampledBasis,
        two: &SampledBasis,
        hints: &Hints,
    ) -> (Vec<u32>, Vec<u32>) {
        let k = self.k;
        let (phi1, phi2) = (one.leading(k), two.leading(k));
        let transferred1 = product_transposed(&phi1, &self.c_12, one.n, k, k);
        let transferred2 = product_transposed(&phi2, &self.c_21, two.n, k, k);
        let dim = hints.dim;
        let join = |a: &[f32], b: &[f32], x: &[f32]| {
            let mut rows = Vec::with_capacity(a.len() + b.len() + x.len());
            for v in 0..a.len() / k {
                rows.extend_from_slice(&a[v * k..(v + 1) * k]);
                rows.extend_from_slice(&b[v * k..(v + 1) * k]);
                rows.extend_from_slice(&x[v * dim..(v + 1) * dim]);
            }
            rows
        };
        let queries = join(&phi2, &transferred2, &hints.two);
        let targets = join(&transferred1, &phi1, &hints.one);
        nearest_both(&queries, &targets, 2 * k + dim)
    }

    /// The maps of size `k` that follow from pointwise maps between samples.
    pub fn from_pointwise(
        one: &SampledBasis,
        two: &SampledBasis,
        p2p_21: &[u32],
        p2p_12: &[u32],
        k: usize,
    ) -> Self {
        let pull = |rows: &[f32], stride: usize, p2p: &[u32]| {
            let mut pulled = Vec::with_capacity(p2p.len() * k);
            for &t in p2p {
                let from = t as usize * stride;
                pulled.extend_from_slice(&rows[from..from + k]);
            }
            pulled
        };
        Self {
            k,
            c_12: two.fit(&pull(&one.rows, one.k, p2p_21), k, k),
            c_21: one.fit(&pull(&two.rows, two.k, p2p_12), k, k),
        }
    }

    /// Refines through the sizes `ks`, ascending.
    pub fn refine(
        mut self,
        one: &SampledBasis,
        two: &SampledBasis,
        ks: &[usize],
        guidance: Option<&Guidance<'_>>,
        turn: Option<&Turn<'_>>,
    ) -> Self {
        for &k in ks {
            let turn = turn.filter(|t| self.k <= t.k_max);
            let hints = Hints::new(&self, one, two, guidance, turn);
            let (p2p_21, p2p_12) = self.pointwise(one, two, &hints);
            self = Self::from_pointwise(one, two, &p2p_21, &p2p_12, k);
        }
        self
    }

    /// The deviation of the maps from being orthogonal and inverse to each other: the mean over
    /// both directions of `‖CᵀC − I‖²/k`, plus `‖C₁₂ C₂₁ − I‖²/k`.
    pub fn strain(&self) -> f64 {
        let k = self.k;
        let departure = |m: &[f32]| {
            let entries = m.iter().enumerate();
            let one = |i: usize| if i / k == i % k { 1.0 } else { 0.0 };
            entries
                .map(|(i, x)| f64::from(x - one(i)).powi(2))
                .sum::<f64>()
                / k as f64
        };
        let gram = |c: &[f32]| departure(&transposed_product(c, c, k, k, k));
        0.5 * (gram(&self.c_12) + gram(&self.c_21))
            + departure(&product(&self.c_12, &self.c_21, k, k, k))
    }

    /// The leading `k` rows and columns.
    pub fn leading(&self, k: usize) -> Self {
        let cut = |c: &[f32]| columns(&c[..k * self.k], self.k, k);
        Self {
            k,
            c_12: cut(&self.c_12),
            c_21: cut(&self.c_21),
        }
    }
}
