use super::{MAX_CORNERS, ParseError, parse};
use crate::mesh::{Findings, Format, ParsedMesh, cross, norm, sub, write};

fn obj(text: &str) -> Result<ParsedMesh, ParseError> {
    parse(text.as_bytes(), Format::Obj)
}

fn off(text: &str) -> Result<ParsedMesh, ParseError> {
    parse(text.as_bytes(), Format::Off)
}

const V4: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n";

#[test]
fn format_is_told_by_the_extension() {
    assert_eq!(Format::from_name("a/b.c.OBJ"), Some(Format::Obj));
    assert_eq!(Format::from_name("x.off"), Some(Format::Off));
    assert_eq!(Format::from_name("x.STL"), Some(Format::Stl));
    assert_eq!(Format::from_name("x.ply"), Some(Format::Ply));
    assert_eq!(Format::from_name("x.glb"), Some(Format::Gltf));
    assert_eq!(Format::from_name("x.gltf"), Some(Format::Gltf));
    assert_eq!(Format::from_name("x.step"), None);
    for format in Format::ALL {
        assert_eq!(
            Format::from_name(&format!("x.{}", format.name())),
            Some(format)
        );
    }
    assert_eq!(Format::from_name("obj"), None);
    assert_eq!(Format::from_name(".obj"), None);
}

#[test]
fn obj_polygons_keep_file_order_over_groups_and_materials() {
    let text = format!(
        "mtllib none.mtl\n{V4}vt 0 0\nvn 0 0 1\nv 9 9 9\no first\nusemtl red\nf 2 3 4\ng second\n\
         f 1/1/1 2//1 3/1 4 # a quad\nl 1 2 3\np 1\nusemtl blue\nf -5 -4 \\\n -3\n"
    );
    let mesh = obj(&text).unwrap();
    assert_eq!(mesh.vertices.len(), 5);
    assert_eq!(mesh.vertices[4], [9.0, 9.0, 9.0]);
    assert_eq!(mesh.n_polygons, 3);
    assert_eq!(mesh.triangles, [[1, 2, 3], [0, 1, 2], [0, 2, 3], [0, 1, 2]]);
    assert_eq!(mesh.polygon_of_triangle, [0, 1, 1, 2]);
}

#[test]
fn obj_keeps_double_precision_and_ignores_colours() {
    let mesh = obj("v 500000.123456789 0 0 1 0 0\nv 1 0 0 0.5\nv 0 1 0\nf 1 2 3\n").unwrap();
    assert_eq!(mesh.vertices[0][0], 500000.123456789);
    assert_eq!(mesh.vertices[1], [1.0, 0.0, 0.0]);
    assert_eq!(mesh.triangles, [[0, 1, 2]]);
}

#[test]
fn faces_with_one_or_two_corners_keep_their_numbers() {
    let mesh = obj(&format!("{V4}f 1 2\nf 1 2 3\nf 4\n")).unwrap();
    assert_eq!(mesh.triangles, [[0, 1, 1], [0, 1, 2], [3, 3, 3]]);
    assert_eq!(mesh.polygon_of_triangle, [0, 1, 2]);
    let mesh = off("OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n2 0 1\n3 0 1 2\n").unwrap();
    assert_eq!(mesh.triangles, [[0, 1, 1], [0, 1, 2]]);
}

#[test]
fn obj_errors_name_the_place_and_the_value() {
    for (text, message) in [
        ("v 0 0 0\n", "the file has no faces"),
        ("", "the file is empty"),
        ("\n# nothing\n", "the file has no faces"),
        (
            "v 0 0 0\np 1\nl 1 1\n",
            "the file has no faces, but 2 statements that are not read: the first is \"p 1\" in \
             line 2",
        ),
        (
            "v 0 0\nf 1 1 1\n",
            "line 1: a vertex has 2 coordinates, but 3 are needed",
        ),
        (
            "v 0 0 0\nv 1 x 0\nf 1 1 1\n",
            "line 2: \"x\" is not a number",
        ),
        ("v 0 0 0\nf 1 1 y/2\n", "line 2: \"y\" is not a number"),
        ("v 0 0 0\nf 1 1 /2\n", "line 2: \"\" is not a number"),
        (
            "v 0 0 0\nf\n",
            "line 2: face 0 has no corners, but at least 1 is needed",
        ),
        (
            "v 0 0 0\nf 1 1 1\nf 1 1 2\n",
            "face 1 names vertex 2, but the mesh has 1",
        ),
        (
            "v 0 0 0\nf 1 1 0\n",
            "face 0 names vertex 0, but the mesh has 1",
        ),
        (
            "v 0 0 0\nf 1 1 -2\n",
            "face 0 names vertex -2, but the mesh has 1",
        ),
        (
            "v 0 0 0\nf 1 1 1\nv 0 inf 0\nf 1 1 2\n",
            "face 1 has a corner at (0, inf, 0), but coordinates must be finite",
        ),
        (
            "v nan 0 0\nf 1 1 1\n",
            "face 0 has a corner at (NaN, 0, 0), but coordinates must be finite",
        ),
    ] {
        assert_eq!(obj(text).unwrap_err().to_string(), message, "{text:?}");
    }
    let huge = format!("v 0 0 0\nf{}\n", " 1".repeat(MAX_CORNERS + 1));
    assert_eq!(
        obj(&huge).unwrap_err(),
        ParseError::PolygonTooLarge {
            face: 0,
            corners: MAX_CORNERS as u64 + 1
        }
    );
}

