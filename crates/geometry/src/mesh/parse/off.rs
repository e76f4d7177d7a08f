//! Reads the Object File Format: `OFF` and its variants with colours, normals, texture coordinates
//! and other dimensions.
//!
//! Each vertex and each face has a line of its own, as every writer does: otherwise the optional
//! values after a vertex or a face could not be distinguished from the next one. Counts are checked
//! against the number of bytes before memory is allocated.

use super::text::{Lines, before_comment, n_mixed_ends, number, position, words};
use super::{MAX_CORNERS, ParseError, Polygons, shown};
use crate::mesh::ParsedMesh;

/// Shortest line of a vertex, `0 0 0`, and of a face, `1 0`, with their line end.
const MIN_VERTEX_BYTES: usize = 6;
const MIN_FACE_BYTES: usize = 4;
/// Prefixes of the keyword, each at most once: texture coordinates, colours, normals, a fourth
/// coordinate, and a number of dimensions. Geomview wants them in this order, MeshLab writes them
/// in another one.
const PREFIXES: [&[u8]; 5] = [b"ST", b"C", b"N", b"4", b"n"];

/// Lines with their numbers, except comments and empty lines.
fn lines(bytes: &[u8]) -> impl Iterator<Item = (usize, &[u8])> {
    Lines::new(bytes)
        .map(|(number, line)| (number, before_comment(line)))
        .filter(|(_, line)| words(line).next().is_some())
}

/// The format of the vertices according to the keyword.
#[derive(Default)]
struct Keyword {
    /// Whether a fourth, homogeneous coordinate follows the others.
    homogeneous: bool,
    /// Whether the header gives the number of dimensions before the counts.
    dimensions: bool,
}

/// The keyword of the first line, and the words after it on that line: counts, or nothing. Files
/// may begin with their counts.
fn keyword<'a>(words: &[&'a [u8]]) -> Result<(Keyword, Vec<&'a [u8]>), ParseError> {
    let first = words[0];
    let Some(at) = first.windows(3).position(|w| w == b"OFF") else {
        return if first[0].is_ascii_digit() {
            Ok((Keyword::default(), words.to_vec()))
        } else {
            Err(bad_header(first))
        };
    };
    let mut left = PREFIXES.to_vec();
    let mut prefix = &first[..at];
    while !prefix.is_empty() {
        let known = left.iter().position(|known| prefix.starts_with(known));
        let known = left.swap_remove(known.ok_or_else(|| bad_header(first))?);
        prefix = &prefix[known.len()..];
    }
    let keyword = Keyword {
        homogeneous: !left.contains(&&b"4"[..]),
        dimensions: !left.contains(&&b"n"[..]),
    };
    // Some writers omit the line end: `OFF490 518 0`.
    let glued = Some(&first[at + 3..]).filter(|glued| !glued.is_empty());
    let rest: Vec<&[u8]> = glued
        .into_iter()
        .chain(words[1..].iter().copied())
        .collect();
    if rest
        .first()
        .is_some_and(|w| w.eq_ignore_ascii_case(b"BINARY"))
    {
        return Err(ParseError::Unsupported {
            what: "binary OFF".into(),
            instead: "save it as text",
        });
    }
    Ok((keyword, rest))
}

impl Keyword {
    /// Whether a vertex has a homogeneous coordinate in addition to the dimensions in the header,
    /// which must be 3.
    fn is_homogeneous(&self, (line, dimensions): (usize, &[u8])) -> Result<bool, ParseError> {
        match number::<u64>(line, dimensions)? {
            3 => Ok(self.homogeneous),
            n => Err(ParseError::Unsupported {
                what: format!("OFF with {n} dimensions"),
                instead: "save it with 3",
            }),
        }
    }
}

/// The count that a header declares; an error if the file is too short for it.
fn count(
    what: &'static str,
    (line, token): (usize, &[u8]),
    n_bytes: usize,
    min_bytes: usize,
) -> Result<usize, ParseError> {
    let declared: u64 = number(line, token)?;
    // The last line may lack its line end.
    let limit = ((n_bytes + 1) / min_bytes).min(u32::MAX as usize) as u64;
    if declared > limit {
        return Err(ParseError::CountTooLarge {
            what,
            declared,
            n_bytes,
            limit,
        });
    }
    Ok(declared as usize)
}

fn bad_header(found: &[u8]) -> ParseError {
    ParseError::BadHeader {
        found: shown(found),
        format: "an OFF",
    }
}

pub(super) fn parse(bytes: &[u8]) -> Result<ParsedMesh, ParseError> {
    let mut lines = lines(bytes);
    let Some((line, first)) = lines.next() else {
        return Err(bad_header(b""));
    };
    let first: Vec<&[u8]> = words(first).collect();
    let (keyword, rest) = keyword(&first)?;
    let mut header: Vec<(usize, &[u8])> = rest.into_iter().map(|word| (line, word)).collect();
    // The number of edges, which is not used, may be missing at the end of a line, but no count
    // before it.
    let needed = 2 + usize::from(keyword.dimensions);
    while header.len() < needed {
        let (line, text) = lines.next().ok_or(ParseError::NoFaces)?;
        header.extend(words(text).map(|word| (line, word)));
    }
    let homogeneous = match keyword.dimensions {
        true => keyword.is_homogeneous(header.remove(0))?,
        false => keyword.homogeneous,
    };
    let (vertices, faces) = (header[0], header[1]);
    let n_vertices = count("vertices", vertices, bytes.len(), MIN_VERTEX_BYTES)?;
    let n_faces = count("faces", faces, bytes.len(), MIN_FACE_BYTES)?;

    let mut positions = Vec::with_capacity(n_vertices);
    while positions.len() < n_vertices {
        let (line, text) = lines.next().ok_or(ParseError::Truncated {
            what: "vertices",
            declared: n_vertices as u64,
            found: positions.len() as u64,
        })?;
        let mut words = words(text);
        let mut position = position(line, &mut words)?;
        if homogeneous {
            let word = words.next();
            let word = word.ok_or(ParseError::ShortVertex {
                line,
                found: 3,
                needed: 4,
            })?;
            let w: f64 = number(line, word)?;
            position = position.map(|x| x / w);
        }
        positions.push(position);
    }

    let mut polygons = Polygons::new(positions);
    polygons.mesh.findings.n_tolerated_statements = n_mixed_ends(bytes);
    let mut corners = Vec::new();
    for face in 0..n_faces {
        let (line, text) = lines.next().ok_or(ParseError::Truncated {
            what: "faces",
            declared: n_faces as u64,
            found: face as u64,
        })?;
        let mut words = words(text);
        let declared: u64 = number(line, words.next().unwrap_or_default())?;
        if declared == 0 {
            return Err(ParseError::EmptyFace { line, face });
        }
        if declared > MAX_CORNERS as u64 {
            return Err(ParseError::PolygonTooLarge {
                face,
                corners: declared,
            });
        }
        corners.clear();
        for token in words.take(declared as usize) {
            let vertex: i64 = number(line, token)?;
            if vertex < 0 || vertex >= n_vertices as i64 {
                return Err(ParseError::VertexOutOfRange {
                    face,
                    vertex,
                    n_vertices,
                });
            }
            corners.push(vertex as u32);
        }
        if (corners.len() as u64) < declared {
            return Err(ParseError::ShortFace {
                line,
                face,
                found: corners.len(),
                declared,
            });
        }
        polygons.push(&corners)?;
    }
    if let Some((line, _)) = lines.next() {
        return Err(ParseError::Trailing {
            line,
            declared: n_faces as u64,
        });
    }
    polygons.finish()
}
