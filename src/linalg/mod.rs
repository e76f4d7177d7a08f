//! Dense and sparse linear algebra that knows nothing of meshes.

pub mod block_lanczos;
pub mod dense_eigen;
pub mod ldlt;
pub mod panel;

#[cfg(test)]
mod spectral_tests;
