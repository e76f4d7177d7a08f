//! The [`Description`] of a shape: all results that are computed from one shape alone.

use crate::mesh::{CleanReport, TriMesh};
use crate::operators::Operator;

/// The parameters of `describe`.
#[derive(Debug, Clone, PartialEq)]
pub struct Params {
    /// The discrete Laplacian.
    pub operator: Operator,
    /// Faces of the working-resolution proxy.
    pub working_faces: u32,
    /// Number of eigenpairs to compute.
    pub n_eigenpairs: u32,
    /// Whether a mesh may have fewer eigenpairs: at most a quarter of its vertices. Eigenvalues
    /// beyond that describe the triangles rather than the surface.
    pub only_meaningful: bool,
    /// Threads for the spectrum; the result does not depend on it.
    pub threads: u32,
}

impl Default for Params {
    fn default() -> Self {
        Self {
            operator: Operator::default(),
            working_faces: 2_500,
            n_eigenpairs: 300,
            only_meaningful: true,
            threads: 1,
        }
    }
}

/// The description of one shape. All arrays are row-major and equal the stored arrays bit by bit,
/// whether the description comes from `describe` or from its file.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Description {
    /// Surface area in squared input units. All other lengths below are scaled to area 1.
    pub area: f64,
    /// The defects that cleaning found and repaired.
    pub report: CleanReport,
    /// Proxy vertices `(n, 3)`, centred, total area 1, in the input's orientation.
    pub vertices: Vec<[f32; 3]>,
    /// Proxy faces `(m, 3)`.
    pub faces: Vec<[u32; 3]>,
    /// Lumped mass of each proxy vertex `(n,)`; sums to 1.
    pub mass: Vec<f32>,
    /// Eigenvalues `(k,)`, ascending.
    pub eigenvalues: Vec<f64>,
    /// Mass-orthonormal eigenvectors `(n, n_eigenvectors)`.
    pub eigenvectors: Vec<f32>,
    /// Columns of `eigenvectors` (at most 100).
    pub n_eigenvectors: usize,
    /// Heat kernel signature `(n, 100)`.
    pub hks: Vec<f32>,
    /// Face descriptors `(m, n_descriptors)`, smoothed, not standardised.
    pub face_descriptors: Vec<f32>,
    /// Columns of `face_descriptors`.
    pub n_descriptors: usize,
    /// Over-segmentation: patch of each proxy face `(m,)`, patches numbered from 0.
    pub patches: Vec<u32>,
    /// For each polygon of the input its proxy face `(n_polygons,)`.
    pub face_map: Vec<u32>,
    /// For each polygon of the input its share of the total area `(n_polygons,)`.
    pub polygon_area: Vec<f32>,
    /// Global descriptor `(g,)`, by which neighbours are ranked.
    pub signature: Vec<f32>,
}

/// Borrowed arrays of a [`Description`], in memory or mapped from the store.
#[derive(Debug, Clone, Copy)]
#[allow(missing_docs)] // as in `Description`
pub struct DescriptionView<'a> {
    pub vertices: &'a [[f32; 3]],
    pub faces: &'a [[u32; 3]],
    pub mass: &'a [f32],
    pub eigenvalues: &'a [f64],
    pub eigenvectors: &'a [f32],
    pub n_eigenvectors: usize,
    pub hks: &'a [f32],
    pub face_descriptors: &'a [f32],
    pub n_descriptors: usize,
    pub patches: &'a [u32],
    pub face_map: &'a [u32],
    pub polygon_area: &'a [f32],
    pub signature: &'a [f32],
}

impl Description {
    /// The arrays, borrowed.
    pub fn view(&self) -> DescriptionView<'_> {
        DescriptionView {
            vertices: &self.vertices,
            faces: &self.faces,
            mass: &self.mass,
            eigenvalues: &self.eigenvalues,
            eigenvectors: &self.eigenvectors,
            n_eigenvectors: self.n_eigenvectors,
            hks: &self.hks,
            face_descriptors: &self.face_descriptors,
            n_descriptors: self.n_descriptors,
            patches: &self.patches,
            face_map: &self.face_map,
            polygon_area: &self.polygon_area,
            signature: &self.signature,
        }
    }
}

impl DescriptionView<'_> {
    /// The proxy as a mesh, in double precision.
    ///
    /// ```
    /// use coseg_geometry::description::Description;
    ///
    /// let triangle = Description {
    ///     vertices: vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
    ///     faces: vec![[0, 1, 2]],
    ///     ..Description::default()
    /// };
    /// assert_eq!(triangle.view().mesh().corners(0)[1], [1.0, 0.0, 0.0]);
    /// ```
    pub fn mesh(&self) -> TriMesh {
        TriMesh {
            vertices: self.vertices.iter().map(|v| v.map(f64::from)).collect(),
            faces: self.faces.to_vec(),
        }
    }
}
