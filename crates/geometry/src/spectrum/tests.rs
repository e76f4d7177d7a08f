use super::{Eigenpairs, Options, Spectrum, SpectrumError};
use crate::mesh::{Bridge, TriMesh, bridges, zoo};
use crate::operators::test_meshes::{bumpy_torus, copies, cube, icosphere, rectangle};
use crate::operators::{Laplacian, Operator, laplacian};
use std::f64::consts::{PI, TAU};

/// The bound on the residuals that the module promises.
const RESIDUAL: f64 = 1e-8;
const ORTHONORMAL: f64 = 1e-10;

fn of(mesh: &TriMesh, k: usize) -> (Laplacian, Spectrum) {
    let operator = laplacian(mesh, &[], Operator::Tufted).unwrap();
    let spectrum = solved(&operator, k);
    (operator, spectrum)
}

/// Solves and checks all properties that hold for any matrix.
fn solved(operator: &Laplacian, k: usize) -> Spectrum {
    let options = Options::default();
    let spectrum = Spectrum::smallest(&operator.stiffness, &operator.mass, k, &options).unwrap();
    check(operator, k, &spectrum);
    spectrum
}

fn check(operator: &Laplacian, k: usize, spectrum: &Spectrum) {
    check_form(operator, k, spectrum);
    assert!(spectrum.certificate.proved(), "{:?}", spectrum.certificate);
    let phi = &spectrum.eigenvectors;
    let positive = spectrum
        .eigenvalues
        .iter()
        .copied()
        .find(|&l| l > 0.0)
        .unwrap_or(1.0);
    for (j, &lambda) in spectrum.eigenvalues.iter().enumerate() {
        // This check is independent of the solver, in plain arithmetic.
        let mut squared = 0.0;
        for (i, row) in operator.stiffness.outer_iterator().enumerate() {
            let w: f64 = row.iter().map(|(c, w)| w * phi[(c, j)]).sum();
            let r = w - lambda * operator.mass[i] * phi[(i, j)];
            squared += r * r / operator.mass[i];
        }
        let (residual, limit) = (squared.sqrt(), RESIDUAL * lambda.max(positive));
        assert!(
            residual <= limit,
            "pair {j} ({lambda}): residual {residual} above {limit}"
        );
        assert!((residual - spectrum.residuals[j]).abs() <= 0.1 * limit);
    }
}

/// Order, signs, orthonormality and the count.
fn check_form(operator: &Laplacian, k: usize, spectrum: &Spectrum) {
    let (n, phi) = (operator.mass.len(), &spectrum.eigenvectors);
    assert_eq!(spectrum.eigenvalues.len(), k);
    assert_eq!(phi.shape(), (n, k));
    assert!(spectrum.eigenvalues.is_sorted());
    assert!(spectrum.eigenvalues[0] >= 0.0);
    for j in 0..k {
        let column = phi.column(j);
        let largest = column.iter().fold(0.0f64, |m, x| m.max(x.abs()));
        assert_eq!(
            column.iter().copied().find(|x| x.abs() == largest),
            Some(largest)
        );
    }
    let weighted = nalgebra::DMatrix::from_fn(n, k, |i, j| operator.mass[i] * phi[(i, j)]);
    let gram = phi.transpose() * weighted;
    let off = (gram - nalgebra::DMatrix::identity(k, k)).amax();
    assert!(off <= ORTHONORMAL, "ΦᵀAΦ is off I by {off}");
    let certificate = &spectrum.certificate;
    assert!(certificate.count >= k && certificate.tau > spectrum.eigenvalues[k - 1]);
}

fn assert_close(found: &[f64], expected: &[f64], relative: f64) {
    assert_eq!(found.len(), expected.len());
    for (i, (f, e)) in found.iter().zip(expected).enumerate() {
        assert!(
            (f - e).abs() <= relative * e.abs().max(expected[expected.len() - 1] * 1e-6),
            "eigenvalue {i} is {f}, expected {e}"
        );
    }
}

/// All eigenvalues by the dense solver on the whole matrix, whatever the components.
fn dense(operator: &Laplacian) -> Vec<f64> {
    let n = operator.mass.len();
    let mut a = vec![0.0; n * n];
    for (&w, (i, j)) in operator.stiffness.iter() {
        a[i * n + j] = w / (operator.mass[i] * operator.mass[j]).sqrt();
    }
    crate::linalg::dense_eigen::symmetric_eigen(&a, n)
        .unwrap()
        .0
}

