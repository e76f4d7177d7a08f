//! Eigenpairs become eigenpairs with measured, small residuals.

// Small matrices and register tiles read best with their indices.
#![allow(clippy::needless_range_loop)]

use super::SpectrumError;
use super::component::Component;
use super::connected::{Pairs, Setting};
use crate::linalg::dense_eigen::symmetric_eigen;
use crate::linalg::panel::{Basis, Tile, WIDTH, ZERO_TILE};

/// Rounds of inverse iteration with a definite factor before a residual is given up.
const MAX_POLISH: usize = 4;

/// Measures the residuals; while one is too large, improves all vectors by inverse iteration with a
/// definite factor (no growth, whatever the mesh) and a Rayleigh–Ritz step.
pub(super) fn verify_and_polish(
    component: &Component,
    setting: &Setting,
    pairs: &mut Pairs,
) -> Result<(), SpectrumError> {
    let mut best = f64::INFINITY;
    for round in 0..=MAX_POLISH {
        setting.hook.enter("verify")?;
        measure(component, pairs);
        let (index, ratio) = worst_ratio(pairs, setting.tolerance);
        if ratio <= 1.0 {
            return Ok(());
        }
        if round == MAX_POLISH || ratio > 0.5 * best {
            return Err(SpectrumError::Residual {
                index,
                eigenvalue: pairs.values[index],
                residual: pairs.residuals[index],
                limit: pairs.residuals[index] / ratio,
            });
        }
        best = best.min(ratio);
        setting.hook.enter("polish")?;
        pairs.n_polish += 1;
        polish(component, setting.parallel, pairs)?;
    }
    Ok(())
}

/// Replaces the values by Rayleigh quotients, and measures the residuals.
fn measure(component: &Component, pairs: &mut Pairs) {
    pairs.residuals.clear();
    for (panel, values) in pairs.panels.iter().zip(pairs.values.chunks_mut(WIDTH)) {
        let (mut quotients, residuals) = component.rayleigh(panel);
        if component.has_null_vector && pairs.residuals.is_empty() {
            quotients[0] = 0.0;
        }
        values.copy_from_slice(&quotients[..values.len()]);
        pairs
            .residuals
            .extend_from_slice(&residuals[..values.len()]);
    }
}

/// The pair whose residual is worst against `tolerance · max(λ, λ₊)`.
fn worst_ratio(pairs: &Pairs, tolerance: f64) -> (usize, f64) {
    let largest = pairs.values.last().copied().unwrap_or(0.0);
    let positive = pairs.values.iter().copied().find(|&l| l > 1e-12 * largest);
    // With zeros only, λ₊ is known to lie above the limit.
    let smallest = positive.unwrap_or(if pairs.limit.is_finite() {
        pairs.limit
    } else {
        1.0
    });
    let mut worst = (0, 0.0);
    for (i, (&l, &r)) in pairs.values.iter().zip(&pairs.residuals).enumerate() {
        let ratio = r / (tolerance * l.max(smallest));
        // Not a number counts as worst.
        if ratio.is_nan() || ratio > worst.1 {
            worst = (i, ratio);
        }
    }
    worst
}

fn polish(component: &Component, parallel: bool, pairs: &mut Pairs) -> Result<(), SpectrumError> {
    let (n, k) = (component.n(), pairs.values.len());
    let largest = pairs.values[k - 1].abs().max(f64::MIN_POSITIVE);
    let (factor, shift) = component.factor(-0.02 * largest)?;
    if factor.n_negative > 0 {
        return Err(SpectrumError::NotSemidefinite {
            count: factor.n_negative,
            below: shift,
        });
    }
    let mut basis = Basis::new(n, pairs.panels.len(), parallel);
    let mut images = Vec::with_capacity(pairs.panels.len());
    for (p, panel) in pairs.panels.iter().enumerate() {
        let mut y = panel.clone();
        factor.solve(&mut y);
        // Scaled to about unit length, so that the Gram matrix below is well conditioned.
        let scale: [f64; WIDTH] =
            std::array::from_fn(|c| pairs.values.get(p * WIDTH + c).map_or(0.0, |l| l - shift));
        for row in &mut y {
            for (x, s) in row.0.iter_mut().zip(&scale) {
                *x *= s;
            }
        }
        images.push((y, scale));
    }
    for (y, _) in &images {
        basis.push(y);
    }
    // In the span of Y: (S - σ) Y = X D with D the scales, so YᵀSY - σ YᵀY = Yᵀ X D.
    let mut g = faer::Mat::<f64>::zeros(k, k);
    let mut h = faer::Mat::<f64>::zeros(k, k);
    for (p, (y, scale)) in images.iter().enumerate() {
        let of_y = basis.project(0, y);
        let of_x = basis.project(0, &pairs.panels[p]);
        for (b, (ty, tx)) in of_y.iter().zip(&of_x).enumerate() {
            for i in 0..WIDTH {
                for j in 0..WIDTH {
                    let (row, column) = (b * WIDTH + i, p * WIDTH + j);
                    if row < k && column < k {
                        g[(row, column)] = ty[i].0[j];
                        h[(row, column)] = tx[i].0[j] * scale[j];
                    }
                }
            }
        }
    }
    drop(images);
    let (values, z) = generalised_eigen(&h, &g)?;
    let coefficients: Vec<Vec<Tile>> = (0..k.div_ceil(WIDTH))
        .map(|p| {
            (0..k.div_ceil(WIDTH))
                .map(|b| {
                    let mut tile = ZERO_TILE;
                    for i in 0..WIDTH.min(k - b * WIDTH) {
                        for j in 0..WIDTH.min(k - p * WIDTH) {
                            tile[i].0[j] = z[(b * WIDTH + i, p * WIDTH + j)];
                        }
                    }
                    tile
                })
                .collect()
        })
        .collect();
    pairs.panels = basis.combinations(&coefficients);
    pairs.values = values.iter().map(|mu| mu + shift).collect();
    if component.has_null_vector {
        pairs.values[0] = 0.0;
        for (row, x) in pairs.panels[0].iter_mut().zip(component.null_vector()) {
            row.0[0] = x;
        }
    }
    Ok(())
}

/// `H z = μ G z` for symmetric H and definite G: values ascending, `zᵀ G z = I`.
fn generalised_eigen(
    h: &faer::Mat<f64>,
    g: &faer::Mat<f64>,
) -> Result<(Vec<f64>, faer::Mat<f64>), SpectrumError> {
    use faer::linalg::triangular_solve::{
        solve_lower_triangular_in_place, solve_upper_triangular_in_place,
    };
    let k = h.nrows();
    let llt = g
        .llt(faer::Side::Lower)
        .map_err(|_| SpectrumError::Dependent { k })?;
    let l = llt.L();
    let mut c = faer::Mat::from_fn(k, k, |i, j| 0.5 * (h[(i, j)] + h[(j, i)]));
    solve_lower_triangular_in_place(l, c.as_mut(), faer::Par::Seq);
    let mut c = c.transpose().to_owned();
    solve_lower_triangular_in_place(l, c.as_mut(), faer::Par::Seq);
    let mut flat = Vec::with_capacity(k * k);
    for j in 0..k {
        flat.extend((0..k).map(|i| 0.5 * (c[(i, j)] + c[(j, i)])));
    }
    let (values, mut z) = symmetric_eigen(&flat, k)?;
    solve_upper_triangular_in_place(l.transpose(), z.as_mut(), faer::Par::Seq);
    Ok((values, z))
}
