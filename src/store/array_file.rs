//! Writes a description as a safetensors file, and reads the positions of arrays from a file's
//! header.
//!
//! The format is safetensors (eight bytes of header length, a JSON header, the data), so that
//! Python reads it without our code. Two things are added. The header is padded with spaces until
//! the data begin at a multiple of 64 bytes, and the only 8-byte array comes first, so that every
//! array can be used where it is mapped. Everything that is not an array (area, report, parameters,
//! format version) is text in `__metadata__`. docs/format.md describes the format completely.

use crate::mesh::CleanReport;
use crate::pipeline::{Description, DescriptionView};
use safetensors::SafeTensors;
use safetensors::tensor::Dtype;
use std::collections::HashMap;
use std::ops::Range;

/// Version of the array files; files of other versions are rejected.
pub const ARRAY_FORMAT: u32 = 1;

/// The data begins at a multiple of this: a cache line, and the widest vector register.
pub(crate) const DATA_ALIGNMENT: usize = 64;

/// The reason why a description could not be written, or an array file is invalid.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // the messages say it
pub enum ArrayFileError {
    #[error(transparent)]
    Io(#[from] std::io::Error),
    #[error("the file has {found} bytes, but the catalog says {expected}")]
    Length { found: u64, expected: u64 },
    #[error("the file's pages could not be read: {0}")]
    Unreadable(std::io::Error),
    #[error("the file's BLAKE3 is {found}, but the catalog says {expected}")]
    Digest {
        found: super::Digest,
        expected: super::Digest,
    },
    #[error("the header is bad: {0}")]
    Header(String),
    #[error("metadata {key:?} is {found:?}, which is not {expected}")]
    Metadata {
        key: &'static str,
        found: Option<String>,
        expected: &'static str,
    },
    #[error("array file format {found}, but this version reads {supported}")]
    Version { found: u32, supported: u32 },
    #[error("array {name:?} is missing")]
    Missing { name: &'static str },
    #[error("array {name:?} is not part of a description")]
    Unexpected { name: String },
    #[error("array {name:?} has dtype {found:?}, but must have {expected:?}")]
    Dtype {
        name: &'static str,
        found: Dtype,
        expected: Dtype,
    },
    #[error("array {name:?} has shape {found:?}, but must have {expected}")]
    Shape {
        name: &'static str,
        found: Vec<usize>,
        expected: String,
    },
    #[error("array {name:?} begins at byte {offset}, which is not a multiple of {alignment}")]
    Alignment {
        name: &'static str,
        offset: usize,
        alignment: usize,
    },
    #[error("{name}[{position}] is {value}, but must be below {limit}")]
    Index {
        name: &'static str,
        position: usize,
        value: u32,
        limit: usize,
    },
}

/// One array of a description: its name, element type, shape and bytes.
#[derive(Debug)]
struct Array<'a> {
    name: &'static str,
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: &'a [u8],
}

/// An array file in pieces, to be written one after the other: the header, and the arrays of the
/// description, which are not copied.
#[derive(Debug)]
pub struct DescriptionFile<'a> {
    header: Vec<u8>,
    arrays: [Array<'a>; 11],
}

impl<'a> DescriptionFile<'a> {
    /// The file of a description. The same description and parameters give the same bytes.
    ///
    /// `params_json` is stored unchanged, for people and for recomputing. If the arrays of the
    /// description do not fit each other, the error names the array.
    pub fn new(description: &'a Description, params_json: &str) -> Result<Self, ArrayFileError> {
        let view = description.view();
        let arrays = arrays(&view)?;
        check_indices(&view)?;
        let mut metadata = serde_json::Map::new();
        metadata.insert("format".into(), ARRAY_FORMAT.to_string().into());
        metadata.insert("area".into(), description.area.to_string().into());
        metadata.insert("params".into(), params_json.into());
        for (key, value) in description.report.counts() {
            metadata.insert(key.into(), value.to_string().into());
        }
        let places = arrays.iter().map(|a| (a.name, a.dtype, a.shape.as_slice()));
        let header = header(Some(metadata), places);
        Ok(Self { header, arrays })
    }

    /// The pieces of the file.
    pub fn pieces(&self) -> Vec<&[u8]> {
        let arrays = self.arrays.iter().map(|a| a.bytes);
        std::iter::once(self.header.as_slice())
            .chain(arrays)
            .collect()
    }
}

/// The bytes of the file of a description, in one piece.
pub fn write_description(
    description: &Description,
    params_json: &str,
) -> Result<Vec<u8>, ArrayFileError> {
    Ok(DescriptionFile::new(description, params_json)?
        .pieces()
        .concat())
}

/// The header of a safetensors file with consecutive arrays: its length, JSON, and spaces up to the
/// beginning of the data.
pub(crate) fn header<'a>(
    metadata: Option<serde_json::Map<String, serde_json::Value>>,
    arrays: impl Iterator<Item = (&'a str, Dtype, &'a [usize])>,
) -> Vec<u8> {
    let mut header = serde_json::Map::new();
    if let Some(metadata) = metadata {
        header.insert("__metadata__".into(), metadata.into());
    }
    let mut end = 0;
    for (name, dtype, shape) in arrays {
        let begin = end;
        end += shape.iter().product::<usize>() * dtype.bitsize() / 8;
        header.insert(
            name.into(),
            serde_json::json!({
                "dtype": dtype.to_string(),
                "shape": shape,
                "data_offsets": [begin, end],
            }),
        );
    }
    let text = serde_json::Value::from(header).to_string();
    let length = (8 + text.len()).next_multiple_of(DATA_ALIGNMENT) - 8;
    let mut bytes = (length as u64).to_le_bytes().to_vec();
    bytes.extend_from_slice(text.as_bytes());
    bytes.resize(8 + length, b' ');
    bytes
}

