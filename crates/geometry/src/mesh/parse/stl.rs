//! STL, text and binary: triangles (in text, any polygons) that share no vertices.
//!
//! A file is binary if its length is the one that its count of triangles gives, or if it does not begin
//! with `solid`: some binary files do begin so. Corners at equal positions become one vertex when the
//! mesh is cleaned.

use super::text::{Lines, position, words};
use super::{MAX_CORNERS, ParseError, Polygons, shown};
use crate::mesh::ParsedMesh;

/// Bytes before the triangles of a binary file, of which the last four are their number.
const HEADER: usize = 84;
/// Bytes of a binary triangle: normal, three corners, and two that each program uses as it likes.
const TRIANGLE: usize = 50;

pub(super) fn parse(bytes: &[u8]) -> Result<ParsedMesh, ParseError> {
    let declared = bytes
        .first_chunk::<HEADER>()
        .and_then(|header| header.last_chunk::<4>())
        .map(|count| u32::from_le_bytes(*count) as usize);
    let is_text = words(bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes))
        .next()
        .is_some_and(|word| word.eq_ignore_ascii_case(b"solid"));
    match declared {
        Some(n) if n.checked_mul(TRIANGLE) == Some(bytes.len() - HEADER) => binary(bytes),
        _ if is_text => text(bytes),
        Some(n) => Err(ParseError::StlLength {
            declared: n,
            expected: n as u64 * TRIANGLE as u64 + HEADER as u64,
            n_bytes: bytes.len(),
        }),
        None => Err(ParseError::BadHeader {
            found: shown(words(bytes).next().unwrap_or_default()),
            format: "an STL",
        }),
    }
}

/// Triangles of a file whose length is right.
fn binary(bytes: &[u8]) -> Result<ParsedMesh, ParseError> {
    let (triangles, _) = bytes[HEADER..].as_chunks::<TRIANGLE>();
    let mut vertices = Vec::with_capacity(3 * triangles.len());
    for triangle in triangles {
        let (numbers, _) = triangle[12..48].as_chunks::<4>();
        let corner =
            |c: usize| std::array::from_fn(|i| f64::from(f32::from_le_bytes(numbers[3 * c + i])));
        vertices.extend((0..3).map(corner));
    }
    let mut polygons = Polygons::new(vertices);
    for t in 0..triangles.len() as u32 {
        polygons.push(&[3 * t, 3 * t + 1, 3 * t + 2])?;
    }
    polygons.finish()
}

fn text(bytes: &[u8]) -> Result<ParsedMesh, ParseError> {
    let mut polygons = Polygons::new(Vec::new());
    // First vertex of the loop that is open.
    let mut open = None;
    let mut solid = false;
    for (line, text) in Lines::new(bytes) {
        let mut words = words(text);
        let Some(keyword) = words.next() else {
            continue;
        };
        let bad = || ParseError::BadLine {
            line,
            found: shown(text.trim_ascii()),
            what: "text STL",
        };
        let n_vertices = polygons.mesh.vertices.len();
        let face = polygons.mesh.n_polygons;
        match (keyword.to_ascii_lowercase().as_slice(), open) {
            (b"vertex", Some(_)) => {
                let position = position(line, &mut words)?;
                polygons.mesh.vertices.push(position);
            }
            (b"outer", None) => open = Some(n_vertices),
            (b"endloop", Some(first)) => {
                let corners: Vec<u32> = (first as u32..n_vertices as u32).collect();
                if corners.is_empty() {
                    return Err(ParseError::EmptyFace { line, face });
                }
                if corners.len() > MAX_CORNERS {
                    return Err(ParseError::PolygonTooLarge {
                        face,
                        corners: corners.len() as u64,
                    });
                }
                polygons.push(&corners)?;
                open = None;
            }
            (b"solid", None) => solid = true,
            (b"endsolid", None) => solid = false,
            (b"facet" | b"endfacet", None) => {}
            _ => return Err(bad()),
        }
    }
    if solid || open.is_some() {
        return Err(ParseError::Missing {
            what: "line endsolid: it is cut off",
        });
    }
    polygons.finish()
}
