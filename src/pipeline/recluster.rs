//! Labels a few representative shapes together: at the start of a collection, and again as it
//! grows.

use super::{DescriptionView, Labelling, Prepared};
use crate::labels::{
    Baseline, Candidate, Discovery, DiscoveryInput, DiscoveryOptions, Features, LabelModel, Links,
    Normalisation, Proposal, ShapeInput, Statistics, baseline, candidates, discover, propose,
};
use crate::linalg::assignment::assignment;
use crate::segmentation::{PatchGraph, Surface};
use rayon::prelude::*;
use std::sync::Arc;

/// A representative shape and the current labels of its faces.
#[derive(Debug, Clone, Copy)]
pub struct Representative<'a> {
    /// Its arrays.
    pub shape: DescriptionView<'a>,
    /// Label id of each proxy face `(m,)`, ids of the old model; ignored without one.
    pub labels: &'a [u32],
}

/// Parameters of a re-clustering.
#[derive(Debug, Clone)]
pub struct ReclusterOptions {
    /// Number of labels and seed.
    pub discovery: DiscoveryOptions,
    /// The up axis, if known.
    pub up: Option<[f64; 3]>,
    /// A new labelling is accepted only if its value is higher by more than this. With negative
    /// infinity it is accepted whatever its value.
    pub min_gain: f64,
    /// The first label id that was never used.
    pub next_label: u32,
    /// Demands of a person that the new labels must meet.
    pub links: Links,
}

/// A change of label ids in a re-clustering.
#[derive(Debug, Clone, PartialEq)]
pub enum LabelChange {
    /// A label id was created.
    Created(u32),
    /// `from` was retired and stands for `into`.
    Merged {
        /// The retired id.
        from: u32,
        /// The id that stands for both.
        into: u32,
    },
    /// Part of `from` became `into`.
    Split {
        /// The id that keeps the larger share.
        from: u32,
        /// The new id.
        into: u32,
    },
}

/// The outcome of a re-clustering.
#[derive(Debug, Clone)]
pub struct Reclustering {
    /// Values of the current labels (negative infinity if there were none) and of the new ones.
    pub scores: (f64, f64),
    /// Whether the new labels were accepted.
    pub accepted: bool,
    /// Changes of label ids.
    pub changes: Vec<LabelChange>,
    /// The model that the representatives make with the accepted labels, or with the current ones.
    pub model: LabelModel,
    /// Labelling of each representative under that model.
    pub labellings: Vec<Labelling>,
}

