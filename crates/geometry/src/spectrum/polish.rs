//! Measures the residuals of eigenpairs, and reduces those that are too large.

// Small matrices and register tiles read best with their indices.
#![allow(clippy::needless_range_loop)]

use super::SpectrumError;
use super::component::{Component, Measured, Scratch};
use super::connected::{Pairs, Setting};
use crate::linalg::basis::Basis;
use crate::linalg::dense_eigen::symmetric_eigen;
use crate::linalg::ldlt::Factor;
use crate::linalg::panel::{Row, Tile, WIDTH, ZERO_TILE};
use rayon::prelude::{IntoParallelRefIterator, ParallelIterator};

/// Pairs whose residuals are at most this share of the allowed one stay unchanged.
const GOOD_ENOUGH: f64 = 0.7;

/// At most this many pairs, or this share of all, are corrected one panel after the other.
const FEW: usize = 16;
const FEW_OF: usize = 4;

/// Inner products above this have squares that count.
const SMALL_TURN: f64 = 1e-6;

/// Eigenvalues within this ratio count as a cluster when errors are attributed.
const CLUSTER: f64 = 1.5;

/// Rounds of inverse iteration with a definite factor before the solve fails for a residual.
const MAX_POLISH: usize = 4;

/// Measures the residuals. While one is too large, improves the worse ones: where they are few, by
/// a correction with the `factor` at the interior shift, if there is one; where they are many, or
/// if that is not enough, by inverse iteration with a definite factor (no growth, whatever the
/// mesh) and a Rayleigh–Ritz step.
pub(super) fn verify_and_polish(
    component: &Component,
    setting: &Setting,
    factor: Option<&Factor>,
    pairs: &mut Pairs,
) -> Result<(), SpectrumError> {
    let parallel = setting.parallel;
    let mut best = f64::INFINITY;
    let mut factor = factor;
    let mut n_definite = 0;
    let all = 0..pairs.vectors.n_panels();
    setting.hook.enter("verify")?;
    measure(component, parallel, pairs, all.clone());
    loop {
        let ratios = ratios(pairs, setting.tolerance);
        let index = worst(&ratios);
        let ratio = ratios[index];
        if ratio <= 1.0 {
            return Ok(());
        }
        let stuck = ratio.is_nan() || ratio > 0.5 * best;
        if ratio.is_nan() || n_definite == MAX_POLISH || (stuck && factor.is_none()) {
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
        let first = usize::from(component.has_null_vector);
        let poor = (first..ratios.len()).filter(|&i| ratios[i] > GOOD_ENOUGH);
        let poor: Vec<usize> = poor.collect();
        let few = poor.len() <= FEW.max(pairs.values.len() / FEW_OF);
        if stuck || !few {
            factor = None;
            best = f64::INFINITY;
        }
        match factor {
            Some(factor) => {
                correct(component, parallel, factor, pairs, &poor);
                setting.hook.enter("verify")?;
                let mut changed: Vec<usize> = poor.iter().map(|i| i / WIDTH).collect();
                changed.dedup();
                measure(component, parallel, pairs, changed);
            }
            None => {
                n_definite += 1;
                polish(component, parallel, pairs, &poor)?;
                setting.hook.enter("verify")?;
                measure(component, parallel, pairs, all.clone());
            }
        }
    }
}

/// Replaces the values by Rayleigh quotients and measures the residuals, in the listed panels, in
/// ascending order.
fn measure(
    component: &Component,
    parallel: bool,
    pairs: &mut Pairs,
    panels: impl IntoIterator<Item = usize>,
) {
    let of_panel = |scratch: &mut Scratch, p: usize| {
        let mut measured = component.rayleigh(&pairs.vectors, p, scratch);
        if component.has_null_vector && p == 0 {
            measured.quotients[0] = 0.0;
        }
        measured
    };
    let panels: Vec<usize> = panels.into_iter().collect();
    let measured: Vec<Measured> = if parallel {
        let panels = panels.par_iter();
        panels
            .map_init(Scratch::default, |scratch, &p| of_panel(scratch, p))
            .collect()
    } else {
        let mut scratch = Scratch::default();
        let panels = panels.iter();
        panels.map(|&p| of_panel(&mut scratch, p)).collect()
    };
    let k = pairs.values.len();
    pairs.residuals.resize(k, 0.0);
    pairs.extremes.resize(k, (0.0, 0.0));
    for (p, measured) in panels.into_iter().zip(measured) {
        for column in 0..WIDTH.min(k - p * WIDTH) {
            let pair = p * WIDTH + column;
            pairs.values[pair] = measured.quotients[column];
            pairs.residuals[pair] = measured.residuals[column];
            pairs.extremes[pair] = measured.extremes[column];
        }
    }
}

/// Corrects the pairs at `poor`, ascending. Solves for their residuals r, measured on W, and
/// subtracts the component of the solution outside the span of all pairs.
///
/// `x - (S - σ)⁻¹ r` equals a step of inverse iteration at σ from x, to first order in the error.
/// But the rounding of the factor, which limits the accuracy of x, now acts on a correction of the
/// size of r. Errors of x along eigenvectors far above σ, nearly all of them, vanish; those up to 2
/// σ may grow by half. Lengths and angles change by the square of the error.
fn correct(
    component: &Component,
    parallel: bool,
    factor: &Factor,
    pairs: &mut Pairs,
    poor: &[usize],
) {
    let mut scratch = Scratch::default();
    let n_rows: usize = pairs.vectors.rows_of(0).map(<[Row]>::len).sum();
    let solved = poor.chunks(WIDTH).map(|group| {
        scratch.x.clear();
        scratch.x.resize(n_rows, Row::ZERO);
        for (to, &pair) in group.iter().enumerate() {
            let from = pairs.vectors.rows_of(pair / WIDTH).flatten();
            for (x, row) in scratch.x.iter_mut().zip(from) {
                x.0[to] = row.0[pair % WIDTH];
            }
        }
        component.measure(&mut scratch);
        let mut panel = std::mem::take(&mut scratch.residuals);
        factor.solve(&mut panel, parallel);
        panel
    });
    let mut corrections: Vec<Vec<Row>> = solved.collect();
    let (two_by_two, last) = corrections.as_chunks_mut::<2>();
    for [a, b] in two_by_two {
        pairs.vectors.remove(0, [&mut a[..], &mut b[..]]);
    }
    for panel in last {
        pairs.vectors.remove(0, [&mut panel[..]]);
    }
    for (group, correction) in poor.chunks(WIDTH).zip(&corrections) {
        for (from, &pair) in group.iter().enumerate() {
            let to = pairs.vectors.rows_of_mut(pair / WIDTH).flatten();
            for (row, x) in to.zip(correction) {
                row.0[pair % WIDTH] -= x.0[from];
            }
        }
    }
}

/// The residuals relative to the allowed ones, `tolerance · max(λ, λ₊)`.
fn ratios(pairs: &Pairs, tolerance: f64) -> Vec<f64> {
    let largest = pairs.values.last().copied().unwrap_or(0.0);
    let positive = pairs.values.iter().copied().find(|&l| l > 1e-12 * largest);
    // If all values are zero, λ₊ is known to lie above the limit.
    let smallest = positive.unwrap_or(if pairs.limit.is_finite() {
        pairs.limit
    } else {
        1.0
    });
    let both = pairs.values.iter().zip(&pairs.residuals);
    both.map(|(&l, &r)| r / (tolerance * l.max(smallest)))
        .collect()
}

/// The index of the largest ratio; NaN counts as larger.
fn worst(ratios: &[f64]) -> usize {
    let key = |i: &usize| ratios[*i];
    (0..ratios.len())
        .max_by(|a, b| key(a).total_cmp(&key(b)))
        .unwrap_or(0)
}

/// Improves the pairs at `poor`, ascending, and preserves the orthonormality of all vectors.
fn polish(
    component: &Component,
    parallel: bool,
    pairs: &mut Pairs,
    poor: &[usize],
) -> Result<(), SpectrumError> {
    let (n, k) = (component.n(), poor.len());
    let largest = pairs.values[pairs.values.len() - 1];
    let (factor, shift) = component.factor(-0.02 * largest.abs().max(f64::MIN_POSITIVE))?;
    if factor.n_negative > 0 {
        return Err(SpectrumError::NotSemidefinite {
            count: factor.n_negative,
            below: shift,
        });
    }
    let columns: Vec<_> = poor.iter().map(|&i| (0, i)).collect();
    let x = Basis::of_columns(n, parallel, &[&pairs.vectors], &columns);
    let n_panels = k.div_ceil(WIDTH);
    let mut y = Basis::new(n, n_panels, parallel);
    let null = component.has_null_vector;
    let values = &pairs.values;
    // An inner product g of y ≈ φ_f and x ≈ φ_r, which should be 0, is an error of either. As (S -
    // σ) y is in the span of X_f, yᵀ (S - σ) x = 0 attributes it: y contains (λ_f - σ) / (λ_f -
    // λ_r) g of φ_r, and x contains the rest of φ_f. Within a cluster any basis will do; the null
    // vector is exact.
    let separate = |g: f64, f: usize, r: usize| {
        let (low, high) = (values[f].min(values[r]), values[f].max(values[r]));
        if high <= CLUSTER * low || (null && r == 0) {
            return (g, 0.0);
        }
        let of_y = (values[f] - shift) / (values[f] - values[r]) * g;
        (of_y, g - of_y)
    };
    let mut largest_turn = 0.0f64;
    let mut from_x = vec![vec![ZERO_TILE; pairs.vectors.n_panels()]; n_panels];
    // Scaled to about unit length, so that the Gram matrix below is well conditioned.
    let scales: Vec<f64> = poor.iter().map(|&i| pairs.values[i] - shift).collect();
    for (p, scales) in scales.chunks(WIDTH).enumerate() {
        let mut panel = x.panel(p);
        factor.solve(&mut panel, parallel);
        for row in &mut panel {
            for (x, s) in row.0.iter_mut().zip(scales) {
                *x *= s;
            }
        }
        let [along] = pairs.vectors.project(0, [&panel]);
        let mut from_y = vec![ZERO_TILE; along.len()];
        for (c, &f) in poor[p * WIDTH..].iter().take(WIDTH).enumerate() {
            for r in (0..pairs.values.len()).filter(|r| poor.binary_search(r).is_err()) {
                let (of_y, of_x) = separate(along[r / WIDTH][r % WIDTH].0[c], f, r);
                largest_turn = largest_turn.max(of_y.abs()).max(of_x.abs());
                from_y[r / WIDTH][r % WIDTH].0[c] = -of_y;
                from_x[p][r / WIDTH][c].0[r % WIDTH] = -of_x;
            }
        }
        pairs.vectors.add_combination(0, [&from_y], [&mut panel]);
        y.push(&panel);
    }
    // In the span of Y: (S - σ) Y = X D with D the scales, so YᵀSY - σ YᵀY = Yᵀ X D.
    let mut g = faer::Mat::<f64>::zeros(k, k);
    let mut h = faer::Mat::<f64>::zeros(k, k);
    for (p, scales) in scales.chunks(WIDTH).enumerate() {
        let [of_y, of_x] = y.project(p, [&y.panel(p), &x.panel(p)]);
        for (b, (ty, tx)) in of_y.iter().zip(&of_x).enumerate() {
            for i in 0..WIDTH.min(k - (p + b) * WIDTH) {
                for (j, scale) in scales.iter().enumerate() {
                    let (row, column) = ((p + b) * WIDTH + i, p * WIDTH + j);
                    g[(row, column)] = ty[i].0[j];
                    h[(row, column)] = tx[i].0[j] * scale;
                    g[(column, row)] = g[(row, column)];
                    h[(column, row)] = h[(row, column)];
                }
            }
        }
    }
    drop(x);
    for r in 0..pairs.vectors.n_panels() {
        let tiles: Vec<Tile> = from_x.iter().map(|tiles| tiles[r]).collect();
        let mut panel = pairs.vectors.panel(r);
        y.add_combination(0, [&tiles], [&mut panel]);
        let rows = pairs.vectors.rows_of_mut(r).flatten();
        rows.zip(panel).for_each(|(row, new)| *row = new);
    }
    let (values, z) = generalised_eigen(&h, &g)?;
    let tile = |p: usize, b: usize| -> Tile {
        let entry = |i: usize, j: usize| match (b * WIDTH + i, p * WIDTH + j) {
            (row, column) if row < k && column < k => z[(row, column)],
            _ => 0.0,
        };
        std::array::from_fn(|i| Row(std::array::from_fn(|j| entry(i, j))))
    };
    let coefficients: Vec<Vec<Tile>> = (0..n_panels)
        .map(|p| (0..n_panels).map(|b| tile(p, b)).collect())
        .collect();
    y.transform(&coefficients);
    for (from, &to) in poor.iter().enumerate() {
        pairs.values[to] = values[from] + shift;
        let rows = pairs.vectors.rows_of_mut(to / WIDTH).flatten();
        for (row, x) in rows.zip(y.rows_of(from / WIDTH).flatten()) {
            row.0[to % WIDTH] = x.0[from % WIDTH];
        }
    }
    // The removed components were right to first order.
    if largest_turn > SMALL_TURN {
        orthonormalise(&mut pairs.vectors, pairs.values.len());
    }
    Ok(())
}

/// `X ← X (3 I - XᵀX) / 2` for the first `k` columns: a Newton step to the nearest orthonormal
/// columns.
fn orthonormalise(vectors: &mut Basis, k: usize) {
    let n_panels = vectors.n_panels();
    let mut coefficients = vec![vec![ZERO_TILE; n_panels]; n_panels];
    for p in 0..n_panels {
        let [gram] = vectors.project(p, [&vectors.panel(p)]);
        for (b, tile) in (p..n_panels).zip(gram) {
            for i in 0..WIDTH.min(k - b * WIDTH) {
                for j in 0..WIDTH.min(k - p * WIDTH) {
                    let unit = if b == p && i == j { 1.5 } else { 0.0 };
                    let entry = unit - 0.5 * tile[i].0[j];
                    coefficients[p][b][i].0[j] = entry;
                    coefficients[b][p][j].0[i] = entry;
                }
            }
        }
    }
    vectors.transform(&coefficients);
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
