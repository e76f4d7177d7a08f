//! Meshes with labels become PLY and OBJ text, faces in the order of the input.

use coseg::ipc::wire::LabelInfo;
use coseg::mesh::ParsedMesh;
use std::fmt::Write as _;

/// Colour of faces without a label.
const UNLABELLED: [u8; 3] = [128, 128, 128];

/// The polygons of a mesh, put together again from their fans.
pub(crate) fn polygons(mesh: &ParsedMesh) -> Vec<Vec<u32>> {
    let mut polygons: Vec<Vec<u32>> = vec![Vec::new(); mesh.n_polygons];
    for (triangle, &polygon) in mesh.triangles.iter().zip(&mesh.polygon_of_triangle) {
        let corners = &mut polygons[polygon as usize];
        if corners.is_empty() {
            corners.extend(triangle);
        } else {
            corners.push(triangle[2]);
        }
    }
    polygons
}

fn colour(label: i32, labels: &[LabelInfo]) -> [u8; 3] {
    let found = u32::try_from(label)
        .ok()
        .and_then(|id| labels.iter().find(|l| l.id == id));
    found.map_or(UNLABELLED, |l| {
        let [_, r, g, b] = l.colour_rgb.to_be_bytes();
        [r, g, b]
    })
}

/// The name of a group and material: the label's id, with the name a person gave.
fn material(label: i32, labels: &[LabelInfo]) -> String {
    let found = u32::try_from(label)
        .ok()
        .and_then(|id| labels.iter().find(|l| l.id == id));
    match found.map(|l| l.name.as_str()) {
        None if label < 0 => "unlabelled".to_owned(),
        None | Some("") => format!("label_{label}"),
        // Names end at white space in both formats.
        Some(name) => format!("label_{label}_{}", name.replace(char::is_whitespace, "_")),
    }
}

/// ASCII PLY with a colour and `int label` for each face.
pub(crate) fn ply(
    vertices: &[[f64; 3]],
    polygons: &[Vec<u32>],
    labels: &[i32],
    infos: &[LabelInfo],
) -> String {
    let most = polygons.iter().map(Vec::len).max().unwrap_or(0);
    let count = if most <= usize::from(u8::MAX) {
        "uchar"
    } else {
        "uint"
    };
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\n\
         property double z\nelement face {}\nproperty list {count} int vertex_indices\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nproperty int label\n\
         end_header\n",
        vertices.len(),
        polygons.len()
    );
    // Writing to a string cannot fail.
    for [x, y, z] in vertices {
        let _ = writeln!(text, "{x} {y} {z}");
    }
    for (polygon, &label) in polygons.iter().zip(labels) {
        let _ = write!(text, "{}", polygon.len());
        for v in polygon {
            let _ = write!(text, " {v}");
        }
        let [r, g, b] = colour(label, infos);
        let _ = writeln!(text, " {r} {g} {b} {label}");
    }
    text
}

/// OBJ with `g` and `usemtl` wherever the label changes.
pub(crate) fn obj(
    vertices: &[[f64; 3]],
    polygons: &[Vec<u32>],
    labels: &[i32],
    infos: &[LabelInfo],
    materials: &str,
) -> String {
    let mut text = format!("mtllib {materials}\n");
    for [x, y, z] in vertices {
        let _ = writeln!(text, "v {x} {y} {z}");
    }
    let mut current = None;
    for (polygon, &label) in polygons.iter().zip(labels) {
        if current != Some(label) {
            let name = material(label, infos);
            let _ = writeln!(text, "g {name}\nusemtl {name}");
            current = Some(label);
        }
        text.push('f');
        for v in polygon {
            let _ = write!(text, " {}", v + 1);
        }
        text.push('\n');
    }
    text
}

/// The material file of all labels.
pub(crate) fn materials(infos: &[LabelInfo]) -> String {
    let mut text = String::new();
    let ids = infos
        .iter()
        .filter_map(|l| i32::try_from(l.id).ok())
        .chain([-1]);
    for id in ids {
        let [r, g, b] = colour(id, infos).map(|c| f64::from(c) / 255.0);
        let _ = writeln!(
            text,
            "newmtl {}\nKd {r:.4} {g:.4} {b:.4}",
            material(id, infos)
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::{LabelInfo, materials, obj, ply, polygons};
    use coseg::mesh::ParsedMesh;

    fn quad_and_triangle() -> ParsedMesh {
        ParsedMesh {
            vertices: vec![
                [0.0; 3],
                [1.0, 0.0, 0.0],
                [1.0, 1.0, 0.0],
                [0.0, 1.0, 0.0],
                [2.0, 0.5, 0.0],
            ],
            triangles: vec![[0, 1, 2], [0, 2, 3], [1, 4, 2]],
            polygon_of_triangle: vec![0, 0, 1],
            n_polygons: 2,
        }
    }

    fn infos() -> Vec<LabelInfo> {
        let name = "long leg".to_owned();
        vec![LabelInfo {
            id: 7,
            name,
            colour_rgb: 0x01_02_ff,
            merged_into: None,
        }]
    }

    #[test]
    fn polygons_are_put_together_again() {
        assert_eq!(
            polygons(&quad_and_triangle()),
            [vec![0, 1, 2, 3], vec![1, 4, 2]]
        );
    }

    #[test]
    fn ply_has_a_colour_and_a_label_for_each_face() {
        let mesh = quad_and_triangle();
        let text = ply(&mesh.vertices, &polygons(&mesh), &[7, -1], &infos());
        assert!(text.contains("element face 2\nproperty list uchar int vertex_indices\n"));
        assert!(
            text.ends_with("4 0 1 2 3 1 2 255 7\n3 1 4 2 128 128 128 -1\n"),
            "{text}"
        );
    }

    #[test]
    fn obj_has_a_group_and_a_material_for_each_label() {
        let mesh = quad_and_triangle();
        let text = obj(
            &mesh.vertices,
            &polygons(&mesh),
            &[7, -1],
            &infos(),
            "m.mtl",
        );
        let faces = "g label_7_long_leg\nusemtl label_7_long_leg\nf 1 2 3 4\n\
                     g unlabelled\nusemtl unlabelled\nf 2 5 3\n";
        assert!(
            text.starts_with("mtllib m.mtl\nv 0 0 0\n") && text.ends_with(faces),
            "{text}"
        );
        assert!(materials(&infos()).contains("newmtl label_7_long_leg\nKd 0.0039 0.0078 1.0000\n"));
    }
}
