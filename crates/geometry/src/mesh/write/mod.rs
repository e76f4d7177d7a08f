//! Writes a mesh as the bytes of a file, with labels and colours in formats that hold them.
//!
//! Coordinates are written with enough digits to read the same number back; labels keep the order
//! of the polygons.

mod glb;
mod usda;

pub use glb::{glb, glb_of};
pub use usda::usda;

use super::TriMesh;
use std::collections::BTreeMap;
use std::fmt::Write;

/// Writes Object File Format text. Reading it returns the same numbers.
///
/// ```
/// use coseg_geometry::mesh::{Format, icosphere, parse, write};
///
/// let sphere = icosphere(1);
/// let read = parse(write::off(&sphere).as_bytes(), Format::Off)?;
/// assert_eq!((read.vertices, read.triangles), (sphere.vertices, sphere.faces));
/// # Ok::<_, coseg_geometry::mesh::ParseError>(())
/// ```
pub fn off(mesh: &TriMesh) -> String {
    let mut out = String::with_capacity(60 * mesh.vertices.len() + 20 * mesh.faces.len());
    out.push_str("OFF\n");
    line(
        &mut out,
        format_args!("{} {} 0", mesh.vertices.len(), mesh.faces.len()),
    );
    for [x, y, z] in &mesh.vertices {
        line(&mut out, format_args!("{x} {y} {z}"));
    }
    for [a, b, c] in &mesh.faces {
        line(&mut out, format_args!("3 {a} {b} {c}"));
    }
    out
}

/// Writes Wavefront OBJ text: a group and a material, named by `name`, for every run of polygons of
/// one label. `material_file` is the name of a file with the text of [`mtl`].
///
/// ```
/// use coseg_geometry::mesh::write;
///
/// let vertices = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
/// let text = write::obj(&vertices, &[[0, 1, 2]], &[7], |l| format!("part-{l}"), "parts.mtl");
/// assert!(text.starts_with("mtllib parts.mtl\nv 0 0 0\n"));
/// assert!(text.ends_with("g part-7\nusemtl part-7\nf 1 2 3\n"));
/// ```
///
/// # Panics
/// If there is not one label per polygon.
pub fn obj<P: AsRef<[u32]>>(
    vertices: &[[f64; 3]],
    polygons: &[P],
    labels: &[i32],
    name: impl Fn(i32) -> String,
    material_file: &str,
) -> String {
    assert_eq!(polygons.len(), labels.len(), "one label per polygon");
    let mut out = String::with_capacity(60 * vertices.len() + 20 * polygons.len());
    line(&mut out, format_args!("mtllib {material_file}"));
    for [x, y, z] in vertices {
        line(&mut out, format_args!("v {x} {y} {z}"));
    }
    let mut current = None;
    for (polygon, &label) in polygons.iter().zip(labels) {
        if current != Some(label) {
            current = Some(label);
            let name = name(label);
            line(&mut out, format_args!("g {name}\nusemtl {name}"));
        }
        out.push('f');
        for corner in polygon.as_ref() {
            // OBJ counts from 1; u64 holds the successor of every u32.
            append(&mut out, format_args!(" {}", u64::from(*corner) + 1));
        }
        out.push('\n');
    }
    out
}

/// Writes materials for [`obj`], as MTL text: a name and a diffuse sRGB colour each.
///
/// ```
/// let text = coseg_geometry::mesh::write::mtl(&[("leg".to_string(), [255, 0, 0])]);
/// assert_eq!(text, "newmtl leg\nKd 1.0000 0.0000 0.0000\n");
/// ```
pub fn mtl(materials: &[(String, [u8; 3])]) -> String {
    let mut out = String::new();
    for (name, colour) in materials {
        let [r, g, b] = colour.map(|c| f64::from(c) / 255.0);
        line(
            &mut out,
            format_args!("newmtl {name}\nKd {r:.4} {g:.4} {b:.4}"),
        );
    }
    out
}

