//! Labels that were discovered before a person labelled faces: what they mean in the person's
//! labels, and how well the two agree.

use super::cut::{STRENGTH, cut};
use super::{Features, Statistics};
use crate::segmentation::Surface;

/// Share of a shape's area that is added to the observed meaning of a label, spread over all
/// classes.
const UNSEEN_AREA: f64 = 0.05;

/// A shape with faces that a person labelled.
#[derive(Debug, Clone, Copy)]
pub struct Pinned<'a> {
    /// Its dual graph.
    pub surface: &'a Surface,
    /// Its standardised face descriptors.
    pub features: &'a Features,
    /// Class of each face `(m,)`; `None` where the person gave no label.
    pub classes: &'a [Option<u32>],
}

/// Discovered labels with their meaning in a person's classes.
#[derive(Debug, Clone, PartialEq)]
pub struct PriorLabels {
    /// Statistics of the `n` discovered labels, over the shapes that had them.
    pub statistics: Statistics,
    /// Probability of each of the person's classes for each discovered label `(n, k)`, row-major.
    pub meaning: Vec<f64>,
    /// Mean probability of the person's class under `meaning`, over the area that the person
    /// labelled: 0 to 1.
    pub agreement: f64,
}

impl PriorLabels {
    /// Estimates the meaning of the labels with these statistics in `k` classes, from the faces of
    /// some shapes that have both, by area. Costs a cut for each of the shapes.
    pub fn new<'a>(
        statistics: Statistics,
        pinned: impl Iterator<Item = Pinned<'a>>,
        k: usize,
    ) -> Self {
        let n = statistics.counts.len();
        let mut both = vec![0.0; n * k];
        for shape in pinned {
            let labels = most_likely(&statistics, shape.surface, shape.features);
            let faces = labels.iter().zip(shape.classes).zip(&shape.surface.area);
            for ((label, class), area) in faces {
                if let Some(class) = class {
                    both[*label as usize * k + *class as usize] += area;
                }
            }
        }
        let meaning = both.chunks_exact(k).flat_map(|row| {
            let total: f64 = row.iter().sum::<f64>() + UNSEEN_AREA;
            row.iter()
                .map(move |area| (area + UNSEEN_AREA / k as f64) / total)
        });
        let meaning: Vec<f64> = meaning.collect();
        let agreed: f64 = both.iter().zip(&meaning).map(|(area, p)| area * p).sum();
        Self {
            agreement: agreed / both.iter().sum::<f64>().max(1e-300),
            statistics,
            meaning,
        }
    }

    /// Returns the probability of each of the person's classes for each face `(m, k)`, row-major,
    /// by the discovered labels alone.
    pub fn probabilities(&self, surface: &Surface, features: &Features) -> Vec<f64> {
        let k = self.n_classes();
        let labels = most_likely(&self.statistics, surface, features);
        let row = |label: &u32| &self.meaning[*label as usize * k..(*label as usize + 1) * k];
        labels.iter().flat_map(row).copied().collect()
    }

    /// Translates the statistics of the discovered labels to the person's classes.
    pub fn translated(&self) -> Statistics {
        self.statistics.translated(&self.meaning, self.n_classes())
    }

    fn n_classes(&self) -> usize {
        self.meaning.len() / self.statistics.counts.len().max(1)
    }
}

/// Returns the discovered label of each face, by their classifier and a cut.
fn most_likely(statistics: &Statistics, surface: &Surface, features: &Features) -> Vec<u32> {
    let log = statistics.classifier().log_probabilities(features);
    let unary: Vec<f64> = log.iter().map(|p| -p).collect();
    cut(surface, &unary, statistics.counts.len(), STRENGTH, None)
}

#[cfg(test)]
mod tests {
    use super::super::test_shapes::Strips;
    use super::*;

    /// Returns strips with three parts and a discovered label for each, and the classes of a person
    /// on the first strip: 1 for the first two parts, 0 for the third, and none for half of the
    /// faces.
    fn seen() -> (Strips, Vec<Option<u32>>, Statistics) {
        let strips = Strips::new(4, 3, 0.3);
        let input = strips.input();
        let mut found = Statistics::empty(3, input.shapes[0].features.dim);
        for s in &input.shapes {
            let label = |f: usize| Some(strips.truth[f]);
            found.accumulate(
                &Statistics::of_shape(s.features, &s.surface.area, label, 3),
                1.0,
            );
        }
        let called = |(f, part): (usize, &u32)| (f % 2 == 0).then_some(u32::from(*part < 2));
        let classes = strips.truth.iter().enumerate().map(called).collect();
        (strips, classes, found)
    }

    #[test]
    fn labels_mean_what_a_person_calls_their_faces() {
        let (strips, classes, found) = seen();
        let input = strips.input();
        let shape = |classes| Pinned {
            surface: input.shapes[0].surface,
            features: input.shapes[0].features,
            classes,
        };
        let prior = PriorLabels::new(found.clone(), std::iter::once(shape(&classes)), 2);
        for (row, class) in prior.meaning.chunks(2).zip([1, 1, 0]) {
            assert!((row[0] + row[1] - 1.0).abs() < 1e-12);
            assert!(row[class] > 0.8, "{:?}", prior.meaning);
        }
        assert!(prior.agreement > 0.8, "{}", prior.agreement);
        let other = &input.shapes[1];
        let translated = prior.probabilities(other.surface, other.features);
        let right = translated.chunks(2).zip(&strips.truth);
        let right = right.filter(|(row, part)| row[usize::from(**part < 2)] > 0.5);
        assert_eq!(right.count(), strips.truth.len());
        // Classes that have nothing to do with the labels lead to low agreement.
        let at_random: Vec<Option<u32>> = (0..strips.truth.len())
            .map(|f| Some(f as u32 % 2))
            .collect();
        let prior = PriorLabels::new(found, std::iter::once(shape(&at_random)), 2);
        assert!((prior.agreement - 0.5).abs() < 0.05, "{}", prior.agreement);
    }

    #[test]
    fn labels_that_nobody_has_seen_may_mean_anything() {
        let (.., found) = seen();
        let prior = PriorLabels::new(found, std::iter::empty(), 2);
        assert_eq!(prior.meaning, [0.5; 6]);
        assert_eq!(prior.agreement, 0.0);
    }
}
