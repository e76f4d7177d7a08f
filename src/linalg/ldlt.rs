//! A sparse symmetric matrix becomes L D Lᵀ, whose pivots count eigenvalues and whose solves take a
//! panel of 8 right-hand sides at a time.
//!
//! The fill-reducing order (approximate minimum degree), the symbolic analysis and the supernodal
//! numeric factorisation are `faer`'s; the factor is then repacked for panel solves, which would
//! otherwise dominate. There is no pivoting: the inertia is that of a nearby matrix `S - σI + E`,
//! and [`Factor::perturbation`] bounds the norm of `E` (Higham, *Accuracy and Stability of
//! Numerical Algorithms*, 2002, theorem 10.3, which holds for D of any sign).

use super::panel::{Row, WIDTH, add_scaled, load, store};
use faer::Par;
use faer::dyn_stack::{MemBuffer, MemStack};
use faer::sparse::linalg::SupernodalThreshold;
use faer::sparse::linalg::cholesky::supernodal::{
    SupernodalLdltRef, SymbolicSupernodalCholesky, factorize_supernodal_numeric_ldlt,
    factorize_supernodal_numeric_ldlt_scratch,
};
use faer::sparse::linalg::cholesky::{
    CholeskySymbolicParams, SymbolicCholesky, SymbolicCholeskyRaw, SymmetricOrdering,
    factorize_symbolic_cholesky,
};
use faer::sparse::{SparseColMatRef, SymbolicSparseColMatRef};
use pulp::{Arch, Simd, WithSimd};

/// Why a factorisation failed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum LdltError {
    /// The order or the symbolic analysis failed: out of memory or too many entries.
    #[error("symbolic analysis of a matrix with {n} rows and {n_entries} entries failed: {reason}")]
    Symbolic {
        /// Rows.
        n: usize,
        /// Stored entries.
        n_entries: usize,
        /// What the analysis said.
        reason: String,
    },
    /// A pivot is zero or not finite: the shift is an eigenvalue of a leading block.
    #[error("pivot {index} of {n} is zero or not finite")]
    ZeroPivot {
        /// Position in elimination order.
        index: usize,
        /// Rows.
        n: usize,
    },
}

/// A sparse symmetric matrix: both triangles, compressed rows, every diagonal entry stored.
#[derive(Debug, Clone)]
pub struct SymmetricSparse {
    /// Where each row begins `(n + 1,)`.
    pub row_starts: Vec<usize>,
    /// Column of each entry, ascending in a row.
    pub columns: Vec<u32>,
    /// The entries.
    pub values: Vec<f64>,
}

impl SymmetricSparse {
    /// Rows.
    pub fn n(&self) -> usize {
        self.row_starts.len() - 1
    }

    /// Columns and values of row `i`.
    pub fn row(&self, i: usize) -> (&[u32], &[f64]) {
        let range = self.row_starts[i]..self.row_starts[i + 1];
        (&self.columns[range.clone()], &self.values[range])
    }

    /// `P M Pᵀ`: row `i` of the result is row `order[i]` of this matrix.
    pub fn permuted(&self, order: &[u32]) -> Self {
        let mut rank = vec![0u32; self.n()];
        for (new, &old) in order.iter().enumerate() {
            rank[old as usize] = new as u32;
        }
        let mut out = Self {
            row_starts: Vec::with_capacity(self.n() + 1),
            columns: Vec::with_capacity(self.columns.len()),
            values: Vec::with_capacity(self.values.len()),
        };
        out.row_starts.push(0);
        let mut entries: Vec<(u32, f64)> = Vec::new();
        for &old in order {
            let (columns, values) = self.row(old as usize);
            entries.clear();
            entries.extend(
                columns
                    .iter()
                    .map(|&c| rank[c as usize])
                    .zip(values.iter().copied()),
            );
            entries.sort_unstable_by_key(|e| e.0);
            out.columns.extend(entries.iter().map(|e| e.0));
            out.values.extend(entries.iter().map(|e| e.1));
            out.row_starts.push(out.columns.len());
        }
        out
    }
}

/// The order of elimination and the pattern of L, common to all shifts.
#[derive(Debug)]
pub struct Analysis {
    symbolic: SymbolicCholesky<u32>,
    /// Row `i` of the permuted matrix is row `order[i]` of the given one.
    pub order: Vec<u32>,
}