/// Writes binary little-endian PLY: `double` coordinates; for each face its corners, `red green
/// blue` and `int label`.
///
/// ```
/// use coseg_geometry::mesh::{Format, parse, write};
///
/// let vertices = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];
/// let bytes = write::ply(&vertices, &[[0, 1, 2, 3]], &[[255, 0, 0]], &[7]);
/// assert_eq!(parse(&bytes, Format::Ply)?.polygons(), [[0, 1, 2, 3]]);
/// # Ok::<_, coseg_geometry::mesh::ParseError>(())
/// ```
///
/// # Panics
/// If there is not one colour and one label per polygon.
pub fn ply<P: AsRef<[u32]>>(
    vertices: &[[f64; 3]],
    polygons: &[P],
    colours: &[[u8; 3]],
    labels: &[i32],
) -> Vec<u8> {
    assert_eq!(polygons.len(), colours.len(), "one colour per polygon");
    assert_eq!(polygons.len(), labels.len(), "one label per polygon");
    // Most readers expect a one-byte count; it is widened only when a polygon needs it.
    let wide = polygons
        .iter()
        .any(|p| p.as_ref().len() > usize::from(u8::MAX));
    let count = if wide { "uint" } else { "uchar" };
    let mut header = String::from("ply\nformat binary_little_endian 1.0\n");
    line(
        &mut header,
        format_args!("element vertex {}", vertices.len()),
    );
    header.push_str("property double x\nproperty double y\nproperty double z\n");
    line(&mut header, format_args!("element face {}", polygons.len()));
    line(
        &mut header,
        format_args!("property list {count} uint vertex_indices"),
    );
    header.push_str("property uchar red\nproperty uchar green\nproperty uchar blue\n");
    header.push_str("property int label\nend_header\n");
    let mut out = header.into_bytes();
    for x in vertices.iter().flatten() {
        out.extend_from_slice(&x.to_le_bytes());
    }
    for ((polygon, colour), label) in polygons.iter().zip(colours).zip(labels) {
        let corners = polygon.as_ref();
        if wide {
            out.extend_from_slice(&(corners.len() as u32).to_le_bytes());
        } else {
            out.push(corners.len() as u8);
        }
        for corner in corners {
            out.extend_from_slice(&corner.to_le_bytes());
        }
        out.extend_from_slice(colour);
        out.extend_from_slice(&label.to_le_bytes());
    }
    out
}

/// Writes an array of int32 `(n,)` in NumPy's format (version 1.0).
///
/// ```
/// let bytes = coseg_geometry::mesh::write::npy(&[1, -1]);
/// assert!(bytes.starts_with(b"\x93NUMPY"));
/// assert_eq!(bytes[bytes.len() - 8..], [1, 0, 0, 0, 255, 255, 255, 255]);
/// ```
pub fn npy(values: &[i32]) -> Vec<u8> {
    // The data begin at a multiple of 64 bytes; magic, version and length take 10.
    let mut header = format!(
        "{{'descr': '<i4', 'fortran_order': False, 'shape': ({},), }}",
        values.len()
    );
    while !(10 + header.len() + 1).is_multiple_of(64) {
        header.push(' ');
    }
    header.push('\n');
    let mut out = b"\x93NUMPY\x01\x00".to_vec();
    out.extend_from_slice(&(header.len() as u16).to_le_bytes());
    out.extend_from_slice(header.as_bytes());
    out.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    out
}

/// Writes the label of each polygon, one on each line, like Princeton's `.seg` files.
///
/// ```
/// assert_eq!(coseg_geometry::mesh::write::seg(&[0, 0, 3]), "0\n0\n3\n");
/// ```
pub fn seg(labels: &[i32]) -> String {
    let mut out = String::with_capacity(3 * labels.len());
    for label in labels {
        line(&mut out, format_args!("{label}"));
    }
    out
}

/// Polygons of each label, both ascending.
fn by_label(labels: &[i32]) -> BTreeMap<i32, Vec<u32>> {
    let mut groups: BTreeMap<i32, Vec<u32>> = BTreeMap::new();
    for (polygon, &label) in (0..).zip(labels) {
        groups.entry(label).or_default().push(polygon);
    }
    groups
}

/// First and count of each run of consecutive numbers.
fn runs(ascending: &[u32]) -> impl Iterator<Item = (u32, usize)> {
    ascending
        .chunk_by(|a, b| *b == a + 1)
        .map(|run| (run[0], run.len()))
}

fn line(out: &mut String, text: std::fmt::Arguments<'_>) {
    append(out, text);
    out.push('\n');
}

fn append(out: &mut String, text: std::fmt::Arguments<'_>) {
    out.write_fmt(text)
        .expect("invariant: writing to a string cannot fail");
}

#[cfg(test)]
mod tests {
    use super::{mtl, npy, obj, off, ply, runs, seg};
    use crate::mesh::{Format, TriMesh, parse};

    fn two_triangles() -> TriMesh {
        TriMesh {
            vertices: vec![
                [0.0, 0.0, 0.0],
                [1.0, 0.0, 0.0],
                [0.0, 1.0, 0.0],
                [0.1, 1e-7, -2.5],
            ],
            faces: vec![[0, 1, 2], [2, 1, 3]],
        }
    }

