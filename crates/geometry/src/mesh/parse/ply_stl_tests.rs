use super::{ParseError, parse};
use crate::mesh::{Format, ParsedMesh};

fn ply(bytes: &[u8]) -> Result<ParsedMesh, ParseError> {
    parse(bytes, Format::Ply)
}

fn stl(bytes: &[u8]) -> Result<ParsedMesh, ParseError> {
    parse(bytes, Format::Stl)
}

const HEADER: &str = "comment made by hand\nobj_info nothing\nelement camera 1\n\
    property list uchar short pose\n\
    element vertex 4\nproperty uchar red\nproperty float x\nproperty double y\nproperty short z\n\
    element face 2\nproperty list uint8 uint8 flags\nproperty list uchar int vertex_indices\n\
    property ushort label\nelement edge 1\nproperty int vertex1\nend_header\n";
const VERTICES: [[f64; 3]; 4] = [
    [0.5, 0.25, 0.0],
    [1.0, 0.0, 0.0],
    [1.0, 1.0, -3.0],
    [0.0, 1.0, 2.0],
];
const FACES: [&[u32]; 2] = [&[0, 1, 2, 3], &[2, 1, 0]];

/// The mesh of the header above in each encoding.
pub(super) fn samples() -> Vec<Vec<u8>> {
    let mut text = format!("ply\nformat ascii 1.0\n{HEADER}2 7 8\n");
    for [x, y, z] in VERTICES {
        text.push_str(&format!("200 {x} {y} {z}\n"));
    }
    for face in FACES {
        let corners: Vec<String> = face.iter().map(u32::to_string).collect();
        text.push_str(&format!("1 9 {} {} 500\n", face.len(), corners.join(" ")));
    }
    text.push_str("3\n");
    let mut samples = vec![text.into_bytes()];
    for (name, big) in [("little", false), ("big", true)] {
        let mut out = format!("ply\nformat binary_{name}_endian 1.0\n{HEADER}").into_bytes();
        let mut put = |bytes: &[u8]| {
            if big {
                out.extend(bytes.iter().rev());
            } else {
                out.extend_from_slice(bytes);
            }
        };
        for bytes in [&[2][..], &7i16.to_le_bytes(), &8i16.to_le_bytes()] {
            put(bytes);
        }
        for [x, y, z] in VERTICES {
            put(&[200]);
            put(&(x as f32).to_le_bytes());
            put(&y.to_le_bytes());
            put(&(z as i16).to_le_bytes());
        }
        for face in FACES {
            put(&[1]);
            put(&[9]);
            put(&[face.len() as u8]);
            for corner in face {
                put(&(*corner as i32).to_le_bytes());
            }
            put(&500u16.to_le_bytes());
        }
        put(&3i32.to_le_bytes());
        samples.push(out);
    }
    samples
}

#[test]
fn ply_is_read_in_all_encodings_whatever_else_it_holds() {
    for bytes in samples() {
        let mesh = ply(&bytes).unwrap();
        assert_eq!(mesh.vertices, VERTICES);
        assert_eq!(mesh.triangles, [[0, 1, 2], [0, 2, 3], [2, 1, 0]]);
        assert_eq!(mesh.polygon_of_triangle, [0, 0, 1]);
        assert_eq!(mesh.n_polygons, 2);
    }
}

const BODY: &str = "element vertex 3\nproperty float x\nproperty float y\n\
    property float z\nelement face 1\n\
    property list uchar int vertex_index\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n";

#[test]
fn ply_text_as_it_is_found() {
    let plain = ply(format!("ply\nformat ascii 1.0\n{BODY}").as_bytes()).unwrap();
    assert_eq!(plain.triangles, [[0, 1, 2]]);
    for text in [
        format!("ply\nformat ascii 1.0\n{BODY}").replace('\n', "\r\n"),
        format!("ply\nformat ascii 1.0\n{BODY}").replace('\n', "\r"),
        format!("ply\nformat ascii 1.0\nCreated by a program\n{BODY}\n\n"),
        format!("ply\nformat ascii 1.0\n{BODY}").replace("3 0 1 2", "3 0 1 2 9 1 1 1"),
        format!("ply\nformat ascii 1.0\n{BODY}").replace("1 0 0", "1. .0 -0e0"),
    ] {
        assert_eq!(ply(text.as_bytes()).unwrap(), plain, "{text:?}");
    }
}

