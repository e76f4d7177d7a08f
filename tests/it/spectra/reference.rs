//! Compares the tufted Laplacian with robust_laplacian 1.1.0 (Sharp and Crane's own code).
//!
//! `reference.py` generates the meshes and writes `reference.json`; its first lines explain how to
//! run it.

use super::smallest;
use coseg::mesh::TriMesh;
use coseg::operators::{Operator, laplacian};
use serde_json::Value;

/// Both mollify with the same factor, but with different rounding.
const AGREE: f64 = 1e-6;

fn numbers(value: &Value) -> Vec<f64> {
    let list = value.as_array().unwrap();
    list.iter().map(|x| x.as_f64().unwrap()).collect()
}

fn assert_close(name: &str, found: &[f64], expected: &[f64]) {
    assert_eq!(found.len(), expected.len(), "{name}");
    let scale = expected.iter().fold(0.0_f64, |m, x| m.max(x.abs()));
    for (i, (a, b)) in found.iter().zip(expected).enumerate() {
        assert!(
            (a - b).abs() <= AGREE * scale,
            "{name} {i}: {a}, expected {b}"
        );
    }
}

#[test]
fn tufted_laplacians_are_those_of_robust_laplacian() {
    let meshes: Value = serde_json::from_str(include_str!("reference.json")).unwrap();
    let meshes = meshes.as_object().unwrap();
    assert_eq!(meshes.len(), 3);
    for (name, about) in meshes {
        let rows = |key: &str| about[key].as_array().unwrap().clone();
        let mesh = TriMesh {
            vertices: rows("vertices")
                .iter()
                .map(|v| numbers(v).try_into().unwrap())
                .collect(),
            faces: rows("faces")
                .iter()
                .map(|f| std::array::from_fn(|i| f[i].as_u64().unwrap() as u32))
                .collect(),
        };
        let operator = laplacian(&mesh, &[], Operator::Tufted).unwrap();
        assert_close(name, &operator.mass, &numbers(&about["mass"]));

        let products = rows("stiffness_times_functions");
        for j in 0..4 {
            let function = |v: usize| ((j + 1) as f64 * (v + 1) as f64).cos();
            let rows = operator.stiffness.outer_iterator();
            let found: Vec<f64> = rows
                .map(|row| row.iter().map(|(v, w)| w * function(v)).sum())
                .collect();
            let expected: Vec<f64> = products.iter().map(|p| p[j].as_f64().unwrap()).collect();
            assert_close(name, &found, &expected);
        }

        let expected = numbers(&about["eigenvalues"]);
        let found = smallest(&operator, expected.len()).unwrap();
        assert_close(name, &found.eigenvalues, &expected);
    }
}
