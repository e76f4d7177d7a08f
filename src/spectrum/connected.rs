//! One connected component becomes its smallest eigenpairs, proved complete.

use super::component::Component;
use super::{Hook, SpectrumError};
use crate::linalg::block_lanczos::{BlockLanczos, Projection};
use crate::linalg::dense_eigen::symmetric_eigen;
use crate::linalg::ldlt::Factor;
use crate::linalg::panel::{Basis, Row, Tile, WIDTH, ZERO_TILE, zero_panel};

/// Components up to this size are solved densely.
const DENSE_ALWAYS: usize = 160;

/// Dense eigenvalues below minus this share of the largest are not rounding.
const NEGATIVE: f64 = 1e-10;

/// Rounds of inverse iteration with a definite factor before a residual is given up.
const MAX_POLISH: usize = 4;

/// Rounds in which eigenvalues that the count says are missing are looked for.
const MAX_REPAIR: usize = 12;

/// Eigenpairs of a component: all that lie below `limit`.
pub(super) struct Pairs {
    /// Ascending.
    pub(super) values: Vec<f64>,
    /// `‖S x - λ x‖` of each.
    pub(super) residuals: Vec<f64>,
    /// Orthonormal eigenvectors of S, 16 a panel, rows in elimination order.
    pub(super) panels: Vec<Vec<Row>>,
    /// Every eigenvalue below this is among `values`.
    pub(super) limit: f64,
    /// Distance from `limit` to the nearest eigenvalue found.
    pub(super) margin: f64,
    /// Bound on the perturbation of S under which the count at `limit` is exact.
    pub(super) perturbation: f64,
    /// Dimension of the Krylov space; 0 for a dense solve.
    pub(super) n_krylov: usize,
    /// Rounds of inverse iteration and of looking for missing pairs.
    pub(super) n_polish: usize,
    pub(super) n_repair: usize,
}

/// What a solve needs besides the matrix.
pub(super) struct Setting<'a> {
    pub(super) tolerance: f64,
    pub(super) seed: u64,
    pub(super) parallel: bool,
    pub(super) hook: Hook<'a>,
}

/// At least `k` smallest eigenpairs (1 ≤ k ≤ n), all of them below `limit`.
pub(super) fn smallest(
    component: &Component,
    k: usize,
    setting: &Setting,
) -> Result<Pairs, SpectrumError> {
    let n = component.n();
    let krylov = first_dimension(k);
    if n <= DENSE_ALWAYS || krylov + 4 * WIDTH > n * 3 / 4 {
        return dense(component, k, setting);
    }
    Lanczos { component, setting }.run(k)
}

/// Vectors after which k pairs have usually converged to 1e-8, by experiment on surfaces.
fn first_dimension(k: usize) -> usize {
    (k * 31 / 20 + 144).next_multiple_of(WIDTH)
}

/// Where to put the limit above pair `j` when `values` are ascending: the first gap at or after k
/// that is not the inside of a cluster. Returns (number of pairs below, limit, margin).
fn gap_after(values: &[f64], k: usize, n: usize) -> Option<(usize, f64, f64)> {
    for j in k..=values.len() {
        if j == n {
            return Some((n, f64::INFINITY, f64::INFINITY));
        }
        if j < values.len() {
            let gap = values[j] - values[j - 1];
            let mean_spacing = values[j] / (j + 1) as f64;
            if gap > 0.02 * mean_spacing {
                let margin = 0.3 * gap.min(mean_spacing);
                return Some((j, values[j - 1] + margin, margin));
            }
        }
    }
    None
}

