//! Reads glTF 2.0, as JSON or in one binary file (GLB): the triangles of its default scene.
//!
//! It reads only the parts that determine triangles (see `document`): the crate `gltf` checks all
//! of a file, and refuses valid ones for parts that do not matter here.
//!
//! Faces come in this order: nodes depth first, a node's mesh before its children, both in the
//! order of the file; a mesh's primitives in order; a primitive's triangles in order. Each triangle
//! is a face. A mesh that several nodes place is read once for each of them; without any nodes each
//! mesh is read once. Points and lines are ignored; skins and morph targets are not applied. No
//! other file is read.

pub(in crate::mesh) mod buffers;
mod compressed;
mod document;

use super::{ParseError, Polygons, shown};
use crate::mesh::ParsedMesh;
use buffers::Buffers;
use document::{Document, Mesh, Primitive, Whole, named};
use nalgebra::{Matrix4, Point3};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;
use std::ops::Range;

/// Vertices and corners that a scene may place beyond one for each two bytes of its file. Without a
/// limit, nodes that place one mesh repeatedly could make a small file as large as they like.
const ALLOWANCE: u64 = 1 << 16;
/// Bytes of the header of a binary file, and of each of its chunks.
const HEADER: usize = 12;
const CHUNK_HEADER: usize = 8;

fn fault(location: impl ToString, why: impl ToString) -> ParseError {
    ParseError::Gltf {
        location: location.to_string(),
        why: why.to_string(),
    }
}

/// The JSON and the binary chunk of a file of either kind.
pub(in crate::mesh) fn container(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>), ParseError> {
    if bytes.starts_with(b"glTF") {
        return binary(bytes);
    }
    let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    if text.trim_ascii_start().starts_with(b"{") {
        return Ok((text, None));
    }
    Err(ParseError::BadHeader {
        found: shown(&bytes[..bytes.len().min(8)]),
        format: "a glTF",
    })
}

/// The chunks of a GLB: JSON, then optionally one of data. Chunks of other kinds are skipped, and
/// so are bytes beyond the length in the header.
fn binary(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>), ParseError> {
    let word = |at: usize| -> Result<usize, ParseError> {
        let word = bytes.get(at..at + 4).and_then(|w| w.try_into().ok());
        let word = word.map(u32::from_le_bytes);
        word.map(|w| w as usize)
            .ok_or_else(|| fault("the file", "ends within its header"))
    };
    let version = word(4)?;
    if version != 2 {
        return Err(ParseError::Unsupported {
            what: format!("glTF {version}"),
            instead: "only glTF 2.0",
        });
    }
    let length = word(8)?;
    let whole = bytes.get(..length).ok_or_else(|| {
        let why = format!(
            "declares {length} bytes, but has {}: it is cut off",
            bytes.len()
        );
        fault("the file", why)
    })?;
    let (mut at, mut json, mut data) = (HEADER, None, None);
    while at + CHUNK_HEADER <= whole.len() {
        let (length, begin) = (word(at)?, at + CHUNK_HEADER);
        let chunk = begin
            .checked_add(length)
            .and_then(|end| whole.get(begin..end));
        let chunk = chunk.ok_or_else(|| {
            let rest = whole.len() - begin;
            let why = format!("declares {length} bytes, but the file has {rest} more");
            fault(format_args!("the chunk at byte {at}"), why)
        })?;
        let kind = &whole[at + 4..begin];
        match (kind, json) {
            (b"JSON", None) => json = Some(chunk),
            (_, None) => return Err(fault("the first chunk", "is not of JSON")),
            (b"BIN\0", _) if data.is_none() => data = Some(chunk),
            _ => {}
        }
        at = begin + length;
    }
    match json {
        Some(json) => Ok((json, data)),
        None => Err(fault("the file", "ends before its JSON")),
    }
}

/// Consecutive polygons that one primitive became where a node places it.
pub(in crate::mesh) struct Span {
    /// The node; in a file without nodes each mesh is placed by none.
    pub(in crate::mesh) node: Option<usize>,
    pub(in crate::mesh) mesh: usize,
    pub(in crate::mesh) primitive: usize,
    pub(in crate::mesh) polygons: Range<usize>,
    /// The vertex of the whole that the primitive's first one became.
    pub(in crate::mesh) first_vertex: u32,
    /// Whether the second and third corner of each triangle have changed places.
    pub(in crate::mesh) mirrored: bool,
    /// By which the primitive is placed.
    pub(in crate::mesh) transform: Matrix4<f64>,
}

/// The scene during its assembly.
struct Scene<'a> {
    document: &'a Document,
    buffers: Buffers<'a>,
    polygons: Polygons,
    spans: Vec<Span>,
    /// Vertices and corners placed so far, and bytes of the file.
    n_placed: u64,
    n_bytes: u64,
}

