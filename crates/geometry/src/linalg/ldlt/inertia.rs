//! Counts eigenvalues by the signs of the pivots of L D Lᵀ, with a bound on the effect of rounding.
//!
//! The count is that of the eigenvalues of `M + E`, `M = S - σI`, with `|E| ≤ G`, entry by entry,
//! `G_ij = √(γ_i γ_j) (|L| |D| |Lᵀ|)_ij`, where `γ_i` is the unit roundoff times the number of
//! operations on row i of L (Higham, *Accuracy and Stability of Numerical Algorithms*, 2002,
//! theorem 10.3, which holds for D of any sign and any order of summation). G is symmetric and not
//! negative, so its norm is at most `max (G x)_i / x_i` for any positive x (Collatz and Wielandt),
//! and a few steps of the power method find an x for which the bound is nearly the norm. Hence
//! every growth of pivots is seen.

use super::{Analysis, LdltError, SymmetricSparse, diagonal_pivots, factorised};
use faer::sparse::linalg::cholesky::supernodal::SupernodalLdltRef;

/// Half the distance from 1 to the next number.
const ROUNDOFF: f64 = 0.5 * f64::EPSILON;

/// Roundings of an entry besides those of its sum: of the product, of the pivot's reciprocal, and
/// of their product.
const FURTHER: f64 = 4.0;

/// Roundings of an entry of S, which is an entry of W over the root of two masses.
const STANDARDISED: f64 = 4.0;

/// Steps of the power method, each as cheap as a solve, after which the bound hardly improves.
const MAX_STEPS: usize = 12;

/// Factor for the rounding of the sums in the bound itself.
const SLACK: f64 = 1.0 + 1e-6;

/// How many eigenvalues lie below a shift.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Inertia {
    /// Negative pivots: eigenvalues of the (perturbed) matrix below the shift.
    pub n_negative: usize,
    /// Bound on the 2-norm of the perturbation that the factorisation amounts to.
    pub perturbation: f64,
    /// Growth of the pivots: the largest row sum of `|L| |D| |Lᵀ|` over that of `|S - σI|`. It is
    /// about the length of a row where the matrix is definite.
    pub growth: f64,
}

impl Inertia {
    /// Counts the eigenvalues of `matrix`, already in the order of `analysis`, below `shift`. The
    /// bound is made sharper, at the cost of a few solves, until it is below `enough`.
    ///
    /// ```
    /// use coseg_geometry::linalg::ldlt::{Analysis, Inertia, SymmetricSparse};
    ///
    /// let matrix = SymmetricSparse {
    ///     row_starts: vec![0, 2, 4],
    ///     columns: vec![0, 1, 0, 1],
    ///     values: vec![2.0, -1.0, -1.0, 2.0], // with eigenvalues 1 and 3
    /// };
    /// let analysis = Analysis::new(&matrix)?;
    /// let found = Inertia::new(&analysis, &matrix.permuted(&analysis.order), 2.5, 0.5)?;
    /// assert_eq!(found.n_negative, 1);
    /// // Rounding cannot have moved an eigenvalue across the shift, half a unit away.
    /// assert!(found.perturbation < 0.5);
    /// # Ok::<_, coseg_geometry::linalg::ldlt::LdltError>(())
    /// ```
    ///
    /// # Errors
    /// If a pivot is zero: the shift is an eigenvalue of a leading block, and another shift nearby
    /// is not.
    pub fn new(
        analysis: &Analysis,
        matrix: &SymmetricSparse,
        shift: f64,
        enough: f64,
    ) -> Result<Self, LdltError> {
        let Some(symbolic) = analysis.supernodal() else {
            let pivots = diagonal_pivots(matrix, shift)?;
            let largest = pivots.iter().fold(0.0, |m: f64, d| m.max(d.abs()));
            return Ok(Self {
                n_negative: pivots.iter().filter(|d| **d < 0.0).count(),
                perturbation: FURTHER * ROUNDOFF * (largest + shift.abs()),
                growth: 1.0,
            });
        };
        let factor = factorised(symbolic, matrix, shift)?;
        let numeric = SupernodalLdltRef::new(symbolic, &factor);
        let n_negative = negative_pivots(&numeric)?;
        let rows = absolute_row_sums(matrix, shift);
        let given = rows.iter().copied().fold(0.0, f64::max);
        let (factorisation, products) = perturbation(&numeric, enough);
        Ok(Self {
            n_negative,
            perturbation: SLACK * (factorisation + STANDARDISED * ROUNDOFF * given),
            growth: if given > 0.0 { products / given } else { 1.0 },
        })
    }
}

