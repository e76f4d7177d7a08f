//! Writes labelled polygons as a binary glTF 2.0 file: a node for each part instance, and a
//! material for each label.
//!
//! Triangles are grouped by part instance; each primitive lists its polygons of the input in its
//! `extras`, as first and count of each run of consecutive ones. The triangles of a polygon are
//! those of [`Triangulator`], on which its label was computed.

use super::Labelling;
use super::labelling::runs;
use crate::mesh::{Triangulator, instances};
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};

/// Sizes beyond which single precision would overflow or lose digits.
const MIN_SIZE: f64 = 1e-30;
const MAX_SIZE: f64 = 1e30;

/// Positions in single precision, and their inverse transform: a translation and a factor.
pub(super) struct Placed {
    pub(super) positions: Vec<[f32; 3]>,
    translation: [f64; 3],
    factor: f64,
}

/// Moves a mesh whose coordinates are not exact in single precision to the origin, where most
/// digits survive. Positions that are not finite, which no polygon uses, become 0.
pub(super) fn place(vertices: &[[f64; 3]]) -> Placed {
    let finite = || vertices.iter().filter(|v| v.iter().all(|x| x.is_finite()));
    let exact = finite().flatten().all(|&x| f64::from(x as f32) == x);
    let (mut translation, mut factor) = ([0.0; 3], 1.0);
    if !exact {
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for v in finite() {
            low = std::array::from_fn(|i| low[i].min(v[i]));
            high = std::array::from_fn(|i| high[i].max(v[i]));
        }
        translation = std::array::from_fn(|i| low[i] + 0.5 * (high[i] - low[i]));
        let size = (0..3).fold(0.0, |s: f64, i| s.max(high[i] - low[i]));
        if size > 0.0 && !(MIN_SIZE..=MAX_SIZE).contains(&size) {
            factor = size;
        }
    }
    let position = |v: &[f64; 3]| -> [f32; 3] {
        let p: [f32; 3] = std::array::from_fn(|i| ((v[i] - translation[i]) / factor) as f32);
        if p.iter().all(|x| x.is_finite()) {
            p
        } else {
            [0.0; 3]
        }
    };
    Placed {
        positions: vertices.iter().map(position).collect(),
        translation,
        factor,
    }
}

/// An sRGB component as linear light, which glTF and USD require.
pub(super) fn linear(c: u8) -> f64 {
    to_linear(f64::from(c) / 255.0)
}

/// Linear light of 0 to 1 as an sRGB component.
pub(super) fn to_srgb(x: f64) -> f64 {
    if x <= 0.003_130_8 {
        12.92 * x
    } else {
        1.055 * x.powf(1.0 / 2.4) - 0.055
    }
}

/// An sRGB component of 0 to 1 as linear light.
pub(super) fn to_linear(x: f64) -> f64 {
    if x <= 0.04045 {
        x / 12.92
    } else {
        ((x + 0.055) / 1.055).powf(2.4)
    }
}

/// The rotation from a coordinate axis to +Y, which is up in glTF, as x, y, z, w.
fn rotation(up: [f64; 3]) -> [f64; 4] {
    use std::f64::consts::FRAC_1_SQRT_2 as H;
    match up.map(|x| x as i8) {
        [1, 0, 0] => [0.0, 0.0, H, H],
        [-1, 0, 0] => [0.0, 0.0, -H, H],
        [0, -1, 0] => [1.0, 0.0, 0.0, 0.0],
        [0, 0, 1] => [-H, 0.0, 0.0, H],
        [0, 0, -1] => [H, 0.0, 0.0, H],
        _ => [0.0, 0.0, 0.0, 1.0],
    }
}

/// The JSON of a glTF file that entries are added to, and the bytes of one of its buffers.
pub(super) struct Document {
    pub(super) root: Value,
    /// Bytes of the buffer that additions go to.
    pub(super) binary: Vec<u8>,
    /// Index of that buffer.
    pub(super) buffer: usize,
    materials: BTreeMap<i32, usize>,
}

impl Document {
    pub(super) fn new(root: Value, buffer: usize, binary: Vec<u8>) -> Self {
        let materials = BTreeMap::new();
        Self {
            root,
            binary,
            buffer,
            materials,
        }
    }

    /// A list of the root, created if it is missing.
    pub(super) fn list(&mut self, name: &str) -> &mut Vec<Value> {
        list(&mut self.root, name)
    }

    /// Adds an entry to a list of the root, and returns its index.
    pub(super) fn push(&mut self, name: &str, entry: Value) -> usize {
        let list = self.list(name);
        list.push(entry);
        list.len() - 1
    }

