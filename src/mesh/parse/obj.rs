//! Wavefront OBJ: its `v` and `f` statements.
//!
//! Groups, objects and materials do not reorder anything; polylines and points are no faces. A vertex's
//! weight or colour and a corner's texture and normal indices are not geometry and are left out. A face
//! may name vertices that come after it, as many writers have it; a negative index counts back from the
//! last vertex before the face.

use super::text::{Lines, before_comment, number, position, words};
use super::{MAX_CORNERS, ParseError, Polygons};
use crate::mesh::ParsedMesh;

/// What the statements so far say.
#[derive(Default)]
struct Geometry {
    vertices: Vec<[f64; 3]>,
    /// Corners of all faces, from 0; checked against the number of vertices at the end.
    corners: Vec<u32>,
    /// Where each face's corners end.
    ends: Vec<usize>,
}

impl Geometry {
    fn push(&mut self, statement: &[u8], line: usize) -> Result<(), ParseError> {
        let mut words = words(before_comment(statement));
        match words.next() {
            Some(b"v") => self.vertices.push(position(line, &mut words)?),
            Some(b"f") => {
                let face = self.ends.len();
                let start = self.corners.len();
                for word in words {
                    let vertex = word.split(|&b| b == b'/').next().unwrap_or_default();
                    let corner = self.corner(number(line, vertex)?, face)?;
                    self.corners.push(corner);
                }
                let found = self.corners.len() - start;
                if found == 0 {
                    return Err(ParseError::EmptyFace { line, face });
                }
                if found > MAX_CORNERS {
                    return Err(ParseError::PolygonTooLarge {
                        face,
                        corners: found as u64,
                    });
                }
                self.ends.push(self.corners.len());
            }
            _ => {}
        }
        Ok(())
    }

    /// The vertex a corner names, from 0.
    fn corner(&self, vertex: i64, face: usize) -> Result<u32, ParseError> {
        let n_vertices = self.vertices.len();
        let index = match vertex {
            0 => None,
            1.. => u32::try_from(vertex - 1).ok(),
            _ => u32::try_from(n_vertices as i64 + vertex).ok(),
        };
        index.ok_or(ParseError::VertexOutOfRange {
            face,
            vertex,
            n_vertices,
        })
    }
}

pub(super) fn parse(bytes: &[u8]) -> Result<ParsedMesh, ParseError> {
    let mut geometry = Geometry::default();
    let mut joined: Vec<u8> = Vec::new();
    let mut first_line = 1;
    for (number, line) in Lines::new(bytes) {
        let line = line.trim_ascii_end();
        if joined.is_empty() {
            first_line = number;
        }
        if let Some(head) = line.strip_suffix(b"\\") {
            joined.extend_from_slice(head);
            joined.push(b' ');
        } else if joined.is_empty() {
            geometry.push(line, number)?;
        } else {
            joined.extend_from_slice(line);
            geometry.push(&joined, first_line)?;
            joined.clear();
        }
    }
    geometry.push(&joined, first_line)?;

    let n_vertices = geometry.vertices.len();
    let mut polygons = Polygons::new(geometry.vertices);
    let mut start = 0;
    for (face, &end) in geometry.ends.iter().enumerate() {
        let corners = &geometry.corners[start..end];
        if let Some(&beyond) = corners.iter().find(|&&v| v as usize >= n_vertices) {
            return Err(ParseError::VertexOutOfRange {
                face,
                vertex: i64::from(beyond) + 1,
                n_vertices,
            });
        }
        polygons.push(corners)?;
        start = end;
    }
    polygons.finish()
}
