//! Shapes without labels become shapes with consistent labels: parts that recur, found together.
//!
//! The patches of each shape are merged into parts. The parts of all shapes are grouped in many
//! ways: by clustering of descriptors, and by spectral clustering of a joint graph after Sidi et
//! al. 2011, *Unsupervised Co-Segmentation of a Set of Shapes via Descriptor-Space Spectral
//! Clustering*. An unsupervised score, together with the consensus among good candidates, chooses
//! the labelling, which is then refined face by face.

use super::candidates::pool;
use super::criterion::Criterion;
use super::cut::cut;
use super::judge::Judge;
use super::links::{LinkedFaces, Links};
use super::patchwise::{Patchwise, in_metric};
use super::{Features, Statistics};
use crate::segmentation::{PatchGraph, Surface};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};

/// Number of best labellings from which a metric is learned.
const N_METRIC_SOURCES: usize = 10;
/// Number of candidates that are refined face by face before the choice is made.
const SHORTLIST: usize = 4;
/// Rounds of classifier and cut; then the area share of changed faces below which they stop.
const REFINEMENTS: usize = 2;
const SETTLED: f64 = 0.003;
/// Boundary strength of a refinement; then the upper limit of its evidence, in nats.
const STRENGTH: f64 = 5.0;
const CAP_NATS: f64 = 7.0;

/// One shape as input of discovery.
#[derive(Debug, Clone, Copy)]
pub struct ShapeInput<'a> {
    /// Its dual graph.
    pub surface: &'a Surface,
    /// Its patches.
    pub patches: &'a PatchGraph,
    /// Its standardised face descriptors.
    pub features: &'a Features,
}

/// The shapes to be labelled together, with features standardised over all of them.
#[derive(Debug, Clone)]
pub struct DiscoveryInput<'a> {
    /// The shapes.
    pub shapes: Vec<ShapeInput<'a>>,
    /// Whether the features end with the columns of the up axis.
    pub up_known: bool,
    /// Demands of a person that the labels must meet.
    pub links: Links,
}

/// The number of labels and the seed.
#[derive(Debug, Clone, PartialEq)]
pub struct DiscoveryOptions {
    /// Number of labels; `None`: estimated between 2 and `max_labels`.
    pub n_labels: Option<usize>,
    /// Upper limit of an estimated number of labels.
    pub max_labels: usize,
    /// Seed of every random start.
    pub seed: u64,
}

impl Default for DiscoveryOptions {
    fn default() -> Self {
        Self {
            n_labels: None,
            max_labels: 8,
            seed: 1,
        }
    }
}

/// A labelling of all shapes.
#[derive(Debug, Clone, PartialEq)]
pub struct Discovery {
    /// Label below `n_labels` of each face of each shape.
    pub labels: Vec<Vec<u32>>,
    /// Number of labels.
    pub n_labels: usize,
    /// Value of the labelling: the log concavity of its boundaries, weighted by the number of
    /// shapes, plus its consensus with the candidates.
    pub value: f64,
    /// Value of the current labelling, judged by the same candidates; negative infinity without
    /// one.
    pub current_value: f64,
}

/// A shape with the mean descriptors of its patches.
pub(super) struct PreparedShape<'a> {
    pub(super) surface: &'a Surface,
    pub(super) patches: &'a PatchGraph,
    pub(super) features: &'a Features,
    pub(super) patch_means: &'a [f64],
}

/// The input with the values that every step needs.
pub(super) struct Prepared<'a> {
    pub(super) input: &'a DiscoveryInput<'a>,
    pub(super) dim: usize,
    pub(super) up_known: bool,
    /// Whether the features are in a learned metric, in which columns are comparable.
    pub(super) learned_metric: bool,
    pub(super) means: Vec<f64>,
    /// Index of the first patch of each shape.
    pub(super) offsets: Vec<usize>,
    /// Area share of each patch, summing to the number of shapes.
    pub(super) area: Vec<f64>,
    /// The demands on patches, all of which count as faces of shape 0.
    pub(super) links: Links,
}

