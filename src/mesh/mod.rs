//! Bytes of a mesh file become a clean, normalised triangle mesh at working resolution.

pub mod write;

/// A triangle mesh: `vertices (n, 3)`, `faces (m, 3)`.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TriMesh {
    /// Coordinates.
    pub vertices: Vec<[f64; 3]>,
    /// Vertex indices of each triangle, counter-clockwise seen from outside.
    pub faces: Vec<[u32; 3]>,
}

/// Mesh file formats that can be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Format {
    /// Wavefront OBJ.
    Obj,
    /// Object File Format.
    Off,
}

/// What a file holds: `polygons` triangulated as fans, in file order.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ParsedMesh {
    /// Coordinates as in the file.
    pub vertices: Vec<[f64; 3]>,
    /// Triangles, as vertex indices that are all in range.
    pub triangles: Vec<[u32; 3]>,
    /// For each triangle the polygon of the file (0-based, file order) it came from.
    pub polygon_of_triangle: Vec<u32>,
    /// Number of polygons (faces) in the file.
    pub n_polygons: usize,
}

/// A short virtual edge that joins two components, so that the analysis has one connected domain.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bridge {
    /// Vertices on either side.
    pub vertices: [u32; 2],
    /// Faces on either side, incident to those vertices.
    pub faces: [u32; 2],
    /// Euclidean distance between the two vertices (0 for coincident ones).
    pub length: f64,
}

/// What cleaning found and did; counts are of the triangulated input.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CleanReport {
    /// Polygons, triangles and vertices of the input.
    pub n_polygons: usize,
    /// Triangles after fan triangulation.
    pub n_triangles: usize,
    /// Vertices in the file.
    pub n_vertices: usize,
    /// Vertices at exactly equal positions that were welded into others.
    pub n_welded_vertices: usize,
    /// Vertices no face uses.
    pub n_isolated_vertices: usize,
    /// Triangles dropped because two corners coincide or the area is zero.
    pub n_degenerate_triangles: usize,
    /// Triangles dropped because another one has the same three corners.
    pub n_duplicate_triangles: usize,
    /// Edges with more than two faces.
    pub n_nonmanifold_edges: usize,
    /// Edges with one face.
    pub n_boundary_edges: usize,
    /// Connected components of the cleaned mesh.
    pub n_components: usize,
    /// Faces of the proxy.
    pub n_proxy_faces: usize,
    /// Vertices of the proxy.
    pub n_proxy_vertices: usize,
    /// Bridges put between components of the proxy.
    pub n_bridges: usize,
}