    /// Adds a view of bytes, and returns its index.
    fn view(&mut self, bytes: impl IntoIterator<Item = u8>, target: u32) -> usize {
        self.binary.resize(self.binary.len().next_multiple_of(4), 0);
        let start = self.binary.len();
        self.binary.extend(bytes);
        let (buffer, length) = (self.buffer, self.binary.len() - start);
        let view = json!({
            "buffer": buffer, "byteOffset": start, "byteLength": length, "target": target,
        });
        self.push("bufferViews", view)
    }

    /// Adds an accessor of vertex indices, and returns its index.
    pub(super) fn indices(&mut self, indices: &[u32]) -> usize {
        const ELEMENT_ARRAY_BUFFER: u32 = 34963;
        let bytes = indices.iter().flat_map(|v| v.to_le_bytes());
        let view = self.view(bytes, ELEMENT_ARRAY_BUFFER);
        let accessor = json!({
            "bufferView": view, "componentType": 5125, "count": indices.len(), "type": "SCALAR",
        });
        self.push("accessors", accessor)
    }

    /// Adds an accessor of values at vertices, and returns its index.
    pub(super) fn attribute<const N: usize>(&mut self, values: &[[f32; N]]) -> usize {
        const ARRAY_BUFFER: u32 = 34962;
        let (mut low, mut high) = ([f32::INFINITY; N], [f32::NEG_INFINITY; N]);
        for p in values {
            low = std::array::from_fn(|i| low[i].min(p[i]));
            high = std::array::from_fn(|i| high[i].max(p[i]));
        }
        let bytes = values.iter().flatten().flat_map(|x| x.to_le_bytes());
        let view = self.view(bytes, ARRAY_BUFFER);
        let accessor = json!({
            "bufferView": view, "componentType": 5126, "count": values.len(),
            "type": format!("VEC{N}"), "min": low.as_slice(), "max": high.as_slice(),
        });
        self.push("accessors", accessor)
    }

    /// The index of the material of a label, which is added at its first use.
    pub(super) fn material(&mut self, label: i32, labelling: &Labelling<'_>) -> usize {
        if let Some(found) = self.materials.get(&label) {
            return *found;
        }
        let style = labelling.style(label);
        let [r, g, b] = style.colour.map(linear);
        let material = json!({
            "name": style.name,
            "doubleSided": true,
            "pbrMetallicRoughness":
            {
                "baseColorFactor": [r, g, b, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.8,
            },
        });
        let index = self.push("materials", material);
        self.materials.insert(label, index);
        index
    }

    /// Puts a node that turns `up` to +Y around nodes of a scene, unless it is that already.
    pub(super) fn upright(
        &mut self,
        name: &str,
        up: Option<[f64; 3]>,
        nodes: Vec<Value>,
    ) -> Vec<Value> {
        let Some(up) = up.filter(|up| *up != [0.0, 1.0, 0.0]) else {
            return nodes;
        };
        let name = format!("{name} upright");
        let node = json!({ "name": name, "rotation": rotation(up), "children": nodes });
        vec![self.push("nodes", node).into()]
    }
}

/// A field of an object, null if it is missing. A value that is no object is replaced by one: files
/// may hold any JSON where only some programs look.
pub(super) fn field<'a>(object: &'a mut Value, name: &str) -> &'a mut Value {
    if !object.is_object() {
        *object = json!({});
    }
    &mut object[name]
}

/// A list in an object, created if it is missing.
pub(super) fn list<'a>(object: &'a mut Value, name: &str) -> &'a mut Vec<Value> {
    let list = field(object, name);
    if !list.is_array() {
        *list = json!([]);
    }
    match list {
        Value::Array(list) => list,
        _ => unreachable!("invariant: it was made an array"),
    }
}

/// The `extras` of the node of a part instance.
pub(super) fn part(name: &str, label: i32, number: u32) -> Value {
    json!({ "label": label, "label_name": name, "instance": number })
}

/// The `extras` of a primitive: the label of its triangles, and their polygons of the input.
pub(super) fn polygons(label: i32, members: &[u32]) -> Value {
    let runs: Vec<usize> = runs(members)
        .flat_map(|(first, count)| [first as usize, count])
        .collect();
    json!({ "label": label, "polygons": runs })
}

