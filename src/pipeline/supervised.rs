//! Labels the shapes of a collection from faces that a person labelled.
//!
//! While no shape is labelled by hand, labels are discovered. From the first correction on, they
//! come from the corrected shapes, the training shapes. [`fit`] labels a few representative shapes
//! together and fits a linear discriminant to them. In the first round, votes through maps from the
//! training shapes and a discriminant fitted to these alone label the representatives. In further
//! rounds, the discriminant is also fitted to the confident faces of all representatives
//! (self-training: Yarowsky 1995, *Unsupervised Word Sense Disambiguation Rivaling Supervised
//! Methods*), and all representatives vote. [`label_fitted`] then labels every other shape with
//! votes and a cut. The fit does not change until the next correction, so the order in which these
//! shapes are labelled makes no difference.
//!
//! One training shape shows what its parts are like, but neither how much parts of one label differ
//! between shapes, nor what a part of this label is like on average. The labels that were
//! discovered before supply both. First, although some of them are wrong, descriptors scatter
//! within them as within true parts. Second, the meaning of each discovered label in the person's
//! labels, observed on faces that have both, gives an expectation of the means of the person's
//! labels. The estimate is that with a conjugate prior worth a number of training shapes (Gauvain
//! and Lee 1994, *Maximum a Posteriori Estimation for Multivariate Gaussian Mixture Observations of
//! Markov Chains*), so its influence fades as training shapes are added. In addition, a shape's own
//! discovered labels, translated into the person's labels, vote beside those that come through
//! maps. Their weight follows from how often the person agreed with them.
//!
//! Before the cut, a face's evidence is mixed with the mean over its part of the shape, because a
//! limb has one label more often than evidence face by face suggests.

use super::place::{blended, vote_probabilities};
use super::{DescriptionView, Labelling, Prepared, Vote};
use crate::fmap::Confidence;
use crate::labels::cut::{STRENGTH, cut};
use crate::labels::{Classifier, Links, Overlap, PriorLabels, Statistics};
use crate::segmentation::{Surface, parts};
use rayon::iter::{IntoParallelIterator, IntoParallelRefIterator, ParallelIterator};
use std::borrow::Cow;

/// Number of parts into which a shape is divided: so many for each class, and so many more.
const N_PARTS_A_CLASS: usize = 2;
const N_PARTS_MORE: usize = 4;

/// Weights of the fit, and of labelling by it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FitOptions {
    /// Number of rounds after the first, which uses the training shapes alone.
    pub n_rounds: usize,
    /// Share of the vote through maps in the log-linear mean with the discriminant.
    pub vote_share: f64,
    /// Weight of the vote of a training shape, relative to that of a shape with propagated labels.
    pub training_trust: f64,
    /// Weight in the discriminant of a face that a person labelled, relative to one whose label was
    /// discovered.
    pub pinned_weight: f64,
    /// Weight in the discriminant of all shapes with propagated labels together, relative to all
    /// training shapes together.
    pub propagated_weight: f64,
    /// Least probability of a face to which the discriminant is fitted, if no person labelled it.
    pub confident: f64,
    /// Number of training shapes that the discovered labels are worth, for the means of the labels
    /// and for the scatter of descriptors around them. With n training shapes, the discovered
    /// labels have the share `discovered_worth / (discovered_worth + n)`.
    pub discovered_worth: f64,
    /// Temperature of the discriminant, which is too certain because it is fitted to few shapes.
    pub temperature: f64,
    /// Share of the mean over a face's part in the cost of each class.
    pub part_share: f64,
    /// Boundary strength of the cut.
    pub strength: f64,
}

impl Default for FitOptions {
    fn default() -> Self {
        Self {
            n_rounds: 1,
            vote_share: 0.5,
            training_trust: 2.0,
            pinned_weight: 4.0,
            propagated_weight: 1.0,
            confident: 0.7,
            discovered_worth: 2.0,
            temperature: 2.0,
            part_share: 0.3,
            strength: STRENGTH,
        }
    }
}

