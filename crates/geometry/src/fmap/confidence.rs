//! Predicts the share of labels that a map transfers correctly, as a whole and at each vertex, and
//! the vertices without counterpart.
//!
//! The prediction is logistic in the logarithms of two figures, both squared differences of
//! descriptors: the residual, between a vertex and its match, and the return, between a vertex and
//! the match of its match. The return is large where many vertices crowd onto one, and reliable
//! where left and right are mixed. The weights are fitted to the maps between all pairs of twenty
//! shapes of ten classes with known labels; each class was predicted from the other nine to measure
//! the accuracy of the prediction.

use super::quality::Quality;

/// Weights of a map: constant, ln residual, orthogonality, coverage, ln return.
pub const OF_MAP: [f64; 5] = [0.783, 0.027, 0.481, 1.070, -1.294];
/// Weights of a vertex: those of its map, then ln residual and ln return at the vertex.
const OF_VERTEX: [f64; 7] = [0.585, 0.517, 0.444, 0.304, -1.104, -0.436, -0.175];
/// Weights for a missing counterpart: constant, ln residual and ln return around a vertex. They are
/// fitted to maps to whole shapes from shapes that lack a part.
const OF_NOTHING: [f64; 3] = [-4.32, 1.14, 0.46];
/// Probability from which a vertex counts as without counterpart.
const NOTHING_FROM: f64 = 0.4;
/// Rounds of averaging over the faces around a vertex, before its counterpart is judged.
const N_SMOOTHED: usize = 4;
/// Offsets that are added before taking logarithms, for a map, a vertex and its surroundings.
const LEAST: [f64; 3] = [1e-3, 0.02, 0.01];
/// Steps to which the confidence of a vertex is rounded, so that the stored value equals the value
/// in use.
const STEPS: f64 = 254.0;

/// The figures from which the confidence of a map is predicted, the first of them 1.
pub fn figures(quality: &Quality) -> [f64; 5] {
    [
        1.0,
        (quality.descriptor_residual + LEAST[0]).ln(),
        quality.orthogonality,
        quality.coverage,
        (quality.descriptor_return + LEAST[0]).ln(),
    ]
}

/// Share of the area on which labels that the map transfers are expected to be right, 0 to 1.
pub fn of_map(quality: &Quality) -> f64 {
    logistic(&OF_MAP, &figures(quality))
}

/// The confidence of a map at each vertex of shape 2.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Confidence {
    /// 0: no counterpart; else 1 + 254 times the probability that a transferred label is right.
    pub of_vertex: Vec<u8>,
}

impl Confidence {
    /// The same confidence at each of `n` vertices.
    pub fn everywhere(probability: f64, n: usize) -> Self {
        Self {
            of_vertex: vec![1 + (STEPS * probability).round() as u8; n],
        }
    }

    /// Predicts the confidence from the squared descriptor differences `residuals (n2,)` and
    /// `returns (n2,)` of a map to the shape with these faces.
    pub fn new(quality: &Quality, faces: &[[u32; 3]], residuals: &[f32], returns: &[f32]) -> Self {
        let of_map = figures(quality);
        let around = (
            smoothed(faces, residuals, N_SMOOTHED),
            smoothed(faces, returns, N_SMOOTHED),
        );
        let mut x = [0.0; 7];
        x[..5].copy_from_slice(&of_map);
        let of_vertex = (0..residuals.len()).map(|v| {
            let log = |value: f32, least: f64| (f64::from(value) + least).ln();
            let near = [1.0, log(around.0[v], LEAST[2]), log(around.1[v], LEAST[2])];
            if logistic(&OF_NOTHING, &near) >= NOTHING_FROM {
                return 0;
            }
            x[5] = log(residuals[v], LEAST[1]);
            x[6] = log(returns[v], LEAST[1]);
            1 + (STEPS * logistic(&OF_VERTEX, &x)).round() as u8
        });
        Self {
            of_vertex: of_vertex.collect(),
        }
    }

    /// The same confidence everywhere, for when only that of the whole map is known; clamped to 0
    /// to 1.
    ///
    /// ```
    /// use coseg_geometry::fmap::Confidence;
    ///
    /// assert_eq!(Confidence::uniform(1.0, 2).of_vertex, [255, 255]);
    /// ```
    pub fn uniform(confidence: f64, n: usize) -> Self {
        let step = 1 + (STEPS * confidence.clamp(0.0, 1.0)).round() as u8;
        Self {
            of_vertex: vec![step; n],
        }
    }

    /// Whether a vertex has a counterpart.
    pub fn is_matched(&self, vertex: usize) -> bool {
        self.of_vertex[vertex] > 0
    }

    /// Probability that a label transferred to a vertex is right; `None` without counterpart.
    ///
    /// ```
    /// use coseg_geometry::fmap::Confidence;
    ///
    /// let confidence = Confidence { of_vertex: vec![0, 1, 255] };
    /// assert_eq!([0, 1, 2].map(|v| confidence.at(v)), [None, Some(0.0), Some(1.0)]);
    /// assert!(!confidence.is_matched(0));
    /// ```
    ///
    /// # Panics
    /// If the vertex does not exist.
    pub fn at(&self, vertex: usize) -> Option<f64> {
        let step = self.of_vertex[vertex];
        (step > 0).then(|| f64::from(step - 1) / STEPS)
    }