/// The five-point Laplacian of a flat torus of size 1 × 1 on an `n × m` grid, and its exact
/// eigenvalues.
fn flat_torus(n: usize, m: usize) -> (Laplacian, Vec<f64>) {
    let (hx, hy) = (1.0 / n as f64, 1.0 / m as f64);
    let mut triplets = sprs::TriMat::new((n * m, n * m));
    for i in 0..n {
        for j in 0..m {
            let here = i * m + j;
            let right = ((i + 1) % n) * m + j;
            let up = i * m + (j + 1) % m;
            for (other, w) in [(right, hy / hx), (up, hx / hy)] {
                triplets.add_triplet(here, other, -w);
                triplets.add_triplet(other, here, -w);
                triplets.add_triplet(here, here, w);
                triplets.add_triplet(other, other, w);
            }
        }
    }
    let mut exact = Vec::new();
    for i in 0..n {
        for j in 0..m {
            let x = (2.0 - 2.0 * (TAU * i as f64 / n as f64).cos()) / (hx * hx);
            let y = (2.0 - 2.0 * (TAU * j as f64 / m as f64).cos()) / (hy * hy);
            exact.push(x + y);
        }
    }
    exact.sort_by(f64::total_cmp);
    (
        Laplacian {
            stiffness: triplets.to_csr(),
            mass: vec![hx * hy; n * m],
        },
        exact,
    )
}

#[test]
fn every_mesh_of_the_zoo_has_a_spectrum() {
    let mut n_solved = 0;
    for (name, mesh) in zoo::clean_meshes() {
        let bridges = bridges(&mesh);
        for kind in [Operator::Tufted, Operator::Cotan, Operator::MeshLaplace] {
            let operator = match laplacian(&mesh, &bridges, kind) {
                Ok(operator) => operator,
                Err(e) => {
                    assert_eq!(kind, Operator::Cotan, "{name}: {e}");
                    continue;
                }
            };
            let n = operator.mass.len();
            for k in [1, n.min(12)] {
                let options = Options::default();
                let found = Spectrum::smallest(&operator.stiffness, &operator.mass, k, &options);
                let found = match found {
                    Ok(found) => found,
                    // Weights of slivers, which the default operator does not have, may exceed
                    // double precision.
                    Err(e) => {
                        assert_ne!(kind, Operator::Tufted, "{name}: {e}");
                        assert!(matches!(e, SpectrumError::Residual { .. }), "{name}: {e}");
                        continue;
                    }
                };
                check_form(&operator, k, &found);
                let proved = found.certificate.proved();
                assert!(proved || kind != Operator::Tufted, "{name}: {found:?}");
                // Values are measured on differences, since such weights cancel in plain sums.
                let positive = found.eigenvalues.iter().copied().find(|l| *l > 0.0);
                let tau = found.certificate.tau;
                let scale = positive.unwrap_or(if tau.is_finite() { tau } else { 1.0 });
                for (r, l) in found.residuals.iter().zip(&found.eigenvalues) {
                    assert!(*r <= RESIDUAL * l.max(scale), "{name}, {kind:?}: {r}");
                }
                n_solved += 1;
            }
        }
    }
    assert!(n_solved > 60, "{n_solved}");
}

#[test]
fn sphere_has_l_l_plus_1() {
    let (_, spectrum) = of(&icosphere(4), 100);
    let mut i = 0;
    for l in 0..8 {
        let expected = f64::from(l * (l + 1));
        for _ in 0..2 * l + 1 {
            // The discretisation error of 2,562 vertices grows with λ.
            let tolerance = 0.002 * expected + 0.0004 * expected * expected;
            let found = spectrum.eigenvalues[i];
            assert!(
                (found - expected).abs() <= tolerance,
                "{i}: {found}, expected {expected}"
            );
            i += 1;
        }
    }
}

#[test]
fn flat_torus_is_exact_with_its_multiplicities() {
    for (n, m, k) in [(12, 10, 30), (24, 24, 150), (64, 64, 200), (90, 40, 60)] {
        let (operator, exact) = flat_torus(n, m);
        let spectrum = solved(&operator, k);
        assert_close(&spectrum.eigenvalues, &exact[..k], 1e-10);
    }
}

#[test]
fn rectangle_has_neumann_eigenvalues() {
    let (width, height) = (2.0, 1.3);
    let mesh = rectangle(width, height, 60, 40);
    let mut exact: Vec<f64> = (0..20)
        .flat_map(|i| (0..20).map(move |j| (f64::from(i) / 2.0, f64::from(j) / 1.3)))
        .map(|(x, y)| PI * PI * (x * x + y * y))
        .collect();
    exact.sort_by(f64::total_cmp);
    for operator in [Operator::Tufted, Operator::Cotan] {
        let operator = laplacian(&mesh, &[], operator).unwrap();
        let spectrum = solved(&operator, 20);
        assert_close(&spectrum.eigenvalues[1..], &exact[1..20], 0.01);
    }
}

