//! Turns the bytes of a mesh file into a clean, normalised triangle mesh at working resolution.
//!
//! [`parse`] reads the file, [`clean`] makes it a mesh that can be measured and reports the
//! defects, [`proxy`] brings it to working resolution with a map back, [`bridges`] joins its
//! components, and [`adjacency`] and [`geodesic`] hold the graphs that later stages use.

pub mod adjacency;
mod bridges;
mod bvh;
mod clean;
pub mod geodesic;
mod icosphere;
mod instances;
mod orient;
mod parse;
mod polygon;
mod proxy;
mod refine;
mod report;
mod shells;
mod vector;
#[cfg(test)]
pub(crate) mod zoo;

pub use adjacency::{DualEdge, DualGraph, FaceGeometry};
pub use bridges::bridges;
pub use bvh::{Bvh, Search};
pub use clean::{CleanError, Cleaned, clean};
pub use geodesic::EdgeGraph;
pub use icosphere::icosphere;
pub use instances::{Instances, instances};
pub use parse::{MAX_CORNERS, MAX_TRIANGLES, ParseError, as_utf8, parse};
pub use polygon::{PolygonKind, Triangulator};
pub use proxy::{Proxy, proxy};
#[cfg(test)]
pub(crate) use refine::refine;
pub use shells::outer_shells;
pub(crate) use vector::{add, cross, distance, dot, norm, scale, sub, unit};

pub mod write;

/// A triangle mesh: `vertices (n, 3)`, `faces (m, 3)`.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TriMesh {
    /// Coordinates.
    pub vertices: Vec<[f64; 3]>,
    /// Vertex indices of each triangle, counter-clockwise seen from outside.
    pub faces: Vec<[u32; 3]>,
}

impl TriMesh {
    /// Coordinates of the three corners of a face, in the order of the face.
    ///
    /// ```
    /// let sphere = coseg_geometry::mesh::icosphere(0);
    /// let [a, _, _] = sphere.corners(7);
    /// assert_eq!(a, sphere.vertices[sphere.faces[7][0] as usize]);
    /// ```
    ///
    /// # Panics
    /// If the face or one of its vertices does not exist.
    #[inline]
    pub fn corners(&self, face: usize) -> [[f64; 3]; 3] {
        self.faces[face].map(|v| self.vertices[v as usize])
    }
}

/// Mesh file formats that can be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Format {
    /// Wavefront OBJ.
    Obj,
    /// Object File Format.
    Off,
    /// Polygon File Format, text or binary.
    Ply,
    /// STL, text or binary.
    Stl,
    /// glTF 2.0, JSON or binary (GLB).
    Gltf,
}

impl Format {
    /// All supported formats.
    pub const ALL: [Self; 5] = [Self::Obj, Self::Off, Self::Ply, Self::Stl, Self::Gltf];

    /// Extensions of file names, as messages list them.
    pub const EXTENSIONS: &str = ".obj, .off, .ply, .stl, .glb, .gltf";

    /// The format of an extension of a file name, in upper or lower case; `None` for any other
    /// extension. Text and binary forms share a format: [`parse`] distinguishes them.
    ///
    /// ```
    /// use coseg_geometry::mesh::Format;
    ///
    /// assert_eq!(Format::from_name("shapes/Chair.GLB"), Some(Format::Gltf));
    /// assert_eq!(Format::from_name("chair.step"), None);
    /// ```
    pub fn from_name(file_name: &str) -> Option<Self> {
        let (stem, extension) = file_name.rsplit_once('.')?;
        if stem.is_empty() {
            return None;
        }
        match extension.to_ascii_lowercase().as_str() {
            "obj" => Some(Self::Obj),
            "off" => Some(Self::Off),
            "ply" => Some(Self::Ply),
            "stl" => Some(Self::Stl),
            "glb" | "gltf" => Some(Self::Gltf),
            _ => None,
        }
    }

    /// The name of the format in lower case.
    pub fn name(self) -> &'static str {
        match self {
            Self::Obj => "obj",
            Self::Off => "off",
            Self::Ply => "ply",
            Self::Stl => "stl",
            Self::Gltf => "gltf",
        }
    }
}

