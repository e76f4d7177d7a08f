//! Pins the labels that a person gives to faces of a shape. The labels of all other faces follow
//! from them.

use super::change::{Change, LabelEdit, Undoable, commit_once};
use super::collection::state::Vocabulary;
use super::collection::{Collection, Staleness, supervised};
use super::error::{LibraryError, Result};
use super::event::EventKind;
use super::facade::Library;
use super::labelling::{NewLabels, Relabelled, area_shares, cause, face_ids};
use super::once::{Request, answered, from_reply};
use super::pins::{Instead, UsedLabels, pin_polygons, pinned_faces, pinned_share, used_labels};
use super::reason::Reason;
use super::review_rows::{check_reviewer, review_row};
use super::rows::to_json;
use super::sources::{Known, Sources};
use super::types::{FailureSubject, LabelId, PartInfo, RequestKey};
use super::verdict::ReviewState;
use crate::correspondence::parts;
use crate::pipeline::DescriptionView;
use crate::segmentation::Surface;
use crate::store::{Digest, LabelSummary, LabelVersionRow, ShapeId, Store};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;

/// Largest label id that a person can use.
pub const MAX_LABEL: u32 = 65_535;
/// Maximum number of labels of a collection that persons can use.
pub const MAX_LABELS: usize = 64;

/// Labels that a person gives to faces of a shape.
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

/// What else a person says with a correction.
#[derive(Debug, Clone, Copy, Default)]
pub struct CorrectionOptions<'a> {
    /// The person, recorded in the shape's review; may be empty.
    pub by: &'a str,
    /// True: there are no labels but those that persons used. False: discovered labels that no
    /// labelled shape shows are labels too. `None`: as before; false in the beginning.
    pub closed: Option<bool>,
}

/// What a person says about the labels of the collection by labelling faces.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Said {
    /// Nothing: the faces may be those that were wrong.
    Nothing,
    /// The faces are a sample of all, chosen by us.
    Sample,
    /// Whether there are no labels but those that persons used.
    Closed(bool),
}

/// What a correction did.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Corrected {
    /// New version of the shape's labels.
    pub version: u64,
    /// Sequence number of the collection after it.
    pub sequence: u64,
    /// Number of faces of the shape that a person labelled, now or before.
    pub n_faces: u64,
    /// Share of the shape's area that these faces cover.
    pub area_share: f64,
    /// Share of the shape's area whose label changed.
    pub changed_share: f64,
    /// Number of shapes whose labels wait to be recomputed from it.
    pub n_stale: u64,
    /// The job that propagates it to these shapes; 0 in a reply that an earlier version stored.
    #[serde(default)]
    pub job: u64,
}

impl Correction {
    /// Returns a digest that distinguishes this correction from every other one of the same shape.
    /// The layout is versioned: a different layout would refuse an honest repeat of a request that
    /// was answered before.
    fn digest(&self, collection: &str, shape: &str, closed: Option<bool>) -> Digest {
        let mut fields = blake3::Hasher::new();
        let mut field = |bytes: &[u8]| {
            fields.update(&(bytes.len() as u64).to_le_bytes());
            fields.update(bytes);
        };
        field(b"correct v1");
        field(collection.as_bytes());
        field(shape.as_bytes());
        match self {
            Self::Whole(labels) => {
                field(b"whole");
                field(bytemuck::cast_slice(labels));
            }
            Self::Faces { faces, label } => {
                field(b"faces");
                field(bytemuck::cast_slice(faces));
                field(&label.to_le_bytes());
            }
            Self::Part { part, label } => {
                field(b"part");
                field(&part.to_le_bytes());
                field(&label.to_le_bytes());
            }
        }
        if let Some(closed) = closed {
            field(if closed { b"closed" } else { b"open" });
        }
        Digest(*fields.finalize().as_bytes())
    }

    /// Returns the digest that version 0.1.0 stored: that of this value as text.
    fn digest_of_first_release(&self, collection: &str, shape: &str) -> Digest {
        let text = match self {
            Self::Whole(labels) => format!("Whole({labels:?})"),
            Self::Faces { faces, label } => format!("Faces {{ faces: {faces:?}, label: {label} }}"),
            Self::Part { part, label } => format!("Part {{ part: {part}, label: {label} }}"),
        };
        Digest::of(format!("correct {collection:?} {shape:?} {text}").as_bytes())
    }
}

/// A correction before it is written.
pub(super) struct Corrects {
    pub(super) change: Change,
    /// Version of the shape's labels before it.
    version: u64,
    n_faces: u64,
    area_share: f64,
    changed_share: f64,
}