impl Analysis {
    /// Orders and analyses the pattern of `matrix`.
    pub fn new(matrix: &SymmetricSparse) -> Result<Self, LdltError> {
        let n = matrix.n();
        let failed = |reason: String| LdltError::Symbolic {
            n,
            n_entries: matrix.columns.len(),
            reason,
        };
        if n > i32::MAX as usize || matrix.columns.len() > i32::MAX as usize {
            return Err(failed(format!("the limit is {} for either", i32::MAX)));
        }
        let starts: Vec<u32> = matrix.row_starts.iter().map(|&p| p as u32).collect();
        let pattern = SymbolicSparseColMatRef::new_checked(n, n, &starts, None, &matrix.columns);
        let params = CholeskySymbolicParams {
            supernodal_flop_ratio_threshold: SupernodalThreshold::FORCE_SUPERNODAL,
            ..Default::default()
        };
        let symbolic =
            factorize_symbolic_cholesky(pattern, faer::Side::Lower, SymmetricOrdering::Amd, params)
                .map_err(|e| failed(format!("{e:?}")))?;
        let order = match symbolic.perm() {
            Some(perm) => perm.arrays().0.to_vec(),
            None => (0..n as u32).collect(),
        };
        Ok(Self { symbolic, order })
    }

    /// `None` for a diagonal matrix, whose analysis has no supernodes.
    fn supernodal(&self) -> Option<&SymbolicSupernodalCholesky<u32>> {
        match self.symbolic.raw() {
            SymbolicCholeskyRaw::Supernodal(s) => Some(s),
            SymbolicCholeskyRaw::Simplicial(_) => None,
        }
    }

    /// Entries of L as stored.
    pub fn n_factor_entries(&self) -> usize {
        self.symbolic.len_val()
    }
}

/// Columns of L that a solve handles together; [`Block::width`] of them.
#[derive(Debug, Clone, Copy)]
struct Block {
    column: usize,
    width: usize,
    /// Rows of the same supernode below this block.
    n_local: usize,
    /// Where its values begin.
    value: usize,
    /// The further rows, in [`Factor::rows`].
    rows: (usize, usize),
}

/// Columns a solve keeps in registers.
const MAX_BLOCK: usize = 6;

/// How many eigenvalues lie below a shift.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Inertia {
    /// Negative pivots: eigenvalues of the (perturbed) matrix below the shift.
    pub n_negative: usize,
    /// Bound on the 2-norm of the perturbation `E` that the factorisation amounts to.
    pub perturbation: f64,
}

impl Inertia {
    /// Counts the eigenvalues of `matrix`, already in the order of `analysis`, below `shift`.
    pub fn new(
        analysis: &Analysis,
        matrix: &SymmetricSparse,
        shift: f64,
    ) -> Result<Self, LdltError> {
        match analysis.supernodal() {
            None => Ok(Factor::of_diagonal(matrix, shift)?.inertia),
            Some(symbolic) => {
                let factor = factorised(symbolic, matrix, shift)?;
                Self::of(&SupernodalLdltRef::new(symbolic, &factor))
            }
        }
    }

    fn of(numeric: &SupernodalLdltRef<u32, f64>) -> Result<Self, LdltError> {
        let symbolic = numeric.symbolic();
        let n = symbolic.nrows();
        let mut n_negative = 0;
        // Row sums of |L| |D| |Lᵀ| and the longest row of L bound the perturbation.
        let mut growth = vec![0.0; n];
        let mut row_lengths = vec![0u32; n];
        for s in 0..symbolic.n_supernodes() {
            let supernode = numeric.supernode(s);
            let (start, pattern, val) = (supernode.start(), supernode.pattern(), supernode.val());
            let n_columns = val.ncols();
            for j in 0..n_columns {
                let column = val.col(j).try_as_col_major();
                let column = column
                    .expect("invariant: supernodes are column-major")
                    .as_slice();
                let pivot = column[j];
                if pivot == 0.0 || !pivot.is_finite() {
                    let index = start + j;
                    return Err(LdltError::ZeroPivot { index, n });
                }
                n_negative += usize::from(pivot < 0.0);
                let (local, further) = column[j + 1..].split_at(n_columns - j - 1);
                let sum: f64 = local.iter().chain(further).map(|l| l.abs()).sum();
                let weight = pivot.abs() * (1.0 + sum);
                growth[start + j] += weight;
                row_lengths[start + j] += 1;
                let rows = start + j + 1..start + n_columns;
                let below = pattern.iter().map(|&r| r as usize);
                for (row, l) in rows.chain(below).zip(local.iter().chain(further)) {
                    growth[row] += l.abs() * weight;
                    row_lengths[row] += 1;
                }
            }
        }
        let longest = row_lengths.iter().copied().max().unwrap_or(0);
        let largest = growth.iter().copied().fold(0.0, f64::max);
        let perturbation = (f64::from(longest) + 1.0) * f64::EPSILON * largest;
        Ok(Self {
            n_negative,
            perturbation,
        })
    }
}

