//! Writes an OBJ file as a binary glTF 2.0 file with what the OBJ says of its surface.
//!
//! Objects become nodes, and their part instances nodes below them; texture coordinates and normals
//! become attributes, and so do colours of vertices (`v x y z r g b`). An OBJ only names its
//! materials, which are in another file. So each material of a part is a primitive that names it in
//! its `extras` and has the material of the label, or one that shows the colours of vertices.

use super::attributes::colours_of_obj;
use super::glb::{Document, Placed, finish, new_document, part, place, polygons, to_linear};
use super::obj::Statements;
use super::paint::Painter;
use super::{Labelling, Materials};
use crate::mesh::parse::text::words;
use crate::mesh::parse::{as_utf8, obj as reader};
use crate::mesh::{Format, ParseError, Triangulator, instances, parse};
use serde_json::{Value, json};
use std::collections::{BTreeMap, HashMap};

/// A corner of a face: its position, and its texture coordinates and normal if it has them.
pub(super) type Corner = (u32, Option<u32>, Option<u32>);

/// A binary glTF file of an OBJ file, called `name`, with a node for each of its objects and, below
/// it, for each part instance. If the coordinate axis `up` is not +Y, a node around them turns it
/// there. A file with colours of vertices shows them for [`Materials::Own`], with the materials of
/// the labels in a variant `labels` (`KHR_materials_variants`); otherwise parts show their labels.
///
/// ```
/// use coseg_geometry::mesh::write::{self, Labelling, Materials};
/// use coseg_geometry::mesh::{Format, parse};
///
/// let file = b"o box\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl wood\nf 1/1 2/1 3/1\n";
/// let styles = Default::default();
/// let labelling = Labelling { labels: &[2], confidence: None, styles: &styles };
/// let found = write::glb_of_obj("a", file, &labelling, Materials::Own, None)?;
/// assert_eq!(parse(&found, Format::Gltf)?.n_polygons, 1);
/// let text = String::from_utf8_lossy(&found);
/// assert!(["TEXCOORD_0", "\"box\"", "\"wood\""].iter().all(|part| text.contains(part)));
/// # Ok::<_, coseg_geometry::mesh::ParseError>(())
/// ```
///
/// # Errors
/// If the file cannot be read.
///
/// # Panics
/// If there is not one label per face.
pub fn glb_of_obj(
    name: &str,
    bytes: &[u8],
    labelling: &Labelling<'_>,
    materials: Materials,
    up: Option<[f64; 3]>,
) -> Result<Vec<u8>, ParseError> {
    let bytes = as_utf8(bytes);
    let mesh = parse(&bytes, Format::Obj)?;
    let (vertices, faces) = (&mesh.vertices, mesh.polygons());
    let statements = Statements::of(&bytes)?;
    let tables = Tables::of(&statements.kept)?;
    let objects = statements.objects();
    let found = instances(vertices, &faces, labelling.labels, &objects.of_faces);
    let mut parts: Vec<BTreeMap<&[u8], Primitive>> = vec![BTreeMap::new(); found.labels.len()];
    let mut object_of = vec![0; found.labels.len()];
    let mut triangulator = Triangulator::default();
    for (face, polygon) in faces.iter().enumerate() {
        let (element, state) = &statements.faces[face];
        let instance = found.of_polygon[face] as usize;
        object_of[instance] = objects.of_faces[face];
        let material = objects.states[*state as usize].material.as_slice();
        let primitive = parts[instance].entry(material).or_default();
        primitive.members.push(face as u32);
        let corners = tables.corners(element, polygon);
        let positions: Vec<[f64; 3]> = polygon.iter().map(|&v| vertices[v as usize]).collect();
        let ring: Vec<u32> = (0..polygon.len() as u32).collect();
        triangulator.triangulate(&positions, &ring, |triangle| {
            for corner in triangle {
                primitive.push(corners[corner as usize]);
            }
        });
    }
    let names = labelling.names(str::to_owned);
    let (mut document, placed) = (new_document(), place(vertices));
    let mut painter = Painter::new(materials);
    // The colour of a material is multiplied with those of the vertices.
    let is_coloured = !tables.colours.is_empty() && materials == Materials::Own;
    let white = is_coloured.then(|| {
        let shading = json!({ "metallicFactor": 0.0, "roughnessFactor": 0.8 });
        let white = json!({ "name": "vertex colours", "doubleSided": true,
            "pbrMetallicRoughness": shading });
        document.push("materials", white)
    });
    let mut of_objects: BTreeMap<u32, Vec<Value>> = BTreeMap::new();
    for (instance, primitives) in parts.iter().enumerate() {
        let (label, number) = (found.labels[instance], found.numbers[instance]);
        let primitives: Vec<Value> = primitives
            .iter()
            .map(|(material, primitive)| {
                let of = (label, materials);
                let mut primitive = primitive.write(&mut document, &tables, &placed, of);
                if let Some(white) = white {
                    primitive["material"] = white.into();
                }
                painter.paint(&mut document, &mut primitive, (label, labelling));
                if !material.is_empty() {
                    primitive["extras"]["material"] = String::from_utf8_lossy(material).into();
                }
                primitive
            })
            .collect();
        let called = format!("{}.{number:03}", names[&label]);
        let mesh = json!({ "name": called, "primitives": primitives });
        let mesh = document.push("meshes", mesh);
        let extras = part(&names[&label], label, number);
        let node = json!({ "name": called, "mesh": mesh, "extras": extras });
        let node = document.push("nodes", node);
        let siblings = of_objects.entry(object_of[instance]).or_default();
        siblings.push(node.into());
    }
    let mut children = Vec::new();
    for (object, parts) in of_objects {
        let called = String::from_utf8_lossy(&objects.names[object as usize]);
        if called.is_empty() {
            children.extend(parts);
        } else {
            let node = json!({ "name": called, "children": parts });
            children.push(document.push("nodes", node).into());
        }
    }
    Ok(finish(document, name, &placed, up, children))
}

