//! Proposes several divisions of the same shapes into labels, from coarse to fine, of which a
//! person can choose one.
//!
//! The best labelling by any unsupervised value is often not the one that a person has in mind, and
//! neither is its number of labels; but among a few hundred good candidates with 2 to 12 labels
//! there mostly is one that is close. So the proposals are picked to cover the candidates: each
//! candidate, weighted by its value, should agree well with one of them (facility location, solved
//! greedily; Nemhauser, Wolsey and Fisher 1978).

use super::candidates::pool;
use super::criterion::Criterion;
use super::discover::{Candidates, DiscoveryInput, Prepared, refine};
use super::patchwise::Patchwise;
use crate::linalg::assignment::assignment;
use rayon::prelude::*;
use std::ops::RangeInclusive;

/// Numbers of labels of the divisions that are proposed.
pub const PROPOSED_LABELS: RangeInclusive<usize> = 2..=12;
/// Number of proposals.
pub const N_PROPOSALS: usize = 8;
/// Number of best candidates of each number of labels that take part.
const N_EACH: usize = 40;
/// Temperature of the softmax of the values of candidates with the same number of labels.
const TEMPERATURE: f64 = 0.2;

/// A candidate for a proposal.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// Number of labels.
    pub n_labels: usize,
    /// Its value among candidates with the same number of labels, as in
    /// [`Discovery::value`](super::Discovery::value).
    pub value: f64,
    /// Label below `n_labels` of each patch of all shapes.
    pub of_patch: Vec<u32>,
}

/// A division of shapes into labels.
#[derive(Debug, Clone, PartialEq)]
pub struct Proposal {
    /// Number of labels.
    pub n_labels: usize,
    /// Its value, as that of a candidate.
    pub value: f64,
    /// Label below `n_labels` of each face of each shape.
    pub labels: Vec<Vec<u32>>,
}

/// Returns the best labellings of the patches of all shapes with `k` labels, best first; fewer, or
/// none, on shapes with few patches. Deterministic for a given seed. Costs as much as
/// [`discover`](super::discover) with this number of labels.
pub fn candidates(input: &DiscoveryInput<'_>, k: usize, seed: u64) -> Vec<Candidate> {
    let shapes = Prepared::new(input);
    if input.shapes.is_empty() || k < 2 || shapes.area.len() < k {
        return Vec::new();
    }
    let criterion: Criterion = shapes.criterion();
    let patchwise = Patchwise::new(&shapes);
    let pool = pool(&shapes, &criterion, k, seed);
    let mut found = Candidates::new(&shapes, &criterion, &patchwise, (k, pool), seed);
    found.refined = distinct(found.refined, k);
    let values = found.judge.values(&found.refined, k);
    let mut all: Vec<Candidate> = (found.refined.into_iter().zip(values))
        .map(|(of_patch, value)| Candidate {
            n_labels: k,
            value,
            of_patch,
        })
        .collect();
    all.sort_by(|a, b| b.value.total_cmp(&a.value));
    all.truncate(N_EACH);
    all
}

/// Numbers labels by their first patch, and removes repeated labellings.
fn distinct(labellings: Vec<Vec<u32>>, k: usize) -> Vec<Vec<u32>> {
    let mut seen = std::collections::BTreeSet::new();
    let mut out = Vec::with_capacity(labellings.len());
    for labels in labellings {
        let labels = numbered(&labels, k).0;
        if seen.insert(labels.clone()) {
            out.push(labels);
        }
    }
    out
}

/// Numbers labels below `k` by their first use. Returns them with their number.
fn numbered(labels: &[u32], k: usize) -> (Vec<u32>, usize) {
    let mut names = vec![u32::MAX; k];
    let mut next = 0;
    let named = labels.iter().map(|l| {
        let name = &mut names[*l as usize];
        if *name == u32::MAX {
            *name = next;
            next += 1;
        }
        *name
    });
    let named = named.collect();
    (named, next as usize)
}

/// Picks [`N_PROPOSALS`] of the candidates with all numbers of labels, refines them face by face,
/// and returns them from coarse to fine; fewer, if so many that differ do not exist.
pub fn propose(input: &DiscoveryInput<'_>, candidates: &[Candidate]) -> Vec<Proposal> {
    let shapes = Prepared::new(input);
    let picked = pick(candidates, &shapes.area, N_PROPOSALS);
    let mut proposals: Vec<Proposal> = picked
        .into_par_iter()
        .map(|c| refined(&shapes, &candidates[c]))
        .collect();
    proposals.sort_by(|a, b| {
        let finer = a.n_labels.cmp(&b.n_labels);
        finer.then(b.value.total_cmp(&a.value))
    });
    proposals.dedup_by(|a, b| a.labels == b.labels);
    for at in 1..proposals.len() {
        let (coarser, finer) = proposals.split_at_mut(at);
        renumber(&mut finer[0], &coarser[at - 1], input);
    }
    proposals
}

