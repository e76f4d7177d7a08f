use super::super::{LabelStyle, Labelling, Materials};
use super::labelled_gltf;
use crate::mesh::parse::gltf::container;
use crate::mesh::{Format, parse};
use base64::Engine as _;
use serde_json::{Value, json};

/// Two squares of two triangles, apart from each other, with texture coordinates, as a file that a
/// program might write: two nodes place the mesh, one mirrored, and it has points and extras.
fn scene() -> Value {
    let mut data: Vec<u8> = Vec::new();
    for x in [0.0f32, 5.0] {
        for (u, v) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
            data.extend([x + u, v, 0.0].iter().flat_map(|x| x.to_le_bytes()));
        }
    }
    data.extend([0.25f32; 16].iter().flat_map(|x| x.to_le_bytes()));
    let strip = [0u8, 1, 3, 2, 4, 5, 6, 4, 6, 7];
    data.extend(strip);
    let uri = format!(
        "data:application/octet-stream;base64,{}",
        super::BASE64.encode(&data)
    );
    let position = |accessor: u32| json!({ "POSITION": accessor, "TEXCOORD_0": 1 });
    json!({
        "asset": { "version": "2.0", "generator": "by hand" },
        "scene": 0,
        "scenes": [{ "nodes": [0, 2], "name": "all" }],
        "nodes": [
            { "name": "body", "mesh": 0, "children": [1], "weights": [0.5], "extras": { "a": 1 } },
            { "name": "other", "mesh": 0, "scale": [-1.0, 1.0, 1.0],
              "translation": [0.0, 9.0, 0.0] },
            { "name": "eye", "camera": 0 },
        ],
        "meshes": [{ "name": "shape", "extras": { "targetNames": ["fat"] }, "primitives": [
            { "attributes": position(0), "indices": 2, "mode": 5, "material": 0,
              "extras": { "b": 2 }, "targets": [{ "POSITION": 0 }] },
            { "attributes": position(0), "mode": 0 },
            { "attributes": position(0), "indices": 3, "extras": 7, "targets": [{ "POSITION": 0 }],
              "extensions": { "EXT_mesh_manifold": {} } },
        ] }],
        "materials": [{ "name": "oak" }],
        "cameras": [{ "type": "perspective", "perspective": { "yfov": 1.0, "znear": 0.1 } }],
        "animations": [{
            "channels": [
                { "sampler": 0, "target": { "node": 0, "path": "weights" } },
                { "sampler": 0, "target": { "node": 0, "path": "scale" } },
            ],
            "samplers": [{ "input": 1, "output": 1 }],
        }],
        "accessors": [
            { "bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3" },
            { "bufferView": 1, "componentType": 5126, "count": 8, "type": "VEC2" },
            { "bufferView": 2, "componentType": 5121, "count": 4, "type": "SCALAR" },
            { "bufferView": 2, "byteOffset": 4, "componentType": 5121, "count": 6,
              "type": "SCALAR" },
        ],
        "bufferViews": [
            { "buffer": 0, "byteLength": 96 },
            { "buffer": 0, "byteOffset": 96, "byteLength": 64 },
            { "buffer": 0, "byteOffset": 160, "byteLength": 10 },
        ],
        "buffers": [{ "byteLength": data.len(), "uri": uri }],
    })
}

/// Triangles 0 and 1 of the scene are the first node's first square, 4 and 5 the second node's.
const LABELS: [i32; 8] = [2, 2, 2, 3, 3, 3, -1, -1];

fn labelled(root: &Value, labels: &[i32], materials: Materials, up: Option<[f64; 3]>) -> Vec<u8> {
    let leg = LabelStyle {
        name: "leg".to_owned(),
        colour: [255, 0, 0],
    };
    let styles = [(2, leg)].into();
    let labelling = Labelling {
        labels,
        confidence: None,
        styles: &styles,
    };
    labelled_gltf("it", root.to_string().as_bytes(), &labelling, materials, up).unwrap()
}

fn json_of(file: &[u8]) -> Value {
    serde_json::from_slice(container(file).unwrap().0).unwrap()
}

