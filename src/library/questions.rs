//! Asks a person for the label of one part at a time, the part whose answer is worth most, and
//! takes the answers.

use super::change::{LabelEdit, Undoable};
use super::collection::Collection;
use super::correct::{Corrected, Correction, Said, corrects};
use super::error::{LibraryError, Result};
use super::facade::Library;
use super::names::check_name;
use super::once::{Request, answered, from_reply};
use super::pins::pins_of;
use super::reason::Reason;
use super::review_rows::{check_reviewer, review_row};
use super::rows::{label_colour, resolved, to_json};
use super::sources::{Known, Sources};
use super::types::{LabelId, RequestKey};
use super::verdict::ReviewState;
use crate::description::DescriptionView;
use crate::labels::{Normalisation, Statistics};
use crate::pipeline::{Background, CandidateShape, Question, ShapeParts, next_question};
use crate::store::{LabelRow, PassedPart, ShapeId};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Maximum number of shapes, besides those with answers, from whose parts the next question is
/// chosen. The cost grows with the square.
const MAX_ASKED: usize = 100;
/// Maximum number of shapes with answers that are considered: those with the least digests.
const MAX_ANSWERED: usize = 60;
/// Maximum number of bytes of a label's name.
const MAX_LABEL_NAME: usize = 128;

/// A part that a person is asked about.
#[derive(Debug, Clone, PartialEq)]
pub struct PartQuestion {
    /// Its shape.
    pub shape: String,
    /// Its number among the parts into which questions divide the shape. These depend on the shape
    /// alone, and are not those of [`super::ShapeInfo::parts`].
    pub part: u32,
    /// Its polygons, ascending.
    pub faces: Vec<u32>,
    /// Its share of the shape's area.
    pub area_share: f64,
    /// Probability that its most likely label is wrong.
    pub doubt: f64,
    /// Area that the answer is expected to decide, in units of a shape's area.
    pub gain: f64,
    /// The most likely labels.
    pub likeliest: Vec<OfferedLabel>,
    /// Number of parts in which a person has labelled faces.
    pub n_answered: u64,
}

/// A label that may be the answer.
#[derive(Debug, Clone, PartialEq)]
pub struct OfferedLabel {
    /// Its id.
    pub label: LabelId,
    /// Its name, if it has one.
    pub name: Option<String>,
    /// How probable it is.
    pub probability: f64,
    /// Whether a person has used it; if not, it was discovered.
    pub used: bool,
}

/// A person's answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer {
    /// The part has this label.
    Label(LabelId),
    /// The part has the label of this name. If no label is named so, the discovered label of most
    /// of the part gets the name, or a new label if a person has used or named that one.
    Named(String),
    /// The person passes the question over.
    Skip,
    /// The part has more than one label, because it is cut wrongly.
    CutWrongly,
}

/// The result of an answer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Answered {
    /// The new label of the part; `None` if it was passed over.
    pub label: Option<LabelId>,
    /// The correction that follows from the answer.
    pub corrected: Option<Corrected>,
}

impl Answer {
    fn text(&self) -> String {
        match self {
            Self::Label(label) => format!("label {label}"),
            Self::Named(name) => format!("named {name:?}"),
            Self::Skip => PASSED[0].to_owned(),
            Self::CutWrongly => PASSED[1].to_owned(),
        }
    }
}

/// Stored names of the reasons why parts are passed over: skipped, cut wrongly.
const PASSED: [&str; 2] = ["skip", "cut"];

/// A shape among whose parts the next question is chosen.
struct Candidate {
    /// Index in the collection.
    at: usize,
    parts: Arc<ShapeParts>,
    labelled: Vec<f64>,
    open: Vec<bool>,
}

/// The discovered labels of a collection, as questions need them.
struct Found<'a> {
    normalisation: &'a Normalisation,
    statistics: &'a Statistics,
    labels: &'a [LabelId],
}

