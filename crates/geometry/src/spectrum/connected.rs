//! Computes the smallest eigenpairs of one connected component, proved complete: densely if it is
//! small or most of its spectrum is wanted.

use super::component::Component;
use super::iterative::{Lanczos, first_dimension};
use super::polish::verify_and_polish;
use super::{Hook, SpectrumError};
use crate::linalg::basis::Basis;
use crate::linalg::dense_eigen::symmetric_eigen;
use crate::linalg::panel::{WIDTH, zero_panel};

/// Components up to this size are solved densely.
const DENSE_ALWAYS: usize = 160;

/// Dense eigenvalues below minus this share of the largest one are too negative for rounding.
const NEGATIVE: f64 = 1e-10;

/// Eigenpairs of a component: all that lie below `limit`.
pub(super) struct Pairs {
    /// Ascending.
    pub(super) values: Vec<f64>,
    /// `‖S x - λ x‖` of each.
    pub(super) residuals: Vec<f64>,
    /// Least and largest entry of each eigenvector of W.
    pub(super) extremes: Vec<(f64, f64)>,
    /// Orthonormal eigenvectors of S, rows in elimination order.
    pub(super) vectors: Basis,
    /// Every eigenvalue below this is among `values`.
    pub(super) limit: f64,
    /// Distance from `limit` to the nearest eigenvalue found.
    pub(super) margin: f64,
    /// Bound on the perturbation of S under which the count at `limit` is exact.
    pub(super) perturbation: f64,
    /// Growth of the pivots where it was counted; 1 for a dense solve.
    pub(super) growth: f64,
    /// Dimension of the Krylov space; 0 for a dense solve.
    pub(super) n_krylov: usize,
    /// Rounds of inverse iteration and of search for missing pairs.
    pub(super) n_polish: usize,
    pub(super) n_repair: usize,
}

/// The parameters of a solve besides the matrix.
pub(super) struct Setting<'a> {
    pub(super) tolerance: f64,
    pub(super) seed: u64,
    pub(super) parallel: bool,
    pub(super) hook: Hook<'a>,
}

/// At least `k` smallest eigenpairs (1 ≤ k ≤ n), all of them below `limit`.
pub(super) fn smallest(
    component: &Component,
    k: usize,
    setting: &Setting,
) -> Result<Pairs, SpectrumError> {
    let n = component.n();
    let krylov = first_dimension(k);
    if n <= DENSE_ALWAYS || krylov + 4 * WIDTH > n * 3 / 4 {
        return dense(component, k, setting);
    }
    Lanczos { component, setting }.run(k)
}

/// A limit between two eigenvalues.
#[derive(Debug, Clone, Copy)]
pub(super) struct Gap {
    /// Number of pairs below the limit.
    pub(super) count: usize,
    pub(super) limit: f64,
    /// Distance from the limit to the last of these pairs.
    pub(super) margin: f64,
}

/// Chooses the limit for ascending `values`: in the first gap at or after pair k that lies outside
/// a cluster and has room for a margin above `least`, which is usually 0.
pub(super) fn gap_after(values: &[f64], k: usize, n: usize, least: f64) -> Option<Gap> {
    for j in k..=values.len() {
        if j == n {
            return Some(Gap {
                count: n,
                limit: f64::INFINITY,
                margin: f64::INFINITY,
            });
        }
        if j < values.len() {
            let gap = values[j] - values[j - 1];
            let mean_spacing = values[j] / (j + 1) as f64;
            // The limit is near the pair below, whose value is the most accurate; where a wide
            // margin is required, it is in the middle.
            let margin = match least > 0.0 {
                true => 0.5 * gap,
                false => 0.3 * gap.min(mean_spacing),
            };
            if gap > 0.02 * mean_spacing && margin > least {
                return Some(Gap {
                    count: j,
                    limit: values[j - 1] + margin,
                    margin,
                });
            }
        }
    }
    None
}

pub(super) fn dense(
    component: &Component,
    k: usize,
    setting: &Setting,
) -> Result<Pairs, SpectrumError> {
    setting.hook.enter("dense")?;
    let n = component.n();
    let mut a = vec![0.0; n * n];
    for i in 0..n {
        let (columns, values) = component.standard.row(i);
        for (&c, &x) in columns.iter().zip(values) {
            a[i * n + c as usize] = x;
        }
    }
    let (mut values, vectors) = symmetric_eigen(&a, n)?;
    let largest = values[n - 1].abs().max(values[0].abs());
    let count = values.iter().filter(|l| **l < -NEGATIVE * largest).count();
    if count > 0 {
        return Err(SpectrumError::NotSemidefinite {
            count,
            below: -NEGATIVE * largest,
        });
    }
    if component.has_null_vector {
        values[0] = 0.0;
    }
    let perturbation = n as f64 * f64::EPSILON * largest;
    let gap = gap_after(&values, k, n, 0.0).filter(|gap| gap.margin > perturbation);
    let gap = gap.or_else(|| gap_after(&values, k, n, 2.0 * perturbation));
    let Gap {
        count: j,
        limit,
        margin,
    } = gap.unwrap_or(Gap {
        count: n,
        limit: f64::INFINITY,
        margin: f64::INFINITY,
    });
    let mut basis = Basis::new(n, j.div_ceil(WIDTH), setting.parallel);
    // The null vector is known exactly, so the others are made orthogonal to it rather than to its
    // approximation.
    let mut null = Basis::new(n, 1, setting.parallel);
    if component.has_null_vector {
        null.push(&zero_panel(n));
        component.set_null_vector(&mut null);
    }
    for first in (0..j).step_by(WIDTH) {
        let mut panel = zero_panel(n);
        for column in first..(first + WIDTH).min(j) {
            for (i, row) in panel[..n].iter_mut().enumerate() {
                row.0[column - first] = vectors[(i, column)];
            }
        }
        null.remove(0, [&mut panel]);
        basis.push(&panel);
    }
    if component.has_null_vector {
        component.set_null_vector(&mut basis);
    }
    values.truncate(j);
    let mut pairs = Pairs {
        values,
        residuals: Vec::new(),
        extremes: Vec::new(),
        vectors: basis,
        limit,
        margin,
        perturbation,
        growth: 1.0,
        n_krylov: 0,
        n_polish: 0,
        n_repair: 0,
    };
    verify_and_polish(component, setting, None, &mut pairs)?;
    Ok(pairs)
}