/// Counts negative pivots; returns an error for a pivot that is zero or not finite.
pub(super) fn negative_pivots(numeric: &SupernodalLdltRef<u32, f64>) -> Result<usize, LdltError> {
    let symbolic = numeric.symbolic();
    let n = symbolic.nrows();
    let mut n_negative = 0;
    for s in 0..symbolic.n_supernodes() {
        let supernode = numeric.supernode(s);
        let (start, val) = (supernode.start(), supernode.val());
        for j in 0..val.ncols() {
            let pivot = val[(j, j)];
            if pivot == 0.0 || !pivot.is_finite() {
                let index = start + j;
                return Err(LdltError::ZeroPivot { index, n });
            }
            n_negative += usize::from(pivot < 0.0);
        }
    }
    Ok(n_negative)
}

/// Row sums of `|S| + |σ| I`.
fn absolute_row_sums(matrix: &SymmetricSparse, shift: f64) -> Vec<f64> {
    let row = |i| {
        let (_, values) = matrix.row(i);
        values.iter().map(|x| x.abs()).sum::<f64>() + shift.abs()
    };
    (0..matrix.n()).map(row).collect()
}

/// The bound on E, and the largest row sum of `|L| |D| |Lᵀ|`.
fn perturbation(numeric: &SupernodalLdltRef<u32, f64>, enough: f64) -> (f64, f64) {
    let symbolic = numeric.symbolic();
    let n = symbolic.nrows();
    let mut lengths = vec![1.0; n];
    for s in 0..symbolic.n_supernodes() {
        let supernode = numeric.supernode(s);
        let (start, n_columns) = (supernode.start(), supernode.val().ncols());
        for j in 0..n_columns {
            lengths[start + j] += j as f64;
        }
        for &row in supernode.pattern() {
            lengths[row as usize] += n_columns as f64;
        }
    }
    let mut x = vec![1.0; n];
    let mut image = vec![0.0; n];
    absolute_product(numeric, &x, &mut image);
    let products = image.iter().copied().fold(0.0, f64::max);
    let weights: Vec<f64> = lengths
        .iter()
        .map(|l| {
            let sum = (l + FURTHER) * ROUNDOFF;
            (sum / (1.0 - sum)).sqrt()
        })
        .collect();
    let mut bound = f64::INFINITY;
    for _ in 0..MAX_STEPS {
        let weighted: Vec<f64> = x.iter().zip(&weights).map(|(x, w)| x * w).collect();
        absolute_product(numeric, &weighted, &mut image);
        let mut largest = 0.0f64;
        let mut quotient = 0.0f64;
        for ((y, w), x) in image.iter_mut().zip(&weights).zip(&x) {
            *y *= w;
            largest = largest.max(*y);
            quotient = quotient.max(*y / x);
        }
        let before = bound;
        bound = bound.min(quotient);
        if !bound.is_finite() || bound < enough || bound > 0.95 * before {
            break;
        }
        // Rows of far smaller norm than the whole matrix need no precise x, and their x must not
        // come near zero.
        for (x, y) in x.iter_mut().zip(&image) {
            *x = (y / largest).max(1e-9);
        }
    }
    (bound, products)
}

/// `|L| |D| |Lᵀ| x`; reads each column of L once.
fn absolute_product(numeric: &SupernodalLdltRef<u32, f64>, x: &[f64], out: &mut [f64]) {
    out.fill(0.0);
    let symbolic = numeric.symbolic();
    for s in 0..symbolic.n_supernodes() {
        let supernode = numeric.supernode(s);
        let (start, pattern, val) = (supernode.start(), supernode.pattern(), supernode.val());
        let n_columns = val.ncols();
        for j in 0..n_columns {
            let column = val.col(j).try_as_col_major();
            let column = column
                .expect("invariant: supernodes are column-major")
                .as_slice();
            let (local, further) = column[j + 1..].split_at(n_columns - j - 1);
            let own = start + j;
            let rows = own + 1..start + n_columns;
            let mut sum = x[own];
            for (l, x) in local.iter().zip(&x[rows.clone()]) {
                sum += l.abs() * x;
            }
            for (l, &row) in further.iter().zip(pattern) {
                sum += l.abs() * x[row as usize];
            }
            sum *= column[j].abs();
            out[own] += sum;
            for (l, y) in local.iter().zip(&mut out[rows]) {
                *y += l.abs() * sum;
            }
            for (l, &row) in further.iter().zip(pattern) {
                out[row as usize] += l.abs() * sum;
            }
        }
    }
}
