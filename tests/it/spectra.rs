//! Compares spectra with another implementation and with formulas, and tests them on dirty meshes
//! and through the command.

mod command;
mod convergence;
mod dirty;
mod reference;

use coseg::operators::{Laplacian, Operator, laplacian};
use coseg::spectrum::{Options, Progress, Spectrum, SpectrumError};
use std::sync::atomic::{AtomicBool, Ordering};

/// The bound that the solver promises.
const RESIDUAL: f64 = 1e-8;
const ORTHONORMAL: f64 = 1e-10;

fn smallest(operator: &Laplacian, k: usize) -> Result<Spectrum, SpectrumError> {
    let found = Spectrum::smallest(&operator.stiffness, &operator.mass, k, &Options::default())?;
    let (n, vectors) = (operator.mass.len(), &found.eigenvectors);
    let mut columns = Vec::new();
    for j in 0..k {
        columns.push((0..n).map(|i| vectors[(i, j)]).collect::<Vec<f64>>());
    }
    check(operator, &found.eigenvalues, &columns);
    Ok(found)
}

/// Checks the promises that hold for any matrix: `columns` are the eigenvectors.
fn check(operator: &Laplacian, eigenvalues: &[f64], columns: &[Vec<f64>]) {
    let mass = &operator.mass;
    assert_eq!(columns.len(), eigenvalues.len());
    assert!(eigenvalues.is_sorted() && eigenvalues[0] >= 0.0);
    let positive = eigenvalues.iter().copied().find(|l| *l > 0.0);
    for (j, (phi, lambda)) in columns.iter().zip(eigenvalues).enumerate() {
        let mut squared = 0.0;
        for (i, row) in operator.stiffness.outer_iterator().enumerate() {
            let product: f64 = row.iter().map(|(c, w)| w * phi[c]).sum();
            squared += (product - lambda * mass[i] * phi[i]).powi(2) / mass[i];
        }
        let limit = RESIDUAL * lambda.max(positive.unwrap_or(1.0));
        assert!(
            squared.sqrt() <= limit,
            "pair {j}: {} above {limit}",
            squared.sqrt()
        );
        for (l, other) in columns[..=j].iter().enumerate() {
            let product: f64 = (0..mass.len()).map(|i| phi[i] * mass[i] * other[i]).sum();
            let expected = f64::from(u8::from(l == j));
            assert!(
                (product - expected).abs() < ORTHONORMAL,
                "pairs {l}, {j}: {product}"
            );
        }
    }
}

#[test]
fn another_thread_stops_a_solve() {
    let operator = laplacian(&dirty::drum(900, 2.0), &[], Operator::Tufted).unwrap();
    let begun = AtomicBool::new(false);
    let stop = AtomicBool::new(false);
    let result = std::thread::scope(|scope| {
        scope.spawn(|| {
            while !begun.load(Ordering::Acquire) {
                std::thread::yield_now();
            }
            stop.store(true, Ordering::Release);
        });
        let hook = |p: &Progress| {
            begun.fetch_or(p.done > 0, Ordering::AcqRel);
            // The count stays below half of the space, so that the flag ends the solve.
            while 2 * p.done > p.expected && !stop.load(Ordering::Acquire) {
                std::thread::yield_now();
            }
            !stop.load(Ordering::Acquire)
        };
        let options = Options {
            progress: Some(&hook),
            ..Options::default()
        };
        Spectrum::smallest(&operator.stiffness, &operator.mass, 60, &options)
    });
    assert_eq!(result, Err(SpectrumError::Cancelled { stage: "iterate" }));
}
