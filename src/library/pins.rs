//! Faces that a person labelled: the classes to which they are pinned, and the labels that persons
//! use.

use super::collection::Collection;
use super::collection::state::{Supervision, Vocabulary};
use super::error::Result;
use super::rows::damaged;
use super::sources::{Known, Sources};
use super::types::LabelId;
use crate::pipeline::{DescriptionView, proxy_pins};
use crate::segmentation::Surface;
use crate::store::{LabelVersionRow, ShapeId};
use std::collections::{BTreeSet, VecDeque};

/// Share of a shape's area that a person must have labelled for the shape to show its labels.
const WHOLE: f64 = 0.9;

/// The labels that persons used, and which others shapes can have.
#[derive(Debug)]
pub(super) struct UsedLabels {
    pub(super) labels: BTreeSet<LabelId>,
    pub(super) vocabulary: Vocabulary,
    /// The vocabulary if no person had said that there are no others.
    pub(super) shown: Vocabulary,
    /// Area that persons labelled, in shapes: that of a shape is 1.
    area: f64,
}

impl UsedLabels {
    /// Returns the vocabulary if the labelled faces are a sample of the collection: then they may
    /// show its labels together, although none of the shapes is labelled whole.
    pub(super) fn sampled(&self) -> Vocabulary {
        match self.vocabulary {
            Vocabulary::Open if self.area >= WHOLE => Vocabulary::Covered,
            vocabulary => vocabulary,
        }
    }
}

/// A stored shape whose pins are about to change.
#[derive(Debug, Clone, Copy)]
pub(super) enum Instead<'a> {
    /// It has these pins.
    Pinned(&'a Known, &'a [i32]),
    /// It is removed.
    Removed(ShapeId),
}

/// Returns the labels that persons used in a collection, after the change of one shape.
pub(super) fn used_labels(
    collection: &Collection,
    sources: &dyn Sources,
    instead: Option<Instead<'_>>,
) -> Result<UsedLabels> {
    let changed = match instead {
        Some(Instead::Pinned(known, _)) => Some(known.row.id),
        Some(Instead::Removed(id)) => Some(id),
        None => None,
    };
    let mut labels = BTreeSet::new();
    let mut shown = Vocabulary::Open;
    let mut area = 0.0;
    let mut take = |view: &DescriptionView<'_>, pins: &[i32]| {
        labels.extend(pins.iter().filter_map(|p| u32::try_from(*p).ok()));
        let share = pinned_share(view, pins);
        area += share;
        if share >= WHOLE {
            shown = Vocabulary::Covered;
        }
    };
    let pinned = collection.shapes().iter().filter(|s| s.pinned);
    for shape in pinned.filter(|s| Some(s.id) != changed) {
        take(
            &sources.known(shape.id)?.view(),
            &pins_of(sources, shape.id)?,
        );
    }
    if let Some(Instead::Pinned(known, pins)) = instead {
        take(&known.view(), pins);
    }
    let supervision = collection.state().regime.supervision();
    let vocabulary = match supervision.map(Supervision::vocabulary) {
        Some(Vocabulary::Closed) => Vocabulary::Closed,
        Some(Vocabulary::Covered) if area >= WHOLE => Vocabulary::Covered,
        _ => shown,
    };
    Ok(UsedLabels {
        labels,
        vocabulary,
        shown,
        area,
    })
}

/// Returns the pins of a shape that a person labelled.
pub(super) fn pins_of(sources: &dyn Sources, id: ShapeId) -> Result<Vec<i32>> {
    let pins = sources.pins(id)?;
    pins.ok_or_else(|| damaged("pins", &format!("row {id} is gone")))
}

/// Returns the share of the area of a shape that is pinned.
pub(super) fn pinned_share(view: &DescriptionView<'_>, pins: &[i32]) -> f64 {
    let area = view.polygon_area.iter().map(|a| f64::from(*a));
    let total: f64 = area.clone().sum();
    let pinned: f64 = area
        .zip(pins)
        .filter(|(_, p)| **p >= 0)
        .map(|(a, _)| a)
        .sum();
    pinned / total.max(1e-300)
}