#[test]
fn non_finite_vertices_that_no_face_uses_are_harmless() {
    assert_eq!(
        obj(&format!("{V4}v nan 0 0\nf 1 2 3\n"))
            .unwrap()
            .vertices
            .len(),
        5
    );
}

const OFF_BODY: &str = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n3 0 1 2\n";

#[test]
fn off_headers_in_all_their_spellings() {
    let plain = off(&format!("OFF\n4 2 0\n{OFF_BODY}")).unwrap();
    assert_eq!(plain.n_polygons, 2);
    assert_eq!(plain.triangles, [[0, 1, 2], [0, 2, 3], [0, 1, 2]]);
    for header in [
        "OFF 4 2 0\n",
        "OFF4 2 0\n",
        "4 2 0\n",
        "# made by hand\nOFF # header\n\n4 2\n",
        "STCNOFF\n4 2 0\n",
        "NCOFF\n4 2 0\n",
        "STNCOFF 4 2\n",
        "NSTOFF\n4\n2 0\n",
        "nOFF\n3\n4 2 0\n",
        "CnOFF 3\n4 2 0\n",
        "CnNSTOFF 3 4 2 0\n",
        "\u{feff}OFF\r\n4 2 0\r\n",
    ] {
        assert_eq!(
            off(&format!("{header}{OFF_BODY}")).unwrap(),
            plain,
            "{header:?}"
        );
    }
    let coloured = "COFF\n4 2 0\n0 0 0 255 0 0 255\n1 0 0 1 2 3 4\n1 1 0 .1 .2 .3 1\n0 1 0\n\
                    4 0 1 2 3 0.5 0.5 0.5\n3 0 1 2 # last\n";
    assert_eq!(off(coloured).unwrap(), plain);
    let homogeneous = "N4OFF\n4 2 0\n0 0 0 1 0 0 1\n2 0 0 2 0 0 1\n-1 -1 0 -1 0 0 1\n0 .5 0 .5\n\
                       4 0 1 2 3\n3 0 1 2\n";
    assert_eq!(off(homogeneous).unwrap(), plain);
    assert_eq!(
        off(&homogeneous.replace("N4OFF", "4nOFF 3")).unwrap(),
        plain
    );
}

