//! Estimates a map between the points of two shapes from their spectra, without landmarks: it
//! starts many small maps and refines few of them.
//!
//! The low eigenfunctions of similar shapes agree up to signs (and a little mixing), so every
//! pattern of signs is a start (Ren et al. 2020, *MapTree*). Small maps do not distinguish the
//! sides of a surface that a reflection exchanges. Each start is therefore refined twice, once
//! towards keeping orientation and once towards reversing it, by crossed functions in the
//! nearest-neighbour search (see [`super::orientation`]). Maps that are bijective and orthogonal
//! survive, on more and more samples with more and more eigenfunctions.

use super::basis::{Basis, product_transposed};
use super::bijective::{Guidance, Hints, Pair, Turn};
use super::orientation::Orientation;
use super::probes::{Probes, curvature_probes, probes};
use super::samples::{SampledBasis, Samples, farthest_point_samples};
use crate::linalg::nearest::{nearest_both, nearest_in_cells, nearest_rows};
use crate::mesh::EdgeGraph;

/// Sizes and weights of [`estimate`].
#[derive(Debug, Clone, PartialEq)]
pub struct EstimateOptions {
    /// Eigenfunctions whose signs are tried.
    pub n_signs: usize,
    /// Samples and size of the map at the end of each stage, ascending.
    pub stages: Vec<Stage>,
    /// Weight of the probe functions in the search, relative to the spectral coordinates.
    pub probe_weight: f32,
    /// Weight of the crossed functions.
    pub turn_weight: f32,
    /// The largest size of a map for which orientation is imposed.
    pub turn_k: usize,
    /// Cost of disagreement with either orientation, in units of strain.
    pub orientation_cost: f64,
    /// Cost of a probe residual of 1, in units of strain.
    pub residual_cost: f64,
    /// Scales of mean curvature among the probe functions.
    pub n_curvatures: usize,
    /// Weight of the mean curvature, relative to the signatures.
    pub curvature_weight: f32,
    /// Weight of landmarks in the search, relative to the spectral coordinates.
    pub landmark_weight: f32,
    /// The orientation to prefer.
    pub side: Side,
    /// Whether the best map of the other orientation is refined to the end too.
    pub alternative: bool,
}

/// The maps to return for a shape that has a reflection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Side {
    /// Maps that keep orientation, unless those that reverse it cost less by more than a quarter: a
    /// shape that is modelled inside out is matched nevertheless.
    #[default]
    Preferred,
    /// Maps that keep orientation.
    Keep,
    /// Maps that reverse orientation: the mirrored ones.
    Reverse,
}

impl Side {
    /// Factor by which a map of the preferred orientation may cost more.
    const PREFERENCE: f64 = 1.25;

    /// The cost of a map in comparisons.
    fn counted(self, candidate: &Candidate) -> f64 {
        let keeps = candidate.agreement >= 0.0;
        match self {
            Self::Preferred if keeps => candidate.cost,
            Self::Preferred => candidate.cost * Self::PREFERENCE,
            Self::Keep => candidate.cost + if keeps { 0.0 } else { f64::from(f32::MAX) },
            Self::Reverse => candidate.cost + if keeps { f64::from(f32::MAX) } else { 0.0 },
        }
    }
}

/// One stage of [`estimate`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stage {
    /// Samples of each shape.
    pub n_samples: usize,
    /// Size of the maps at its end.
    pub k: usize,
    /// Growth in each round.
    pub step: usize,
    /// Number of maps of each orientation that survive the stage.
    pub keep: usize,
    /// Whether the search includes probe functions.
    pub guided: bool,
}

impl Default for EstimateOptions {
    fn default() -> Self {
        let stage = |n_samples, k, step, keep, guided| Stage {
            n_samples,
            k,
            step,
            keep,
            guided,
        };
        Self {
            n_signs: 5,
            stages: vec![
                stage(100, 14, 2, 8, true),
                stage(200, 30, 4, 4, true),
                stage(300, 50, 10, 2, true),
                stage(600, 100, 25, 1, false),
            ],
            probe_weight: 1.0,
            turn_weight: 0.5,
            turn_k: 15,
            orientation_cost: 0.5,
            residual_cost: 1.0,
            n_curvatures: 4,
            curvature_weight: 1.0,
            landmark_weight: 1.0,
            side: Side::default(),
            alternative: true,
        }
    }
}

