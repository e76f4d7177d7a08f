//! A person labels faces of a shape: they are pinned, and everything else follows from them.

use super::commit::{collection_row, event};
use super::history::{Before, from_reply};
use super::lane::Lane;
use super::place::Known;
use super::relabel::{NewLabels, area_shares, cause, face_ids, moves};
use super::rows::{CarryingState, CollectionState, Teaching, damaged, label_colour, to_json};
use super::submit::unix_secs;
use super::{
    EventKind, FailureSubject, LabelId, Library, LibraryError, PartInfo, RequestKey, Result,
};
use crate::correspondence::parts;
use crate::pipeline::{DescriptionView, proxy_pins};
use crate::segmentation::Surface;
use crate::store::{Digest, LabelRow, LabelSummary, LabelVersionRow, Tx};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeSet, VecDeque};

/// Largest label id that a person can choose.
pub const MAX_LABEL: u32 = 65_535;
/// Most labels of a collection that a person can use.
pub const MAX_LABELS: usize = 64;
/// Share of a shape's area that a person must have labelled for the shape to say which labels there are.
const WHOLE: f64 = 0.9;

/// What a person says of a shape.
#[derive(Debug, Clone, PartialEq)]
pub enum Correction {
    /// A label for each polygon `(n_polygons,)`; -1 leaves the polygon alone.
    Whole(Vec<i32>),
    /// One label for some polygons.
    Faces {
        /// Which polygons, from 0.
        faces: Vec<u32>,
        /// Their label.
        label: LabelId,
    },
    /// One label for a part, numbered as in [`super::ShapeInfo::parts`].
    Part {
        /// Which part.
        part: u32,
        /// Its label.
        label: LabelId,
    },
}

/// What a correction did.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Corrected {
    /// Version of the shape's labels.
    pub version: u64,
    /// Sequence number of the collection after it.
    pub sequence: u64,
    /// Faces of the shape that a person labelled, now or before.
    pub n_faces: u64,
    /// Share of the shape's area that those cover.
    pub area_share: f64,
    /// Share of the shape's area whose label changed.
    pub changed_share: f64,
    /// Shapes whose labels wait to be recomputed from it.
    pub n_stale: u64,
    /// The job in which it is carried to them; 0 for what an earlier version answered.
    #[serde(default)]
    pub job: u64,
}

/// Labels that a person used, and whether they are all there is.
pub(super) struct Vocabulary {
    pub(super) labels: BTreeSet<LabelId>,
    pub(super) closed: bool,
}