    #[test]
    fn off_reads_back_exactly() {
        let mesh = two_triangles();
        let text = off(&mesh);
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines[..2], ["OFF", "4 2 0"]);
        assert_eq!(lines[6..], ["3 0 1 2", "3 2 1 3"]);
        for (line, vertex) in lines[2..6].iter().zip(&mesh.vertices) {
            let read: Vec<f64> = line.split(' ').map(|t| t.parse().unwrap()).collect();
            assert_eq!(read, vertex);
        }
    }

    #[test]
    fn obj_keeps_the_order_and_groups_runs() {
        let mesh = two_triangles();
        let polygons = [vec![0, 1, 2], vec![2, 1, 3], vec![0, 1, 3, 2]];
        let name = |label: i32| format!("label_{label}");
        let text = obj(&mesh.vertices, &polygons, &[4, 4, -1], name, "a.mtl");
        let rest: Vec<&str> = text.lines().filter(|l| !l.starts_with("v ")).collect();
        let expected = [
            "mtllib a.mtl",
            "g label_4",
            "usemtl label_4",
            "f 1 2 3",
            "f 3 2 4",
            "g label_-1",
            "usemtl label_-1",
            "f 1 2 4 3",
        ];
        assert_eq!(rest, expected);
        let materials = [("a".to_owned(), [255, 0, 51]), ("b".to_owned(), [0; 3])];
        let expected = "newmtl a\nKd 1.0000 0.0000 0.2000\nnewmtl b\nKd 0.0000 0.0000 0.0000\n";
        assert_eq!(mtl(&materials), expected);
    }

    #[test]
    fn ply_has_the_bytes_its_header_promises() {
        let mesh = two_triangles();
        let bytes = ply(
            &mesh.vertices,
            &mesh.faces,
            &[[1, 2, 3], [4, 5, 6]],
            &[9, -1],
        );
        let end = b"end_header\n";
        let at = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
        let header = std::str::from_utf8(&bytes[..at]).unwrap();
        assert!(header.contains("element vertex 4\n") && header.contains("element face 2\n"));
        let body = &bytes[at..];
        assert_eq!(body.len(), 4 * 24 + 2 * (1 + 12 + 3 + 4));
        assert_eq!(body[3 * 24..3 * 24 + 8], 0.1f64.to_le_bytes());
        let face = &body[4 * 24 + 20..];
        assert_eq!(face[0], 3);
        assert_eq!(face[1..5], 2u32.to_le_bytes());
        assert_eq!(face[13..16], [4, 5, 6]);
        assert_eq!(face[16..20], (-1i32).to_le_bytes());
    }

    #[test]
    fn what_is_written_our_own_readers_read() {
        let mesh = two_triangles();
        let polygons = [vec![0, 1, 2], vec![2, 1, 3], vec![0, 1, 3, 2]];
        let name = |label: i32| format!("label_{label}");
        let text = obj(&mesh.vertices, &polygons, &[4, 4, -1], name, "a.mtl");
        let bytes = ply(&mesh.vertices, &polygons, &[[1, 2, 3]; 3], &[4, 4, -1]);
        for (bytes, format) in [(text.into_bytes(), Format::Obj), (bytes, Format::Ply)] {
            let read = parse(&bytes, format).unwrap();
            assert_eq!(read.vertices, mesh.vertices);
            assert_eq!(read.triangles, [[0, 1, 2], [2, 1, 3], [0, 1, 3], [0, 3, 2]]);
            assert_eq!(read.polygon_of_triangle, [0, 1, 2, 2]);
        }
        let read = parse(off(&mesh).as_bytes(), Format::Off).unwrap();
        assert_eq!((read.vertices, read.triangles), (mesh.vertices, mesh.faces));
    }

    #[test]
    fn labels_alone_have_the_bytes_their_readers_expect() {
        assert_eq!(seg(&[3, -1, 12]), "3\n-1\n12\n");
        let bytes = npy(&[1, -1]);
        assert_eq!(bytes.len(), 128 + 8);
        assert_eq!(&bytes[..10], b"\x93NUMPY\x01\x00\x76\x00");
        let header = std::str::from_utf8(&bytes[10..128]).unwrap();
        assert!(header.starts_with("{'descr': '<i4', 'fortran_order': False, 'shape': (2,), }"));
        assert!(header.ends_with(" \n"));
        assert_eq!(bytes[128..], [1, 0, 0, 0, 255, 255, 255, 255]);
        assert_eq!(npy(&[]).len(), 128);
        let found: Vec<(u32, usize)> = runs(&[0, 1, 2, 5, 7, 8]).collect();
        assert_eq!(found, [(0, 3), (5, 1), (7, 2)]);
    }

    #[test]
    fn ply_widens_the_count_for_large_polygons() {
        let polygon: Vec<u32> = (0..300).collect();
        let vertices = vec![[0.0; 3]; 300];
        let bytes = ply(&vertices, &[polygon], &[[0; 3]], &[0]);
        let header = String::from_utf8_lossy(&bytes[..300]).into_owned();
        assert!(header.contains("property list uint uint vertex_indices"));
    }
}