/// Texture coordinates and normals of a file, as glTF has them.
#[derive(Default)]
pub(super) struct Tables {
    pub(super) texture: Vec<[f32; 2]>,
    /// None where a normal has no direction.
    pub(super) normals: Vec<Option<[f32; 3]>>,
    /// sRGB, for each vertex of the file; empty without any.
    pub(super) colours: Vec<[f32; 3]>,
}

impl Tables {
    pub(super) fn of(bytes: &[u8]) -> Result<Self, ParseError> {
        let mut found = Self {
            colours: colours_of_obj(bytes)?,
            ..Self::default()
        };
        reader::statements(bytes, |statement, _, _| {
            let mut words = words(statement);
            match words.next() {
                Some(b"vt") => {
                    // glTF counts from the top of an image, OBJ from its bottom.
                    let [u, v] = numbers(words);
                    found.texture.push([u as f32, (1.0 - v) as f32]);
                }
                Some(b"vn") => {
                    let normal: [f64; 3] = numbers(words);
                    let length = crate::mesh::norm(normal);
                    let unit = normal.map(|x| (x / length) as f32);
                    let has_direction = unit.iter().all(|x| x.is_finite());
                    found.normals.push(has_direction.then_some(unit));
                }
                _ => {}
            }
            Ok(())
        })?;
        Ok(found)
    }

    /// The corners of a face; texture coordinates and normals that the file lacks are none.
    pub(super) fn corners(&self, element: &[u8], polygon: &[u32]) -> Vec<Corner> {
        let words = words(element).skip(1).zip(polygon);
        words
            .map(|(word, &vertex)| {
                let mut indices = word.split(|&b| b == b'/').skip(1).map(|index| {
                    let index: u32 = std::str::from_utf8(index).ok()?.parse().ok()?;
                    index.checked_sub(1)
                });
                let texture = indices.next().flatten();
                let normal = indices.next().flatten();
                let is_normal = |i: &u32| matches!(self.normals.get(*i as usize), Some(Some(_)));
                (
                    vertex,
                    texture.filter(|&i| (i as usize) < self.texture.len()),
                    normal.filter(is_normal),
                )
            })
            .collect()
    }
}

/// The first numbers of a statement; 0 for those that are missing or none.
fn numbers<'a, const N: usize>(words: impl Iterator<Item = &'a [u8]>) -> [f64; N] {
    let mut found = [0.0; N];
    for (number, word) in found.iter_mut().zip(words) {
        let value = std::str::from_utf8(word).ok().and_then(|w| w.parse().ok());
        *number = value.filter(|x: &f64| x.is_finite()).unwrap_or(0.0);
    }
    found
}

/// The faces of one material in a part instance.
#[derive(Clone, Default)]
struct Primitive {
    /// Vertices of the primitive, by index.
    vertices: Vec<Corner>,
    index_of: HashMap<Corner, u32>,
    indices: Vec<u32>,
    members: Vec<u32>,
}