impl<'a> Prepared<'a> {
    pub(super) fn new(input: &'a DiscoveryInput<'a>) -> Self {
        let dim = input.shapes.first().map_or(0, |s| s.features.dim);
        let (mut means, mut offsets, mut area) = (Vec::new(), vec![0], Vec::new());
        for s in &input.shapes {
            let n = s.patches.len();
            means.extend(
                s.surface
                    .patch_means(&s.patches.patch_of_face, n, &s.features.data, dim),
            );
            area.extend_from_slice(&s.patches.area);
            offsets.push(area.len());
        }
        Self {
            links: on_patches(input, &offsets),
            input,
            dim,
            up_known: input.up_known,
            learned_metric: false,
            means,
            offsets,
            area,
        }
    }

    pub(super) fn each(&self) -> impl Iterator<Item = PreparedShape<'_>> {
        self.input
            .shapes
            .iter()
            .zip(self.offsets.windows(2))
            .map(|(s, range)| PreparedShape {
                surface: s.surface,
                patches: s.patches,
                features: s.features,
                patch_means: &self.means[range[0] * self.dim..range[1] * self.dim],
            })
    }

    pub(super) fn criterion(&self) -> Criterion {
        let patches: Vec<&PatchGraph> = self.input.shapes.iter().map(|s| s.patches).collect();
        Criterion::new(&patches, &self.means, self.dim, &self.offsets)
    }

    /// Converts a labelling of all patches to labels of faces.
    pub(super) fn on_faces(&self, of_patch: &[u32]) -> Vec<Vec<u32>> {
        let shapes = self.input.shapes.iter().zip(&self.offsets);
        shapes
            .map(|(s, o)| {
                s.patches
                    .patch_of_face
                    .iter()
                    .map(|p| of_patch[o + *p as usize])
                    .collect()
            })
            .collect()
    }

    /// Returns, for each patch of all shapes, the label of most of its area.
    fn majority(&self, labels: &[Vec<u32>], k: usize) -> Vec<u32> {
        let mut out = Vec::with_capacity(self.area.len());
        for (s, labels) in self.input.shapes.iter().zip(labels) {
            let mut area = vec![0.0; s.patches.len() * k];
            for (f, l) in labels.iter().enumerate() {
                area[s.patches.patch_of_face[f] as usize * k + *l as usize] += s.surface.area[f];
            }
            out.extend(area.chunks_exact(k).map(|row| {
                let most = (0..k).max_by(|&a, &b| row[a].total_cmp(&row[b]).then(b.cmp(&a)));
                most.unwrap_or(0) as u32
            }));
        }
        out
    }
}

/// Labels the faces of all shapes consistently. Deterministic for given options. The cost grows
/// with the square of the number of parts (about 25 in a shape): meant for up to a few dozen
/// shapes.
///
/// `current` is the current labelling, if any, with its number of labels. It is judged by the same
/// candidates as the new one.
pub fn discover(
    input: &DiscoveryInput<'_>,
    options: &DiscoveryOptions,
    current: Option<(&[Vec<u32>], usize)>,
) -> Discovery {
    if options.n_labels == Some(1) || input.shapes.is_empty() {
        let labels = input
            .shapes
            .iter()
            .map(|s| vec![0; s.surface.n_faces()])
            .collect();
        let current_value = if current.is_some() {
            0.0
        } else {
            f64::NEG_INFINITY
        };
        return Discovery {
            labels,
            n_labels: 1,
            value: 0.0,
            current_value,
        };
    }
    let shapes = Prepared::new(input);
    let criterion = shapes.criterion();
    let fewest = fewest_labels(&input.links);
    let pool = match options.n_labels {
        Some(k) if k >= fewest => (k, pool(&shapes, &criterion, k, options.seed)),
        Some(_) => (fewest, pool(&shapes, &criterion, fewest, options.seed)),
        None => estimate(&shapes, &criterion, options),
    };
    let chosen = choose(&shapes, &criterion, pool, options.seed, current);
    let mut found = chosen.unwrap_or_else(|| {
        // With fewer patches than labels, each patch gets a label of its own.
        let labels = input
            .shapes
            .iter()
            .map(|s| s.patches.patch_of_face.clone())
            .collect();
        let n_labels = input
            .shapes
            .iter()
            .map(|s| s.patches.len())
            .max()
            .unwrap_or(1);
        Discovery {
            labels,
            n_labels,
            value: 0.0,
            current_value: f64::NEG_INFINITY,
        }
    });
    let area = |shape: usize, face: u32| input.shapes[shape].surface.area[face as usize];
    input.links.repair(&mut found.labels, found.n_labels, area);
    found
}

