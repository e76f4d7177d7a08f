//! Labels that were discovered before a person labelled faces: which of them labelled faces show,
//! what these mean in the person's labels, and how well the two agree.

use super::cut::{STRENGTH, cut};
use super::{Features, Statistics};
use crate::segmentation::Surface;

/// Share of a shape's area that is added to the observed meaning of a label, spread over all
/// classes.
const UNSEEN_AREA: f64 = 0.05;

/// Share of the area that a discovered label covers on labelled shapes, relative to its mean over
/// all shapes, from which on labelled faces show it.
const SHOWN: f64 = 0.2;
/// Mean share of a shape's area below which a discovered label is too small to be kept.
const LEAST_KEPT: f64 = 0.02;

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

/// Faces that have both a discovered label and a person's.
#[derive(Debug, Clone, PartialEq)]
pub struct Overlap {
    /// Area of each class in each discovered label `(n, k)`, row-major; that of a shape is 1.
    area: Vec<f64>,
    /// Largest share of a shape's area that each discovered label has on labelled faces `(n,)`.
    most: Vec<f64>,
    n_classes: usize,
}

impl Overlap {
    /// Compares the labels with these statistics and the `k` classes of a person on some shapes.
    /// Costs a cut for each of the shapes.
    pub fn new<'a>(
        statistics: &Statistics,
        pinned: impl Iterator<Item = Pinned<'a>>,
        k: usize,
    ) -> Self {
        let n = statistics.counts.len();
        let (mut area, mut most) = (vec![0.0; n * k], vec![0.0_f64; n]);
        for shape in pinned {
            let labels = most_likely(statistics, shape.surface, shape.features);
            let faces = labels.iter().zip(shape.classes).zip(&shape.surface.area);
            let mut here = vec![0.0; n];
            for ((label, class), face_area) in faces {
                if let Some(class) = class {
                    area[*label as usize * k + *class as usize] += face_area;
                    here[*label as usize] += face_area;
                }
            }
            most.iter_mut().zip(&here).for_each(|(m, h)| *m = m.max(*h));
        }
        Self {
            area,
            most,
            n_classes: k,
        }
    }

    /// Returns which discovered labels no labelled face shows, of those that are large enough to be
    /// kept: indices into the labels with these statistics, over `n_shapes` shapes, ascending.
    pub fn not_shown(&self, statistics: &Statistics, n_shapes: usize) -> Vec<usize> {
        let mean = |label: usize| statistics.counts[label] / n_shapes.max(1) as f64;
        let is_kept = |label: &usize| {
            let mean = mean(*label);
            mean >= LEAST_KEPT && self.most[*label] < SHOWN * mean
        };
        (0..self.most.len()).filter(is_kept).collect()
    }
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
    /// Estimates the meaning of the labels with these statistics from the faces that have both. It
    /// is in `k` classes, those of the person first. Each label in `own` means the class beside it
    /// and nothing else.
    pub fn new(statistics: Statistics, both: &Overlap, own: &[(usize, u32)], k: usize) -> Self {
        let n_given = both.n_classes;
        let mut meaning = Vec::with_capacity(statistics.counts.len() * k);
        let mut agreed = 0.0;
        for (label, row) in both.area.chunks_exact(n_given.max(1)).enumerate() {
            let start = meaning.len();
            meaning.resize(start + k, 0.0);
            if let Some((_, class)) = own.iter().find(|(l, _)| *l == label) {
                meaning[start + *class as usize] = 1.0;
                continue;
            }
            let total: f64 = row.iter().sum::<f64>() + UNSEEN_AREA;
            for (class, area) in row.iter().enumerate() {
                let p = (area + UNSEEN_AREA / n_given as f64) / total;
                meaning[start + class] = p;
                agreed += area * p;
            }
        }
        Self {
            agreement: agreed / both.area.iter().sum::<f64>().max(1e-300),
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
        let of =
            |found: &Statistics, classes| Overlap::new(found, std::iter::once(shape(classes)), 2);
        let both = of(&found, &classes);
        let prior = PriorLabels::new(found.clone(), &both, &[], 2);
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
        let prior = PriorLabels::new(found.clone(), &of(&found, &at_random), &[], 2);
        assert!((prior.agreement - 0.5).abs() < 0.05, "{}", prior.agreement);
    }

    #[test]
    fn labels_that_nobody_has_seen_may_mean_anything() {
        let (.., found) = seen();
        let both = Overlap::new(&found, std::iter::empty(), 2);
        let prior = PriorLabels::new(found, &both, &[], 2);
        assert_eq!(prior.meaning, [0.5; 6]);
        assert_eq!(prior.agreement, 0.0);
    }

    #[test]
    fn a_label_that_no_labelled_face_shows_has_a_class_of_its_own() {
        let (strips, classes, found) = seen();
        let input = strips.input();
        // The person labels the first part alone.
        let first: Vec<Option<u32>> = classes
            .iter()
            .zip(&strips.truth)
            .map(|(_, part)| (*part == 0).then_some(0))
            .collect();
        let shape = Pinned {
            surface: input.shapes[0].surface,
            features: input.shapes[0].features,
            classes: &first,
        };
        let both = Overlap::new(&found, std::iter::once(shape), 1);
        let own = both.not_shown(&found, 4);
        assert_eq!(own, [1, 2]);
        let prior = PriorLabels::new(found.clone(), &both, &[(1, 1), (2, 2)], 3);
        assert_eq!(prior.meaning, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
        // Labels that are too small are not worth a class.
        assert_eq!(both.not_shown(&found, 4_000), [0_usize; 0]);
    }
}