impl Library {
    /// Labels faces of a shape by hand. They keep these labels for ever; those of other shapes follow, in the
    /// background, from this shape and the others that were corrected. Ids that are not there are created.
    ///
    /// # Errors
    /// There is no such collection or shape, or a label or a number of labels is out of range.
    pub fn correct(
        &self,
        collection: &str,
        shape: &str,
        correction: &Correction,
        key: Option<&RequestKey>,
    ) -> Result<Corrected> {
        let text = format!("correct {collection:?} {shape:?} {correction:?}");
        let request = Digest::of(text.as_bytes());
        let row = self.collection_row(collection)?;
        self.with_lane(row, |lane| {
            if let Some(reply) = self.answered(key, request)? {
                return from_reply(&reply);
            }
            let id = self.shape_row(collection, shape)?.1.id;
            let known = self.known(id)?;
            let view = known.mapped.view();
            let said = polygon_labels(&known, &view, correction)?;
            let pinned = self.store.catalog().read(|r| r.pins(id))?;
            let mut pins = pinned.unwrap_or_else(|| vec![-1; said.len()]);
            for (pin, said) in pins.iter_mut().zip(&said) {
                if *said >= 0 {
                    *pin = *said;
                }
            }
            let before = self.vocabulary(lane, None)?;
            let after = self.vocabulary(lane, Some((&known, &pins)))?;
            let in_use = active_labels(lane, &before);
            if after.labels.len() > MAX_LABELS {
                let message = format!(
                    "collection {collection:?} would have {} labels, the limit is {MAX_LABELS}",
                    after.labels.len()
                );
                return Err(LibraryError::invalid("LABEL_LIMIT", message));
            }
            let new = corrected_labels(&known, &view, &pins);
            let moved = moves(
                &known.labels.polygon_labels,
                &new.row.polygon_labels,
                view.polygon_area,
            );
            let covered = pinned_share(&view, &pins);
            let whole = pins.iter().all(|p| *p >= 0);
            let mut state = lane.state.clone();
            let mut teaching = match state.teaching.take() {
                Some(teaching) => teaching,
                None => self.discovered(lane)?,
            };
            teaching.pending = true;
            teaching.normalised = false;
            teaching.closed = after.closed;
            state.teaching = Some(teaching);
            let reply = self.once(key, request, |tx| {
                let collection = lane.row.id;
                let before = Before::labels(tx, lane, &[id])?;
                let detail = to_json(&serde_json::json!({ "shape": shape }));
                tx.insert_correction(collection, "correct", &detail, &before.encode())?;
                for label in after.labels.iter().filter(|l| !in_use.contains(l)) {
                    use_label(tx, lane, *label)?;
                }
                if after.closed {
                    for label in in_use.iter().filter(|l| !after.labels.contains(l)) {
                        event(tx, collection, &EventKind::LabelRetired { label: *label })?;
                    }
                }
                tx.set_pins(id, Some(&pins))?;
                let corrected = EventKind::Corrected {
                    shape: shape.into(),
                    version: known.row.version + 1,
                    n_faces: pins.iter().filter(|p| **p >= 0).count() as u64,
                    area_share: covered,
                };
                event(tx, collection, &corrected)?;
                let changed = EventKind::LabelsChanged {
                    shape: shape.into(),
                    version: known.row.version + 1,
                    cause: cause::CORRECTION.into(),
                    moves: moved.clone(),
                };
                let mut labels = new;
                labels.row.version = known.row.version + 1;
                labels.row.cause = cause::CORRECTION.into();
                labels.row.sequence = event(tx, collection, &changed)?;
                tx.put_labels(id, &labels.row, &labels.summary)?;
                tx.mark_all_stale(collection)?;
                tx.set_stale(id, !whole)?;
                let n_stale = tx.n_stale(collection)?;
                let job = tx.insert_job(&lane.row.name, unix_secs(), &[])?;
                let state = CollectionState {
                    carrying: Some(CarryingState {
                        job,
                        n_shapes: n_stale,
                    }),
                    ..state.clone()
                };
                tx.set_state(collection, to_json(&state).as_bytes())?;
                let row = collection_row(tx, collection)?;
                let corrected = Corrected {
                    version: labels.row.version,
                    sequence: row.sequence,
                    n_faces: pins.iter().filter(|p| **p >= 0).count() as u64,
                    area_share: covered,
                    changed_share: moved.iter().map(|m| m.area_share).sum(),
                    n_stale,
                    job,
                };
                Ok(to_json(&corrected).into_bytes())
            })?;
            self.reload(lane)?;
            from_reply(&reply)
        })
    }