/// The values of L and D, as `faer` lays them out.
fn factorised(
    symbolic: &SymbolicSupernodalCholesky<u32>,
    matrix: &SymmetricSparse,
    shift: f64,
) -> Result<Vec<f64>, LdltError> {
    let n = matrix.n();
    let mut starts = Vec::with_capacity(n + 1);
    let mut row_indices = Vec::with_capacity(matrix.columns.len() / 2 + n);
    let mut values = Vec::with_capacity(matrix.columns.len() / 2 + n);
    starts.push(0u32);
    for i in 0..n {
        let (columns, entries) = matrix.row(i);
        let first = columns.partition_point(|&c| (c as usize) < i);
        for (&c, &x) in columns[first..].iter().zip(&entries[first..]) {
            row_indices.push(c);
            values.push(if c as usize == i { x - shift } else { x });
        }
        starts.push(row_indices.len() as u32);
    }
    let lower = SparseColMatRef::new(
        SymbolicSparseColMatRef::new_checked(n, n, &starts, None, &row_indices),
        &values,
    );
    let mut factor = vec![0.0; symbolic.len_val()];
    let mut memory = MemBuffer::new(factorize_supernodal_numeric_ldlt_scratch::<u32, f64>(
        symbolic,
        Par::Seq,
        Default::default(),
    ));
    factorize_supernodal_numeric_ldlt(
        &mut factor,
        lower,
        Default::default(),
        symbolic,
        Par::Seq,
        MemStack::new(&mut memory),
        Default::default(),
    )
    .map_err(
        |faer::linalg::cholesky::ldlt::factor::LdltError::ZeroPivot { index }| {
            LdltError::ZeroPivot { index, n }
        },
    )?;
    Ok(factor)
}

/// `P (S - σI) Pᵀ = L D Lᵀ`, ready for panel solves.
#[derive(Debug)]
pub struct Factor {
    /// The count of eigenvalues below the shift.
    pub inertia: Inertia,
    blocks: Vec<Block>,
    rows: Vec<u32>,
    /// Per block: the unit lower triangle, then the rows below, row-major, all negated.
    values: Vec<f64>,
    inverse_pivots: Vec<f64>,
}

impl Factor {
    /// Factorises `matrix - shift I`, where `matrix` is already in the order of `analysis`.
    pub fn new(
        analysis: &Analysis,
        matrix: &SymmetricSparse,
        shift: f64,
    ) -> Result<Self, LdltError> {
        let Some(symbolic) = analysis.supernodal() else {
            return Self::of_diagonal(matrix, shift);
        };
        let factor = factorised(symbolic, matrix, shift)?;
        let numeric = SupernodalLdltRef::new(symbolic, &factor);
        Ok(Self::packed(&numeric, Inertia::of(&numeric)?))
    }

    fn of_diagonal(matrix: &SymmetricSparse, shift: f64) -> Result<Self, LdltError> {
        let n = matrix.n();
        assert_eq!(
            matrix.columns.len(),
            n,
            "invariant: only a diagonal has no supernodes"
        );
        let inertia = Inertia {
            n_negative: 0,
            perturbation: 0.0,
        };
        let mut out = Self {
            inertia,
            blocks: Vec::new(),
            rows: Vec::new(),
            values: vec![0.0; n],
            inverse_pivots: Vec::with_capacity(n),
        };
        for (index, x) in matrix.values.iter().enumerate() {
            let pivot = x - shift;
            if pivot == 0.0 || !pivot.is_finite() {
                return Err(LdltError::ZeroPivot { index, n });
            }
            out.inertia.n_negative += usize::from(pivot < 0.0);
            out.inverse_pivots.push(1.0 / pivot);
            out.inertia.perturbation =
                f64::max(out.inertia.perturbation, f64::EPSILON * pivot.abs());
            let rows = (0, 0);
            out.blocks.push(Block {
                column: index,
                width: 1,
                n_local: 0,
                value: index,
                rows,
            });
        }
        Ok(out)
    }