/// Returns the number of labels that the demands need at least.
fn fewest_labels(links: &Links) -> usize {
    // Each group can have a label of its own.
    links.fewest_classes(links.groups.len()).unwrap_or(1)
}

/// Returns the demands on patches that follow from those on faces. A patch is linked if most of its
/// area is; of a group without such a patch on a shape, the patch with most of its area.
fn on_patches(input: &DiscoveryInput<'_>, offsets: &[usize]) -> Links {
    let mut taken = BTreeSet::new();
    let mut of_group = |group: &LinkedFaces| {
        let mut area = BTreeMap::<usize, BTreeMap<usize, f64>>::new();
        for &(shape, face) in &group.faces {
            let s = &input.shapes[shape];
            let patch = s.patches.patch_of_face[face as usize] as usize;
            let of_shape = area.entry(shape).or_default();
            *of_shape.entry(patch).or_default() += s.surface.area[face as usize];
        }
        let mut faces = Vec::new();
        for (shape, linked) in area {
            let share = |p: &usize| linked[p] / input.shapes[shape].patches.area[*p].max(1e-300);
            let mut patches: Vec<usize> = linked.keys().copied().collect();
            patches.sort_by(|a, b| share(b).total_cmp(&share(a)).then(a.cmp(b)));
            let n = patches.iter().filter(|p| share(p) > 0.5).count().max(1);
            let global = patches[..n.min(patches.len())].iter();
            let global = global.map(|p| (offsets[shape] + p) as u32);
            faces.extend(global.filter(|p| taken.insert(*p)).map(|p| (0, p)));
        }
        LinkedFaces {
            faces,
            class: group.class,
        }
    };
    Links {
        groups: input.links.groups.iter().map(&mut of_group).collect(),
        apart: input.links.apart.clone(),
    }
}

/// Returns the number of labels whose best candidate has the highest value, and the candidates.
fn estimate(shapes: &Prepared<'_>, criterion: &Criterion, options: &DiscoveryOptions) -> Numbered {
    let valued = |k: usize| {
        let candidates = pool(shapes, criterion, k, options.seed);
        let judge = Judge::new(criterion, candidates, &shapes.area, k);
        (judge.comparable_value(), (k, judge.into_candidates()))
    };
    let fewest = fewest_labels(&shapes.input.links).max(2);
    let counts = (fewest..=options.max_labels.max(fewest)).into_par_iter();
    let valued: Vec<(f64, Numbered)> = counts.map(valued).collect();
    let best = valued
        .into_iter()
        .reduce(|best, next| if next.0 > best.0 { next } else { best });
    best.map_or((2, Vec::new()), |(_, pool)| pool)
}

/// A number of labels, and labellings of all patches with as many.
type Numbered = (usize, Vec<Vec<u32>>);

/// The candidate labellings with one number of labels, each refined patch by patch, and their
/// judge.
pub(super) struct Candidates<'a> {
    pub(super) refined: Vec<Vec<u32>>,
    pub(super) judge: Judge<'a>,
}

impl<'a> Candidates<'a> {
    /// Refines the labellings of [`pool`] with `k` labels. A metric is learned from the best of
    /// them, and parts are grouped once more in that metric.
    pub(super) fn new(
        shapes: &'a Prepared<'_>,
        criterion: &'a Criterion,
        patchwise: &Patchwise<'_>,
        (k, candidates): Numbered,
        seed: u64,
    ) -> Self {
        let refined_all = |labellings: &[Vec<u32>]| -> Vec<Vec<u32>> {
            labellings
                .par_iter()
                .map(|l| patchwise.refine(l, k))
                .collect()
        };
        let mut refined = refined_all(&candidates);
        let mut judge = Judge::new(criterion, candidates, &shapes.area, k);
        let sources = judge.best(&refined, N_METRIC_SOURCES);
        let sources: Vec<&Vec<u32>> = sources.iter().map(|&c| &refined[c]).collect();
        if let Some(metric) = patchwise.metric(&sources, k) {
            let features: Vec<Features> = (shapes.input.shapes.par_iter())
                .map(|s| in_metric(s.features, &metric))
                .collect();
            let input = DiscoveryInput {
                shapes: shapes
                    .input
                    .shapes
                    .iter()
                    .zip(&features)
                    .map(|(s, features)| ShapeInput { features, ..*s })
                    .collect(),
                up_known: shapes.up_known,
                links: shapes.input.links.clone(),
            };
            let in_metric = Prepared {
                learned_metric: true,
                ..Prepared::new(&input)
            };
            let more = pool(&in_metric, criterion, k, seed);
            refined.extend(refined_all(&more));
            judge = judge.with_more(more);
        }
        Self { refined, judge }
    }
}

