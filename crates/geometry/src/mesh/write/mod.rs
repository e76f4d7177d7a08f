//! Writes a mesh as the bytes of a file, with labels and colours in formats that hold them.
//!
//! Coordinates are written with enough digits to read the same number back; labels keep the order
//! of the polygons.

mod attributes;
mod glb;
mod gltf;
mod labelling;
mod obj;
mod obj_glb;
mod paint;
mod ply;
mod usda;

pub use attributes::{Attributes, OwnMaterial};
pub use glb::{glb, glb_of};
pub use gltf::labelled_gltf;
pub use labelling::{LabelStyle, Labelling, Materials};
pub use obj::{OwnNames, labelled_obj, mtl, mtl_entry, obj, obj_with};
pub use obj_glb::glb_of_obj;
pub use ply::{ply, ply_with};
pub use usda::usda;

use super::TriMesh;
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
    use super::{Labelling, npy, obj, off, ply, seg};
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
    fn what_is_written_our_own_readers_read() {
        let mesh = two_triangles();
        let polygons = [vec![0, 1, 2], vec![2, 1, 3], vec![0, 1, 3, 2]];
        let labelling = Labelling {
            labels: &[4, 4, 5],
            confidence: None,
            styles: &Default::default(),
        };
        let text = obj(&mesh.vertices, &polygons, &labelling, "a.mtl");
        let bytes = ply(&mesh.vertices, &polygons, &[[1, 2, 3]; 3], &[4, 4, 5]);
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
    }
}