#[test]
fn ply_errors_name_the_place_and_the_value() {
    let with = |from: &str, to: &str| format!("ply\nformat ascii 1.0\n{}", BODY.replace(from, to));
    for (text, message) in [
        ("".to_owned(), "the file is empty"),
        (
            "OFF\n".to_owned(),
            "the file is an OFF mesh, not a PLY mesh: name it .off",
        ),
        (
            "Ply\n".to_owned(),
            "the file begins with \"Ply\", which is not a PLY header",
        ),
        (
            "ply\nformat ascii 1.0\nelement vertex 3\n".to_owned(),
            "the file has no line end_header: the file is cut off within its header",
        ),
        (
            "ply\nformat utf7 1.0\nend_header\n".to_owned(),
            "line 2: \"format utf7 1.0\" is not a line of a PLY header",
        ),
        (
            with("float x", "quad x"),
            "line 4: \"property quad x\" is not a line of a PLY header",
        ),
        (
            with("vertex 3", "vertex many"),
            "line 3: \"element vertex many\" is not a line of a PLY header",
        ),
        (
            with("vertex 3", "vertex 3000000000"),
            "the header declares 3000000000 vertices, but 26 bytes hold at most 4",
        ),
        (
            with("face 1", "face 9"),
            "the header declares 9 faces, but 8 bytes hold at most 4",
        ),
        (
            with("face 1", "face 2"),
            "the header declares 2 faces, but the file ends after 1",
        ),
        (
            with("float z", "float w"),
            "the file has no properties x, y and z of its vertices",
        ),
        (
            with("vertex_index", "corners"),
            "the file has no list vertex_indices (or vertex_index) of its faces",
        ),
        (
            with("element face 1", "element other 1"),
            "the file has no faces",
        ),
        (
            with("0 0 0\n1", "0 0 zero\n1"),
            "line 10: \"zero\" is not a number",
        ),
        (
            with("1 0 0\n", "1 0\n"),
            "line 11 ends before all 3 properties of its row are given",
        ),
        (
            with("3 0 1 2", "3 0 1 3"),
            "face 0 names vertex 3, but the mesh has 3",
        ),
        (
            with("3 0 1 2", "3 0 1 -1"),
            "face 0 names vertex -1, but the mesh has 3",
        ),
        (
            with("3 0 1 2", "0"),
            "face 0 has no corners, but at least 1 is needed",
        ),
        (
            with("3 0 1 2", "20000 0 1 2"),
            "face 0 has 20000 corners, but at most 10000 are read",
        ),
        (
            with("1 0 0\n", "1 0 nan\n"),
            "face 0 has a corner at (1, 0, NaN), but coordinates must be finite",
        ),
        (
            with("3 0 1 2", &"0 ".repeat(10_002).replacen('0', "10001", 1)),
            "face 0 has 10001 corners, but at most 10000 are read",
        ),
        (
            with("property float z", "property float z\nproperty float x"),
            "a header that declares the same element or property twice is not read, only one of \
             each name",
        ),
        (
            with("3 0 1 2\n", "3 0 1 2\n3 2 1 0\n"),
            "the file has 7 bytes beyond the data that its header declares",
        ),
    ] {
        assert_eq!(
            ply(text.as_bytes()).unwrap_err().to_string(),
            message,
            "{text:?}"
        );
    }
}

fn facet(vertices: &[[f64; 3]]) -> String {
    let lines: String = vertices
        .iter()
        .map(|[x, y, z]| format!("      vertex {x} {y} {z}\n"))
        .collect();
    format!("  facet normal 0 0 1\n    outer loop\n{lines}    endloop\n  endfacet\n")
}

/// The same two triangles as text and as binary, the latter with a header that begins like a text.
pub(super) fn stl_samples() -> [Vec<u8>; 2] {
    let [a, b, c, d] = VERTICES;
    let text = format!(
        "solid a facet\n{}{}endsolid a facet\n",
        facet(&[a, b, c]),
        facet(&[c, b, d])
    );
    let mut binary = vec![0; 80];
    binary[..5].copy_from_slice(b"solid");
    binary.extend_from_slice(&2u32.to_le_bytes());
    for triangle in [[a, b, c], [c, b, d]] {
        binary.extend_from_slice(&[0; 12]);
        let numbers = triangle.iter().flatten();
        binary.extend(numbers.flat_map(|x| (*x as f32).to_le_bytes()));
        binary.extend_from_slice(&[7, 7]);
    }
    [text.into_bytes(), binary]
}