/// The arrays of a description in file order: the 8-byte one first.
fn arrays<'a>(view: &DescriptionView<'a>) -> Result<[Array<'a>; 11], ArrayFileError> {
    let (n, m) = (view.vertices.len(), view.faces.len());
    let n_polygons = view.face_map.len();
    Ok([
        array(
            "eigenvalues",
            Dtype::F64,
            view.eigenvalues,
            &[view.eigenvalues.len()],
        )?,
        array("vertices", Dtype::F32, view.vertices, &[n, 3])?,
        array("faces", Dtype::U32, view.faces, &[m, 3])?,
        array("mass", Dtype::F32, view.mass, &[n])?,
        array(
            "eigenvectors",
            Dtype::F32,
            view.eigenvectors,
            &[n, view.n_eigenvectors],
        )?,
        array(
            "hks",
            Dtype::F32,
            view.hks,
            &[n, view.hks.len().checked_div(n).unwrap_or(0)],
        )?,
        array(
            "face_descriptors",
            Dtype::F32,
            view.face_descriptors,
            &[m, view.n_descriptors],
        )?,
        array("patches", Dtype::U32, view.patches, &[m])?,
        array("face_map", Dtype::U32, view.face_map, &[n_polygons])?,
        array("polygon_area", Dtype::F32, view.polygon_area, &[n_polygons])?,
        array(
            "signature",
            Dtype::F32,
            view.signature,
            &[view.signature.len()],
        )?,
    ])
}

fn array<'a, T: bytemuck::NoUninit>(
    name: &'static str,
    dtype: Dtype,
    values: &'a [T],
    shape: &[usize],
) -> Result<Array<'a>, ArrayFileError> {
    let bytes: &[u8] = bytemuck::cast_slice(values);
    let size = dtype.bitsize() / 8;
    if shape.iter().product::<usize>() * size != bytes.len() {
        return Err(ArrayFileError::Shape {
            name,
            found: vec![bytes.len() / size],
            expected: format!("{shape:?}"),
        });
    }
    Ok(Array {
        name,
        dtype,
        shape: shape.to_vec(),
        bytes,
    })
}

/// Indices are checked when a file is written and when it is opened, so that holders of a
/// description may index with them.
pub(super) fn check_indices(view: &DescriptionView<'_>) -> Result<(), ArrayFileError> {
    let (n, m) = (view.vertices.len(), view.faces.len());
    let below = |name, values: &[u32], limit: usize| match values
        .iter()
        .position(|&value| value as usize >= limit)
    {
        None => Ok(()),
        Some(position) => Err(ArrayFileError::Index {
            name,
            position,
            value: values[position],
            limit,
        }),
    };
    below("faces", view.faces.as_flattened(), n)?;
    below("patches", view.patches, m)?;
    below("face_map", view.face_map, m)
}

/// The header of an array file: the position of each array, and the rest of the description.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Layout {
    pub(super) area: f64,
    pub(super) report: CleanReport,
    pub(super) params: String,
    pub(super) n_eigenvectors: usize,
    pub(super) n_descriptors: usize,
    pub(super) vertices: Range<usize>,
    pub(super) faces: Range<usize>,
    pub(super) mass: Range<usize>,
    pub(super) eigenvalues: Range<usize>,
    pub(super) eigenvectors: Range<usize>,
    pub(super) hks: Range<usize>,
    pub(super) face_descriptors: Range<usize>,
    pub(super) patches: Range<usize>,
    pub(super) face_map: Range<usize>,
    pub(super) polygon_area: Range<usize>,
    pub(super) signature: Range<usize>,
}

/// Names in the order in which [`arrays`] writes them.
const NAMES: [&str; 11] = [
    "eigenvalues",
    "vertices",
    "faces",
    "mass",
    "eigenvectors",
    "hks",
    "face_descriptors",
    "patches",
    "face_map",
    "polygon_area",
    "signature",
];