/// The data of a shape that [`estimate`] uses, computed once for all its maps.
#[derive(Debug, Clone)]
pub struct Frame {
    /// The samples of each stage, with the basis at them.
    pub levels: Vec<Level>,
    /// The orientation.
    pub orientation: Orientation,
}

/// The data of a shape at one stage.
#[derive(Debug, Clone)]
pub struct Level {
    /// The samples.
    pub samples: Samples,
    /// The basis at the samples.
    pub basis: SampledBasis,
    /// Probe functions at the samples, of mean squared norm 1.
    pub probes: Vec<f32>,
    /// Columns of `probes`.
    pub dim: usize,
}

impl Frame {
    /// Computes the frame of a shape.
    pub fn new(
        graph: &EdgeGraph,
        vertices: &[[f32; 3]],
        faces: &[[u32; 3]],
        basis: &Basis<'_>,
        options: &EstimateOptions,
    ) -> Self {
        let counts: Vec<usize> = options.stages.iter().map(|s| s.n_samples).collect();
        let samples = farthest_point_samples(graph, basis.mass, &counts);
        let probes = probes(basis, 20, 10).beside(
            &curvature_probes(vertices, faces, basis, options.n_curvatures),
            options.curvature_weight,
        );
        let levels = samples.into_iter().zip(&options.stages);
        Self {
            levels: levels
                .map(|(samples, stage)| Level::new(samples, basis, &probes, stage.k))
                .collect(),
            orientation: Orientation::new(faces, basis),
        }
    }
}

impl Frame {
    /// The last, finest level.
    ///
    /// # Panics
    /// If the options of the frame have no stage.
    pub fn last(&self) -> &Level {
        self.levels.last().expect("invariant: there is a stage")
    }
}

impl Level {
    fn new(samples: Samples, basis: &Basis<'_>, probes: &Probes, k: usize) -> Self {
        let dim = probes.dim;
        let scale = (dim as f32).sqrt().recip();
        let rows = samples.vertices.iter();
        let at = rows.flat_map(|&v| &probes.values[v as usize * dim..(v as usize + 1) * dim]);
        Self {
            probes: at.map(|x| scale * x).collect(),
            dim,
            basis: SampledBasis::new(basis, &samples.vertices, &samples.mass, k),
            samples,
        }
    }
}

impl Level {
    /// Adds further probe functions, given at all vertices.
    fn marked(&self, more: &Probes, weight: f32) -> Self {
        let scale = (weight / more.dim.max(1) as f32).sqrt();
        let rows = self
            .probes
            .chunks_exact(self.dim)
            .zip(&self.samples.vertices);
        let probes = rows.flat_map(|(row, &v)| {
            let at = v as usize * more.dim;
            let more = &more.values[at..at + more.dim];
            row.iter()
                .copied()
                .chain(more.iter().map(move |x| scale * x))
        });
        Self {
            probes: probes.collect(),
            dim: self.dim + more.dim,
            basis: self.basis.clone(),
            samples: self.samples.clone(),
        }
    }
}

/// An estimated map.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// The maps in both directions.
    pub pair: Pair,
    /// −1 (reverses orientation) to 1 (keeps it).
    pub agreement: f64,
    /// Mean squared difference of the probe functions at matched samples, in both directions; 0 is
    /// perfect, 2 is chance.
    pub residual: f64,
    /// See [`Pair::strain`].
    pub strain: f64,
    /// Strain plus the cost of disagreement with orientation: lower is better.
    pub cost: f64,
}

