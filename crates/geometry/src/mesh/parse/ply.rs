//! Reads the Polygon File Format, also called Stanford PLY (Turk 1994): text, and binary in both
//! byte orders.
//!
//! `ply-rs-bw` reads the header and binary rows. Rows of text are read here, because its grammar
//! has no `1.`, `.5` or `nan`, and it does not report the location of a row. It reads `x y z` of
//! the element `vertex` and the list `vertex_indices` (or `vertex_index`) of the element `face`, of
//! any types; other properties and elements are skipped. A text has one row on each line; words
//! beyond the declared properties are ignored, because some writers put values there that their
//! header does not declare. Rows of triangle strips and of edges are counted as unread beside
//! faces. Counts are checked against the number of bytes before memory is allocated.

use super::text::{first_line, number, words};
use super::{MAX_CORNERS, ParseError, Polygons, shown};
use crate::mesh::ParsedMesh;
use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{
    ElementDef, Encoding, Header, Property, PropertyAccess, PropertyAccessResult, PropertyType,
    ScalarType,
};
use std::io::ErrorKind;

/// The contents of one row of any element, as far as a mesh needs them.
#[derive(Default)]
struct Row {
    position: [f64; 3],
    corners: Vec<i64>,
}

/// Index of the coordinate that a property holds.
fn coordinate(name: &str) -> Option<usize> {
    ["x", "y", "z"].iter().position(|axis| *axis == name)
}

fn is_corners(name: &str) -> bool {
    ["vertex_indices", "vertex_index"].contains(&name)
}

impl PropertyAccess for Row {
    fn new() -> Self {
        Self::default()
    }

    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        fn integers<T: Into<i64>>(list: Vec<T>) -> Vec<i64> {
            list.into_iter().map(Into::into).collect()
        }
        let value = match property {
            Property::Char(v) => v.into(),
            Property::UChar(v) => v.into(),
            Property::Short(v) => v.into(),
            Property::UShort(v) => v.into(),
            Property::Int(v) => v.into(),
            Property::UInt(v) => v.into(),
            Property::Float(v) => v.into(),
            Property::Double(v) => v,
            list if is_corners(name) => {
                self.corners = match list {
                    Property::ListChar(v) => integers(v),
                    Property::ListUChar(v) => integers(v),
                    Property::ListShort(v) => integers(v),
                    Property::ListUShort(v) => integers(v),
                    Property::ListInt(v) => integers(v),
                    Property::ListUInt(v) => integers(v),
                    _ => return PropertyAccessResult::UnsupportedType,
                };
                return PropertyAccessResult::Set;
            }
            _ => return PropertyAccessResult::Ignored,
        };
        match coordinate(name) {
            Some(axis) => self.position[axis] = value,
            None => return PropertyAccessResult::Ignored,
        }
        PropertyAccessResult::Set
    }
}

/// The next line of a header and its length including its end: LF, CR LF, or CR alone if `cr` is
/// set. A binary body may begin with the same byte as LF.
fn header_line(rest: &[u8], cr: bool) -> (&[u8], usize) {
    let end = if cr { b'\r' } else { b'\n' };
    let length = rest.iter().position(|&b| b == end);
    let text = &rest[..length.unwrap_or(rest.len())];
    (text.trim_ascii(), length.map_or(rest.len(), |l| l + 1))
}

/// The data after the header.
struct Body<'a> {
    rest: &'a [u8],
    encoding: Encoding,
    /// Number of the last line read.
    line: usize,
}

