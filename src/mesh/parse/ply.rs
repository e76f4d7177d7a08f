//! Polygon File Format, also called Stanford PLY (Turk 1994): text, and binary in both byte orders.
//!
//! Of the element `vertex` its `x y z`, of the element `face` its list `vertex_indices` (or
//! `vertex_index`) is read, whatever the types; other properties and elements are skipped. A text has a row
//! a line, and what a line holds beyond its properties is left out, because some writers put there what
//! their header does not declare. Counts are checked against the bytes before anything is allocated.

use super::text::{number, words};
use super::{MAX_CORNERS, ParseError, Polygons, shown};
use crate::mesh::ParsedMesh;

#[derive(Debug, Clone, Copy, PartialEq)]
enum Encoding {
    Text,
    LittleEndian,
    BigEndian,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn named(word: &[u8]) -> Option<Self> {
        Some(match word {
            b"char" | b"int8" => Self::I8,
            b"uchar" | b"uint8" => Self::U8,
            b"short" | b"int16" => Self::I16,
            b"ushort" | b"uint16" => Self::U16,
            b"int" | b"int32" => Self::I32,
            b"uint" | b"uint32" => Self::U32,
            b"float" | b"float32" => Self::F32,
            b"double" | b"float64" => Self::F64,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }
}

/// What a property is to a mesh.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Role {
    /// Coordinate 0 to 2 of a vertex.
    Coordinate(usize),
    /// Corners of a face.
    Corners,
    Other,
}

#[derive(Debug, Clone, Copy)]
struct Property {
    /// Type of a list's count; `None` for a scalar.
    list: Option<Scalar>,
    scalar: Scalar,
    role: Role,
}

#[derive(Debug)]
struct Element {
    name: String,
    count: u64,
    properties: Vec<Property>,
}

impl Element {
    /// Bytes of the shortest row.
    fn min_bytes(&self, encoding: Encoding) -> usize {
        let binary = |p: &Property| p.list.unwrap_or(p.scalar).size();
        match encoding {
            // A digit and what separates it from the next.
            Encoding::Text => 2 * self.properties.len(),
            _ => self.properties.iter().map(binary).sum(),
        }
    }

    /// What messages call its rows.
    fn rows_are(&self) -> &'static str {
        match self.name.as_str() {
            "vertex" => "vertices",
            "face" => "faces",
            _ => "rows of another element",
        }
    }

    fn has(&self, role: Role) -> bool {
        self.properties.iter().any(|p| p.role == role)
    }
}

/// The lines of the header, and where the data begins.
struct Header {
    encoding: Encoding,
    elements: Vec<Element>,
    n_bytes: usize,
    n_lines: usize,
    /// Whether lines end in CR alone.
    cr: bool,
}

/// The next line and the bytes it takes with its end: LF, CR LF, or CR alone where `cr` says so.
fn line(rest: &[u8], cr: bool) -> (&[u8], usize) {
    let end = if cr { b'\r' } else { b'\n' };
    let length = rest.iter().position(|&b| b == end);
    let text = &rest[..length.unwrap_or(rest.len())];
    (text.trim_ascii(), length.map_or(rest.len(), |l| l + 1))
}

fn bad_line(line: usize, text: &[u8]) -> ParseError {
    ParseError::BadLine {
        line,
        found: shown(text),
        what: "PLY header",
    }
}

fn header(bytes: &[u8]) -> Result<Header, ParseError> {
    if !bytes.starts_with(b"ply") {
        return Err(ParseError::BadHeader {
            found: shown(words(bytes).next().unwrap_or_default()),
            format: "a PLY",
        });
    }
    let first_end = bytes.iter().position(|&b| b == b'\n' || b == b'\r');
    let cr = first_end.is_some_and(|i| bytes[i] == b'\r' && bytes.get(i + 1) != Some(&b'\n'));
    let (mut at, mut n_lines) = (0, 0);
    let mut encoding = None;
    let mut elements: Vec<Element> = Vec::new();
    loop {
        if at >= bytes.len() {
            return Err(ParseError::Missing {
                what: "line end_header: the file is cut off within its header",
            });
        }
        let (text, taken) = line(&bytes[at..], cr);
        at += taken;
        n_lines += 1;
        let tokens: Vec<&[u8]> = words(text).take(6).collect();
        match tokens.as_slice() {
            [b"ply"] if n_lines == 1 => {}
            [] | [b"comment" | b"obj_info", ..] => {}
            [b"format", name, _version] => {
                encoding = Some(match *name {
                    b"ascii" => Encoding::Text,
                    b"binary_little_endian" => Encoding::LittleEndian,
                    b"binary_big_endian" => Encoding::BigEndian,
                    _ => return Err(bad_line(n_lines, text)),
                });
            }
            [b"element", name, count] => elements.push(Element {
                name: shown(name),
                count: number(n_lines, count)?,
                properties: Vec::new(),
            }),
            [b"property", rest @ ..] => {
                let element = elements.last_mut().ok_or_else(|| bad_line(n_lines, text))?;
                let property =
                    property(&element.name, rest).ok_or_else(|| bad_line(n_lines, text))?;
                element.properties.push(property);
            }
            [b"end_header"] => break,
            [b"ply" | b"format" | b"element" | b"end_header", ..] => {
                return Err(bad_line(n_lines, text));
            }
            // Some writers forget the word comment.
            _ => {}
        }
    }
    Ok(Header {
        encoding: encoding.ok_or(ParseError::Missing {
            what: "line format in its header",
        })?,
        elements,
        n_bytes: at,
        n_lines,
        cr,
    })
}

