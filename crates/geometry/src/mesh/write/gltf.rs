//! A glTF file gets a node for each part instance, and keeps everything that it holds.
//!
//! The triangles of a node's mesh go to new nodes below it, one for each part instance, such as
//! `leg.001`; an instance never reaches across nodes. Their primitives are the file's, with other
//! indices: attributes, materials, morph targets and extensions are the same entries as before, and
//! nothing is encoded again.

use super::glb::{Document, glb_of, list, part, polygons};
use super::paint::Painter;
use super::{Labelling, Materials};
use crate::mesh::parse::as_utf8;
use crate::mesh::parse::gltf::buffers::{BASE64, data_uri};
use crate::mesh::parse::gltf::{Span, container, spans};
use crate::mesh::{ParseError, ParsedMesh, instances};
use base64::Engine as _;
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};

/// Draws a node's mesh many times, so it goes with the mesh.
const INSTANCING: &str = "EXT_mesh_gpu_instancing";
/// Hold triangles of a whole primitive or mesh, which is no longer whole.
const OF_WHOLES: [&str; 2] = ["KHR_draco_mesh_compression", "EXT_mesh_manifold"];

/// A binary glTF file with the nodes, meshes, materials and whatever else is in `bytes`, and a node
/// for each part instance below the node that places it. Where the coordinate axis `up` is not +Y a
/// node around the scene, called after `name`, turns it there.
///
/// A primitive with a material keeps it, and has that of its label in a variant `labels`
/// (`KHR_materials_variants`); for [`Materials::Labels`] it has that of its label, and its own in a
/// variant `original`. Without a material it has that of its label.
///
/// ```
/// use coseg_geometry::mesh::write::{self, Labelling, Materials};
/// use coseg_geometry::mesh::{Format, icosphere, parse};
///
/// let sphere = icosphere(1);
/// let (labels, styles) = (vec![0; sphere.faces.len()], Default::default());
/// let labelling = Labelling { labels: &labels, confidence: None, styles: &styles };
/// let file = write::glb("ball", &sphere.vertices, &sphere.faces, &labelling, None);
/// let labels: Vec<i32> = (0..labels.len() as i32).map(|face| face / 40).collect();
/// let labelling = Labelling { labels: &labels, ..labelling };
/// let twice = write::labelled_gltf("ball", &file, &labelling, Materials::Own, None)?;
/// assert_eq!(parse(&twice, Format::Gltf)?.n_polygons, sphere.faces.len());
/// # Ok::<_, coseg_geometry::mesh::ParseError>(())
/// ```
///
/// # Errors
/// If the file cannot be read.
///
/// # Panics
/// If there is not one label per face.
pub fn labelled_gltf(
    name: &str,
    bytes: &[u8],
    labelling: &Labelling<'_>,
    materials: Materials,
    up: Option<[f64; 3]>,
) -> Result<Vec<u8>, ParseError> {
    let bytes = as_utf8(bytes);
    let (mesh, spans) = spans(&bytes)?;
    let (text, binary) = container(&bytes)?;
    let root: Value = serde_json::from_slice(text).map_err(|error| ParseError::Json {
        reason: error.to_string(),
    })?;
    let (document, encoded) = open(root, binary)?;
    let mut patch = Patch {
        document,
        labelling,
        painter: Painter::new(materials),
    };
    patch.add_scene();
    patch.split(&mesh, &spans);
    let scene = patch.document.root["scene"].as_u64().unwrap_or(0) as usize;
    let roots = std::mem::take(list(&mut patch.document.list("scenes")[scene], "nodes"));
    let roots = patch.document.upright(name, up, roots);
    patch.document.list("scenes")[scene]["nodes"] = roots.into();
    Ok(close(patch.document, encoded))
}

/// The file with a buffer that can grow: its binary chunk, or its first buffer as one. `true` if
/// there is none, so that a buffer is added, in the JSON.
fn open(mut root: Value, binary: Option<&[u8]>) -> Result<(Document, bool), ParseError> {
    let buffers = list(&mut root, "buffers");
    let declared = |buffer: &Value| buffer["byteLength"].as_f64().unwrap_or(0.0) as usize;
    let uri = buffers.first().and_then(|buffer| buffer["uri"].as_str());
    let (index, mut data, encoded) = match (uri, binary) {
        (Some(uri), None)
            if uri
                .get(..5)
                .is_some_and(|s| s.eq_ignore_ascii_case("data:")) =>
        {
            (0, data_uri(uri, "buffer 0")?, false)
        }
        (None, Some(binary)) => (0, binary.to_vec(), false),
        (None, None) if buffers.is_empty() => (0, Vec::new(), false),
        _ => (buffers.len(), Vec::new(), true),
    };
    match buffers.get_mut(index) {
        Some(buffer) => {
            data.truncate(declared(buffer));
            if let Some(buffer) = buffer.as_object_mut() {
                buffer.remove("uri");
            }
        }
        None => buffers.push(json!({})),
    }
    Ok((Document::new(root, index, data), encoded))
}