/// Returns the best labelling with as many labels as those of a pool: the best candidates are
/// refined face by face and judged again. Returns `None` if there is no candidate.
fn choose(
    shapes: &Prepared<'_>,
    criterion: &Criterion,
    pool: Numbered,
    seed: u64,
    current: Option<(&[Vec<u32>], usize)>,
) -> Option<Discovery> {
    let k = pool.0;
    let patchwise = Patchwise::new(shapes);
    let Candidates { refined, judge } = Candidates::new(shapes, criterion, &patchwise, pool, seed);
    let on_faces: Vec<Vec<Vec<u32>>> = judge
        .best(&refined, SHORTLIST)
        .into_par_iter()
        .map(|c| refine(shapes.input, shapes.on_faces(&refined[c]), k))
        .collect();
    let as_patches: Vec<Vec<u32>> = on_faces.iter().map(|l| shapes.majority(l, k)).collect();
    let values = judge.values(&as_patches, k);
    let best =
        (0..values.len()).max_by(|&a, &b| values[a].total_cmp(&values[b]).then(b.cmp(&a)))?;
    let current_value = current.map_or(f64::NEG_INFINITY, |(labels, n)| {
        judge.values(&[shapes.majority(labels, n)], n)[0]
    });
    let labels = on_faces.into_iter().nth(best)?;
    Some(Discovery {
        labels,
        n_labels: k,
        value: values[best],
        current_value,
    })
}

/// Alternates between fitting a linear classifier of all faces and a cut of each shape.
pub(super) fn refine(
    input: &DiscoveryInput<'_>,
    mut labels: Vec<Vec<u32>>,
    k: usize,
) -> Vec<Vec<u32>> {
    for _ in 0..REFINEMENTS {
        let dim = input.shapes[0].features.dim;
        let mut statistics = Statistics::empty(k, dim);
        let of_shapes: Vec<Statistics> = (input.shapes.par_iter().zip(&labels))
            .map(|(s, labels)| {
                Statistics::of_shape(s.features, &s.surface.area, |f| Some(labels[f]), k)
            })
            .collect();
        // Added in the order of the shapes, so that the sums do not depend on the number of
        // threads.
        for of_shape in &of_shapes {
            statistics.accumulate(of_shape, 1.0);
        }
        let classifier = statistics.classifier();
        let mut changed = 0.0;
        let unary = |s: &ShapeInput<'_>| -> Vec<f64> {
            let log = classifier.log_probabilities(s.features).into_iter();
            log.map(|p| (-p).min(CAP_NATS)).collect()
        };
        let surfaces: Vec<&Surface> = input.shapes.iter().map(|s| s.surface).collect();
        let fixed = input
            .links
            .decided(&surfaces, k, |at| unary(&input.shapes[at]));
        let cuts: Vec<Vec<u32>> = (input.shapes.par_iter().zip(&fixed))
            .map(|(s, fixed)| cut(s.surface, &unary(s), k, STRENGTH, fixed.as_deref()))
            .collect();
        for ((s, labels), next) in input.shapes.iter().zip(&mut labels).zip(cuts) {
            let moved = (0..next.len()).filter(|&f| next[f] != labels[f]);
            changed += moved.map(|f| s.surface.area[f]).sum::<f64>();
            *labels = next;
        }
        if changed / (input.shapes.len() as f64) < SETTLED {
            break;
        }
    }
    labels
}