impl Library {
    /// Labels faces of a shape by hand. They keep these labels until a person changes them. The
    /// labels of other shapes follow in the background from all training shapes. Labels with new
    /// ids are created.
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
        let options = CorrectionOptions::default();
        self.correct_with(collection, shape, correction, &options, key)
    }

    /// Does what [`Library::correct`] does, and what else `options` say.
    ///
    /// # Errors
    /// Those of [`Library::correct`]; or the name of the person is not valid.
    pub fn correct_with(
        &self,
        collection: &str,
        shape: &str,
        correction: &Correction,
        options: &CorrectionOptions<'_>,
        key: Option<&RequestKey>,
    ) -> Result<Corrected> {
        check_reviewer(options.by)?;
        let digest = correction.digest(collection, shape, options.closed);
        let request = Request {
            earlier: Some(correction.digest_of_first_release(collection, shape)),
            ..Request::new(key, digest)
        };
        let row = self.collection_row(collection)?;
        self.with_collection(row, |in_memory| {
            if let Some(reply) = answered(&self.store, &request)? {
                return from_reply(&reply);
            }
            let id = self.shape_row(collection, shape)?.1.id;
            let said = options.closed.map_or(Said::Nothing, Said::Closed);
            let mut corrects = corrects(in_memory, &self.store, id, correction, said)?;
            let review = review_row(ReviewState::Corrected, options.by);
            corrects.change.reviews.push((id, Some(review)));
            let reply = corrects.commit(&self.store, in_memory, &request, |done| to_json(&done))?;
            from_reply(&reply)
        })
    }
}

impl Corrects {
    /// Writes the correction. `reply` makes the text that is stored as its reply.
    pub(super) fn commit(
        self,
        store: &Store,
        collection: &mut Collection,
        request: &Request<'_>,
        reply: impl FnOnce(Corrected) -> String,
    ) -> Result<Vec<u8>> {
        let Self {
            change,
            version,
            n_faces,
            area_share,
            changed_share,
        } = self;
        commit_once(store, collection, change, request, |tx, now| {
            let corrected = Corrected {
                version,
                sequence: now.row.sequence,
                n_faces,
                area_share,
                changed_share,
                n_stale: tx.n_stale(now.row.id)?,
                job: now.job,
            };
            Ok(reply(corrected).into_bytes())
        })
    }
}

/// Returns the change that corrects one shape.
pub(super) fn corrects(
    collection: &Collection,
    sources: &dyn Sources,
    id: ShapeId,
    correction: &Correction,
    said: Said,
) -> Result<Corrects> {
    let known = sources.known(id)?;
    let view = known.view();
    let given = polygon_labels(&known, &view, correction)?;
    let pins = sources.pins(id)?;
    let mut pins = pins.unwrap_or_else(|| vec![-1; given.len()]);
    for (pin, given) in pins.iter_mut().zip(&given) {
        if *given >= 0 {
            *pin = *given;
        }
    }
    let before = used_labels(collection, sources, None)?;
    let mut after = used_labels(collection, sources, Some(Instead::Pinned(&known, &pins)))?;
    after.vocabulary = match said {
        Said::Nothing => after.vocabulary,
        Said::Sample => after.sampled(),
        Said::Closed(true) => Vocabulary::Closed,
        Said::Closed(false) => after.shown,
    };
    if after.labels.len() > MAX_LABELS {
        let message = format!(
            "collection {:?} would have {} labels, the limit is {MAX_LABELS}",
            collection.row().name,
            after.labels.len()
        );
        return Err(LibraryError::invalid(Reason::LabelLimit, message));
    }
    let in_use = active_labels(collection, &before);
    let new = after.labels.iter().filter(|l| !in_use.contains(l));
    let labels = new.map(|label| LabelEdit::Used(*label)).collect();
    let new = corrected_labels(&known, &view, &pins);
    let relabelled = Relabelled::new(&known, new, cause::CORRECTION);
    let version = relabelled.labels.row.version;
    let n_faces = pins.iter().filter(|p| **p >= 0).count() as u64;
    let area_share = pinned_share(&view, &pins);
    let changed_share = relabelled.moves.iter().map(|m| m.area_share).sum();
    let is_whole = pins.iter().all(|p| *p >= 0);
    let shape = known.row.name.clone();
    let change = Change {
        undoable: Some(Undoable::Correct {
            shape: shape.clone(),
        }),
        labels,
        pins: vec![(id, Some(pins))],
        closing: Some(EventKind::Corrected {
            shape,
            version,
            n_faces,
            area_share,
        }),
        relabelled: vec![relabelled],
        staleness: Staleness::All,
        stale: vec![(id, !is_whole)],
        state: Some(supervised::corrected(
            collection,
            sources,
            after.vocabulary,
        )?),
        propagates: true,
        ..Change::default()
    };
    Ok(Corrects {
        change,
        version,
        n_faces,
        area_share,
        changed_share,
    })
}

/// Returns the labels that shapes of a collection may have before a change.
fn active_labels(collection: &Collection, used: &UsedLabels) -> BTreeSet<LabelId> {
    let mut labels = used.labels.clone();
    labels.extend(collection.label_model().iter().flat_map(|m| &m.labels));
    labels
}

