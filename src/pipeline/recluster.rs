//! A few representative shapes are labelled together: the start of a collection's labels, and their revision as
//! the collection grows.

use super::{DescriptionView, Labelling, Prepared};
use crate::labels::{
    Discovery, DiscoveryInput, DiscoveryOptions, Features, LabelModel, Normalisation, ShapeInput,
    Statistics, discover,
};
use crate::linalg::assignment::assignment;
use crate::segmentation::{PatchGraph, Surface};

/// A new labelling is taken only if its score is higher by this; so labels do not flicker.
pub const MIN_GAIN: f64 = 0.03;

/// A representative shape and the labels its faces carry now.
#[derive(Debug, Clone, Copy)]
pub struct Representative<'a> {
    /// Its arrays.
    pub shape: DescriptionView<'a>,
    /// Label id of each proxy face `(m,)`, ids of the old model; not read where there is none.
    pub labels: &'a [u32],
}

/// What re-clustering is asked for.
#[derive(Debug, Clone)]
pub struct ReclusterOptions {
    /// Number of labels and seed.
    pub discovery: DiscoveryOptions,
    /// The up axis, if known.
    pub up: Option<[f64; 3]>,
    /// Take the new labelling whatever its score: while a collection is too small to judge.
    pub always: bool,
    /// First label id that was never used.
    pub next_label: u32,
}

/// A label that was found to be part of another, or several.
#[derive(Debug, Clone, PartialEq)]
pub enum LabelChange {
    /// A label id came into being.
    Created(u32),
    /// `from` is retired and stands for `into`.
    Merged {
        /// The retired id.
        from: u32,
        /// The id that stands for both.
        into: u32,
    },
    /// Part of `from` is `into` now.
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
    /// Score of the labels as they were (negative infinity if there were none) and of the new ones.
    pub scores: (f64, f64),
    /// Whether the new labels were taken.
    pub accepted: bool,
    /// What happened to label ids.
    pub changes: Vec<LabelChange>,
    /// The model the representatives make with the labels they have now.
    pub model: LabelModel,
    /// Labelling of each representative under that model.
    pub labellings: Vec<Labelling>,
}

/// Clusters the parts of the representatives anew and decides whether that is better than what there is. In either
/// case the label model is made anew from the representatives, with descriptors standardised over them.
pub fn recluster(
    shapes: &[Representative<'_>],
    old: Option<&LabelModel>,
    epoch: u64,
    options: &ReclusterOptions,
) -> Reclustering {
    let raw: Vec<Features> = shapes
        .iter()
        .map(|s| Features::raw(&s.shape, options.up))
        .collect();
    let surfaces: Vec<Surface> = shapes
        .iter()
        .map(|s| Surface::new(&s.shape.mesh()))
        .collect();
    let normalisation = Normalisation::fit(
        raw.iter().zip(surfaces.iter().map(|s| s.area.as_slice())),
        options.up.is_some(),
    );
    let prepared: Vec<Prepared> = raw
        .iter()
        .zip(surfaces)
        .map(|(raw, surface)| Prepared {
            surface,
            features: normalisation.standardise(raw),
            at_vertices: Vec::new(),
        })
        .collect();
    let patches: Vec<PatchGraph> = prepared
        .iter()
        .zip(shapes)
        .map(|(p, s)| PatchGraph::new(&p.surface, s.shape.patches))
        .collect();
    let input = DiscoveryInput {
        shapes: prepared
            .iter()
            .zip(&patches)
            .map(|(p, patches)| ShapeInput {
                surface: &p.surface,
                patches,
                features: &p.features,
            })
            .collect(),
        up_known: options.up.is_some(),
    };
    let current = old.map(|model| current_classes(shapes, model));
    let there = current.as_deref().zip(old.map(|m| m.labels.len()));
    let found = discover(&input, &options.discovery, there);
    let (old_score, new_score) = (found.current_value, found.value);
    let accepted = options.always || new_score > old_score + MIN_GAIN;
    let (labels, classes, changes) = match (accepted, current, old) {
        (false, Some(classes), Some(model)) => (model.labels.clone(), classes, Vec::new()),
        (_, current, old) => rename(
            found,
            current.as_deref().zip(old),
            &prepared,
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
        normalisation,
        statistics,
        up: options.up,
    };
    let labellings = classes
        .into_iter()
        .zip(&prepared)
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

/// The classes of the old model that the representatives' labels are.
fn current_classes(shapes: &[Representative<'_>], model: &LabelModel) -> Vec<Vec<u32>> {
    let class_of = |label: &u32| model.labels.iter().position(|l| l == label).unwrap_or(0) as u32;
    shapes
        .iter()
        .map(|s| s.labels.iter().map(class_of).collect())
        .collect()
}

type Renamed = (Vec<u32>, Vec<Vec<u32>>, Vec<LabelChange>);

/// Gives the classes of a discovery the ids of the old labels they overlap most (one to one, by area); a class that
/// is left over becomes a new id, a label that is left over is merged into the one that took most of it.
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
