//! Labelled polygons become a binary PLY file.

use super::attributes::Kind;
use super::{Attributes, Materials, line};
use std::cmp::Ordering;

/// Grey of vertices that no polygon uses.
const UNUSED: [u8; 3] = [128; 3];

/// Binary little-endian PLY: `double` coordinates; per face its corners, `red green blue` and
/// `int label`. Vertices have these properties, too, for programs that show none of faces: those of
/// the label with the largest area around them, or grey and -1 without faces.
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
    let none = (&Attributes::default(), Materials::Labels);
    ply_with(vertices, polygons, colours, labels, none)
}

/// Like [`ply`], with the normals of another file (`float nx ny nz`) and, for [`Materials::Own`],
/// its colours at the vertices; faces have the colours of their labels. A vertex has one of either
/// here: if one has two normals, as at a sharp edge, there are none, and so with colours.
///
/// # Panics
/// If there is not one colour and one label per polygon.
pub fn ply_with<P: AsRef<[u32]>>(
    vertices: &[[f64; 3]],
    polygons: &[P],
    colours: &[[u8; 3]],
    labels: &[i32],
    (attributes, materials): (&Attributes, Materials),
) -> Vec<u8> {
    assert_eq!(polygons.len(), colours.len(), "one colour per polygon");
    assert_eq!(polygons.len(), labels.len(), "one label per polygon");
    // A one-byte count is what most readers expect; it is widened only when a polygon needs it.
    let wide = polygons
        .iter()
        .any(|p| p.as_ref().len() > usize::from(u8::MAX));
    let count = if wide { "uint" } else { "uchar" };
    let (n_vertices, n_polygons) = (vertices.len(), polygons.len());
    const PAINT: &str =
        "property uchar red\nproperty uchar green\nproperty uchar blue\nproperty int label\n";
    let mut header = String::from("ply\nformat binary_little_endian 1.0\n");
    line(&mut header, format_args!("element vertex {n_vertices}"));
    header.push_str("property double x\nproperty double y\nproperty double z\n");
    let values = (&attributes.normals, &attributes.colours);
    let normals = attributes.of_vertices(polygons, n_vertices, Kind::Normal, values.0);
    let own = attributes.of_vertices(polygons, n_vertices, Kind::Colour, values.1);
    let own = own.filter(|_| materials == Materials::Own);
    if normals.is_some() {
        header.push_str("property float nx\nproperty float ny\nproperty float nz\n");
    }
    header.push_str(PAINT);
    line(&mut header, format_args!("element face {n_polygons}"));
    line(
        &mut header,
        format_args!("property list {count} uint vertex_indices"),
    );
    header.push_str(PAINT);
    header.push_str("end_header\n");
    let mut out = header.into_bytes();
    let paint = |out: &mut Vec<u8>, polygon: Option<u32>, own: Option<[u8; 3]>| {
        let (colour, label) = match polygon {
            Some(polygon) => (colours[polygon as usize], labels[polygon as usize]),
            None => (UNUSED, -1),
        };
        let colour = own.unwrap_or(colour);
        out.extend_from_slice(&colour);
        out.extend_from_slice(&label.to_le_bytes());
    };
    let shown = shown_at(vertices, polygons, labels);
    for (i, (vertex, shown)) in vertices.iter().zip(shown).enumerate() {
        out.extend(vertex.iter().flat_map(|x| x.to_le_bytes()));
        if let Some(normals) = &normals {
            let normal = normals[i].map_or([0.0; 3], |at| values.0[at as usize]);
            out.extend(normal.iter().flat_map(|x| x.to_le_bytes()));
        }
        let colour = own.as_ref().map(|own| {
            let colour = own[i].map_or([1.0; 3], |at| values.1[at as usize]);
            colour.map(|x| (255.0 * x).round() as u8)
        });
        paint(&mut out, shown, colour);
    }
    for (polygon, corners) in (0..).zip(polygons) {
        let corners = corners.as_ref();
        if wide {
            out.extend_from_slice(&(corners.len() as u32).to_le_bytes());
        } else {
            out.push(corners.len() as u8);
        }
        for corner in corners {
            out.extend_from_slice(&corner.to_le_bytes());
        }
        paint(&mut out, Some(polygon), None);
    }
    out
}

