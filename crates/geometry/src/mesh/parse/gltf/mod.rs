//! glTF 2.0, as JSON or in one binary file (GLB), read by `gltf`: the triangles of its default scene.
//!
//! Faces come in this order: nodes depth first, a node's mesh before its children, both in the order of
//! the file; a mesh's primitives in order; a primitive's triangles in order. Each triangle is a face. A
//! mesh that several nodes place is read once for each. Points and lines are no faces; skins and morph
//! targets are not applied. Nothing outside the file is read.

mod buffers;
mod transforms;

use super::{ParseError, Polygons, shown};
use crate::mesh::ParsedMesh;
use buffers::Buffers;
use gltf::json::validation::{Error as Invalid, Validate as _};
use gltf::json::{self, Root};
use gltf::mesh::{Mode, Semantic};
use gltf::{Document, Node, Primitive};
use nalgebra::{Matrix4, Point3};
use std::borrow::Cow;
use std::collections::BTreeMap;

/// Vertices and corners that a scene may place beyond one for each two bytes of its file: nodes that place
/// one mesh again and again could make a small file as large as they like.
const ALLOWANCE: u64 = 1 << 16;
/// Objects the JSON may have; each is many times as large in memory as in the file.
const MAX_OBJECTS: usize = 1_000_000;
/// Required extensions that leave triangles where they are; integer positions are read.
const HARMLESS: [&str; 8] = [
    "KHR_materials_",
    "KHR_texture_",
    "EXT_texture_",
    "MSFT_texture_",
    "KHR_lights_",
    "KHR_xmp",
    "KHR_mesh_quantization",
    "KHR_animation_pointer",
];

fn fault(place: impl ToString, why: impl ToString) -> ParseError {
    ParseError::Gltf {
        place: place.to_string(),
        why: why.to_string(),
    }
}

/// The JSON and the binary chunk of a file.
type Chunks<'a> = (Cow<'a, [u8]>, Option<Cow<'a, [u8]>>);

/// The chunks of a file of either kind.
fn container(bytes: &[u8]) -> Result<Chunks<'_>, ParseError> {
    if bytes.starts_with(b"glTF") {
        // The crate subtracts the length of the header from that of the file.
        let length = bytes.get(8..12).and_then(|word| word.try_into().ok());
        if length.map(u32::from_le_bytes).is_none_or(|n| n < 12) {
            return Err(fault("the file", "ends within its header"));
        }
        let glb = gltf::Glb::from_slice(bytes).map_err(|e| unreadable(&e))?;
        return Ok((glb.json, glb.bin));
    }
    let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    if text.trim_ascii_start().starts_with(b"{") {
        return Ok((Cow::Borrowed(text), None));
    }
    Err(ParseError::BadHeader {
        found: shown(&bytes[..bytes.len().min(8)]),
        format: "a glTF",
    })
}

fn unreadable(error: &gltf::Error) -> ParseError {
    match error {
        gltf::Error::Binary(gltf::binary::Error::Version(version)) => ParseError::Unsupported {
            what: format!("glTF {version}"),
            instead: "only glTF 2.0",
        },
        other => fault("the file", format_args!("is no whole GLB: {other}")),
    }
}

fn no_json(error: &json::Error) -> ParseError {
    ParseError::Json {
        reason: error.to_string(),
    }
}

/// A document in which every index that leads to triangles is in range.
fn document(text: &[u8]) -> Result<Document, ParseError> {
    let n_objects = text.iter().filter(|&&b| b == b'{').count();
    if n_objects > MAX_OBJECTS {
        return Err(fault(
            "the JSON",
            format_args!("has {n_objects} objects, but at most {MAX_OBJECTS} are read"),
        ));
    }
    let root: Root = json::deserialize::from_slice(text).map_err(|e| no_json(&e))?;
    if !root.asset.version.starts_with("2.") {
        return Err(ParseError::Unsupported {
            what: format!("glTF {}", shown(root.asset.version.as_bytes())),
            instead: "only glTF 2.0",
        });
    }
    let harmless = |name: &str| HARMLESS.iter().any(|known| name.starts_with(known));
    if let Some(name) = root.extensions_required.iter().find(|name| !harmless(name)) {
        return Err(ParseError::Unsupported {
            what: format!("a file that requires {}", shown(name.as_bytes())),
            instead: "export it without that extension",
        });
    }
    check(&root, text)?;
    Ok(Document::from_json_without_validation(root))
}

