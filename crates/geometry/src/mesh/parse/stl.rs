//! Reads STL, text and binary: triangles (in text, any polygons) that share no vertices.
//!
//! Text is read word by word, since some writers put a facet or a whole file on one line. Words
//! that follow a statement on its line and are not keywords, such as a colour, are counted as
//! unread.
//!
//! A file is binary if its length matches its count of triangles, or if it does not begin with
//! `solid`: some binary files do begin so. Corners at equal positions become one vertex when the
//! mesh is cleaned.

use super::text::{Lines, n_mixed_ends, number, position, words};
use super::{MAX_CORNERS, ParseError, Polygons, as_utf8, shown};
use crate::mesh::ParsedMesh;

/// Bytes before the triangles of a binary file, of which the last four are their number.
const HEADER: usize = 84;
/// Bytes of a binary triangle: normal, three corners, and two bytes that programs use in different
/// ways.
const TRIANGLE: usize = 50;

pub(super) fn parse(bytes: &[u8]) -> Result<ParsedMesh, ParseError> {
    let declared = bytes
        .first_chunk::<HEADER>()
        .and_then(|header| header.last_chunk::<4>())
        .map(|count| u32::from_le_bytes(*count) as usize);
    let as_text = as_utf8(bytes);
    let is_text = words(&as_text)
        .next()
        .is_some_and(|word| word.eq_ignore_ascii_case(b"solid"));
    match declared {
        Some(n) if n.checked_mul(TRIANGLE) == Some(bytes.len() - HEADER) => binary(bytes),
        _ if is_text => text(&as_text),
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

/// The triangles of a file whose length matches its count.
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

/// The first words of the statements of a text.
const KEYWORDS: [&str; 7] = [
    "solid", "facet", "outer", "vertex", "endloop", "endfacet", "endsolid",
];

fn is(word: &[u8], keyword: &str) -> bool {
    word.eq_ignore_ascii_case(keyword.as_bytes())
}

fn is_keyword(word: &[u8]) -> bool {
    KEYWORDS.iter().any(|keyword| is(word, keyword))
}

/// The state of reading a text.
struct Text {
    polygons: Polygons,
    /// First vertex of the open loop.
    open: Option<usize>,
    solid: bool,
}

fn text(bytes: &[u8]) -> Result<ParsedMesh, ParseError> {
    let mut reader = Text {
        polygons: Polygons::new(Vec::new()),
        open: None,
        solid: false,
    };
    reader.polygons.mesh.findings.n_tolerated_statements = n_mixed_ends(bytes);
    let mut statements = Vec::new();
    for (line, text) in Lines::new(bytes) {
        statements.clear();
        statements.extend(words(text));
        reader.line(line, &statements)?;
    }
    if reader.solid || reader.open.is_some() {
        return Err(ParseError::Missing {
            what: "line endsolid: it is cut off",
        });
    }
    reader.polygons.finish()
}

impl Text {
    fn line(&mut self, line: usize, words: &[&[u8]]) -> Result<(), ParseError> {
        let mut at = 0;
        let mut unread = false;
        while at < words.len() {
            let findings = &mut self.polygons.mesh.findings;
            if at > 0 && !is_keyword(words[at]) {
                unread = true;
                at += 1;
                continue;
            }
            findings.n_tolerated_statements += usize::from(at > 0);
            at += self.statement(line, words, at)?;
        }
        self.polygons.mesh.findings.n_unread_statements += usize::from(unread);
        Ok(())
    }

    /// Reads the statement that begins at a word, and returns its number of words.
    fn statement(&mut self, line: usize, words: &[&[u8]], at: usize) -> Result<usize, ParseError> {
        let polygons = &mut self.polygons;
        let n_vertices = polygons.mesh.vertices.len();
        let face = polygons.mesh.n_polygons;
        let keyword = words[at].to_ascii_lowercase();
        let rest = &words[at + 1..];
        Ok(match (keyword.as_slice(), self.open) {
            (b"vertex", Some(_)) => {
                let position = position(line, &mut rest.iter().copied())?;
                polygons.mesh.vertices.push(position);
                4
            }
            (b"outer", None) => {
                self.open = Some(n_vertices);
                1 + usize::from(rest.first().is_some_and(|word| is(word, "loop")))
            }
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
                self.open = None;
                1
            }
            // The words of the normal that follows are ignored.
            (b"facet", None) => {
                let normal = rest.iter().position(|word| is_keyword(word));
                1 + normal.unwrap_or(rest.len())
            }
            (b"endfacet", None) => 1,
            (b"solid" | b"endsolid", None) => {
                self.solid = keyword == b"solid";
                1 + name(line, rest)
            }
            _ => {
                return Err(ParseError::BadLine {
                    line,
                    found: shown(&words.join(&b' ')),
                    what: "text STL",
                });
            }
        })
    }
}

/// Number of words of the name after `solid` or `endsolid`. It may have any words and ends with its
/// line, or where a facet begins with its normal.
fn name(line: usize, rest: &[&[u8]]) -> usize {
    let facet = |words: &[&[u8]]| {
        is(words[0], "facet") && is(words[1], "normal") && number::<f64>(line, words[2]).is_ok()
    };
    rest.windows(3).position(facet).unwrap_or(rest.len())
}