fn dense(component: &Component, k: usize, setting: &Setting) -> Result<Pairs, SpectrumError> {
    setting.hook.enter("dense")?;
    let n = component.n();
    let mut a = vec![0.0; n * n];
    for i in 0..n {
        let (columns, values) = component.standard.row(i);
        for (&c, &x) in columns.iter().zip(values) {
            a[i * n + c as usize] = x;
        }
    }
    let (mut values, vectors) = symmetric_eigen(&a, n)?;
    let largest = values[n - 1].abs().max(values[0].abs());
    let count = values.iter().filter(|l| **l < -NEGATIVE * largest).count();
    if count > 0 {
        return Err(SpectrumError::NotSemidefinite {
            count,
            below: -NEGATIVE * largest,
        });
    }
    if component.has_null_vector {
        values[0] = 0.0;
    }
    let (j, limit, margin) = gap_after(&values, k, n).unwrap_or((n, f64::INFINITY, f64::INFINITY));
    let mut panels = Vec::with_capacity(j.div_ceil(WIDTH));
    for first in (0..j).step_by(WIDTH) {
        let mut panel = zero_panel(n);
        for column in first..(first + WIDTH).min(j) {
            for (i, row) in panel[..n].iter_mut().enumerate() {
                row.0[column - first] = vectors[(i, column)];
            }
        }
        panels.push(panel);
    }
    if component.has_null_vector {
        for (row, x) in panels[0].iter_mut().zip(component.null_vector()) {
            row.0[0] = x;
        }
    }
    values.truncate(j);
    let mut pairs = Pairs {
        values,
        residuals: Vec::new(),
        panels,
        limit,
        margin,
        perturbation: n as f64 * f64::EPSILON * largest,
        n_krylov: 0,
        n_polish: 0,
        n_repair: 0,
    };
    verify_and_polish(component, setting, &mut pairs)?;
    Ok(pairs)
}

struct Lanczos<'a> {
    component: &'a Component,
    setting: &'a Setting<'a>,
}

/// Ritz pairs in ascending order of eigenvalue.
struct Ritz {
    /// (eigenvalue, its index in the projection, estimate of the residual of the final vector)
    pairs: Vec<(f64, usize, f64)>,
}

