//! Encodes the model of a collection as one safetensors buffer for the catalog, and decodes it.

use crate::labels::{LabelModel, Normalisation, PriorLabels, Statistics};
use safetensors::tensor::{Dtype, SafeTensors, TensorView, serialize};
use std::collections::HashMap;

/// The label model in two states: with all shapes added so far, and as it was when its epoch began.
///
/// New shapes are labelled by `model`. Stored shapes that an accepted re-clustering made stale are
/// labelled by `base`, so that the result does not depend on the time.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::library) struct ModelState {
    pub(in crate::library) model: LabelModel,
    pub(in crate::library) base: Statistics,
    /// The labels that were discovered before a person labelled anything, where they are evidence.
    pub(in crate::library) prior: Option<PriorLabels>,
}

impl ModelState {
    /// Begins an epoch with a model.
    pub(in crate::library) fn begin(model: LabelModel) -> Self {
        Self {
            base: model.statistics.clone(),
            model,
            prior: None,
        }
    }

    /// Returns the model as it was when the epoch began.
    pub(in crate::library) fn base_model(&self) -> LabelModel {
        LabelModel {
            statistics: self.base.clone(),
            ..self.model.clone()
        }
    }

    /// Encodes the model.
    pub(in crate::library) fn encode(&self) -> Vec<u8> {
        let m = &self.model;
        let dim = m.normalisation.mean.len();
        let k = m.labels.len();
        let labels: Vec<f64> = m.labels.iter().map(|l| f64::from(*l)).collect();
        let up = m.up.map_or(Vec::new(), |u| u.to_vec());
        let triangles = [
            triangle(&m.statistics.moment, dim),
            triangle(&self.base.moment, dim),
        ];
        let mut arrays: Vec<(&str, Vec<usize>, &[f64])> = vec![
            ("labels", vec![k], &labels),
            ("mean", vec![dim], &m.normalisation.mean),
            ("deviation", vec![dim], &m.normalisation.deviation),
            ("up", vec![up.len()], &up),
            ("counts", vec![k], &m.statistics.counts),
            ("sums", vec![k, dim], &m.statistics.sums),
            ("moment", vec![triangles[0].len()], &triangles[0]),
            ("base_counts", vec![k], &self.base.counts),
            ("base_sums", vec![k, dim], &self.base.sums),
            ("base_moment", vec![triangles[1].len()], &triangles[1]),
        ];
        let prior = self.prior.as_ref();
        let of_prior = prior.map(|p| (p, triangle(&p.statistics.moment, dim), [p.agreement]));
        if let Some((prior, moment, agreement)) = &of_prior {
            let n = prior.statistics.counts.len();
            arrays.extend([
                ("prior_counts", vec![n], &prior.statistics.counts[..]),
                ("prior_sums", vec![n, dim], &prior.statistics.sums),
                ("prior_moment", vec![moment.len()], moment),
                ("prior_meaning", vec![n, k], &prior.meaning),
                ("prior_agreement", vec![1], agreement),
            ]);
        }
        let bytes: Vec<Vec<u8>> = arrays
            .iter()
            .map(|a| a.2.iter().flat_map(|x| x.to_le_bytes()).collect())
            .collect();
        let views = arrays.iter().zip(&bytes).map(|((name, shape, _), bytes)| {
            let view = TensorView::new(Dtype::F64, shape.clone(), bytes);
            (*name, view.expect("invariant: eight bytes a value"))
        });
        let epoch = HashMap::from([("epoch".to_string(), m.epoch.to_string())]);
        serialize(views, Some(epoch)).expect("invariant: names are unique and metadata is text")
    }

