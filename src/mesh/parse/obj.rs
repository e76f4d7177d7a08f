//! Wavefront OBJ: its `v` and `f` statements, read by `tobj`.
//!
//! Only these two statements reach `tobj`, one clean line each, because given a whole file it
//! - counts polylines (`l a b c`) as polygons and splits the polygons over groups and materials,
//! - numbers vertices by first use and forgets the others,
//! - knows neither continued lines nor comments behind a statement.
//!
//! A first polygon that names all vertices makes it keep the numbers of the file. A vertex's weight or
//! colour and a corner's texture and normal indices are not geometry and are left out.

use super::{MAX_CORNERS, ParseError, Polygons, shown};
use crate::mesh::ParsedMesh;

const OPTIONS: tobj::LoadOptions = tobj::LoadOptions {
    triangulate: false,
    single_index: false,
    ignore_points: false,
    ignore_lines: false,
};

/// The geometry of an OBJ file, as lines for `tobj`.
#[derive(Default)]
struct Geometry {
    text: Vec<u8>,
    /// Line of the file of each statement.
    lines: Vec<usize>,
    n_vertices: usize,
    n_faces: usize,
}

impl Geometry {
    fn push(&mut self, statement: &[u8], line: usize) -> Result<(), ParseError> {
        let mut tokens = statement
            .split(|&b| b == b'#')
            .next()
            .unwrap_or_default()
            .split(u8::is_ascii_whitespace)
            .filter(|t| !t.is_empty());
        match tokens.next() {
            Some(b"v") => {
                self.text.push(b'v');
                let mut found = 0;
                for token in tokens.take(3) {
                    self.word(token, line)?;
                    found += 1;
                }
                if found < 3 {
                    return Err(ParseError::ShortVertex { line, found });
                }
                self.n_vertices += 1;
            }
            Some(b"f") => {
                let face = self.n_faces;
                self.text.push(b'f');
                let mut corners = 0;
                for token in tokens {
                    let vertex = token.split(|&b| b == b'/').next().unwrap_or_default();
                    self.word(vertex, line)?;
                    corners += 1;
                }
                if corners == 0 {
                    return Err(ParseError::EmptyFace { line, face });
                }
                if corners > MAX_CORNERS {
                    return Err(ParseError::PolygonTooLarge {
                        face,
                        corners: corners as u64,
                    });
                }
                self.n_faces += 1;
            }
            _ => return Ok(()),
        }
        self.text.push(b'\n');
        self.lines.push(line);
        Ok(())
    }

    /// Numbers are ASCII; anything else would make `tobj` refuse the line without saying which.
    fn word(&mut self, token: &[u8], line: usize) -> Result<(), ParseError> {
        if token.is_empty() || !token.is_ascii() {
            return Err(ParseError::NotANumber {
                line,
                token: shown(token),
            });
        }
        self.text.push(b' ');
        self.text.extend_from_slice(token);
        Ok(())
    }

    /// Where and why `tobj` refused the text; it says neither line nor face.
    fn fault(&self, error: tobj::LoadError) -> ParseError {
        let text = std::str::from_utf8(&self.text).unwrap_or_default();
        let (mut n_seen, mut face) = (0_i64, 0);
        let n_vertices = self.n_vertices;
        for (statement, &line) in text.lines().zip(&self.lines) {
            let mut words = statement.split_ascii_whitespace();
            if words.next() == Some("v") {
                n_seen += 1;
                if let Some(token) = words.find(|t| t.parse::<f64>().is_err()) {
                    return ParseError::NotANumber {
                        line,
                        token: shown(token.as_bytes()),
                    };
                }
                continue;
            }
            for token in words {
                let Ok(index) = token.parse::<i64>() else {
                    return ParseError::NotANumber {
                        line,
                        token: shown(token.as_bytes()),
                    };
                };
                let absolute = if index < 0 { n_seen + index } else { index - 1 };
                if absolute < 0 || absolute >= n_vertices as i64 {
                    return ParseError::VertexOutOfRange {
                        face,
                        vertex: index,
                        n_vertices,
                    };
                }
            }
            face += 1;
        }
        ParseError::Reader {
            reason: error.to_string(),
        }
    }
}

pub(super) fn parse(bytes: &[u8]) -> Result<ParsedMesh, ParseError> {
    let mut geometry = Geometry::default();
    let mut joined: Vec<u8> = Vec::new();
    let mut first_line = 1;
    for (number, line) in bytes.split(|&b| b == b'\n').enumerate() {
        let line = line.trim_ascii_end();
        if joined.is_empty() {
            first_line = number + 1;
        }
        if let Some(head) = line.strip_suffix(b"\\") {
            joined.extend_from_slice(head);
            joined.push(b' ');
        } else if joined.is_empty() {
            geometry.push(line, first_line)?;
        } else {
            joined.extend_from_slice(line);
            geometry.push(&joined, first_line)?;
            joined.clear();
        }
    }
    geometry.push(&joined, first_line)?;
    if geometry.n_faces == 0 {
        return Err(ParseError::NoFaces);
    }

    let mut anchor = Vec::with_capacity(8 * geometry.n_vertices + 8);
    anchor.push(b'f');
    for vertex in 1..=geometry.n_vertices {
        anchor.extend_from_slice(format!(" {vertex}").as_bytes());
    }
    anchor.push(b'\n');
    let mut reader = std::io::Read::chain(anchor.as_slice(), geometry.text.as_slice());
    let no_materials = |_: &_| Err(tobj::LoadError::OpenFileFailed);
    let (models, _) = tobj::load_obj_buf(&mut reader, &OPTIONS, no_materials)
        .map_err(|error| geometry.fault(error))?;
    let [model] = models.as_slice() else {
        return Err(ParseError::Reader {
            reason: format!("{} models, not 1", models.len()),
        });
    };
    let mesh = &model.mesh;
    let (positions, _) = mesh.positions.as_chunks::<3>();
    let mut polygons = Polygons::new(positions.to_vec());
    // No arities means triangles only; then the anchor is one too.
    let all_triangles = vec![3; mesh.indices.len() / 3];
    let arities = if mesh.face_arities.is_empty() {
        &all_triangles
    } else {
        &mesh.face_arities
    };
    let mut at = 0;
    for (i, &arity) in arities.iter().enumerate() {
        let corners = &mesh.indices[at..at + arity as usize];
        at += arity as usize;
        if i > 0 {
            polygons.push(corners)?;
        }
    }
    polygons.finish()
}