impl Scene<'_> {
    /// Largest number of vertices and corners that may be placed. Compressed data count at their
    /// full size.
    fn limit(&self) -> u64 {
        ALLOWANCE + (self.n_bytes + self.buffers.n_decoded() as u64) / 2
    }

    fn place(&mut self, n: usize) -> Result<(), ParseError> {
        self.n_placed = self.n_placed.saturating_add(n as u64);
        if self.n_placed > self.limit() {
            return Err(fault(
                "the scene",
                format_args!(
                    "places more than {} vertices and corners, more than a file of its size may: \
                     its nodes repeat the same mesh",
                    self.limit()
                ),
            ));
        }
        Ok(())
    }

    fn mesh(
        &mut self,
        node: Option<usize>,
        index: Whole,
        mesh: &Mesh,
        to: &Matrix4<f64>,
    ) -> Result<(), ParseError> {
        // The first vertex of each accessor's positions, once placed.
        let mut bases = BTreeMap::new();
        // Where left and right are exchanged, faces turn inside out.
        let mirrored = to.fixed_view::<3, 3>(0, 0).determinant() < 0.0;
        for (i, primitive) in mesh.primitives.iter().enumerate() {
            let location = format!("meshes[{}].primitives[{i}]", index.0);
            let first = self.polygons.mesh.n_polygons;
            self.primitive(primitive, &location, (to, mirrored), &mut bases)?;
            let polygons = first..self.polygons.mesh.n_polygons;
            let positions = primitive.positions().and_then(|p| bases.get(&p.0));
            if let Some(&first_vertex) = positions.filter(|_| !polygons.is_empty()) {
                self.spans.push(Span {
                    node,
                    mesh: index.0,
                    primitive: i,
                    polygons,
                    first_vertex,
                    mirrored,
                    transform: *to,
                });
            }
        }
        Ok(())
    }

    fn primitive(
        &mut self,
        primitive: &Primitive,
        location: &str,
        (transform, mirrored): (&Matrix4<f64>, bool),
        bases: &mut BTreeMap<usize, u32>,
    ) -> Result<(), ParseError> {
        let mode = match primitive.mode() {
            0..=3 => return Ok(()),
            4 => Mode::Triangles,
            5 => Mode::Strip,
            6 => Mode::Fan,
            other => {
                let why = format!("is {other}, which glTF does not know");
                return Err(fault(format_args!("{location}.mode"), why));
            }
        };
        let Some(index) = primitive.positions() else {
            return Ok(());
        };
        let accessors = &self.document.accessors;
        let by = format!("{location}.attributes.POSITION");
        let positions = named(accessors, index, "accessor", by)?;
        if primitive.is_draco() && positions.buffer_view.is_none() {
            return Err(ParseError::Unsupported {
                what: "a mesh compressed by KHR_draco_mesh_compression".to_owned(),
                instead: "export it without that extension",
            });
        }
        let indices = match primitive.indices {
            None => None,
            Some(index) => {
                let by = format!("{location}.indices");
                Some((index, named(accessors, index, "accessor", by)?))
            }
        };
        let n_vertices = positions.count.0;
        let base = match bases.get(&index.0) {
            Some(base) => *base,
            None => {
                self.buffers.prepare(positions);
                self.place(n_vertices)?;
                let vertices = &mut self.polygons.mesh.vertices;
                let base = vertices.len() as u32;
                for position in self.buffers.positions(index)? {
                    let placed = transform.transform_point(&Point3::from(position));
                    vertices.push(placed.coords.into());
                }
                bases.insert(index.0, base);
                base
            }
        };
        let corners: Vec<u32> = match indices {
            Some((index, indices)) => {
                self.buffers.prepare(indices);
                self.place(indices.count.0)?;
                self.buffers.indices(index)?
            }
            None => {
                self.place(n_vertices)?;
                (0..n_vertices as u32).collect()
            }
        };
        let n_corners = corners.len();
        if mode == Mode::Triangles && !n_corners.is_multiple_of(3) {
            return Err(fault(
                "a primitive of triangles",
                format_args!("has {n_corners} corners, which is no multiple of 3"),
            ));
        }
        let n_triangles = match mode {
            Mode::Triangles => n_corners / 3,
            _ => n_corners.saturating_sub(2),
        };
        for i in 0..n_triangles {
            let [a, mut b, mut c] = match mode {
                Mode::Triangles => [corners[3 * i], corners[3 * i + 1], corners[3 * i + 2]],
                Mode::Strip => [corners[i], corners[i + 1 + i % 2], corners[i + 2 - i % 2]],
                Mode::Fan => [corners[i + 1], corners[i + 2], corners[0]],
            };
            if mirrored {
                std::mem::swap(&mut b, &mut c);
            }
            if let Some(beyond) = [a, b, c].into_iter().find(|&v| v as usize >= n_vertices) {
                return Err(ParseError::VertexOutOfRange {
                    face: self.polygons.mesh.n_polygons,
                    vertex: beyond.into(),
                    n_vertices,
                });
            }
            self.polygons.push(&[a + base, b + base, c + base])?;
        }
        Ok(())
    }
}