impl Layout {
    /// Reads the header of a whole file and checks that the arrays are those of one description.
    pub(super) fn parse(file: &[u8]) -> Result<Self, ArrayFileError> {
        let bad_header = |e: safetensors::SafeTensorError| ArrayFileError::Header(e.to_string());
        let (_, header) = SafeTensors::read_metadata(file).map_err(bad_header)?;
        let metadata = header.metadata().clone().unwrap_or_default();
        let version: u32 = number(&metadata, "format", "a format version")?;
        if version != ARRAY_FORMAT {
            return Err(ArrayFileError::Version {
                found: version,
                supported: ARRAY_FORMAT,
            });
        }
        let tensors = SafeTensors::deserialize(file).map_err(bad_header)?;
        if let Some(name) = tensors
            .names()
            .into_iter()
            .find(|name| !NAMES.contains(name))
        {
            return Err(ArrayFileError::Unexpected {
                name: name.to_string(),
            });
        }
        let find = |name: &'static str, dtype: Dtype, rank: usize| {
            let tensor = tensors
                .tensor(name)
                .map_err(|_| ArrayFileError::Missing { name })?;
            if tensor.dtype() != dtype {
                return Err(ArrayFileError::Dtype {
                    name,
                    found: tensor.dtype(),
                    expected: dtype,
                });
            }
            if tensor.shape().len() != rank {
                return Err(ArrayFileError::Shape {
                    name,
                    found: tensor.shape().to_vec(),
                    expected: format!("{rank} dimensions"),
                });
            }
            let begin = tensor.data().as_ptr().addr() - file.as_ptr().addr();
            let alignment = dtype.bitsize() / 8;
            if !begin.is_multiple_of(alignment) {
                return Err(ArrayFileError::Alignment {
                    name,
                    offset: begin,
                    alignment,
                });
            }
            Ok((tensor.shape().to_vec(), begin..begin + tensor.data().len()))
        };
        let (vertices_shape, vertices) = find("vertices", Dtype::F32, 2)?;
        let (faces_shape, faces) = find("faces", Dtype::U32, 2)?;
        let (n, m) = (vertices_shape[0], faces_shape[0]);
        require("vertices", &vertices_shape, &[n, 3])?;
        require("faces", &faces_shape, &[m, 3])?;
        let (mass_shape, mass) = find("mass", Dtype::F32, 1)?;
        require("mass", &mass_shape, &[n])?;
        let (_, eigenvalues) = find("eigenvalues", Dtype::F64, 1)?;
        let (eigenvectors_shape, eigenvectors) = find("eigenvectors", Dtype::F32, 2)?;
        require(
            "eigenvectors",
            &eigenvectors_shape,
            &[n, eigenvectors_shape[1]],
        )?;
        let (hks_shape, hks) = find("hks", Dtype::F32, 2)?;
        require("hks", &hks_shape, &[n, hks_shape[1]])?;
        let (descriptors_shape, face_descriptors) = find("face_descriptors", Dtype::F32, 2)?;
        require(
            "face_descriptors",
            &descriptors_shape,
            &[m, descriptors_shape[1]],
        )?;
        let (patches_shape, patches) = find("patches", Dtype::U32, 1)?;
        require("patches", &patches_shape, &[m])?;
        let (face_map_shape, face_map) = find("face_map", Dtype::U32, 1)?;
        let (area_shape, polygon_area) = find("polygon_area", Dtype::F32, 1)?;
        require("polygon_area", &area_shape, &[face_map_shape[0]])?;
        let (_, signature) = find("signature", Dtype::F32, 1)?;
        Ok(Self {
            area: number(&metadata, "area", "an area")?,
            report: report_from(&metadata)?,
            params: text(&metadata, "params", "parameters")?.to_string(),
            n_eigenvectors: eigenvectors_shape[1],
            n_descriptors: descriptors_shape[1],
            vertices,
            faces,
            mass,
            eigenvalues,
            eigenvectors,
            hks,
            face_descriptors,
            patches,
            face_map,
            polygon_area,
            signature,
        })
    }
}

fn require(name: &'static str, found: &[usize], expected: &[usize]) -> Result<(), ArrayFileError> {
    if found == expected {
        return Ok(());
    }
    let expected = format!("{expected:?}");
    Err(ArrayFileError::Shape {
        name,
        found: found.to_vec(),
        expected,
    })
}

type Metadata = HashMap<String, String>;

fn text<'a>(
    metadata: &'a Metadata,
    key: &'static str,
    expected: &'static str,
) -> Result<&'a str, ArrayFileError> {
    metadata
        .get(key)
        .map(String::as_str)
        .ok_or(ArrayFileError::Metadata {
            key,
            found: None,
            expected,
        })
}

fn number<T: std::str::FromStr>(
    metadata: &Metadata,
    key: &'static str,
    expected: &'static str,
) -> Result<T, ArrayFileError> {
    let found = text(metadata, key, expected)?;
    found.parse().map_err(|_| ArrayFileError::Metadata {
        key,
        found: Some(found.to_string()),
        expected,
    })
}

fn report_from(metadata: &Metadata) -> Result<CleanReport, ArrayFileError> {
    let expected = "a count";
    let count = |name| match metadata.contains_key(name) {
        true => number(metadata, name, expected).map(Some),
        false => Ok(None),
    };
    let missing = |key| ArrayFileError::Metadata {
        key,
        found: None,
        expected,
    };
    CleanReport::from_counts(count, missing)
}
