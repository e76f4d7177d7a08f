//! Builds the votes of stored shapes for the labels of another one, through functional maps.

use super::collection::Collection;
use super::error::Result;
use super::rows::confidence_of_row;
use super::sources::{FileView, Known, Sources};
use super::types::Source;
use crate::fmap::{Confidence, FunctionalMap, MapOptions};
use crate::labels::LabelModel;
use crate::pipeline::{
    DescriptionView, Labelling, Prepared, Vote, descriptor_distance, map, map_from,
};
use crate::store::{MapRow, ShapeId};
use rayon::prelude::*;
use std::sync::Arc;

/// A shape with the values that labelling derives from it under a label model.
#[derive(Debug)]
pub(super) struct PreparedShape<'a> {
    pub(super) view: DescriptionView<'a>,
    pub(super) prepared: Arc<Prepared>,
}

impl<'a> PreparedShape<'a> {
    pub(super) fn new(sources: &dyn Sources, shape: FileView<'a>, model: &LabelModel) -> Self {
        Self {
            view: shape.view,
            prepared: sources.prepared(shape, model),
        }
    }

    /// Computes the functional map from this shape to another.
    pub(super) fn map_to(&self, to: &PreparedShape<'_>) -> FunctionalMap {
        let options = MapOptions::default();
        map(
            (&self.view, &self.prepared),
            (&to.view, &to.prepared),
            &options,
        )
    }

    /// Computes a map like [`Self::map_to`], but starts from a map `c_12 (k, k1)` instead of
    /// nearest neighbours of descriptors.
    pub(super) fn map_grown_from(
        &self,
        to: &PreparedShape<'_>,
        start: (&[f32], usize),
    ) -> FunctionalMap {
        let options = MapOptions::default();
        map_from(
            (&self.view, &self.prepared),
            (&to.view, &to.prepared),
            start,
            &options,
        )
    }
}

/// A labelling of a new shape, the maps that votes came through, and the shapes that voted.
#[derive(Debug)]
pub(super) struct Voted {
    pub(super) labelling: Labelling,
    pub(super) sources: Vec<Source>,
    /// Each map with the shape that it comes from.
    pub(super) maps: Vec<(ShapeId, FunctionalMap)>,
}

impl Voted {
    pub(super) fn new(labelling: Labelling, voters: &[Voter], maps: Vec<FunctionalMap>) -> Self {
        Self {
            sources: sources_of(voters, &labelling.weights),
            maps: voters.iter().map(|v| v.known.row.id).zip(maps).collect(),
            labelling,
        }
    }

    /// Splits an optional value into the labelling, the shapes that voted, and the maps; none
    /// without a value.
    pub(super) fn parts(
        voted: Option<Self>,
    ) -> (
        Option<Labelling>,
        Vec<Source>,
        Vec<(ShapeId, FunctionalMap)>,
    ) {
        match voted {
            Some(v) => (Some(v.labelling), v.sources, v.maps),
            None => (None, Vec::new(), Vec::new()),
        }
    }
}

/// A stored shape that votes.
#[derive(Debug)]
pub(super) struct Voter {
    pub(super) known: Known,
    /// Its label probabilities; `None`: those of its newest labels.
    probabilities: Option<Vec<u8>>,
    /// Weight of its vote, relative to that of a shape whose labels were propagated.
    trust: f64,
}

impl Voter {
    /// A shape that votes with its newest labels. If a model of another epoch computed them, with
    /// perhaps other classes, the vote uses the labels themselves instead of probabilities.
    pub(super) fn new(known: Known, model: &LabelModel) -> Self {
        Self::training(known, None, 1.0, model)
    }

    /// A shape that votes with its newest labels, or with other probabilities, and has the weight
    /// `trust`.
    pub(super) fn training(
        known: Known,
        probabilities: Option<Vec<u8>>,
        trust: f64,
        model: &LabelModel,
    ) -> Self {
        let (labels, k) = (&known.labels, model.labels.len());
        let is_current = known.row.label_epoch == model.epoch
            && labels.proxy_probabilities.len() == labels.proxy_labels.len() * k;
        let class = |id: &i32| {
            let found = model
                .labels
                .iter()
                .position(|l| i64::from(*l) == i64::from(*id));
            found.map(|c| c as u32)
        };
        let probabilities = match probabilities {
            None if !is_current => {
                let classes: Vec<Option<u32>> = labels.proxy_labels.iter().map(class).collect();
                Some(one_hot(&classes, k))
            }
            probabilities => probabilities,
        };
        Self {
            known,
            probabilities,
            trust,
        }
    }
}

