//! The parts of the eigen solver against plain loops.

use super::dense_eigen::symmetric_eigen;
use super::ldlt::{Analysis, Factor, LdltError, SymmetricSparse};
use super::panel::{Basis, CHUNK, Row, WIDTH, gram, zero_panel};
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64;

/// Relative rounding of a few hundred operations.
const ROUNDING: f64 = 1e-12;

fn random_panel(n: usize, random: &mut Pcg64) -> Vec<Row> {
    let mut panel = zero_panel(n);
    for row in &mut panel[..n] {
        row.0.fill_with(|| random.random::<f64>() - 0.5);
    }
    panel
}

/// A random sparse matrix of `n` rows with about 6 entries in each.
fn random_matrix(n: usize, random: &mut Pcg64) -> (SymmetricSparse, Vec<f64>) {
    let mut dense = vec![0.0; n * n];
    for i in 0..n {
        dense[i * n + i] = 4.0 * random.random::<f64>() - 1.0;
        for _ in 0..3 {
            let j = random.random_range(0..n);
            let x = random.random::<f64>() - 0.5;
            dense[i * n + j] = x;
            dense[j * n + i] = x;
        }
    }
    let mut m = SymmetricSparse {
        row_starts: vec![0],
        columns: vec![],
        values: vec![],
    };
    for i in 0..n {
        for j in 0..n {
            if i == j || dense[i * n + j] != 0.0 {
                m.columns.push(j as u32);
                m.values.push(dense[i * n + j]);
            }
        }
        m.row_starts.push(m.columns.len());
    }
    (m, dense)
}

#[test]
fn products_of_panels_are_those_of_plain_loops() {
    let mut random = Pcg64::seed_from_u64(1);
    for n in [1, 95, CHUNK, 1_000] {
        for parallel in [false, true] {
            let panels: Vec<_> = (0..3).map(|_| random_panel(n, &mut random)).collect();
            let w = random_panel(n, &mut random);
            let mut basis = Basis::new(n, 3, parallel);
            panels.iter().for_each(|p| basis.push(p));
            assert_eq!(basis.panel(1), panels[1]);
            let tiles = basis.project(1, &w);
            assert_eq!(tiles.len(), 2);
            assert_eq!(gram(&panels[2], &w), tiles[1]);
            for (tile, v) in tiles.iter().zip(&panels[1..]) {
                for (i, row) in tile.iter().enumerate() {
                    for (j, found) in row.0.iter().enumerate() {
                        let plain: f64 = v.iter().zip(&w).map(|(a, b)| a.0[i] * b.0[j]).sum();
                        assert!((found - plain).abs() < ROUNDING * n as f64);
                    }
                }
            }
            let sum = &basis.combinations(&[basis.project(0, &w)])[0];
            let mut added = w.clone();
            basis.add_combination(0, &basis.project(0, &w), &mut added);
            for ((s, a), w) in sum.iter().zip(&added).zip(&w) {
                for j in 0..WIDTH {
                    assert!((a.0[j] - w.0[j] - s.0[j]).abs() < ROUNDING * n as f64);
                }
            }
            assert!(
                sum[n..].iter().all(|row| *row == Row::ZERO),
                "padding stays zero"
            );
        }
    }
}

#[test]
fn factors_solve_and_count() {
    let mut random = Pcg64::seed_from_u64(2);
    for n in [1, 2, 17, 200] {
        let (matrix, dense) = random_matrix(n, &mut random);
        let (eigenvalues, _) = symmetric_eigen(&dense, n).unwrap();
        let analysis = Analysis::new(&matrix).unwrap();
        let permuted = matrix.permuted(&analysis.order);
        for shift in [-100.0, -0.31, 0.4, 1.7, 100.0] {
            let factor = Factor::new(&analysis, &permuted, shift).unwrap();
            assert_eq!(
                factor.n_negative,
                eigenvalues.iter().filter(|l| **l < shift).count()
            );
            let b = random_panel(n, &mut random);
            let mut x = b.clone();
            factor.solve(&mut x);
            // Backward error: the residual against the bound on the perturbation.
            for i in 0..n {
                let (columns, values) = permuted.row(i);
                for j in 0..WIDTH {
                    let sx: f64 = columns
                        .iter()
                        .zip(values)
                        .map(|(&c, v)| v * x[c as usize].0[j])
                        .sum();
                    let r = sx - shift * x[i].0[j] - b[i].0[j];
                    let size = x.iter().map(|row| row.0[j].abs()).fold(1.0, f64::max);
                    assert!(
                        r.abs() <= 10.0 * factor.perturbation * size + ROUNDING,
                        "{r}"
                    );
                }
            }
        }
    }
}

#[test]
fn a_zero_pivot_is_named() {
    let matrix = SymmetricSparse {
        row_starts: vec![0, 2, 4],
        columns: vec![0, 1, 0, 1],
        values: vec![0.0, 1.0, 1.0, 0.0],
    };
    let analysis = Analysis::new(&matrix).unwrap();
    let error = Factor::new(&analysis, &matrix.permuted(&analysis.order), 0.0).unwrap_err();
    assert_eq!(error, LdltError::ZeroPivot { index: 0, n: 2 });
    assert_eq!(error.to_string(), "pivot 0 of 2 is zero or not finite");
}