/// Returns the class of each proxy face `(m,)` that a person labelled, from the pins
/// `(n_polygons,)` and the label of each class; empty if nothing is pinned. If the whole shape is
/// labelled, every proxy face gets a class: one that stands for no polygon takes the class of the
/// nearest face that does, so that no face keeps a label that nobody gave.
pub(super) fn pinned_faces<L: Copy + Into<i64>>(
    view: &DescriptionView<'_>,
    pins: &[i32],
    labels: &[L],
) -> Vec<Option<u32>> {
    if pins.is_empty() {
        return Vec::new();
    }
    let class = |pin: &i32| {
        let found = labels.iter().position(|l| (*l).into() == i64::from(*pin));
        found.map(|c| c as u32)
    };
    let of_polygon: Vec<Option<u32>> = pins.iter().map(class).collect();
    let mut classes = proxy_pins(view, &of_polygon, labels.len());
    if pins.iter().all(|p| *p >= 0) && classes.iter().any(Option::is_none) {
        spread(&Surface::new(&view.mesh()), &mut classes);
    }
    classes
}

/// Gives each face without a class that of the nearest face with one, counted in steps over edges
/// and bridges. Among equally near faces it is that of the face that was reached first, by
/// ascending index.
fn spread(surface: &Surface, classes: &mut [Option<u32>]) {
    let mut neighbours = vec![Vec::new(); classes.len()];
    for edge in &surface.edges {
        let [a, b] = edge.faces;
        neighbours[a as usize].push(b);
        neighbours[b as usize].push(a);
    }
    let with_class = (0..classes.len() as u32).filter(|f| classes[*f as usize].is_some());
    let mut reached: VecDeque<u32> = with_class.collect();
    while let Some(face) = reached.pop_front() {
        for next in &neighbours[face as usize] {
            if classes[*next as usize].is_none() {
                classes[*next as usize] = classes[face as usize];
                reached.push_back(*next);
            }
        }
    }
}

/// Overwrites computed labels with those that a person gave.
pub(super) fn pin_polygons(row: &mut LabelVersionRow, pins: &[i32]) {
    let slots = row
        .polygon_labels
        .iter_mut()
        .zip(&mut row.polygon_confidence);
    for ((label, confidence), pin) in slots.zip(pins) {
        if *pin >= 0 {
            *label = *pin;
            *confidence = u8::MAX;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{UsedLabels, Vocabulary, spread};
    use crate::mesh::icosphere;
    use crate::segmentation::Surface;
    use std::collections::BTreeSet;

    #[test]
    fn a_sample_as_large_as_a_shape_covers_an_open_vocabulary() {
        let sampled = |vocabulary, area| {
            let used = UsedLabels {
                labels: BTreeSet::new(),
                vocabulary,
                shown: Vocabulary::Open,
                area,
            };
            used.sampled()
        };
        assert_eq!(sampled(Vocabulary::Open, 0.5), Vocabulary::Open);
        assert_eq!(sampled(Vocabulary::Open, 1.5), Vocabulary::Covered);
        assert_eq!(sampled(Vocabulary::Closed, 1.5), Vocabulary::Closed);
    }

    #[test]
    fn faces_without_a_class_take_that_of_the_nearest_face() {
        let surface = Surface::new(&icosphere(2));
        let mut classes = vec![None; surface.n_faces()];
        spread(&surface, &mut classes);
        assert!(classes.iter().all(Option::is_none), "nothing to spread");
        // Two opposite faces: each takes its half, up to the size of a face.
        let far = |a: usize, b: usize| -> f64 {
            let (a, b) = (surface.centroids[a], surface.centroids[b]);
            (0..3).map(|i| (a[i] - b[i]).powi(2)).sum()
        };
        let opposite = (0..classes.len()).max_by(|a, b| far(0, *a).total_cmp(&far(0, *b)));
        let opposite = opposite.unwrap();
        (classes[0], classes[opposite]) = (Some(4), Some(7));
        spread(&surface, &mut classes);
        for (f, class) in classes.iter().enumerate() {
            let (here, there) = (far(0, f).sqrt(), far(opposite, f).sqrt());
            match class {
                Some(4) => assert!(here < there + 0.3, "{here} {there}"),
                Some(7) => assert!(there < here + 0.3, "{here} {there}"),
                other => panic!("face {f} has {other:?}"),
            }
        }
    }
}