/// How corners form triangles.
#[derive(Clone, Copy, PartialEq)]
enum Mode {
    Triangles,
    Strip,
    Fan,
}

/// Nodes at one level of the hierarchy with the same transform, and the index of the next one.
struct Level<'a> {
    list: List,
    nodes: &'a [Whole],
    next: usize,
    transform: Matrix4<f64>,
}

/// The kind of list that names nodes.
#[derive(Clone, Copy)]
enum List {
    Scene(usize),
    Children(usize),
    Roots,
}

impl fmt::Display for List {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Scene(scene) => write!(f, "scenes[{scene}].nodes"),
            Self::Children(node) => write!(f, "nodes[{node}].children"),
            Self::Roots => f.write_str("roots"),
        }
    }
}

/// The root nodes: those of the default scene, or of the first one, or all nodes without a parent.
fn roots(document: &Document) -> Result<(List, Cow<'_, [Whole]>), ParseError> {
    if document.scene.is_some() || !document.scenes.is_empty() {
        let index = document.scene.unwrap_or_default();
        let scene = named(&document.scenes, index, "scene", "scene")?;
        return Ok((List::Scene(index.0), Cow::Borrowed(&scene.nodes)));
    }
    let mut is_child = vec![false; document.nodes.len()];
    for child in document.nodes.iter().flat_map(|node| &node.children) {
        if let Some(is_child) = is_child.get_mut(child.0) {
            *is_child = true;
        }
    }
    let nodes = (0..document.nodes.len()).filter(|&node| !is_child[node]);
    Ok((List::Roots, nodes.map(Whole).collect()))
}

pub(super) fn parse(bytes: &[u8]) -> Result<ParsedMesh, ParseError> {
    spans(bytes).map(|(mesh, _)| mesh)
}

/// The mesh of a file, and what its polygons come from, in their order.
pub(in crate::mesh) fn spans(bytes: &[u8]) -> Result<(ParsedMesh, Vec<Span>), ParseError> {
    let (text, binary) = container(bytes)?;
    let document = Document::read(text)?;
    let mut scene = Scene {
        document: &document,
        buffers: Buffers::new(&document, binary),
        polygons: Polygons::new(Vec::new()),
        spans: Vec::new(),
        n_placed: 0,
        n_bytes: bytes.len() as u64,
    };
    let (list, roots) = roots(&document)?;
    let mut levels = vec![Level {
        list,
        nodes: &roots,
        next: 0,
        transform: Matrix4::identity(),
    }];
    let mut seen = vec![false; document.nodes.len()];
    let mut n_meshes = 0;
    while let Some(level) = levels.last_mut() {
        let Some(&index) = level.nodes.get(level.next) else {
            levels.pop();
            continue;
        };
        let by = format_args!("{}[{}]", level.list, level.next);
        let node = named(&document.nodes, index, "node", by)?;
        level.next += 1;
        if std::mem::replace(&mut seen[index.0], true) {
            return Err(fault(
                format_args!("node {}", index.0),
                "is reached twice, but nodes must form a tree",
            ));
        }
        let transform = level.transform * node.transform();
        if let Some(mesh) = node.mesh {
            let by = format_args!("nodes[{}].mesh", index.0);
            let found = named(&document.meshes, mesh, "mesh", by)?;
            scene.mesh(Some(index.0), mesh, found, &transform)?;
            n_meshes += 1;
        }
        levels.push(Level {
            list: List::Children(index.0),
            nodes: &node.children,
            next: 0,
            transform,
        });
    }
    if document.scenes.is_empty() && document.nodes.is_empty() {
        // A file without nodes is a collection of meshes.
        for (i, mesh) in document.meshes.iter().enumerate() {
            scene.mesh(None, Whole(i), mesh, &Matrix4::identity())?;
        }
    } else if n_meshes == 0 && !document.meshes.is_empty() {
        let why = format!(
            "places none of the file's {} meshes: make the scene that has them the default one",
            document.meshes.len()
        );
        return Err(fault("the scene that is read", why));
    }
    let spans = scene.spans;
    Ok((scene.polygons.finish()?, spans))
}

/// Gives `read` a function for accessors that triangles do not need: from the index of an accessor
/// and the number of its entries to these, with zeros for missing components; `None` if they cannot
/// be read, or are not as many.
pub(in crate::mesh) fn with_vectors<R>(
    bytes: &[u8],
    read: impl FnOnce(&dyn Fn(usize, usize) -> Option<Vec<[f64; 4]>>) -> R,
) -> Result<R, ParseError> {
    let (text, binary) = container(bytes)?;
    let document = Document::read(text)?;
    let buffers = Buffers::new(&document, binary);
    Ok(read(&|accessor, count| {
        let it = document.accessors.get(accessor)?;
        // An accessor without a view is as long as it says.
        if it.count.0 != count {
            return None;
        }
        buffers.vectors(Whole(accessor)).ok()
    }))
}

#[cfg(test)]
mod odd_tests;
