use super::test_meshes::{bumpy_torus, cube, icosphere, rectangle};
use super::{Laplacian, LaplacianError, Operator, laplacian};
use crate::mesh::{Bridge, TriMesh, zoo};

const ALL: [Operator; 3] = [Operator::Tufted, Operator::Cotan, Operator::MeshLaplace];

fn area(mesh: &TriMesh) -> f64 {
    mesh.faces
        .iter()
        .map(|f| {
            let p = f.map(|v| mesh.vertices[v as usize]);
            let n = super::cross(super::difference(p[1], p[0]), super::difference(p[2], p[0]));
            0.5 * super::dot(n, n).sqrt()
        })
        .sum()
}

/// Three squares that share an edge, with a triangle hanging by one vertex.
fn fan() -> TriMesh {
    let mut mesh = TriMesh {
        vertices: vec![[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
        faces: Vec::new(),
    };
    for angle in [0.1f64, 1.9, 4.0] {
        let (x, y) = (angle.cos(), angle.sin());
        let first = mesh.vertices.len() as u32;
        mesh.vertices.extend([[x, y, 0.0], [x, y, 1.0]]);
        mesh.faces
            .extend([[0, first, first + 1], [1, 0, first + 1]]);
    }
    mesh.vertices.extend([[0.3, 0.0, 1.8], [-0.5, 0.2, 1.9]]);
    mesh.faces.push([1, 8, 9]);
    mesh
}

fn good_meshes() -> Vec<TriMesh> {
    vec![
        icosphere(2),
        cube(3),
        rectangle(2.0, 1.0, 9, 4),
        bumpy_torus(20, 9),
        fan(),
    ]
}

/// Meshes with at most this many vertices have all their eigenvalues checked.
const MAX_DENSE: usize = 600;

fn assert_laplacian(l: &Laplacian, operator: Operator) {
    let n = l.mass.len();
    assert!(l.mass.iter().all(|&m| m > 0.0));
    let is_small = n <= MAX_DENSE;
    let mut dense = vec![0.0; if is_small { n * n } else { 0 }];
    for (i, row) in l.stiffness.outer_iterator().enumerate() {
        let sum: f64 = row.iter().map(|(_, w)| w).sum();
        let absolute: f64 = row.iter().map(|(_, w)| w.abs()).sum();
        assert!(
            sum.abs() <= 1e-14 * absolute,
            "{operator:?}: row {i} sums to {sum}"
        );
        assert!(row.indices().is_sorted());
        for (j, &w) in row.iter() {
            assert_eq!(l.stiffness.get(j, i), Some(&w), "symmetric to the bit");
            if is_small {
                dense[i * n + j] = w;
            }
            if operator != Operator::Cotan && i != j {
                assert!(w <= 2e-6, "{operator:?}: weight {w} of the wrong sign");
            }
        }
    }
    if !is_small {
        return;
    }
    let (values, _) = crate::linalg::dense_eigen::symmetric_eigen(&dense, n).unwrap();
    assert!(
        values[0] >= -1e-12 * values[n - 1],
        "semidefinite: {}",
        values[0]
    );
}

#[test]
fn every_mesh_gives_a_semidefinite_stiffness_and_its_area() {
    for mesh in good_meshes() {
        for operator in ALL {
            let l = laplacian(&mesh, &[], operator).unwrap();
            assert_laplacian(&l, operator);
            let total: f64 = l.mass.iter().sum();
            assert!(
                (total / area(&mesh) - 1.0).abs() < 1e-5,
                "{operator:?}: {total}"
            );
        }
    }
}

#[test]
fn every_mesh_of_the_zoo_gives_a_semidefinite_stiffness_or_a_named_refusal() {
    let (mut n_laplacians, mut refusals) = (0, Vec::new());
    for (name, mesh) in zoo::clean_meshes() {
        let bridges = crate::mesh::bridges(&mesh);
        for operator in ALL {
            match laplacian(&mesh, &bridges, operator) {
                Ok(l) => {
                    assert_laplacian(&l, operator);
                    n_laplacians += 1;
                }
                Err(e) => refusals.push((name, operator, e)),
            }
        }
    }
    // Only plain cotangents reject faces that cleaning accepts.
    let cotangents = |r: &(&str, Operator, LaplacianError)| r.1 == Operator::Cotan;
    assert!(refusals.iter().all(cotangents), "{refusals:?}");
    assert!(
        n_laplacians > 30 && n_laplacians > 5 * refusals.len(),
        "{n_laplacians}, {refusals:?}"
    );
}

#[test]
fn tufted_equals_cotan_on_a_closed_delaunay_mesh() {
    let mesh = icosphere(3);
    let tufted = laplacian(&mesh, &[], Operator::Tufted).unwrap();
    let cotan = laplacian(&mesh, &[], Operator::Cotan).unwrap();
    assert_eq!(tufted.stiffness.nnz(), cotan.stiffness.nnz());
    for (&w, (i, j)) in cotan.stiffness.iter() {
        assert!((tufted.stiffness.get(i, j).unwrap() - w).abs() < 1e-4);
    }
    for (t, c) in tufted.mass.iter().zip(&cotan.mass) {
        assert!((t / c - 1.0).abs() < 1e-4);
    }
}

#[test]
fn equilateral_triangle_by_hand() {
    let h = 0.75f64.sqrt();
    let mesh = TriMesh {
        vertices: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.5, h, 0.0]],
        faces: vec![[0, 1, 2]],
    };
    for operator in [Operator::Tufted, Operator::Cotan] {
        let l = laplacian(&mesh, &[], operator).unwrap();
        let half_cotangent = 0.5 / 3.0f64.sqrt();
        assert!((l.stiffness.get(0, 1).unwrap() + half_cotangent).abs() < 1e-5);
        assert!((l.mass[0] - 0.5 * h / 3.0).abs() < 1e-5);
    }
}