#[test]
fn a_matrix_without_null_vector() {
    // Dirichlet conditions make the diagonal alone larger.
    let (mut operator, exact) = flat_torus(40, 40);
    let shift = 17.0;
    let mut triplets = sprs::TriMat::new(operator.stiffness.shape());
    for (&w, (i, j)) in operator.stiffness.iter() {
        let diagonal = if i == j {
            shift * operator.mass[i]
        } else {
            0.0
        };
        triplets.add_triplet(i, j, w + diagonal);
    }
    operator.stiffness = triplets.to_csr();
    let expected: Vec<f64> = exact[..90].iter().map(|l| l + shift).collect();
    assert_close(&solved(&operator, 90).eigenvalues, &expected, 1e-10);
}

#[test]
fn invariant_under_rotation_renumbering_and_scaling() {
    let mesh = bumpy_torus(50, 24);
    let k = 80;
    let (_, reference) = of(&mesh, k);
    let (c, s) = (0.8, 0.6);
    let mut rotated = mesh.clone();
    for p in &mut rotated.vertices {
        *p = [c * p[0] - s * p[1] + 3.0, s * p[0] + c * p[1], p[2] - 1.0];
    }
    assert_close(&of(&rotated, k).1.eigenvalues, &reference.eigenvalues, 1e-9);
    let mut scaled = mesh.clone();
    for p in &mut scaled.vertices {
        *p = p.map(|x| 1e3 * x);
    }
    let values: Vec<f64> = of(&scaled, k)
        .1
        .eigenvalues
        .iter()
        .map(|l| l * 1e6)
        .collect();
    assert_close(&values, &reference.eigenvalues, 1e-9);
    let n = mesh.vertices.len() as u32;
    let new = |v: u32| (v * 7 + 3) % n;
    assert_eq!(n % 7, 3, "7 must be invertible");
    let mut renumbered = mesh.clone();
    for (v, &p) in mesh.vertices.iter().enumerate() {
        renumbered.vertices[new(v as u32) as usize] = p;
    }
    renumbered.faces = mesh.faces.iter().map(|f| f.map(new)).collect();
    let (_, other) = of(&renumbered, k);
    assert_close(&other.eigenvalues, &reference.eigenvalues, 1e-9);
    for j in 0..10 {
        // Simple eigenvalues have the same vectors, including canonical signs.
        for v in 0..n {
            let (a, b) = (
                reference.eigenvectors[(v as usize, j)],
                other.eigenvectors[(new(v) as usize, j)],
            );
            assert!((a - b).abs() < 1e-6, "vector {j} at {v}: {a} {b}");
        }
    }
}

#[test]
fn many_components() {
    for (mesh, count, k) in [
        (icosphere(2), 1, 60),
        (icosphere(2), 7, 120),
        (icosphere(1), 40, 300),
        (cube(2), 40, 170),
        (cube(1), 300, 320),
        (icosphere(3), 7, 90),
    ] {
        let one = dense(&laplacian(&mesh, &[], Operator::Tufted).unwrap());
        let mut expected: Vec<f64> = one
            .iter()
            .flat_map(|&l| std::iter::repeat_n(l.max(0.0), count))
            .collect();
        expected.truncate(k);
        let (_, spectrum) = of(&copies(&mesh, count as u32), k);
        assert_close(&spectrum.eigenvalues, &expected, 1e-8);
        assert_eq!(spectrum.certificate.n_components, count);
        let zeros = spectrum.eigenvalues.iter().filter(|l| **l == 0.0).count();
        assert_eq!(zeros, count.min(k));
    }
}

