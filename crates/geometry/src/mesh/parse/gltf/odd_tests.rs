//! Files that are valid and unusual: parts that do not affect triangles may be present, missing or
//! of new kinds.

use crate::mesh::parse::gltf_tests::{SQUARE, binary, glb, json};
use crate::mesh::parse::{ParseError, parse};
use crate::mesh::{Format, ParsedMesh};

const NODE: &str = r#"{"mesh":0}"#;

fn gltf(bytes: &[u8]) -> Result<ParsedMesh, ParseError> {
    parse(bytes, Format::Gltf)
}

fn read(json: &str) -> Result<ParsedMesh, ParseError> {
    gltf(&glb(json, &binary()))
}

/// The square from the simplest text.
fn square() -> ParsedMesh {
    read(&json(NODE, SQUARE, "", "")).unwrap()
}

#[test]
fn parts_that_are_not_needed_may_hold_anything() {
    for more in [
        r#","animations":[{"channels":[{"sampler":0,"target":{"path":"rotation"}}],
                "samplers":[]}]"#,
        r#","animations":[{"channels":[{"sampler":0,"target":{"path":"pointer","extensions":
            {"KHR_animation_pointer":{"pointer":"/materials/0/emissiveFactor"}}}}],
                "samplers":[{"input":9,"output":9}]}]"#,
        r#","animations":[{"channels":[],"samplers":[{"interpolation":"NEW"}]}],
                "skins":[{"joints":[]}]"#,
        r#","cameras":[{"type":"panoramic"}],"textures":[{"source":99}],"images":[{}]"#,
        r#","materials":[{"alphaMode":"DITHER",
                "pbrMetallicRoughness":{"baseColorTexture":{"index":77}}}]"#,
        r#","samplers":[{"magFilter":1}],"extensions":{"NEW_thing":[1,"two",null]},
                "extensionsUsed":["NEW_thing"]"#,
        r#","extras":null"#,
        r#","extras":"text""#,
        r#","extras":-1e-3"#,
        r#","extras":[{},[],0]"#,
        r#","extras":{"a":{"b":true}},"unheardOf":18446744073709551616"#,
        r#","extensionsRequired":["KHR_animation_pointer","KHR_materials_new",
                "KHR_texture_basisu"]"#,
    ] {
        assert_eq!(read(&json(NODE, SQUARE, "", more)), Ok(square()), "{more}");
    }
    // This is deeper than a reader that builds a tree can handle.
    let deep = format!(r#","extras":{}{}"#, "[".repeat(5_000), "]".repeat(5_000));
    assert_eq!(read(&json(NODE, SQUARE, "", &deep)), Ok(square()));
}

