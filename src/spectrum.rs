//! Stiffness W and lumped mass A become the smallest eigenpairs of `W φ = λ A φ`, proved complete.
//!
//! W is split into connected components and standardised, `S = A^{-1/2} W A^{-1/2}`. On each, block
//! Lanczos runs on `(S - σI)⁻¹` with σ inside the wanted part of the spectrum, where the sparse
//! L D Lᵀ factor of `S - σI` also counts the eigenvalues below σ. A second factorisation at τ, in
//! the gap above the last wanted eigenvalue, must have exactly as many negative pivots as pairs were
//! found below τ (Sylvester's law of inertia; Grimes, Lewis and Simon 1994): nothing is missing.
//! Small components, or most of a spectrum, are solved densely. Residuals are measured on W itself;
//! where an unpivoted indefinite factor was not accurate enough, inverse iteration with a definite
//! one and a Rayleigh–Ritz step follow.

mod component;
mod connected;
mod iterative;
mod polish;

use crate::linalg::block_lanczos::Exhausted;
use crate::linalg::dense_eigen::DenseEigenError;
use crate::linalg::ldlt::LdltError;
use crate::linalg::panel::{Row, WIDTH};
use component::{Component, components, validate};
use connected::{Pairs, Setting, smallest};
use nalgebra::DMatrix;
use rayon::prelude::{IntoParallelIterator, ParallelIterator};
use std::collections::HashMap;

/// Called on entering each stage and at each iteration with the name of the stage; `false` cancels.
pub type StageHook<'a> = &'a dyn Fn(&str) -> bool;

/// How to compute a spectrum.
#[derive(Clone, Copy)]
pub struct Options<'a> {
    /// Seed of the random start. Results are accurate and complete for any.
    pub seed: u64,
    /// Residuals are at most this times `max(λ, λ₊)`, λ₊ the smallest eigenvalue above zero.
    pub tolerance: f64,
    /// 1: the calling thread alone. More: the rayon pool of the caller. Same bits either way.
    pub threads: usize,
    /// Told of each stage: `components`, `factor`, `iterate`, `check`, `vectors`, `certify`,
    /// `repair`, `verify`, `polish`, `dense`, `assemble`.
    pub stage: Option<StageHook<'a>>,
}

impl Default for Options<'_> {
    fn default() -> Self {
        Self {
            seed: 0x5eed,
            tolerance: 1e-8,
            threads: 1,
            stage: None,
        }
    }
}

impl std::fmt::Debug for Options<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Options")
            .field("seed", &self.seed)
            .field("tolerance", &self.tolerance)
            .field("threads", &self.threads)
            .field("stage", &self.stage.is_some())
            .finish()
    }
}

/// What proves that no eigenvalue is missing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Certificate {
    /// Every eigenvalue below this was found; at least the k-th lies below. Infinite if all n are.
    pub tau: f64,
    /// Eigenvalues below `tau`, counted by inertia (or by a dense solver that finds all n).
    pub count: usize,
    /// Distance from `tau` to the nearest eigenvalue found.
    pub margin: f64,
    /// The count is that of a matrix within this distance (2-norm) of `A^{-1/2} W A^{-1/2}`: below
    /// `margin`, the proof holds for the matrix as given.
    pub perturbation: f64,
    /// Connected components of W.
    pub n_components: usize,
    /// Largest Krylov space that was used; 0 when all components were solved densely.
    pub n_krylov: usize,
    /// Rounds of inverse iteration that residuals needed.
    pub n_polish: usize,
    /// Rounds in which pairs missed at first were looked for.
    pub n_repair: usize,
}

/// The smallest eigenpairs of `W φ = λ A φ`.
#[derive(Debug, Clone, PartialEq)]
pub struct Spectrum {
    /// `(k,)`, ascending, not negative.
    pub eigenvalues: Vec<f64>,
    /// `(n, k)`, `ΦᵀAΦ = I`; in each column the entry of largest magnitude (the first such) is
    /// positive.
    pub eigenvectors: DMatrix<f64>,
    /// `‖W φ - λ A φ‖` in the norm of `A⁻¹`, `(k,)`.
    pub residuals: Vec<f64>,
    /// Why none is missing.
    pub certificate: Certificate,
}