/// Gives each label of a coarser division the same number in this one, where they overlap most, so
/// that both can be drawn in the same colours.
fn renumber(finer: &mut Proposal, coarser: &Proposal, input: &DiscoveryInput<'_>) {
    let (k, n) = (finer.n_labels, coarser.n_labels);
    let mut overlap = vec![0.0; k * n];
    for ((shape, a), b) in input.shapes.iter().zip(&finer.labels).zip(&coarser.labels) {
        for ((i, j), area) in a.iter().zip(b).zip(&shape.surface.area) {
            overlap[*i as usize * n + *j as usize] -= area;
        }
    }
    let matched = assignment(&overlap, k, n);
    let mut rest = (0..k).filter(|name| !matched.contains(&Some(*name)));
    let names = matched.iter().map(|m| m.or_else(|| rest.next()));
    let names: Vec<u32> = names.map(|name| name.unwrap_or(0) as u32).collect();
    for label in finer.labels.iter_mut().flatten() {
        *label = names[*label as usize];
    }
}

/// Refines a candidate face by face. A label that is lost is not counted.
fn refined(shapes: &Prepared<'_>, candidate: &Candidate) -> Proposal {
    let k = candidate.n_labels;
    let labels = refine(shapes.input, shapes.on_faces(&candidate.of_patch), k);
    let (all, n_labels) = numbered(&labels.concat(), k);
    let mut rest = all.into_iter();
    Proposal {
        n_labels,
        value: candidate.value,
        labels: labels
            .iter()
            .map(|of_shape| rest.by_ref().take(of_shape.len()).collect())
            .collect(),
    }
}

/// Returns the positions of the candidates that cover all of them best, at most `n`, in the order
/// in which they are picked.
fn pick(candidates: &[Candidate], area: &[f64], n: usize) -> Vec<usize> {
    let weights = weights(candidates);
    let total: f64 = area.iter().sum();
    let agreements: Vec<Vec<f64>> = (0..candidates.len())
        .into_par_iter()
        .map(|a| {
            let with = |b: &Candidate| right_share(&candidates[a], b, area) / total;
            candidates.iter().map(with).collect()
        })
        .collect();
    let mut covered = vec![0.0; candidates.len()];
    let mut picked = Vec::new();
    while picked.len() < n.min(candidates.len()) {
        let gain = |c: usize| -> f64 {
            let all = agreements[c].iter().zip(&covered).zip(&weights);
            all.map(|((a, best), w)| w * (a - best).max(0.0)).sum()
        };
        let gains: Vec<f64> = (0..candidates.len()).map(gain).collect();
        let best = (0..gains.len()).max_by(|&a, &b| gains[a].total_cmp(&gains[b]).then(b.cmp(&a)));
        let Some(best) = best.filter(|c| gains[*c] > 0.0) else {
            break;
        };
        for (best, a) in covered.iter_mut().zip(&agreements[best]) {
            *best = a.max(*best);
        }
        picked.push(best);
    }
    picked
}

/// Returns the weight of each candidate: the softmax of the values with each number of labels.
fn weights(candidates: &[Candidate]) -> Vec<f64> {
    let of = |k: usize| candidates.iter().filter(move |c| c.n_labels == k);
    let scale = |k: usize| {
        let top = of(k).map(|c| c.value).fold(f64::NEG_INFINITY, f64::max);
        let sum: f64 = of(k).map(|c| ((c.value - top) / TEMPERATURE).exp()).sum();
        (top, sum)
    };
    let largest = candidates.iter().map(|c| c.n_labels).max().unwrap_or(0);
    let scales: Vec<(f64, f64)> = (0..=largest).map(scale).collect();
    let weight = |c: &Candidate| {
        let (top, sum) = scales[c.n_labels];
        ((c.value - top) / TEMPERATURE).exp() / sum
    };
    candidates.iter().map(weight).collect()
}

/// Returns the area on which two labellings agree after the best one-to-one assignment of labels.
fn right_share(a: &Candidate, b: &Candidate, area: &[f64]) -> f64 {
    let mut overlap = vec![0.0; a.n_labels * b.n_labels];
    for ((i, j), area) in a.of_patch.iter().zip(&b.of_patch).zip(area) {
        overlap[*i as usize * b.n_labels + *j as usize] -= area;
    }
    let matched = assignment(&overlap, a.n_labels, b.n_labels).into_iter();
    let pairs = matched.enumerate().filter_map(|(i, j)| j.map(|j| (i, j)));
    pairs.map(|(i, j)| -overlap[i * b.n_labels + j]).sum()
}

