//! Chooses the best of many candidate labellings, without ground truth.
//!
//! The value of a labelling is the log of the concavity of its boundaries, plus its agreement with
//! the other candidates, each weighted by its own concavity. The two terms err in different ways: a
//! few very concave boundaries may leave parts together that no other grouping joins, and a
//! boundary on which most groupings agree may cut across limbs. On a few shapes, a handful of deep
//! creases decides the concavity; its weight therefore grows with the number of shapes, up to a
//! limit.

use super::criterion::Criterion;
use nalgebra::DMatrix;

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
    /// Area share of each patch, summing to the number of shapes.
    area: &'a [f64],
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
            .iter()
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
        Self {
            criterion,
            candidates,
            weights,
            area,
            concavity_weight: (area.iter().sum::<f64>() / FULL_WEIGHT_SHAPES).min(1.0),
            k,
        }
    }

    /// Adds candidates.
    pub(super) fn with_more(mut self, more: Vec<Vec<u32>>) -> Self {
        self.candidates.extend(more);
        Self::new(self.criterion, self.candidates, self.area, self.k)
    }

    /// Returns the value of each labelling of all patches with labels below `k`.
    pub(super) fn values(&self, labellings: &[Vec<u32>], k: usize) -> Vec<f64> {
        labellings
            .iter()
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

    /// Returns, for each labelling, the mean normalised mutual information with the candidates.
    /// Patches are weighted by area.
    fn consensus(&self, labellings: &[Vec<u32>], k: usize) -> Vec<f64> {
        let (mine, theirs) = (
            self.indicator(labellings, k),
            self.indicator(&self.candidates, self.k),
        );
        let joint = mine.transpose() * &theirs;
        let entropy = |p: f64| if p > 0.0 { -p * p.ln() } else { 0.0 };
        let own = |m: &DMatrix<f64>, c: usize, k: usize| -> f64 {
            (0..k)
                .map(|l| entropy(m.column(c * k + l).norm_squared()))
                .sum()
        };
        let their_own: Vec<f64> = (0..self.candidates.len())
            .map(|c| own(&theirs, c, self.k))
            .collect();
        (0..labellings.len())
            .map(|a| {
                let my_own = own(&mine, a, k);
                let agreement = |b: usize| {
                    let block = joint.view((a * k, b * self.k), (k, self.k));
                    let both: f64 = block.iter().map(|p| entropy(*p)).sum();
                    (my_own + their_own[b] - both) / (my_own * their_own[b]).sqrt().max(1e-9)
                };
                (0..self.candidates.len())
                    .map(|b| self.weights[b] * agreement(b))
                    .sum()
            })
            .collect()
    }

    /// Returns a matrix whose column `c k + l` has the square roots of the area shares of the
    /// patches with label l in labelling c.
    fn indicator(&self, labellings: &[Vec<u32>], k: usize) -> DMatrix<f64> {
        let total: f64 = self.area.iter().sum();
        let mut indicator = DMatrix::zeros(self.area.len(), labellings.len() * k);
        for (c, labels) in labellings.iter().enumerate() {
            for (p, l) in labels.iter().enumerate() {
                indicator[(p, c * k + *l as usize)] = (self.area[p] / total).sqrt();
            }
        }
        indicator
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
