//! Tests unprepared meshes: each has a spectrum under every operator, or is refused with a reason.

use super::smallest;
use crate::harness::messy_files;
use coseg::mesh::{self, Format, TriMesh};
use coseg::operators::{Laplacian, LaplacianError, Operator, laplacian};
use std::collections::BTreeSet;

const OPERATORS: [Operator; 3] = [Operator::Tufted, Operator::Cotan, Operator::MeshLaplace];
/// Rows of W sum to zero up to rounding, relative to the row's largest entry.
const ROUNDING: f64 = 1e-9;
const N_PAIRS: usize = 24;
/// With more vertices, `mesh-laplace` is checked but not solved, because its kernel fills in.
const MAX_VERTICES: usize = 6_000;

/// Checks symmetry, zero row sums and positive mass; the existence of a spectrum proves
/// semidefiniteness.
fn assert_laplacian(name: &str, operator: &Laplacian) {
    let w = &operator.stiffness;
    for (i, row) in w.outer_iterator().enumerate() {
        let largest = row.iter().fold(0.0_f64, |m, (_, x)| m.max(x.abs()));
        let sum: f64 = row.iter().map(|(_, x)| x).sum();
        assert!(
            sum.abs() <= ROUNDING * largest,
            "{name}: row {i} sums to {sum}"
        );
        for (j, x) in row.iter() {
            assert_eq!(w.get(j, i), Some(x), "{name}: ({i}, {j})");
        }
    }
    let positive = |m: &f64| m.is_finite() && *m > 0.0;
    assert!(operator.mass.iter().all(positive), "{name}");
}

/// No weight has the wrong sign; with zero row sums, W is then semidefinite (Gershgorin).
fn assert_semidefinite(name: &str, operator: &Laplacian) {
    for (i, row) in operator.stiffness.outer_iterator().enumerate() {
        for (j, x) in row.iter() {
            assert!(i == j || *x <= 0.0, "{name}: ({i}, {j}) is {x}");
        }
    }
}

/// The results of a cleaned mesh under each operator; reasons of refusals.
fn spectra(name: &str, mesh: &TriMesh) -> Vec<String> {
    let bridges = mesh::bridges(mesh);
    let k = N_PAIRS.min(mesh.vertices.len());
    let mut refusals = Vec::new();
    for kind in OPERATORS {
        let name = format!("{name}, {kind:?}");
        let found = laplacian(mesh, &bridges, kind);
        let operator = match found {
            Ok(operator) => operator,
            Err(e) => {
                // The default operator accepts all meshes that cleaning accepts.
                assert_ne!(kind, Operator::Tufted, "{name}: {e}");
                assert!(!matches!(e, LaplacianError::Empty { .. }), "{name}: {e}");
                refusals.push(format!("{name}: {e}"));
                continue;
            }
        };
        assert_laplacian(&name, &operator);
        if kind == Operator::MeshLaplace && mesh.vertices.len() > MAX_VERTICES {
            assert_semidefinite(&name, &operator);
            continue;
        }
        // `smallest` checks residuals and orthonormality. A refusal under the default operator is a
        // defect. Slivers give the other operators weights so large that a residual may stay above
        // the limit, which is reported.
        let found = match smallest(&operator, k) {
            Ok(found) => found,
            Err(e) => {
                assert_ne!(kind, Operator::Tufted, "{name}: {e}");
                refusals.push(format!("{name}: {e}"));
                continue;
            }
        };
        assert!(found.certificate.count >= k, "{name}");
        if !found.certificate.proved() {
            println!("{name}: counted, not proved: {:?}", found.certificate);
            assert_ne!(kind, Operator::Tufted, "{name}: {:?}", found.certificate);
        }
        // Bridges make one domain; a truncated kernel may still omit parts that are far from the
        // rest.
        let zeros = found.eigenvalues.iter().filter(|l| **l == 0.0).count();
        assert_eq!(zeros, found.certificate.n_components.min(k), "{name}");
        assert!(
            zeros == 1 || kind == Operator::MeshLaplace,
            "{name}: {zeros}"
        );
    }
    refusals
}

#[test]
fn every_messy_file_has_spectra_or_a_named_refusal() {
    let Some(paths) = messy_files() else {
        return;
    };
    let (mut n_solved, mut refusals) = (0, Vec::new());
    let mut formats = BTreeSet::new();
    for path in paths {
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        let Some(format) = Format::from_name(&name) else {
            continue;
        };
        let bytes = std::fs::read(&path).unwrap();
        let parsed = match mesh::parse(&bytes, format) {
            Ok(parsed) => parsed,
            Err(e) => {
                refusals.push(format!("{name}: {e}"));
                continue;
            }
        };
        match mesh::clean(&parsed) {
            Ok(cleaned) => {
                println!("{name}: {} vertices", cleaned.mesh.vertices.len());
                refusals.extend(spectra(&name, &cleaned.mesh));
                n_solved += 1;
                formats.insert(format.name());
            }
            Err(e) => refusals.push(format!("{name}: {e}")),
        }
    }
    println!(
        "{n_solved} files have spectra; refused:\n{}",
        refusals.join("\n")
    );
    assert!(n_solved >= 45, "{n_solved}");
    assert_eq!(formats.len(), 5, "{formats:?}");
}

/// A closed strip of `n` squares, `height` high, with caps: the lower it is, the thinner its
/// triangles.
pub(super) fn drum(n: u32, height: f64) -> TriMesh {
    let mut mesh = TriMesh::default();
    for i in 0..n {
        let (sin, cos) = (std::f64::consts::TAU * f64::from(i) / f64::from(n)).sin_cos();
        mesh.vertices.extend([[cos, sin, 0.0], [cos, sin, height]]);
        let (a, b) = (2 * i, 2 * ((i + 1) % n));
        mesh.faces.extend([[a, b, b + 1], [a, b + 1, a + 1]]);
        mesh.faces
            .extend([[b, a, 2 * n], [a + 1, b + 1, 2 * n + 1]]);
    }
    mesh.vertices.extend([[0.0; 3], [0.0, 0.0, height]]);
    mesh
}

#[test]
fn slivers_have_spectra() {
    for height in [1.0, 1e-2, 1e-3, 1e-5, 1e-6] {
        let refusals = spectra(&format!("drum {height}"), &drum(40, height));
        assert!(refusals.is_empty(), "{refusals:?}");
    }
}

#[test]
fn needles_and_crossings_have_spectra() {
    // Two drums that pass through each other's middle, welded at a vertex, and a fin: not a
    // manifold.
    let mut mesh = drum(24, 0.7);
    let n = mesh.vertices.len() as u32;
    let other = drum(17, 1e-4);
    mesh.vertices
        .extend(other.vertices.iter().map(|p| [p[2], p[0] + 0.3, p[1]]));
    let welded = |v: u32| if v == 0 { 0 } else { v + n };
    mesh.faces.extend(other.faces.iter().map(|f| f.map(welded)));
    let tip = mesh.vertices.len() as u32;
    mesh.vertices.push([2.0, 2.0, 0.1]);
    mesh.faces.push([2, 4, tip]);
    let parsed = coseg::mesh::write::off(&mesh);
    let parsed = mesh::parse(parsed.as_bytes(), Format::Off).unwrap();
    let cleaned = mesh::clean(&parsed).unwrap();
    let refusals = spectra("crossing drums", &cleaned.mesh);
    assert!(refusals.is_empty(), "{refusals:?}");
}