/// Why there is no spectrum.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SpectrumError {
    /// W is not square.
    #[error("stiffness has {rows} rows but {columns} columns")]
    NotSquare {
        /// Rows of W.
        rows: usize,
        /// Columns of W.
        columns: usize,
    },
    /// The mass does not belong to W.
    #[error("mass has {n_mass} entries, but the stiffness has {n} rows")]
    MassLength {
        /// Entries of the mass.
        n_mass: usize,
        /// Rows of W.
        n: usize,
    },
    /// A mass is not a positive finite number.
    #[error(
        "the mass of vertex {vertex} is {value}, but must be positive, finite and not denormal"
    )]
    Mass {
        /// Which vertex.
        vertex: usize,
        /// Its mass.
        value: f64,
    },
    /// An entry of W is not finite.
    #[error("stiffness ({row}, {column}) is {value}, but must be finite")]
    Stiffness {
        /// Row.
        row: usize,
        /// Column.
        column: usize,
        /// The entry.
        value: f64,
    },
    /// W is not symmetric.
    #[error("stiffness ({row}, {column}) is {value}, but ({column}, {row}) is {mirror}")]
    NotSymmetric {
        /// Row.
        row: usize,
        /// Column.
        column: usize,
        /// The entry.
        value: f64,
        /// Its mirror image.
        mirror: f64,
    },
    /// W has negative eigenvalues.
    #[error("{count} eigenvalues lie below {below}, but the stiffness must be semidefinite")]
    NotSemidefinite {
        /// How many.
        count: usize,
        /// A negative number.
        below: f64,
    },
    /// More pairs were asked for than exist, or none.
    #[error("{k} eigenpairs asked for, but the limits are 1 and {n}")]
    Count {
        /// Asked for.
        k: usize,
        /// Rows of W.
        n: usize,
    },
    /// The tolerance is not usable.
    #[error("the tolerance is {tolerance}, but the limits are 1e-13 and 1e-2")]
    Tolerance {
        /// As given.
        tolerance: f64,
    },
    /// The count of eigenvalues disagrees with the pairs found.
    #[error("{expected} eigenvalues lie below {tau}, but {found} were found")]
    Incomplete {
        /// Where it was counted.
        tau: f64,
        /// By inertia.
        expected: usize,
        /// Pairs found.
        found: usize,
    },
    /// The Krylov space grew to its limit.
    #[error("{k} pairs have not converged in a Krylov space of {n_krylov} vectors, the limit")]
    NotConverged {
        /// Wanted.
        k: usize,
        /// Dimension of the Krylov space.
        n_krylov: usize,
    },
    /// Everything above the k-th eigenvalue is one cluster, as far as was computed.
    #[error("no gap was found above eigenvalue {k} among {n_krylov} approximations")]
    NoGap {
        /// Asked for.
        k: usize,
        /// Dimension of the Krylov space.
        n_krylov: usize,
    },
    /// A residual stayed above the tolerance.
    #[error("eigenvalue {index} ({eigenvalue}) has residual {residual}, but the limit is {limit}")]
    Residual {
        /// Which pair, from 0.
        index: usize,
        /// Its value.
        eigenvalue: f64,
        /// Its residual.
        residual: f64,
        /// What was allowed.
        limit: f64,
    },
    /// Approximate eigenvectors became linearly dependent.
    #[error("{k} approximate eigenvectors are linearly dependent")]
    Dependent {
        /// How many.
        k: usize,
    },
    /// The stage hook said stop.
    #[error("cancelled in stage {stage}")]
    Cancelled {
        /// Where.
        stage: &'static str,
    },
    /// A factorisation failed.
    #[error(transparent)]
    Factor(#[from] LdltError),
    /// The dense solver failed.
    #[error(transparent)]
    Dense(#[from] DenseEigenError),
    /// A Krylov space could not be extended.
    #[error(transparent)]
    Exhausted(#[from] Exhausted),
}

#[derive(Clone, Copy)]
struct Hook<'a>(Option<StageHook<'a>>);

impl Hook<'_> {
    fn enter(&self, stage: &'static str) -> Result<(), SpectrumError> {
        match self.0 {
            Some(hook) if !hook(stage) => Err(SpectrumError::Cancelled { stage }),
            _ => Ok(()),
        }
    }
}

