//! Suggests the shape to label next: one from which labels would be propagated to many uncertain
//! shapes.

use super::error::{LibraryError, Result};
use super::facade::Library;
use super::reason::Reason;
use super::rows::{damaged, from_json};
use super::types::PartInfo;
use crate::neighbors::SignatureMetric;

/// Maximum number of shapes that are compared with each other. From more, a sample is taken evenly
/// over the order of arrival.
const MAX_COMPARED: usize = 1_000;
/// Weight of a shape with certain labels, because certain labels may be wrong.
const LEAST_NEED: f64 = 0.1;

/// The shape whose labelling by a person would help most.
#[derive(Debug, Clone, PartialEq)]
pub struct Suggestion {
    /// Its name.
    pub shape: String,
    /// Expected gain, relative to that of the other shapes; 1 is the mean.
    pub gain: f64,
    /// Share of its area whose label is uncertain.
    pub uncertainty: f64,
    /// Number of shapes to which it would be nearer than any training shape.
    pub n_nearest: u64,
    /// The reason, for people.
    pub reason: String,
    /// Number of shapes that a person labelled.
    pub n_corrected: u64,
}

impl Library {
    /// Returns the shape whose labelling by a person would help most: the one that brings the other
    /// shapes, each weighted by the uncertainty of its labels, nearest to a training shape (greedy
    /// facility location; Nemhauser, Wolsey and Fisher 1978). Without training shapes it is the
    /// medoid. Compares at most a thousand signatures with each other.
    ///
    /// # Errors
    /// There is no such collection, or a person has labelled every shape of it.
    pub fn suggest(&self, collection: &str) -> Result<Suggestion> {
        let row = self.collection_row(collection)?;
        let (shapes, metric) = self.with_collection(row, |collection| {
            let shapes = collection.shapes().to_vec();
            let n_descriptors = shapes.first().map_or(0, |s| s.signature.len() / 4);
            let model = collection.label_model();
            let metric = model.map(|m| SignatureMetric::new(&m.normalisation, n_descriptors));
            Ok((shapes, metric))
        })?;
        let corrected = || shapes.iter().filter(|s| s.pinned);
        let n_corrected = corrected().count();
        let open: Vec<_> = shapes.iter().filter(|s| !s.pinned).collect();
        let (Some(metric), false) = (metric, open.is_empty()) else {
            return Err(LibraryError::FailedPrecondition {
                reason: Reason::NothingToSuggest,
                message: format!(
                    "collection {collection:?} has {} shapes, and a person labelled \
                     {n_corrected} of them",
                    shapes.len()
                ),
            });
        };
        let n = open.len().min(MAX_COMPARED);
        let open: Vec<_> = (0..n).map(|i| open[i * open.len() / n]).collect();
        let rows = self.store.catalog().read(|r| -> Result<Vec<_>> {
            let rows = open.iter().map(|s| Ok(r.shape(s.id)?));
            rows.collect()
        })?;
        let (mut names, mut uncertainty) = (Vec::with_capacity(n), Vec::with_capacity(n));
        for row in rows {
            let row = row.ok_or_else(|| damaged("shapes", "a row is gone"))?;
            let parts: Vec<PartInfo> = from_json(&row.parts_json, &format!("shapes {}", row.name))?;
            let certain: f64 = parts.iter().map(|p| p.area_share * p.confidence).sum();
            uncertainty.push((1.0 - certain).clamp(0.0, 1.0));
            names.push(row.name);
        }
        let distance = |a: usize, b: usize| metric.distance(&open[a].signature, &open[b].signature);
        let mut pairs = vec![0.0; n * n];
        for a in 0..n {
            for b in 0..a {
                let d = distance(a, b);
                (pairs[a * n + b], pairs[b * n + a]) = (d, d);
            }
        }
        let farthest = pairs.iter().copied().fold(0.0, f64::max);
        let to_training: Vec<f64> = open
            .iter()
            .map(|s| {
                let all = corrected().map(|e| metric.distance(&s.signature, &e.signature));
                all.fold(farthest, f64::min)
            })
            .collect();
        let need = |t: usize| uncertainty[t].max(LEAST_NEED);
        let nearer = |c: usize, t: usize| (to_training[t] - pairs[c * n + t]).max(0.0);
        let gains: Vec<f64> = (0..n)
            .map(|c| (0..n).map(|t| need(t) * nearer(c, t)).sum())
            .collect();
        let best = (0..n).max_by(|&a, &b| gains[a].total_cmp(&gains[b]).then(b.cmp(&a)));
        let best = best.unwrap_or(0);
        let n_nearest = (0..n).filter(|t| nearer(best, *t) > 0.0).count();
        let mean = gains.iter().sum::<f64>() / n as f64;
        let percent = uncertainty[best] * 100.0;
        let reason = if n_corrected == 0 {
            "nothing is labelled by hand yet, and it is the most central shape".to_owned()
        } else {
            format!(
                "it is nearer to {n_nearest} of {n} shapes than any labelled by hand, and \
                 {percent:.0} % of its own area is uncertain"
            )
        };
        Ok(Suggestion {
            shape: names.swap_remove(best),
            gain: if mean > 0.0 { gains[best] / mean } else { 1.0 },
            uncertainty: uncertainty[best],
            n_nearest: n_nearest as u64,
            reason,
            n_corrected: n_corrected as u64,
        })
    }
}