fn close(document: Document, encoded: bool) -> Vec<u8> {
    let Document {
        mut root,
        binary,
        buffer,
        ..
    } = document;
    root["buffers"][buffer]["byteLength"] = binary.len().into();
    if encoded {
        let text = BASE64.encode(&binary);
        root["buffers"][buffer]["uri"] =
            format!("data:application/octet-stream;base64,{text}").into();
        return glb_of(root.to_string(), Vec::new());
    }
    glb_of(root.to_string(), binary)
}

struct Patch<'a> {
    document: Document,
    labelling: &'a Labelling<'a>,
    painter: Painter,
}

/// The triangles of one part instance that come from one span.
struct Piece<'a> {
    span: &'a Span,
    indices: Vec<u32>,
    members: Vec<u32>,
}

impl Patch<'_> {
    /// A file without a scene gets one of all it has, as it is read. Without nodes, the node of a
    /// mesh has its index.
    fn add_scene(&mut self) {
        if !self.document.list("scenes").is_empty() {
            return;
        }
        if self.document.list("nodes").is_empty() {
            for index in 0..self.document.list("meshes").len() {
                let mut node = json!({ "mesh": index });
                if let Some(name) = self.document.list("meshes")[index].get("name") {
                    node["name"] = name.clone();
                }
                self.document.push("nodes", node);
            }
        }
        let nodes = self.document.list("nodes").iter();
        let children = nodes.filter_map(|node| node["children"].as_array());
        let children: BTreeSet<usize> = children.flatten().filter_map(index).collect();
        let n_nodes = self.document.list("nodes").len();
        let roots: Vec<usize> = (0..n_nodes).filter(|n| !children.contains(n)).collect();
        self.document.push("scenes", json!({ "nodes": roots }));
        self.document.root["scene"] = 0.into();
    }

    fn split(&mut self, mesh: &ParsedMesh, spans: &[Span]) {
        let node_of = |span: &Span| span.node.unwrap_or(span.mesh);
        let mut objects = vec![0; mesh.n_polygons];
        for span in spans {
            objects[span.polygons.clone()].fill(node_of(span) as u32);
        }
        // Each triangle is a polygon.
        let found = instances(
            &mesh.vertices,
            &mesh.triangles,
            self.labelling.labels,
            &objects,
        );
        let names = self.labelling.names(str::to_owned);
        // Their places are taken by what becomes of them.
        let wholes = self.document.list("meshes").clone();
        let mut free = self.free_meshes(spans.iter().map(|span| (node_of(span), span.mesh)));
        for of_node in spans.chunk_by(|a, b| node_of(a) == node_of(b)) {
            let (node, old) = (node_of(&of_node[0]), of_node[0].mesh);
            let mut pieces: BTreeMap<u32, Vec<Piece<'_>>> = BTreeMap::new();
            for span in of_node {
                let mut of_span: BTreeMap<u32, Piece<'_>> = BTreeMap::new();
                for polygon in span.polygons.clone() {
                    let piece = of_span.entry(found.of_polygon[polygon]).or_insert(Piece {
                        span,
                        indices: Vec::new(),
                        members: Vec::new(),
                    });
                    let [a, b, c] = mesh.triangles[polygon].map(|v| v - span.first_vertex);
                    piece
                        .indices
                        .extend(if span.mirrored { [a, c, b] } else { [a, b, c] });
                    piece.members.push(polygon as u32);
                }
                for (instance, piece) in of_span {
                    pieces.entry(instance).or_default().push(piece);
                }
            }
            let whole = &wholes[old];
            let taken: BTreeSet<usize> = of_node.iter().map(|span| span.primitive).collect();
            let rest = self.rest(whole, &taken);
            let mut place = |document: &mut Document, mesh: Value| match free.remove(&old) {
                true => {
                    document.list("meshes")[old] = mesh;
                    old
                }
                false => document.push("meshes", mesh),
            };
            let rest = rest.map(|rest| place(&mut self.document, rest));
            let mut children = Vec::new();
            for (instance, pieces) in pieces {
                let (label, number) = (
                    found.labels[instance as usize],
                    found.numbers[instance as usize],
                );
                let mesh = self.mesh(whole, label, &pieces);
                let mesh = place(&mut self.document, mesh);
                let called = format!("{}.{number:03}", names[&label]);
                let extras = part(&names[&label], label, number);
                children.push(json!({ "name": called, "mesh": mesh, "extras": extras }));
            }
            self.hang(node, rest, children);
        }
    }

    /// Meshes that only nodes of the scene have, which need them no more.
    fn free_meshes(&mut self, placed: impl Iterator<Item = (usize, usize)>) -> BTreeSet<usize> {
        let (mut nodes, mut meshes) = (BTreeSet::new(), BTreeSet::new());
        for (node, mesh) in placed {
            nodes.insert(node);
            meshes.insert(mesh);
        }
        for (i, node) in self.document.list("nodes").iter().enumerate() {
            if let Some(mesh) = index(&node["mesh"]).filter(|_| !nodes.contains(&i)) {
                meshes.remove(&mesh);
            }
        }
        meshes
    }

    /// The mesh with the primitives that have no triangles, if there are any.
    fn rest(&self, whole: &Value, taken: &BTreeSet<usize>) -> Option<Value> {
        let primitives = whole["primitives"].as_array()?.iter().enumerate();
        let left = primitives.filter(|(i, _)| !taken.contains(i));
        let left: Vec<Value> = left.map(|(_, primitive)| primitive.clone()).collect();
        let mut rest = whole.clone();
        let any = !left.is_empty();
        rest["primitives"] = left.into();
        any.then_some(rest)
    }

    /// The mesh of one part instance.
    fn mesh(&mut self, whole: &Value, label: i32, pieces: &[Piece<'_>]) -> Value {
        let mut mesh = whole.clone();
        forget(&mut mesh, &OF_WHOLES);
        let primitives = pieces.iter().map(|piece| {
            let mut primitive = whole["primitives"][piece.span.primitive].clone();
            forget(&mut primitive, &OF_WHOLES);
            primitive["indices"] = self.document.indices(&piece.indices).into();
            if let Some(primitive) = primitive.as_object_mut() {
                primitive.remove("mode");
            }
            let extras = &mut primitive["extras"];
            if !extras.is_object() {
                *extras = match extras.take() {
                    Value::Null => json!({}),
                    other => json!({ "extras": other }),
                };
            }
            if let Value::Object(added) = polygons(label, &piece.members) {
                added
                    .into_iter()
                    .for_each(|(key, value)| extras[key.as_str()] = value);
            }
            let labelling = self.labelling;
            self.painter
                .paint(&mut self.document, &mut primitive, (label, labelling));
            primitive
        });
        let primitives: Vec<Value> = primitives.collect();
        mesh["primitives"] = primitives.into();
        mesh
    }

    /// Hangs part instances below the node whose mesh they were.
    fn hang(&mut self, node: usize, rest: Option<usize>, mut children: Vec<Value>) {
        let parent = &mut self.document.list("nodes")[node];
        if let Some(instancing) = parent["extensions"].get(INSTANCING) {
            for child in &mut children {
                child["extensions"] = json!({ INSTANCING: instancing });
            }
        }
        if rest.is_none() {
            forget(parent, &[INSTANCING]);
        }
        // What belongs to a mesh goes with it; a rest needs it as well.
        for key in ["skin", "weights"] {
            if let Some(value) = parent.get(key).cloned() {
                children
                    .iter_mut()
                    .for_each(|child| child[key] = value.clone());
            }
        }
        if let Some(parent) = parent.as_object_mut() {
            parent.remove("mesh");
            if rest.is_none() {
                parent.remove("skin");
                parent.remove("weights");
            }
        }
        if let Some(rest) = rest {
            parent["mesh"] = rest.into();
        }
        let first = self.document.list("nodes").len();
        let added = first..first + children.len();
        self.document.list("nodes").extend(children);
        let below = list(&mut self.document.list("nodes")[node], "children");
        below.extend(added.clone().map(Value::from));
        self.animate(node, rest.is_some(), added);
    }

    /// Lets channels that morph a node's mesh morph those of its part instances.
    fn animate(&mut self, node: usize, keeps: bool, parts: std::ops::Range<usize>) {
        let animations = self.document.root.get_mut("animations");
        for animation in animations
            .and_then(Value::as_array_mut)
            .into_iter()
            .flatten()
        {
            let channels = animation.get_mut("channels").and_then(Value::as_array_mut);
            let Some(channels) = channels else { continue };
            let morphs = |channel: &Value| {
                let target = &channel["target"];
                index(&target["node"]) == Some(node) && target["path"] == "weights"
            };
            let found: Vec<Value> = channels.iter().filter(|c| morphs(c)).cloned().collect();
            if !keeps {
                channels.retain(|channel| !morphs(channel));
            }
            for channel in found {
                channels.extend(parts.clone().map(|part| {
                    let mut channel = channel.clone();
                    channel["target"]["node"] = part.into();
                    channel
                }));
            }
        }
    }
}

/// An index, which may be written as `3.0`.
pub(super) fn index(value: &Value) -> Option<usize> {
    let number = value.as_f64()?;
    (number >= 0.0 && number.fract() == 0.0).then_some(number as usize)
}

/// Removes extensions of an entry.
fn forget(entry: &mut Value, names: &[&str]) {
    let Some(extensions) = entry.get_mut("extensions").and_then(Value::as_object_mut) else {
        return;
    };
    names.iter().for_each(|name| drop(extensions.remove(*name)));
    if extensions.is_empty()
        && let Some(entry) = entry.as_object_mut()
    {
        entry.remove("extensions");
    }
}

#[cfg(test)]
mod tests;
