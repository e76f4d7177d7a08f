//! Chooses the part of a collection's shapes whose label is most worth asking a person for.
//!
//! The patches of each shape are merged until [`N_PARTS`] parts remain. Parts are compared by their
//! mean descriptors, in the metric of the scatter within discovered labels. An answer is expected
//! to decide the parts that are similar to the one asked about, as far as they are in doubt and no
//! earlier answer is as near: greedy facility location (Nemhauser, Wolsey and Fisher 1978, *An
//! Analysis of Approximations for Maximizing Submodular Set Functions*), weighted by area and
//! doubt. A part whose patches seem to have different labels is worth less, because its answer is
//! wrong for some of them. All this follows from a model of patches alone, so the next question
//! neither waits for an answer to be propagated to faces nor depends on it.

use super::DescriptionView;
use crate::labels::{Features, Normalisation, Statistics};
use crate::segmentation::{PatchGraph, Surface, merge_patches};
use nalgebra::{Cholesky, DMatrix};

/// Number of parts into which a shape is divided for questions.
pub const N_PARTS: usize = 16;
/// Number of most likely labels that a question offers.
pub const N_OFFERED: usize = 3;
/// Least doubt of a part: the model may be wrong even where it is certain.
const LEAST_DOUBT: f64 = 0.05;
/// Worth of a question whose own answer is certain, relative to one about which nothing is known.
const WORTH_OF_CERTAIN: f64 = 0.1;
/// Training shapes that the discovered labels are worth, as in propagation.
const PRIOR_SHAPES: f64 = 2.0;
/// Temperature of both classifiers, which are fitted to little data.
const TEMPERATURE: f64 = 2.0;
/// Share of a shape's area that must be answered for a discovered label before it is as much known
/// as unknown.
const UNSEEN_AREA: f64 = 0.02;
/// Probabilities below this count as this, so that one source cannot veto the other.
const FLOOR: f64 = 0.02;
/// Share of the mean variance that is mixed into the scatter for the metric.
const RIDGE: f64 = 0.1;
/// Rank of the neighbour in other shapes whose median distance is the width of the kernel.
const NEIGHBOUR: usize = 4;

/// The parts of a shape, as questions use them. They follow from its description alone.
#[derive(Debug, Clone, PartialEq)]
pub struct ShapeParts {
    /// Part of each proxy face `(m,)`.
    pub part_of_face: Vec<u32>,
    /// Part of each patch.
    pub part_of_patch: Vec<u32>,
    /// Area share of each patch.
    pub patch_area: Vec<f64>,
    /// Mean descriptors of each patch `(n_patches, dim)`, not standardised.
    pub patch_means: Vec<f32>,
}

impl ShapeParts {
    /// Divides a shape into parts; `up` is the collection's up axis, if known. Patches are merged
    /// by descriptors that are standardised over the shape itself, so its parts do not depend on
    /// other shapes.
    pub fn new(shape: &DescriptionView<'_>, up: Option<[f64; 3]>) -> Self {
        let surface = Surface::new(&shape.mesh());
        let raw = Features::raw(shape, up);
        let own = Normalisation::fit(
            std::iter::once((&raw, surface.area.as_slice())),
            up.is_some(),
        );
        let features = own.standardise(&raw);
        let graph = PatchGraph::new(&surface, shape.patches);
        let means = surface.patch_means(shape.patches, graph.len(), &features.data, features.dim);
        let part_of_patch = merge_patches(&graph, &means, features.dim, &[N_PARTS]).remove(0);
        let raw_means = surface.patch_means(shape.patches, graph.len(), &raw.data, raw.dim);
        let patches = shape.patches.iter();
        Self {
            part_of_face: patches.map(|p| part_of_patch[*p as usize]).collect(),
            part_of_patch,
            patch_area: graph.area,
            patch_means: raw_means.into_iter().map(|x| x as f32).collect(),
        }
    }

    /// Number of parts.
    pub fn n_parts(&self) -> usize {
        self.part_of_patch
            .iter()
            .max()
            .map_or(0, |p| *p as usize + 1)
    }
}

/// A shape about whose parts a person may be asked.
#[derive(Debug, Clone, Copy)]
pub struct CandidateShape<'a> {
    /// Its parts.
    pub parts: &'a ShapeParts,
    /// Area that a person gave to each class in each part `(p, k)`, in shares of the shape.
    pub labelled: &'a [f64],
    /// Whether each part may be asked about `(p,)`.
    pub open: &'a [bool],
}

/// What a collection knows that bears on questions.
#[derive(Debug, Clone, Copy)]
pub struct Background<'a> {
    /// Standardises descriptors.
    pub normalisation: &'a Normalisation,
    /// Statistics of the `n` discovered labels.
    pub discovered: &'a Statistics,
    /// Number of classes that a person has used.
    pub k: usize,
}

