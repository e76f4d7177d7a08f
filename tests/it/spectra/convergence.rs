//! Tests that eigenvalues of finer and finer meshes converge to those of the surface with the right
//! order.
//!
//! Linear elements with lumped mass have an error of O(h²): half the edge gives a quarter of the
//! error.

use super::smallest;
use coseg::mesh::TriMesh;
use coseg::operators::{Laplacian, Operator, laplacian};
use std::collections::BTreeMap;
use std::f64::consts::{PI, TAU};

/// The least order in h that counts as second order.
const ORDER: f64 = 1.8;

/// The orders by which errors fall from one mesh to the next with half its edge length.
fn assert_second_order(name: &str, errors: &[f64]) {
    for pair in errors.windows(2) {
        let order = (pair[0] / pair[1]).log2();
        assert!(order > ORDER, "{name}: order {order} of {errors:?}");
    }
}

/// Largest relative error of the eigenvalues above zero.
fn error(operator: &Laplacian, expected: &[f64]) -> f64 {
    let found = smallest(operator, expected.len() + 1).unwrap();
    let pairs = found.eigenvalues[1..].iter().zip(expected);
    pairs.fold(0.0, |worst, (a, b)| worst.max((a - b).abs() / b))
}

/// A unit sphere: an octahedron whose faces are divided `m` times in each direction.
fn sphere(m: i32) -> TriMesh {
    let mut index = BTreeMap::new();
    let mut mesh = TriMesh::default();
    for signs in 0..8 {
        let sign = [0, 1, 2].map(|axis| if signs >> axis & 1 == 0 { 1 } else { -1 });
        let mut at = |i: i32, j: i32| {
            let p = [i * sign[0], j * sign[1], (m - i - j) * sign[2]];
            *index.entry(p).or_insert_with(|| {
                let r = f64::from(p.iter().map(|x| x * x).sum::<i32>()).sqrt();
                mesh.vertices.push(p.map(|x| f64::from(x) / r));
                mesh.vertices.len() as u32 - 1
            })
        };
        let mut faces = Vec::new();
        for i in 0..m {
            for j in 0..m - i {
                faces.push([at(i, j), at(i + 1, j), at(i, j + 1)]);
                if i + j + 1 < m {
                    faces.push([at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)]);
                }
            }
        }
        let inside_out = sign.iter().product::<i32>() < 0;
        mesh.faces.extend(
            faces
                .into_iter()
                .map(|[a, b, c]| if inside_out { [a, c, b] } else { [a, b, c] }),
        );
    }
    mesh
}

#[test]
fn sphere_at_second_order() {
    // l (l + 1), 2 l + 1 times.
    let expected: Vec<f64> = (1..=3)
        .flat_map(|l| vec![f64::from(l * (l + 1)); 2 * l as usize + 1])
        .collect();
    for operator in [Operator::Cotan, Operator::Tufted] {
        let errors = [8, 16, 32].map(|m| {
            let mesh = sphere(m);
            assert_eq!(mesh.vertices.len() as i32, 4 * m * m + 2);
            error(&laplacian(&mesh, &[], operator).unwrap(), &expected)
        });
        assert_second_order("sphere", &errors);
        assert!(errors[2] < 0.01, "{errors:?}");
    }
}

#[test]
fn rectangle_with_free_edges_at_second_order() {
    let (width, height) = (2.0, 1.0);
    let mut expected: Vec<f64> = (0..8)
        .flat_map(|i| (0..8).map(move |j| (PI * f64::from(i) / width, PI * f64::from(j) / height)))
        .map(|(a, b)| a * a + b * b)
        .collect();
    expected.sort_by(f64::total_cmp);
    let expected = &expected[1..12];
    for operator in [Operator::Cotan, Operator::Tufted] {
        let errors = [10_u32, 20, 40].map(|m| {
            let mut mesh = TriMesh::default();
            for i in 0..=2 * m {
                for j in 0..=m {
                    let p = [
                        f64::from(i) / f64::from(m),
                        f64::from(j) / f64::from(m),
                        0.0,
                    ];
                    mesh.vertices.push(p);
                    let (a, b) = (i * (m + 1) + j, (i + 1) * (m + 1) + j);
                    if i < 2 * m && j < m {
                        mesh.faces.extend([[a, b, b + 1], [a, b + 1, a + 1]]);
                    }
                }
            }
            error(&laplacian(&mesh, &[], operator).unwrap(), expected)
        });
        assert_second_order("rectangle", &errors);
    }
}

#[test]
fn flat_torus_at_second_order() {
    // A flat torus cannot be embedded in space as a mesh, so its matrices are given explicitly.
    let torus = |m: usize| {
        let h = 1.0 / m as f64;
        let at = |i: usize, j: usize| (i % m) * m + j % m;
        let mut triplets = sprs::TriMat::new((m * m, m * m));
        for i in 0..m {
            for j in 0..m {
                triplets.add_triplet(at(i, j), at(i, j), 4.0);
                for other in [
                    at(i + 1, j),
                    at(i + m - 1, j),
                    at(i, j + 1),
                    at(i, j + m - 1),
                ] {
                    triplets.add_triplet(at(i, j), other, -1.0);
                }
            }
        }
        Laplacian {
            stiffness: triplets.to_csr(),
            mass: vec![h * h; m * m],
        }
    };
    let mut expected: Vec<f64> = (-4..=4_i32)
        .flat_map(|i| (-4..=4_i32).map(move |j| f64::from(i * i + j * j) * TAU * TAU))
        .collect();
    expected.sort_by(f64::total_cmp);
    let errors = [12, 24, 48].map(|m| error(&torus(m), &expected[1..21]));
    assert_second_order("flat torus", &errors);
}