#[test]
fn extras_of_every_type_may_be_everywhere() {
    for extras in [
        "null",
        "0",
        r#""words""#,
        "[1]",
        r#"{"POSITION":5}"#,
        "true",
    ] {
        let extras = format!(r#""extras":{extras},"name":"n","extensions":{{"NEW_x":{extras}}},"#);
        let text =
            json(NODE, SQUARE, "", "").replace(r#""mesh":0"#, &format!(r#"{extras}"mesh":0"#));
        let text = text.replace(r#""attributes":"#, &format!(r#"{extras}"attributes":"#));
        let text = text.replace(r#""primitives":"#, &format!(r#"{extras}"primitives":"#));
        let text = text.replace(r#""bufferView":"#, &format!(r#"{extras}"bufferView":"#));
        let text = text.replace(r#""buffer":"#, &format!(r#"{extras}"buffer":"#));
        let text = text.replace(r#""nodes":[0]"#, &format!(r#"{extras}"nodes":[0]"#));
        assert_eq!(read(&text), Ok(square()), "{text}");
    }
}

#[test]
fn attributes_of_an_application_and_of_the_future_are_passed_over() {
    for attribute in [
        "_TEMPERATURE",
        "_",
        "FEATURE_ID_0",
        "NEW_SET:COLOR",
        "COLOR_17",
        "TANGENT",
    ] {
        let primitive = format!(
            r#"{{"attributes":{{"{attribute}":99,"POSITION":0}},"indices":1,"material":3,
            "targets":[{{"POSITION":44,"_X":1}}]}}"#
        );
        assert_eq!(
            read(&json(NODE, &primitive, "", "")),
            Ok(square()),
            "{attribute}"
        );
    }
    // Accessors that no triangle needs may have new types and refer to missing parts.
    let strange = r#",{"componentType":5130,"type":"VEC5","count":0,"bufferView":70}"#;
    assert_eq!(read(&json(NODE, SQUARE, strange, "")), Ok(square()));
    // So may nodes that name cameras, skins and weights.
    let node = r#"{"mesh":0,"camera":4,"skin":5,"weights":[0.5],"name":""}"#;
    assert_eq!(read(&json(node, SQUARE, "", "")), Ok(square()));
}

#[test]
fn scenes_may_lack_nodes_and_files_scenes() {
    let whole = json(r#"{"name":"empty"},{"mesh":0}"#, SQUARE, "", "");
    let scenes = |scenes: &str| whole.replace(r#""scene":0,"scenes":[{"nodes":[0]}]"#, scenes);
    let second = r#""scene":1,"scenes":[{"name":"none"},{"nodes":[0,1]}]"#;
    assert_eq!(read(&scenes(second)), Ok(square()));
    // Of two scenes only the default one is read.
    let both = r#""scene":1,"scenes":[{"nodes":[1]},{"nodes":[1]}]"#;
    assert_eq!(read(&scenes(both)), Ok(square()));
    let message = |text: &str| read(&scenes(text)).unwrap_err().to_string();
    let elsewhere = "the scene that is read places none of the file's 1 meshes: make the scene \
                     that has them the default one";
    assert_eq!(message(r#""scenes":[{},{"nodes":[1]}]"#), elsewhere);
    assert_eq!(
        message(r#""scene":2,"scenes":[{}]"#),
        "scene names scene 2, but the file has 1"
    );
    assert_eq!(
        message(r#""scene":0,"scenes":[{"nodes":[9]}]"#),
        "scenes[0].nodes[0] names node 9, but the file has 2"
    );
    // A collection of meshes, without nodes.
    let store = json(NODE, SQUARE, "", "").replace(r#""nodes":[{"mesh":0}],"#, "");
    assert_eq!(
        read(&store.replace(r#""scene":0,"scenes":[{"nodes":[0]}],"#, "")),
        Ok(square())
    );
    let nothing = r#"{"asset":{"version":"2.0"}}"#;
    assert_eq!(
        gltf(nothing.as_bytes()).unwrap_err().to_string(),
        "the file has no faces"
    );
}

#[test]
fn whole_numbers_may_have_a_point() {
    let text = json(NODE, SQUARE, "", "").replace(r#""count":4"#, r#""count":4.0"#);
    let text = text.replace(r#""indices":1"#, r#""indices":1.0e0"#);
    assert_eq!(read(&text), Ok(square()));
    for count in ["-1", "3.5", "1e300", r#""4""#] {
        let text =
            json(NODE, SQUARE, "", "").replace(r#""count":4"#, &format!(r#""count":{count}"#));
        let message = read(&text).unwrap_err().to_string();
        assert!(
            message.contains("expected a whole number from 0 on"),
            "{message}"
        );
    }
}

#[test]
fn chunks_of_other_kinds_are_passed_over() {
    let whole = glb(&json(NODE, SQUARE, "", ""), &binary());
    let with = |chunks: &[(&[u8; 4], &[u8])], after: &[u8]| {
        let mut out = whole[..12].to_vec();
        for (kind, data) in chunks {
            out.extend((data.len() as u32).to_le_bytes());
            out.extend_from_slice(*kind);
            out.extend_from_slice(data);
        }
        let length = out.len() as u32;
        out[8..12].copy_from_slice(&length.to_le_bytes());
        out.extend_from_slice(after);
        out
    };
    let n = u32::from_le_bytes(whole[12..16].try_into().unwrap()) as usize;
    let (text, data) = (&whole[20..20 + n], &whole[28 + n..]);
    let new: (&[u8; 4], &[u8]) = (b"NEW!", &[1, 2, 3, 4]);
    assert_eq!(
        gltf(&with(&[(b"JSON", text), (b"BIN\0", data), new], b"")),
        Ok(square())
    );
    assert_eq!(
        gltf(&with(&[(b"JSON", text), (b"BIN\0", data)], b"after")),
        Ok(square())
    );
    let message = |bytes: &[u8]| gltf(bytes).unwrap_err().to_string();
    let without = with(&[(b"JSON", text), new], b"");
    assert_eq!(message(&without), "buffer 0 has no data in the file");
    let first = with(&[new, (b"JSON", text)], b"");
    assert_eq!(message(&first), "the first chunk is not of JSON");
    assert_eq!(message(&with(&[], b"")), "the file ends before its JSON");
    let cut = &whole[..whole.len() - 1];
    let n = whole.len();
    let expected = format!(
        "the file declares {n} bytes, but has {}: it is cut off",
        n - 1
    );
    assert_eq!(message(cut), expected);
    let mut one = whole.clone();
    one[4] = 1;
    assert_eq!(message(&one), "glTF 1 is not read, only glTF 2.0");
}

#[test]
fn data_uris_of_every_spelling() {
    use base64::Engine as _;
    let base64 = base64::engine::general_purpose::STANDARD.encode(binary());
    let escaped: String = binary().iter().map(|b| format!("%{b:02X}")).collect();
    for uri in [
        format!("data:application/gltf-buffer;base64,{base64}"),
        format!(
            "DATA:application/octet-stream;BASE64,{}",
            base64.trim_end_matches('=')
        ),
        format!(
            "data:;base64,{}",
            base64.replace('+', "%2B").replace('/', "%2f")
        ),
        format!("data:application/octet-stream,{escaped}"),
    ] {
        let text = json(NODE, SQUARE, "", "");
        let text = text.replace(
            r#""byteLength":72"#,
            &format!(r#""byteLength":72,"uri":"{uri}""#),
        );
        assert_eq!(gltf(text.as_bytes()), Ok(square()), "{uri}");
    }
}

#[test]
fn a_file_without_the_buffers_that_it_needs_says_which() {
    let whole = json(NODE, SQUARE, "", "");
    let without = whole.replace(r#""buffers":[{"byteLength":72}]"#, r#""buffers":[]"#);
    assert_eq!(
        read(&without).unwrap_err().to_string(),
        "bufferViews[0].buffer names buffer 0, but the file has 0"
    );
    // A node that no triangle needs may be anywhere.
    let more = whole.replace(
        r#""buffers":[{"byteLength":72}]"#,
        r#""buffers":[{"byteLength":72},{"byteLength":7,"uri":"https://example.com/x.bin"}]"#,
    );
    assert_eq!(read(&more), Ok(square()));
}

#[test]
fn compression_by_draco_is_refused_by_name_unless_there_is_a_way_around_it() {
    let draco = r#""extensions":{"KHR_draco_mesh_compression":{"bufferView":0,
        "attributes":{"POSITION":0}}}"#;
    let whole = SQUARE.replace(r#""indices":1"#, &format!(r#""indices":1,{draco}"#));
    assert_eq!(read(&json(NODE, &whole, "", "")), Ok(square()));
    let hollow = r#",{"componentType":5126,"count":4,"type":"VEC3"}"#;
    let text = json(
        NODE,
        &whole.replace(r#""POSITION":0,"#, r#""POSITION":2,"#),
        hollow,
        "",
    );
    assert_eq!(
        read(&text).unwrap_err().to_string(),
        "a mesh compressed by KHR_draco_mesh_compression is not read, export it without that \
         extension"
    );
}

/// The square with both of its views compressed, in a file whose second buffer has a plain copy.
fn compressed(name: &str, filter: &str, positions: &[u8], indices: &[u8]) -> (String, Vec<u8>) {
    let mut binary = positions.to_vec();
    binary.resize(positions.len().next_multiple_of(4), 0);
    let at = binary.len();
    binary.extend_from_slice(indices);
    let view = |length: usize, begin: usize, n: usize, stride: usize, count: usize, mode: &str| {
        let filter = if mode == "TRIANGLES" { "" } else { filter };
        format!(
            r#"{{"buffer":1,"byteLength":{length},
                "extensions":{{"{name}":{{"buffer":0,"byteOffset":{begin},
            "byteLength":{n},"byteStride":{stride},"count":{count},"mode":"{mode}"{filter}}}}}}}"#
        )
    };
    let text = format!(
        r#"{{"asset":{{"version":"2.0"}},"extensionsRequired":["{name}"],"scenes":[{{"nodes":[0]}}],
        "nodes":[{{"mesh":0}}],
            "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"indices":1}}]}}],
        "accessors":[{{"bufferView":0,"componentType":5126,"count":4,"type":"VEC3"}},
        {{"bufferView":1,"componentType":5125,"count":6,"type":"SCALAR"}}],
        "bufferViews":[{},{}],
        "buffers":[{{"byteLength":{}}},
                {{"byteLength":72,"extensions":{{"{name}":{{"fallback":true}}}}}}]}}"#,
        view(48, 0, positions.len(), 12, 4, "ATTRIBUTES"),
        view(24, at, indices.len(), 4, 6, "TRIANGLES"),
        binary.len()
    );
    (text, binary)
}

#[test]
fn compression_by_meshopt_is_read() {
    let square = square();
    let corners: Vec<[f32; 3]> = square
        .vertices
        .iter()
        .map(|p| p.map(|x| x as f32))
        .collect();
    let positions = ::meshopt::encode_vertex_buffer(&corners).unwrap();
    let indices = ::meshopt::encode_index_buffer(square.triangles.as_flattened(), 4).unwrap();
    for name in ["EXT_meshopt_compression", "KHR_meshopt_compression"] {
        let (text, binary) = compressed(name, "", &positions, &indices);
        let mesh = gltf(&glb(&text, &binary)).unwrap();
        assert_eq!(mesh.vertices, square.vertices);
        // The codec may begin a triangle at another corner.
        assert_eq!(mesh.triangles.len(), 2);
    }
    // 1 = 1·2^0, in the filter's numbers: exponent in the first eight bits, then the mantissa.
    let exponential: Vec<[u32; 3]> = corners.iter().map(|p| p.map(|x| x as u32)).collect();
    let positions = ::meshopt::encode_vertex_buffer(&exponential).unwrap();
    let filter = r#","filter":"EXPONENTIAL""#;
    let (text, binary) = compressed("EXT_meshopt_compression", filter, &positions, &indices);
    assert_eq!(
        gltf(&glb(&text, &binary)).unwrap().vertices,
        square.vertices
    );
    let message = |text: &str, binary: &[u8]| gltf(&glb(text, binary)).unwrap_err().to_string();
    let quaternions = text.replace("EXPONENTIAL", "QUATERNION");
    assert_eq!(
        message(&quaternions, &binary),
        "bufferViews[0] has the filter \"QUATERNION\", which positions cannot have"
    );
    let huge = text.replace(r#""count":4,"mode""#, r#""count":400000000,"mode""#);
    assert!(
        message(&huge, &binary).contains("hold at most"),
        "{}",
        message(&huge, &binary)
    );
    for at in 0..binary.len() {
        for byte in [0, 1, 0x7f, 0xff] {
            let mut damaged = binary.clone();
            damaged[at] = byte;
            // The result may be an error or a mesh; it must not panic.
            let _ = gltf(&glb(&text, &damaged));
        }
    }
}

#[test]
fn many_objects_that_are_not_needed_are_no_reason_to_refuse_a_file() {
    let many = format!(r#","extras":[{}{{}}]"#, "{},".repeat(1_100_000));
    assert_eq!(read(&json(NODE, SQUARE, "", &many)), Ok(square()));
    let nodes = format!("{NODE},{}{{}}", "{},".repeat(1_100_000));
    let message = read(&json(&nodes, SQUARE, "", "")).unwrap_err().to_string();
    assert!(message.starts_with("the JSON has 11000"), "{message}");
}