/// A part that a person is asked about.
#[derive(Debug, Clone, PartialEq)]
pub struct Question {
    /// Index of its shape.
    pub shape: usize,
    /// Index of the part among those of its shape.
    pub part: u32,
    /// Area that its answer is expected to decide, in units of a shape's area.
    pub gain: f64,
    /// Probability that its most likely class is wrong.
    pub doubt: f64,
    /// The most likely classes with their probabilities. Below k they are the person's classes;
    /// from k on they are discovered labels that nobody has named.
    pub likeliest: Vec<(usize, f64)>,
}

/// Returns the part whose answer is worth most; `None` if no part is open. Costs the square of the
/// number of parts.
pub fn next_question(shapes: &[CandidateShape<'_>], known: &Background<'_>) -> Option<Question> {
    if !shapes.iter().any(|s| s.open.contains(&true)) {
        return None;
    }
    let parts = PartModel::new(shapes, known);
    let n = parts.area.len();
    let kernel = parts.kernel(known.discovered);
    let mut covered = vec![0.0f64; n];
    for (s, share) in parts.answered.iter().enumerate().filter(|s| *s.1 > 0.0) {
        for (covered, near) in covered.iter_mut().zip(kernel.column(s).iter()) {
            *covered = covered.max(share.min(1.0) * near);
        }
    }
    let need: Vec<f64> = (0..n)
        .map(|j| parts.area[j] * parts.doubt[j].max(LEAST_DOUBT))
        .collect();
    let gain = |i: usize| -> f64 {
        let column = kernel.column(i);
        let each = column.iter().zip(&covered).zip(&need);
        each.map(|((near, covered), need)| need * (near - covered).max(0.0))
            .sum()
    };
    let worth = |i: usize| parts.purity[i].powi(2) * (parts.doubt[i] + WORTH_OF_CERTAIN) * gain(i);
    let (_, best) = (0..n)
        .filter(|i| parts.open[*i])
        .map(|i| (worth(i), i))
        .max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)))?;
    Some(Question {
        shape: parts.shape[best].0,
        part: parts.shape[best].1,
        gain: gain(best),
        doubt: parts.doubt[best],
        likeliest: parts.likeliest(best),
    })
}

/// The parts of all shapes, one after the other.
struct PartModel {
    /// Shape of each part, and its index there.
    shape: Vec<(usize, u32)>,
    area: Vec<f64>,
    open: Vec<bool>,
    /// Share of each part that a person labelled.
    answered: Vec<f64>,
    /// Standardised mean descriptors `(n_parts, dim)`.
    means: Vec<f64>,
    dim: usize,
    /// Mean over the patches of the probability that the person's most likely class is wrong.
    doubt: Vec<f64>,
    /// Share of the area whose patches have the most common label, averaged over discovered labels
    /// and the person's.
    purity: Vec<f64>,
    /// Number of columns of `probabilities`.
    width: usize,
    /// Mean probabilities over the patches `(n_parts, k + n)`: of the person's classes, then of
    /// discovered labels as far as nobody has named them.
    probabilities: Vec<f64>,
}