    /// Decodes a value that [`ModelState::encode`] encoded. The error names the fault of the bytes.
    pub(in crate::library) fn decode(bytes: &[u8]) -> Result<Self, String> {
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(|e| e.to_string())?;
        let tensors = SafeTensors::deserialize(bytes).map_err(|e| e.to_string())?;
        let epoch = header
            .metadata()
            .as_ref()
            .and_then(|m| m.get("epoch"))
            .and_then(|e| e.parse().ok());
        let epoch = epoch.ok_or("label model without an epoch")?;
        let values = |name: &str| -> Result<Vec<f64>, String> {
            let t = tensors.tensor(name).map_err(|e| e.to_string())?;
            let (chunks, rest) = t.data().as_chunks::<8>();
            if t.dtype() != Dtype::F64 || !rest.is_empty() {
                return Err(format!("label model: {name} is {:?}, not f64", t.dtype()));
            }
            Ok(chunks.iter().map(|c| f64::from_le_bytes(*c)).collect())
        };
        let (mean, deviation, labels) = (values("mean")?, values("deviation")?, values("labels")?);
        let (dim, k) = (mean.len(), labels.len());
        let statistics = |prefix: &str, k: usize| -> Result<Statistics, String> {
            let [counts, sums, moment] =
                ["counts", "sums", "moment"].map(|n| values(&format!("{prefix}{n}")));
            let (counts, sums, moment) = (counts?, sums?, moment?);
            if counts.len() != k || sums.len() != k * dim || moment.len() != dim * (dim + 1) / 2 {
                return Err(format!(
                    "label model: statistics do not fit {k} labels of {dim} columns"
                ));
            }
            Ok(Statistics {
                counts,
                sums,
                moment: square(&moment, dim),
            })
        };
        if deviation.len() != dim {
            return Err(format!(
                "label model: {} deviations for {dim} columns",
                deviation.len()
            ));
        }
        let prior = match tensors.names().contains(&"prior_meaning") {
            true => {
                let (meaning, agreement) = (values("prior_meaning")?, values("prior_agreement")?);
                let n = meaning.len() / k.max(1);
                let ([agreement], true) = (&agreement[..], meaning.len() == n * k) else {
                    return Err(format!(
                        "label model: the discovered labels do not fit {k} labels"
                    ));
                };
                Some(PriorLabels {
                    statistics: statistics("prior_", n)?,
                    agreement: *agreement,
                    meaning,
                })
            }
            false => None,
        };
        let up = <[f64; 3]>::try_from(values("up")?).ok();
        let normalisation = Normalisation {
            mean,
            deviation,
            up_known: up.is_some(),
        };
        let labels = labels.into_iter().map(|l| l as u32).collect();
        let model = LabelModel {
            epoch,
            labels,
            normalisation,
            statistics: statistics("", k)?,
            up,
        };
        Ok(Self {
            model,
            base: statistics("base_", k)?,
            prior,
        })
    }
}

/// Returns the lower triangle, row by row.
fn triangle(square: &[f64], dim: usize) -> Vec<f64> {
    (0..dim)
        .flat_map(|i| square[i * dim..=i * dim + i].iter().copied())
        .collect()
}

fn square(triangle: &[f64], dim: usize) -> Vec<f64> {
    let mut out = vec![0.0; dim * dim];
    let mut values = triangle.iter();
    for i in 0..dim {
        for (j, v) in (0..=i).zip(&mut values) {
            out[i * dim + j] = *v;
            out[j * dim + i] = *v;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> ModelState {
        let dim = 4;
        let prior = PriorLabels {
            statistics: Statistics::empty(3, dim),
            meaning: vec![0.5, 0.5, 0.25, 0.75, 1.0, 0.0],
            agreement: 0.875,
        };
        let statistics = Statistics {
            counts: vec![0.25, 0.75],
            sums: (0..8).map(f64::from).collect(),
            moment: (0..16).map(|i| f64::from((i / 4) * (i % 4))).collect(),
        };
        let normalisation = Normalisation {
            mean: vec![0.5; dim],
            deviation: vec![2.0; dim],
            up_known: true,
        };
        let up = Some([0.0, 1.0, 0.0]);
        let model = LabelModel {
            epoch: 7,
            labels: vec![3, 1],
            normalisation,
            statistics,
            up,
        };
        ModelState {
            prior: Some(prior),
            ..ModelState::begin(model)
        }
    }

    #[test]
    fn reads_back_what_was_written() {
        let state = sample();
        let discovered = ModelState::begin(state.model.clone());
        for state in [state, discovered] {
            assert_eq!(ModelState::decode(&state.encode()), Ok(state));
        }
    }

    #[test]
    fn damage_is_an_error() {
        let bytes = sample().encode();
        for n in 0..bytes.len() {
            assert!(ModelState::decode(&bytes[..n]).is_err(), "cut to {n} bytes");
        }
    }
}