/// Refuses indices that lead nowhere and values that glTF does not know, in what the scene is read from.
fn check(root: &Root, text: &[u8]) -> Result<(), ParseError> {
    // The crate's own check takes the bounds of positions from accessors that it has not looked for yet.
    let n_accessors = root.accessors.len();
    let primitives = root.meshes.iter().flat_map(|mesh| &mesh.primitives);
    for index in primitives.flat_map(|primitive| primitive.attributes.values()) {
        if index.value() >= n_accessors {
            return Err(fault(
                "a primitive",
                format_args!(
                    "names accessor {}, but the file has {n_accessors}",
                    index.value()
                ),
            ));
        }
    }
    const READ: [&str; 6] = [
        "accessors",
        "bufferViews",
        "buffers",
        "meshes",
        "nodes",
        "scene",
    ];
    let mut first = None;
    root.validate(root, json::Path::new, &mut |path, error| {
        // Bounds that are missing, extensions: of no account here.
        if !matches!(error, Invalid::IndexOutOfBounds | Invalid::Invalid) {
            return;
        }
        let path = path();
        let is_bound = [".min", ".max"]
            .iter()
            .any(|end| path.as_str().ends_with(end));
        if first.is_none() && !is_bound && READ.iter().any(|name| path.as_str().starts_with(name)) {
            let is_index = matches!(error, Invalid::IndexOutOfBounds);
            first = Some((path.as_str().to_owned(), is_index));
        }
    });
    let Some((path, is_index)) = first else {
        return Ok(());
    };
    let found = value_at(text, &path);
    let why = match list_of(&path).filter(|_| is_index) {
        Some((what, list)) => {
            let n = value_at(text, list).map_or(0, |list| list.as_array().map_or(0, Vec::len));
            format!(
                "names {what} {}, but the file has {n}",
                spelt(found.as_ref())
            )
        }
        None => format!("is {}, which glTF does not know", spelt(found.as_ref())),
    };
    Err(fault(shown(path.as_bytes()), why))
}

/// What an index at a path names, and where these are, by the last word of the path.
fn list_of(path: &str) -> Option<(&'static str, &'static str)> {
    let word = path.rsplit('.').next().unwrap_or(path);
    let word = word.split('[').next().unwrap_or(word);
    Some(match word {
        "children" | "nodes" | "skeleton" | "joints" | "node" => ("node", "nodes"),
        "mesh" => ("mesh", "meshes"),
        "scene" => ("scene", "scenes"),
        "buffer" => ("buffer", "buffers"),
        "bufferView" => ("buffer view", "bufferViews"),
        "indices" | "attributes" | "targets" => ("accessor", "accessors"),
        "material" => ("material", "materials"),
        "skin" => ("skin", "skins"),
        "camera" => ("camera", "cameras"),
        _ => return None,
    })
}

/// The value at a path such as `nodes[0].children[1]` of a JSON that was read before.
fn value_at(text: &[u8], path: &str) -> Option<json::Value> {
    let pointer: String = path
        .split(['.', '[', ']'])
        .filter(|step| !step.is_empty())
        .flat_map(|step| ["/", step.trim_matches('"')])
        .collect();
    let whole: json::Value = json::deserialize::from_slice(text).ok()?;
    whole.pointer(&pointer).cloned()
}

/// A value as the file has it, cut short.
fn spelt(value: Option<&json::Value>) -> String {
    value.map_or_else(|| "nothing".to_owned(), |v| shown(v.to_string().as_bytes()))
}

/// The scene as it is put together.
struct Scene<'a> {
    buffers: Buffers<'a>,
    polygons: Polygons,
    /// Vertices and corners placed, and how many may be.
    n_placed: u64,
    limit: u64,
}