/// Returns the label that a correction gives to each polygon; -1 for none.
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
            return Err(LibraryError::invalid(Reason::LabelRange, message));
        }
        Ok(label as i32)
    };
    let mut given = vec![-1; n];
    match correction {
        Correction::Whole(labels) => {
            if labels.len() != n {
                let found = labels.len();
                let message =
                    format!("{found} labels were given, but shape {name:?} has {n} faces");
                return Err(LibraryError::invalid(Reason::LabelCount, message));
            }
            let bad = labels.iter().position(|l| *l < -1 || *l > MAX_LABEL as i32);
            if let Some(face) = bad {
                return Err(LibraryError::InvalidFace {
                    reason: Reason::LabelRange,
                    message: format!(
                        "the label of face {face} is {}, but must be -1 to {MAX_LABEL}",
                        labels[face]
                    ),
                    subject: FailureSubject::Face(face as u64),
                });
            }
            given.clone_from(labels);
        }
        Correction::Faces { faces, label } => {
            let label = in_range(*label)?;
            for face in faces {
                let Some(slot) = given.get_mut(*face as usize) else {
                    return Err(LibraryError::InvalidFace {
                        reason: Reason::FaceIndex,
                        message: format!("face {face} is named, but shape {name:?} has {n}"),
                        subject: FailureSubject::Face(u64::from(*face)),
                    });
                };
                *slot = label;
            }
        }
        Correction::Part { part, label } => {
            let label = in_range(*label)?;
            for polygon in part_polygons(known, view, *part)? {
                given[polygon as usize] = label;
            }
        }
    }
    if given.iter().all(|l| *l < 0) {
        let message =
            format!("no face of shape {name:?} is given a label, so nothing is corrected");
        return Err(LibraryError::invalid(Reason::NothingCorrected, message));
    }
    Ok(given)
}

/// Returns the polygons of a part, ascending.
pub(super) fn part_polygons(
    known: &Known,
    view: &DescriptionView<'_>,
    part: u32,
) -> Result<Vec<u32>> {
    let ids = face_ids(&known.labels.proxy_labels);
    let pieces = parts(&Surface::new(&view.mesh()), &ids);
    let Some(id) = pieces.label.get(part as usize) else {
        let (name, n) = (&known.row.name, pieces.label.len());
        let message = format!("part {part} is named, but shape {name:?} has {n}");
        return Err(LibraryError::invalid(Reason::PartIndex, message));
    };
    let is_in = |polygon: &u32| {
        let p = *polygon as usize;
        let part_of = pieces.part_of_face[view.face_map[p] as usize];
        part_of == part && known.labels.polygon_labels[p] == *id as i32
    };
    Ok((0..view.face_map.len() as u32).filter(is_in).collect())
}

/// Returns the newest labels of a shape, overwritten by those that a person gave.
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

#[cfg(test)]
mod tests {
    use super::Correction;
    use crate::store::Digest;

    /// This text identifies a repeat of a request that an earlier version answered.
    #[test]
    fn the_first_release_s_digest_is_that_of_the_value_as_text() {
        let part = Correction::Part { part: 3, label: 7 };
        let faces = Correction::Faces {
            faces: vec![2, 0],
            label: 9,
        };
        for (correction, text) in [
            (Correction::Whole(vec![-1, 4]), "Whole([-1, 4])"),
            (faces, "Faces { faces: [2, 0], label: 9 }"),
            (part, "Part { part: 3, label: 7 }"),
        ] {
            assert_eq!(
                format!("{correction:?}"),
                text,
                "the first release used Debug"
            );
            let text = format!("correct \"a\" \"b\\n\" {text}");
            let digest = correction.digest_of_first_release("a", "b\n");
            assert_eq!(digest, Digest::of(text.as_bytes()));
        }
    }

    #[test]
    fn corrections_that_differ_have_other_digests() {
        let faces = |faces: &[u32], label| Correction::Faces {
            faces: faces.to_vec(),
            label,
        };
        let part = |part, label| Correction::Part { part, label };
        let all = [
            ("a", "b", Correction::Whole(vec![1, 2])),
            ("a", "b", Correction::Whole(vec![2, 1])),
            ("ab", "", Correction::Whole(vec![1, 2])),
            ("a", "b", faces(&[1], 2)),
            ("a", "b", faces(&[1, 2], 2)),
            ("a", "b", faces(&[], 1)),
            ("a", "b", part(1, 2)),
            ("a", "b", part(2, 1)),
        ];
        let digest = |c: &(&str, &str, Correction)| c.2.digest(c.0, c.1, None).0;
        let distinct: std::collections::BTreeSet<[u8; 32]> = all.iter().map(digest).collect();
        assert_eq!(distinct.len(), all.len());
        assert_eq!(digest(&all[0]), digest(&all[0].clone()));
        let said = |closed| all[0].2.digest("a", "b", closed).0;
        assert!(said(None) != said(Some(true)) && said(Some(true)) != said(Some(false)));
    }
}