    /// Share of the mass `(n2,)` that has a counterpart, 0 to 1.
    ///
    /// ```
    /// use coseg_geometry::fmap::Confidence;
    ///
    /// let confidence = Confidence { of_vertex: vec![0, 200] };
    /// assert_eq!(confidence.matched_share(&[0.25, 0.75]), 0.75);
    /// ```
    pub fn matched_share(&self, mass: &[f32]) -> f64 {
        let of = |matched: bool| -> f64 {
            let rows = mass.iter().zip(&self.of_vertex);
            rows.map(|(m, c)| {
                if matched && *c == 0 {
                    0.0
                } else {
                    f64::from(*m)
                }
            })
            .sum()
        };
        of(true) / of(false).max(1e-300)
    }
}

/// Replaces values by the means, over the faces around each vertex, of the means of their corners,
/// `rounds` times. Vertices without faces keep their value.
pub fn smoothed(faces: &[[u32; 3]], values: &[f32], rounds: usize) -> Vec<f32> {
    let mut values = values.to_vec();
    let mut count = vec![0u32; values.len()];
    faces.iter().flatten().for_each(|v| count[*v as usize] += 1);
    for _ in 0..rounds {
        let mut sum = vec![0.0f32; values.len()];
        for face in faces {
            let mean = face.iter().map(|v| values[*v as usize]).sum::<f32>() / 3.0;
            face.iter().for_each(|v| sum[*v as usize] += mean);
        }
        for ((value, sum), n) in values.iter_mut().zip(sum).zip(&count) {
            if *n > 0 {
                *value = sum / *n as f32;
            }
        }
    }
    values
}

/// The logistic function of a weighted sum.
pub fn logistic(weights: &[f64], x: &[f64]) -> f64 {
    let sum: f64 = weights.iter().zip(x).map(|(w, x)| w * x).sum();
    1.0 / (1.0 + (-sum).exp())
}

/// The weights with which [`logistic`] fits shares (0 to 1) with the largest likelihood; a small
/// ridge keeps them finite. Newton's method; O(rounds n d²).
pub fn fitted<const D: usize>(rows: &[([f64; D], f64)]) -> [f64; D] {
    const ROUNDS: usize = 25;
    const RIDGE: f64 = 1e-3;
    let mut weights = nalgebra::SVector::<f64, D>::zeros();
    for _ in 0..ROUNDS {
        let mut gradient = -weights * RIDGE;
        let mut curvature = nalgebra::SMatrix::<f64, D, D>::identity() * RIDGE;
        for (x, share) in rows {
            let p = logistic(weights.as_slice(), x);
            let x = nalgebra::SVector::<f64, D>::from_row_slice(x);
            gradient += x * (share - p);
            curvature += x * x.transpose() * (p * (1.0 - p));
        }
        let Some(inverse) = curvature.try_inverse() else {
            break;
        };
        weights += inverse * gradient;
    }
    std::array::from_fn(|i| weights[i])
}

#[cfg(test)]
mod tests {
    use super::{Confidence, fitted, logistic, smoothed};
    use crate::fmap::Quality;

    #[test]
    fn a_fit_finds_the_weights_that_made_the_shares() {
        let truth = [0.5, -1.5, 0.8];
        let rows: Vec<([f64; 3], f64)> = (0..200)
            .map(|i| {
                let x = [1.0, (i as f64 * 0.37).sin(), (i as f64 * 0.11).cos()];
                (x, logistic(&truth, &x))
            })
            .collect();
        for (w, t) in fitted(&rows).iter().zip(truth) {
            assert!((w - t).abs() < 1e-3, "{w} {t}");
        }
    }

    #[test]
    fn what_looks_like_nothing_there_is_not_matched() {
        let quality = Quality {
            descriptor_residual: 1.0,
            descriptor_return: 0.5,
            orthogonality: 0.5,
            coverage: 0.5,
            ..Quality::default()
        };
        let residuals = [0.1, 1.0, 5.0, 80.0];
        let c = Confidence::new(&quality, &[], &residuals, &[0.1, 0.5, 2.0, 40.0]);
        assert!(!c.is_matched(3) && c.at(3).is_none());
        assert!(c.at(0) > c.at(1) && c.at(1) > c.at(2));
        assert!((c.matched_share(&[0.4, 0.3, 0.2, 0.1]) - 0.9).abs() < 1e-6);
        let same = Confidence::uniform(0.5, 2);
        assert!((same.at(1).unwrap() - 0.5).abs() < 1e-9);
    }

    #[test]
    fn smoothing_keeps_a_constant_and_lone_vertices() {
        let faces = [[0, 1, 2], [0, 2, 3]];
        let x = smoothed(&faces, &[2.0, 2.0, 2.0, 2.0, 9.0], 3);
        assert_eq!(x, [2.0, 2.0, 2.0, 2.0, 9.0]);
    }
}