/// A tiny eigenvalue of either sign is rounding of zero below this share of the largest one.
const ZERO: f64 = 1e-12;

impl Spectrum {
    /// The `k` smallest eigenpairs of `W φ = λ A φ`: `stiffness` W `(n, n)` symmetric positive
    /// semidefinite, `mass` the diagonal of A `(n,)`, positive; `1 <= k <= n`.
    ///
    /// Disconnected domains are fine (an eigenvalue 0 for each component). The cost is about
    /// `n k²` for surfaces, `n³` for the dense route (k above about n/3).
    pub fn smallest(
        stiffness: &sprs::CsMat<f64>,
        mass: &[f64],
        k: usize,
        options: &Options,
    ) -> Result<Self, SpectrumError> {
        let n = mass.len();
        if !(1e-13..=1e-2).contains(&options.tolerance) {
            return Err(SpectrumError::Tolerance {
                tolerance: options.tolerance,
            });
        }
        validate(stiffness, mass)?;
        if k == 0 || k > n {
            return Err(SpectrumError::Count { k, n });
        }
        let hook = Hook(options.stage);
        hook.enter("components")?;
        let parts = components(stiffness, mass)?;
        let setting = Setting {
            tolerance: options.tolerance,
            seed: options.seed,
            parallel: options.threads > 1,
            hook,
        };
        let solved = if let [only] = parts.as_slice() {
            vec![smallest(only, k, &setting)?]
        } else {
            solve_components(&parts, k, &setting)?
        };
        hook.enter("assemble")?;
        assemble(&parts, &solved, k, n, setting.parallel)
    }
}

/// Solves each component for its share of the `k` smallest pairs. The shares come from counts at a
/// common limit, so that no component is solved for more than it contributes (plus one pair).
fn solve_components(
    parts: &[Component],
    k: usize,
    setting: &Setting,
) -> Result<Vec<Pairs>, SpectrumError> {
    let n: usize = parts.iter().map(Component::n).sum();
    let area: f64 = parts.iter().map(|p| p.area).sum();
    let mut wanted = vec![1usize; parts.len()];
    if k > parts.len() {
        let count = |limit: f64| -> Result<Vec<usize>, SpectrumError> {
            setting.hook.enter("components")?;
            parts
                .iter()
                .map(|p| Ok(p.inertia(limit)?.0.n_negative))
                .collect()
        };
        let enough = |counts: &[usize]| counts.iter().sum::<usize>() >= k;
        let slack = k + k / 5 + 8;
        let (mut low, mut high) = (0.0f64, 4.4 * std::f64::consts::PI * k as f64 / area);
        let mut counts = count(high)?;
        // Beyond Gershgorin's bound the count is n, so this ends.
        while !enough(&counts) {
            low = high;
            high *= 2.0;
            counts = count(high)?;
        }
        while counts.iter().sum::<usize>() > slack && high > 1.001 * low {
            let middle = if low > 0.0 {
                (low * high).sqrt()
            } else {
                high / 8.0
            };
            let at_middle = count(middle)?;
            if enough(&at_middle) {
                high = middle;
                counts = at_middle;
            } else {
                low = middle;
            }
            if high < f64::MIN_POSITIVE * 1e20 {
                break;
            }
        }
        for (w, (c, p)) in wanted.iter_mut().zip(counts.iter().zip(parts)) {
            *w = (c + 1).min(p.n());
        }
    }
    let mut solved = Vec::with_capacity(parts.len());
    for (part, &share) in parts.iter().zip(&wanted) {
        solved.push(smallest(part, share, setting)?);
    }
    // A share that turns out too small (counts at a limit inside a cluster) is enlarged.
    loop {
        let mut all: Vec<f64> = solved
            .iter()
            .flat_map(|s| s.values.iter().copied())
            .collect();
        all.sort_by(f64::total_cmp);
        let kth = all.get(k - 1).copied().unwrap_or(f64::INFINITY);
        let mut changed = false;
        for ((part, share), pairs) in parts.iter().zip(&mut wanted).zip(&mut solved) {
            if pairs.limit <= kth && pairs.values.len() < part.n() {
                *share = (2 * *share + 2).max(pairs.values.len() + 1).min(part.n());
                *pairs = smallest(part, *share, setting)?;
                changed = true;
            }
        }
        if !changed {
            debug_assert!(all.len() >= k && n >= k);
            return Ok(solved);
        }
    }
}