impl Library {
    /// Returns the part whose label is most worth asking a person for, as ranked by
    /// [`next_question`](crate::pipeline::next_question). It depends on the shapes and on the
    /// labels that persons gave, not on the progress of their propagation. With `passed`, parts
    /// that were passed over may be asked about again.
    ///
    /// # Errors
    /// There is no such collection, or every part of it was answered or passed over.
    pub fn next_question(&self, collection: &str, passed: bool) -> Result<PartQuestion> {
        let row = self.collection_row(collection)?;
        self.with_collection(row, |collection| {
            let nothing = || LibraryError::FailedPrecondition {
                reason: Reason::NothingToAsk,
                message: format!(
                    "collection {:?} has no part to ask about: each was answered or passed over",
                    collection.row().name
                ),
            };
            let found = found(collection).ok_or_else(nothing)?;
            let pins = pins(collection, &self.store)?;
            let used: BTreeSet<LabelId> = pins
                .values()
                .flatten()
                .filter_map(|p| u32::try_from(*p).ok())
                .collect();
            let used: Vec<LabelId> = used.into_iter().collect();
            let passed_over = match passed {
                true => Vec::new(),
                false => self
                    .store
                    .catalog()
                    .read(|r| r.passed_parts(collection.id()))?,
            };
            let candidates = self.candidates(collection, &pins, &used, &passed_over)?;
            let shapes: Vec<CandidateShape<'_>> = candidates
                .iter()
                .map(|a| CandidateShape {
                    parts: &a.parts,
                    labelled: &a.labelled,
                    open: &a.open,
                })
                .collect();
            let known = Background {
                normalisation: found.normalisation,
                discovered: found.statistics,
                k: used.len(),
            };
            let question = next_question(&shapes, &known).ok_or_else(nothing)?;
            let labels = self.store.labels(collection.id())?;
            let likeliest = offered(&question, &used, found.labels, &labels);
            let with_area = |a: &Candidate| -> u64 {
                let k = used.len().max(1);
                let answered = a.labelled.chunks_exact(k);
                answered.filter(|row| row.iter().any(|x| *x > 0.0)).count() as u64
            };
            let shape = &candidates[question.shape];
            let known = self.store.known(collection.shapes()[shape.at].id)?;
            let view = known.view();
            let faces = faces_of(&view, &shape.parts, question.part);
            let area = faces
                .iter()
                .map(|f| f64::from(view.polygon_area[*f as usize]));
            Ok(PartQuestion {
                area_share: area.sum(),
                faces,
                shape: known.row.name.clone(),
                part: question.part,
                doubt: question.doubt,
                gain: question.gain,
                likeliest,
                n_answered: candidates.iter().map(with_area).sum(),
            })
        })
    }

    /// Takes the answer to a question. The part is pinned, and the labels of other shapes follow in
    /// the background. A part that is passed over is not asked about again.
    ///
    /// # Errors
    /// There is no such collection, shape, part or label, or a name or a number of labels is out of
    /// range.
    pub fn answer(
        &self,
        collection: &str,
        (shape, part): (&str, u32),
        answer: &Answer,
        by: &str,
        key: Option<&RequestKey>,
    ) -> Result<Answered> {
        check_reviewer(by)?;
        if let Answer::Named(name) = answer {
            check_name("label", name, MAX_LABEL_NAME)?;
        }
        let text = answer.text();
        let request = Request::of(
            key,
            &format!("answer {collection:?} {shape:?} {part} {text}"),
        );
        let row = self.collection_row(collection)?;
        self.with_collection(row, |in_memory| {
            if let Some(reply) = answered(&self.store, &request)? {
                return from_reply(&reply);
            }
            let id = self.shape_row(collection, shape)?.1.id;
            let known = self.store.known(id)?;
            let parts = self.parts.of(&self.store, id, axis(in_memory))?;
            if part as usize >= parts.n_parts() {
                let n = parts.n_parts();
                let message = format!("part {part} is named, but shape {shape:?} has {n}");
                return Err(LibraryError::invalid(Reason::PartIndex, message));
            }
            let faces = faces_of(&known.view(), &parts, part);
            let (label, new) = match answer {
                Answer::Label(label) => (*label, None),
                Answer::Named(name) => self.label_of_name(in_memory, name, (&known, &faces))?,
                Answer::Skip | Answer::CutWrongly => {
                    return self.pass(in_memory, id, part, &text, &request);
                }
            };
            let correction = Correction::Faces { faces, label };
            let mut corrects = corrects(in_memory, &self.store, id, &correction, Said::Sample)?;
            let change = &mut corrects.change;
            change.undoable = Some(Undoable::Answer {
                shape: shape.to_owned(),
            });
            change.labels.extend(new);
            let review = review_row(ReviewState::Corrected, by);
            change.reviews.push((id, Some(review)));
            let reply = corrects.commit(&self.store, in_memory, &request, |done| {
                to_json(&Answered {
                    label: Some(label),
                    corrected: Some(done),
                })
            })?;
            from_reply(&reply)
        })
    }

