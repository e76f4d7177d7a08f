//! Discrete Laplacians: `W φ = λ A φ` with stiffness W positive semidefinite and lumped mass A.

/// Which discrete Laplacian.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Operator {
    /// Intrinsic Delaunay on the tufted cover with mollification (Sharp and Crane 2020).
    #[default]
    Tufted,
    /// Plain cotangent stiffness with barycentric (1/3 area) lumped mass.
    Cotan,
    /// Mesh Laplacian of Belkin, Sun and Wang 2008, the source paper's eq. (6).
    MeshLaplace,
}
