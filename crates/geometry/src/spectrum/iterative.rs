//! Computes the smallest eigenpairs of one connected component by shifted block Lanczos; inertia
//! proves that none is missing.

use super::SpectrumError;
use super::component::Component;
use super::connected::{Gap, Pairs, Setting, dense, gap_after};
use super::polish::verify_and_polish;
use crate::linalg::basis::Basis;
use crate::linalg::block_lanczos::{BlockLanczos, Projection};
use crate::linalg::ldlt::{Factor, Inertia};
use crate::linalg::panel::{Row, WIDTH, zero_panel};

/// Rounds of search for eigenvalues that the count includes and the iteration missed.
const MAX_REPAIR: usize = 12;

/// A Krylov space with this many vectors for each wanted pair (and 1,600 more) will not converge:
/// the spectrum is one cluster.
const MOST_VECTORS: usize = 6;

/// Where the bound on rounding is too large for a gap, the search for a wider one includes this
/// many more pairs, plus a share.
const FURTHER_PAIRS: usize = 16;
const FURTHER_SHARE: usize = 8;

/// Where the Krylov space does not converge, components up to this size are solved densely.
const DENSE_AT_MOST: usize = 4_000;

/// Share of the wanted eigenvalues that may lie below the shift. Both ends of the wanted range then
/// converge at about the same time; at 0.4 or 0.7 the space has to be 10 % larger.
const FEWEST_BELOW: f64 = 0.5;
const MOST_BELOW: f64 = 0.65;

/// Number of vectors after which k pairs have usually converged to 1e-8, by experiment on surfaces.
/// A second test of a space that is too small costs more than a few vectors too many.
pub(super) fn first_dimension(k: usize) -> usize {
    (k * 31 / 20 + 96).next_multiple_of(WIDTH)
}

/// Number of blocks after which residuals that are `worst` times too large will suffice: each block
/// divides them by `10^(2.9 k^-0.22)`, by experiment, on any surface.
fn blocks_to_go(worst: f64, k: usize) -> usize {
    let per_block = 2.9 * (k as f64).powf(-0.22);
    (worst.max(1.0).log10() / per_block).ceil().min(1e3) as usize
}