#[test]
fn tufted_flips_the_long_diagonal_of_a_flat_kite() {
    // The shared edge 0-1 faces two angles of 2 atan(2) each: 253° in all, so it is flipped, and
    // the two new triangles have angles atan(1/2) at the tips.
    let mesh = TriMesh {
        vertices: vec![
            [-1.0, 0.0, 0.0],
            [1.0, 0.0, 0.0],
            [0.0, 0.5, 0.0],
            [0.0, -0.5, 0.0],
        ],
        faces: vec![[0, 1, 2], [1, 0, 3]],
    };
    let l = laplacian(&mesh, &[], Operator::Tufted).unwrap();
    let cotangent_at_tip = 0.75; // cot(2 atan(1/2))
    let weight = -l.stiffness.get(2, 3).unwrap();
    assert!((weight - cotangent_at_tip).abs() < 1e-4, "{weight}");
    assert!(l.stiffness.get(0, 1).is_none_or(|w| w.abs() < 1e-6));
}

#[test]
fn tufted_ignores_orientation_and_stands_degenerate_faces() {
    let mesh = fan();
    let reference = laplacian(&mesh, &[], Operator::Tufted).unwrap();
    let mut turned = mesh.clone();
    for f in turned.faces.iter_mut().step_by(2) {
        f.swap(0, 1);
    }
    let other = laplacian(&turned, &[], Operator::Tufted).unwrap();
    for (&w, (i, j)) in reference.stiffness.iter() {
        assert!((other.stiffness.get(i, j).copied().unwrap_or(0.0) - w).abs() < 1e-9);
    }
    let mut flat = rectangle(1.0, 1.0, 4, 4);
    flat.vertices[6] = flat.vertices[7];
    for operator in [Operator::Tufted, Operator::MeshLaplace] {
        let l = laplacian(&flat, &[], operator);
        if operator == Operator::Tufted {
            assert_laplacian(&l.unwrap(), operator);
        }
    }
    assert!(matches!(
        laplacian(&flat, &[], Operator::Cotan),
        Err(LaplacianError::DegenerateFace { .. })
    ));
}

/// From robust_laplacian 1.1.0, `mesh_laplacian(vertices, faces, mollify_factor=1e-6)`.
#[test]
fn tufted_agrees_with_the_reference_implementation_on_the_fan() {
    let l = laplacian(&fan(), &[], Operator::Tufted).unwrap();
    for (i, j, w) in REFERENCE_STIFFNESS {
        let found = l.stiffness.get(i, j).copied().unwrap_or(0.0);
        assert!(
            (found - w).abs() < 1e-6,
            "({i}, {j}): {found}, expected {w}"
        );
    }
    for (m, expected) in l.mass.iter().zip(REFERENCE_MASS) {
        assert!((m - expected).abs() < 1e-7);
    }
}