/// Corners of all triangles, sorted.
fn corners(file: &[u8]) -> Vec<String> {
    let mesh = parse(file, Format::Gltf).unwrap();
    let corners = mesh
        .triangles
        .iter()
        .map(|t| format!("{:?}", t.map(|v| mesh.vertices[v as usize])));
    let mut corners: Vec<String> = corners.collect();
    corners.sort_unstable();
    corners
}

/// Name, mesh, and names of the children of a node.
fn node(root: &Value, name: &str) -> (Value, Vec<String>) {
    let nodes = root["nodes"].as_array().unwrap();
    let found = nodes.iter().find(|n| n["name"] == name).unwrap();
    let children = found["children"].as_array().into_iter().flatten();
    let children = children.map(|c| &nodes[c.as_u64().unwrap() as usize]["name"]);
    let children = children.map(|n| n.as_str().unwrap().to_owned());
    (found.clone(), children.collect())
}

#[test]
fn triangles_go_to_nodes_of_part_instances_below_the_node_that_placed_them() {
    let scene = scene();
    let file = labelled(&scene, &LABELS, Materials::Own, None);
    assert_eq!(corners(&file), corners(scene.to_string().as_bytes()));
    let root = json_of(&file);
    let (body, below) = node(&root, "body");
    assert_eq!(below, ["other", "leg.001", "leg.002", "label_3.001"]);
    let (other, below) = node(&root, "other");
    assert_eq!(below, ["unlabelled.001", "label_3.002"]);
    // The points stay where they were.
    for old in [&body, &other] {
        let mesh = &root["meshes"][old["mesh"].as_u64().unwrap() as usize];
        assert_eq!(mesh["primitives"].as_array().unwrap().len(), 1);
        assert_eq!(mesh["primitives"][0]["mode"], 0);
    }
    assert_eq!(other["translation"], json!([0.0, 9.0, 0.0]));
    let leg = node(&root, "leg.001").0;
    assert_eq!(
        leg["extras"],
        json!({ "label": 2, "label_name": "leg", "instance": 1 })
    );
    let mesh = &root["meshes"][leg["mesh"].as_u64().unwrap() as usize];
    let expected = json!([{
        "attributes": { "POSITION": 0, "TEXCOORD_0": 1 },
        "indices": mesh["primitives"][0]["indices"], "material": 0, "targets": [{ "POSITION": 0 }],
        "extras": { "b": 2, "label": 2, "polygons": [0, 2] },
        "extensions": {
            "KHR_materials_variants": { "mappings": [{ "material": 1, "variants": [0] }] },
        },
    }]);
    assert_eq!(mesh["primitives"], expected);
    let apart = node(&root, "label_3.001").0;
    let apart = &root["meshes"][apart["mesh"].as_u64().unwrap() as usize]["primitives"][0];
    assert_eq!(
        apart["extras"],
        json!({ "extras": 7, "label": 3, "polygons": [3, 1] })
    );
    assert!(apart.get("extensions").is_none(), "{apart}");
    let own = root["materials"][apart["material"].as_u64().unwrap() as usize].clone();
    assert_eq!(own["name"], "label_3");
}

#[test]
fn everything_else_stays() {
    let scene = scene();
    let root = json_of(&labelled(&scene, &LABELS, Materials::Own, None));
    for key in ["asset", "scenes", "cameras", "scene"] {
        assert_eq!(root[key], scene[key], "{key}");
    }
    for key in ["materials", "accessors", "bufferViews"] {
        let (found, old) = (
            &root[key].as_array().unwrap(),
            scene[key].as_array().unwrap(),
        );
        assert_eq!(found[..old.len()], old[..], "{key}");
    }
    assert_eq!(root["nodes"][2], scene["nodes"][2]);
    assert_eq!(root["nodes"][0]["extras"], json!({ "a": 1 }));
    assert_eq!(root["extensionsUsed"], json!(["KHR_materials_variants"]));
    let variants = &root["extensions"]["KHR_materials_variants"]["variants"];
    assert_eq!(*variants, json!([{ "name": "labels" }]));
    assert!(root["buffers"][0].get("uri").is_none());
    // Whoever morphs the node morphs its parts; the points keep their channel.
    let channels = root["animations"][0]["channels"].as_array().unwrap();
    let morphed = channels.iter().filter(|c| c["target"]["path"] == "weights");
    let morphed: Vec<u64> = morphed
        .map(|c| c["target"]["node"].as_u64().unwrap())
        .collect();
    assert_eq!(morphed, [0, 3, 4, 5]);
    let (parts, meshes) = (&root["nodes"].as_array().unwrap()[3..6], &root["meshes"]);
    for part in parts {
        assert_eq!(part["weights"], json!([0.5]));
        let mesh = &meshes[part["mesh"].as_u64().unwrap() as usize];
        assert_eq!(
            (&mesh["name"], &mesh["extras"]),
            (&json!("shape"), &scene["meshes"][0]["extras"])
        );
    }
    // No mesh is left that nothing places.
    let nodes = root["nodes"].as_array().unwrap();
    let placed = nodes.iter().filter(|node| !node["mesh"].is_null()).count();
    assert_eq!(placed, meshes.as_array().unwrap().len());
}

