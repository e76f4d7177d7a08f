//! Object File Format: `OFF` and its variants with colours, normals and texture coordinates.
//!
//! One vertex and one face a line, as every writer has it: only so can the optional values behind a
//! vertex or a face be told from what follows. Counts are checked against the bytes before anything is
//! allocated.

use super::text::{Lines, before_comment, number, position, words};
use super::{MAX_CORNERS, ParseError, Polygons, shown};
use crate::mesh::ParsedMesh;

/// Shortest line of a vertex, `0 0 0`, and of a face, `1 0`, with their line end.
const MIN_VERTEX_BYTES: usize = 6;
const MIN_FACE_BYTES: usize = 4;
const TEXT: &str = "only text in three dimensions";

/// Lines with their numbers, without comments and empty ones.
fn lines(bytes: &[u8]) -> impl Iterator<Item = (usize, &[u8])> {
    Lines::new(bytes)
        .map(|(number, line)| (number, before_comment(line)))
        .filter(|(_, line)| words(line).next().is_some())
}

/// What follows the keyword on its line: counts, or nothing. `None` when the line is no header, as in
/// files that begin with their counts.
fn after_keyword<'a>(words: &[&'a [u8]]) -> Result<Option<Vec<&'a [u8]>>, ParseError> {
    let first = words[0];
    let Some(at) = first.windows(3).position(|w| w == b"OFF") else {
        return if first[0].is_ascii_digit() {
            Ok(None)
        } else {
            Err(bad_header(first))
        };
    };
    let prefix = &first[..at];
    if prefix.iter().any(|b| matches!(b, b'4' | b'n')) {
        return Err(ParseError::Unsupported {
            what: format!("{} with other dimensions", shown(first)),
            instead: TEXT,
        });
    }
    let rest = prefix.strip_prefix(b"ST").unwrap_or(prefix);
    let rest = rest.strip_prefix(b"C").unwrap_or(rest);
    let rest = rest.strip_prefix(b"N").unwrap_or(rest);
    if !rest.is_empty() {
        return Err(bad_header(first));
    }
    // Some writers leave out the line end: `OFF490 518 0`.
    let glued = &first[at + 3..];
    let mut counts = Vec::new();
    if !glued.is_empty() {
        counts.push(glued);
    }
    counts.extend_from_slice(&words[1..]);
    if counts
        .first()
        .is_some_and(|w| w.eq_ignore_ascii_case(b"BINARY"))
    {
        return Err(ParseError::Unsupported {
            what: "binary OFF".into(),
            instead: TEXT,
        });
    }
    Ok(Some(counts))
}

/// The count a header declares, refused when the file is too short to hold it.
fn count(
    what: &'static str,
    (line, token): (usize, &[u8]),
    n_bytes: usize,
    min_bytes: usize,
) -> Result<usize, ParseError> {
    let declared: u64 = number(line, token)?;
    // The last line may lack its end.
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
    let Some((mut line, first)) = lines.next() else {
        return Err(bad_header(b""));
    };
    let first: Vec<&[u8]> = words(first).collect();
    let mut counts = match after_keyword(&first)? {
        None => first,
        Some(counts) => counts,
    };
    if counts.is_empty() {
        let next = lines.next().ok_or(ParseError::NoFaces)?;
        (line, counts) = (next.0, words(next.1).collect());
    }
    let Some(&[vertices, faces]) = counts.first_chunk::<2>() else {
        return Err(bad_header(counts[0]));
    };
    let n_vertices = count("vertices", (line, vertices), bytes.len(), MIN_VERTEX_BYTES)?;
    let n_faces = count("faces", (line, faces), bytes.len(), MIN_FACE_BYTES)?;

    let mut positions = Vec::with_capacity(n_vertices);
    while positions.len() < n_vertices {
        let (line, text) = lines.next().ok_or(ParseError::Truncated {
            what: "vertices",
            declared: n_vertices as u64,
            found: positions.len() as u64,
        })?;
        positions.push(position(line, &mut words(text))?);
    }

    let mut polygons = Polygons::new(positions);
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