    /// The labels that persons used in a collection, with the pins of one shape as they will be.
    pub(super) fn vocabulary(
        &self,
        lane: &Lane,
        with: Option<(&Known, &[i32])>,
    ) -> Result<Vocabulary> {
        let mut labels = BTreeSet::new();
        let mut closed = false;
        let mut take = |view: &DescriptionView<'_>, pins: &[i32]| {
            labels.extend(pins.iter().filter_map(|p| u32::try_from(*p).ok()));
            closed |= pinned_share(view, pins) >= WHOLE;
        };
        for shape in lane.shapes.iter().filter(|s| s.pinned) {
            if with.is_some_and(|(known, _)| known.row.id == shape.id) {
                continue;
            }
            let (known, pins) = self.pinned(shape.id)?;
            take(&known.mapped.view(), &pins);
        }
        if let Some((known, pins)) = with {
            take(&known.mapped.view(), pins);
        }
        Ok(Vocabulary { labels, closed })
    }

    /// A shape that a person labelled, with its pinned polygons.
    pub(super) fn pinned(&self, id: crate::store::ShapeId) -> Result<(Known, Vec<i32>)> {
        let pins = self.store.catalog().read(|r| r.pins(id))?;
        let gone = || damaged("pins", &format!("row {id} is gone"));
        Ok((self.known(id)?, pins.ok_or_else(gone)?))
    }

    /// What goes on counting of the labels that were discovered, when discovery ends.
    pub(super) fn discovered(&self, lane: &Lane) -> Result<Teaching> {
        let mut teaching = Teaching::default();
        if let Some(learnt) = &lane.learnt {
            teaching.discovered_labels.clone_from(&learnt.model.labels);
            let chosen = lane
                .shapes
                .iter()
                .filter(|s| lane.state.representatives.contains(&s.ordinal) && !s.stale);
            for shape in chosen {
                let version = self.store.catalog().read(|r| -> Result<_> {
                    Ok(r.shape(shape.id)?.map_or(0, |row| row.version))
                })?;
                teaching.discovered.push((shape.ordinal, version));
            }
        }
        Ok(teaching)
    }
}

/// Labels that shapes of a collection may carry before a change.
fn active_labels(lane: &Lane, used: &Vocabulary) -> BTreeSet<LabelId> {
    let mut labels = used.labels.clone();
    if !lane.state.teaching.as_ref().is_some_and(|t| t.closed) {
        labels.extend(lane.learnt.iter().flat_map(|l| &l.model.labels));
    }
    labels
}

/// Brings a label into use that a person named by its id.
fn use_label(tx: &Tx<'_>, lane: &Lane, id: LabelId) -> Result<()> {
    let collection = lane.row.id;
    let there = tx.labels(collection)?.into_iter().find(|l| l.id == id);
    let row = match there {
        // In use again: what it was merged into keeps what it has.
        Some(row) => LabelRow {
            merged_into: None,
            ..row
        },
        None => LabelRow {
            id,
            name: None,
            colour: label_colour(id),
            merged_into: None,
        },
    };
    tx.reserve_label(collection, id)?;
    tx.put_label(collection, &row)?;
    event(tx, collection, &EventKind::LabelCreated { label: id })?;
    Ok(())
}

/// What a correction says of each polygon; -1: nothing.
fn polygon_labels(
    known: &Known,
    view: &DescriptionView<'_>,
    correction: &Correction,
) -> Result<Vec<i32>> {
    let n = view.face_map.len();
    let name = &known.row.name;
    let in_range = |label: LabelId| -> Result<i32> {
        if label > MAX_LABEL {
            let message = format!("the label is {label}, but must be at most {MAX_LABEL}");
            return Err(LibraryError::invalid("LABEL_RANGE", message));
        }
        Ok(label as i32)
    };
    let mut said = vec![-1; n];
    match correction {
        Correction::Whole(labels) => {
            if labels.len() != n {
                let found = labels.len();
                let message =
                    format!("{found} labels were given, but shape {name:?} has {n} faces");
                return Err(LibraryError::invalid("LABEL_COUNT", message));
            }
            let bad = labels.iter().position(|l| *l < -1 || *l > MAX_LABEL as i32);
            if let Some(face) = bad {
                return Err(LibraryError::InvalidFace {
                    reason: "LABEL_RANGE",
                    message: format!(
                        "the label of face {face} is {}, but must be -1 to {MAX_LABEL}",
                        labels[face]
                    ),
                    subject: FailureSubject::Face(face as u64),
                });
            }
            said.clone_from(labels);
        }
        Correction::Faces { faces, label } => {
            let label = in_range(*label)?;
            for face in faces {
                let Some(slot) = said.get_mut(*face as usize) else {
                    return Err(LibraryError::InvalidFace {
                        reason: "FACE_INDEX",
                        message: format!("face {face} is named, but shape {name:?} has {n}"),
                        subject: FailureSubject::Face(u64::from(*face)),
                    });
                };
                *slot = label;
            }
        }
        Correction::Part { part, label } => {
            let label = in_range(*label)?;
            let ids = face_ids(&known.labels.proxy_labels);
            let pieces = parts(&Surface::new(&view.mesh()), &ids);
            let Some(id) = pieces.label.get(*part as usize) else {
                let n = pieces.label.len();
                let message = format!("part {part} is named, but shape {name:?} has {n}");
                return Err(LibraryError::invalid("PART_INDEX", message));
            };
            for (p, slot) in said.iter_mut().enumerate() {
                let is_in = pieces.part_of_face[view.face_map[p] as usize] == *part;
                if is_in && known.labels.polygon_labels[p] == *id as i32 {
                    *slot = label;
                }
            }
        }
    }
    if said.iter().all(|l| *l < 0) {
        let message =
            format!("no face of shape {name:?} is given a label, so nothing is corrected");
        return Err(LibraryError::invalid("NOTHING_CORRECTED", message));
    }
    Ok(said)
}