#[test]
fn parts_show_their_labels_where_that_is_wanted() {
    let root = json_of(&labelled(&scene(), &LABELS, Materials::Labels, None));
    let leg = node(&root, "leg.001").0;
    let primitive = &root["meshes"][leg["mesh"].as_u64().unwrap() as usize]["primitives"][0];
    let shown = primitive["material"].as_u64().unwrap() as usize;
    assert_eq!(root["materials"][shown]["name"], "leg");
    let mapping = json!([{ "material": 0, "variants": [0] }]);
    assert_eq!(
        primitive["extensions"]["KHR_materials_variants"]["mappings"],
        mapping
    );
    let variants = &root["extensions"]["KHR_materials_variants"]["variants"];
    assert_eq!(*variants, json!([{ "name": "original" }]));
}

#[test]
fn a_scene_is_turned_upright_or_made() {
    let file = labelled(&scene(), &LABELS, Materials::Own, Some([0.0, 0.0, 1.0]));
    let root = json_of(&file);
    let top = root["scenes"][0]["nodes"][0].as_u64().unwrap() as usize;
    assert_eq!(root["nodes"][top]["name"], "it upright");
    assert_eq!(root["nodes"][top]["children"], json!([0, 2]));
    // Without scenes the roots are one; without nodes each mesh has one.
    let mut bare = scene();
    for key in ["scene", "scenes", "animations"] {
        bare.as_object_mut().unwrap().remove(key);
    }
    let file = labelled(&bare, &LABELS, Materials::Own, None);
    assert_eq!(json_of(&file)["scenes"], json!([{ "nodes": [0, 2] }]));
    assert_eq!(corners(&file), corners(bare.to_string().as_bytes()));
    bare.as_object_mut().unwrap().remove("nodes");
    let file = labelled(&bare, &LABELS[..4], Materials::Own, None);
    let root = json_of(&file);
    assert_eq!(root["scenes"], json!([{ "nodes": [0] }]));
    assert_eq!(
        node(&root, "shape").1,
        ["leg.001", "leg.002", "label_3.001"]
    );
    assert_eq!(corners(&file), corners(bare.to_string().as_bytes()));
}

#[test]
fn a_buffer_that_cannot_grow_is_left_alone() {
    let mut root = scene();
    let buffer = root["buffers"][0].clone();
    // A buffer without data stands for compressed views, which nothing here uses.
    root["buffers"] = json!([{ "byteLength": 8 }, buffer]);
    for view in root["bufferViews"].as_array_mut().unwrap() {
        view["buffer"] = 1.into();
    }
    let file = labelled(&root, &LABELS, Materials::Own, None);
    assert_eq!(corners(&file), corners(root.to_string().as_bytes()));
    let found = json_of(&file);
    assert_eq!(found["buffers"][1], root["buffers"][1]);
    assert_eq!(found["buffers"].as_array().unwrap().len(), 3);
    // What was written is a GLB, whose chunk grows when it is written again.
    let file = labelled(&scene(), &LABELS, Materials::Own, None);
    let again = labelled_gltf(
        "it",
        &file,
        &Labelling {
            labels: &[5; 8],
            confidence: None,
            styles: &Default::default(),
        },
        Materials::Own,
        None,
    );
    assert_eq!(corners(&again.unwrap()), corners(&file));
}