/// Returns the best map and, if wanted, the best map of the other orientation after it. `landmarks`
/// are probe functions at the vertices of both shapes whose columns correspond (see
/// [`super::landmarks`]).
pub fn estimate(
    one: &Frame,
    two: &Frame,
    landmarks: Option<(&Probes, &Probes)>,
    options: &EstimateOptions,
) -> Vec<Candidate> {
    let mut found: Vec<Candidate> = Vec::new();
    for (s, stage) in options.stages.iter().enumerate() {
        let marked = landmarks.map(|(x, y)| {
            let weight = options.landmark_weight / options.probe_weight.max(1e-6);
            (
                one.levels[s].marked(x, weight),
                two.levels[s].marked(y, weight),
            )
        });
        let (a, b) = match &marked {
            Some((a, b)) => (a, b),
            None => (&one.levels[s], &two.levels[s]),
        };
        let k_end = stage.k.min(a.basis.k).min(b.basis.k);
        let guidance = Guidance {
            one: &a.probes,
            two: &b.probes,
            dim: a.dim,
            weight: options.probe_weight,
        };
        let guided = stage.guided || marked.is_some();
        let guidance = Some(&guidance).filter(|_| guided);
        let tries: Vec<(Pair, f32)> = if s == 0 {
            let mut tries = starts(options.n_signs.min(k_end.saturating_sub(1)));
            if marked.is_some() {
                let (p2p_21, p2p_12) = nearest_both(&b.probes, &a.probes, a.dim);
                let k = (options.n_signs + 1).min(k_end);
                let pair = Pair::from_pointwise(&a.basis, &b.basis, &p2p_21, &p2p_12, k);
                tries.extend([(pair.clone(), 1.0), (pair, -1.0)]);
            }
            tries
        } else {
            let sign = |c: &Candidate| if c.agreement < 0.0 { -1.0 } else { 1.0 };
            found.iter().map(|c| (c.pair.clone(), sign(c))).collect()
        };
        let refined = tries.into_iter().map(|(pair, sign)| {
            // Samples of a small mesh may distinguish fewer eigenfunctions than those of the
            // previous stage.
            let pair = if pair.k > k_end {
                pair.leading(k_end)
            } else {
                pair
            };
            let turn = Turn {
                one: &one.orientation,
                two: &two.orientation,
                sign,
                weight: options.turn_weight,
                k_max: options.turn_k,
            };
            let first = if s == 0 { pair.k } else { pair.k + stage.step };
            let ks = sizes(first, k_end, stage.step);
            let pair = pair.refine(&a.basis, &b.basis, &ks, guidance, Some(&turn));
            let agreement = one
                .orientation
                .agreement(&two.orientation, &pair.c_12, pair.k);
            let residual = probe_residual(a, b, &pair);
            let strain = pair.strain();
            let cost = strain
                + options.orientation_cost * (1.0 - agreement.abs())
                + options.residual_cost * residual;
            Candidate {
                pair,
                residual,
                strain,
                agreement,
                cost,
            }
        });
        let refined: Vec<Candidate> = refined.collect();
        found = best(refined, stage.keep);
        let last = s + 2 >= options.stages.len();
        if last {
            found.sort_by(|x, y| options.side.counted(x).total_cmp(&options.side.counted(y)));
            if let Some(first) = found.first().map(|c| c.agreement < 0.0) {
                let keep = 1 + usize::from(options.alternative);
                found = best_of_sides(found, first);
                found.truncate(keep);
            }
        }
    }
    found
}

/// The first map of the preferred orientation, then the first of the other.
fn best_of_sides(found: Vec<Candidate>, reversing: bool) -> Vec<Candidate> {
    let (same, other): (Vec<_>, Vec<_>) = found
        .into_iter()
        .partition(|c| (c.agreement < 0.0) == reversing);
    same.into_iter()
        .take(1)
        .chain(other.into_iter().take(1))
        .collect()
}