/// A binary glTF file of one mesh, called `name`, with a node for each part instance below its own.
/// If the coordinate axis `up` is not +Y, a node around the mesh turns it there.
///
/// ```
/// use coseg_geometry::mesh::write::{self, Labelling};
/// use coseg_geometry::mesh::{Format, icosphere, parse};
///
/// let sphere = icosphere(1);
/// let (labels, styles) = (vec![0; sphere.faces.len()], Default::default());
/// let labelling = Labelling { labels: &labels, confidence: None, styles: &styles };
/// let file = write::glb("ball", &sphere.vertices, &sphere.faces, &labelling, None);
/// assert_eq!(parse(&file, Format::Gltf)?.n_polygons, sphere.faces.len());
/// # Ok::<_, coseg_geometry::mesh::ParseError>(())
/// ```
///
/// # Panics
/// If there is not one label per polygon, or a polygon has no corners.
pub fn glb<P: AsRef<[u32]>>(
    name: &str,
    vertices: &[[f64; 3]],
    polygons: &[P],
    labelling: &Labelling<'_>,
    up: Option<[f64; 3]>,
) -> Vec<u8> {
    let found = instances(
        vertices,
        polygons,
        labelling.labels,
        &vec![0; polygons.len()],
    );
    let names = labelling.names(str::to_owned);
    let placed = place(vertices);
    let mut document = new_document();
    let mut members: Vec<Vec<u32>> = vec![Vec::new(); found.labels.len()];
    for (polygon, &instance) in (0..).zip(&found.of_polygon) {
        members[instance as usize].push(polygon);
    }
    let mut triangulator = Triangulator::default();
    let mut parts = Vec::new();
    for ((&label, &number), members) in found.labels.iter().zip(&found.numbers).zip(&members) {
        let mut triangles: Vec<u32> = Vec::new();
        for &polygon in members {
            let corners = polygons[polygon as usize].as_ref();
            triangulator.triangulate(vertices, corners, |t| triangles.extend(t));
        }
        let used: BTreeSet<u32> = triangles.iter().copied().collect();
        let local: BTreeMap<u32, u32> = used.iter().copied().zip(0..).collect();
        let positions: Vec<[f32; 3]> = used.iter().map(|&v| placed.positions[v as usize]).collect();
        let indices: Vec<u32> = triangles.iter().map(|v| local[v]).collect();
        let positions = document.attribute(&positions);
        let indices = document.indices(&indices);
        let material = document.material(label, labelling);
        let primitive = json!({
            "attributes": { "POSITION": positions }, "indices": indices, "material": material,
            "extras": self::polygons(label, members),
        });
        let called = format!("{}.{number:03}", names[&label]);
        let mesh = document.push(
            "meshes",
            json!({ "name": called, "primitives": [primitive] }),
        );
        let extras = part(&names[&label], label, number);
        let node = json!({ "name": called, "mesh": mesh, "extras": extras });
        parts.push(Value::from(document.push("nodes", node)));
    }
    finish(document, name, &placed, up, parts)
}

/// The document of a file with nothing in it.
pub(super) fn new_document() -> Document {
    let root =
        json!({ "asset": { "version": "2.0", "generator": "coseg" }, "buffers": [{}], "scene": 0 });
    Document::new(root, 0, Vec::new())
}

/// The file of a document with a scene of one node, called `name`, which takes its children to
/// their place.
pub(super) fn finish(
    mut document: Document,
    name: &str,
    placed: &Placed,
    up: Option<[f64; 3]>,
    children: Vec<Value>,
) -> Vec<u8> {
    let mut node = json!({ "name": name, "children": children });
    if placed.translation != [0.0; 3] {
        node["translation"] = json!(placed.translation);
    }
    if placed.factor != 1.0 {
        node["scale"] = vec![placed.factor; 3].into();
    }
    let node = document.push("nodes", node);
    let nodes = document.upright(name, up, vec![node.into()]);
    document.push("scenes", json!({ "nodes": nodes }));
    document.root["buffers"][0]["byteLength"] = document.binary.len().into();
    glb_of(document.root.to_string(), document.binary)
}

