use super::{MAX_CORNERS, ParseError, parse};
use crate::mesh::{Format, ParsedMesh};

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
        ("", "the file has no faces"),
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
}

#[test]
fn off_errors_name_the_place_and_the_value() {
    for (text, message) in [
        ("", "the file begins with \"\", which is not an OFF header"),
        (
            "ply\n",
            "the file begins with \"ply\", which is not an OFF header",
        ),
        (
            "XOFF\n1 1 0\n",
            "the file begins with \"XOFF\", which is not an OFF header",
        ),
        (
            "OFF BINARY\n",
            "binary OFF is not read, only text in three dimensions",
        ),
        (
            "4OFF\n1 1 0\n",
            "4OFF with other dimensions is not read, only text in three dimensions",
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
            "line 5 goes on after the 1 faces the header declares",
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