/// Returns probabilities `(m, k)` of given classes; zeros for faces without one.
pub(super) fn one_hot(classes: &[Option<u32>], k: usize) -> Vec<u8> {
    let mut out = vec![0; classes.len() * k];
    for (row, class) in out.chunks_exact_mut(k).zip(classes) {
        if let Some(class) = class {
            row[*class as usize] = u8::MAX;
        }
    }
    out
}

/// The values that votes need of a map to the shape that is labelled.
#[derive(Debug, Clone)]
pub(super) struct IncomingMap {
    p2p_21: Vec<u32>,
    confidence: Confidence,
}

impl IncomingMap {
    pub(super) fn of_row(row: MapRow) -> Result<Self> {
        Ok(Self {
            confidence: confidence_of_row(&row)?,
            p2p_21: row.p2p_21,
        })
    }

    /// Returns, for each vertex of the shape that is labelled, a vertex of the voter.
    pub(super) fn p2p_21(&self) -> &[u32] {
        &self.p2p_21
    }

    pub(super) fn confidence(&self) -> &Confidence {
        &self.confidence
    }
}

impl From<&FunctionalMap> for IncomingMap {
    fn from(map: &FunctionalMap) -> Self {
        Self {
            p2p_21: map.p2p_21.clone(),
            confidence: map.confidence.clone(),
        }
    }
}

/// Makes one vote for each voter and its map.
pub(super) fn votes<'a>(voters: &'a [Voter], maps: &'a [IncomingMap]) -> Vec<Vote<'a>> {
    let vote = |(voter, map): (&'a Voter, &'a IncomingMap)| Vote {
        faces: voter.known.view().faces,
        probabilities: match &voter.probabilities {
            Some(probabilities) => probabilities,
            None => &voter.known.labels.proxy_probabilities,
        },
        p2p: &map.p2p_21,
        confidence: &map.confidence,
        trust: voter.trust,
    };
    voters.iter().zip(maps).map(vote).collect()
}

/// Returns the voters as the sources of a labelling, with the weights of their votes.
pub(super) fn sources_of(voters: &[Voter], weights: &[f64]) -> Vec<Source> {
    let source = |(voter, weight): (&Voter, &f64)| Source {
        shape: voter.known.row.name.clone(),
        version: voter.known.row.version,
        weight: *weight,
    };
    voters.iter().zip(weights).map(source).collect()
}

/// Computes the map from a stored shape to another one.
pub(super) fn new_map(
    sources: &dyn Sources,
    from: &Known,
    to: &PreparedShape<'_>,
    model: &LabelModel,
) -> FunctionalMap {
    PreparedShape::new(sources, from.file(), model).map_to(to)
}

/// Computes the map from each voter to a shape.
pub(super) fn new_maps(
    sources: &dyn Sources,
    voters: &[Voter],
    to: &PreparedShape<'_>,
    model: &LabelModel,
) -> Vec<FunctionalMap> {
    let voters = voters.par_iter();
    let maps = voters.map(|v| new_map(sources, &v.known, to, model));
    maps.collect()
}

/// Returns, best first, the `limit` shapes among some whose maps to a shape promise most. Twice as
/// many are selected by their signatures, then compared vertex by vertex.
pub(super) fn rank_candidates(
    collection: &Collection,
    sources: &dyn Sources,
    shape: FileView<'_>,
    among: &[usize],
    limit: usize,
) -> Result<Vec<usize>> {
    let nearest = {
        let view = &shape.view;
        collection.nearest_among(among, view.signature, view.n_descriptors, 2 * limit)
    };
    let nearest: Vec<usize> = nearest.into_iter().map(|(at, _)| at).collect();
    let Some(model) = collection.label_model().filter(|_| nearest.len() > limit) else {
        return Ok(nearest);
    };
    let shape = sources.prepared(shape, model);
    let compared = nearest.into_par_iter().map(|at| {
        let known = sources.arrays(collection.shapes()[at].id)?;
        let known = sources.prepared(known.view(), model);
        Ok((descriptor_distance(&known, &shape), at))
    });
    let mut found: Vec<(f64, usize)> = compared.collect::<Result<_>>()?;
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    found.truncate(limit);
    Ok(found.into_iter().map(|(_, at)| at).collect())
}