#[test]
fn bridges_join_components_with_a_small_weight() {
    let mesh = super::test_meshes::copies(&icosphere(1), 2);
    let n = mesh.vertices.len() as u32;
    let bridge = Bridge {
        vertices: [n / 2, 3],
        faces: [0, 0],
        length: 1.0,
    };
    for operator in [Operator::Tufted, Operator::Cotan] {
        let separate = laplacian(&mesh, &[], operator).unwrap();
        let joined = laplacian(&mesh, &[bridge], operator).unwrap();
        assert_laplacian(&joined, operator);
        assert_eq!(separate.mass, joined.mass);
        assert_eq!(joined.stiffness.nnz(), separate.stiffness.nnz() + 2);
        let w = -joined.stiffness.get(3, n as usize / 2).unwrap();
        assert!(w > 0.003 && w < 0.01, "{w}");
    }
}

#[test]
fn refuses_meshes_without_laplacian() {
    let good = icosphere(0);
    let message = |mesh: &TriMesh, bridges: &[Bridge]| {
        laplacian(mesh, bridges, Operator::Tufted)
            .unwrap_err()
            .to_string()
    };
    let mut m = good.clone();
    m.faces.clear();
    assert_eq!(message(&m, &[]), "the mesh has 12 vertices but no face");
    let mut m = good.clone();
    m.vertices[4][2] = f64::NAN;
    assert_eq!(
        message(&m, &[]),
        "coordinate 2 of vertex 4 is NaN, but must be finite"
    );
    let mut m = good.clone();
    m.faces[17][1] = 902;
    assert_eq!(
        message(&m, &[]),
        "face 17 names vertex 902, but the mesh has 12"
    );
    let mut m = good.clone();
    m.faces[3] = [1, 5, 5];
    assert_eq!(
        message(&m, &[]),
        "face 3 names vertex 5 more than once, but needs three different corners"
    );
    let mut m = good.clone();
    m.vertices.push([0.0; 3]);
    assert_eq!(
        message(&m, &[]),
        "vertex 12 belongs to no face, but each needs at least one"
    );
    let bridge = Bridge {
        vertices: [3, 12],
        faces: [0, 0],
        length: 0.0,
    };
    assert_eq!(
        message(&good, &[bridge]),
        "bridge 0 joins vertices [3, 12], but there are only 12"
    );
    let mut m = good.clone();
    m.vertices.fill([0.5; 3]);
    for operator in ALL {
        assert!(laplacian(&m, &[], operator).is_err());
    }
    let mut m = good;
    for p in &mut m.vertices {
        *p = p.map(|x| x * 1e200);
    }
    for operator in ALL {
        assert!(laplacian(&m, &[], operator).is_err());
    }
}
const REFERENCE_STIFFNESS: [(usize, usize, f64); 23] = [
    (0, 0, 3.000000000),
    (0, 1, -1.500000000),
    (0, 2, -0.500000000),
    (0, 4, -0.500000000),
    (0, 6, -0.500000000),
    (1, 1, 3.498953098),
    (1, 3, -0.500000000),
    (1, 5, -0.500000000),
    (1, 7, -0.500000000),
    (1, 8, -0.383253829),
    (1, 9, -0.115699269),
    (2, 2, 1.000000000),
    (2, 3, -0.500000000),
    (3, 3, 1.000000000),
    (4, 4, 1.000000000),
    (4, 5, -0.500000000),
    (5, 5, 1.000000000),
    (6, 6, 1.000000000),
    (6, 7, -0.500000000),
    (7, 7, 1.000000000),
    (8, 8, 0.795432475),
    (8, 9, -0.412178646),
    (9, 9, 0.527877915),
];

const REFERENCE_MASS: [f64; 10] = [
    1.000000000,
    0.615241293,
    0.166666667,
    0.333333333,
    0.166666667,
    0.333333333,
    0.166666667,
    0.333333333,
    0.115241293,
    0.115241293,
];