/// A representative shape to which the model is fitted.
#[derive(Debug, Clone, Copy)]
pub struct FitShape<'a> {
    /// Its arrays.
    pub shape: DescriptionView<'a>,
    /// The shape, prepared under the collection's normalisation.
    pub prepared: &'a Prepared,
    /// Class of each face that a person labelled `(m,)`; empty if there is none.
    pub pinned: &'a [Option<u32>],
    /// Probabilities `(m, k)`, 0 to 255, of discovered labels that still count; empty if there are
    /// none.
    pub discovered: &'a [u8],
}

/// A map between two shapes of the fit.
#[derive(Debug, Clone, Copy)]
pub struct FitMap<'a> {
    /// Index of the shape that votes.
    pub from: usize,
    /// Index of the shape that it votes for.
    pub to: usize,
    /// For each vertex of `to` a vertex of `from`.
    pub p2p: &'a [u32],
    /// Expected correctness of the map at each vertex of `to`.
    pub confidence: &'a Confidence,
}

/// The result of a fit.
#[derive(Debug, Clone, PartialEq)]
pub struct Fitted {
    /// Statistics that make the discriminant.
    pub statistics: Statistics,
    /// The labels that were discovered before, with their meaning in the person's classes.
    pub prior: Option<PriorLabels>,
    /// Labelling of each shape of the fit.
    pub labellings: Vec<Labelling>,
}

/// Evidence besides the shapes of the fit.
#[derive(Debug, Clone, Copy)]
pub struct FurtherEvidence<'a> {
    /// Statistics of labelled faces elsewhere: pinned faces of further training shapes, and faces
    /// with discovered labels that still count.
    pub statistics: &'a Statistics,
    /// Number of training shapes, including those of the fit. Each counts by the share of its area
    /// that is pinned.
    pub n_training: f64,
    /// Labels that were discovered before a person labelled anything, where a person has labelled
    /// whole shapes since. They show what parts are like on average and how much parts of one label
    /// differ between shapes, which a few training shapes do not show.
    pub discovered: Option<&'a DiscoveredLabels>,
    /// Demands of a person on labels of the shapes of the fit.
    pub links: &'a Links,
}

/// Discovered labels beside a person's.
#[derive(Debug, Clone, PartialEq)]
pub struct DiscoveredLabels {
    /// Statistics of the labels over many shapes.
    pub statistics: Statistics,
    /// Faces of the training shapes that have a discovered label and a class of the person.
    pub overlap: Overlap,
    /// Labels that no labelled face shows, each with the class that stands for it: a class of its
    /// own behind those of the person, or the class into which a person merged it.
    pub own: Vec<(usize, u32)>,
}

