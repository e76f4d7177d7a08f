//! The errors of a spectrum.

use crate::linalg::block_lanczos::Exhausted;
use crate::linalg::dense_eigen::DenseEigenError;
use crate::linalg::ldlt::LdltError;

/// The reason why a spectrum cannot be computed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SpectrumError {
    /// W is not square.
    #[error("stiffness has {rows} rows but {columns} columns")]
    NotSquare {
        /// Rows of W.
        rows: usize,
        /// Columns of W.
        columns: usize,
    },
    /// The mass has another length than W.
    #[error("mass has {n_mass} entries, but the stiffness has {n} rows")]
    MassLength {
        /// Entries of the mass.
        n_mass: usize,
        /// Rows of W.
        n: usize,
    },
    /// A mass is not a positive finite number.
    #[error(
        "the mass of vertex {vertex} is {value}, but must be positive, finite and not denormal"
    )]
    Mass {
        /// Index of the vertex.
        vertex: usize,
        /// Its mass.
        value: f64,
    },
    /// An entry of W is not finite.
    #[error("stiffness ({row}, {column}) is {value}, but must be finite")]
    Stiffness {
        /// Row.
        row: usize,
        /// Column.
        column: usize,
        /// The entry.
        value: f64,
    },
    /// W is not symmetric.
    #[error("stiffness ({row}, {column}) is {value}, but ({column}, {row}) is {mirror}")]
    NotSymmetric {
        /// Row.
        row: usize,
        /// Column.
        column: usize,
        /// The entry.
        value: f64,
        /// Its mirror image.
        mirror: f64,
    },
    /// W has negative eigenvalues.
    #[error("{count} eigenvalues lie below {below}, but the stiffness must be semidefinite")]
    NotSemidefinite {
        /// Number of these eigenvalues.
        count: usize,
        /// A negative number.
        below: f64,
    },
    /// The number of eigenpairs to compute is 0, or exceeds the dimension.
    #[error("{k} eigenpairs were requested, but the limits are 1 and {n}")]
    Count {
        /// Number of eigenpairs to compute.
        k: usize,
        /// Rows of W.
        n: usize,
    },
    /// The tolerance is not usable.
    #[error("the tolerance is {tolerance}, but the limits are 1e-13 and 1e-2")]
    Tolerance {
        /// The given tolerance.
        tolerance: f64,
    },
    /// The count of eigenvalues disagrees with the pairs found.
    #[error("{expected} eigenvalues lie below {tau}, but {found} were found")]
    Incomplete {
        /// The limit of the count.
        tau: f64,
        /// The count by inertia.
        expected: usize,
        /// Pairs found.
        found: usize,
    },
    /// The Krylov space grew to its limit.
    #[error("{k} pairs have not converged in a Krylov space of {n_krylov} vectors, the limit")]
    NotConverged {
        /// Number of pairs to compute.
        k: usize,
        /// Dimension of the Krylov space.
        n_krylov: usize,
    },
    /// Everything above the k-th eigenvalue is one cluster, as far as it was computed.
    #[error("no gap was found above eigenvalue {k} among {n_krylov} approximations")]
    NoGap {
        /// Number of pairs to compute.
        k: usize,
        /// Dimension of the Krylov space.
        n_krylov: usize,
    },
    /// A residual stayed above the tolerance.
    #[error("eigenvalue {index} ({eigenvalue}) has residual {residual}, but the limit is {limit}")]
    Residual {
        /// Index of the pair, from 0.
        index: usize,
        /// Its value.
        eigenvalue: f64,
        /// Its residual.
        residual: f64,
        /// The largest allowed residual.
        limit: f64,
    },
    /// Approximate eigenvectors became linearly dependent.
    #[error("{k} approximate eigenvectors are linearly dependent")]
    Dependent {
        /// Number of vectors.
        k: usize,
    },
    /// The progress hook cancelled the solve.
    #[error("cancelled in stage {stage}")]
    Cancelled {
        /// The stage that was cancelled.
        stage: &'static str,
    },
    /// A factorisation failed.
    #[error(transparent)]
    Factor(#[from] LdltError),
    /// The dense solver failed.
    #[error(transparent)]
    Dense(#[from] DenseEigenError),
    /// A Krylov space could not be extended.
    #[error(transparent)]
    Exhausted(#[from] Exhausted),
}
