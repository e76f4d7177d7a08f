//! The label model of a collection: linear discriminant analysis on face descriptors, stored as
//! sufficient statistics, so that a shape can be added or removed exactly.

use super::{Features, Normalisation};
use nalgebra::{Cholesky, DMatrix};

/// Share of the mean variance that is mixed into the pooled covariance.
const SHRINKAGE: f64 = 0.02;

/// Counts, sums and second moments of labelled faces, each weighted by its share of its shape's
/// area.
#[derive(Debug, Clone, PartialEq)]
pub struct Statistics {
    /// Area of each label `(k,)`.
    pub counts: Vec<f64>,
    /// Sum of descriptors of each label `(k, dim)`.
    pub sums: Vec<f64>,
    /// Sum of outer products over all labels `(dim, dim)`, symmetric.
    pub moment: Vec<f64>,
}

impl Statistics {
    /// Statistics without any face.
    pub fn empty(k: usize, dim: usize) -> Self {
        Self {
            counts: vec![0.0; k],
            sums: vec![0.0; k * dim],
            moment: vec![0.0; dim * dim],
        }
    }

    /// Computes statistics of one labelled shape. Faces whose label is `None` do not count.
    pub fn of_shape(
        features: &Features,
        area: &[f64],
        labels: impl Fn(usize) -> Option<u32>,
        k: usize,
    ) -> Self {
        let dim = features.dim;
        let mut s = Self::empty(k, dim);
        let mut weighted = DMatrix::<f64>::zeros(dim, area.len());
        for (f, row) in features.data.chunks_exact(dim).enumerate() {
            let Some(label) = labels(f).map(|l| l as usize) else {
                continue;
            };
            s.counts[label] += area[f];
            let root = area[f].sqrt();
            for (c, &x) in row.iter().enumerate() {
                s.sums[label * dim + c] += area[f] * f64::from(x);
                weighted[(c, f)] = root * f64::from(x);
            }
        }
        let moment = &weighted * weighted.transpose();
        s.moment.copy_from_slice(moment.as_slice());
        s
    }

    /// Adds `sign` times `other`.
    pub fn accumulate(&mut self, other: &Self, sign: f64) {
        let pairs = [
            (&mut self.counts, &other.counts),
            (&mut self.sums, &other.sums),
            (&mut self.moment, &other.moment),
        ];
        for (mine, theirs) in pairs {
            mine.iter_mut()
                .zip(theirs)
                .for_each(|(a, b)| *a += sign * b);
        }
    }

    /// Returns the scatter of the descriptors within labels `(dim, dim)`: the pooled covariance
    /// around the labels' means.
    pub fn scatter_within(&self) -> DMatrix<f64> {
        let mean = self.means();
        let dim = mean.ncols();
        let mut within = DMatrix::from_column_slice(dim, dim, &self.moment);
        let scaled = DMatrix::from_fn(mean.nrows(), dim, |l, c| mean[(l, c)] * self.counts[l]);
        within -= scaled.transpose() * &mean;
        within / self.total().max(1e-300)
    }

    /// Returns the same counts and means, with `share` of the scatter within labels replaced by
    /// `other`.
    pub fn with_scatter(&self, other: &DMatrix<f64>, share: f64) -> Self {
        let weight = share * self.total();
        let difference = (other - self.scatter_within()) * weight;
        let mut mixed = self.clone();
        mixed
            .moment
            .iter_mut()
            .zip(difference.iter())
            .for_each(|(m, d)| *m += d);
        mixed
    }

    /// Translates the statistics to `n` other labels. Each label stands for them with the
    /// probabilities `meaning (k, n)`, row-major, whose rows sum to one.
    pub(super) fn translated(&self, meaning: &[f64], n: usize) -> Self {
        let dim = self.sums.len() / self.counts.len().max(1);
        let mut out = Self {
            moment: self.moment.clone(),
            ..Self::empty(n, dim)
        };
        for (row, (count, sums)) in meaning
            .chunks_exact(n)
            .zip(self.counts.iter().zip(self.sums.chunks_exact(dim)))
        {
            for (label, p) in row.iter().enumerate() {
                out.counts[label] += p * count;
                let into = &mut out.sums[label * dim..(label + 1) * dim];
                into.iter_mut().zip(sums).for_each(|(s, x)| *s += p * x);
            }
        }
        out
    }