#[test]
fn bridged_components_are_one_domain_with_near_multiplicities() {
    // 40 equal cubes in a row: each eigenvalue comes 40 times, split by the bridges alone.
    let (count, part) = (40, cube(2));
    let n = part.vertices.len() as u32;
    let mesh = copies(&part, count);
    let bridges: Vec<Bridge> = (1..count)
        .map(|i| Bridge {
            vertices: [i * n - 1, i * n],
            faces: [0, 0],
            length: 2.0,
        })
        .collect();
    let operator = laplacian(&mesh, &bridges, Operator::Tufted).unwrap();
    let spectrum = solved(&operator, 200);
    assert_eq!(spectrum.certificate.n_components, 1);
    assert_close(&spectrum.eigenvalues[1..], &dense(&operator)[1..200], 1e-6);
    assert_eq!(
        spectrum.eigenvalues.iter().filter(|l| **l == 0.0).count(),
        1
    );
    // The spectrum of the parts is barely disturbed.
    let separate = of(&mesh, 200).1;
    for (a, b) in separate.eigenvalues.iter().zip(&spectrum.eigenvalues) {
        assert!((a - b).abs() <= 0.02 * separate.eigenvalues[60], "{a} {b}");
    }
}

fn assert_complete_for_seeds(seeds: std::ops::Range<u64>) {
    let operator = laplacian(&icosphere(3), &[], Operator::Cotan).unwrap();
    let expected = dense(&operator);
    for seed in seeds {
        let k = 30 + seed as usize % 50;
        let options = Options {
            seed,
            ..Options::default()
        };
        let s = Spectrum::smallest(&operator.stiffness, &operator.mass, k, &options).unwrap();
        assert!(
            s.certificate.n_krylov > 0,
            "this is to test the iterative route"
        );
        assert_close(&s.eigenvalues[1..], &expected[1..k], 1e-9);
    }
}

#[test]
fn icosphere_is_complete_for_100_seeds() {
    assert_complete_for_seeds(0..100);
}

#[test]
#[ignore = "takes half a minute"]
fn icosphere_is_complete_for_1000_seeds() {
    assert_complete_for_seeds(100..1100);
}

#[test]
fn one_cluster_is_solved_densely() {
    // The complete graph has the eigenvalue 0 once, and n in all other places.
    let n = 300;
    let mut triplets = sprs::TriMat::new((n, n));
    for i in 0..n {
        for j in 0..n {
            triplets.add_triplet(i, j, if i == j { n as f64 - 1.0 } else { -1.0 });
        }
    }
    let operator = Laplacian {
        stiffness: triplets.to_csr(),
        mass: vec![1.0; n],
    };
    let spectrum = solved(&operator, 5);
    assert_close(
        &spectrum.eigenvalues,
        &[0.0, 300.0, 300.0, 300.0, 300.0],
        1e-12,
    );
    assert_eq!(spectrum.certificate.count, n);
}

#[test]
fn isolated_vertices_are_components() {
    let mut operator = laplacian(&icosphere(2), &[], Operator::Tufted).unwrap();
    let n = operator.mass.len();
    let mut triplets = sprs::TriMat::new((n + 3, n + 3));
    for (&w, (i, j)) in operator.stiffness.iter() {
        triplets.add_triplet(i, j, w);
    }
    let connected = solved(&operator, 40).eigenvalues;
    operator = Laplacian {
        stiffness: triplets.to_csr(),
        mass: [operator.mass, vec![0.1, 2.0, 3.0]].concat(),
    };
    let spectrum = solved(&operator, 43);
    assert_eq!(spectrum.certificate.n_components, 4);
    assert_close(&spectrum.eigenvalues[3..], &connected, 1e-9);
}

#[test]
fn cubes_have_their_symmetric_clusters() {
    let operator = laplacian(&cube(12), &[], Operator::Tufted).unwrap();
    let expected = dense(&operator);
    for k in [10, 33, 64, 151] {
        let spectrum = solved(&operator, k);
        assert!(spectrum.certificate.n_krylov > 0);
        assert_close(&spectrum.eigenvalues[1..], &expected[1..k], 1e-9);
    }
}

#[test]
fn slivers_stay_accurate() {
    // Columns of vertices move close together, so triangles are 10⁵ times longer than wide.
    let mut mesh = bumpy_torus(60, 30);
    for i in (0..60).step_by(6) {
        for j in 0..30 {
            let (a, b) = (mesh.vertices[i * 30 + j], mesh.vertices[(i + 1) * 30 + j]);
            let t = 1e-5;
            mesh.vertices[(i + 1) * 30 + j] = std::array::from_fn(|d| a[d] + t * (b[d] - a[d]));
        }
    }
    for operator in [Operator::Tufted, Operator::Cotan] {
        let operator = laplacian(&mesh, &[], operator).unwrap();
        let options = Options::default();
        for k in [40, 150] {
            let s = Spectrum::smallest(&operator.stiffness, &operator.mass, k, &options).unwrap();
            let positive = s.eigenvalues[1];
            for (r, l) in s.residuals.iter().zip(&s.eigenvalues) {
                assert!(*r <= RESIDUAL * l.max(positive));
            }
            assert_eq!(s.eigenvalues[0], 0.0);
        }
    }
}

