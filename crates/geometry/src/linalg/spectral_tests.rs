//! Compares the components of the eigensolver with plain loops.

use super::basis::Basis;
use super::dense_eigen::symmetric_eigen;
use super::ldlt::{Analysis, Factor, Inertia, LdltError, SymmetricSparse};
use super::panel::{
    PADDING, Row, Tile, WIDTH, add_product, gram, multiply_in_place, negated, zero_panel,
};
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
    for n in [1, 95, PADDING, 3_000] {
        for parallel in [false, true] {
            let panels: Vec<_> = (0..3).map(|_| random_panel(n, &mut random)).collect();
            let w = random_panel(n, &mut random);
            // There is room for one panel, so the others make it grow.
            let mut basis = Basis::new(n, 1, parallel);
            panels.iter().for_each(|p| basis.push(p));
            assert_eq!(basis.panel(1), panels[1]);
            let [tiles] = basis.project(1, [&w]);
            assert_eq!(tiles.len(), 2);
            assert_eq!(gram(&panels[2], &w, parallel), tiles[1]);
            assert_eq!(basis.project(1, [&panels[0], &w])[1], tiles);
            for (tile, v) in tiles.iter().zip(&panels[1..]) {
                for (i, row) in tile.iter().enumerate() {
                    for (j, found) in row.0.iter().enumerate() {
                        let plain: f64 = v.iter().zip(&w).map(|(a, b)| a.0[i] * b.0[j]).sum();
                        assert!((found - plain).abs() < ROUNDING * n as f64);
                    }
                }
            }
            let [tiles] = basis.project(0, [&w]);
            let (mut added, mut other) = (w.clone(), w.clone());
            basis.add_combination(0, [&tiles, &tiles], [&mut added, &mut other]);
            assert_eq!(added, other);
            let mut product = w.clone();
            add_product(&panels[0], &tiles[0], &mut product, parallel);
            let mut combined = basis;
            combined.transform(&[tiles.clone(), tiles]);
            assert_eq!(combined.n_panels(), 2);
            assert_eq!(combined.panel(0), combined.panel(1));
            let sum = combined.panel(0);
            for (i, (s, a)) in sum.iter().zip(&added).enumerate() {
                for j in 0..WIDTH {
                    assert!((a.0[j] - w[i].0[j] - s.0[j]).abs() < ROUNDING * n as f64);
                }
            }
            let padding = sum[n..].iter().chain(&product[n..]);
            assert!(padding.into_iter().all(|row| *row == Row::ZERO));
            let mut alone = panels[0].clone();
            multiply_in_place(&mut alone, &negated(&identity_tile()), parallel);
            let negative = |(a, b): (&Row, &Row)| a.0 == b.0.map(|x| -x);
            assert!(alone.iter().zip(&panels[0]).all(negative));
        }
    }
}

fn identity_tile() -> Tile {
    std::array::from_fn(|i| Row(std::array::from_fn(|j| f64::from(u8::from(i == j)))))
}

#[test]
fn columns_are_gathered_from_several_bases() {
    let mut random = Pcg64::seed_from_u64(3);
    let n = 50;
    let make = |random: &mut Pcg64| {
        let mut basis = Basis::new(n, 2, false);
        basis.push(&random_panel(n, random));
        basis.push(&random_panel(n, random));
        basis
    };
    let (a, b) = (make(&mut random), make(&mut random));
    let columns = [
        (1, 9),
        (0, 0),
        (0, 15),
        (1, 8),
        (0, 3),
        (1, 1),
        (0, 2),
        (1, 2),
        (1, 15),
    ];
    let gathered = Basis::of_columns(n, false, &[&a, &b], &columns);
    assert_eq!(gathered.n_panels(), 2);
    for (to, &(source, from)) in columns.iter().enumerate() {
        let from_panel = [&a, &b][source].panel(from / WIDTH);
        for (found, row) in gathered.panel(to / WIDTH).iter().zip(&from_panel) {
            assert_eq!(found.0[to % WIDTH], row.0[from % WIDTH]);
        }
    }
    assert!(
        gathered
            .panel(1)
            .iter()
            .all(|row| row.0[1..] == [0.0; WIDTH - 1])
    );
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
            let rough = Inertia::new(&analysis, &permuted, shift, f64::INFINITY).unwrap();
            let counted = Inertia::new(&analysis, &permuted, shift, 0.0).unwrap();
            assert_eq!(counted.n_negative, factor.n_negative);
            assert_eq!(rough.n_negative, factor.n_negative);
            assert!(counted.perturbation <= rough.perturbation);
            let b = random_panel(n, &mut random);
            let mut x = b.clone();
            factor.solve(&mut x, false);
            let mut shared = b.clone();
            factor.solve(&mut shared, true);
            assert_eq!(shared, x);
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
                        r.abs() <= 10.0 * counted.perturbation * size + ROUNDING,
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