impl Primitive {
    fn push(&mut self, corner: Corner) {
        let next = self.vertices.len() as u32;
        let index = *self.index_of.entry(corner).or_insert(next);
        if index == next {
            self.vertices.push(corner);
        }
        self.indices.push(index);
    }

    /// Adds attributes and indices. Normals are there if all corners have one; texture coordinates
    /// if any has, and those of others are 0; colours if any vertex of the file has one.
    fn write(
        &self,
        document: &mut Document,
        tables: &Tables,
        placed: &Placed,
        (label, materials): (i32, Materials),
    ) -> Value {
        let corners = || self.vertices.iter();
        let positions: Vec<[f32; 3]> = corners().map(|c| placed.positions[c.0 as usize]).collect();
        let mut attributes = json!({ "POSITION": document.attribute(&positions) });
        let normals = corners().map(|c| tables.normals[c.2? as usize]);
        if let Some(normals) = normals.collect::<Option<Vec<[f32; 3]>>>() {
            attributes["NORMAL"] = document.attribute(&normals).into();
        }
        if corners().any(|c| c.1.is_some()) {
            let texture = |c: &Corner| c.1.map_or([0.0; 2], |i| tables.texture[i as usize]);
            let texture: Vec<[f32; 2]> = corners().map(texture).collect();
            attributes["TEXCOORD_0"] = document.attribute(&texture).into();
        }
        if !tables.colours.is_empty() && materials == Materials::Own {
            let colour = |c: &Corner| tables.colours[c.0 as usize];
            let light = |c: &Corner| colour(c).map(|x| to_linear(f64::from(x)) as f32);
            let colours: Vec<[f32; 3]> = corners().map(light).collect();
            attributes["COLOR_0"] = document.attribute(&colours).into();
        }
        let indices = document.indices(&self.indices);
        let extras = polygons(label, &self.members);
        json!({ "attributes": attributes, "indices": indices, "extras": extras })
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Labelling, Materials};
    use super::glb_of_obj;
    use crate::mesh::parse::gltf::container;
    use crate::mesh::{Format, parse};
    use serde_json::{Value, json};

    /// Two squares with a seam of texture coordinates between them, and one in another object.
    const FILE: &str = "o body\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 2 0 0\nv 2 1 0\n\
        vt 0 0\nvt 1 0\nvt 1 0.75\nvn 0 0 2\nvn 0 0 0\n\
        usemtl oak\nf 1/1/1 2/2/1 3/3/1 4/1/1\nusemtl pine\nf 2/1 5/2 6/3 3/1\n\
        o lid\nv 5 0 0\nv 6 0 0\nv 6 1 0\nf -3//2 -2//2 -1//2\n";

    fn labelled(labels: &[i32]) -> (Value, Vec<u8>) {
        let labelling = Labelling {
            labels,
            confidence: None,
            styles: &Default::default(),
        };
        let bytes = glb_of_obj("a", FILE.as_bytes(), &labelling, Materials::Own, None).unwrap();
        let (json, _) = container(&bytes).unwrap();
        (serde_json::from_slice(json).unwrap(), bytes)
    }

    #[test]
    fn objects_are_nodes_and_materials_primitives_of_their_parts() {
        let (root, bytes) = labelled(&[3, 3, 3]);
        let nodes = root["nodes"].as_array().unwrap();
        let names: Vec<&str> = nodes.iter().map(|n| n["name"].as_str().unwrap()).collect();
        let expected = ["label_3.001", "label_3.002", "body", "lid", "a"];
        assert_eq!(names, expected);
        assert_eq!(nodes[2]["children"], json!([0]));
        assert_eq!(nodes[4]["children"], json!([2, 3]));
        let extras: Vec<&Value> = root["meshes"][0]["primitives"]
            .as_array()
            .unwrap()
            .iter()
            .map(|primitive| &primitive["extras"])
            .collect();
        let oak = json!({ "label": 3, "polygons": [0, 1], "material": "oak" });
        let pine = json!({ "label": 3, "polygons": [1, 1], "material": "pine" });
        assert_eq!(extras, [&oak, &pine]);
        // The same triangles as those of the file, at the same places.
        let (found, file) = (
            parse(&bytes, Format::Gltf).unwrap(),
            parse(FILE.as_bytes(), Format::Obj).unwrap(),
        );
        let at = |mesh: &crate::mesh::ParsedMesh| -> Vec<[[f64; 3]; 3]> {
            let corners = |t: &[u32; 3]| t.map(|v| mesh.vertices[v as usize]);
            mesh.triangles.iter().map(corners).collect()
        };
        assert_eq!(at(&found), at(&file));
    }