/// Fits a model of `k` classes, kept discovered labels included, to some shapes and labels them.
/// Costs a cut for each shape and round.
pub fn fit(
    members: &[FitShape<'_>],
    maps: &[FitMap<'_>],
    further: &FurtherEvidence<'_>,
    k: usize,
    options: &FitOptions,
) -> Fitted {
    let worth = options.discovered_worth;
    let share = worth / (worth + further.n_training);
    let scatter = further.discovered.map(|d| d.statistics.scatter_within());
    let with_scatter = |statistics: &Statistics| match &scatter {
        Some(scatter) => statistics.with_scatter(scatter, share),
        None => statistics.clone(),
    };
    let mut certain = further.statistics.clone();
    for member in members.iter().filter(|l| !l.pinned.is_empty()) {
        let class = |f: usize| member.pinned[f];
        let of_shape = Statistics::of_shape(
            &member.prepared.features,
            &member.prepared.surface.area,
            class,
            k,
        );
        certain.accumulate(&of_shape, options.pinned_weight);
    }
    let prior = further
        .discovered
        .map(|d| PriorLabels::new(d.statistics.clone(), &d.overlap, &d.own, k));
    if let Some(prior) = &prior {
        let translated = prior.translated();
        let each = certain.total() / further.n_training.max(1e-3);
        let weight = worth * each / translated.total().max(1e-12);
        certain.accumulate(&translated, weight);
    }
    let own: Vec<Option<OwnVote>> = members
        .par_iter()
        .map(|l| Some(OwnVote::new(&l.shape, l.prepared, prior.as_ref()?)))
        .collect();
    let part_of: Vec<Vec<u32>> = members
        .par_iter()
        .map(|l| parts_for(&l.shape, l.prepared, k))
        .collect();
    let mut votes: Vec<Vec<u8>> = members.iter().map(|l| first_vote(l, k)).collect();
    let surfaces: Vec<&Surface> = members.iter().map(|l| &*l.prepared.surface).collect();
    let mut statistics = with_scatter(&certain);
    let mut labellings = Vec::new();
    for round in 0..=options.n_rounds {
        let classifier = statistics.classifier().at_temperature(options.temperature);
        let costs = |to: usize| {
            let into = votes_into(members, maps, &votes, to, options);
            let evidence = Evidence {
                classifier: &classifier,
                votes: &into,
                own: own[to].as_ref(),
                part_of: &part_of[to],
            };
            costs(
                &members[to].shape,
                members[to].prepared,
                &evidence,
                k,
                options,
            )
        };
        let decided = further.links.decided(&surfaces, k, |to| costs(to).0);
        labellings = (0..members.len())
            .into_par_iter()
            .map(|to| {
                let (unary, weights) = costs(to);
                let fixed = pinned_or(members[to].pinned, decided[to].as_deref());
                labelled(members[to].prepared, (&unary, weights), &fixed, k, options)
            })
            .collect();
        if round < options.n_rounds {
            votes = labellings.iter().map(|l| l.probabilities.clone()).collect();
            let more = with_confident(&certain, members, &labellings, k, options);
            statistics = with_scatter(&more);
        }
    }
    Fitted {
        statistics,
        prior,
        labellings,
    }
}

/// Labels a shape by a fit. The evidence is the votes through maps from training shapes and
/// representatives, the vote of the shape's own discovered labels, and the discriminant of
/// `statistics`. Faces that a person labelled keep their class.
pub fn label_fitted(
    shape: &DescriptionView<'_>,
    prepared: &Prepared,
    (statistics, prior): (&Statistics, Option<&PriorLabels>),
    votes: &[Vote<'_>],
    pinned: &[Option<u32>],
    options: &FitOptions,
) -> Labelling {
    let k = statistics.counts.len();
    let own = prior.map(|prior| OwnVote::new(shape, prepared, prior));
    let evidence = Evidence {
        classifier: &statistics.classifier().at_temperature(options.temperature),
        votes,
        own: own.as_ref(),
        part_of: &parts_for(shape, prepared, k),
    };
    let (unary, weights) = costs(shape, prepared, &evidence, k, options);
    labelled(prepared, (&unary, weights), pinned, k, options)
}

/// Converts classes of polygons `(n_polygons,)` to classes of proxy faces `(m,)`. A face is pinned
/// if most of the area that it stands for is pinned, to the class of most of that area.
pub fn proxy_pins(
    shape: &DescriptionView<'_>,
    polygon_class: &[Option<u32>],
    k: usize,
) -> Vec<Option<u32>> {
    let m = shape.faces.len();
    // Column k is area that is not pinned.
    let mut area = vec![0.0; m * (k + 1)];
    for (p, class) in polygon_class.iter().enumerate() {
        let column = class.map_or(k, |c| c as usize);
        let face = shape.face_map[p] as usize;
        area[face * (k + 1) + column] += f64::from(shape.polygon_area[p]).max(1e-300);
    }
    let most = |row: &[f64]| {
        let best = (0..k).max_by(|&a, &b| row[a].total_cmp(&row[b]).then(b.cmp(&a)))?;
        let pinned: f64 = row[..k].iter().sum();
        (pinned > row[k]).then_some(best as u32)
    };
    area.chunks_exact(k + 1).map(most).collect()
}

/// Returns the votes of the other members for one.
fn votes_into<'a>(
    members: &'a [FitShape<'_>],
    maps: &'a [FitMap<'_>],
    votes: &'a [Vec<u8>],
    to: usize,
    options: &FitOptions,
) -> Vec<Vote<'a>> {
    let into = maps
        .iter()
        .filter(|m| m.to == to && !votes[m.from].is_empty());
    into.map(|m| Vote {
        faces: members[m.from].shape.faces,
        probabilities: &votes[m.from],
        p2p: m.p2p,
        confidence: m.confidence,
        trust: if members[m.from].pinned.is_empty() {
            1.0
        } else {
            options.training_trust
        },
    })
    .collect()
}