    fn pass(
        &self,
        collection: &Collection,
        shape: ShapeId,
        part: u32,
        why: &str,
        request: &Request<'_>,
    ) -> Result<Answered> {
        let passed = Answered {
            label: None,
            corrected: None,
        };
        self.store.catalog().write(|tx| {
            super::once::once(tx, request, |tx| {
                if tx.collection_by_id(collection.id())?.is_none() {
                    return Err(LibraryError::deleted(&collection.row().name));
                }
                tx.pass_part(shape, part, why)?;
                Ok(to_json(&passed).into_bytes())
            })
        })?;
        Ok(passed)
    }

    /// Returns the label of a name, and the edit that gives the name to a label if none has it: to
    /// the discovered label that the faces have, unless a person used or named it, or else to a new
    /// label. So a name holds at once wherever discovery found the same part.
    fn label_of_name(
        &self,
        collection: &Collection,
        name: &str,
        (known, faces): (&Known, &[u32]),
    ) -> Result<(LabelId, Option<LabelEdit>)> {
        let labels = self.store.labels(collection.id())?;
        let is_named = |l: &&LabelRow| l.merged_into.is_none() && l.name.as_deref() == Some(name);
        if let Some(row) = labels.iter().find(is_named) {
            return Ok((row.id, None));
        }
        let pins = pins(collection, &self.store)?;
        let discovered = found(collection).map_or(&[][..], |f| f.labels);
        let is_free = |row: &&LabelRow| {
            let id = i64::from(row.id);
            let is_used = pins.values().flatten().any(|p| i64::from(*p) == id);
            row.name.is_none() && row.merged_into.is_none() && !is_used
        };
        let own = label_of_most(known, faces).filter(|label| discovered.contains(label));
        let own = own.and_then(|label| labels.iter().find(|l| l.id == label));
        if let Some(row) = own.filter(is_free) {
            return Ok((row.id, Some(LabelEdit::Named(row.clone(), name.to_owned()))));
        }
        let id = collection.row().next_label;
        let row = LabelRow {
            id,
            name: None,
            colour: label_colour(id),
            merged_into: None,
        };
        Ok((id, Some(LabelEdit::Named(row, name.to_owned()))))
    }

    /// Returns the shapes from whose parts the next question is chosen: those of the least digests,
    /// with answers and without.
    fn candidates(
        &self,
        collection: &Collection,
        pins: &BTreeMap<usize, Vec<i32>>,
        used: &[LabelId],
        passed_over: &[PassedPart],
    ) -> Result<Vec<Candidate>> {
        let all = collection.representatives(collection.shapes().len());
        let (with, without): (Vec<usize>, Vec<usize>) =
            all.into_iter().partition(|at| pins.contains_key(at));
        let chosen: BTreeSet<usize> = with
            .into_iter()
            .take(MAX_ANSWERED)
            .chain(without.into_iter().take(MAX_ASKED))
            .collect();
        let up = axis(collection);
        let chosen: Vec<usize> = chosen.into_iter().collect();
        chosen
            .par_iter()
            .map(|&at| {
                let id = collection.shapes()[at].id;
                let parts = self.parts.of(&self.store, id, up)?;
                let mut labelled = vec![0.0; parts.n_parts() * used.len()];
                if let Some(pins) = pins.get(&at) {
                    let known = self.store.known(id)?;
                    let view = known.view();
                    for (polygon, pin) in pins.iter().enumerate() {
                        let class = used.iter().position(|l| i64::from(*l) == i64::from(*pin));
                        let Some(class) = class else { continue };
                        let face = view.face_map[polygon] as usize;
                        let part = parts.part_of_face[face] as usize;
                        labelled[part * used.len() + class] +=
                            f64::from(view.polygon_area[polygon]);
                    }
                }
                let mut open: Vec<bool> = (0..parts.n_parts())
                    .map(|part| {
                        let row = &labelled[part * used.len()..(part + 1) * used.len()];
                        row.iter().all(|area| *area <= 0.0)
                    })
                    .collect();
                for passed in passed_over.iter().filter(|p| p.shape == id) {
                    if let Some(slot) = open.get_mut(passed.part as usize) {
                        *slot = false;
                    }
                }
                Ok(Candidate {
                    at,
                    parts,
                    labelled,
                    open,
                })
            })
            .collect()
    }
}