impl PartModel {
    fn new(shapes: &[CandidateShape<'_>], known: &Background<'_>) -> Self {
        let raw = Features {
            data: shapes
                .iter()
                .flat_map(|s| &s.parts.patch_means)
                .copied()
                .collect(),
            dim: known.normalisation.mean.len(),
        };
        let features = known.normalisation.standardise(&raw);
        let patches = Patches::new(shapes, &features, known);
        let (k, width, dim) = (known.k, patches.width, features.dim);
        let mut model = Self {
            shape: Vec::new(),
            area: Vec::new(),
            open: Vec::new(),
            answered: Vec::new(),
            means: Vec::new(),
            dim,
            doubt: Vec::new(),
            purity: Vec::new(),
            width,
            probabilities: Vec::new(),
        };
        let mut first = 0;
        for (s, shape) in shapes.iter().enumerate() {
            for part in 0..shape.parts.n_parts() {
                let of_part = shape.parts.part_of_patch.iter().enumerate();
                let of_part = of_part.filter(|p| *p.1 as usize == part);
                let members: Vec<(usize, f64)> = of_part
                    .map(|(p, _)| (first + p, shape.parts.patch_area[p]))
                    .collect();
                let area: f64 = members.iter().map(|m| m.1).sum();
                let scale = 1.0 / area.max(1e-12);
                let at = model.means.len();
                model.means.resize(at + dim, 0.0);
                let row = model.probabilities.len();
                model.probabilities.resize(row + width, 0.0);
                let mut doubt = 0.0;
                for (patch, weight) in &members {
                    let weight = weight * scale;
                    let x = &features.data[patch * dim..(patch + 1) * dim];
                    let slots = model.means[at..].iter_mut().zip(x);
                    slots.for_each(|(m, x)| *m += weight * f64::from(*x));
                    let p = &patches.probabilities[patch * width..(patch + 1) * width];
                    let slots = model.probabilities[row..].iter_mut().zip(p);
                    slots.for_each(|(m, p)| *m += weight * p);
                    doubt += weight * (1.0 - p[..k].iter().copied().fold(0.0, f64::max));
                }
                let labelled = &shape.labelled[part * k..(part + 1) * k];
                model.shape.push((s, part as u32));
                model.area.push(area);
                model.open.push(shape.open[part]);
                model.answered.push(labelled.iter().sum::<f64>() * scale);
                model.doubt.push(doubt.clamp(0.0, 1.0));
                model.purity.push(patches.purity(&members, k));
            }
            first += shape.parts.part_of_patch.len();
        }
        model
    }

    fn likeliest(&self, part: usize) -> Vec<(usize, f64)> {
        let row = &self.probabilities[part * self.width..(part + 1) * self.width];
        let mut classes: Vec<(usize, f64)> = row.iter().copied().enumerate().collect();
        classes.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        classes.truncate(N_OFFERED);
        classes
    }

    /// Returns the similarity of every two parts `(n, n)`, 0 to 1: `exp(−d²/h)`, where d is the
    /// distance of their means in the metric of the scatter within discovered labels, and h is the
    /// median of d² to a near part of another shape.
    fn kernel(&self, discovered: &Statistics) -> DMatrix<f64> {
        let (n, dim) = (self.area.len(), self.dim);
        let scatter = discovered.scatter_within();
        let ridge = RIDGE * scatter.trace() / dim as f64;
        let metric = scatter * (1.0 - RIDGE) + DMatrix::identity(dim, dim) * ridge.max(1e-9);
        let columns = DMatrix::from_column_slice(dim, n, &self.means);
        // The ridge makes the metric positive definite, except for statistics without faces.
        let white = Cholesky::new(metric).and_then(|f| f.l().solve_lower_triangular(&columns));
        let white = white.unwrap_or(columns);
        let norms: Vec<f64> = white.column_iter().map(|c| c.norm_squared()).collect();
        let mut squared = white.transpose() * &white;
        for j in 0..n {
            for i in 0..n {
                squared[(i, j)] = (norms[i] + norms[j] - 2.0 * squared[(i, j)]).max(0.0);
            }
        }
        let near = |j: usize| {
            let others = (0..n).filter(|i| self.shape[*i].0 != self.shape[j].0);
            let mut others: Vec<f64> = others.map(|i| squared[(i, j)]).collect();
            let rank = NEIGHBOUR.min(others.len().checked_sub(1)?);
            Some(*others.select_nth_unstable_by(rank, f64::total_cmp).1)
        };
        let mut near: Vec<f64> = (0..n).filter_map(near).collect();
        near.sort_by(f64::total_cmp);
        let width = near.get(near.len() / 2).copied().unwrap_or(1.0).max(1e-12);
        squared.map(|d| (-d / width).exp())
    }
}

/// Estimated labels of each patch.
struct Patches {
    width: usize,
    /// `(n_patches, k + n)`: as in [`PartModel`].
    probabilities: Vec<f64>,
    /// The most likely discovered label of each.
    found: Vec<usize>,
}

impl Patches {
    fn new(shapes: &[CandidateShape<'_>], features: &Features, known: &Background<'_>) -> Self {
        let (k, n) = (known.k, known.discovered.counts.len());
        let classifier = known.discovered.classifier().at_temperature(TEMPERATURE);
        let log = classifier.log_probabilities(features);
        let found: Vec<f64> = log.iter().map(|p| p.exp()).collect();
        let labelled = labelled_patches(shapes, k);
        let meaning = meaning(&labelled, &found, (k, n));
        let log_person = match k {
            0 => Vec::new(),
            _ => {
                let person = person_statistics(&labelled, features, known, &meaning);
                let classifier = person.classifier().at_temperature(TEMPERATURE);
                classifier.log_probabilities(features)
            }
        };
        let width = k + n;
        let n_patches = found.len() / n.max(1);
        let mut probabilities = vec![0.0; n_patches * width];
        for (i, row) in probabilities.chunks_exact_mut(width.max(1)).enumerate() {
            for (label, p) in found[i * n..(i + 1) * n].iter().enumerate() {
                let of_label = &meaning[label * (k + 1)..(label + 1) * (k + 1)];
                for (slot, m) in row[..k].iter_mut().zip(of_label) {
                    *slot += p * m;
                }
                row[k + label] = p * of_label[k];
            }
            let named: f64 = row[..k].iter().sum();
            // The geometric mean of the meaning of the discovered labels and the person's
            // classifier.
            for (class, slot) in row[..k].iter_mut().enumerate() {
                let meant = (*slot / named.max(1e-12)).max(FLOOR);
                *slot = meant.sqrt() * (0.5 * log_person[i * k + class]).exp();
            }
            let sum: f64 = row[..k].iter().sum();
            row[..k]
                .iter_mut()
                .for_each(|p| *p *= named / sum.max(1e-300));
        }
        Self {
            width,
            probabilities,
            found: found.chunks_exact(n.max(1)).map(largest).collect(),
        }
    }

    /// Returns the share of the area of some patches that has their most common label, averaged
    /// over discovered labels and the person's.
    fn purity(&self, members: &[(usize, f64)], k: usize) -> f64 {
        let share = |label: &dyn Fn(usize) -> usize| {
            let mut area = vec![0.0; self.width];
            for (patch, weight) in members {
                area[label(*patch)] += weight;
            }
            let sum: f64 = area.iter().sum();
            area.into_iter().fold(0.0, f64::max) / sum.max(1e-12)
        };
        let found = share(&|p| self.found[p]);
        if k < 2 {
            return found;
        }
        let person = share(&|p| largest(&self.probabilities[p * self.width..][..k]));
        (found + person) / 2.0
    }
}

/// Returns the index of the largest value; of equal ones the first.
fn largest(row: &[f64]) -> usize {
    let order = |a: &usize, b: &usize| row[*a].total_cmp(&row[*b]).then(b.cmp(a));
    (0..row.len()).max_by(order).unwrap_or(0)
}

/// Returns the area that a person gave to each class in each patch `(n_patches, k)`: that of each
/// part, spread over its patches.
fn labelled_patches(shapes: &[CandidateShape<'_>], k: usize) -> Vec<f64> {
    let mut out = Vec::new();
    for shape in shapes {
        let mut area = vec![0.0; shape.parts.n_parts()];
        let of_patch = || {
            shape
                .parts
                .part_of_patch
                .iter()
                .zip(&shape.parts.patch_area)
        };
        of_patch().for_each(|(part, a)| area[*part as usize] += a);
        for (part, a) in of_patch() {
            let part = *part as usize;
            let labelled = &shape.labelled[part * k..(part + 1) * k];
            out.extend(labelled.iter().map(|l| l * a / area[part].max(1e-12)));
        }
    }
    out
}

/// Returns the meaning of each discovered label `(n, k + 1)`: probabilities of the person's
/// classes, then the probability that nobody has named it.
fn meaning(labelled: &[f64], found: &[f64], (k, n): (usize, usize)) -> Vec<f64> {
    let mut both = vec![0.0; n * (k + 1)];
    if k > 0 {
        for (labelled, found) in labelled.chunks_exact(k).zip(found.chunks_exact(n.max(1))) {
            for (label, p) in found.iter().enumerate() {
                let row = &mut both[label * (k + 1)..][..k];
                let each = row.iter_mut().zip(labelled);
                each.for_each(|(slot, area)| *slot += p * area);
            }
        }
    }
    for row in both.chunks_exact_mut(k + 1) {
        row[k] = UNSEEN_AREA;
        let sum: f64 = row.iter().sum();
        row.iter_mut().for_each(|p| *p /= sum);
    }
    both
}

/// Computes statistics of the person's classes from the labelled patches, with the discovered
/// labels, translated by their meaning, as a prior.
fn person_statistics(
    labelled: &[f64],
    features: &Features,
    known: &Background<'_>,
    meaning: &[f64],
) -> Statistics {
    let (k, dim) = (known.k, features.dim);
    let mut person = Statistics::empty(k, dim);
    let mut add = |class: usize, count: f64, sums: &mut dyn Iterator<Item = f64>| {
        person.counts[class] += count;
        let slots = person.sums[class * dim..(class + 1) * dim].iter_mut();
        slots.zip(sums).for_each(|(s, x)| *s += x);
    };
    let patches = labelled
        .chunks_exact(k)
        .zip(features.data.chunks_exact(dim));
    for (labelled, x) in patches {
        for (class, area) in labelled.iter().enumerate().filter(|c| *c.1 > 0.0) {
            add(class, *area, &mut x.iter().map(|x| area * f64::from(*x)));
        }
    }
    let discovered = known.discovered;
    let worth = PRIOR_SHAPES / discovered.total().max(1e-12);
    for (label, count) in discovered.counts.iter().enumerate() {
        let sums = &discovered.sums[label * dim..(label + 1) * dim];
        for class in 0..k {
            let share = worth * meaning[label * (k + 1) + class];
            add(class, share * count, &mut sums.iter().map(|x| share * x));
        }
    }
    person.with_scatter(&discovered.scatter_within(), 1.0)
}

#[cfg(test)]
mod tests;