/// For each vertex a polygon of the label with the largest area around it; of equal ones the label
/// that comes first.
fn shown_at<P: AsRef<[u32]>>(
    vertices: &[[f64; 3]],
    polygons: &[P],
    labels: &[i32],
) -> Vec<Option<u32>> {
    let mut corners = Vec::new();
    for (polygon, (ring, &label)) in (0..).zip(polygons.iter().zip(labels)) {
        let area = crate::mesh::instances::area(vertices, ring.as_ref());
        corners.extend(ring.as_ref().iter().map(|&v| (v, label, polygon, area)));
    }
    corners.sort_unstable_by_key(|&(vertex, label, polygon, _)| (vertex, label, polygon));
    let mut shown = vec![None; vertices.len()];
    for of_vertex in corners.chunk_by(|a, b| a.0 == b.0) {
        let of_labels = of_vertex.chunk_by(|a, b| a.1 == b.1);
        let sums = of_labels.map(|chunk| (chunk[0].2, chunk.iter().map(|c| c.3).sum::<f64>()));
        let most = sums.reduce(|best, next| match next.1.total_cmp(&best.1) {
            Ordering::Greater => next,
            _ => best,
        });
        shown[of_vertex[0].0 as usize] = most.map(|(polygon, _)| polygon);
    }
    shown
}

#[cfg(test)]
mod tests {
    use super::ply;

    /// What follows the header, and the header.
    fn split(bytes: &[u8]) -> (&str, &[u8]) {
        let end = b"end_header\n";
        let at = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
        (std::str::from_utf8(&bytes[..at]).unwrap(), &bytes[at..])
    }

    #[test]
    fn ply_has_the_bytes_its_header_promises() {
        let vertices = [
            [0.0, 0.0, 0.0],
            [1.0, 0.0, 0.0],
            [0.0, 1.0, 0.0],
            [0.1, 3.0, 0.0],
            [9.0; 3],
        ];
        let faces = [[0, 1, 2], [2, 1, 3]];
        let bytes = ply(&vertices, &faces, &[[1, 2, 3], [4, 5, 6]], &[9, -1]);
        let (header, body) = split(&bytes);
        assert!(header.contains("element vertex 5\n") && header.contains("element face 2\n"));
        assert_eq!(header.matches("property int label\n").count(), 2);
        assert_eq!(body.len(), 5 * (24 + 7) + 2 * (1 + 12 + 7));
        let vertex = |i: usize| &body[31 * i..31 * (i + 1)];
        assert_eq!(vertex(3)[..8], 0.1f64.to_le_bytes());
        // The second triangle is the larger one.
        for (i, colour, label) in [
            (0, [1, 2, 3], 9i32),
            (1, [4, 5, 6], -1),
            (2, [4, 5, 6], -1),
            (3, [4, 5, 6], -1),
            (4, [128; 3], -1),
        ] {
            assert_eq!(vertex(i)[24..27], colour, "{i}");
            assert_eq!(vertex(i)[27..], label.to_le_bytes(), "{i}");
        }
        let face = &body[5 * 31 + 20..];
        assert_eq!(face[0], 3);
        assert_eq!(face[1..5], 2u32.to_le_bytes());
        assert_eq!(face[13..16], [4, 5, 6]);
        assert_eq!(face[16..20], (-1i32).to_le_bytes());
    }

    #[test]
    fn ply_widens_the_count_for_large_polygons() {
        let polygon: Vec<u32> = (0..300).collect();
        let vertices = vec![[0.0; 3]; 300];
        let bytes = ply(&vertices, &[polygon], &[[0; 3]], &[0]);
        let (header, _) = split(&bytes);
        assert!(header.contains("property list uint uint vertex_indices"));
    }
}