impl Scene<'_> {
    fn place(&mut self, n: usize) -> Result<(), ParseError> {
        self.n_placed = self.n_placed.saturating_add(n as u64);
        if self.n_placed > self.limit {
            return Err(fault(
                "the scene",
                format_args!(
                    "places more than {} vertices and corners, more than a file of its size may: its \
                     nodes repeat the same mesh",
                    self.limit
                ),
            ));
        }
        Ok(())
    }

    /// Adds a mesh's primitives; `bases` holds where the positions of each accessor begin, once placed.
    fn primitive(
        &mut self,
        primitive: &Primitive<'_>,
        transform: &Matrix4<f64>,
        bases: &mut BTreeMap<usize, u32>,
    ) -> Result<(), ParseError> {
        let mode = primitive.mode();
        let Some(positions) = primitive.get(&Semantic::Positions) else {
            return Ok(());
        };
        if !matches!(
            mode,
            Mode::Triangles | Mode::TriangleStrip | Mode::TriangleFan
        ) {
            return Ok(());
        }
        let n_vertices = positions.count();
        let base = match bases.get(&positions.index()) {
            Some(base) => *base,
            None => {
                self.place(n_vertices)?;
                let vertices = &mut self.polygons.mesh.vertices;
                let base = vertices.len() as u32;
                for position in self.buffers.positions(&positions)? {
                    let placed = transform.transform_point(&Point3::from(position));
                    vertices.push(placed.coords.into());
                }
                bases.insert(positions.index(), base);
                base
            }
        };
        let n_corners = primitive.indices().map_or(n_vertices, |i| i.count());
        self.place(n_corners)?;
        let corners: Vec<u32> = match primitive.indices() {
            Some(indices) => self.buffers.indices(&indices)?,
            None => (0..n_vertices as u32).collect(),
        };
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
        // Where left and right are exchanged, faces turn inside out.
        let mirrors = transform.fixed_view::<3, 3>(0, 0).determinant() < 0.0;
        for i in 0..n_triangles {
            let [a, mut b, mut c] = match mode {
                Mode::Triangles => [corners[3 * i], corners[3 * i + 1], corners[3 * i + 2]],
                Mode::TriangleStrip => [corners[i], corners[i + 1 + i % 2], corners[i + 2 - i % 2]],
                _ => [corners[i + 1], corners[i + 2], corners[0]],
            };
            if mirrors {
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

/// The nodes a scene begins with: of the default scene, the first one, or all that are nobody's children.
fn roots(document: &Document) -> Vec<Node<'_>> {
    if let Some(scene) = document
        .default_scene()
        .or_else(|| document.scenes().next())
    {
        return scene.nodes().collect();
    }
    let mut is_child = vec![false; document.nodes().len()];
    for child in document.nodes().flat_map(|node| node.children()) {
        is_child[child.index()] = true;
    }
    document
        .nodes()
        .filter(|node| !is_child[node.index()])
        .collect()
}

pub(super) fn parse(bytes: &[u8]) -> Result<ParsedMesh, ParseError> {
    let (text, binary) = container(bytes)?;
    let document = document(&text)?;
    let transforms = transforms::read(&text).map_err(|e| no_json(&e))?;
    let mut scene = Scene {
        buffers: Buffers::new(&document, binary.as_deref()),
        polygons: Polygons::new(Vec::new()),
        n_placed: 0,
        limit: ALLOWANCE + bytes.len() as u64 / 2,
    };
    let mut seen = vec![false; document.nodes().len()];
    let outermost = roots(&document).into_iter().rev();
    let mut todo: Vec<(Node<'_>, Matrix4<f64>)> =
        outermost.map(|node| (node, Matrix4::identity())).collect();
    while let Some((node, outer)) = todo.pop() {
        if std::mem::replace(&mut seen[node.index()], true) {
            return Err(fault(
                format_args!("node {}", node.index()),
                "is reached twice, but nodes must form a tree",
            ));
        }
        let transform = outer * transforms[node.index()];
        if let Some(mesh) = node.mesh() {
            let mut bases = BTreeMap::new();
            for primitive in mesh.primitives() {
                scene.primitive(&primitive, &transform, &mut bases)?;
            }
        }
        let children: Vec<Node<'_>> = node.children().collect();
        todo.extend(children.into_iter().rev().map(|child| (child, transform)));
    }
    scene.polygons.finish()
}