/// Returns the class of each face that a person labelled, elsewhere that which links decide; empty
/// if neither decides any.
fn pinned_or<'a>(
    pinned: &'a [Option<u32>],
    decided: Option<&'a [Option<u32>]>,
) -> Cow<'a, [Option<u32>]> {
    match (pinned, decided) {
        (pinned, None) => Cow::Borrowed(pinned),
        ([], Some(decided)) => Cow::Borrowed(decided),
        (pinned, Some(decided)) => {
            let both = pinned.iter().zip(decided);
            Cow::Owned(both.map(|(pin, link)| pin.or(*link)).collect())
        }
    }
}

/// Returns the vote of a shape in the first round: pinned classes, elsewhere the discovered labels.
fn first_vote(member: &FitShape<'_>, k: usize) -> Vec<u8> {
    let mut vote = match (member.discovered, member.pinned) {
        ([], []) => return Vec::new(),
        ([], pinned) => vec![0; pinned.len() * k],
        (discovered, _) => discovered.to_vec(),
    };
    for (row, pin) in vote.chunks_exact_mut(k).zip(member.pinned) {
        if let Some(class) = pin {
            row.fill(0);
            row[*class as usize] = u8::MAX;
        }
    }
    vote
}

/// Adds the confident faces of the representatives to the certain statistics, at a given weight of
/// all of them together.
fn with_confident(
    certain: &Statistics,
    members: &[FitShape<'_>],
    labellings: &[Labelling],
    k: usize,
    options: &FitOptions,
) -> Statistics {
    let dim = certain.sums.len() / k.max(1);
    let mut confident = Statistics::empty(k, dim);
    let least = (options.confident * 255.0) as u8;
    for (member, labelling) in members.iter().zip(labellings) {
        let class = |f: usize| {
            let class = labelling.classes[f];
            let is_pinned = member.pinned.get(f).is_some_and(Option::is_some);
            let confident = labelling.probabilities[f * k + class as usize] >= least;
            (confident && !is_pinned).then_some(class)
        };
        let of_shape = Statistics::of_shape(
            &member.prepared.features,
            &member.prepared.surface.area,
            class,
            k,
        );
        confident.accumulate(&of_shape, 1.0);
    }
    let weight = options.propagated_weight * certain.total() / confident.total().max(1e-12);
    let mut all = certain.clone();
    all.accumulate(&confident, weight.min(1.0));
    all
}

/// The labels discovered on a shape before a person labelled anything, as a vote through the map of
/// the shape to itself.
struct OwnVote {
    probabilities: Vec<u8>,
    p2p: Vec<u32>,
    confidence: Confidence,
}

impl OwnVote {
    fn new(shape: &DescriptionView<'_>, prepared: &Prepared, prior: &PriorLabels) -> Self {
        let discovered = prior.probabilities(&prepared.surface, &prepared.features);
        let n = shape.vertices.len();
        Self {
            probabilities: discovered
                .iter()
                .map(|p| (p * 255.0).round() as u8)
                .collect(),
            p2p: (0..n as u32).collect(),
            confidence: Confidence::everywhere(prior.agreement, n),
        }
    }
}

/// Returns the part of each face `(m,)` of a shape that is labelled in `k` classes.
fn parts_for(shape: &DescriptionView<'_>, prepared: &Prepared, k: usize) -> Vec<u32> {
    let (surface, features) = (&prepared.surface, &prepared.features);
    let n = N_PARTS_A_CLASS * k + N_PARTS_MORE;
    parts(surface, shape.patches, &features.data, features.dim, n)
}

/// The evidence for the labels of one shape.
struct Evidence<'a> {
    classifier: &'a Classifier,
    /// Votes through maps from other shapes.
    votes: &'a [Vote<'a>],
    own: Option<&'a OwnVote>,
    /// Part of each face `(m,)`.
    part_of: &'a [u32],
}

