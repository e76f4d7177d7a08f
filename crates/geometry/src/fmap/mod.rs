//! Functional maps transfer functions on one shape to another in their spectral bases.
//!
//! Ovsjanikov et al. 2012, *Functional Maps: A Flexible Representation of Maps Between Shapes*.
//! `c_12 (k2, k1)` transfers coefficients on shape 1 to coefficients on shape 2. `p2p_21 (n2,)`
//! gives for each vertex of 2 a vertex of 1, so that a function f on 1 is transferred as
//! `f[p2p_21]`.

pub mod basis;
pub mod bijective;
pub mod confidence;
pub mod consistency;
pub mod convert;
pub mod estimate;
pub mod icp;
pub mod landmarks;
pub mod latent;
pub mod operators;
pub mod orientation;
pub mod parts;
pub mod points;
pub mod precise;
pub mod probes;
mod quality;
pub mod samples;
pub mod solve;
#[cfg(test)]
mod test_shapes;
pub mod transfer;
mod zoomout;

pub use basis::Basis;
pub use confidence::Confidence;
pub use estimate::{EstimateOptions, Side};
pub use parts::{
    MapOptions, MapShape, descriptor_zoomout, descriptor_zoomout_from, nearest_descriptors,
};
pub use points::{
    PointMap, PointMapBack, PointShape, point_map_back, point_maps, point_maps_by_probes,
};
pub use quality::{Assessment, Quality};
pub use zoomout::{zoomout, zoomout_sampled};

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
    /// Its confidence at each vertex of shape 2; it also marks vertices without counterpart.
    pub confidence: Confidence,
    /// Figures of its quality.
    pub quality: Quality,
}