/// The header, and the data after it.
fn header(bytes: &[u8]) -> Result<(Header, Body<'_>), ParseError> {
    if !bytes.starts_with(b"ply") {
        return Err(ParseError::BadHeader {
            found: shown(words(bytes).next().unwrap_or_default()),
            format: "a PLY",
        });
    }
    let first_end = bytes.iter().position(|&b| b == b'\n' || b == b'\r');
    let cr = first_end.is_some_and(|i| bytes[i] == b'\r' && bytes.get(i + 1) != Some(&b'\n'));
    let mut rest = bytes;
    let mut lines: Vec<String> = Vec::new();
    let (mut n_elements, mut n_properties) = (0, 0);
    loop {
        if rest.is_empty() {
            return Err(ParseError::Missing {
                what: "line end_header: the file is cut off within its header",
            });
        }
        let (text, taken) = header_line(rest, cr);
        rest = &rest[taken..];
        let keyword = words(text).next().unwrap_or_default();
        n_elements += usize::from(keyword == b"element");
        n_properties += usize::from(keyword == b"property");
        lines.push(match keyword {
            b"ply" | b"format" | b"element" | b"property" | b"obj_info" | b"end_header" => {
                String::from_utf8_lossy(text).into_owned()
            }
            // Comments, empty lines, and comments without the keyword, which some writers produce.
            _ => "comment".into(),
        });
        if keyword == b"end_header" {
            break;
        }
    }
    let text = lines.join("\n");
    let parser = Parser::<Row>::new();
    let header = parser
        .read_header(&mut Reader::new(text.as_bytes()))
        .map_err(|error| {
            let line = error.line().unwrap_or(0);
            match lines.get(line.wrapping_sub(1)) {
                Some(text) => ParseError::BadLine {
                    line,
                    found: shown(text.as_bytes()),
                    what: "PLY header",
                },
                None => ParseError::Reader {
                    reason: error.to_string(),
                },
            }
        })?;
    let found = header
        .elements
        .values()
        .map(|e| e.properties.len())
        .sum::<usize>();
    if header.elements.len() < n_elements || found < n_properties {
        return Err(ParseError::Unsupported {
            what: "a header that declares the same element or property twice".into(),
            instead: "only one of each name",
        });
    }
    let body = Body {
        rest,
        encoding: header.encoding,
        line: lines.len(),
    };
    Ok((header, body))
}

impl Body<'_> {
    /// The next row; `None` when it is incomplete.
    fn row(&mut self, element: &ElementDef, index: usize) -> Result<Option<Row>, ParseError> {
        let parser = Parser::<Row>::new();
        let row = match self.encoding {
            Encoding::Ascii => return self.text_row(element, index),
            Encoding::BinaryBigEndian => parser.read_big_endian_element(&mut self.rest, element),
            Encoding::BinaryLittleEndian => {
                parser.read_little_endian_element(&mut self.rest, element)
            }
        };
        match row {
            Ok(row) => Ok(Some(row)),
            Err(error) if error.kind() == ErrorKind::UnexpectedEof => Ok(None),
            Err(error) => Err(ParseError::Reader {
                reason: error.to_string(),
            }),
        }
    }

    /// The next non-empty line of a text.
    fn text_row(&mut self, element: &ElementDef, index: usize) -> Result<Option<Row>, ParseError> {
        let mut row = Row::default();
        if element.properties.is_empty() {
            return Ok(Some(row));
        }
        let text = loop {
            if self.rest.is_empty() {
                return Ok(None);
            }
            let (text, taken) = first_line(self.rest);
            self.rest = &self.rest[taken..];
            self.line += 1;
            if !text.trim_ascii().is_empty() {
                break text;
            }
        };
        let mut words = words(text);
        let mut next = || {
            words.next().ok_or(ParseError::ShortRow {
                line: self.line,
                declared: element.properties.len(),
            })
        };
        for (name, property) in &element.properties {
            match property.data_type {
                PropertyType::Scalar(_) => {
                    let word = next()?;
                    if let Some(axis) = coordinate(name) {
                        row.position[axis] = number(self.line, word)?;
                    }
                }
                PropertyType::List(..) => {
                    let n: usize = number(self.line, next()?)?;
                    if is_corners(name) {
                        check_corners(index, n)?;
                    }
                    for _ in 0..n {
                        let word = next()?;
                        if is_corners(name) {
                            row.corners.push(number(self.line, word)?);
                        }
                    }
                }
            }
        }
        Ok(Some(row))
    }
}

/// The name of an element's rows in messages.
fn rows_are(element: &ElementDef) -> &'static str {
    match element.name.as_str() {
        "vertex" => "vertices",
        "face" => "faces",
        _ => "rows of another element",
    }
}

