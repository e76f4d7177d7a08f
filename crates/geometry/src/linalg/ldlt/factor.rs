//! Stores L D Lᵀ in a layout for solves of a panel of 8 right-hand sides at a time.

use super::super::panel::{Row, WIDTH, add_scaled, load, store};
use super::inertia::negative_pivots;
use super::{Analysis, LdltError, SymmetricSparse, diagonal_pivots, factorised};
use faer::sparse::linalg::cholesky::supernodal::SupernodalLdltRef;
use pulp::{Arch, Simd, WithSimd};

/// The columns of L that a solve handles together; there are [`Block::width`] of them.
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
    /// Number of negative pivots: of eigenvalues below the shift, up to rounding.
    pub n_negative: usize,
    blocks: Vec<Block>,
    rows: Vec<u32>,
    /// Per block: the unit lower triangle, then the rows below, row-major, all negated.
    values: Vec<f64>,
    inverse_pivots: Vec<f64>,
}

impl Factor {
    /// Factorises `matrix - shift I`, where `matrix` is already in the order of `analysis`.
    ///
    /// ```
    /// use coseg_geometry::linalg::ldlt::{Analysis, Factor, SymmetricSparse};
    /// use coseg_geometry::linalg::panel::{Row, zero_panel};
    ///
    /// let matrix = SymmetricSparse {
    ///     row_starts: vec![0, 2, 4],
    ///     columns: vec![0, 1, 0, 1],
    ///     values: vec![2.0, -1.0, -1.0, 2.0], // with eigenvalues 1 and 3
    /// };
    /// let analysis = Analysis::new(&matrix)?;
    /// let factor = Factor::new(&analysis, &matrix.permuted(&analysis.order), 2.5)?;
    /// assert_eq!(factor.n_negative, 1); // one eigenvalue is below 2.5
    /// let mut panel = zero_panel(2);
    /// panel[..2].fill(Row([1.0; 8])); // (1, 1), the eigenvector of 1, eight times
    /// factor.solve(&mut panel, false);
    /// assert!((panel[0].0[0] * (1.0 - 2.5) - 1.0).abs() < 1e-12);
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
    ) -> Result<Self, LdltError> {
        let Some(symbolic) = analysis.supernodal() else {
            return Self::of_diagonal(matrix, shift);
        };
        let factor = factorised(symbolic, matrix, shift)?;
        let numeric = SupernodalLdltRef::new(symbolic, &factor);
        Ok(Self::packed(&numeric, negative_pivots(&numeric)?))
    }

    fn of_diagonal(matrix: &SymmetricSparse, shift: f64) -> Result<Self, LdltError> {
        let pivots = diagonal_pivots(matrix, shift)?;
        let block = |column| Block {
            column,
            width: 1,
            n_local: 0,
            value: column,
            rows: (0, 0),
        };
        Ok(Self {
            n_negative: pivots.iter().filter(|d| **d < 0.0).count(),
            blocks: (0..pivots.len()).map(block).collect(),
            rows: Vec::new(),
            values: vec![0.0; pivots.len()],
            inverse_pivots: pivots.iter().map(|d| 1.0 / d).collect(),
        })
    }

    fn packed(numeric: &SupernodalLdltRef<u32, f64>, n_negative: usize) -> Self {
        let symbolic = numeric.symbolic();
        let mut out = Self {
            n_negative,
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

/// Rows of a block's entries, `W` each.
type Entries<'a, const W: usize> = &'a [[f64; W]];

impl Block {
    /// The unit triangle, the rows of the same supernode, the further rows, and which these are.
    #[inline(always)]
    fn entries<'a, const W: usize>(
        &self,
        factor: &'a Factor,
    ) -> (Entries<'a, W>, Entries<'a, W>, Entries<'a, W>, &'a [u32]) {
        let rows = &factor.rows[self.rows.0..self.rows.1];
        let n_entries = W * (W + self.n_local + rows.len());
        let (l, _) = factor.values[self.value..self.value + n_entries].as_chunks::<W>();
        let (triangle, below) = l.split_at(W);
        let (local, further) = below.split_at(self.n_local);
        (triangle, local, further, rows)
    }
}

#[inline(always)]
fn forward<S: Simd, const X: usize, const W: usize, const C: usize>(
    simd: S,
    factor: &Factor,
    block: &Block,
    x: &mut [[f64; C]],
) {
    let (triangle, local, further, rows) = block.entries::<W>(factor);
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
    let (triangle, local, further, rows) = block.entries::<W>(factor);
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