/// A file of a JSON and a binary chunk, each padded to four bytes.
///
/// ```
/// let json = "{\"asset\":{\"version\":\"2.0\"}}".to_string();
/// let file = coseg_geometry::mesh::write::glb_of(json, vec![1, 2, 3]);
/// assert!(file.starts_with(b"glTF"));
/// // The header says how long the file is.
/// assert_eq!(file[8..12], (file.len() as u32).to_le_bytes());
/// ```
pub fn glb_of(mut json: String, mut binary: Vec<u8>) -> Vec<u8> {
    binary.resize(binary.len().next_multiple_of(4), 0);
    while !json.len().is_multiple_of(4) {
        json.push(' ');
    }
    // A chunk of data without any would be an error.
    let data = if binary.is_empty() {
        0
    } else {
        8 + binary.len()
    };
    let length = 12 + 8 + json.len() + data;
    let mut out = Vec::with_capacity(length);
    out.extend_from_slice(b"glTF");
    for word in [2, length, json.len()] {
        out.extend_from_slice(&(word as u32).to_le_bytes());
    }
    out.extend_from_slice(b"JSON");
    out.extend_from_slice(json.as_bytes());
    if data > 0 {
        out.extend_from_slice(&(binary.len() as u32).to_le_bytes());
        out.extend_from_slice(b"BIN\0");
        out.extend_from_slice(&binary);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::{LabelStyle, Labelling};
    use super::glb;
    use crate::mesh::parse::gltf::container;
    use crate::mesh::{Format, cross, dot, parse};
    use std::collections::BTreeMap;

    fn labelling<'a>(labels: &'a [i32], styles: &'a BTreeMap<i32, LabelStyle>) -> Labelling<'a> {
        Labelling {
            labels,
            confidence: None,
            styles,
        }
    }

    #[test]
    fn there_is_a_node_for_each_part_instance_and_the_runs_say_which_polygons_it_has() {
        let vertices = [
            [0.0; 3],
            [1.0, 0.0, 0.0],
            [1.0, 1.0, 0.0],
            [0.0, 1.0, 0.5],
            [5.0, 0.0, 0.0],
        ];
        let polygons = [
            vec![0, 1, 2, 3],
            vec![0, 1, 2],
            vec![1, 2, 3],
            vec![3, 2, 1],
            vec![4, 4, 4],
        ];
        let seat = LabelStyle {
            name: "seat \"7\"".to_owned(),
            colour: [255, 128, 0],
        };
        let styles = [(7, seat)].into();
        let labels = [7, -1, 7, 7, 9];
        let bytes = glb(
            "a",
            &vertices,
            &polygons,
            &labelling(&labels, &styles),
            None,
        );
        assert_eq!(bytes.len() % 4, 0);
        let mesh = parse(&bytes, Format::Gltf).unwrap();
        let at = |t: &[u32; 3]| t.map(|v| mesh.vertices[v as usize]);
        let expected = [
            [0, 1, 2],
            [0, 1, 2],
            [0, 2, 3],
            [1, 2, 3],
            [3, 2, 1],
            [4; 3],
        ];
        let expected = expected.map(|t| t.map(|v| vertices[v]));
        assert!(mesh.triangles.iter().map(at).eq(expected));
        let (json, _) = container(&bytes).unwrap();
        let root: serde_json::Value = serde_json::from_slice(json).unwrap();
        let nodes = root["nodes"].as_array().unwrap();
        let names: Vec<&str> = nodes.iter().map(|n| n["name"].as_str().unwrap()).collect();
        assert_eq!(
            names,
            ["unlabelled.001", "seat \"7\".001", "label_9.001", "a"]
        );
        let extras = &nodes[1]["extras"];
        assert_eq!(
            (&extras["label"], &extras["instance"]),
            (&7.into(), &1.into())
        );
        let primitive = &root["meshes"][1]["primitives"][0];
        assert_eq!(
            primitive["extras"]["polygons"],
            serde_json::json!([0, 1, 2, 2])
        );
        assert_eq!(root["materials"][1]["name"], "seat \"7\"");
    }

    #[test]
    fn whatever_axis_is_up_becomes_the_second() {
        for k in 0..3 {
            for sign in [1.0, -1.0] {
                let mut up = [0.0; 3];
                up[k] = sign;
                // The axis itself, and a triangle that distinguishes turning from mirroring.
                let vertices = [up, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
                let styles = BTreeMap::new();
                let polygons = [vec![1, 2, 3], vec![0]];
                let bytes = glb(
                    "a",
                    &vertices,
                    &polygons,
                    &labelling(&[0, 1], &styles),
                    Some(up),
                );
                let found = parse(&bytes, Format::Gltf).unwrap().vertices;
                let close = |a: f64, b: f64| (a - b).abs() < 1e-12;
                assert!(close(found[3][1], 1.0), "{up:?}: {:?}", found[3]);
                let [a, b, c] = [0, 1, 2].map(|v| found[v]);
                assert!(close(dot(a, cross(b, c)), 1.0), "{up:?} is mirrored");
                let has_node = String::from_utf8_lossy(&bytes).contains("\"rotation\"");
                assert_eq!(has_node, up != [0.0, 1.0, 0.0]);
            }
        }
    }

    #[test]
    fn digits_survive_far_from_the_origin_and_at_absurd_sizes() {
        for (offset, size) in [(500_000.125, 0.001), (0.0, 1e100), (1e-90, 1e-100)] {
            let at = |x: f64, y: f64| [offset + x * size, offset + y * size, offset];
            let vertices = [at(0.1, 0.2), at(1.3, 0.0), at(0.7, 1.1), [f64::NAN; 3]];
            let styles = BTreeMap::new();
            let bytes = glb(
                "a",
                &vertices,
                &[[0, 1, 2]],
                &labelling(&[0], &styles),
                None,
            );
            let mesh = parse(&bytes, Format::Gltf).unwrap();
            for (found, wanted) in mesh.vertices.iter().zip(&vertices).take(3) {
                for i in 0..3 {
                    assert!(
                        (found[i] - wanted[i]).abs() <= 1e-6 * size,
                        "{found:?} {wanted:?}"
                    );
                }
            }
        }
    }
}
