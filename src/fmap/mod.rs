//! Functional maps between shapes.

/// How good a map is.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Quality {
    /// Mean squared descriptor difference between matched vertices.
    pub descriptor_residual: f64,
    /// `‖CᵀC − I‖_F / √k`; 0 for an isometry.
    pub orthogonality: f64,
    /// Share of the source's area that is hit.
    pub coverage: f64,
    /// Share of entries of C with magnitude below 0.1 (the source paper reports at least 0.9).
    pub near_zero: f64,
}