#[test]
fn any_k_on_a_small_mesh() {
    let tetrahedron = TriMesh {
        vertices: vec![
            [1.0, 1.0, 1.0],
            [1.0, -1.0, -1.0],
            [-1.0, 1.0, -1.0],
            [-1.0, -1.0, 1.0],
        ],
        faces: vec![[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]],
    };
    for k in 1..=4 {
        let (_, spectrum) = of(&tetrahedron, k);
        assert_eq!(spectrum.eigenvalues[0], 0.0);
        for l in &spectrum.eigenvalues[1..] {
            assert!((l - spectrum.eigenvalues[1]).abs() < 1e-12 * l);
        }
        assert_eq!(spectrum.certificate.tau.is_infinite(), k > 1);
    }
    let mesh = bumpy_torus(30, 16);
    let n = mesh.vertices.len();
    let all = of(&mesh, n).1;
    for k in [1, 2, 3, n / 3, n / 2, n - 1] {
        let (_, spectrum) = of(&mesh, k);
        assert_close(&spectrum.eigenvalues, &all.eigenvalues[..k], 1e-9);
    }
    let single = TriMesh {
        vertices: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        faces: vec![[0, 1, 2]],
    };
    assert_eq!(of(&single, 3).1.eigenvalues[0], 0.0);
}

#[test]
fn few_pairs_of_a_large_mesh() {
    let mesh = bumpy_torus(120, 40);
    let reference = of(&mesh, 40).1.eigenvalues;
    for k in [1, 2, 5, 16, 17] {
        let (_, spectrum) = of(&mesh, k);
        assert!(spectrum.certificate.n_krylov > 0);
        assert_close(&spectrum.eigenvalues, &reference[..k], 1e-9);
    }
}

#[test]
fn rows_are_those_of_the_matrix() {
    // One component has consecutive columns; several components have alternating ones.
    for mesh in [bumpy_torus(40, 30), copies(&bumpy_torus(12, 8), 3)] {
        let operator = laplacian(&mesh, &[], Operator::Tufted).unwrap();
        let (w, a, k, options) = (&operator.stiffness, &operator.mass, 45, Options::default());
        let pairs = Eigenpairs::smallest(w, a, k, &options).unwrap();
        let spectrum = Spectrum::smallest(w, a, k, &options).unwrap();
        assert_eq!((pairs.n(), pairs.k()), spectrum.eigenvectors.shape());
        assert_eq!(pairs.eigenvalues, spectrum.eigenvalues);
        let all = pairs.all_rows();
        let mut rows = vec![f64::NAN; 7 * k];
        for first in (0..pairs.n() - 7).step_by(5) {
            pairs.rows(first, &mut rows);
            for (v, row) in rows.chunks_exact(k).enumerate() {
                let expected: Vec<f64> = spectrum
                    .eigenvectors
                    .row(first + v)
                    .iter()
                    .copied()
                    .collect();
                assert_eq!(row, expected);
                assert_eq!(all[(first + v) * k..][..k], expected);
            }
        }
    }
}

#[test]
fn a_count_that_rounding_might_change_is_not_called_a_proof() {
    let mut operator = laplacian(&bumpy_torus(40, 30), &[], Operator::Tufted).unwrap();
    assert!(solved(&operator, 40).certificate.proved());
    // A vertex has almost no mass, so one entry of the matrix in standard form dominates all
    // others.
    operator.mass[17] *= 1e-13;
    let options = Options {
        tolerance: 1e-5,
        ..Options::default()
    };
    let found = Spectrum::smallest(&operator.stiffness, &operator.mass, 40, &options).unwrap();
    let certificate = found.certificate;
    assert!(!certificate.proved(), "{certificate:?}");
    assert!(certificate.perturbation >= certificate.margin && certificate.count >= 40);
}

#[test]
fn the_same_bits_for_any_number_of_threads() {
    let operator = laplacian(&bumpy_torus(80, 30), &[], Operator::Tufted).unwrap();
    let solve = |threads| {
        let options = Options {
            threads,
            ..Options::default()
        };
        Spectrum::smallest(&operator.stiffness, &operator.mass, 120, &options).unwrap()
    };
    let one = solve(1);
    assert!(one.certificate.n_krylov > 0);
    for threads in [2, 3] {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        assert_eq!(one, pool.install(|| solve(threads)));
    }
    assert_eq!(one, solve(1));
}