/// Returns the label that more than half of the area of some polygons has.
fn label_of_most(known: &Known, faces: &[u32]) -> Option<LabelId> {
    let view = known.view();
    let mut area = BTreeMap::<i32, f64>::new();
    for face in faces {
        let label = known.labels.polygon_labels[*face as usize];
        *area.entry(label).or_default() += f64::from(view.polygon_area[*face as usize]);
    }
    let total: f64 = area.values().sum();
    let most = area.into_iter().find(|(_, a)| 2.0 * a > total)?;
    LabelId::try_from(most.0).ok()
}

/// Returns the up axis along which descriptors are taken.
fn axis(collection: &Collection) -> Option<[f64; 3]> {
    collection.label_model().and_then(|m| m.up)
}

/// Returns the discovered labels and the scale of descriptors.
fn found(collection: &Collection) -> Option<Found<'_>> {
    let model = collection.model()?;
    let supervision = collection.state().regime.supervision();
    let (statistics, labels) = match (&model.prior, supervision) {
        (Some(prior), Some(s)) => (&prior.statistics, s.discovered().labels.as_slice()),
        _ => (&model.model.statistics, model.model.labels.as_slice()),
    };
    Some(Found {
        normalisation: &model.model.normalisation,
        statistics,
        labels,
    })
}

/// Returns the pins of the shapes that persons labelled, by index.
fn pins(collection: &Collection, sources: &dyn Sources) -> Result<BTreeMap<usize, Vec<i32>>> {
    let shapes = collection.shapes().iter().enumerate();
    let pinned = shapes.filter(|s| s.1.pinned);
    pinned
        .map(|(at, shape)| Ok((at, pins_of(sources, shape.id)?)))
        .collect()
}

/// Returns the polygons of a part.
fn faces_of(view: &DescriptionView<'_>, parts: &ShapeParts, part: u32) -> Vec<u32> {
    let polygons = (0..view.face_map.len() as u32).zip(view.face_map);
    let is_in = |face: &u32| parts.part_of_face[*face as usize] == part;
    polygons.filter(|p| is_in(p.1)).map(|p| p.0).collect()
}

/// Returns the most likely labels of a question, each once, because discovered labels may have been
/// merged.
fn offered(
    question: &Question,
    used: &[LabelId],
    discovered: &[LabelId],
    labels: &[LabelRow],
) -> Vec<OfferedLabel> {
    let mut out: Vec<OfferedLabel> = Vec::new();
    for (class, probability) in &question.likeliest {
        let label = match used.get(*class) {
            Some(label) => Some(*label),
            None => discovered.get(class - used.len()).copied(),
        };
        let row = label.map(|label| resolved(labels, label));
        let row = row.and_then(|id| labels.iter().find(|l| l.id == id));
        let Some(row) = row else { continue };
        match out.iter_mut().find(|o| o.label == row.id) {
            Some(same) => same.probability += probability,
            None => out.push(OfferedLabel {
                label: row.id,
                name: row.name.clone(),
                probability: *probability,
                used: used.contains(&row.id),
            }),
        }
    }
    out.sort_by(|a, b| {
        b.probability
            .total_cmp(&a.probability)
            .then(a.label.cmp(&b.label))
    });
    out
}