    fn packed(numeric: &SupernodalLdltRef<u32, f64>, inertia: Inertia) -> Self {
        let symbolic = numeric.symbolic();
        let mut out = Self {
            inertia,
            blocks: Vec::new(),
            rows: Vec::with_capacity(symbolic.row_idx().len()),
            values: Vec::with_capacity(symbolic.len_val()),
            inverse_pivots: Vec::with_capacity(symbolic.nrows()),
        };
        for s in 0..symbolic.n_supernodes() {
            let supernode = numeric.supernode(s);
            let (start, pattern, val) = (supernode.start(), supernode.pattern(), supernode.val());
            let (n_columns, n_rows) = (val.ncols(), val.nrows());
            let first_row = out.rows.len();
            out.rows.extend_from_slice(pattern);
            let pivots = (0..n_columns).map(|j| val[(j, j)]);
            out.inverse_pivots.extend(pivots.map(|d| 1.0 / d));
            for o in (0..n_columns).step_by(MAX_BLOCK) {
                let width = (n_columns - o).min(MAX_BLOCK);
                out.blocks.push(Block {
                    column: start + o,
                    width,
                    n_local: n_columns - o - width,
                    value: out.values.len(),
                    rows: (first_row, out.rows.len()),
                });
                for i in o..n_rows {
                    for c in o..o + width {
                        out.values.push(if i > c { -val[(i, c)] } else { 0.0 });
                    }
                }
            }
        }
        out
    }

    /// `X ← (S - σI)⁻¹ X` for a panel in elimination order. `parallel`: the columns are shared
    /// between two threads of the caller's rayon pool; each column comes out the same.
    pub fn solve(&self, panel: &mut [Row], parallel: bool) {
        let arch = Arch::new();
        let factor = self;
        if !parallel || !arch.dispatch(Halves) {
            let x = bytemuck::cast_slice_mut::<Row, [f64; WIDTH]>(panel);
            arch.dispatch(Solve { factor, x });
            return;
        }
        let mut left: Vec<Half> = panel.iter().map(|row| *half(row, 0)).collect();
        let mut right: Vec<Half> = panel.iter().map(|row| *half(row, 1)).collect();
        let solve = |x: &mut [Half]| arch.dispatch(Solve { factor, x });
        rayon::join(|| solve(&mut left), || solve(&mut right));
        for (row, (l, r)) in panel.iter_mut().zip(left.iter().zip(&right)) {
            row.0[..WIDTH / 2].copy_from_slice(l);
            row.0[WIDTH / 2..].copy_from_slice(r);
        }
    }
}

/// Half a row.
type Half = [f64; WIDTH / 2];

fn half(row: &Row, which: usize) -> &Half {
    &row.0.as_chunks().0[which]
}

/// Whether half a row is made of whole vectors.
struct Halves;

impl WithSimd for Halves {
    type Output = bool;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> bool {
        (WIDTH / 2).is_multiple_of(S::F64_LANES)
    }
}

struct Solve<'a, const C: usize> {
    factor: &'a Factor,
    x: &'a mut [[f64; C]],
}

impl<const C: usize> WithSimd for Solve<'_, C> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        if 2 * S::F64_LANES <= C {
            solve::<S, 2, C>(simd, self.factor, self.x);
        } else {
            solve::<S, 1, C>(simd, self.factor, self.x);
        }
    }
}

