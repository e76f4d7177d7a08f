//! Numerical tools that know nothing of meshes.

pub mod assignment;
pub mod kmeans;
pub mod lanczos_top;
pub mod maxflow;
pub mod nearest;
