//! Computes the smallest eigenpairs of `W φ = λ A φ` for stiffness W and lumped mass A, and proves
//! that none is missing.
//!
//! W is split into connected components and standardised, `S = A^{-1/2} W A^{-1/2}`. On each
//! component, block Lanczos runs on `(S - σI)⁻¹` with σ inside the wanted part of the spectrum,
//! where the sparse L D Lᵀ factor of `S - σI` also counts the eigenvalues below σ. A second
//! factorisation at τ, in the gap above the last wanted eigenvalue, must have exactly as many
//! negative pivots as there are pairs below τ (Sylvester's law of inertia; Grimes, Lewis and Simon
//! 1994), so that none is missing. Small components are solved densely, and so are components of
//! which most of the spectrum is wanted. Residuals are measured on W itself. Where an unpivoted
//! indefinite factor was not accurate enough, inverse iteration with a definite one and a
//! Rayleigh–Ritz step follow.

mod component;
mod connected;
mod eigenpairs;
mod error;
mod iterative;
mod polish;

pub use eigenpairs::Eigenpairs;
pub use error::SpectrumError;

use component::{Component, components, validate};
use connected::{Pairs, Setting, smallest};
use nalgebra::DMatrix;

/// The progress of a solve.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Progress {
    /// `components`, `factor`, `iterate`, `check`, `certify`, `vectors`, `repair`, `verify`,
    /// `polish`, `dense`, `assemble`.
    pub stage: &'static str,
    /// Vectors of the Krylov space, in stages `iterate` and `repair`; 0 in others.
    pub done: usize,
    /// Expected number of vectors, as far as known; never less than `done`. 0 in other stages.
    pub expected: usize,
}

/// Called on entering each stage and at each block of an iteration, in the calling thread; `false`
/// cancels, with [`SpectrumError::Cancelled`].
pub type ProgressHook<'a> = &'a dyn Fn(&Progress) -> bool;

/// How to compute a spectrum.
#[derive(Clone, Copy)]
pub struct Options<'a> {
    /// Seed of the random start. Results are accurate and complete for any.
    pub seed: u64,
    /// Residuals are at most this times `max(λ, λ₊)`, λ₊ the smallest eigenvalue above zero.
    pub tolerance: f64,
    /// 1: the calling thread alone. More: the rayon pool of the caller. Same bits either way.
    pub threads: usize,
    /// Called at each stage and block; decides whether to continue.
    pub progress: Option<ProgressHook<'a>>,
}

impl Default for Options<'_> {
    fn default() -> Self {
        Self {
            seed: 0x5eed,
            tolerance: 1e-8,
            threads: 1,
            progress: None,
        }
    }
}

impl std::fmt::Debug for Options<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Options")
            .field("seed", &self.seed)
            .field("tolerance", &self.tolerance)
            .field("threads", &self.threads)
            .field("progress", &self.progress.is_some())
            .finish()
    }
}

/// The proof that no eigenvalue is missing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Certificate {
    /// Every eigenvalue below this was found; at least the k-th lies below. Infinite if all n are.
    pub tau: f64,
    /// Eigenvalues below `tau`, counted by inertia (or by a dense solver that finds all n).
    pub count: usize,
    /// Distance from `tau` to the nearest eigenvalue found.
    pub margin: f64,
    /// The count is that of a matrix within this distance (2-norm) of `A^{-1/2} W A^{-1/2}`, in the
    /// worst case of rounding. See [`Certificate::proved`].
    pub perturbation: f64,
    /// Growth of the pivots in the factorisation that counted: the largest row sum of
    /// `|L| |D| |Lᵀ|` over that of the matrix. 1 when all components were solved densely.
    pub growth: f64,
    /// Connected components of W.
    pub n_components: usize,
    /// Dimension of the largest Krylov space; 0 when all components were solved densely.
    pub n_krylov: usize,
    /// Rounds of inverse iteration that the residuals needed.
    pub n_polish: usize,
    /// Rounds of search for pairs that the first iteration missed.
    pub n_repair: usize,
}

impl Certificate {
    /// Whether the count holds for the matrix as given, regardless of rounding: no eigenvalue is
    /// within `perturbation` of `tau`. If false, pairs and count still agree, but that is no proof.
    ///
    /// ```
    /// use coseg_geometry::mesh::icosphere;
    /// use coseg_geometry::operators::{Operator, laplacian};
    /// use coseg_geometry::spectrum::{Options, Spectrum};
    ///
    /// let sphere = laplacian(&icosphere(4), &[], Operator::Tufted)?;
    /// let found = Spectrum::smallest(&sphere.stiffness, &sphere.mass, 10, &Options::default())?;
    /// let certificate = found.certificate;
    /// assert!(certificate.proved() && certificate.perturbation < certificate.margin);
    /// // At least the requested ones lie below τ; those of a multiplet come together.
    /// assert!(certificate.count >= 10 && found.eigenvalues[9] < certificate.tau);
    /// # Ok::<_, Box<dyn std::error::Error>>(())
    /// ```
    pub fn proved(&self) -> bool {
        self.perturbation < self.margin
    }
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
    /// The proof that no eigenvalue is missing.
    pub certificate: Certificate,
}