    /// Returns the area of all labels.
    pub fn total(&self) -> f64 {
        self.counts.iter().sum()
    }

    /// Returns the mean descriptors of each label `(k, dim)`.
    fn means(&self) -> DMatrix<f64> {
        let k = self.counts.len();
        let dim = self.sums.len() / k.max(1);
        DMatrix::from_fn(k, dim, |l, c| {
            self.sums[l * dim + c] / self.counts[l].max(1e-12)
        })
    }

    /// Builds the linear classifier of these statistics: pooled covariance with shrinkage, priors
    /// by area.
    pub fn classifier(&self) -> Classifier {
        let mean = self.means();
        let (k, dim) = mean.shape();
        let total = self.total();
        let mut within = self.scatter_within();
        let ridge = SHRINKAGE * within.trace() / dim as f64;
        within *= 1.0 - SHRINKAGE;
        for c in 0..dim {
            within[(c, c)] += ridge.max(1e-9);
        }
        // Shrinkage makes the matrix positive definite, except for statistics without faces, whose
        // weights are zero.
        let weights = Cholesky::new(within).map_or_else(
            || DMatrix::zeros(dim, k),
            |factor| factor.solve(&mean.transpose()),
        );
        let bias = (0..k)
            .map(|l| {
                let half: f64 = (0..dim)
                    .map(|c| weights[(c, l)] * mean[(l, c)])
                    .sum::<f64>()
                    / 2.0;
                (self.counts[l] / total.max(1e-300)).max(1e-9).ln() - half
            })
            .collect();
        Classifier {
            weights: weights.as_slice().to_vec(),
            bias,
            dim,
        }
    }
}

/// A linear classifier of faces.
#[derive(Debug, Clone, PartialEq)]
pub struct Classifier {
    weights: Vec<f64>,
    bias: Vec<f64>,
    dim: usize,
}

impl Classifier {
    /// Divides the scores by `temperature`; above 1 the classifier becomes less certain.
    pub fn at_temperature(mut self, temperature: f64) -> Self {
        let scores = self.weights.iter_mut().chain(&mut self.bias);
        scores.for_each(|s| *s /= temperature);
        self
    }

    /// Returns the log-probability of each label for each face `(m, k)`, row-major.
    pub fn log_probabilities(&self, features: &Features) -> Vec<f64> {
        let k = self.bias.len();
        let mut out = Vec::with_capacity(features.data.len() / self.dim * k);
        for row in features.data.chunks_exact(self.dim) {
            let start = out.len();
            for (l, b) in self.bias.iter().enumerate() {
                let w = &self.weights[l * self.dim..(l + 1) * self.dim];
                out.push(
                    b + w
                        .iter()
                        .zip(row)
                        .map(|(w, x)| w * f64::from(*x))
                        .sum::<f64>(),
                );
            }
            let scores = &mut out[start..];
            let top = scores.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let log_sum = scores.iter().map(|s| (s - top).exp()).sum::<f64>().ln() + top;
            scores.iter_mut().for_each(|s| *s -= log_sum);
        }
        out
    }
}

