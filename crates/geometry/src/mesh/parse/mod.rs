//! Parses the bytes of a mesh file to triangulated polygons, in file order.
//!
//! A parser refuses contents that cannot be intended (indices out of range, coordinates that are
//! not numbers) and names the location. Defects (degenerate faces, unused vertices) are left for
//! `clean`. Geometry that is skipped is counted.

mod content;
mod encoding;
pub(super) mod gltf;
pub(super) mod obj;
mod off;
mod ply;
mod stl;
pub(super) mod text;

use super::{Format, ParsedMesh, Triangulator};
pub use encoding::as_utf8;

/// The largest number of corners of a polygon; a face with more shows that the file is damaged.
pub const MAX_CORNERS: usize = 10_000;
/// The largest number of triangles of a mesh after triangulation.
pub const MAX_TRIANGLES: usize = 50_000_000;

/// The reason why bytes are not a mesh. Faces and vertices count from 0 in file order, lines from
/// 1.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[allow(missing_docs)] // the fields are the values of the message
pub enum ParseError {
    #[error("the file is empty")]
    Empty,
    #[error("the file is {found}, not {wanted}: {instead}")]
    OtherContent {
        found: &'static str,
        wanted: &'static str,
        instead: String,
    },
    #[error("the file has no faces")]
    NoFaces,
    #[error(
        "the file has no faces, but {n_unread} statements that are not read: the first \
         is \"{found}\" in line {line}"
    )]
    OnlyUnread {
        n_unread: usize,
        line: usize,
        found: String,
    },
    #[error("line {line}: \"{token}\" is not a number")]
    NotANumber { line: usize, token: String },
    #[error("line {line}: a vertex has {found} coordinates, but {needed} are needed")]
    ShortVertex {
        line: usize,
        found: usize,
        needed: usize,
    },
    #[error("line {line}: face {face} has no corners, but at least 1 is needed")]
    EmptyFace { line: usize, face: usize },
    #[error("face {face} has no corners, but at least 1 is needed")]
    EmptyPolygon { face: usize },
    #[error("line {line}: face {face} has {found} corners, but declares {declared}")]
    ShortFace {
        line: usize,
        face: usize,
        found: usize,
        declared: u64,
    },
    #[error("face {face} has {corners} corners, but at most {MAX_CORNERS} are read")]
    PolygonTooLarge { face: usize, corners: u64 },
    #[error("face {face} names vertex {vertex}, but the mesh has {n_vertices}")]
    VertexOutOfRange {
        face: usize,
        vertex: i64,
        n_vertices: usize,
    },
    #[error(
        "face {face} has a corner at ({}, {}, {}), but coordinates must be finite",
        position[0], position[1], position[2]
    )]
    NonFinite { face: usize, position: [f64; 3] },
    #[error("the mesh has more than {MAX_TRIANGLES} triangles")]
    TooManyTriangles,
    #[error("the file begins with \"{found}\", which is not {format} header")]
    BadHeader { found: String, format: &'static str },
    #[error("line {line}: \"{found}\" is not a line of a {what}")]
    BadLine {
        line: usize,
        found: String,
        what: &'static str,
    },
    #[error("the file has no {what}")]
    Missing { what: &'static str },
    #[error("{what} is not read, {instead}")]
    Unsupported { what: String, instead: &'static str },
    #[error("the header declares {declared} {what}, but {n_bytes} bytes hold at most {limit}")]
    CountTooLarge {
        what: &'static str,
        declared: u64,
        n_bytes: usize,
        limit: u64,
    },
    #[error("the header declares {declared} {what}, but the file ends after {found}")]
    Truncated {
        what: &'static str,
        declared: u64,
        found: u64,
    },
    #[error("line {line} follows the {declared} faces that the header declares")]
    Trailing { line: usize, declared: u64 },
    #[error("line {line} ends before all {declared} properties of its row are given")]
    ShortRow { line: usize, declared: usize },
    #[error("the file has {n_bytes} bytes beyond the data that its header declares")]
    TrailingBytes { n_bytes: usize },
    #[error(
        "the header declares {declared} triangles, which take {expected} bytes, but the file has \
         {n_bytes}"
    )]
    StlLength {
        declared: usize,
        expected: u64,
        n_bytes: usize,
    },
    #[error("the JSON is not that of a glTF file: {reason}")]
    Json { reason: String },
    #[error("{location} {why}")]
    Gltf { location: String, why: String },
    #[error("the file cannot be read: {reason}")]
    Reader { reason: String },
}