fn property(element: &str, words: &[&[u8]]) -> Option<Property> {
    Some(match *words {
        [b"list", count, scalar, name] => Property {
            // A count is an integer.
            list: Some(Scalar::named(count).filter(|c| !matches!(c, Scalar::F32 | Scalar::F64))?),
            scalar: Scalar::named(scalar)?,
            role: match name {
                b"vertex_indices" | b"vertex_index" if element == "face" => Role::Corners,
                _ => Role::Other,
            },
        },
        [scalar, name] => Property {
            list: None,
            scalar: Scalar::named(scalar)?,
            role: match name {
                b"x" if element == "vertex" => Role::Coordinate(0),
                b"y" if element == "vertex" => Role::Coordinate(1),
                b"z" if element == "vertex" => Role::Coordinate(2),
                _ => Role::Other,
            },
        },
        _ => return None,
    })
}

/// What follows the header.
struct Body<'a> {
    /// What of it is not read yet; of a text, after the line that is being read.
    rest: &'a [u8],
    encoding: Encoding,
    /// What is not read yet of the line that is being read, and its number.
    text: &'a [u8],
    line: usize,
    cr: bool,
}

impl<'a> Body<'a> {
    /// Goes on to the next line of a text that is not empty; false at the end of the file.
    fn begin_row(&mut self) -> bool {
        if self.encoding != Encoding::Text {
            return true;
        }
        while !self.rest.is_empty() {
            let (text, taken) = line(self.rest, self.cr);
            (self.text, self.rest) = (text, &self.rest[taken..]);
            self.line += 1;
            if !text.is_empty() {
                return true;
            }
        }
        false
    }

    /// The next value; `None` at the end of the row or the file. Integers up to 2^53 are exact.
    fn value(&mut self, scalar: Scalar) -> Result<Option<f64>, ParseError> {
        if self.encoding == Encoding::Text {
            let Some(word) = self.word() else {
                return Ok(None);
            };
            return number(self.line, word).map(Some);
        }
        let Some((bytes, rest)) = self.rest.split_at_checked(scalar.size()) else {
            return Ok(None);
        };
        self.rest = rest;
        let mut word = [0; 8];
        let bits = if self.encoding == Encoding::LittleEndian {
            word[..bytes.len()].copy_from_slice(bytes);
            u64::from_le_bytes(word)
        } else {
            word[8 - bytes.len()..].copy_from_slice(bytes);
            u64::from_be_bytes(word)
        };
        Ok(Some(match scalar {
            Scalar::I8 => f64::from(bits as i8),
            Scalar::U8 => f64::from(bits as u8),
            Scalar::I16 => f64::from(bits as i16),
            Scalar::U16 => f64::from(bits as u16),
            Scalar::I32 => f64::from(bits as i32),
            Scalar::U32 => f64::from(bits as u32),
            Scalar::F32 => f64::from(f32::from_bits(bits as u32)),
            Scalar::F64 => f64::from_bits(bits),
        }))
    }

    /// Passes over `n` values; `None` when there are fewer.
    fn skip(&mut self, scalar: Scalar, n: usize) -> Option<()> {
        if self.encoding == Encoding::Text {
            for _ in 0..n {
                self.word()?;
            }
        } else {
            self.rest = self.rest.get(n.checked_mul(scalar.size())?..)?;
        }
        Some(())
    }

    fn word(&mut self) -> Option<&'a [u8]> {
        let text = self.text.trim_ascii_start();
        let end = text.iter().position(u8::is_ascii_whitespace);
        let (word, rest) = text.split_at(end.unwrap_or(text.len()));
        self.text = rest;
        (!word.is_empty()).then_some(word)
    }
}

/// The number of rows, refused when the file is too short to hold them.
fn rows(element: &Element, encoding: Encoding, n_bytes: usize) -> Result<usize, ParseError> {
    // The last word of a text may lack what separates it.
    let limit = match element.min_bytes(encoding) {
        0 => 0,
        min => ((n_bytes + 1) / min).min(u32::MAX as usize) as u64,
    };
    if element.count > limit {
        return Err(ParseError::CountTooLarge {
            what: element.rows_are(),
            declared: element.count,
            n_bytes,
            limit,
        });
    }
    Ok(element.count as usize)
}