/// Returns the normalised mutual information of two labellings of weighted elements,
/// `I(A; B) / √(H(A) H(B))` (Strehl and Ghosh 2002): 1 if they are the same up to names, 0 if one
/// tells nothing about the other.
pub fn agreement(a: &[u32], b: &[u32], weights: &[f64]) -> f64 {
    let total: f64 = weights.iter().sum();
    let entropy = |key: &dyn Fn(usize) -> (u32, u32)| -> f64 {
        let mut shares = std::collections::BTreeMap::<(u32, u32), f64>::new();
        for (at, w) in weights.iter().enumerate() {
            *shares.entry(key(at)).or_default() += w / total;
        }
        let positive = shares.values().filter(|p| **p > 0.0);
        positive.map(|p| -p * p.ln()).sum()
    };
    let (of_a, of_b) = (entropy(&|at| (a[at], 0)), entropy(&|at| (0, b[at])));
    if of_a <= 0.0 && of_b <= 0.0 {
        return 1.0;
    }
    let joint = entropy(&|at| (a[at], b[at]));
    ((of_a + of_b - joint) / (of_a * of_b).sqrt().max(1e-9)).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::super::Links;
    use super::super::test_shapes::Strips;
    use super::*;

    fn proposals(strips: &Strips) -> Vec<Proposal> {
        let input = strips.input();
        let all: Vec<Candidate> = (2..=5).flat_map(|k| candidates(&input, k, 1)).collect();
        propose(&input, &all)
    }

    #[test]
    fn proposals_differ_go_from_coarse_to_fine_and_hold_the_parts() {
        let strips = Strips::new(6, 3, 0.3);
        let found = proposals(&strips);
        assert!((4..=N_PROPOSALS).contains(&found.len()), "{}", found.len());
        assert!(found.is_sorted_by_key(|p| p.n_labels));
        for (at, p) in found.iter().enumerate() {
            let used: std::collections::BTreeSet<u32> =
                p.labels.iter().flatten().copied().collect();
            assert_eq!(used, (0..p.n_labels as u32).collect());
            assert!((2..=5).contains(&p.n_labels));
            let mine = p.labels.concat();
            for other in &found[..at] {
                let area = vec![1.0; mine.len()];
                assert!(agreement(&mine, &other.labels.concat(), &area) < 0.999);
            }
        }
        let best = found.iter().map(|p| strips.right(&p.labels));
        assert!(best.fold(0.0, f64::max) > 0.99);
    }

    #[test]
    fn proposals_do_not_depend_on_the_number_of_threads() {
        let strips = Strips::new(4, 3, 0.3);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build();
        let alone = pool.expect("a pool").install(|| proposals(&strips));
        assert_eq!(proposals(&strips), alone);
    }

    #[test]
    fn a_finer_division_keeps_the_numbers_of_a_coarser_one() {
        let strips = Strips::new(1, 3, 0.3);
        let n = strips.truth.len();
        let of = |n_labels, label: &dyn Fn(usize) -> u32| Proposal {
            n_labels,
            value: 0.0,
            labels: vec![(0..n).map(label).collect()],
        };
        let coarser = of(2, &|f| u32::from(f < n / 2));
        // The second half of it is two labels here, in other numbers.
        let mut finer = of(3, &|f| {
            if f < n / 2 {
                2
            } else {
                u32::from(f > n * 9 / 10)
            }
        });
        renumber(&mut finer, &coarser, &strips.input());
        let expected = of(3, &|f| {
            if f < n / 2 {
                1
            } else if f > n * 9 / 10 {
                2
            } else {
                0
            }
        });
        assert_eq!(finer, expected);
    }

    #[test]
    fn few_proposals_cover_candidates_that_are_alike() {
        let of = |value: f64, labels: [u32; 6]| Candidate {
            n_labels: 2,
            value,
            of_patch: labels.to_vec(),
        };
        let all = [
            of(0.9, [0, 0, 0, 1, 1, 1]),
            of(1.0, [0, 0, 0, 0, 1, 1]),
            of(0.9, [0, 0, 0, 0, 0, 1]),
            of(0.8, [0, 1, 0, 1, 0, 1]),
        ];
        // The second is most like the others; the last is like none of them.
        assert_eq!(pick(&all, &[1.0; 6], 2), [1, 3]);
        assert_eq!(pick(&all, &[1.0; 6], 9).len(), 4);
        assert_eq!(pick(&[], &[], 3), [0; 0]);
    }

    #[test]
    fn shapes_with_too_few_patches_have_no_candidates() {
        let strips = Strips::new(1, 1, 0.3);
        let input = strips.input();
        assert!(candidates(&input, 12, 1).is_empty());
        let none = DiscoveryInput {
            shapes: Vec::new(),
            up_known: false,
            links: Links::default(),
        };
        assert!(candidates(&none, 2, 1).is_empty());
        assert!(propose(&none, &[]).is_empty());
    }

    #[test]
    fn agreement_ignores_names_and_counts_by_weight() {
        let area = [1.0, 1.0, 1.0, 1.0];
        let same = agreement(&[0, 0, 1, 1], &[7, 7, 3, 3], &area);
        assert!((same - 1.0).abs() < 1e-12);
        assert!(agreement(&[0, 0, 1, 1], &[0, 1, 0, 1], &area) < 1e-12);
        let off = agreement(&[0, 0, 1, 1], &[0, 0, 1, 0], &[1.0, 1.0, 1.0, 1e-9]);
        assert!((off - 1.0).abs() < 1e-6, "{off}");
        assert!((agreement(&[0, 0], &[1, 1], &[1.0, 1.0]) - 1.0).abs() < 1e-12);
    }
}