/// Reads the polygons of a mesh file and triangulates them; vertices and polygons keep their order.
///
/// Coordinates are those of the file, in its units. Degenerate faces and unused vertices are kept
/// for [`clean`](super::clean). Statements that are skipped, or that programs interpret
/// differently, are counted in [`ParsedMesh::findings`]. The cost is linear in the size of the
/// file.
///
/// ```
/// use coseg_geometry::mesh::{Format, ParseError, parse};
///
/// let square = parse(b"OFF\n4 1 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n", Format::Off)?;
/// assert_eq!((square.vertices.len(), square.n_polygons), (4, 1));
/// assert_eq!(square.triangles, [[0, 1, 2], [0, 2, 3]]);
/// assert_eq!(square.polygon_of_triangle, [0, 0]);
///
/// assert_eq!(parse(b"", Format::Off), Err(ParseError::Empty));
/// # Ok::<_, ParseError>(())
/// ```
///
/// # Errors
/// If the bytes are not a mesh with at least one face, indices in range and finite corners.
pub fn parse(bytes: &[u8], format: Format) -> Result<ParsedMesh, ParseError> {
    let parsed = match format {
        Format::Obj => obj::parse(&as_utf8(bytes)),
        Format::Off => off::parse(&as_utf8(bytes)),
        Format::Ply => ply::parse(&as_utf8(bytes)),
        Format::Stl => stl::parse(bytes),
        Format::Gltf => gltf::parse(&as_utf8(bytes)),
    };
    // The contents are examined only if the file cannot be read, so that no guess refuses a valid
    // file.
    parsed.map_err(|error| match content::of(bytes, format) {
        None if bytes.is_empty() => ParseError::Empty,
        None => error,
        Some(other) => other,
    })
}

/// Collects polygons, and checks and triangulates them.
struct Polygons {
    mesh: ParsedMesh,
    triangulator: Triangulator,
}

impl Polygons {
    fn new(vertices: Vec<[f64; 3]>) -> Self {
        Self {
            mesh: ParsedMesh {
                vertices,
                ..ParsedMesh::default()
            },
            triangulator: Triangulator::default(),
        }
    }

    /// Adds the next polygon of the file; it must have at least one corner, and its corners must be
    /// in range.
    fn push(&mut self, corners: &[u32]) -> Result<(), ParseError> {
        let face = self.mesh.n_polygons;
        if let Some(position) = corners
            .iter()
            .map(|&v| self.mesh.vertices[v as usize])
            .find(|p| p.iter().any(|x| !x.is_finite()))
        {
            return Err(ParseError::NonFinite { face, position });
        }
        let n_triangles = corners.len().saturating_sub(2).max(1);
        let ParsedMesh {
            vertices,
            triangles,
            polygon_of_triangle,
            not_fans,
            findings,
            ..
        } = &mut self.mesh;
        if triangles.len() + n_triangles > MAX_TRIANGLES {
            return Err(ParseError::TooManyTriangles);
        }
        let kind = self
            .triangulator
            .triangulate(vertices, corners, |triangle| {
                triangles.push(triangle);
                polygon_of_triangle.push(face as u32);
            });
        findings.n_nonplanar_polygons += usize::from(!kind.planar);
        findings.n_nonsimple_polygons += usize::from(!kind.simple);
        if !kind.fan {
            not_fans.push((face as u32, corners.to_vec()));
        }
        self.mesh.n_polygons += 1;
        Ok(())
    }

    fn finish(self) -> Result<ParsedMesh, ParseError> {
        if self.mesh.n_polygons == 0 {
            Err(ParseError::NoFaces)
        } else {
            Ok(self.mesh)
        }
    }
}

/// A token in the form in which messages show it: printable and short.
fn shown(token: &[u8]) -> String {
    String::from_utf8_lossy(&token[..token.len().min(40)])
        .chars()
        .map(|c| if c.is_control() { '\u{fffd}' } else { c })
        .collect()
}

#[cfg(test)]
mod gltf_tests;
#[cfg(test)]
mod hostile_tests;
#[cfg(test)]
mod ply_stl_tests;
#[cfg(test)]
mod tests;
