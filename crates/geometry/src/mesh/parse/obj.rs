//! Reads Wavefront OBJ: its `v` and `f` (formerly `fo`) statements, by `tobj`.
//!
//! Only these two statements reach `tobj`, one clean line each, because given a whole file it
//! - counts polylines (`l a b c`) as polygons and splits the polygons over groups and materials,
//! - numbers vertices by first use and forgets the others,
//! - knows neither continued lines nor comments behind a statement.
//!
//! Other geometry (lines, points, curves, surfaces, other files) and unknown statements are
//! counted. A comment ends with its line, even if it ends in a backslash: a path in a comment must
//! not swallow a face. Some programs differ, so these comments are counted, too.
//!
//! A first polygon that names all vertices makes `tobj` keep the numbers of the file. Groups,
//! objects and materials do not reorder faces. A vertex's weight or colour and a corner's texture
//! and normal indices are not geometry and are ignored. A face may name vertices that come after
//! it, as many writers do; a negative index counts back from the last vertex before the face.

use super::text::{Lines, before_comment, n_mixed_ends, number, words};
use super::{MAX_CORNERS, ParseError, Polygons, shown};
use crate::mesh::ParsedMesh;
use std::io::Read as _;

const OPTIONS: tobj::LoadOptions = tobj::LoadOptions {
    triangulate: false,
    single_index: false,
    ignore_points: false,
    ignore_lines: false,
};

/// Statements without a surface of their own: attributes of vertices, groups, states, and parts of
/// a curve or surface that is counted itself.
const WITHOUT_SURFACE: [&[u8]; 37] = [
    b"vt",
    b"vn",
    b"vp",
    b"g",
    b"s",
    b"o",
    b"mg",
    b"usemtl",
    b"mtllib",
    b"usemap",
    b"maplib",
    b"bevel",
    b"c_interp",
    b"d_interp",
    b"lod",
    b"shadow_obj",
    b"trace_obj",
    b"ctech",
    b"stech",
    b"deg",
    b"bmat",
    b"step",
    b"cstype",
    b"parm",
    b"trim",
    b"hole",
    b"scrv",
    b"sp",
    b"end",
    b"con",
    b"res",
    b"vc",
    b"vw",
    b"cstyle",
    b"texture",
    b"xf",
    b"matlib",
];

/// Gives `each` the statements of a file: without comments, as they are, and the number of their
/// first lines. Statements that go on in the next line are joined. Returns the number of comments
/// that end in a backslash.
pub(in crate::mesh) fn statements(
    bytes: &[u8],
    mut each: impl FnMut(&[u8], &[u8], usize) -> Result<(), ParseError>,
) -> Result<usize, ParseError> {
    let mut n_tolerated = 0;
    let mut joined: Vec<u8> = Vec::new();
    let mut first_line = 1;
    for (number, whole) in Lines::new(bytes) {
        let statement = before_comment(whole);
        let line = whole.trim_ascii_end();
        if joined.is_empty() {
            first_line = number;
        }
        let continued = line.strip_suffix(b"\\");
        let in_comment = statement.len() < line.len();
        n_tolerated += usize::from(in_comment && continued.is_some());
        let line = if in_comment { statement } else { line };
        if let Some(head) = continued.filter(|_| !in_comment) {
            joined.extend_from_slice(head);
            joined.push(b' ');
        } else if joined.is_empty() {
            each(line, whole, number)?;
        } else {
            joined.extend_from_slice(line);
            each(&joined, &joined, first_line)?;
            joined.clear();
        }
    }
    each(&joined, &joined, first_line)?;
    Ok(n_tolerated)
}

/// The geometry of a file, as lines for `tobj`.
#[derive(Default)]
struct Geometry {
    text: Vec<u8>,
    /// Line of the file of each statement.
    lines: Vec<usize>,
    n_vertices: usize,
    n_faces: usize,
    n_tolerated: usize,
    n_unread: usize,
    first_unread: Option<(usize, String)>,
}

impl Geometry {
    fn of(bytes: &[u8]) -> Result<Self, ParseError> {
        let mut geometry = Self::default();
        let tolerated = statements(bytes, |statement, _, line| geometry.push(statement, line))?;
        geometry.n_tolerated += tolerated;
        Ok(geometry)
    }

