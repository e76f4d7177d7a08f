//! Chooses the best of many candidate labellings, without ground truth.
//!
//! The value of a labelling is the log of the concavity of its boundaries, plus its agreement with
//! the other candidates, each weighted by its own concavity. The two terms err in different ways: a
//! few very concave boundaries may leave parts together that no other grouping joins, and a
//! boundary on which most groupings agree may cut across limbs. On a few shapes, a handful of deep
//! creases decides the concavity; its weight therefore grows with the number of shapes, up to a
//! limit.

use super::criterion::Criterion;
use rayon::prelude::*;

/// Temperature of the softmax of the log concavities, which weights the candidates.
const TEMPERATURE: f64 = 0.15;
/// Number of shapes from which on the concavity has its full weight.
const FULL_WEIGHT_SHAPES: f64 = 14.0;
/// Weight of the consensus relative to the score, where numbers of labels are compared.
const CONSENSUS_WEIGHT: f64 = 0.5;

/// Judges labellings by their concavity and by their agreement with good candidates.
pub(super) struct Judge<'a> {
    criterion: &'a Criterion,
    /// Candidate labellings of all patches, and the softmax of their log concavities.
    candidates: Vec<Vec<u32>>,
    weights: Vec<f64>,
    /// Area share of each patch, summing to the number of shapes, and to 1.
    area: &'a [f64],
    shares: Vec<f64>,
    concavity_weight: f64,
    k: usize,
}

impl<'a> Judge<'a> {
    pub(super) fn new(
        criterion: &'a Criterion,
        candidates: Vec<Vec<u32>>,
        area: &'a [f64],
        k: usize,
    ) -> Self {
        let concavities: Vec<f64> = candidates
            .par_iter()
            .map(|l| criterion.log_concavity(&criterion.pair_sums(l, k)))
            .collect();
        let top = concavities
            .iter()
            .copied()
            .fold(f64::NEG_INFINITY, f64::max);
        let mut weights: Vec<f64> = concavities
            .iter()
            .map(|c| ((c - top) / TEMPERATURE).exp())
            .collect();
        let sum: f64 = weights.iter().sum();
        weights.iter_mut().for_each(|w| *w /= sum);
        let total: f64 = area.iter().sum();
        Self {
            criterion,
            candidates,
            weights,
            area,
            concavity_weight: (total / FULL_WEIGHT_SHAPES).min(1.0),
            shares: area.iter().map(|a| a / total).collect(),
            k,
        }
    }

    /// Adds candidates.
    pub(super) fn with_more(mut self, more: Vec<Vec<u32>>) -> Self {
        self.candidates.extend(more);
        Self::new(self.criterion, self.candidates, self.area, self.k)
    }

    /// Returns the candidates.
    pub(super) fn into_candidates(self) -> Vec<Vec<u32>> {
        self.candidates
    }

    /// Returns the value of each labelling of all patches with labels below `k`.
    pub(super) fn values(&self, labellings: &[Vec<u32>], k: usize) -> Vec<f64> {
        labellings
            .par_iter()
            .zip(self.consensus(labellings, k))
            .map(|(l, c)| {
                let sums = self.criterion.pair_sums(l, k);
                self.concavity_weight * self.criterion.log_concavity(&sums) + c
            })
            .collect()
    }

    /// Returns the positions of the `n` labellings of the greatest value, best first.
    pub(super) fn best(&self, labellings: &[Vec<u32>], n: usize) -> Vec<usize> {
        let values = self.values(labellings, self.k);
        let mut order: Vec<usize> = (0..values.len()).collect();
        order.sort_by(|&a, &b| values[b].total_cmp(&values[a]).then(a.cmp(&b)));
        order.truncate(n);
        order
    }

    /// Returns the score of the best candidate plus its consensus; comparable between numbers of
    /// labels.
    pub(super) fn comparable_value(&self) -> f64 {
        let consensus = self.consensus(&self.candidates, self.k);
        let candidates = self.candidates.iter().zip(consensus);
        candidates
            .map(|(l, c)| {
                let sums = self.criterion.pair_sums(l, self.k);
                self.criterion.score(&sums) + CONSENSUS_WEIGHT * c
            })
            .fold(f64::NEG_INFINITY, f64::max)
    }

    /// Returns, for each labelling, the mean normalised mutual information with the candidates,
    /// `I(A; B) / √(H(A) H(B))` (Strehl and Ghosh 2002). Patches are weighted by area.
    fn consensus(&self, labellings: &[Vec<u32>], k: usize) -> Vec<f64> {
        let entropy = |shares: &[f64]| -> f64 {
            let positive = shares.iter().filter(|p| **p > 0.0);
            positive.map(|p| -p * p.ln()).sum()
        };
        let their_own: Vec<f64> = (self.candidates.iter())
            .map(|theirs| {
                let mut shares = vec![0.0; self.k];
                self.add_shares(&mut shares, |p| theirs[p]);
                entropy(&shares)
            })
            .collect();
        labellings
            .par_iter()
            .map(|mine| {
                let mut shares = vec![0.0; k];
                self.add_shares(&mut shares, |p| mine[p]);
                let my_own = entropy(&shares);
                let mut joint = vec![0.0; k * self.k];
                let agreements = self.candidates.iter().zip(&their_own).map(|(theirs, own)| {
                    joint.fill(0.0);
                    self.add_shares(&mut joint, |p| mine[p] * self.k as u32 + theirs[p]);
                    (my_own + own - entropy(&joint)) / (my_own * own).sqrt().max(1e-9)
                });
                let weighted = agreements.zip(&self.weights).map(|(a, weight)| weight * a);
                weighted.sum()
            })
            .collect()
    }

    /// Adds the area share of each patch to its place in `shares`. Neighbours in the list go to
    /// different copies, since one sum waits for the other where both have the same place.
    fn add_shares(&self, shares: &mut [f64], place: impl Fn(usize) -> u32) {
        const COPIES: usize = 4;
        let mut copies = vec![[0.0; COPIES]; shares.len()];
        for (p, share) in self.shares.iter().enumerate() {
            copies[place(p) as usize][p % COPIES] += share;
        }
        for (share, copies) in shares.iter_mut().zip(&copies) {
            *share += copies.iter().sum::<f64>();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::discover::Prepared;
    use super::super::test_shapes::Strips;
    use super::*;

    #[test]
    fn labels_that_end_at_creases_and_recur_are_best() {
        let strips = Strips::new(4, 3, 0.3);
        let input = strips.input();
        let shapes = Prepared::new(&input);
        let criterion = shapes.criterion();
        let truth: Vec<u32> = (0..4).flat_map(|_| (0..18).map(|p| p / 6)).collect();
        let shifted: Vec<u32> = (0..4)
            .flat_map(|_| (0..18).map(|p| (p + 2) / 6 % 3))
            .collect();
        let mut once = truth.clone();
        once[..18].copy_from_slice(&shifted[..18]);
        let candidates = vec![shifted.clone(), truth.clone(), once.clone()];
        let judge = Judge::new(&criterion, candidates.clone(), &shapes.area, 3);
        assert_eq!(judge.best(&candidates, 3), [1, 2, 0]);
        let values = judge.values(&candidates, 3);
        assert_eq!(values, judge.with_more(Vec::new()).values(&candidates, 3));
    }
}
