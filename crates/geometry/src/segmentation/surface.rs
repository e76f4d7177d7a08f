//! Builds the weighted dual graph of a proxy mesh, on which faces are labelled.

use crate::mesh::{DualGraph, FaceGeometry, TriMesh, bridges};

/// Weight of a convex crease relative to a concave one of the same angle: people cut along
/// concavities (minima rule, Hoffman and Richards 1984).
const CONVEX_WEIGHT: f64 = 0.1;
/// Crease of a virtual edge between components: as good a place to cut as a sharp concave crease.
const BRIDGE_CREASE: f64 = 0.3;

/// Two faces that share an edge (or are joined by a bridge).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfaceEdge {
    /// The faces.
    pub faces: [u32; 2],
    /// Length of the shared edge; the mean edge length for a bridge.
    pub length: f64,
    /// `η min(θ/π, 1)` with θ the angle between the normals and η = 0.1 convex, 1 concave: 0 where
    /// flat, 1 where folded.
    pub crease: f64,
    /// Cost of a label boundary here, 1 on a flat edge of mean length, falling with the crease:
    /// `(length / mean) (−ln crease) / ln 1000`, crease clipped to [1e-3, 1].
    pub boundary_cost: f64,
}

/// The data of a mesh that labelling uses.
#[derive(Debug, Clone, PartialEq)]
pub struct Surface {
    /// Share of the total area of each face `(m,)`; sums to 1.
    pub area: Vec<f64>,
    /// Centroids of the faces `(m, 3)`.
    pub centroids: Vec<[f64; 3]>,
    /// The dual graph.
    pub edges: Vec<SurfaceEdge>,
}

impl Surface {
    /// The surface of a proxy mesh, whose components are joined by bridges.
    ///
    /// ```
    /// use coseg_geometry::mesh::icosphere;
    /// use coseg_geometry::segmentation::Surface;
    ///
    /// let surface = Surface::new(&icosphere(2));
    /// assert_eq!((surface.n_faces(), surface.edges.len()), (320, 480));
    /// assert!((surface.area.iter().sum::<f64>() - 1.0).abs() < 1e-9);
    /// // A sphere has no concave crease, at which a boundary would cost less.
    /// assert!(surface.edges.iter().all(|e| e.crease < 0.1));
    /// ```
    pub fn new(mesh: &TriMesh) -> Self {
        let joins = bridges(mesh);
        Self::from_dual(&FaceGeometry::new(mesh), &DualGraph::new(mesh, &joins))
    }

    /// Builds the surface from a geometry and a dual graph that the caller already has.
    ///
    /// ```
    /// use coseg_geometry::mesh::{DualGraph, FaceGeometry, icosphere};
    /// use coseg_geometry::segmentation::Surface;
    ///
    /// let sphere = icosphere(1);
    /// let (geometry, dual) = (FaceGeometry::new(&sphere), DualGraph::new(&sphere, &[]));
    /// assert_eq!(Surface::from_dual(&geometry, &dual), Surface::new(&sphere));
    /// ```
    pub fn from_dual(geometry: &FaceGeometry, dual: &DualGraph) -> Self {
        let total: f64 = geometry.areas.iter().sum();
        let real = dual.edges.iter().filter(|e| !e.bridge);
        let (sum, n) = real.fold((0.0, 0usize), |(s, n), e| (s + e.length, n + 1));
        let mean = if n > 0 { sum / n as f64 } else { 1.0 };
        let edges = dual
            .edges
            .iter()
            .map(|e| {
                let weight = if e.convex { CONVEX_WEIGHT } else { 1.0 };
                let crease = if e.bridge {
                    BRIDGE_CREASE
                } else {
                    weight * (e.angle / std::f64::consts::PI).min(1.0)
                };
                let length = if e.bridge { mean } else { e.length };
                let boundary_cost = if e.bridge {
                    0.0
                } else {
                    length / mean * -crease.clamp(1e-3, 1.0).ln() / 1000f64.ln()
                };
                SurfaceEdge {
                    faces: e.faces,
                    length,
                    crease,
                    boundary_cost,
                }
            })
            .collect();
        Self {
            area: geometry.areas.iter().map(|a| a / total).collect(),
            centroids: geometry.centroids.clone(),
            edges,
        }
    }