/// Share of the area of a shape that is pinned.
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

/// The newest labels of a shape with those that a person gave in their place.
fn corrected_labels(known: &Known, view: &DescriptionView<'_>, pins: &[i32]) -> NewLabels {
    let mut row = LabelVersionRow {
        proxy_labels: known.labels.proxy_labels.clone(),
        proxy_probabilities: known.labels.proxy_probabilities.clone(),
        polygon_labels: known.labels.polygon_labels.clone(),
        polygon_confidence: known.labels.polygon_confidence.clone(),
        sources_json: known.labels.sources_json.clone(),
        ..LabelVersionRow::default()
    };
    let labels: Vec<i32> = pins
        .iter()
        .copied()
        .filter(|p| *p >= 0)
        .collect::<BTreeSet<_>>()
        .into_iter()
        .collect();
    for (label, pin) in row
        .proxy_labels
        .iter_mut()
        .zip(pinned_faces(view, pins, &labels))
    {
        if let Some(class) = pin {
            *label = labels[class as usize];
        }
    }
    pin_polygons(&mut row, pins);
    let surface = Surface::new(&view.mesh());
    let pieces = parts(&surface, &face_ids(&row.proxy_labels));
    let infos: Vec<PartInfo> = pieces
        .label
        .iter()
        .zip(&pieces.area)
        .map(|(label, area_share)| PartInfo {
            label: *label,
            area_share: *area_share,
            confidence: 1.0,
        })
        .collect();
    let summary = LabelSummary {
        label_epoch: known.row.label_epoch,
        parts_json: to_json(&infos),
        area_shares: area_shares(view, &row.polygon_labels),
    };
    NewLabels { row, summary }
}

/// Class of each proxy face `(m,)` that a person labelled, given the pins `(n_polygons,)` and the label
/// of each class. If the whole shape is labelled, every proxy face is: one that stands for no polygon
/// takes the class of the nearest face that does, so that no face keeps a label that nobody gave.
pub(super) fn pinned_faces<L: Copy + Into<i64>>(
    view: &DescriptionView<'_>,
    pins: &[i32],
    labels: &[L],
) -> Vec<Option<u32>> {
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

/// Gives each face without a class that of the nearest face with one, counted in steps over edges and
/// bridges; of faces equally near, that of the one that was reached first, by ascending index.
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

/// Puts the labels that a person gave in the place of those that were found.
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
    use super::spread;
    use crate::mesh::icosphere;
    use crate::segmentation::Surface;

    #[test]
    fn faces_without_a_class_take_that_of_the_nearest_face() {
        let surface = Surface::new(&icosphere(2));
        let mut classes = vec![None; surface.n_faces()];
        spread(&surface, &mut classes);
        assert!(classes.iter().all(Option::is_none), "nothing to spread");
        // Two opposite faces: each takes the half that it is in, up to the size of a face.
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
