use super::super::glb::{glb_of, new_document};
use super::super::{Labelling, Materials, obj, obj_with, ply, ply_with};
use super::Attributes;
use crate::mesh::{Format, parse};
use serde_json::json;

const PLACES: [[f32; 3]; 4] = [[0.0; 3], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];

/// Two triangles of one set of positions with texture coordinates of their own; the first has a
/// material, colours and normals, and a node stretches both along x.
fn file() -> Vec<u8> {
    let mut document = new_document();
    let positions = document.attribute(&PLACES);
    let [first, second] = [0.25, 0.75].map(|u| document.attribute(&[[u, 0.25]; 4]));
    let slanted = std::f32::consts::FRAC_1_SQRT_2;
    let normals = document.attribute(&[[slanted, 0.0, slanted]; 4]);
    let colours = document.attribute(&[[1.0, 0.0, 0.214]; 4]);
    let too_few = document.attribute(&[[0.0, 0.0, 1.0]; 3]);
    let (one, two) = (document.indices(&[0, 1, 2]), document.indices(&[0, 2, 3]));
    let shading = json!({ "baseColorFactor": [0.214, 1, 0, 1] });
    let oak = json!({ "name": "dark oak", "pbrMetallicRoughness": shading });
    document.push("materials", json!({}));
    document.push("materials", oak);
    let primitives = json!([
        { "indices": one, "material": 1, "attributes": { "POSITION": positions, "NORMAL": normals,
            "TEXCOORD_0": first, "COLOR_0": colours } },
        { "indices": two, "material": 0, "attributes": { "POSITION": positions, "NORMAL": too_few,
            "TEXCOORD_0": second, "COLOR_0": "none" } },
    ]);
    document.push("meshes", json!({ "primitives": primitives }));
    document.push("nodes", json!({ "mesh": 0, "scale": [3, 1, 1] }));
    document.push("scenes", json!({ "nodes": [0] }));
    document.root["buffers"][0]["byteLength"] = document.binary.len().into();
    glb_of(document.root.to_string(), document.binary)
}

fn labelling<'a>(
    labels: &'a [i32],
    styles: &'a std::collections::BTreeMap<i32, super::super::LabelStyle>,
) -> Labelling<'a> {
    Labelling {
        labels,
        confidence: None,
        styles,
    }
}

#[test]
fn an_obj_of_a_gltf_has_its_texture_normals_and_materials() {
    let bytes = file();
    let mesh = parse(&bytes, Format::Gltf).unwrap();
    let found = Attributes::of(&bytes, Format::Gltf).unwrap();
    let names: Vec<&str> = found.materials.iter().map(|m| m.name.as_str()).collect();
    assert_eq!(names, ["dark oak", "material_0"]);
    // Light of 0.214 is sRGB 0.5.
    assert_eq!(found.materials[0].colour, Some([127, 255, 0]));
    assert_eq!(found.materials[1].colour, Some([255; 3]));
    let own = ["oak".to_owned(), "m".to_owned()];
    let styles = Default::default();
    let of = (&found, Some(own.as_slice()));
    let text = obj_with(
        &mesh.vertices,
        &mesh.polygons(),
        &labelling(&[4, 4], &styles),
        "a.mtl",
        of,
    );
    let lines: Vec<&str> = text.lines().collect();
    // glTF counts from the top of an image, OBJ from its bottom.
    assert!(lines.contains(&"vt 0.25 0.75") && lines.contains(&"vt 0.75 0.75"));
    let normal = lines.iter().find(|line| line.starts_with("vn ")).unwrap();
    let [x, y, z] = numbers(&normal[3..]);
    // Stretched along x it turns towards z: (1/3, 0, 1), of length 1.
    let length = (1.0_f64 / 9.0 + 1.0).sqrt();
    assert!((x - 1.0 / 3.0 / length).abs() < 1e-6 && y == 0.0 && (z - 1.0 / length).abs() < 1e-6);
    let end: Vec<&str> = lines[lines.len() - 4..].to_vec();
    assert_eq!(
        end,
        [
            "usemtl oak",
            "f 1/1/1 2/2/2 3/3/3",
            "usemtl m",
            "f 1/5 3/7 4/8"
        ]
    );
    // Only some vertices have colours: the others are white.
    let [_, _, _, r, g, b] = numbers(&lines.iter().find(|l| l.starts_with("v ")).unwrap()[2..]);
    assert!(
        (r, g) == (1.0, 0.0) && (b - 0.5).abs() < 1e-3,
        "{r} {g} {b}"
    );
    assert!(lines.contains(&"v 0 1 0 1 1 1"), "{text}");
    // Read back: the same mesh, and the same attributes.
    let read = parse(text.as_bytes(), Format::Obj).unwrap();
    assert_eq!(
        (&read.vertices, &read.triangles),
        (&mesh.vertices, &mesh.triangles)
    );
    let again = Attributes::of(text.as_bytes(), Format::Obj).unwrap();
    assert_eq!(
        (again.texture, again.normals),
        (found.texture, found.normals)
    );
}

fn numbers<const N: usize>(text: &str) -> [f64; N] {
    let numbers: Vec<f64> = text.split(' ').map(|t| t.parse().unwrap()).collect();
    numbers.try_into().unwrap()
}

