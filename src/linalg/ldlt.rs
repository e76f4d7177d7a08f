//! A sparse symmetric matrix becomes L D Lᵀ, whose pivots count eigenvalues and whose solves take a
//! panel of 16 right-hand sides at a time.
//!
//! The fill-reducing order (approximate minimum degree), the symbolic analysis and the supernodal
//! numeric factorisation are `faer`'s; the factor is then repacked for panel solves, which would
//! otherwise dominate. There is no pivoting: the inertia is that of a nearby matrix `S - σI + E`,
//! and [`Factor::perturbation`] bounds the norm of `E` (Higham, *Accuracy and Stability of
//! Numerical Algorithms*, 2002, theorem 10.3, which holds for D of any sign).

use super::panel::{Row, WIDTH};
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

/// `P (S - σI) Pᵀ = L D Lᵀ`, ready for panel solves.
#[derive(Debug)]
pub struct Factor {
    /// Negative pivots: eigenvalues of the (perturbed) matrix below the shift.
    pub n_negative: usize,
    /// Bound on the 2-norm of the perturbation `E` that the factorisation amounts to.
    pub perturbation: f64,
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
        let n = matrix.n();
        let Some(symbolic) = analysis.supernodal() else {
            return Self::of_diagonal(matrix, shift);
        };
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
        Self::packed(symbolic, &factor)
    }

    fn of_diagonal(matrix: &SymmetricSparse, shift: f64) -> Result<Self, LdltError> {
        let n = matrix.n();
        assert_eq!(
            matrix.columns.len(),
            n,
            "invariant: only a diagonal has no supernodes"
        );
        let mut out = Self {
            n_negative: 0,
            perturbation: 0.0,
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
            out.n_negative += usize::from(pivot < 0.0);
            out.inverse_pivots.push(1.0 / pivot);
            out.perturbation = f64::max(out.perturbation, f64::EPSILON * pivot.abs());
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

    fn packed(
        symbolic: &SymbolicSupernodalCholesky<u32>,
        factor: &[f64],
    ) -> Result<Self, LdltError> {
        let n = symbolic.nrows();
        let numeric = SupernodalLdltRef::new(symbolic, factor);
        let mut out = Self {
            n_negative: 0,
            perturbation: 0.0,
            blocks: Vec::new(),
            rows: Vec::with_capacity(symbolic.row_idx().len()),
            values: Vec::with_capacity(factor.len()),
            inverse_pivots: vec![0.0; n],
        };
        // Row sums of |L| |D| |Lᵀ| and the longest row of L bound the perturbation.
        let mut scaled = vec![0.0; n];
        let mut growth = vec![0.0; n];
        let mut row_lengths = vec![0u32; n];
        for s in 0..symbolic.n_supernodes() {
            let supernode = numeric.supernode(s);
            let (start, pattern, val) = (supernode.start(), supernode.pattern(), supernode.val());
            let (n_columns, n_rows) = (val.ncols(), val.nrows());
            let first_row = out.rows.len();
            out.rows.extend_from_slice(pattern);
            let index = |i: usize| match i < n_columns {
                true => start + i,
                false => pattern[i - n_columns] as usize,
            };
            for j in 0..n_columns {
                let pivot = val[(j, j)];
                if pivot == 0.0 || !pivot.is_finite() {
                    return Err(LdltError::ZeroPivot {
                        index: start + j,
                        n,
                    });
                }
                out.n_negative += usize::from(pivot < 0.0);
                out.inverse_pivots[start + j] = 1.0 / pivot;
                let sum: f64 = (j + 1..n_rows).map(|i| val[(i, j)].abs()).sum();
                let weight = pivot.abs() * (1.0 + sum);
                scaled[start + j] = weight;
                growth[start + j] += weight;
                row_lengths[start + j] += 1;
                for i in j + 1..n_rows {
                    growth[index(i)] += val[(i, j)].abs() * weight;
                    row_lengths[index(i)] += 1;
                }
            }
            let mut o = 0;
            while o < n_columns {
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
                o += width;
            }
        }
        let longest = row_lengths.iter().copied().max().unwrap_or(0);
        let largest = growth.iter().copied().fold(0.0, f64::max);
        out.perturbation = (f64::from(longest) + 1.0) * f64::EPSILON * largest;
        Ok(out)
    }

    /// `X ← (S - σI)⁻¹ X` for a panel in elimination order.
    pub fn solve(&self, panel: &mut [Row]) {
        Arch::new().dispatch(Solve {
            factor: self,
            x: panel,
        });
    }
}

struct Solve<'a> {
    factor: &'a Factor,
    x: &'a mut [Row],
}

