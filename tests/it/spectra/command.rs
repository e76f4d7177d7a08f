//! `describe --full`: what it writes is what it says, and its timings add up.

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
    }
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
    // All of the solver is within some part; what is not is the time between two readings of a clock.
    let total = ms("spectrum");
    assert!(sum <= total + 1e-6 && sum > 0.5 * total, "{sum} of {total}");

    let text = stdout(&home.coseg(&args), 0);
    assert!(
        text.lines()
            .any(|l| l.trim_start().starts_with("spectrum.assemble ")),
        "{text}"
    );
    // Without --full a description has its stages alone.
    let args = ["describe", &mesh, "--k", "40", "--json"];
    let found = json(&home.coseg(&args), 0);
    let names = found["timings_ms"].as_object().unwrap().keys();
    assert!(names.clone().all(|n| !n.contains('.')), "{names:?}");
}