#[test]
fn stl_is_read_as_text_and_as_binary() {
    let [a, b, c, d] = VERTICES;
    for bytes in stl_samples() {
        let mesh = stl(&bytes).unwrap();
        assert_eq!(mesh.vertices, [a, b, c, c, b, d]);
        assert_eq!(mesh.triangles, [[0, 1, 2], [3, 4, 5]]);
        assert_eq!(mesh.n_polygons, 2);
    }
    // Several solids, in capitals, and a facet with four corners.
    let text = format!(
        "SOLID\n{}ENDSOLID\nsolid\n{}endsolid",
        facet(&[a, b, c]),
        facet(&VERTICES)
    );
    let mesh = stl(text.to_uppercase().as_bytes()).unwrap();
    assert_eq!(mesh.triangles, [[0, 1, 2], [3, 4, 5], [3, 5, 6]]);
    assert_eq!(mesh.polygon_of_triangle, [0, 1, 1]);
}

#[test]
fn stl_errors_name_the_place_and_the_value() {
    let [text, mut binary] = stl_samples();
    let text = String::from_utf8(text).unwrap();
    binary[..5].copy_from_slice(b"Solid");
    binary.push(0);
    let mut named = vec![b'x'; 100];
    named[80..84].copy_from_slice(&7u32.to_le_bytes());
    let mut empty = vec![0; 84];
    empty[0] = b'x';
    for (bytes, message) in [
        (b"".to_vec(), "the file is empty"),
        (
            b"mesh\n".to_vec(),
            "the file begins with \"mesh\", which is not an STL header",
        ),
        (
            named,
            "the header declares 7 triangles, which take 434 bytes, but the file has 100",
        ),
        (empty, "the file has no faces"),
        (b"solid\nendsolid\n".to_vec(), "the file has no faces"),
        (
            text.replace("endsolid", "").into_bytes(),
            "line 16: \"a facet\" is not a line of a text STL",
        ),
        (
            text.split("endsolid").next().unwrap().into(),
            "the file has no line endsolid: it is cut off",
        ),
        (
            text.replacen("vertex 0.5 0.25 0\n", "vertex 0.5 0.25\n", 1)
                .into_bytes(),
            "line 4: a vertex has 2 coordinates, but 3 are needed",
        ),
        (
            text.replacen("vertex 0.5", "vertex half", 1).into_bytes(),
            "line 4: \"half\" is not a number",
        ),
        (
            text.replacen("vertex 0.5", "vertex inf", 1).into_bytes(),
            "face 0 has a corner at (inf, 0.25, 0), but coordinates must be finite",
        ),
        (
            b"solid\nouter loop\nendloop\nendsolid\n".to_vec(),
            "line 3: face 0 has no corners, but at least 1 is needed",
        ),
    ] {
        assert_eq!(stl(&bytes).unwrap_err().to_string(), message);
    }
    assert!(stl(&binary).is_err(), "one byte too many");
}

#[test]
fn text_stl_may_have_several_statements_on_a_line() {
    let [text, _] = stl_samples();
    let plain = stl(&text).unwrap();
    let text = String::from_utf8(text).unwrap();
    let facets = text.split_once('\n').unwrap().1.replace('\n', " ");
    for (text, n) in [
        (text.replace("endloop\n  endfacet", "endloop endfacet"), 2),
        (text.replace("0 0 1\n    outer", "0 0 1 outer"), 2),
        (text.replace("0 0 1\n", "-nan(ind) nan nan\n"), 0),
        // The name ends where a facet begins with its normal.
        (format!("solid a facet {facets}"), 15),
        (format!("solid a facet\n{facets}\n"), 14),
    ] {
        let mesh = stl(text.as_bytes()).unwrap_or_else(|e| panic!("{text}: {e}"));
        assert_eq!(mesh.triangles, plain.triangles, "{text}");
        assert_eq!(mesh.vertices, plain.vertices, "{text}");
        assert_eq!(mesh.findings.n_tolerated_statements, n, "{text}");
        assert_eq!(mesh.findings.n_unread_statements, 0, "{text}");
    }
    let coloured = text.replacen("vertex 0.5 0.25 0\n", "vertex 0.5 0.25 0 255 0 0\n", 1);
    let mesh = stl(coloured.as_bytes()).unwrap();
    assert_eq!(mesh.vertices, plain.vertices);
    assert_eq!(mesh.findings.n_unread_statements, 1);
    // Unknown words begin a line; whether they are geometry is unknown.
    assert_eq!(
        stl(text.replacen("endfacet", "end facet", 1).as_bytes())
            .unwrap_err()
            .to_string(),
        "line 8: \"end facet\" is not a line of a text STL"
    );
}