impl WithSimd for Solve<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { factor, x } = self;
        for block in &factor.blocks {
            match block.width {
                1 => forward::<S, 1>(simd, factor, block, x),
                2 => forward::<S, 2>(simd, factor, block, x),
                3 => forward::<S, 3>(simd, factor, block, x),
                4 => forward::<S, 4>(simd, factor, block, x),
                5 => forward::<S, 5>(simd, factor, block, x),
                _ => forward::<S, MAX_BLOCK>(simd, factor, block, x),
            }
        }
        for block in factor.blocks.iter().rev() {
            match block.width {
                1 => backward::<S, 1>(simd, factor, block, x),
                2 => backward::<S, 2>(simd, factor, block, x),
                3 => backward::<S, 3>(simd, factor, block, x),
                4 => backward::<S, 4>(simd, factor, block, x),
                5 => backward::<S, 5>(simd, factor, block, x),
                _ => backward::<S, MAX_BLOCK>(simd, factor, block, x),
            }
        }
    }
}

#[inline(always)]
fn pair<S: Simd>(row: &Row, h: usize) -> [S::f64s; 2] {
    let (vectors, _) = S::as_simd_f64s(&row.0);
    [vectors[2 * h], vectors[2 * h + 1]]
}

#[inline(always)]
fn set_pair<S: Simd>(row: &mut Row, h: usize, x: [S::f64s; 2]) {
    let (vectors, _) = S::as_mut_simd_f64s(&mut row.0);
    vectors[2 * h] = x[0];
    vectors[2 * h + 1] = x[1];
}

/// `a + l b`.
#[inline(always)]
fn add_scaled<S: Simd>(simd: S, a: [S::f64s; 2], l: f64, b: [S::f64s; 2]) -> [S::f64s; 2] {
    let l = simd.splat_f64s(l);
    [
        simd.mul_add_e_f64s(l, b[0], a[0]),
        simd.mul_add_e_f64s(l, b[1], a[1]),
    ]
}

#[inline(always)]
fn forward<S: Simd, const W: usize>(simd: S, factor: &Factor, block: &Block, x: &mut [Row]) {
    let rows = &factor.rows[block.rows.0..block.rows.1];
    let n_entries = W * (W + block.n_local + rows.len());
    let (l, _) = factor.values[block.value..block.value + n_entries].as_chunks::<W>();
    let (triangle, below) = l.split_at(W);
    let (local, further) = below.split_at(block.n_local);
    let end = block.column + W;
    for h in 0..WIDTH / (2 * S::F64_LANES) {
        let mut a = [[simd.splat_f64s(0.0); 2]; W];
        for (ai, xi) in a.iter_mut().zip(&x[block.column..end]) {
            *ai = pair::<S>(xi, h);
        }
        for i in 1..W {
            for k in 0..i {
                a[i] = add_scaled(simd, a[i], triangle[i][k], a[k]);
            }
        }
        for (ai, xi) in a.iter().zip(&mut x[block.column..end]) {
            set_pair::<S>(xi, h, *ai);
        }
        for (li, xi) in local.iter().zip(&mut x[end..end + block.n_local]) {
            let mut y = pair::<S>(xi, h);
            for k in 0..W {
                y = add_scaled(simd, y, li[k], a[k]);
            }
            set_pair::<S>(xi, h, y);
        }
        for (li, &r) in further.iter().zip(rows) {
            let xi = &mut x[r as usize];
            let mut y = pair::<S>(xi, h);
            for k in 0..W {
                y = add_scaled(simd, y, li[k], a[k]);
            }
            set_pair::<S>(xi, h, y);
        }
    }
}

#[inline(always)]
fn backward<S: Simd, const W: usize>(simd: S, factor: &Factor, block: &Block, x: &mut [Row]) {
    let rows = &factor.rows[block.rows.0..block.rows.1];
    let n_entries = W * (W + block.n_local + rows.len());
    let (l, _) = factor.values[block.value..block.value + n_entries].as_chunks::<W>();
    let (triangle, below) = l.split_at(W);
    let (local, further) = below.split_at(block.n_local);
    let end = block.column + W;
    let inverse_pivots = &factor.inverse_pivots[block.column..end];
    for h in 0..WIDTH / (2 * S::F64_LANES) {
        let mut a = [[simd.splat_f64s(0.0); 2]; W];
        for ((ai, xi), &d) in a.iter_mut().zip(&x[block.column..end]).zip(inverse_pivots) {
            let [x0, x1] = pair::<S>(xi, h);
            let d = simd.splat_f64s(d);
            *ai = [simd.mul_f64s(x0, d), simd.mul_f64s(x1, d)];
        }
        for (li, xi) in local.iter().zip(&x[end..end + block.n_local]) {
            let y = pair::<S>(xi, h);
            for k in 0..W {
                a[k] = add_scaled(simd, a[k], li[k], y);
            }
        }
        for (li, &r) in further.iter().zip(rows) {
            let y = pair::<S>(&x[r as usize], h);
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
            set_pair::<S>(xi, h, *ai);
        }
    }
}