impl Lanczos<'_> {
    fn n_null(&self) -> usize {
        usize::from(self.component.has_null_vector)
    }

    /// A shift with 0.35–0.8 of the k wanted eigenvalues below it: Weyl's law, corrected by counts.
    fn interior_shift(&self, k: usize) -> Result<(Factor, f64), SpectrumError> {
        let k = k as f64;
        let weyl = 4.0 * std::f64::consts::PI * k / self.component.area;
        let (mut low, mut high) = (0.0f64, f64::INFINITY);
        let mut best: Option<(Factor, f64)> = None;
        let mut shift = 0.6 * weyl;
        for _ in 0..60 {
            self.setting.hook.enter("factor")?;
            let (factor, at) = self.component.factor(shift)?;
            let count = factor.n_negative as f64;
            if count >= 0.35 * k && count <= (0.8 * k).max(1.0) {
                return Ok((factor, at));
            }
            if count > 0.8 * k {
                high = at;
            } else {
                low = at;
            }
            // The count is about linear in the shift; safeguarded by bisection.
            let aimed = shift * (0.6 * k / count.max(0.5)).clamp(0.02, 50.0);
            let bounded = high.is_finite() && low > 0.0;
            shift = match bounded {
                true if aimed > low && aimed < high && high > 4.0 * low => aimed,
                true => (low * high).sqrt(),
                false => aimed,
            };
            let usable = factor.n_negative < k as usize;
            if usable {
                best = Some((factor, at));
            }
            if bounded && high < 1.02 * low {
                break;
            }
        }
        match best {
            Some(found) => Ok(found),
            None => Ok(self.component.factor(shift)?),
        }
    }

    fn run(&self, k: usize) -> Result<Pairs, SpectrumError> {
        let n = self.component.n();
        let hook = &self.setting.hook;
        // At least three pairs, so that a shift fits between them.
        let (factor, shift) = self.interior_shift(k.max(3))?;
        let mut locked = Basis::new(n, 1, self.setting.parallel);
        let null = self.null_panel();
        if let Some(panel) = &null {
            locked.push(panel);
        }
        let n_below = factor.n_negative.saturating_sub(self.n_null());
        let capacity = (n - self.n_null()) / WIDTH - 2;
        let mut space = BlockLanczos::new(
            n,
            &locked,
            capacity.min((2 * k + 400) / WIDTH) + 1,
            self.setting.seed,
            self.setting.parallel,
        )?;
        let mut target = first_dimension(k).min(capacity * WIDTH);
        let (ritz, projection, below) = loop {
            hook.enter("iterate")?;
            while space.dimension() < target {
                space.step(&|panel: &mut [Row]| factor.solve(panel))?;
                hook.enter("iterate")?;
            }
            hook.enter("check")?;
            let projection = space.projection()?;
            let ritz = self.ritz(&projection, shift);
            let worst = self.worst(&ritz, k - self.n_null().min(k));
            let below = ritz.pairs.iter().filter(|p| p.0 < shift).count();
            let gap = self.gap(&ritz, k);
            if worst <= 1.0
                && below >= n_below
                && let Some((j, _, _)) = gap
                && self.worst(&ritz, j - self.n_null()) <= 1.0
            {
                break (ritz, projection, j);
            }
            if space.dimension() + WIDTH > capacity * WIDTH {
                return dense(self.component, k, self.setting);
            }
            let blocks = if worst > 1e6 {
                4
            } else if worst > 1e3 {
                2
            } else {
                1
            };
            target = (space.dimension() + blocks * WIDTH).min(capacity * WIDTH);
        };
        hook.enter("vectors")?;
        let n_krylov = space.dimension();
        let count = below - self.n_null();
        let chosen: Vec<usize> = ritz.pairs[..count].iter().map(|p| p.1).collect();
        let panels = space.vectors(&projection, &chosen);
        let mut values: Vec<f64> = ritz.pairs[..count].iter().map(|p| p.0).collect();
        let panels = match null {
            None => panels,
            Some(null) => {
                values.insert(0, 0.0);
                with_first_column(&null, &panels, values.len())
            }
        };
        let (_, limit, margin) = self
            .gap(&ritz, k)
            .ok_or(SpectrumError::NoGap { k, n_krylov })?;
        let mut pairs = Pairs {
            values,
            residuals: Vec::new(),
            panels,
            limit,
            margin,
            perturbation: 0.0,
            n_krylov,
            n_polish: 0,
            n_repair: 0,
        };
        self.complete(&factor, shift, &mut pairs)?;
        verify_and_polish(self.component, self.setting, &mut pairs)?;
        Ok(pairs)
    }

    fn null_panel(&self) -> Option<Vec<Row>> {
        self.component.has_null_vector.then(|| {
            let mut panel = zero_panel(self.component.n());
            for (row, x) in panel.iter_mut().zip(self.component.null_vector()) {
                row.0[0] = x;
            }
            panel
        })
    }

    fn ritz(&self, projection: &Projection, shift: f64) -> Ritz {
        // Ritz values that map below zero are the unconverged middle of the inverted spectrum.
        let floor = -1e-6 * shift.abs();
        let mut pairs: Vec<(f64, usize, f64)> = projection
            .values
            .iter()
            .zip(&projection.residuals)
            .enumerate()
            .filter(|(_, (theta, _))| **theta != 0.0)
            .map(|(e, (theta, r))| (shift + 1.0 / theta, e, r / (theta * theta)))
            .filter(|p| p.0 > floor)
            .collect();
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
        Ritz { pairs }
    }

    /// Largest residual of the first `count` pairs, in units of what is allowed.
    fn worst(&self, ritz: &Ritz, count: usize) -> f64 {
        if ritz.pairs.len() < count {
            return f64::INFINITY;
        }
        let smallest = ritz.pairs.first().map_or(0.0, |p| p.0);
        let allowed = |value: f64| 0.5 * self.setting.tolerance * value.max(smallest).abs();
        ritz.pairs[..count]
            .iter()
            .map(|p| p.2 / allowed(p.0))
            .fold(0.0, f64::max)
    }

    fn gap(&self, ritz: &Ritz, k: usize) -> Option<(usize, f64, f64)> {
        let nulls = std::iter::repeat_n(0.0, self.n_null());
        let values: Vec<f64> = nulls.chain(ritz.pairs.iter().map(|p| p.0)).collect();
        if values.len() <= k {
            return None;
        }
        gap_after(&values, k, self.component.n())
    }

    /// Compares the count of eigenvalues below the limit with the pairs found, and looks for
    /// missing ones in the orthogonal complement of those found.
    fn complete(
        &self,
        factor: &Factor,
        shift: f64,
        pairs: &mut Pairs,
    ) -> Result<(), SpectrumError> {
        let n = self.component.n();
        for round in 0..=MAX_REPAIR {
            self.setting.hook.enter("certify")?;
            let (at_limit, limit) = self.component.factor(pairs.limit)?;
            pairs.limit = limit;
            pairs.perturbation = at_limit.perturbation;
            let (expected, found) = (at_limit.n_negative, pairs.values.len());
            if expected == found {
                return Ok(());
            }
            if expected < found || round == MAX_REPAIR {
                return Err(SpectrumError::Incomplete {
                    tau: limit,
                    expected,
                    found,
                });
            }
            drop(at_limit);
            self.setting.hook.enter("repair")?;
            pairs.n_repair += 1;
            let mut locked = Basis::new(n, pairs.panels.len(), self.setting.parallel);
            for panel in &pairs.panels {
                locked.push(panel);
            }
            let (values, panels) =
                self.missing(factor, shift, &locked, expected - found, limit, round)?;
            if values.is_empty() {
                continue;
            }
            merge(pairs, &values, &panels);
        }
        Ok(())
    }

    /// Up to `wanted` eigenpairs below `limit` orthogonal to `locked`.
    fn missing(
        &self,
        factor: &Factor,
        shift: f64,
        locked: &Basis,
        wanted: usize,
        limit: f64,
        round: usize,
    ) -> Result<(Vec<f64>, Vec<Vec<Row>>), SpectrumError> {
        let n = self.component.n();
        let found = locked.n_panels() * WIDTH;
        let capacity = (n.saturating_sub(found) / WIDTH).saturating_sub(2);
        let seed = self.setting.seed.wrapping_add(1 + round as u64);
        let mut space =
            BlockLanczos::new(n, locked, capacity.min(32), seed, self.setting.parallel)?;
        let mut target = (4 * WIDTH + wanted * 3 / 2).next_multiple_of(WIDTH);
        loop {
            while space.dimension() < target.min(capacity * WIDTH) {
                self.setting.hook.enter("repair")?;
                space.step(&|panel: &mut [Row]| factor.solve(panel))?;
            }
            let projection = space.projection()?;
            let ritz = self.ritz(&projection, shift);
            let count = ritz.pairs.iter().take_while(|p| p.0 < limit).count();
            let full = space.dimension() + WIDTH > capacity * WIDTH;
            let scale = self.setting.tolerance * limit.abs();
            let worst = ritz.pairs[..count]
                .iter()
                .map(|p| p.2 / scale)
                .fold(0.0, f64::max);
            if (worst <= 1.0 && count >= wanted.min(WIDTH)) || full || space.dimension() > 1_600 {
                let good: Vec<_> = ritz.pairs[..count]
                    .iter()
                    .filter(|p| p.2 <= scale)
                    .collect();
                let values = good.iter().map(|p| p.0).collect();
                let chosen: Vec<usize> = good.iter().map(|p| p.1).collect();
                return Ok((values, space.vectors(&projection, &chosen)));
            }
            target = space.dimension() + 2 * WIDTH;
        }
    }
}

