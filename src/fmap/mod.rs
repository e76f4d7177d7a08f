//! Functional maps: functions on one shape are carried to another in their spectral bases.
//!
//! Ovsjanikov et al. 2012, *Functional Maps: A Flexible Representation of Maps Between Shapes*. `c_12 (k2, k1)`
//! carries coefficients on shape 1 to coefficients on shape 2; `p2p_21 (n2,)` gives for each vertex of 2 a
//! vertex of 1, so that a function f on 1 is carried as `f[p2p_21]`.

mod zoomout;

pub use zoomout::{MapOptions, MapShape, descriptor_zoomout};

/// A functional map with its pointwise map and its quality.
#[derive(Debug, Clone, PartialEq)]
pub struct FunctionalMap {
    /// `(k2, k1)`, row-major.
    pub c_12: Vec<f32>,
    /// Columns.
    pub k1: usize,
    /// Rows.
    pub k2: usize,
    /// For each vertex of shape 2 a vertex of shape 1.
    pub p2p_21: Vec<u32>,
    /// How good it is.
    pub quality: Quality,
}

/// How good a map is.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Quality {
    /// Mass-weighted mean squared descriptor difference between matched vertices; 0 is perfect.
    pub descriptor_residual: f64,
    /// `‖CᵀC − I‖_F / √k`; 0 for an isometry.
    pub orthogonality: f64,
    /// Share of the mass of shape 1 that is hit, 0 to 1.
    pub coverage: f64,
    /// Share of entries of C with magnitude below 0.1 (Yang and Tian report at least 0.9).
    pub near_zero: f64,
}
