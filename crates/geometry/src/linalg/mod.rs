//! Numerical methods that do not depend on meshes.

pub mod assignment;
pub mod basis;
pub mod block_lanczos;
pub mod dense_eigen;
pub mod kmeans;
pub mod lanczos_top;
pub mod ldlt;
pub mod maxflow;
pub mod nearest;
pub mod panel;
pub mod squares;

#[cfg(test)]
mod spectral_tests;