    fn push(&mut self, statement: &[u8], line: usize) -> Result<(), ParseError> {
        let mut words = words(statement);
        match words.next() {
            Some(b"v") => {
                self.text.push(b'v');
                let mut found = 0;
                for word in words.take(3) {
                    self.word(word, line)?;
                    found += 1;
                }
                if found < 3 {
                    return Err(ParseError::ShortVertex {
                        line,
                        found,
                        needed: 3,
                    });
                }
                self.n_vertices += 1;
            }
            Some(keyword @ (b"f" | b"fo")) => {
                let face = self.n_faces;
                self.n_tolerated += usize::from(keyword == b"fo");
                self.text.push(b'f');
                let mut corners = 0;
                for word in words {
                    let vertex = word.split(|&b| b == b'/').next().unwrap_or_default();
                    self.word(vertex, line)?;
                    corners += 1;
                }
                if corners == 0 {
                    return Err(ParseError::EmptyFace { line, face });
                }
                if corners > MAX_CORNERS {
                    let corners = corners as u64;
                    return Err(ParseError::PolygonTooLarge { face, corners });
                }
                self.n_faces += 1;
            }
            None => return Ok(()),
            Some(keyword) => {
                if !WITHOUT_SURFACE.contains(&keyword) {
                    self.n_unread += 1;
                    let first = || (line, shown(statement.trim_ascii()));
                    self.first_unread.get_or_insert_with(first);
                }
                return Ok(());
            }
        }
        self.text.push(b'\n');
        self.lines.push(line);
        Ok(())
    }

    /// Bytes other than ASCII would make `tobj` refuse the text without naming the line.
    fn word(&mut self, word: &[u8], line: usize) -> Result<(), ParseError> {
        if word.is_empty() || !word.is_ascii() {
            let token = shown(word);
            return Err(ParseError::NotANumber { line, token });
        }
        self.text.push(b' ');
        self.text.extend_from_slice(word);
        Ok(())
    }

    /// The location and the reason of an error of `tobj`, which names neither line nor face.
    fn fault(&self, error: &tobj::LoadError) -> ParseError {
        let n_vertices = self.n_vertices;
        let (mut n_seen, mut face) = (0_i64, 0);
        for (statement, &line) in self.text.split(|&b| b == b'\n').zip(&self.lines) {
            let mut words = words(statement);
            let result = if words.next() == Some(b"v") {
                n_seen += 1;
                words.try_for_each(|word| number::<f64>(line, word).map(drop))
            } else {
                face += 1;
                words.try_for_each(|word| {
                    let vertex: i64 = number(line, word)?;
                    let index = if vertex < 0 {
                        n_seen + vertex
                    } else {
                        vertex - 1
                    };
                    if (0..n_vertices as i64).contains(&index) {
                        return Ok(());
                    }
                    Err(ParseError::VertexOutOfRange {
                        face: face - 1,
                        vertex,
                        n_vertices,
                    })
                })
            };
            if let Err(error) = result {
                return error;
            }
        }
        ParseError::Reader {
            reason: error.to_string(),
        }
    }
}

pub(super) fn parse(bytes: &[u8]) -> Result<ParsedMesh, ParseError> {
    let geometry = Geometry::of(bytes)?;
    if geometry.n_faces == 0 {
        return Err(match geometry.first_unread {
            None => ParseError::NoFaces,
            Some((line, found)) => ParseError::OnlyUnread {
                n_unread: geometry.n_unread,
                line,
                found,
            },
        });
    }
    let mut all_vertices = String::from("f");
    for vertex in 1..=geometry.n_vertices {
        all_vertices.push(' ');
        all_vertices.push_str(&vertex.to_string());
    }
    all_vertices.push('\n');
    let mut text = all_vertices.as_bytes().chain(geometry.text.as_slice());
    let no_materials = |_: &std::path::Path| Err(tobj::LoadError::OpenFileFailed);
    let (models, _) = tobj::load_obj_buf(&mut text, &OPTIONS, no_materials)
        .map_err(|error| geometry.fault(&error))?;
    let [model] = models.as_slice() else {
        return Err(ParseError::Reader {
            reason: format!("{} models, not 1", models.len()),
        });
    };
    let mesh = &model.mesh;
    let (positions, _) = mesh.positions.as_chunks::<3>();
    let mut polygons = Polygons::new(positions.to_vec());
    polygons.mesh.findings.n_tolerated_statements = geometry.n_tolerated + n_mixed_ends(bytes);
    polygons.mesh.findings.n_unread_statements = geometry.n_unread;
    // Without arities all polygons are triangles.
    let arities = mesh.face_arities.iter().map(|&n| n as usize);
    let triangles = std::iter::repeat_n(3, mesh.indices.len() / 3);
    let arities: Vec<usize> = match mesh.face_arities.is_empty() {
        true => triangles.collect(),
        false => arities.collect(),
    };
    let mut corners = mesh.indices.as_slice();
    for (i, arity) in arities.into_iter().enumerate() {
        let (polygon, rest) = corners.split_at(arity);
        corners = rest;
        if i > 0 {
            polygons.push(polygon)?;
        }
    }
    polygons.finish()
}