#[test]
fn off_errors_name_the_place_and_the_value() {
    for (text, message) in [
        ("", "the file is empty"),
        (
            "\n",
            "the file begins with \"\", which is not an OFF header",
        ),
        (
            "ply\n",
            "the file is a PLY mesh, not an OFF mesh: name it .ply",
        ),
        (
            "XOFF\n1 1 0\n",
            "the file begins with \"XOFF\", which is not an OFF header",
        ),
        ("OFF BINARY\n", "binary OFF is not read, save it as text"),
        (
            "CCOFF\n1 1 0\n",
            "the file begins with \"CCOFF\", which is not an OFF header",
        ),
        (
            "nOFF\n5\n1 1 0\n0 0 0 0 0\n1 0\n",
            "OFF with 5 dimensions is not read, save it with 3",
        ),
        (
            "4OFF\n1 1 0\n0 0 0\n1 0\n",
            "line 3: a vertex has 3 coordinates, but 4 are needed",
        ),
        (
            "4OFF\n1 1 0\n0 0 1 0\n1 0\n",
            "face 0 has a corner at (NaN, NaN, inf), but coordinates must be finite",
        ),
        ("OFF\n", "the file has no faces"),
        ("OFF\n1 0 0\n0 0 0\n", "the file has no faces"),
        (
            "OFF\n99999999999 1 0\n0 0 0\n",
            "the header declares 99999999999 vertices, but 26 bytes hold at most 4",
        ),
        (
            "OFF\n1 1000000 0\n0 0 0\n",
            "the header declares 1000000 faces, but 22 bytes hold at most 5",
        ),
        (
            "OFF\n3 1 0\n0 0 0\n1 1 1\n",
            "the header declares 3 vertices, but the file ends after 2",
        ),
        (
            "OFF\n1 2 0\n0 0 0\n3 0 0 0\n",
            "the header declares 2 faces, but the file ends after 1",
        ),
        (
            "OFF\n1 1 0\n0 0 0\n3 0 0 0\n3 0 0 0\n",
            "line 5 follows the 1 faces that the header declares",
        ),
        (
            "OFF\n1 1 0\n0 0 0\n3 0 0\n",
            "line 4: face 0 has 2 corners, but declares 3",
        ),
        (
            "OFF\n1 1 0\n0 0 0\n3 0 0 1\n",
            "face 0 names vertex 1, but the mesh has 1",
        ),
        (
            "OFF\n1 1 0\n0 0 0\n3 0 0 -1\n",
            "face 0 names vertex -1, but the mesh has 1",
        ),
        (
            "OFF\n1 1 0\n0 0 0\n0 0\n",
            "line 4: face 0 has no corners, but at least 1 is needed",
        ),
        (
            "OFF\n1 1 0\n0 0 0\n20000 0\n",
            "face 0 has 20000 corners, but at most 10000 are read",
        ),
        (
            "OFF\n1 1 0\n0 0 z\n3 0 0 0\n",
            "line 3: \"z\" is not a number",
        ),
        (
            "OFF\n1 1 0\n0 0 nan\n3 0 0 0\n",
            "face 0 has a corner at (0, 0, NaN), but coordinates must be finite",
        ),
    ] {
        assert_eq!(off(text).unwrap_err().to_string(), message, "{text:?}");
    }
}

/// Three faces of a cube, of which the last is given by each line that programs interpret
/// differently.
#[test]
fn obj_statements_that_programs_differ_about_are_read_and_counted() {
    let plain = obj(&format!("{V4}f 1 2 3\nf 1 2 3 4\n")).unwrap();
    for (text, n) in [
        ("f 1 2 3\nfo 1 2 3 4\n", 1),
        ("f 1 2 3 # of C:\\\nf 1 2 3 4\n", 1),
        ("# maps in D:\\maps\\\nf 1 2 3\n# more \\ \nf 1 2 3 4\n", 2),
        ("# a \\ within\nf 1 \\\n2 3\nf 1 2 3 4\n", 0),
        ("f 1 2 3\rf 1 2 3 4\n", 1),
    ] {
        let mesh = obj(&format!("{V4}{text}")).unwrap();
        assert_eq!(mesh.triangles, plain.triangles, "{text:?}");
        assert_eq!(mesh.findings.n_tolerated_statements, n, "{text:?}");
        assert_eq!(mesh.findings.n_unread_statements, 0, "{text:?}");
    }
}

#[test]
fn obj_geometry_that_is_not_read_is_counted() {
    let text = format!(
        "mtllib a.mtl\no x\ng y\ns 1\nvt 0 0\nvn 0 0 1\nvp 0\n{V4}usemtl z\nf 1 2 3\n\
         l 1 2\np 1\ncstype bezier\ndeg 3\ncurv 0 1 1 2 3 4\nparm u 0 1\nend\nsurf 0 1 0 1 1\n\
         F 1 2 3\ncall other.obj\n"
    );
    let findings = obj(&text).unwrap().findings;
    assert_eq!(findings.n_unread_statements, 6);
    assert_eq!(findings.n_tolerated_statements, 0);
}

/// Every text format, with all line ends and in all Unicode encodings.
#[test]
fn texts_are_read_in_every_encoding_and_with_every_line_end() {
    let ply = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\n\
               property float y\nproperty float z\n\
               element face 1\nproperty list uchar int vertex_index\nend_header\n0 0 0\n1 0 0\n\
               0 1 0\n3 0 1 2\n";
    let stl = "solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\n\
               vertex 0 1 0\nendloop\n\
               endfacet\nendsolid x\n";
    for (format, text) in [
        (Format::Obj, "# x\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 \\\n2 3\n"),
        (Format::Off, "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"),
        (Format::Ply, ply),
        (Format::Stl, stl),
    ] {
        let plain = parse(text.as_bytes(), format).unwrap();
        for end in ["\n", "\r\n", "\r", "\r\r\n"] {
            let text = text.replace('\n', end);
            let wide = |bytes: fn(u16) -> [u8; 2]| -> Vec<u8> {
                text.encode_utf16().flat_map(bytes).collect()
            };
            let (little, big) = (wide(u16::to_le_bytes), wide(u16::to_be_bytes));
            for (name, bytes) in [
                ("UTF-8", text.as_bytes().to_vec()),
                (
                    "a byte-order mark",
                    [b"\xef\xbb\xbf", text.as_bytes()].concat(),
                ),
                (
                    "UTF-16LE with a mark",
                    [b"\xff\xfe", little.as_slice()].concat(),
                ),
                (
                    "UTF-16BE with a mark",
                    [b"\xfe\xff", big.as_slice()].concat(),
                ),
                ("UTF-16LE", little),
                ("UTF-16BE", big),
            ] {
                let read = parse(&bytes, format);
                assert_eq!(read.as_ref(), Ok(&plain), "{format:?}, {name}, {end:?}");
            }
        }
    }
}