/// Returns the cost of each class for each face `(m, k)`, and the weights of the votes of other
/// shapes.
fn costs(
    shape: &DescriptionView<'_>,
    prepared: &Prepared,
    evidence: &Evidence<'_>,
    k: usize,
    options: &FitOptions,
) -> (Vec<f64>, Vec<f64>) {
    let log_model = evidence.classifier.log_probabilities(&prepared.features);
    let mut votes = evidence.votes.to_vec();
    votes.extend(evidence.own.map(|own| Vote {
        faces: shape.faces,
        probabilities: &own.probabilities,
        p2p: &own.p2p,
        confidence: &own.confidence,
        trust: 1.0,
    }));
    let (voted, mut weights) = vote_probabilities(shape, &votes, k);
    // The weights of the other shapes only, which must sum to 1.
    weights.truncate(evidence.votes.len());
    let sum: f64 = weights.iter().sum();
    weights.iter_mut().for_each(|w| *w /= sum.max(1e-300));
    let unary = blended(&log_model, &voted, options.vote_share, k);
    let part_of = evidence.part_of;
    let unary = shared_by_parts(unary, &prepared.surface, part_of, k, options.part_share);
    (unary, weights)
}

/// Labels a shape by the costs of classes. Faces with a class in `fixed` have that class.
fn labelled(
    prepared: &Prepared,
    (unary, weights): (&[f64], Vec<f64>),
    fixed: &[Option<u32>],
    k: usize,
    options: &FitOptions,
) -> Labelling {
    let pinned = (!fixed.is_empty()).then_some(fixed);
    let classes = cut(&prepared.surface, unary, k, options.strength, pinned);
    let mut posterior: Vec<f64> = unary.iter().map(|u| (-u).exp()).collect();
    for (f, row) in posterior.chunks_exact_mut(k).enumerate() {
        if let Some(class) = fixed.get(f).copied().flatten() {
            row.fill(0.0);
            row[class as usize] = 1.0;
            continue;
        }
        let sum: f64 = row.iter().sum();
        row.iter_mut().for_each(|p| *p /= sum);
    }
    Labelling::new(classes, &posterior, weights, k)
}

/// Mixes the cost of each class for each face `(m, k)` with its mean over the face's part; `share`
/// is the share of the mean, `part_of (m,)` the part of each face.
fn shared_by_parts(
    mut unary: Vec<f64>,
    surface: &Surface,
    part_of: &[u32],
    k: usize,
    share: f64,
) -> Vec<f64> {
    let n = part_of.iter().max().map_or(0, |p| *p as usize + 1);
    let means = surface.patch_means(part_of, n, &unary, k);
    for (row, part) in unary.chunks_exact_mut(k).zip(part_of) {
        let mean = &means[*part as usize * k..(*part as usize + 1) * k];
        for (cost, mean) in row.iter_mut().zip(mean) {
            *cost = (1.0 - share) * *cost + share * mean;
        }
    }
    unary
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faces_share_the_mean_cost_of_their_part_by_area() {
        let surface = Surface {
            area: vec![0.1, 0.3, 0.6],
            centroids: vec![[0.0; 3]; 3],
            edges: Vec::new(),
        };
        let unary = vec![0.0, 2.0, 4.0, 6.0, 5.0, 1.0];
        let shared = shared_by_parts(unary, &surface, &[0, 0, 1], 2, 0.5);
        // The means of the first part are 3 and 5.
        let expected = [1.5, 3.5, 3.5, 5.5, 5.0, 1.0];
        for (cost, expected) in shared.iter().zip(expected) {
            assert!((cost - expected).abs() < 1e-12, "{shared:?}");
        }
    }
}
