//! Factorises a sparse symmetric matrix as L D Lᵀ. The pivots count eigenvalues, and solves take a
//! panel of 8 right-hand sides at a time.
//!
//! The fill-reducing order (approximate minimum degree), the symbolic analysis and the supernodal
//! numeric factorisation are `faer`'s; the factor is then repacked for panel solves, which would
//! otherwise dominate. There is no pivoting: the inertia is that of a nearby matrix, and
//! [`Inertia::perturbation`] bounds the distance to it.

mod factor;
mod inertia;

pub use factor::Factor;
pub use inertia::Inertia;

use faer::Par;
use faer::dyn_stack::{MemBuffer, MemStack};
use faer::sparse::linalg::SupernodalThreshold;
use faer::sparse::linalg::cholesky::supernodal::{
    SymbolicSupernodalCholesky, factorize_supernodal_numeric_ldlt,
    factorize_supernodal_numeric_ldlt_scratch,
};
use faer::sparse::linalg::cholesky::{
    CholeskySymbolicParams, SymbolicCholesky, SymbolicCholeskyRaw, SymmetricOrdering,
    factorize_symbolic_cholesky,
};
use faer::sparse::{SparseColMatRef, SymbolicSparseColMatRef};

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
        /// The reason that the analysis reported.
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
    ///
    /// ```
    /// use coseg_geometry::linalg::ldlt::SymmetricSparse;
    ///
    /// let diagonal = SymmetricSparse {
    ///     row_starts: vec![0, 1, 2],
    ///     columns: vec![0, 1],
    ///     values: vec![5.0, 7.0],
    /// };
    /// assert_eq!(diagonal.permuted(&[1, 0]).values, [7.0, 5.0]);
    /// ```
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
    /// Orders and analyses the pattern of `matrix` `(n, n)`; its values do not matter.
    ///
    /// ```
    /// use coseg_geometry::linalg::ldlt::{Analysis, SymmetricSparse};
    ///
    /// let matrix = SymmetricSparse {
    ///     row_starts: vec![0, 2, 4],
    ///     columns: vec![0, 1, 0, 1],
    ///     values: vec![2.0, -1.0, -1.0, 2.0],
    /// };
    /// let analysis = Analysis::new(&matrix)?;
    /// let mut order = analysis.order.clone();
    /// order.sort_unstable();
    /// assert_eq!(order, [0, 1]);
    /// # Ok::<_, coseg_geometry::linalg::ldlt::LdltError>(())
    /// ```
    ///
    /// # Errors
    /// Too many rows or entries, or too little memory.
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

/// The values of L and D, in the layout of `faer`.
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

/// The pivots of a diagonal matrix, whose analysis has no supernodes.
fn diagonal_pivots(matrix: &SymmetricSparse, shift: f64) -> Result<Vec<f64>, LdltError> {
    let n = matrix.n();
    assert_eq!(
        matrix.columns.len(),
        n,
        "invariant: only a diagonal has no supernodes"
    );
    let pivots: Vec<f64> = matrix.values.iter().map(|x| x - shift).collect();
    match pivots.iter().position(|d| *d == 0.0 || !d.is_finite()) {
        Some(index) => Err(LdltError::ZeroPivot { index, n }),
        None => Ok(pivots),
    }
}
