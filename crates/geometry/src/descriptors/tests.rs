use super::{
    FaceDescriptors, GROUPS, area_ranks, face_descriptors, face_kernels, hks, hks_times, signature,
};
use crate::mesh::{Bridge, DualGraph, FaceGeometry, TriMesh, bridges, clean, distance, proxy, zoo};
use nalgebra::{DMatrix, DVector};

/// Eigenpairs of a simple graph Laplacian over lumped areas: these tests need no more structure,
/// and do not depend on the operators.
fn spectrum(mesh: &TriMesh, bridges: &[Bridge], k: usize) -> (Vec<f64>, DMatrix<f64>) {
    let n = mesh.vertices.len();
    let mut mass = vec![0.0; n];
    let mut w: DMatrix<f64> = DMatrix::zeros(n, n);
    let mut link = |a: u32, b: u32, x: f64| {
        let (a, b) = (a as usize, b as usize);
        w[(a, a)] += x;
        w[(b, b)] += x;
        w[(a, b)] -= x;
        w[(b, a)] -= x;
    };
    let geometry = FaceGeometry::new(mesh);
    for (face, area) in mesh.faces.iter().zip(&geometry.areas) {
        for i in 0..3 {
            mass[face[i] as usize] += area / 3.0;
            let [a, b] = [face[i], face[(i + 1) % 3]];
            let d = distance(mesh.vertices[a as usize], mesh.vertices[b as usize]);
            link(a, b, area / (d * d));
        }
    }
    for b in bridges {
        link(b.vertices[0], b.vertices[1], 0.01);
    }
    let s = DVector::from_iterator(n, mass.iter().map(|m| 1.0 / m.sqrt()));
    let symmetric = DMatrix::from_fn(n, n, |i, j| s[i] * w[(i, j)] * s[j]);
    let eigen = symmetric.symmetric_eigen();
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    order.truncate(k.min(n));
    let values = order
        .iter()
        .map(|&i| eigen.eigenvalues[i].max(0.0))
        .collect();
    let vectors = DMatrix::from_fn(n, order.len(), |v, j| {
        s[v] * eigen.eigenvectors[(v, order[j])]
    });
    (values, vectors)
}

fn describe(mesh: &TriMesh, k: usize) -> FaceDescriptors {
    let joins = bridges(mesh);
    let dual = DualGraph::new(mesh, &joins);
    let (values, vectors) = spectrum(mesh, &joins, k);
    let kernels = face_kernels(&values).of_matrix(&vectors);
    let face = face_descriptors(mesh, &joins, &dual, &kernels);
    assert!(
        signature(mesh, &face, &values)
            .iter()
            .all(|x| x.is_finite())
    );
    face
}

/// A shape without symmetry, so that axes and samples are unique.
fn lopsided() -> TriMesh {
    let mut mesh = zoo::dumbbell(10);
    for p in &mut mesh.vertices {
        let [x, y, z] = *p;
        *p = [
            x + 0.1 * y * y,
            1.3 * y + 0.15 * x * x + 0.07 * x,
            0.8 * z + 0.11 * x + 0.2 * y * y,
        ];
    }
    clean(&zoo::parsed(&mesh)).unwrap().mesh
}

/// Largest difference in each group, in standard deviations of the group's columns.
fn differences(
    a: &FaceDescriptors,
    b: &FaceDescriptors,
    face: impl Fn(usize) -> usize,
) -> Vec<f64> {
    let m = a.data.len() / a.n;
    let mut at = 0;
    GROUPS
        .iter()
        .map(|(_, width)| {
            let columns = at..at + width;
            at += width;
            let mut worst: f64 = 0.0;
            for c in columns {
                let value = |x: &FaceDescriptors, f: usize| f64::from(x.data[f * x.n + c]);
                let mean = (0..m).map(|f| value(a, f)).sum::<f64>() / m as f64;
                let variance = (0..m).map(|f| (value(a, f) - mean).powi(2)).sum::<f64>() / m as f64;
                let deviation = variance.sqrt().max(1e-3);
                for f in 0..m {
                    worst = worst.max((value(b, f) - value(a, face(f))).abs() / deviation);
                }
            }
            worst
        })
        .collect()
}

/// Rounding may move a centroid over the rim of a ball and a ray past an edge; then single faces
/// differ by that much of a standard deviation.
const ROUNDING: f64 = 0.05;

#[test]
fn groups_add_up_to_ninety_two_columns() {
    assert_eq!(GROUPS.iter().map(|g| g.1).sum::<usize>(), 92);
    assert_eq!(describe(&lopsided(), 40).n, 92);
}

#[test]
fn rotation_translation_and_scale_do_not_matter() {
    let mesh = lopsided();
    let there = zoo::moved(&zoo::scaled(&zoo::rotated(&mesh), 17.0), [3.0, -5.0, 8.0]);
    let moved = clean(&zoo::parsed(&there)).unwrap().mesh;
    let (a, b) = (describe(&mesh, 40), describe(&moved, 40));
    for ((name, _), d) in GROUPS.iter().zip(differences(&a, &b, |f| f)) {
        assert!(d < ROUNDING, "{name} differs by {d}");
    }
    assert_eq!(a.farthest_start, b.farthest_start);
}

#[test]
fn numbering_does_not_matter() {
    let mesh = lopsided();
    let (other, old) = zoo::renumbered(&mesh);
    let (a, b) = (describe(&mesh, 40), describe(&other, 40));
    for ((name, _), d) in GROUPS.iter().zip(differences(&a, &b, |f| old[f])) {
        assert!(d < ROUNDING, "{name} differs by {d}");
    }
    assert_eq!(a.farthest_start as usize, old[b.farthest_start as usize]);
}

#[test]
fn the_same_mesh_gives_the_same_bits() {
    let mesh = lopsided();
    assert_eq!(describe(&mesh, 30), describe(&mesh, 30));
}

#[test]
fn everything_is_finite_on_the_zoo() {
    for (name, mesh) in zoo::clean_meshes() {
        let p = proxy(&mesh, 300).mesh;
        for (mesh, k) in [(&p, 60), (&p, 2), (&p, 1), (&p, 0)] {
            let x = describe(mesh, k);
            assert_eq!(x.data.len(), 92 * mesh.faces.len(), "{name}");
            assert!(
                x.data.iter().all(|v| v.is_finite()),
                "{name} with {k} pairs"
            );
        }
        // A coarse mesh is used as it is.
        if mesh.vertices.len() < 300 {
            assert!(
                describe(&mesh, 60).data.iter().all(|v| v.is_finite()),
                "{name}"
            );
        }
    }
}

#[test]
fn heat_on_a_sphere_is_everywhere_the_same() {
    // The icosahedron's symmetry leaves a few kinds of vertices, close to each other.
    let mesh = clean(&zoo::parsed(&zoo::sphere(3))).unwrap().mesh;
    // Complete eigenspaces: l = 0 … 5 have 36 pairs.
    let (values, vectors) = spectrum(&mesh, &[], 36);
    let times = hks_times(&values, 10);
    let h = hks(&values, &vectors, &times);
    for j in 0..10 {
        let column: Vec<f32> = h.chunks(10).map(|row| row[j]).collect();
        let mean = column.iter().sum::<f32>() / column.len() as f32;
        assert!(
            column.iter().all(|x| (x / mean - 1.0).abs() < 0.08),
            "time {j}"
        );
    }
}

#[test]
fn ranks_are_shares_of_the_area() {
    let r = area_ranks(&[3.0, 1.0, 2.0], &[1.0, 2.0, 1.0]);
    assert_eq!(r, [0.875, 0.25, 0.625]);
}
