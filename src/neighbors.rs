//! Ranks the known shapes by their global descriptors, to select those that a new shape is compared
//! with.

use crate::labels::Normalisation;

/// Quantiles count half as much as means.
const QUANTILE_WEIGHT: f64 = 0.5;

/// The metric for signatures of a collection: a scale for each column of the face descriptors.
#[derive(Debug, Clone, PartialEq)]
pub struct SignatureMetric {
    scale: Vec<f64>,
}

impl SignatureMetric {
    /// The metric of a collection's normalisation over the first `n_descriptors` columns.
    pub fn new(normalisation: &Normalisation, n_descriptors: usize) -> Self {
        let mut scale = Vec::with_capacity(n_descriptors);
        for (_, width) in crate::descriptors::GROUPS {
            let group = 1.0 / (*width as f64).sqrt();
            let columns = &normalisation.deviation[scale.len()..scale.len() + width];
            scale.extend(columns.iter().map(|d| group / d.max(1e-6)));
        }
        Self { scale }
    }

    /// Distance of two signatures: standardised means and quantiles of the face descriptors.
    pub fn distance(&self, a: &[f32], b: &[f32]) -> f64 {
        let n = self.scale.len();
        let sum: f64 = (0..4 * n)
            .map(|i| {
                let weight = if i < n { 1.0 } else { QUANTILE_WEIGHT };
                let d = weight * self.scale[i % n] * f64::from(a[i] - b[i]);
                d * d
            })
            .sum();
        sum.sqrt()
    }

    /// The `limit` nearest of `known`, as (index, distance), nearest first; ties go to the lower
    /// index.
    pub fn nearest<'a>(
        &self,
        signature: &[f32],
        known: impl Iterator<Item = &'a [f32]>,
        limit: usize,
    ) -> Vec<(usize, f64)> {
        let mut ranked: Vec<(usize, f64)> = known
            .enumerate()
            .map(|(i, s)| (i, self.distance(signature, s)))
            .collect();
        ranked.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        ranked.truncate(limit);
        ranked
    }
}