fn probe_residual(one: &Level, two: &Level, pair: &Pair) -> f64 {
    let (p2p_21, p2p_12) = pair.pointwise(&one.basis, &two.basis, &Hints::default());
    let dim = one.dim;
    let mean = |a: &Level, b: &Level, p2p: &[u32]| {
        let rows = a.probes.chunks_exact(dim).zip(p2p).zip(&a.samples.mass);
        let sum: f64 = rows
            .map(|((x, t), mass)| {
                let y = &b.probes[*t as usize * dim..(*t as usize + 1) * dim];
                let d: f32 = x.iter().zip(y).map(|(x, y)| (x - y) * (x - y)).sum();
                f64::from(d * mass)
            })
            .sum();
        sum
    };
    0.5 * (mean(two, one, &p2p_21) + mean(one, two, &p2p_12))
}

/// Every pattern of signs, for either orientation.
fn starts(n_signs: usize) -> Vec<(Pair, f32)> {
    let patterns = (0..1usize << n_signs).map(|pattern| {
        let sign = |bit: usize| if pattern >> bit & 1 == 1 { -1.0 } else { 1.0 };
        let signs: Vec<f32> = std::iter::once(1.0).chain((0..n_signs).map(sign)).collect();
        Pair::from_signs(&signs)
    });
    patterns
        .flat_map(|p| [(p.clone(), 1.0), (p, -1.0)])
        .collect()
}

/// Sizes from `from` to `to`, both included, by `step`.
fn sizes(from: usize, to: usize, step: usize) -> Vec<usize> {
    let mut ks: Vec<usize> = (from.min(to)..to).step_by(step.max(1)).collect();
    ks.push(to);
    ks
}

/// The `keep` cheapest of each orientation that differ from each other, cheapest first.
fn best(mut found: Vec<Candidate>, keep: usize) -> Vec<Candidate> {
    /// Mean squared difference of a row below which two maps count as equal.
    const SAME: f64 = 0.05;
    found.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    let mut kept: Vec<Candidate> = Vec::new();
    for c in found {
        let same_side = |o: &&Candidate| (o.agreement < 0.0) == (c.agreement < 0.0);
        let n = kept.iter().filter(same_side).count();
        let twin = |o: &Candidate| {
            let d = o.pair.c_12.iter().zip(&c.pair.c_12);
            d.map(|(x, y)| f64::from(x - y).powi(2)).sum::<f64>() < SAME * c.pair.k as f64
        };
        if n < keep && !kept.iter().any(twin) {
            kept.push(c);
        }
    }
    kept
}

/// Number of cells of samples of shape 1 that are searched for each vertex of shape 2.
const N_PROBED: usize = 4;

/// The pointwise map `p2p_21 (n2,)` of a functional map `c_12 (k, k)`: for each row of `Φ₂` the
/// nearest of `Φ₁ C₁₂ᵀ`, searched in the nearest few cells of samples of shape 1. O(n2 (samples +
/// n1 / samples) k).
pub fn dense(one: (&Basis<'_>, &Frame), two: &Basis<'_>, c_12: &[f32], k: usize) -> Vec<u32> {
    let targets = product_transposed(&one.0.leading(k), c_12, one.0.n_vertices(), k, k);
    nearest_of(one.1, &two.leading(k), &targets, k)
}

/// The pointwise map `p2p_12 (n1,)` of the same `c_12`: for each row of `Φ₁ C₁₂ᵀ` the nearest of
/// `Φ₂`, by cells of samples of shape 2. The same distances as in [`dense`], from the other side.
pub fn dense_back(one: &Basis<'_>, two: (&Basis<'_>, &Frame), c_12: &[f32], k: usize) -> Vec<u32> {
    let queries = product_transposed(&one.leading(k), c_12, one.n_vertices(), k, k);
    nearest_of(two.1, &queries, &two.0.leading(k), k)
}

fn nearest_of(frame: &Frame, queries: &[f32], targets: &[f32], k: usize) -> Vec<u32> {
    let n = frame.levels.len();
    let Some(level) = frame.levels.get(n.saturating_sub(2)) else {
        return nearest_rows(queries, targets, k);
    };
    let cells = &level.samples;
    nearest_in_cells(
        queries,
        targets,
        k,
        &cells.vertices,
        &cells.nearest,
        N_PROBED,
    )
}