/// Reads one row; `corners` holds a face's, `position` a vertex's. `None` when it is not there as a whole.
fn row(
    body: &mut Body<'_>,
    element: &Element,
    index: usize,
    n_vertices: usize,
    position: &mut [f64; 3],
    corners: &mut Vec<u32>,
) -> Result<Option<()>, ParseError> {
    if !body.begin_row() {
        return Ok(None);
    }
    for property in &element.properties {
        let Some(count) = property.list else {
            if let Role::Coordinate(i) = property.role {
                let Some(value) = body.value(property.scalar)? else {
                    return Ok(None);
                };
                position[i] = value;
            } else if body.skip(property.scalar, 1).is_none() {
                return Ok(None);
            }
            continue;
        };
        let Some(found) = body.value(count)? else {
            return Ok(None);
        };
        if property.role != Role::Corners {
            // A negative count is none, one beyond all bytes is not there.
            if body.skip(property.scalar, found as usize).is_none() {
                return Ok(None);
            }
            continue;
        }
        if found <= 0.0 {
            return Err(ParseError::EmptyPolygon { face: index });
        }
        if found > MAX_CORNERS as f64 {
            return Err(ParseError::PolygonTooLarge {
                face: index,
                corners: found as u64,
            });
        }
        corners.clear();
        for _ in 0..found as usize {
            let Some(vertex) = body.value(property.scalar)? else {
                return Ok(None);
            };
            if !(0.0..n_vertices as f64).contains(&vertex) || vertex.fract() != 0.0 {
                return Err(ParseError::VertexOutOfRange {
                    face: index,
                    vertex: vertex as i64,
                    n_vertices,
                });
            }
            corners.push(vertex as u32);
        }
    }
    Ok(Some(()))
}

/// The elements that make a mesh, if they are there, once each and in the order in which they can be read.
fn check(elements: &[Element]) -> Result<(), ParseError> {
    let place = |name: &str| elements.iter().position(|e| e.name == name);
    for element in elements {
        let n = elements.iter().filter(|e| e.name == element.name).count();
        if n > 1 && ["vertex", "face"].contains(&element.name.as_str()) {
            return Err(ParseError::Unsupported {
                what: format!("a header with {n} elements named {}", element.name),
                instead: "only one of each",
            });
        }
    }
    let (Some(vertex), Some(face)) = (place("vertex"), place("face")) else {
        if place("tristrips").is_some() {
            return Err(ParseError::Unsupported {
                what: "an element tristrips".into(),
                instead: "only faces: export it without triangle strips",
            });
        }
        return Err(ParseError::NoFaces);
    };
    if face < vertex {
        return Err(ParseError::Unsupported {
            what: "a file with its faces before its vertices".into(),
            instead: "only one with its vertices first",
        });
    }
    if !(0..3).all(|i| elements[vertex].has(Role::Coordinate(i))) {
        return Err(ParseError::Missing {
            what: "properties x, y and z of its vertices",
        });
    }
    if elements[face].count > 0 && !elements[face].has(Role::Corners) {
        return Err(ParseError::Missing {
            what: "list vertex_indices (or vertex_index) of its faces",
        });
    }
    Ok(())
}

pub(super) fn parse(bytes: &[u8]) -> Result<ParsedMesh, ParseError> {
    let header = header(bytes)?;
    check(&header.elements)?;
    let mut body = Body {
        rest: &bytes[header.n_bytes..],
        encoding: header.encoding,
        text: &[],
        line: header.n_lines,
        cr: header.cr,
    };
    let mut polygons = Polygons::new(Vec::new());
    let (mut position, mut corners) = ([0.0; 3], Vec::new());
    for element in &header.elements {
        let n_rows = rows(element, header.encoding, body.rest.len())?;
        let vertices = &mut polygons.mesh.vertices;
        if element.name == "vertex" {
            vertices.reserve_exact(n_rows);
        }
        for index in 0..n_rows {
            let n_vertices = polygons.mesh.vertices.len();
            let found = row(
                &mut body,
                element,
                index,
                n_vertices,
                &mut position,
                &mut corners,
            )?;
            if found.is_none() && !body.rest.is_empty() && header.encoding == Encoding::Text {
                return Err(ParseError::ShortRow {
                    line: body.line,
                    declared: element.properties.len(),
                });
            }
            if found.is_none() {
                return Err(ParseError::Truncated {
                    what: element.rows_are(),
                    declared: element.count,
                    found: index as u64,
                });
            }
            match element.name.as_str() {
                "vertex" => polygons.mesh.vertices.push(position),
                "face" => polygons.push(&corners)?,
                _ => {}
            }
        }
    }
    let rest = body.rest.trim_ascii();
    if !rest.is_empty() {
        return Err(ParseError::TrailingBytes {
            n_bytes: rest.len(),
        });
    }
    polygons.finish()
}
