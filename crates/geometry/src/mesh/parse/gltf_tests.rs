use super::{ParseError, parse};
use crate::mesh::{Format, ParsedMesh};

fn gltf(bytes: &[u8]) -> Result<ParsedMesh, ParseError> {
    parse(bytes, Format::Gltf)
}

/// A GLB file of this JSON and these bytes.
pub(super) fn glb(json: &str, binary: &[u8]) -> Vec<u8> {
    let mut json = json.as_bytes().to_vec();
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut out = b"glTF".to_vec();
    for word in [2, 28 + json.len() + binary.len(), json.len()] {
        out.extend_from_slice(&(word as u32).to_le_bytes());
    }
    out.extend_from_slice(b"JSON");
    out.extend_from_slice(&json);
    out.extend_from_slice(&(binary.len() as u32).to_le_bytes());
    out.extend_from_slice(b"BIN\0");
    out.extend_from_slice(binary);
    out
}

/// Four corners of a square as floats, then the indices 0 1 2 2 1 3 as bytes, and as sparse data
/// one index (short) with one position.
pub(super) fn binary() -> Vec<u8> {
    let mut out: Vec<u8> = [
        0.0f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0,
    ]
    .iter()
    .flat_map(|x| x.to_le_bytes())
    .collect();
    out.extend_from_slice(&[0, 1, 2, 2, 1, 3, 0, 0]);
    out.extend_from_slice(&[3, 0, 0, 0]);
    out.extend([5.0f32, 6.0, 7.0].iter().flat_map(|x| x.to_le_bytes()));
    out
}

/// A file with these nodes, primitives, accessors after the first two, and further entries.
pub(super) fn json(nodes: &str, primitives: &str, accessors: &str, more: &str) -> String {
    format!(
        r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],"nodes":[{nodes}],
        "meshes":[{{"primitives":[{primitives}]}}],
        "accessors":[{{"bufferView":0,"componentType":5126,"count":4,"type":"VEC3"}},
        {{"bufferView":1,"componentType":5121,"count":6,"type":"SCALAR"}}{accessors}],
        "bufferViews":[{{"buffer":0,"byteLength":48}},{{"buffer":0,"byteOffset":48,"byteLength":6}},
        {{"buffer":0,"byteOffset":56,"byteLength":2}},
            {{"buffer":0,"byteOffset":60,"byteLength":12}}],
        "buffers":[{{"byteLength":72}}]{more}}}"#
    )
}

pub(super) const SQUARE: &str = r#"{"attributes":{"POSITION":0,"NORMAL":0},"indices":1}"#;
const NODE: &str = r#"{"mesh":0}"#;

fn read(
    nodes: &str,
    primitives: &str,
    accessors: &str,
    more: &str,
) -> Result<ParsedMesh, ParseError> {
    gltf(&glb(&json(nodes, primitives, accessors, more), &binary()))
}

fn message(nodes: &str, primitives: &str, accessors: &str, more: &str) -> String {
    read(nodes, primitives, accessors, more)
        .unwrap_err()
        .to_string()
}

#[test]
fn all_kinds_of_primitives_in_their_order() {
    let primitives = [
        SQUARE,
        r#"{"attributes":{"POSITION":0},"mode":1}"#,
        r#"{"attributes":{"POSITION":0},"mode":5}"#,
        r#"{"attributes":{"POSITION":0},"mode":6}"#,
        r#"{"attributes":{},"mode":4}"#,
    ];
    let mesh = read(NODE, &primitives.join(","), "", "").unwrap();
    // The primitives share their positions.
    assert_eq!(mesh.vertices.len(), 4);
    let expected = [
        [0, 1, 2],
        [2, 1, 3],
        [0, 1, 2],
        [1, 3, 2],
        [1, 2, 0],
        [2, 3, 0],
    ];
    assert_eq!(mesh.triangles, expected);
    assert_eq!(mesh.n_polygons, 6);
}

#[test]
fn nodes_move_their_meshes_depth_first() {
    let nodes = r#"{"children":[2,1],"translation":[10,0,0]},
        {"mesh":0,"matrix":[0,1,0,0, -1,0,0,0, 0,0,1,0, 0,0,5,1]},
        {"children":[3],"scale":[2,2,-2]},
        {"mesh":0,"rotation":[0,0,0.7071067811865476,0.7071067811865476]}"#;
    let mesh = read(nodes, SQUARE, "", "").unwrap();
    assert_eq!(mesh.vertices.len(), 8);
    let close = |v: usize, wanted: [f64; 3]| {
        let found = mesh.vertices[v];
        assert!(
            (0..3).all(|i| (found[i] - wanted[i]).abs() < 1e-12),
            "{v}: {found:?}"
        );
    };
    // Node 3 is turned, then scaled by 2, then moved by 10; it mirrors, so its triangles are
    // flipped.
    close(1, [10.0, 2.0, 0.0]);
    close(2, [8.0, 0.0, 0.0]);
    assert_eq!(mesh.triangles[..2], [[0, 2, 1], [2, 3, 1]]);
    // Node 1.
    close(5, [10.0, 1.0, 5.0]);
    close(6, [9.0, 0.0, 5.0]);
    assert_eq!(mesh.triangles[2..], [[4, 5, 6], [6, 5, 7]]);
}