#[inline(always)]
fn solve<S: Simd, const X: usize, const C: usize>(simd: S, factor: &Factor, x: &mut [[f64; C]]) {
    for block in &factor.blocks {
        match block.width {
            1 => forward::<S, X, 1, C>(simd, factor, block, x),
            2 => forward::<S, X, 2, C>(simd, factor, block, x),
            3 => forward::<S, X, 3, C>(simd, factor, block, x),
            4 => forward::<S, X, 4, C>(simd, factor, block, x),
            5 => forward::<S, X, 5, C>(simd, factor, block, x),
            _ => forward::<S, X, MAX_BLOCK, C>(simd, factor, block, x),
        }
    }
    for block in factor.blocks.iter().rev() {
        match block.width {
            1 => backward::<S, X, 1, C>(simd, factor, block, x),
            2 => backward::<S, X, 2, C>(simd, factor, block, x),
            3 => backward::<S, X, 3, C>(simd, factor, block, x),
            4 => backward::<S, X, 4, C>(simd, factor, block, x),
            5 => backward::<S, X, 5, C>(simd, factor, block, x),
            _ => backward::<S, X, MAX_BLOCK, C>(simd, factor, block, x),
        }
    }
}

#[inline(always)]
fn forward<S: Simd, const X: usize, const W: usize, const C: usize>(
    simd: S,
    factor: &Factor,
    block: &Block,
    x: &mut [[f64; C]],
) {
    let rows = &factor.rows[block.rows.0..block.rows.1];
    let n_entries = W * (W + block.n_local + rows.len());
    let (l, _) = factor.values[block.value..block.value + n_entries].as_chunks::<W>();
    let (triangle, below) = l.split_at(W);
    let (local, further) = below.split_at(block.n_local);
    let end = block.column + W;
    for h in 0..C / (X * S::F64_LANES) {
        let mut a = [[simd.splat_f64s(0.0); X]; W];
        for (ai, xi) in a.iter_mut().zip(&x[block.column..end]) {
            *ai = load::<S, X>(xi, h);
        }
        for i in 1..W {
            for k in 0..i {
                a[i] = add_scaled(simd, a[i], triangle[i][k], a[k]);
            }
        }
        for (ai, xi) in a.iter().zip(&mut x[block.column..end]) {
            store::<S, X>(xi, h, *ai);
        }
        for (li, xi) in local.iter().zip(&mut x[end..end + block.n_local]) {
            let mut y = load::<S, X>(xi, h);
            for k in 0..W {
                y = add_scaled(simd, y, li[k], a[k]);
            }
            store::<S, X>(xi, h, y);
        }
        for (li, &r) in further.iter().zip(rows) {
            let xi = &mut x[r as usize];
            let mut y = load::<S, X>(xi, h);
            for k in 0..W {
                y = add_scaled(simd, y, li[k], a[k]);
            }
            store::<S, X>(xi, h, y);
        }
    }
}

#[inline(always)]
fn backward<S: Simd, const X: usize, const W: usize, const C: usize>(
    simd: S,
    factor: &Factor,
    block: &Block,
    x: &mut [[f64; C]],
) {
    let rows = &factor.rows[block.rows.0..block.rows.1];
    let n_entries = W * (W + block.n_local + rows.len());
    let (l, _) = factor.values[block.value..block.value + n_entries].as_chunks::<W>();
    let (triangle, below) = l.split_at(W);
    let (local, further) = below.split_at(block.n_local);
    let end = block.column + W;
    let inverse_pivots = &factor.inverse_pivots[block.column..end];
    for h in 0..C / (X * S::F64_LANES) {
        let mut a = [[simd.splat_f64s(0.0); X]; W];
        for ((ai, xi), &d) in a.iter_mut().zip(&x[block.column..end]).zip(inverse_pivots) {
            let d = simd.splat_f64s(d);
            *ai = load::<S, X>(xi, h).map(|x| simd.mul_f64s(x, d));
        }
        for (li, xi) in local.iter().zip(&x[end..end + block.n_local]) {
            let y = load::<S, X>(xi, h);
            for k in 0..W {
                a[k] = add_scaled(simd, a[k], li[k], y);
            }
        }
        for (li, &r) in further.iter().zip(rows) {
            let y = load::<S, X>(&x[r as usize], h);
            for k in 0..W {
                a[k] = add_scaled(simd, a[k], li[k], y);
            }
        }
        for i in (0..W).rev() {
            for k in i + 1..W {
                a[i] = add_scaled(simd, a[i], triangle[k][i], a[k]);
            }
        }
        for (ai, xi) in a.iter().zip(&mut x[block.column..end]) {
            store::<S, X>(xi, h, *ai);
        }
    }
}