#[test]
fn without_names_faces_have_the_materials_of_their_labels() {
    let bytes = file();
    let mesh = parse(&bytes, Format::Gltf).unwrap();
    let found = Attributes::of(&bytes, Format::Gltf).unwrap();
    let styles = Default::default();
    let labels = labelling(&[4, 4], &styles);
    let text = obj_with(
        &mesh.vertices,
        &mesh.polygons(),
        &labels,
        "a.mtl",
        (&found, None),
    );
    assert_eq!(text.matches("usemtl ").count(), 1);
    assert!(
        text.contains("usemtl label_4\nf 1/1/1 2/2/2 3/3/3\nf 1/5 3/7 4/8\n"),
        "{text}"
    );
    // Without attributes the text is that of a mesh alone.
    let none = Attributes::of(b"OFF\n", Format::Off).unwrap();
    let plain = obj_with(
        &mesh.vertices,
        &mesh.polygons(),
        &labels,
        "a.mtl",
        (&none, None),
    );
    assert_eq!(
        plain,
        obj(&mesh.vertices, &mesh.polygons(), &labels, "a.mtl")
    );
}

/// The rows of vertices of a binary PLY: position, normal, colour.
fn rows(bytes: &[u8], n: usize, has_normals: bool) -> Vec<([f32; 3], [u8; 3])> {
    let end = b"end_header\n";
    let at = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
    let size = if has_normals { 43 } else { 31 };
    (0..n)
        .map(|i| {
            let row = &bytes[at + i * size..at + (i + 1) * size];
            let float =
                |j: usize| f32::from_le_bytes(row[24 + 4 * j..28 + 4 * j].try_into().unwrap());
            let normal = if has_normals {
                [0, 1, 2].map(float)
            } else {
                [0.0; 3]
            };
            let colour = &row[size - 7..size - 4];
            (normal, colour.try_into().unwrap())
        })
        .collect()
}

#[test]
fn a_ply_has_normals_and_colours_of_vertices_that_have_one() {
    const SQUARE: &str = "v 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 1 1 0 0 0 1\nv 0 1 0 1 1 0\nv 9 9 9\n\
        vn 0 0 2\nvn 0 1 0\nf 1//1 2//1 3//1\nf 1//1 3//1 4//1\n";
    let paint = ([[9, 9, 9]; 2], [7, 7]);
    let write = |text: &str, materials| {
        let mesh = parse(text.as_bytes(), Format::Obj).unwrap();
        let found = Attributes::of(text.as_bytes(), Format::Obj).unwrap();
        let polygons = mesh.polygons();
        ply_with(
            &mesh.vertices,
            &polygons,
            &paint.0,
            &paint.1,
            (&found, materials),
        )
    };
    let bytes = write(SQUARE, Materials::Own);
    let found = rows(&bytes, 5, true);
    assert_eq!(found[0], ([0.0, 0.0, 1.0], [255, 0, 0]));
    assert_eq!(found[3], ([0.0, 0.0, 1.0], [255, 255, 0]));
    assert_eq!(found[4], ([0.0; 3], [255; 3]));
    assert_eq!(parse(&bytes, Format::Ply).unwrap().n_polygons, 2);
    // Labels are shown where that is asked for, and always at faces.
    let labels = rows(&write(SQUARE, Materials::Labels), 5, true);
    assert_eq!((labels[0].1, labels[4].1), ([9; 3], [128; 3]));
    assert_eq!(bytes[bytes.len() - 7..bytes.len() - 4], [9; 3]);
    // Two normals at one vertex are a sharp edge: PLY cannot say it.
    let sharp = write(
        &SQUARE.replace("f 1//1 3//1 4//1", "f 1//2 3//2 4//2"),
        Materials::Own,
    );
    assert!(!String::from_utf8_lossy(&sharp).contains("property float nx"));
    assert_eq!(rows(&sharp, 5, false)[1].1, [0, 255, 0]);
    // And a file that has neither is written as before.
    let plain = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n";
    let mesh = parse(plain.as_bytes(), Format::Obj).unwrap();
    let before = ply(&mesh.vertices, &mesh.polygons(), &paint.0, &paint.1);
    assert_eq!(write(plain, Materials::Own), before);
}

#[test]
fn normals_of_a_flattened_mesh_and_numbers_that_are_none_are_left_out() {
    let text = file();
    let (json, _) = crate::mesh::parse::gltf::container(&text).unwrap();
    let json = String::from_utf8_lossy(json).into_owned();
    let flat = json.replace("[3,1,1]", "[0,1,1]");
    assert_ne!(flat, json);
    let binary = text[20 + json.len() + 8..].to_vec();
    let found = Attributes::of(&glb_of(flat, binary.clone()), Format::Gltf).unwrap();
    assert!(found.normals.is_empty() && !found.texture.is_empty());
    let mut broken = binary;
    // The first texture coordinate, behind four positions.
    broken[48..52].copy_from_slice(&f32::NAN.to_le_bytes());
    let found = Attributes::of(&glb_of(json, broken), Format::Gltf).unwrap();
    assert_eq!(found.texture.len(), 4);
    assert_eq!(found.corner(0, 0, super::Kind::Texture), None);
    assert_eq!(found.corner(1, 0, super::Kind::Texture), Some(0));
}