/// Clusters the parts of the representatives again, and accepts the new labels if their value is
/// higher than that of the current ones. In either case the label model is rebuilt from the
/// representatives, with descriptors standardised over them.
pub fn recluster(
    shapes: &[Representative<'_>],
    old: Option<&LabelModel>,
    epoch: u64,
    options: &ReclusterOptions,
) -> Reclustering {
    let views: Vec<DescriptionView<'_>> = shapes.iter().map(|s| s.shape).collect();
    let together = Together::new(&views, options.up);
    let current = old.map(|model| current_classes(shapes, model));
    let current_input = current.as_deref().zip(old.map(|m| m.labels.len()));
    let input = DiscoveryInput {
        links: options.links.clone(),
        ..together.input()
    };
    let found = discover(&input, &options.discovery, current_input);
    relabelled(&together, found, current, old, epoch, options)
}

/// Makes a division of representatives the labels, whatever its value: `found` has the label of
/// each of their proxy faces. Label ids and model follow as in [`recluster`].
pub fn adopt(
    shapes: &[Representative<'_>],
    old: Option<&LabelModel>,
    epoch: u64,
    options: &ReclusterOptions,
    found: Proposal,
) -> Reclustering {
    let views: Vec<DescriptionView<'_>> = shapes.iter().map(|s| s.shape).collect();
    let together = Together::new(&views, options.up);
    let current = old.map(|model| current_classes(shapes, model));
    let mut found = Discovery {
        labels: found.labels,
        n_labels: found.n_labels,
        value: found.value,
        current_value: f64::NEG_INFINITY,
    };
    // With too few labels for the demands, the person's choice counts.
    if options.links.fewest_classes(found.n_labels).is_some() {
        let area = |shape: usize, face: u32| together.prepared[shape].surface.area[face as usize];
        options
            .links
            .repair(&mut found.labels, found.n_labels, area);
    }
    let options = ReclusterOptions {
        min_gain: f64::NEG_INFINITY,
        ..options.clone()
    };
    relabelled(&together, found, current, old, epoch, &options)
}

/// Returns the outcome of a re-clustering that found a labelling.
fn relabelled(
    together: &Together,
    found: Discovery,
    current: Option<Vec<Vec<u32>>>,
    old: Option<&LabelModel>,
    epoch: u64,
    options: &ReclusterOptions,
) -> Reclustering {
    let Together {
        normalisation,
        prepared,
        ..
    } = together;
    let (old_score, new_score) = (found.current_value, found.value);
    let accepted = new_score > old_score + options.min_gain;
    let (labels, classes, changes) = match (accepted, current, old) {
        (false, Some(classes), Some(model)) => (model.labels.clone(), classes, Vec::new()),
        (_, current, old) => rename(
            found,
            current.as_deref().zip(old),
            prepared,
            options.next_label,
        ),
    };
    let dim = normalisation.mean.len();
    let mut statistics = Statistics::empty(labels.len(), dim);
    for (p, classes) in prepared.iter().zip(&classes) {
        let class = |f: usize| Some(classes[f]);
        let of_shape = Statistics::of_shape(&p.features, &p.surface.area, class, labels.len());
        statistics.accumulate(&of_shape, 1.0);
    }
    let model = LabelModel {
        epoch,
        labels,
        normalisation: normalisation.clone(),
        statistics,
        up: options.up,
    };
    let labellings = classes
        .into_par_iter()
        .zip(prepared)
        .map(|(c, p)| Labelling::given(c, p, &model))
        .collect();
    Reclustering {
        scores: (old_score, new_score),
        accepted,
        changes,
        model,
        labellings,
    }
}

/// Shapes whose descriptors are standardised together.
struct Together {
    normalisation: Normalisation,
    prepared: Vec<Prepared>,
    patches: Vec<PatchGraph>,
}

impl Together {
    fn new(shapes: &[DescriptionView<'_>], up: Option<[f64; 3]>) -> Self {
        let raw: Vec<Features> = shapes.par_iter().map(|s| Features::raw(s, up)).collect();
        let surfaces: Vec<Surface> = shapes.par_iter().map(|s| Surface::new(&s.mesh())).collect();
        let normalisation = Normalisation::fit(
            raw.iter().zip(surfaces.iter().map(|s| s.area.as_slice())),
            up.is_some(),
        );
        let prepared: Vec<Prepared> = raw
            .par_iter()
            .zip(surfaces)
            .map(|(raw, surface)| Prepared {
                surface: Arc::new(surface),
                features: normalisation.standardise(raw),
                at_vertices: Vec::new(),
            })
            .collect();
        let patches = prepared
            .par_iter()
            .zip(shapes)
            .map(|(p, s)| PatchGraph::new(&p.surface, s.patches))
            .collect();
        Self {
            normalisation,
            prepared,
            patches,
        }
    }

    fn input(&self) -> DiscoveryInput<'_> {
        DiscoveryInput {
            shapes: self
                .prepared
                .iter()
                .zip(&self.patches)
                .map(|(p, patches)| ShapeInput {
                    surface: &p.surface,
                    patches,
                    features: &p.features,
                })
                .collect(),
            up_known: self.normalisation.up_known,
            links: Links::default(),
        }
    }
}

/// Returns labels of the proxy faces of shapes that are all known from the start, by discovery or
/// by a baseline.
pub fn batch(
    shapes: &[DescriptionView<'_>],
    n_labels: usize,
    up: Option<[f64; 3]>,
    by: Option<Baseline>,
) -> Vec<Vec<u32>> {
    let together = Together::new(shapes, up);
    let input = together.input();
    let options = DiscoveryOptions {
        n_labels: Some(n_labels),
        ..DiscoveryOptions::default()
    };
    match by {
        Some(which) => baseline(which, &input, n_labels, options.seed),
        None => discover(&input, &options, None).labels,
    }
}

/// Returns candidates for proposals with `k` labels on shapes that are all known.
pub fn proposal_candidates(
    shapes: &[DescriptionView<'_>],
    up: Option<[f64; 3]>,
    k: usize,
) -> Vec<Candidate> {
    let seed = DiscoveryOptions::default().seed;
    candidates(&Together::new(shapes, up).input(), k, seed)
}

/// Picks proposals among the candidates with all numbers of labels, which
/// [`proposal_candidates`] returned for the same shapes.
pub fn proposals(
    shapes: &[DescriptionView<'_>],
    up: Option<[f64; 3]>,
    candidates: &[Candidate],
) -> Vec<Proposal> {
    propose(&Together::new(shapes, up).input(), candidates)
}

/// Returns the classes of the old model that correspond to the representatives' labels.
fn current_classes(shapes: &[Representative<'_>], model: &LabelModel) -> Vec<Vec<u32>> {
    let class_of = |label: &u32| model.labels.iter().position(|l| l == label).unwrap_or(0) as u32;
    shapes
        .iter()
        .map(|s| s.labels.iter().map(class_of).collect())
        .collect()
}

type Renamed = (Vec<u32>, Vec<Vec<u32>>, Vec<LabelChange>);

/// Gives each class of a discovery the id of the old label that it overlaps most (one to one, by
/// area). A class without an old label gets a new id. An old label without a class is merged into
/// the one that took most of its area.
fn rename(
    found: Discovery,
    old: Option<(&[Vec<u32>], &LabelModel)>,
    prepared: &[Prepared],
    next_label: u32,
) -> Renamed {
    let k = found.n_labels;
    let Some((current, model)) = old else {
        let labels: Vec<u32> = (next_label..next_label + k as u32).collect();
        let changes = labels.iter().map(|l| LabelChange::Created(*l)).collect();
        return (labels, found.labels, changes);
    };
    let k_old = model.labels.len();
    let mut overlap = vec![0.0; k * k_old];
    for ((new, old), p) in found.labels.iter().zip(current).zip(prepared) {
        for (f, a) in p.surface.area.iter().enumerate() {
            overlap[new[f] as usize * k_old + old[f] as usize] += a;
        }
    }
    let cost: Vec<f64> = overlap.iter().map(|o| -o).collect();
    let matched = assignment(&cost, k, k_old);
    let (mut changes, mut labels, mut next) = (Vec::new(), Vec::with_capacity(k), next_label);
    for (class, old) in matched.iter().enumerate() {
        labels.push(match old {
            Some(old) => model.labels[*old],
            None => {
                let row = &overlap[class * k_old..(class + 1) * k_old];
                let from = (0..k_old)
                    .max_by(|&a, &b| row[a].total_cmp(&row[b]))
                    .unwrap_or(0);
                changes.push(LabelChange::Created(next));
                changes.push(LabelChange::Split {
                    from: model.labels[from],
                    into: next,
                });
                next += 1;
                next - 1
            }
        });
    }
    for old in (0..k_old).filter(|o| !matched.contains(&Some(*o))) {
        let into = (0..k)
            .max_by(|&a, &b| overlap[a * k_old + old].total_cmp(&overlap[b * k_old + old]))
            .unwrap_or(0);
        changes.push(LabelChange::Merged {
            from: model.labels[old],
            into: labels[into],
        });
    }
    (labels, found.labels, changes)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Builds one shape of a few faces of equal area.
    fn faces(n: usize) -> Vec<Prepared> {
        vec![Prepared {
            surface: Arc::new(Surface {
                area: vec![1.0 / n as f64; n],
                centroids: vec![[0.0; 3]; n],
                edges: Vec::new(),
            }),
            features: Features {
                data: Vec::new(),
                dim: 0,
            },
            at_vertices: Vec::new(),
        }]
    }

    /// Returns the label ids and changes after faces of the classes `current`, with ids 10, 11,
    /// ..., were found to be of the classes `found`.
    fn renamed(current: &[u32], found: &[u32]) -> (Vec<u32>, Vec<LabelChange>) {
        let n_classes = |classes: &[u32]| classes.iter().max().map_or(0, |c| *c as usize + 1);
        let model = LabelModel {
            epoch: 1,
            labels: (10..10 + n_classes(current) as u32).collect(),
            normalisation: Normalisation {
                mean: Vec::new(),
                deviation: Vec::new(),
                up_known: false,
            },
            statistics: Statistics::empty(n_classes(current), 0),
            up: None,
        };
        let discovery = Discovery {
            labels: vec![found.to_vec()],
            n_labels: n_classes(found),
            value: 0.0,
            current_value: 0.0,
        };
        let old = [current.to_vec()];
        let (labels, classes, changes) =
            rename(discovery, Some((&old, &model)), &faces(current.len()), 40);
        assert_eq!(classes, [found.to_vec()]);
        (labels, changes)
    }

    #[test]
    fn classes_take_the_ids_of_the_labels_they_overlap_most() {
        let (labels, changes) = renamed(&[0, 0, 0, 1, 1, 2], &[2, 2, 0, 0, 0, 1]);
        assert_eq!((labels, changes), (vec![11, 12, 10], Vec::new()));
    }

    #[test]
    fn a_label_that_is_two_parts_is_split_into_a_new_id() {
        let (labels, changes) = renamed(&[0, 0, 0, 1, 1], &[0, 0, 2, 1, 1]);
        assert_eq!(labels, [10, 11, 40]);
        let split = LabelChange::Split { from: 10, into: 40 };
        assert_eq!(changes, [LabelChange::Created(40), split]);
    }

    #[test]
    fn a_label_that_is_no_part_of_its_own_is_merged() {
        let (labels, changes) = renamed(&[0, 0, 0, 1, 1, 2], &[0, 0, 0, 1, 1, 1]);
        assert_eq!(labels, [10, 11]);
        assert_eq!(changes, [LabelChange::Merged { from: 12, into: 11 }]);
    }
}