/// The contents of a file: its polygons as triangles, in file order.
///
/// Every polygon has at least one triangle: a face with one or two corners becomes a degenerate
/// one, so that polygons keep their numbers.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ParsedMesh {
    /// Coordinates as in the file, in file order.
    pub vertices: Vec<[f64; 3]>,
    /// Triangles, as vertex indices that are all in range.
    pub triangles: Vec<[u32; 3]>,
    /// For each triangle its polygon in the file (0-based, file order).
    pub polygon_of_triangle: Vec<u32>,
    /// Number of polygons (faces) in the file.
    pub n_polygons: usize,
    /// Polygons, ascending, whose triangles are not their fan from the first corner, with their
    /// corners.
    pub not_fans: Vec<(u32, Vec<u32>)>,
    /// The findings of reading.
    pub findings: Findings,
}

impl ParsedMesh {
    /// The corners of each polygon, in file order.
    ///
    /// ```
    /// use coseg_geometry::mesh::{Format, parse};
    ///
    /// let square = parse(b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n", Format::Obj)?;
    /// assert_eq!(square.polygons(), [[0, 1, 2, 3]]);
    /// # Ok::<_, coseg_geometry::mesh::ParseError>(())
    /// ```
    pub fn polygons(&self) -> Vec<Vec<u32>> {
        let mut polygons: Vec<Vec<u32>> = vec![Vec::new(); self.n_polygons];
        for (triangle, &polygon) in self.triangles.iter().zip(&self.polygon_of_triangle) {
            let corners = &mut polygons[polygon as usize];
            if corners.is_empty() {
                corners.extend(triangle);
            } else {
                corners.push(triangle[2]);
            }
        }
        for (polygon, corners) in &self.not_fans {
            polygons[*polygon as usize].clone_from(corners);
        }
        polygons
    }
}

/// The findings of reading a file; all are 0 for most files.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Findings {
    /// Polygons whose corners do not lie in a plane.
    pub n_nonplanar_polygons: usize,
    /// Polygons that cross themselves or have no area.
    pub n_nonsimple_polygons: usize,
    /// Statements that were read although programs interpret them differently.
    pub n_tolerated_statements: usize,
    /// Statements that were skipped: they hold geometry other than polygons, or are unknown.
    pub n_unread_statements: usize,
}

/// A short virtual edge that joins two components, so that the analysis has one connected domain.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bridge {
    /// Vertices on either side; the same vertex twice where two components touch in a point.
    pub vertices: [u32; 2],
    /// Faces on either side, incident to those vertices.
    pub faces: [u32; 2],
    /// Euclidean distance between the two vertices (0 for coincident ones).
    pub length: f64,
}

/// The findings and actions of cleaning; counts are of the triangulated input.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CleanReport {
    /// Polygons of the input.
    pub n_polygons: usize,
    /// Triangles of the triangulated polygons.
    pub n_triangles: usize,
    /// Vertices in the file.
    pub n_vertices: usize,
    /// Vertices at exactly equal positions that were welded into others.
    pub n_welded_vertices: usize,
    /// Vertices without a face.
    pub n_isolated_vertices: usize,
    /// Triangles dropped because two corners coincide or the area is zero.
    pub n_degenerate_triangles: usize,
    /// Triangles dropped because another one has the same three corners.
    pub n_duplicate_triangles: usize,
    /// Triangles that were flipped, so that neighbours agree on which side is outside.
    pub n_flipped_triangles: usize,
    /// Edges with more than two faces.
    pub n_nonmanifold_edges: usize,
    /// Edges with one face.
    pub n_boundary_edges: usize,
    /// Connected components of the cleaned mesh (connected through shared edges).
    pub n_components: usize,
    /// Faces of the proxy.
    pub n_proxy_faces: usize,
    /// Vertices of the proxy.
    pub n_proxy_vertices: usize,
    /// Bridges between components of the analysed mesh.
    pub n_bridges: usize,
    /// Polygons whose triangles are not their fan from the first corner: concave ones, and those
    /// with holes.
    pub n_concave_polygons: usize,
    /// Polygons whose corners do not lie in a plane.
    pub n_nonplanar_polygons: usize,
    /// Polygons that cross themselves or have no area; their triangles are their fan.
    pub n_nonsimple_polygons: usize,
    /// Statements that were read although programs interpret them differently.
    pub n_tolerated_statements: usize,
    /// Statements that were skipped: they hold geometry other than polygons, or are unknown.
    pub n_unread_statements: usize,
    /// Components that are excluded from the analysis: another one at a small distance represents
    /// each.
    pub n_inner_walls: usize,
    /// Triangles of these components.
    pub n_inner_triangles: usize,
}