#[test]
fn sparse_and_integer_positions() {
    let sparse =
        r#"{"count":1,"indices":{"bufferView":2,"componentType":5123},"values":{"bufferView":3}}"#;
    let with_base = format!(
        r#",{{"bufferView":0,"componentType":5126,"count":4,"type":"VEC3","sparse":{sparse}}}"#
    );
    let primitive = r#"{"attributes":{"POSITION":2},"indices":1}"#;
    let mesh = read(NODE, primitive, &with_base, "").unwrap();
    assert_eq!(mesh.vertices[1], [1.0, 0.0, 0.0]);
    assert_eq!(mesh.vertices[3], [5.0, 6.0, 7.0]);
    let of_zeros =
        format!(r#",{{"componentType":5126,"count":4,"type":"VEC3","sparse":{sparse}}}"#);
    let mesh = read(NODE, primitive, &of_zeros, "").unwrap();
    assert_eq!(
        mesh.vertices,
        [[0.0; 3], [0.0; 3], [0.0; 3], [5.0, 6.0, 7.0]]
    );
    let bytes =
        r#",{"bufferView":1,"componentType":5121,"count":2,"type":"VEC3","normalized":true}"#;
    let primitive = r#"{"attributes":{"POSITION":2},"mode":6}"#;
    assert_eq!(message(NODE, primitive, bytes, ""), "the file has no faces");
    let three = r#"{"attributes":{"POSITION":0},"mode":6},{"attributes":{"POSITION":2},"mode":6}"#;
    let mesh = read(
        NODE,
        three,
        bytes,
        r#","extensionsRequired":["KHR_mesh_quantization"]"#,
    )
    .unwrap();
    assert_eq!(mesh.vertices[5], [2.0 / 255.0, 1.0 / 255.0, 3.0 / 255.0]);
}

#[test]
fn json_alone_with_a_data_uri() {
    let sextets = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::new();
    for group in binary().chunks(3) {
        let bits = group.iter().fold(0, |w, b| w << 8 | usize::from(*b));
        for shift in [18, 12, 6, 0] {
            text.push(char::from(sextets[bits >> shift & 63]));
        }
    }
    let with = |uri: &str| {
        json(NODE, SQUARE, "", "").replace(
            r#""byteLength":72}]"#,
            &format!(r#""byteLength":72,"uri":"{uri}"}}]"#),
        )
    };
    let whole = with(&format!("data:application/octet-stream;base64,{text}"));
    let mesh = gltf(format!("\u{feff} {whole}").as_bytes()).unwrap();
    assert_eq!(mesh, read(NODE, SQUARE, "", "").unwrap());
    for (uri, message) in [
        (
            "scene.bin",
            "buffer 0 is in another file (\"scene.bin\"), which is not sent along: `coseg add` \
             and the clients pack both into one when they are given the path; or export a single \
             .glb",
        ),
        (
            "data:;base64,AAA*",
            "buffer 0 has a data URI that is not valid base64",
        ),
        ("data:;base64,AAAA", "buffer 0 declares 72 bytes, but has 3"),
    ] {
        assert_eq!(gltf(with(uri).as_bytes()).unwrap_err().to_string(), message);
    }
    let without = json(NODE, SQUARE, "", "");
    assert_eq!(
        gltf(without.as_bytes()).unwrap_err().to_string(),
        "buffer 0 has no data in the file"
    );
}

#[test]
fn without_a_default_scene_the_first_is_read_and_without_any_all_roots() {
    let whole = json(r#"{"mesh":0},{"mesh":0,"children":[0]}"#, SQUARE, "", "");
    let n = |json: &str| gltf(&glb(json, &binary())).unwrap().n_polygons;
    assert_eq!(n(&whole), 2);
    assert_eq!(n(&whole.replace(r#""scene":0,"#, "")), 2);
    assert_eq!(
        n(&whole.replace(r#""scene":0,"scenes":[{"nodes":[0]}],"#, "")),
        4
    );
}

#[test]
fn gltf_errors_name_the_place_and_the_value() {
    let twice = "is reached twice, but nodes must form a tree";
    for (found, wanted) in [
        (
            message(r#"{"mesh":0,"children":[0]}"#, SQUARE, "", ""),
            format!("node 0 {twice}"),
        ),
        (
            message(r#"{"children":[1,1]},{"mesh":0}"#, SQUARE, "", ""),
            format!("node 1 {twice}"),
        ),
        (
            message(r#"{"children":[7]}"#, SQUARE, "", ""),
            "nodes[0].children[0] names node 7, but the file has 1".into(),
        ),
        (
            message(NODE, r#"{"attributes":{"POSITION":0},"indices":6}"#, "", ""),
            "meshes[0].primitives[0].indices names accessor 6, but the file has 2".into(),
        ),
        (
            message(NODE, r#"{"attributes":{"POSITION":0},"mode":9}"#, "", ""),
            "meshes[0].primitives[0].mode is 9, which glTF does not know".into(),
        ),
        (
            message(r#"{"mesh":2}"#, SQUARE, "", ""),
            "nodes[0].mesh names mesh 2, but the file has 1".into(),
        ),
        (
            message(NODE, r#"{"attributes":{"POSITION":9}}"#, "", ""),
            "meshes[0].primitives[0].attributes.POSITION names accessor 9, but the file has \
             2"
            .into(),
        ),
        (
            message(NODE, r#"{"attributes":{"POSITION":1}}"#, "", ""),
            "accessor 1 holds positions, but not as VEC3 of float, byte or short".into(),
        ),
        (
            message(NODE, r#"{"attributes":{"POSITION":0},"indices":0}"#, "", ""),
            "accessor 0 holds indices, but not as SCALAR of unsigned integers".into(),
        ),
        (
            message(NODE, r#"{"attributes":{"POSITION":0}}"#, "", ""),
            "a primitive of triangles has 4 corners, which is no multiple of 3".into(),
        ),
        (
            message(
                NODE,
                SQUARE,
                "",
                r#","extensionsRequired":["KHR_draco_mesh_compression"]"#,
            ),
            "a file that requires KHR_draco_mesh_compression is not read, export it without that \
             extension"
                .into(),
        ),
    ] {
        assert_eq!(found, wanted);
    }
    let accessor = |text: &str| {
        let accessors = format!(",{{{text}}}");
        message(
            NODE,
            r#"{"attributes":{"POSITION":2},"mode":6}"#,
            &accessors,
            "",
        )
    };
    for (text, wanted) in [
        (
            r#""bufferView":0,"componentType":5126,"count":5,"type":"VEC3""#,
            "accessor 2 has 5 entries from byte 0 on, but buffer view 0 has 48 bytes",
        ),
        (
            r#""bufferView":0,"byteOffset":4,"componentType":5126,"count":4,"type":"VEC3""#,
            "accessor 2 has 4 entries from byte 4 on, but buffer view 0 has 48 bytes",
        ),
        (
            r#""bufferView":8,"componentType":5126,"count":5,"type":"VEC3""#,
            "accessors[2].bufferView names buffer view 8, but the file has 4",
        ),
        (
            r#""bufferView":0,"componentType":77,"count":4,"type":"VEC3""#,
            "accessors[2].componentType is 77, which glTF does not know",
        ),
        (
            r#""componentType":5126,"count":4,"type":"VEC3",
                "sparse":{"count":5,"indices":{"bufferView":2,
            "componentType":5123},"values":{"bufferView":3}}"#,
            "accessor 2 replaces 5 entries, but has 4",
        ),
        (
            r#""componentType":5126,"count":3,"type":"VEC3",
                "sparse":{"count":1,"indices":{"bufferView":2,
            "componentType":5123},"values":{"bufferView":3}}"#,
            "accessor 2 replaces entry 3, but has 3",
        ),
    ] {
        assert_eq!(accessor(text), wanted);
    }
    let huge = r#""componentType":5126,"count":9007199254740991,"type":"VEC3""#;
    assert!(
        accessor(huge).contains("places more than"),
        "{}",
        accessor(huge)
    );
    let short = json(NODE, SQUARE, "", "").replace("\"byteLength\":48", "\"byteLength\":99");
    assert_eq!(
        gltf(&glb(&short, &binary())).unwrap_err().to_string(),
        "buffer view 0 has 99 bytes from byte 0 on, but buffer 0 has 72"
    );
    let old = json(NODE, SQUARE, "", "").replace("\"2.0\"", "\"1.0\"");
    let old = gltf(&glb(&old, &binary())).unwrap_err().to_string();
    assert_eq!(old, "glTF 1.0 is not read, only glTF 2.0");
    let beyond = binary()
        .iter()
        .map(|&b| if b == 3 { 4 } else { b })
        .collect::<Vec<u8>>();
    let beyond = gltf(&glb(&json(NODE, SQUARE, "", ""), &beyond)).unwrap_err();
    assert_eq!(
        beyond.to_string(),
        "face 1 names vertex 4, but the mesh has 4"
    );
}

#[test]
fn a_small_file_cannot_place_a_mesh_without_end() {
    let nodes: String = (0..60_000).map(|_| r#",{"mesh":0}"#).collect();
    let children: Vec<String> = (1..=60_000).map(|i| i.to_string()).collect();
    let root = format!(r#"{{"children":[{}]}}{nodes}"#, children.join(","));
    let many = vec![SQUARE; 20].join(",");
    let found = message(&root, &many, "", "");
    assert!(found.starts_with("the scene places more than "), "{found}");
}