/// Moves all columns of `panels` one to the right and puts column 0 of `first` before them.
fn with_first_column(first: &[Row], panels: &[Vec<Row>], count: usize) -> Vec<Vec<Row>> {
    let rows = first.len();
    let mut out = vec![vec![Row::ZERO; rows]; count.div_ceil(WIDTH)];
    for i in 0..rows {
        let mut carried = first[i].0[0];
        for (p, panel) in out.iter_mut().enumerate() {
            let source = panels.get(p).map_or([0.0; WIDTH], |s| s[i].0);
            panel[i].0[0] = carried;
            panel[i].0[1..].copy_from_slice(&source[..WIDTH - 1]);
            carried = source[WIDTH - 1];
        }
    }
    out
}

/// Adds further pairs, in ascending order.
fn merge(pairs: &mut Pairs, values: &[f64], panels: &[Vec<Row>]) {
    let old = pairs.values.len();
    let mut order: Vec<(f64, usize)> = pairs
        .values
        .iter()
        .chain(values)
        .copied()
        .enumerate()
        .map(|(i, v)| (v, i))
        .collect();
    order.sort_by(|a, b| a.0.total_cmp(&b.0));
    let rows = pairs.panels[0].len();
    let mut out = vec![vec![Row::ZERO; rows]; order.len().div_ceil(WIDTH)];
    for (new, &(_, from)) in order.iter().enumerate() {
        let (source, from) = if from < old {
            (&pairs.panels, from)
        } else {
            (&panels.to_vec(), from - old)
        };
        for (row, s) in out[new / WIDTH].iter_mut().zip(&source[from / WIDTH]) {
            row.0[new % WIDTH] = s.0[from % WIDTH];
        }
    }
    pairs.values = order.iter().map(|o| o.0).collect();
    pairs.panels = out;
}

/// Measures the residuals; while one is too large, improves all vectors by inverse iteration with a
/// definite factor (no growth, whatever the mesh) and a Rayleigh–Ritz step.
fn verify_and_polish(
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
        if !(ratio <= worst.1) {
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
