//! Faces that a person labelled become the labels of all shapes of a collection.
//!
//! While nothing is labelled by hand, labels are discovered; from the first correction on they come from the
//! corrected shapes, the exemplars. A few representative shapes learn first, together: votes through maps from
//! the exemplars, and a linear discriminant that is trained on the exemplars alone, label them; then once more,
//! with the discriminant trained anew with the confident faces of all of them (Yarowsky 1995, *Unsupervised
//! Word Sense Disambiguation Rivaling Supervised Methods*), and they vote for each other. What they have
//! learnt labels every other shape with a vote and a cut: it does not change until the next correction, so the
//! order in which those are labelled makes no difference.
//!
//! One exemplar shows what its parts are like, but not how much like parts of different shapes differ, nor what a part of
//! its kind is like on average. Both are taken from the labels that were discovered before. Wrong as some are, descriptors
//! scatter within them as within true parts; and what each of them means in the person's words, seen by the faces
//! that both label, says where the means of the person's labels are to be expected: the estimate is that with a conjugate prior
//! worth so many exemplars (Gauvain and Lee 1994, *Maximum a Posteriori Estimation for Multivariate Gaussian Mixture
//! Observations of Markov Chains*), which fades as exemplars come. Besides, a shape's own discovered labels, in the person's
//! words, vote beside those that come through maps, and are believed as far as the person was found to agree with them.
//!
//! Before the cut a face's evidence is mixed with the mean over the part of the shape that it is in: a limb is of one label
//! more often than evidence face by face says.

use super::place::{blended, vote_probabilities};
use super::{DescriptionView, Labelling, Prepared, Vote};
use crate::fmap::Confidence;
use crate::labels::cut::{STRENGTH, cut};
use crate::labels::{Classifier, Pinned, PriorLabels, Statistics};
use crate::segmentation::{Surface, parts};
use rayon::iter::{IntoParallelIterator, IntoParallelRefIterator, ParallelIterator};

/// Parts that a shape is taken to consist of: so many for each class, and so many more.
const N_PARTS_A_CLASS: usize = 2;
const N_PARTS_MORE: usize = 4;

/// Weights of teaching.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FitOptions {
    /// Rounds in which the representatives learn from each other, after the one in which they learn from the
    /// exemplars alone.
    pub n_rounds: usize,
    /// Share of the vote through maps in the log-linear mean with the discriminant.
    pub vote_share: f64,
    /// Weight of an exemplar's vote against that of a shape that was labelled by carrying.
    pub training_trust: f64,
    /// Weight in the discriminant of a face that a person labelled, against one whose label was discovered.
    pub pinned_weight: f64,
    /// Weight of all shapes labelled by carrying together against all exemplars together, in the discriminant.
    pub propagated_weight: f64,
    /// Least probability of a face that the discriminant is trained on, if no person labelled it.
    pub confident: f64,
    /// Exemplars that tell as much as the labels that were discovered, of where the labels' means are and of how
    /// descriptors scatter around them: with n exemplars, what was discovered has `discovered_worth /
    /// (discovered_worth + n)` of the say.
    pub discovered_worth: f64,
    /// Temperature of the discriminant, which is trained on few shapes and too certain.
    pub temperature: f64,
    /// Share, in what each class of a face costs, of the mean over the part that the face is in.
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

/// A representative shape that learns, and teaches the others.
#[derive(Debug, Clone, Copy)]
pub struct FitShape<'a> {
    /// Its arrays.
    pub shape: DescriptionView<'a>,
    /// What is derived from them under the collection's normalisation.
    pub prepared: &'a Prepared,
    /// Class of each face that a person labelled `(m,)`; empty if none is.
    pub pinned: &'a [Option<u32>],
    /// Probabilities `(m, k)`, 0 to 255, of labels that were discovered and still count; empty if none do.
    pub discovered: &'a [u8],
}

/// A map between two members.
#[derive(Debug, Clone, Copy)]
pub struct FitMap<'a> {
    /// Labels are carried from this member
    pub from: usize,
    /// to this one.
    pub to: usize,
    /// For each vertex of `to` a vertex of `from`.
    pub p2p: &'a [u32],
    /// What to expect of the map at each vertex of `to`.
    pub confidence: &'a Confidence,
}

/// What the representatives have learnt.
#[derive(Debug, Clone, PartialEq)]
pub struct Fitted {
    /// What makes the discriminant.
    pub statistics: Statistics,
    /// What the labels that were discovered before mean now.
    pub prior: Option<PriorLabels>,
    /// Labelling of each member.
    pub labellings: Vec<Labelling>,
}

