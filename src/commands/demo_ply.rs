//! Writes labelled shapes as coloured PLY files: one for each shape, and one with all of them side
//! by side.

use super::export_mesh::{colour, styles};
use coseg::ipc::wire::LabelInfo;
use coseg::mesh::TriMesh;
use coseg::mesh::write::ply;
use coseg::synth::Labelled;

/// Colours of known parts that people with any colour vision can distinguish (M. Okabe and K. Ito,
/// "Color universal design", 2008).
const KNOWN: [[u8; 3]; 8] = [
    [230, 159, 0],
    [86, 180, 233],
    [0, 158, 115],
    [240, 228, 66],
    [0, 114, 178],
    [213, 94, 0],
    [204, 121, 167],
    [0, 0, 0],
];
/// Distance between neighbouring shapes, relative to their size.
const SPACING: f64 = 1.15;

/// Names and bytes of the files: `NAME.ply` in the colours of the labels, and `all.ply`, in which
/// the shapes with known parts stand behind those with the found ones.
pub(super) fn files(shapes: &[(&Labelled, &[i32])], infos: &[LabelInfo]) -> Vec<(String, Vec<u8>)> {
    let mut files = Vec::with_capacity(shapes.len() + 1);
    let styles = styles(infos);
    let mut all = Scene::default();
    let size = shapes
        .iter()
        .map(|(s, _)| extent(&s.mesh))
        .fold(0.0, f64::max)
        * SPACING;
    for (i, (shape, labels)) in shapes.iter().enumerate() {
        let colours: Vec<[u8; 3]> = labels.iter().map(|&l| colour(l, &styles)).collect();
        let mesh = &shape.mesh;
        files.push((
            format!("{}.ply", shape.name),
            ply(&mesh.vertices, &mesh.faces, &colours, labels),
        ));
        let column = size * i as f64;
        all.put(mesh, [column, 0.0, 0.0], &colours, labels);
        let known = |l: &u32| KNOWN[*l as usize % KNOWN.len()];
        let colours: Vec<[u8; 3]> = shape.labels.iter().map(known).collect();
        let truth: Vec<i32> = shape.labels.iter().map(|&l| l as i32).collect();
        all.put(mesh, [column, 0.0, -size], &colours, &truth);
    }
    files.push((
        "all.ply".to_owned(),
        ply(&all.vertices, &all.faces, &all.colours, &all.labels),
    ));
    files
}

/// The area of a triangle.
pub(super) fn face_area(mesh: &TriMesh, face: &[u32; 3]) -> f64 {
    let [a, b, c] = face.map(|v| mesh.vertices[v as usize]);
    let (u, v) = (
        [0, 1, 2].map(|k| b[k] - a[k]),
        [0, 1, 2].map(|k| c[k] - a[k]),
    );
    let normal = [
        u[1] * v[2] - u[2] * v[1],
        u[2] * v[0] - u[0] * v[2],
        u[0] * v[1] - u[1] * v[0],
    ];
    normal.iter().map(|x| x * x).sum::<f64>().sqrt() / 2.0
}

/// The longest side of the bounding box.
fn extent(mesh: &TriMesh) -> f64 {
    let side = |k: usize| {
        let low = mesh
            .vertices
            .iter()
            .map(|v| v[k])
            .fold(f64::INFINITY, f64::min);
        let high = mesh
            .vertices
            .iter()
            .map(|v| v[k])
            .fold(f64::NEG_INFINITY, f64::max);
        high - low
    };
    side(0).max(side(1)).max(side(2))
}

/// Several meshes, joined to one.
#[derive(Default)]
struct Scene {
    vertices: Vec<[f64; 3]>,
    faces: Vec<[u32; 3]>,
    colours: Vec<[u8; 3]>,
    labels: Vec<i32>,
}

impl Scene {
    fn put(&mut self, mesh: &TriMesh, at: [f64; 3], colours: &[[u8; 3]], labels: &[i32]) {
        let first = self.vertices.len() as u32;
        let moved = |v: &[f64; 3]| [0, 1, 2].map(|k| v[k] + at[k]);
        self.vertices.extend(mesh.vertices.iter().map(moved));
        self.faces
            .extend(mesh.faces.iter().map(|f| f.map(|v| v + first)));
        self.colours.extend(colours);
        self.labels.extend(labels);
    }
}

#[cfg(test)]
mod tests {
    use super::files;
    use coseg::ipc::wire::LabelInfo;
    use coseg::mesh::TriMesh;
    use coseg::synth::Labelled;

    #[test]
    fn one_file_each_and_one_with_all() {
        let mesh = TriMesh {
            vertices: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]],
            faces: vec![[0, 1, 2]],
        };
        let shape = |name: &str| Labelled {
            mesh: mesh.clone(),
            labels: vec![0],
            label_names: &["only"],
            name: name.to_owned(),
        };
        let (a, b) = (shape("a"), shape("b"));
        let infos = [LabelInfo {
            id: 5,
            name: String::new(),
            colour_rgb: 0x01_02_03,
            merged_into: None,
            n_shapes: 1,
            area_share: 1.0,
            unclaimed: false,
        }];
        let files = files(&[(&a, &[5]), (&b, &[-1])], &infos);
        let names: Vec<&str> = files.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(names, ["a.ply", "b.ply", "all.ply"]);
        // The last face record: count, three corners, colour, label.
        let tail = |i: usize| files[i].1[files[i].1.len() - 7..].to_vec();
        assert_eq!(tail(0), [1, 2, 3, 5, 0, 0, 0]);
        assert_eq!(tail(1), [128, 128, 128, 255, 255, 255, 255]);
        let header = String::from_utf8_lossy(&files[2].1).into_owned();
        assert!(header.contains("element vertex 12\n") && header.contains("element face 4\n"));
    }
}