fn assemble(
    parts: &[Component],
    solved: &[Pairs],
    k: usize,
    n: usize,
    parallel: bool,
) -> Result<Spectrum, SpectrumError> {
    // (value, component, index in it): ties go to the earlier component.
    let mut order: Vec<(f64, usize, usize)> = solved
        .iter()
        .enumerate()
        .flat_map(|(c, s)| s.values.iter().enumerate().map(move |(i, &v)| (v, c, i)))
        .collect();
    order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)).then(a.2.cmp(&b.2)));
    let tightest = solved
        .iter()
        .min_by(|a, b| a.limit.total_cmp(&b.limit))
        .expect("invariant: k >= 1, so there is a component");
    let tau = tightest.limit;
    let count = order.iter().filter(|o| o.0 < tau).count();
    let zero = ZERO * order[k - 1].0.abs();
    let mut eigenvalues = Vec::with_capacity(k);
    let mut residuals = Vec::with_capacity(k);
    let mut flat = vec![0.0; n * k];
    let mut groups: Vec<Group> = Vec::new();
    let mut group_of = HashMap::new();
    for (&(value, c, i), column) in order[..k].iter().zip(flat.chunks_exact_mut(n)) {
        if value < -1e-6 * order[k - 1].0.abs() {
            return Err(SpectrumError::NotSemidefinite {
                count: 1,
                below: value,
            });
        }
        eigenvalues.push(if value < zero { 0.0 } else { value });
        residuals.push(solved[c].residuals[i]);
        let group = *group_of.entry((c, i / WIDTH)).or_insert_with(|| {
            groups.push(Group {
                component: c,
                panel: i / WIDTH,
                columns: Vec::with_capacity(WIDTH),
            });
            groups.len() - 1
        });
        groups[group].columns.push((i % WIDTH, column));
    }
    let by_vertex: Vec<_> = parts.iter().map(Component::rows_by_vertex).collect();
    let write = |panel: &mut Vec<Row>, group: Group| {
        let c = group.component;
        solved[c].vectors.copy_panel(group.panel, panel);
        group.write(&parts[c], panel, &by_vertex[c]);
    };
    if parallel {
        groups.into_par_iter().for_each_init(Vec::new, write);
    } else {
        let mut panel = Vec::new();
        groups.into_iter().for_each(|g| write(&mut panel, g));
    }
    Ok(Spectrum {
        eigenvalues,
        eigenvectors: DMatrix::from_vec(n, k, flat),
        residuals,
        certificate: Certificate {
            tau,
            count,
            margin: tightest.margin,
            perturbation: solved.iter().map(|s| s.perturbation).fold(0.0, f64::max),
            n_components: parts.len(),
            n_krylov: solved.iter().map(|s| s.n_krylov).max().unwrap_or(0),
            n_polish: solved.iter().map(|s| s.n_polish).sum(),
            n_repair: solved.iter().map(|s| s.n_repair).sum(),
        },
    })
}

/// Where the columns of a panel go.
struct Group<'a> {
    component: usize,
    panel: usize,
    /// (column of the panel, its place in the result)
    columns: Vec<(usize, &'a mut [f64])>,
}

impl Group<'_> {
    /// Writes the columns, scaled to A-length 1 and with their canonical signs, in the order of the
    /// vertices: memory is written in sequence, and the eight numbers of a row are read at once.
    fn write(self, part: &Component, panel: &[Row], by_vertex: &[(u32, u32)]) {
        let mut largest = [0.0f64; WIDTH];
        let mut columns = self.columns;
        for &(vertex, row) in by_vertex {
            let scale = part.inverse_sqrt_mass[row as usize];
            let x = panel[row as usize].0.map(|x| x * scale);
            for (l, x) in largest.iter_mut().zip(x) {
                if x.abs() > l.abs() {
                    *l = x;
                }
            }
            for (from, column) in &mut columns {
                column[vertex as usize] = x[*from];
            }
        }
        for (from, column) in columns {
            if largest[from] < 0.0 {
                for &(vertex, _) in by_vertex {
                    column[vertex as usize] *= -1.0;
                }
            }
        }
    }
}

#[cfg(test)]
mod refusal_tests;
#[cfg(test)]
mod tests;