/// What counts besides the members.
#[derive(Debug, Clone, Copy)]
pub struct FurtherEvidence<'a> {
    /// Statistics of faces that were labelled: pinned ones of further exemplars, and discovered ones that still count.
    pub statistics: &'a Statistics,
    /// Training shapes, those among the members included: each counts by the share of its area that is pinned.
    pub n_training: f64,
    /// Statistics of the labels that were discovered before anything was labelled, over many shapes, where they count
    /// no more themselves: what parts are like on average, and how like parts of different shapes differ, of which a few
    /// exemplars say little.
    pub discovered: Option<&'a Statistics>,
}

/// Teaches the members `k` classes. Costs a cut for each member and round.
pub fn fit(
    members: &[FitShape<'_>],
    maps: &[FitMap<'_>],
    further: &FurtherEvidence<'_>,
    k: usize,
    options: &FitOptions,
) -> Fitted {
    let worth = options.discovered_worth;
    let share = worth / (worth + further.n_training);
    let scatter = further.discovered.map(Statistics::scatter_within);
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
    let prior = further.discovered.map(|discovered| {
        let pinned = members.iter().filter(|l| !l.pinned.is_empty());
        let pinned = pinned.map(|l| Pinned {
            surface: &l.prepared.surface,
            features: &l.prepared.features,
            classes: l.pinned,
        });
        PriorLabels::new(discovered.clone(), pinned, k)
    });
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
    let mut statistics = with_scatter(&certain);
    let mut labellings = Vec::new();
    for round in 0..=options.n_rounds {
        let classifier = statistics.classifier().at_temperature(options.temperature);
        labellings = (0..members.len())
            .into_par_iter()
            .map(|to| {
                let member = &members[to];
                let into: Vec<Vote<'_>> = maps
                    .iter()
                    .filter(|m| m.to == to && !votes[m.from].is_empty())
                    .map(|m| Vote {
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
                    .collect();
                let evidence = Evidence {
                    classifier: &classifier,
                    votes: &into,
                    own: own[to].as_ref(),
                    part_of: &part_of[to],
                    pinned: member.pinned,
                };
                labelled(&member.shape, member.prepared, &evidence, k, options)
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

/// Labels a shape from what was taught: votes through maps from exemplars and representatives, and of the labels that were
/// discovered before; the discriminant that `statistics` make; and the faces a person labelled, which keep their class.
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
        pinned,
    };
    labelled(shape, prepared, &evidence, k, options)
}

/// Classes of proxy faces `(m,)`, given those of the polygons `(n_polygons,)`: a face is pinned if most of the area that
/// it stands for is, to the class of most of that.
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

/// What a member says before it has learnt anything: what a person pinned, else what was discovered.
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

/// The certain statistics with the confident faces of what was carried, all of them together of a given weight.
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

/// What was discovered of a shape before a person labelled anything, as a vote through the map to itself.
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

/// Part of each face `(m,)` of a shape that is to be labelled in `k` classes.
fn parts_for(shape: &DescriptionView<'_>, prepared: &Prepared, k: usize) -> Vec<u32> {
    let (surface, features) = (&prepared.surface, &prepared.features);
    let n = N_PARTS_A_CLASS * k + N_PARTS_MORE;
    parts(surface, shape.patches, &features.data, features.dim, n)
}

/// What is known of the labels of one shape.
struct Evidence<'a> {
    classifier: &'a Classifier,
    /// Through maps from other shapes.
    votes: &'a [Vote<'a>],
    own: Option<&'a OwnVote>,
    /// Part of each face `(m,)`.
    part_of: &'a [u32],
    pinned: &'a [Option<u32>],
}

fn labelled(
    shape: &DescriptionView<'_>,
    prepared: &Prepared,
    evidence: &Evidence<'_>,
    k: usize,
    options: &FitOptions,
) -> Labelling {
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
    // Those of the other shapes among themselves.
    weights.truncate(evidence.votes.len());
    let sum: f64 = weights.iter().sum();
    weights.iter_mut().for_each(|w| *w /= sum.max(1e-300));
    let unary = blended(&log_model, &voted, options.vote_share, k);
    let part_of = evidence.part_of;
    let unary = shared_by_parts(unary, &prepared.surface, part_of, k, options.part_share);
    let fixed = (!evidence.pinned.is_empty()).then_some(evidence.pinned);
    let classes = cut(&prepared.surface, &unary, k, options.strength, fixed);
    let mut posterior: Vec<f64> = unary.iter().map(|u| (-u).exp()).collect();
    for (f, row) in posterior.chunks_exact_mut(k).enumerate() {
        if let Some(class) = evidence.pinned.get(f).copied().flatten() {
            row.fill(0.0);
            row[class as usize] = 1.0;
            continue;
        }
        let sum: f64 = row.iter().sum();
        row.iter_mut().for_each(|p| *p /= sum);
    }
    Labelling::new(classes, &posterior, weights, k)
}

/// What each class of each face costs `(m, k)`, this share of it the mean over the part `(m,)` that the face is in.
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