/// The label model of a collection.
#[derive(Debug, Clone, PartialEq)]
pub struct LabelModel {
    /// Number of accepted re-clusterings. Statistics of different epochs must not be added.
    pub epoch: u64,
    /// Label id of each class `(k,)`.
    pub labels: Vec<u32>,
    /// Standardises descriptors in this epoch.
    pub normalisation: Normalisation,
    /// Sum over the shapes on which the model is based.
    pub statistics: Statistics,
    /// Unit vector of the up axis in input coordinates, if it is known.
    pub up: Option<[f64; 3]>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};

    fn blobs(seed: u64) -> (Features, Vec<f64>, Vec<u32>) {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
        let labels: Vec<u32> = (0..600).map(|i| i % 3).collect();
        let data = labels
            .iter()
            .flat_map(|l| {
                let noise: [f32; 2] = [rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0)];
                [*l as f32 * 3.0 + noise[0], noise[1] - *l as f32]
            })
            .collect();
        (Features { data, dim: 2 }, vec![1.0 / 600.0; 600], labels)
    }

    #[test]
    fn separable_labels_are_classified() {
        let (x, a, y) = blobs(1);
        let classifier = Statistics::of_shape(&x, &a, |f| Some(y[f]), 3).classifier();
        let p = classifier.log_probabilities(&x);
        let right = p
            .chunks(3)
            .zip(&y)
            .filter(|(p, y)| (0..3).all(|l| p[l] <= p[**y as usize]))
            .count();
        assert!(right > 590, "{right} of 600");
        assert!(
            p.chunks(3)
                .all(|p| (p.iter().map(|v| v.exp()).sum::<f64>() - 1.0).abs() < 1e-9)
        );
    }

    #[test]
    fn scatter_from_elsewhere_changes_the_scatter_alone() {
        let (x, a, y) = blobs(1);
        let one = Statistics::of_shape(&x, &a, |f| Some(y[f]), 3);
        let other = DMatrix::from_row_slice(2, 2, &[2.0, 0.5, 0.5, 1.0]);
        let mixed = one.with_scatter(&other, 0.25);
        assert_eq!((&mixed.counts, &mixed.sums), (&one.counts, &one.sums));
        let expected = one.scatter_within() * 0.75 + other * 0.25;
        assert!((mixed.scatter_within() - expected).norm() < 1e-12);
    }

    #[test]
    fn what_stands_for_other_labels_is_split_among_them() {
        let (x, a, y) = blobs(1);
        let three = Statistics::of_shape(&x, &a, |f| Some(y[f]), 3);
        let merged = Statistics::of_shape(&x, &a, |f| Some(y[f] / 2), 2);
        let difference = |a: &[f64], b: &[f64]| {
            let pairs = a.iter().zip(b);
            pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
        };
        let translated = three.translated(&[1.0, 0.0, 1.0, 0.0, 0.0, 1.0], 2);
        assert!(difference(&translated.counts, &merged.counts) < 1e-12);
        assert!(difference(&translated.sums, &merged.sums) < 1e-12);
        assert!(difference(&translated.moment, &merged.moment) < 1e-12);
        let halves = three.translated(&[0.5; 6], 2);
        assert!((halves.counts[0] - three.total() / 2.0).abs() < 1e-12);
    }

    #[test]
    fn a_high_temperature_makes_a_classifier_doubt() {
        let (x, a, y) = blobs(1);
        let sure = Statistics::of_shape(&x, &a, |f| Some(y[f]), 3).classifier();
        let cool = sure.log_probabilities(&x);
        let warm = sure.at_temperature(2.0).log_probabilities(&x);
        let most = |row: &[f64]| (0..3).max_by(|&a, &b| row[a].total_cmp(&row[b]));
        for (cool, warm) in cool.chunks(3).zip(warm.chunks(3)) {
            assert_eq!(most(cool), most(warm));
            let top = |row: &[f64]| row.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            assert!(top(warm) <= top(cool));
        }
    }

    #[test]
    fn taking_a_shape_away_undoes_adding_it() {
        let (x, a, y) = blobs(1);
        let (x2, a2, y2) = blobs(2);
        let one = Statistics::of_shape(&x, &a, |f| Some(y[f]), 3);
        let mut both = one.clone();
        let other = Statistics::of_shape(&x2, &a2, |f| (f % 2 == 0).then_some(y2[f]), 3);
        both.accumulate(&other, 1.0);
        both.accumulate(&other, -1.0);
        let same = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12);
        assert!(same(&both.counts, &one.counts) && same(&both.sums, &one.sums));
        assert!(same(&both.moment, &one.moment));
    }
}
