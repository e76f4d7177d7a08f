//! Suggests the shape to label next: one from which labels would be propagated to many uncertain
//! shapes, and that shows labels which no labelled shape shows.

use super::collection::Collection;
use super::error::{LibraryError, Result};
use super::facade::Library;
use super::reason::Reason;
use super::rows::{damaged, from_json};
use super::types::{LabelId, PartInfo};
use crate::neighbors::SignatureMetric;
use std::collections::BTreeMap;

/// Maximum number of shapes that are compared with each other. From more, a sample is taken evenly
/// over the order of arrival.
const MAX_COMPARED: usize = 1_000;
/// Weight of a shape with certain labels, because certain labels may be wrong.
const LEAST_NEED: f64 = 0.1;

/// Share of the area that a label has on a shape, relative to its mean over all shapes, from which
/// on the shape shows it fully.
const SHOWN_FULLY: f64 = 0.5;

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
    /// facility location; Nemhauser, Wolsey and Fisher 1978), times the share of the collection's
    /// area whose label it or a training shape shows. Without training shapes it is the medoid.
    /// Compares at most a thousand signatures with each other.
    ///
    /// # Errors
    /// There is no such collection, or a person has labelled every shape of it.
    pub fn suggest(&self, collection: &str) -> Result<Suggestion> {
        let row = self.collection_row(collection)?;
        let id = row.id;
        let (shapes, metric, unclaimed) = self.with_collection(row, |collection| {
            let shapes = collection.shapes().to_vec();
            let n_descriptors = shapes.first().map_or(0, |s| s.signature.len() / 4);
            let model = collection.label_model();
            let metric = model.map(|m| SignatureMetric::new(&m.normalisation, n_descriptors));
            Ok((shapes, metric, unclaimed(collection)))
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
        let (rows, uses) = self.store.catalog().read(|r| -> Result<_> {
            let rows = open
                .iter()
                .map(|s| Ok((r.shape(s.id)?, r.area_shares(s.id)?)));
            Ok((rows.collect::<Result<Vec<_>>>()?, r.label_uses(id)?))
        })?;
        let unclaimed = Unclaimed::new(&unclaimed, &uses, shapes.len());
        let (mut names, mut uncertainty) = (Vec::with_capacity(n), Vec::with_capacity(n));
        let mut shown = Vec::with_capacity(n);
        for (row, labels) in rows {
            shown.push(unclaimed.shown_with(&labels));
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
            .map(|c| shown[c] * (0..n).map(|t| need(t) * nearer(c, t)).sum::<f64>())
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

/// Returns the labels that are kept because no training shape shows them; none before there is a
/// training shape.
fn unclaimed(collection: &Collection) -> Vec<LabelId> {
    let supervision = collection.state().regime.supervision();
    supervision.map_or_else(Vec::new, |s| s.discovered().kept.clone())
}

/// Unclaimed labels.
struct Unclaimed {
    /// Each label with its mean share of a shape's area.
    labels: BTreeMap<LabelId, f64>,
}

impl Unclaimed {
    fn new(labels: &[LabelId], uses: &BTreeMap<LabelId, (u64, f64)>, n_shapes: usize) -> Self {
        let mean = |label: &LabelId| Some((*label, uses.get(label)?.1 / n_shapes.max(1) as f64));
        Self {
            labels: labels.iter().filter_map(mean).collect(),
        }
    }

    /// Returns the share of the collection's area whose label a training shape would show if one
    /// with these labels, each with its area share, became one.
    fn shown_with(&self, labels: &[(LabelId, f64)]) -> f64 {
        let hidden = self.labels.iter().map(|(label, mean)| {
            let here = labels.iter().find(|(l, _)| l == label).map_or(0.0, |l| l.1);
            mean * (1.0 - here / (SHOWN_FULLY * mean).max(1e-12)).max(0.0)
        });
        1.0 - hidden.sum::<f64>()
    }
}

#[cfg(test)]
mod tests {
    use super::Unclaimed;
    use std::collections::BTreeMap;

    #[test]
    fn a_shape_that_shows_more_labels_shows_more_of_the_area() {
        let uses = BTreeMap::from([(1, (4, 2.0)), (2, (2, 0.4)), (3, (4, 1.6))]);
        // Label 3 is claimed: its 0.4 of the area is shown in any case.
        let unclaimed = Unclaimed::new(&[1, 2, 9], &uses, 4);
        let shown = |labels: &[(u32, f64)]| unclaimed.shown_with(labels);
        assert!((shown(&[(3, 1.0)]) - 0.4).abs() < 1e-12);
        assert!((shown(&[(1, 0.5), (3, 0.5)]) - 0.9).abs() < 1e-12);
        assert!((shown(&[(1, 0.9), (2, 0.1)]) - 1.0).abs() < 1e-12);
        // A trace of a label shows little of it.
        assert!((shown(&[(1, 0.95), (2, 0.025)]) - 0.95).abs() < 1e-12);
        assert!((Unclaimed::new(&[], &uses, 4).shown_with(&[]) - 1.0).abs() < 1e-12);
    }
}