/// A prism over a C, whose caps begin at any corner; by hand: 2 x 7 for the caps and 16 for the
/// walls.
fn c_prism(start: usize) -> String {
    let c = ["0 0", "3 0", "3 1", "1 1", "1 2", "3 2", "3 3", "0 3"];
    let vertices: String = [0, 1]
        .iter()
        .flat_map(|z| c.map(|xy| format!("v {xy} {z}\n")))
        .collect();
    let corner = |i: usize| 1 + (i + start) % 8;
    let bottom: String = (0..8).map(|i| format!(" {}", corner(8 - i))).collect();
    let top: String = (0..8).map(|i| format!(" {}", corner(i) + 8)).collect();
    let walls: String = (0..8)
        .map(|i| (1 + i, 1 + (i + 1) % 8))
        .map(|(a, b)| format!("f {a} {b} {} {}\n", b + 8, a + 8))
        .collect();
    format!("{vertices}f{bottom}\nf{top}\n{walls}")
}

fn area(mesh: &ParsedMesh) -> f64 {
    let corners = mesh
        .triangles
        .iter()
        .map(|t| t.map(|v| mesh.vertices[v as usize]));
    corners
        .map(|[a, b, c]| 0.5 * norm(cross(sub(b, a), sub(c, a))))
        .sum()
}

#[test]
fn concave_faces_have_the_area_they_have_in_every_format_and_in_exports() {
    for start in 0..8 {
        let mesh = obj(&c_prism(start)).unwrap();
        assert!((area(&mesh) - 30.0).abs() < 1e-12, "{start}");
        assert_eq!(mesh.n_polygons, 10);
        assert_eq!(mesh.findings, Findings::default());
        let polygons = mesh.polygons();
        assert_eq!(polygons[1].len(), 8);
        assert_eq!(polygons[1][0] as usize, 8 + start);
        let labels: Vec<i32> = (0..10).collect();
        let labelling = write::Labelling {
            labels: &labels,
            confidence: None,
            styles: &Default::default(),
        };
        let glb = write::glb("c", &mesh.vertices, &polygons, &labelling, None);
        let glb = parse(&glb, Format::Gltf).unwrap();
        assert!((area(&glb) - 30.0).abs() < 1e-6, "{start}");
        assert_eq!(glb.triangles.len(), mesh.triangles.len());
        let ply = write::ply(&mesh.vertices, &polygons, &[[0; 3]; 10], &labels);
        assert_eq!(parse(&ply, Format::Ply).unwrap(), mesh);
        let text = write::obj(&mesh.vertices, &polygons, &labelling, "a.mtl");
        assert_eq!(obj(&text).unwrap(), mesh);
        let lines: String = polygons
            .iter()
            .map(|p| {
                format!(
                    "{} {}\n",
                    p.len(),
                    p.iter().map(u32::to_string).collect::<Vec<_>>().join(" ")
                )
            })
            .collect();
        let vertices: String = mesh
            .vertices
            .iter()
            .map(|[x, y, z]| format!("{x} {y} {z}\n"))
            .collect();
        assert_eq!(
            off(&format!("OFF\n16 10 0\n{vertices}{lines}")).unwrap(),
            mesh
        );
    }
}

#[test]
fn faces_that_are_not_planar_or_cross_themselves_are_counted() {
    let text = "v 0 0 0\nv 1 0 0\nv 1 1 0.5\nv 0 1 0\nv 1 1 0\nf 1 2 3 4\nf 1 2 5 4\nf 1 5 2 4\n";
    let mesh = obj(text).unwrap();
    assert_eq!(mesh.findings.n_nonplanar_polygons, 1);
    assert_eq!(mesh.findings.n_nonsimple_polygons, 1);
    // Each polygon is its fan, as before such statements were counted.
    assert_eq!(
        mesh.triangles,
        [
            [0, 1, 2],
            [0, 2, 3],
            [0, 1, 4],
            [0, 4, 3],
            [0, 4, 1],
            [0, 1, 3]
        ]
    );
}