/// A solve of one component.
pub(super) struct Lanczos<'a> {
    pub(super) component: &'a Component,
    pub(super) setting: &'a Setting<'a>,
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

    /// A shift with about 0.6 of the k wanted eigenvalues below it, by Weyl's law corrected by
    /// counts.
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
            if count >= FEWEST_BELOW * k && count <= (MOST_BELOW * k).max(1.0) {
                return Ok((factor, at));
            }
            if count > MOST_BELOW * k {
                high = at;
            } else {
                low = at;
            }
            // The count is roughly linear in the shift; bisection is the safeguard.
            let aimed = shift * (0.58 * k / count.max(0.5)).clamp(0.02, 50.0);
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

    /// At least `k` smallest pairs, all of them below the limit.
    pub(super) fn run(&self, k: usize) -> Result<Pairs, SpectrumError> {
        let n = self.component.n();
        let hook = &self.setting.hook;
        // At least three pairs are wanted, so that a shift fits between them.
        let (factor, shift) = self.interior_shift(k.max(3))?;
        let mut locked = Basis::new(n, 1, self.setting.parallel);
        if self.component.has_null_vector {
            locked.push(&zero_panel(n));
            self.component.set_null_vector(&mut locked);
        }
        let n_below = factor.n_negative.saturating_sub(self.n_null());
        let capacity = ((n - self.n_null()) / WIDTH - 2).min((MOST_VECTORS * k + 1_600) / WIDTH);
        let mut space = BlockLanczos::new(
            n,
            &locked,
            capacity.min(first_dimension(k) / WIDTH) + 1,
            self.setting.seed,
            self.setting.parallel,
        )?;
        let mut target = first_dimension(k).min(capacity * WIDTH);
        // The margin that a gap must have, after a bound turned out to be too large.
        let mut least = 0.0;
        let (ritz, projection, gap, counted) = loop {
            while space.dimension() < target {
                hook.at("iterate", space.dimension(), target)?;
                space.step(&|panel: &mut [Row]| factor.solve(panel, self.setting.parallel))?;
            }
            hook.enter("check")?;
            let projection = space.projection()?;
            let ritz = self.ritz(&projection, shift);
            let below = ritz.pairs.iter().filter(|p| p.0 < shift).count();
            let mut worst = self.worst(&ritz, k - self.n_null().min(k));
            let mut gap = self.gap(&ritz, k, least);
            if let Some(gap) = gap {
                worst = worst.max(self.worst(&ritz, gap.count - self.n_null()));
            }
            if let (true, true, Some(mut found)) = (worst <= 1.0, below >= n_below, gap) {
                hook.enter("certify")?;
                let counted = self.component.inertia(found.limit, found.margin)?;
                found.limit = counted.1;
                if counted.0.perturbation < found.margin {
                    break (ritz, projection, found, counted.0);
                }
                least = 2.0 * counted.0.perturbation;
                gap = self.gap(&ritz, k, least);
                let further = k + FURTHER_PAIRS + k / FURTHER_SHARE;
                match gap.filter(|g| g.count <= further && g.count > found.count) {
                    None => break (ritz, projection, found, counted.0),
                    Some(wider) => {
                        worst = self.worst(&ritz, wider.count - self.n_null());
                        if worst <= 1.0 {
                            continue;
                        }
                    }
                }
            }
            if space.dimension() + WIDTH > capacity * WIDTH {
                if n <= DENSE_AT_MOST {
                    return dense(self.component, k, self.setting);
                }
                if gap.is_none() {
                    let n_krylov = space.dimension();
                    return Err(SpectrumError::NoGap { k, n_krylov });
                }
                return Err(SpectrumError::NotConverged {
                    k,
                    n_krylov: space.dimension(),
                });
            }
            let more = (blocks_to_go(worst, k) * WIDTH).min(space.dimension() / 4);
            target = (space.dimension() + more.max(WIDTH)).min(capacity * WIDTH);
        };
        hook.enter("vectors")?;
        let n_krylov = space.dimension();
        let found = &ritz.pairs[..gap.count - self.n_null()];
        let null = self.component.has_null_vector;
        let chosen: Vec<Option<usize>> = null
            .then_some(None)
            .into_iter()
            .chain(found.iter().map(|p| Some(p.1)))
            .collect();
        let values = null.then_some(0.0).into_iter();
        let values = values.chain(found.iter().map(|p| p.0)).collect();
        let mut vectors = space.vectors(&projection, &chosen);
        if null {
            self.component.set_null_vector(&mut vectors);
        }
        let mut pairs = Pairs {
            values,
            residuals: Vec::new(),
            extremes: Vec::new(),
            vectors,
            limit: gap.limit,
            margin: gap.margin,
            perturbation: 0.0,
            growth: 1.0,
            n_krylov,
            n_polish: 0,
            n_repair: 0,
        };
        self.complete(&factor, shift, counted, &mut pairs)?;
        verify_and_polish(self.component, self.setting, Some(&factor), &mut pairs)?;
        Ok(pairs)
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

    /// Largest residual of the first `count` pairs, relative to the allowed one.
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

    fn gap(&self, ritz: &Ritz, k: usize, least: f64) -> Option<Gap> {
        let nulls = std::iter::repeat_n(0.0, self.n_null());
        let values: Vec<f64> = nulls.chain(ritz.pairs.iter().map(|p| p.0)).collect();
        if values.len() <= k {
            return None;
        }
        gap_after(&values, k, self.component.n(), least)
    }

    /// Compares the count of eigenvalues below the limit with the pairs found, and searches for
    /// missing ones in the orthogonal complement of those found.
    fn complete(
        &self,
        factor: &Factor,
        shift: f64,
        counted: Inertia,
        pairs: &mut Pairs,
    ) -> Result<(), SpectrumError> {
        let limit = pairs.limit;
        pairs.perturbation = counted.perturbation;
        pairs.growth = counted.growth;
        for round in 0..=MAX_REPAIR {
            let (expected, found) = (counted.n_negative, pairs.values.len());
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
            self.setting.hook.enter("repair")?;
            pairs.n_repair += 1;
            let locked = &pairs.vectors;
            let (values, vectors) =
                self.missing(factor, shift, locked, expected - found, limit, round)?;
            if !values.is_empty() {
                self.merge(pairs, &values, &vectors);
            }
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
    ) -> Result<(Vec<f64>, Basis), SpectrumError> {
        let n = self.component.n();
        let found = locked.n_panels() * WIDTH;
        let capacity = (n.saturating_sub(found) / WIDTH).saturating_sub(2);
        let seed = self.setting.seed.wrapping_add(1 + round as u64);
        let mut space =
            BlockLanczos::new(n, locked, capacity.min(32), seed, self.setting.parallel)?;
        let mut target = (4 * WIDTH + wanted * 3 / 2).next_multiple_of(WIDTH);
        loop {
            while space.dimension() < target.min(capacity * WIDTH) {
                self.setting.hook.at("repair", space.dimension(), target)?;
                space.step(&|panel: &mut [Row]| factor.solve(panel, self.setting.parallel))?;
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
                let chosen: Vec<_> = good.iter().map(|p| Some(p.1)).collect();
                return Ok((values, space.vectors(&projection, &chosen)));
            }
            target = space.dimension() + 2 * WIDTH;
        }
    }

    /// Adds further pairs, in ascending order.
    fn merge(&self, pairs: &mut Pairs, values: &[f64], vectors: &Basis) {
        let old = pairs.values.iter().enumerate().map(|(i, &v)| (v, 0, i));
        let new = values.iter().enumerate().map(|(i, &v)| (v, 1, i));
        let mut order: Vec<(f64, usize, usize)> = old.chain(new).collect();
        order.sort_by(|a, b| a.0.total_cmp(&b.0));
        let columns: Vec<_> = order.iter().map(|o| (o.1, o.2)).collect();
        let sources = [&pairs.vectors, vectors];
        let n = self.component.n();
        pairs.vectors = Basis::of_columns(n, self.setting.parallel, &sources, &columns);
        pairs.values = order.iter().map(|o| o.0).collect();
        let last = pairs.values[pairs.values.len() - 1];
        pairs.margin = pairs.margin.min(pairs.limit - last);
    }
}