#[derive(Clone, Copy)]
struct Hook<'a>(Option<ProgressHook<'a>>);

impl Hook<'_> {
    fn enter(&self, stage: &'static str) -> Result<(), SpectrumError> {
        self.at(stage, 0, 0)
    }

    fn at(&self, stage: &'static str, done: usize, expected: usize) -> Result<(), SpectrumError> {
        let expected = expected.max(done);
        let progress = Progress {
            stage,
            done,
            expected,
        };
        match self.0 {
            Some(hook) if !hook(&progress) => Err(SpectrumError::Cancelled { stage }),
            _ => Ok(()),
        }
    }
}

impl Spectrum {
    /// The `k` smallest eigenpairs of `W φ = λ A φ`: `stiffness` W `(n, n)` symmetric positive
    /// semidefinite, `mass` the diagonal of A `(n,)`, positive; `1 <= k <= n`.
    ///
    /// Disconnected domains are allowed (they have an eigenvalue 0 for each component). The cost is
    /// about `n k²` for surfaces, `n³` for the dense solver (k above about n/3). The eigenvectors
    /// are copied once, out of the solver's memory; [`Eigenpairs::smallest`] leaves them there.
    ///
    /// ```
    /// use coseg_geometry::mesh::icosphere;
    /// use coseg_geometry::operators::{Operator, laplacian};
    /// use coseg_geometry::spectrum::{Options, Spectrum};
    ///
    /// let sphere = laplacian(&icosphere(3), &[], Operator::Tufted)?;
    /// let found = Spectrum::smallest(&sphere.stiffness, &sphere.mass, 9, &Options::default())?;
    /// assert!(found.certificate.proved()); // no eigenvalue is missing
    /// // The unit sphere has l (l + 1), 2 l + 1 times each.
    /// let rounded: Vec<f64> = found.eigenvalues.iter().map(|x| x.round()).collect();
    /// assert_eq!(rounded, [0.0, 2.0, 2.0, 2.0, 6.0, 6.0, 6.0, 6.0, 6.0]);
    /// # Ok::<_, Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// If the matrices violate the conditions above, the solve is cancelled, or completeness cannot
    /// be proved: see [`SpectrumError`].
    pub fn smallest(
        stiffness: &sprs::CsMat<f64>,
        mass: &[f64],
        k: usize,
        options: &Options,
    ) -> Result<Self, SpectrumError> {
        Ok(Eigenpairs::smallest(stiffness, mass, k, options)?.into_spectrum())
    }
}

/// Validates the arguments and solves each component.
fn solve(
    stiffness: &sprs::CsMat<f64>,
    mass: &[f64],
    k: usize,
    options: &Options,
) -> Result<(Vec<Component>, Vec<Pairs>), SpectrumError> {
    let n = mass.len();
    if !(1e-13..=1e-2).contains(&options.tolerance) {
        return Err(SpectrumError::Tolerance {
            tolerance: options.tolerance,
        });
    }
    let hook = Hook(options.progress);
    hook.enter("components")?;
    validate(stiffness, mass)?;
    if k == 0 || k > n {
        return Err(SpectrumError::Count { k, n });
    }
    let parts = components(stiffness, mass)?;
    let setting = Setting {
        tolerance: options.tolerance,
        seed: options.seed,
        parallel: options.threads > 1,
        hook,
    };
    let solved = match parts.as_slice() {
        [only] => vec![smallest(only, k, &setting)?],
        _ => solve_components(&parts, k, &setting)?,
    };
    hook.enter("assemble")?;
    Ok((parts, solved))
}

/// Solves each component for its share of the `k` smallest pairs. The shares are counts at a common
/// limit, so that no component is solved for more than it contributes (plus one pair).
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
                .map(|p| Ok(p.inertia(limit, f64::INFINITY)?.0.n_negative))
                .collect()
        };
        let enough = |counts: &[usize]| counts.iter().sum::<usize>() >= k;
        let slack = k + k / 5 + 8;
        let (mut low, mut high) = (0.0f64, 4.4 * std::f64::consts::PI * k as f64 / area);
        let mut counts = count(high)?;
        // Beyond Gershgorin's bound the count is n, so this loop ends.
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

#[cfg(test)]
mod refusal_tests;
#[cfg(test)]
mod tests;
