//! Tests `describe --full`: its output matches its files, and its timings add up.

use super::check;
use crate::harness::{Home, json, skittle, stdout};
use coseg::operators::Laplacian;
use safetensors::SafeTensors;

fn doubles(file: &SafeTensors<'_>, name: &str) -> Vec<f64> {
    let (chunks, _) = file.tensor(name).unwrap().data().as_chunks::<8>();
    chunks.iter().map(|b| f64::from_le_bytes(*b)).collect()
}

fn words(file: &SafeTensors<'_>, name: &str) -> Vec<usize> {
    let (chunks, _) = file.tensor(name).unwrap().data().as_chunks::<4>();
    chunks
        .iter()
        .map(|b| u32::from_le_bytes(*b) as usize)
        .collect()
}

#[test]
fn the_file_holds_the_operator_and_its_pairs() {
    let home = Home::new();
    let mesh = home.mesh("skittle.off", &skittle(1));
    let out = home.path("out.safetensors").display().to_string();
    let k = 30;
    for operator in ["tufted", "cotan", "mesh-laplace"] {
        let args = [
            "describe",
            &mesh,
            "--full",
            "--k",
            "30",
            "--operator",
            operator,
        ];
        let found = json(
            &home.coseg(&[&args[..], &["--json", "-o", &out]].concat()),
            0,
        );
        let bytes = std::fs::read(&out).unwrap();
        let file = SafeTensors::deserialize(&bytes).unwrap();
        let mass = doubles(&file, "mass");
        let n = mass.len();
        assert_eq!(found["n_vertices"], n);
        let stiffness = sprs::CsMat::new(
            (n, n),
            words(&file, "stiffness_indptr"),
            words(&file, "stiffness_indices"),
            doubles(&file, "stiffness_data"),
        );
        let vectors = doubles(&file, "eigenvectors");
        let columns: Vec<Vec<f64>> = (0..k)
            .map(|j| (0..n).map(|i| vectors[i * k + j]).collect())
            .collect();
        let values = doubles(&file, "eigenvalues");
        check(&Laplacian { stiffness, mass }, &values, &columns);
        assert_eq!(values[k - 1], found["eigenvalues"][k - 1].as_f64().unwrap());
        assert_eq!(found["certificate"]["proved"], true, "{found}");
        assert_signatures(&file, &values, &columns);
    }
}

/// Checks that signatures follow the formulas, for all batches and kernels.
fn assert_signatures(file: &SafeTensors<'_>, values: &[f64], columns: &[Vec<f64>]) {
    let (n, k) = (columns[0].len(), values.len());
    let times = coseg::descriptors::hks_times(values, 100);
    let hks = doubles(file, "hks");
    let weights = coseg::descriptors::wave_weights(values, 100);
    let wks = doubles(file, "wks");
    let gps = doubles(file, "gps");
    assert_eq!(gps.len(), n * (k - 1));
    for v in (0..n).step_by(17) {
        for j in [0, 1, 50, 98, 99] {
            let heat = |i: usize| (-values[i] * times[j]).exp() * columns[i][v].powi(2);
            let expected: f64 = (0..k).map(heat).sum();
            let found = hks[v * 100 + j];
            assert!(
                (found - expected).abs() <= 1e-12 * expected,
                "hks {v} {j}: {found} {expected}"
            );
            let wave = |i: usize| weights[(i, j)] * columns[i][v].powi(2);
            let expected: f64 = (0..k).map(wave).sum();
            let found = wks[v * 100 + j];
            assert!(
                (found - expected).abs() <= 1e-12 * expected,
                "wks {v} {j}: {found} {expected}"
            );
        }
        for i in 1..k {
            let (found, expected) = (gps[v * (k - 1) + i - 1], columns[i][v] / values[i].sqrt());
            assert!(
                (found - expected).abs() <= 1e-12 * expected.abs(),
                "gps {v} {i}"
            );
        }
    }
    let dna = file.tensor("shape_dna").unwrap();
    assert_eq!(dna.shape(), [k - 1]);
    let (first, _) = dna.data().split_first_chunk::<4>().unwrap();
    assert_eq!(f32::from_le_bytes(*first), values[1].ln() as f32);
}

#[test]
fn parts_of_the_solver_are_within_its_total() {
    let home = Home::new();
    let mesh = home.mesh("skittle.off", &skittle(2));
    let args = ["describe", &mesh, "--full", "--k", "40", "--timings"];
    let found = json(&home.coseg(&[&args[..], &["--json"]].concat()), 0);
    let timings = found["timings_ms"].as_object().unwrap();
    let ms = |name: &str| timings[name].as_f64().unwrap();
    let parts: Vec<&String> = timings
        .keys()
        .filter(|n| n.starts_with("spectrum."))
        .collect();
    assert!(parts.len() >= 3, "{parts:?}");
    let sum: f64 = parts.iter().map(|n| ms(n)).sum();
    // All stages of the solver are within a stage; the rest is the time between two readings of a
    // clock.
    let total = ms("spectrum");
    assert!(sum <= total + 1e-6 && sum > 0.5 * total, "{sum} of {total}");

    let text = stdout(&home.coseg(&args), 0);
    assert!(
        text.lines()
            .any(|l| l.trim_start().starts_with("spectrum.assemble ")),
        "{text}"
    );
    // Without --full a description has only its own stages.
    let args = ["describe", &mesh, "--k", "40", "--json"];
    let found = json(&home.coseg(&args), 0);
    let names = found["timings_ms"].as_object().unwrap().keys();
    assert!(names.clone().all(|n| !n.contains('.')), "{names:?}");
}