/// Returns an error for more rows than fit into the length of the file.
fn check_count(element: &ElementDef, encoding: Encoding, n_bytes: usize) -> Result<(), ParseError> {
    let size = |scalar: &ScalarType| match scalar {
        ScalarType::Char | ScalarType::UChar => 1,
        ScalarType::Short | ScalarType::UShort => 2,
        ScalarType::Int | ScalarType::UInt | ScalarType::Float => 4,
        ScalarType::Double => 8,
    };
    let min: usize = match encoding {
        // A digit and its separator.
        Encoding::Ascii => 2 * element.properties.len(),
        _ => element
            .properties
            .values()
            .map(|property| match &property.data_type {
                PropertyType::Scalar(scalar) | PropertyType::List(scalar, _) => size(scalar),
            })
            .sum(),
    };
    // The last word of a text may lack its separator.
    let limit = match min {
        0 => 0,
        min => ((n_bytes + 1) / min).min(u32::MAX as usize),
    };
    if element.count > limit {
        return Err(ParseError::CountTooLarge {
            what: rows_are(element),
            declared: element.count as u64,
            n_bytes,
            limit: limit as u64,
        });
    }
    Ok(())
}

/// Checks that the elements of a mesh exist and come in an order in which they can be read.
fn check(header: &Header) -> Result<(), ParseError> {
    let place = |name: &str| header.elements.get_index_of(name);
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
    let scalar = |name: &str| {
        let property = header.elements[vertex].properties.get(name);
        property.is_some_and(|p| matches!(p.data_type, PropertyType::Scalar(_)))
    };
    if !["x", "y", "z"].into_iter().all(scalar) {
        return Err(ParseError::Missing {
            what: "properties x, y and z of its vertices",
        });
    }
    let face = &header.elements[face];
    let has_corners = |(name, property): (&String, &ply_rs_bw::ply::PropertyDef)| {
        is_corners(name) && matches!(property.data_type, PropertyType::List(..))
    };
    if face.count > 0 && !face.properties.iter().any(has_corners) {
        return Err(ParseError::Missing {
            what: "list vertex_indices (or vertex_index) of its faces",
        });
    }
    Ok(())
}

/// Returns an error for a face with no corners or with more than the limit.
fn check_corners(face: usize, n: usize) -> Result<(), ParseError> {
    match n {
        0 => Err(ParseError::EmptyPolygon { face }),
        1..=MAX_CORNERS => Ok(()),
        _ => Err(ParseError::PolygonTooLarge {
            face,
            corners: n as u64,
        }),
    }
}

/// The corners of a face, all of which must be vertices.
fn corners(row: &Row, face: usize, n_vertices: usize) -> Result<Vec<u32>, ParseError> {
    check_corners(face, row.corners.len())?;
    let inside = |&vertex: &i64| match u32::try_from(vertex) {
        Ok(index) if (index as usize) < n_vertices => Ok(index),
        _ => Err(ParseError::VertexOutOfRange {
            face,
            vertex,
            n_vertices,
        }),
    };
    row.corners.iter().map(inside).collect()
}

pub(super) fn parse(bytes: &[u8]) -> Result<ParsedMesh, ParseError> {
    let (header, mut body) = header(bytes)?;
    check(&header)?;
    let mut polygons = Polygons::new(Vec::new());
    for element in header.elements.values() {
        check_count(element, body.encoding, body.rest.len())?;
        if element.name == "vertex" {
            polygons.mesh.vertices.reserve_exact(element.count);
        }
        if ["tristrips", "edge"].contains(&element.name.as_str()) {
            polygons.mesh.findings.n_unread_statements += element.count;
        }
        for index in 0..element.count {
            let Some(row) = body.row(element, index)? else {
                return Err(ParseError::Truncated {
                    what: rows_are(element),
                    declared: element.count as u64,
                    found: index as u64,
                });
            };
            match element.name.as_str() {
                "vertex" => polygons.mesh.vertices.push(row.position),
                "face" => {
                    let n_vertices = polygons.mesh.vertices.len();
                    polygons.push(&corners(&row, index, n_vertices)?)?;
                }
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