    #[test]
    fn texture_coordinates_and_normals_become_attributes() {
        let (root, bytes) = labelled(&[3, 3, 3]);
        let (_, binary) = container(&bytes).unwrap();
        let values = |accessor: &Value| -> Vec<f32> {
            let accessor = &root["accessors"][accessor.as_u64().unwrap() as usize];
            let view = &root["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
            let start = view["byteOffset"].as_u64().unwrap() as usize;
            let end = start + view["byteLength"].as_u64().unwrap() as usize;
            let (chunks, _) = binary.unwrap()[start..end].as_chunks::<4>();
            chunks.iter().map(|&b| f32::from_le_bytes(b)).collect()
        };
        let [oak, pine] = [0, 1].map(|i| &root["meshes"][0]["primitives"][i]["attributes"]);
        let texture = [0.0, 1.0, 1.0, 1.0, 1.0, 0.25, 0.0, 1.0];
        assert_eq!(values(&oak["TEXCOORD_0"]), texture);
        assert_eq!(values(&oak["NORMAL"]), [0.0, 0.0, 1.0].repeat(4));
        assert_eq!(values(&pine["TEXCOORD_0"])[..2], [0.0, 1.0]);
        // None has normals, and those of the lid have no direction.
        let lid = &root["meshes"][1]["primitives"][0]["attributes"];
        for attributes in [pine, lid] {
            assert!(attributes["NORMAL"].is_null(), "{attributes}");
        }
        assert!(lid["TEXCOORD_0"].is_null());
        let accessor = &root["accessors"][oak["TEXCOORD_0"].as_u64().unwrap() as usize];
        assert_eq!(accessor["type"], "VEC2");
    }

    #[test]
    fn colours_of_vertices_become_an_attribute_in_linear_light() {
        const COLOURED: &str = "v 0 0 0 1 0 0.5\nv 1 0 0 0 1 0\nv 0 1 0\nf 1 2 3\n";
        let labelling = Labelling {
            labels: &[3],
            confidence: None,
            styles: &Default::default(),
        };
        let read = |text: &str, materials| {
            let bytes = glb_of_obj("a", text.as_bytes(), &labelling, materials, None).unwrap();
            let (json, binary) = container(&bytes).unwrap();
            let root: Value = serde_json::from_slice(json).unwrap();
            (root, binary.unwrap().to_vec())
        };
        // Of 0 to 1, and of 0 to 255.
        let bytes = COLOURED.replace("1 0 0.5\n", "255 0 127.5\n");
        let bytes = bytes.replace("0 1 0\nv", "0 255 0\nv");
        for text in [COLOURED, bytes.as_str()] {
            let (root, binary) = read(text, Materials::Own);
            let primitive = &root["meshes"][0]["primitives"][0];
            let accessor = primitive["attributes"]["COLOR_0"].as_u64().unwrap() as usize;
            let view = root["accessors"][accessor]["bufferView"].as_u64().unwrap() as usize;
            let start = root["bufferViews"][view]["byteOffset"].as_u64().unwrap() as usize;
            let (chunks, _) = binary[start..start + 36].as_chunks::<4>();
            let found: Vec<f32> = chunks.iter().map(|b| f32::from_le_bytes(*b)).collect();
            // sRGB 0.5 is 0.214 of the light; a vertex without a colour is white.
            let expected = [1.0, 0.0, 0.214, 0.0, 1.0, 0.0, 1.0, 1.0, 1.0];
            for (f, e) in found.iter().zip(expected) {
                assert!((f - e).abs() < 1e-3, "{found:?}");
            }
            let material = |i: &Value| root["materials"][i.as_u64().unwrap() as usize].clone();
            assert_eq!(material(&primitive["material"])["name"], "vertex colours");
            let variants = &primitive["extensions"]["KHR_materials_variants"];
            assert_eq!(
                material(&variants["mappings"][0]["material"])["name"],
                "label_3"
            );
        }
        let (root, _) = read(COLOURED, Materials::Labels);
        let primitive = &root["meshes"][0]["primitives"][0];
        assert!(primitive["attributes"]["COLOR_0"].is_null() && root["materials"][1].is_null());
        assert_eq!(root["materials"][0]["name"], "label_3");
    }
}