    /// Number of faces.
    pub fn n_faces(&self) -> usize {
        self.area.len()
    }

    /// Area-weighted mean of the rows of `values (m, dim)` over each patch; `(n_patches, dim)`. A
    /// patch without faces gets zeros.
    ///
    /// ```
    /// use coseg_geometry::mesh::icosphere;
    /// use coseg_geometry::segmentation::Surface;
    ///
    /// let surface = Surface::new(&icosphere(0));
    /// let halves: Vec<u32> = (0..20).map(|f| f / 10).collect();
    /// let values: Vec<f32> = (0..20).map(|f| f as f32).collect();
    /// let means = surface.patch_means(&halves, 2, &values, 1);
    /// assert!((means[0] - 4.5).abs() < 1e-9 && (means[1] - 14.5).abs() < 1e-9);
    /// ```
    pub fn patch_means<T: Copy + Into<f64>>(
        &self,
        patches: &[u32],
        n_patches: usize,
        values: &[T],
        dim: usize,
    ) -> Vec<f64> {
        let mut mean = vec![0.0; n_patches * dim];
        let mut area = vec![0.0; n_patches];
        for (face, &p) in patches.iter().enumerate() {
            let p = p as usize;
            area[p] += self.area[face];
            for (s, &x) in mean[p * dim..(p + 1) * dim]
                .iter_mut()
                .zip(&values[face * dim..])
            {
                *s += self.area[face] * x.into();
            }
        }
        for (row, a) in mean.chunks_exact_mut(dim).zip(&area) {
            row.iter_mut().for_each(|s| *s /= a.max(1e-300));
        }
        mean
    }
}

/// The patches of one shape and the boundaries between them.
#[derive(Debug, Clone, PartialEq)]
pub struct PatchGraph {
    /// Patch of each face `(m,)`.
    pub patch_of_face: Vec<u32>,
    /// Area share of each patch.
    pub area: Vec<f64>,
    /// Boundaries: two patches, length, length-weighted mean crease; sorted by the patches.
    pub edges: Vec<([u32; 2], f64, f64)>,
}

impl PatchGraph {
    /// The graph of `patches (m,)`, numbered from 0 without gaps.
    ///
    /// ```
    /// use coseg_geometry::mesh::{FaceGeometry, icosphere};
    /// use coseg_geometry::segmentation::{PatchGraph, Surface};
    ///
    /// let sphere = icosphere(3);
    /// let centroids = FaceGeometry::new(&sphere).centroids;
    /// let south: Vec<u32> = centroids.iter().map(|c| u32::from(c[2] < 0.0)).collect();
    /// let graph = PatchGraph::new(&Surface::new(&sphere), &south);
    /// assert_eq!((graph.len(), graph.edges.len()), (2, 1));
    /// let ([a, b], length, _) = graph.edges[0];
    /// assert_eq!([a, b], [0, 1]);
    /// assert!(length >= 6.0); // the equator, along edges
    /// ```
    pub fn new(surface: &Surface, patches: &[u32]) -> Self {
        let n = patches.iter().max().map_or(0, |p| *p as usize + 1);
        let mut area = vec![0.0; n];
        for (face, &p) in patches.iter().enumerate() {
            area[p as usize] += surface.area[face];
        }
        let mut boundaries = std::collections::BTreeMap::<[u32; 2], (f64, f64)>::new();
        for e in &surface.edges {
            let [a, b] = e.faces.map(|f| patches[f as usize]);
            if a != b {
                let sum = boundaries.entry([a.min(b), a.max(b)]).or_default();
                sum.0 += e.length;
                sum.1 += e.length * e.crease;
            }
        }
        let edges = boundaries
            .into_iter()
            .map(|(pair, (length, weighted))| (pair, length, weighted / length.max(1e-300)))
            .collect();
        Self {
            patch_of_face: patches.to_vec(),
            area,
            edges,
        }
    }

    /// Number of patches.
    pub fn len(&self) -> usize {
        self.area.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.area.is_empty()
    }
}
