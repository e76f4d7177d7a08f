//! Makes proposals in the background.
//!
//! A step finds the candidates with one number of labels and stores them; the last one picks the
//! proposals. Steps read the shapes without holding the collection, so nothing that a person asks
//! for waits for them, and a process that is killed loses at most one.

use super::collection::{Collection, Regime, State, chosen};
use super::error::{LibraryError, Result};
use super::facade::Library;
use super::lookup::require_collection;
use super::reason::Reason;
use super::rows::{damaged, from_json, to_json};
use super::sources::{Known, Sources};
use crate::labels::{Candidate, PROPOSED_LABELS, Proposal};
use crate::pipeline::{DescriptionView, proposal_candidates, proposals};
use crate::store::{CandidatesRow, CollectionId, CollectionRow, Digest, ProposalRow, Reader};
use serde::{Deserialize, Serialize};

/// Number of shapes from which on proposals are made: on fewer, too little recurs.
pub const MIN_PROPOSED_SHAPES: u64 = 3;

/// The proposals of a collection.
#[derive(Debug, Clone, PartialEq)]
pub struct Proposals {
    /// From coarse to fine.
    pub proposals: Vec<ProposalInfo>,
    /// Distinguishes them from those that were made before or are made later; empty if there are
    /// none.
    pub set: String,
    /// Number of steps of making new ones, and how many of them are done; both 0 if none are made.
    pub n_steps: u32,
    /// See `n_steps`.
    pub n_done: u32,
    /// Number of shapes that are divided.
    pub n_shapes: u64,
    /// Names of those that are still there, in the order of their arrival.
    pub shapes: Vec<String>,
}

/// A division of some shapes of a collection into labels.
#[derive(Debug, Clone, PartialEq)]
pub struct ProposalInfo {
    /// Its number, from 1.
    pub n: u32,
    /// Number of its labels.
    pub n_labels: u32,
    /// Its value among divisions with as many labels; see docs/methods.md.
    pub value: f64,
    /// Whether it is the labels in force.
    pub in_force: bool,
    /// 1 − the normalised mutual information with the labels in force: 0 if they are the same.
    pub differs: f64,
}

/// Labels of a shape in a proposal.
#[derive(Debug, Clone, PartialEq)]
pub struct ProposedLabels {
    /// The shape.
    pub shape: String,
    /// Class of each polygon `(n_polygons,)`, from 0.
    pub labels: Vec<i32>,
}

/// The shapes that proposals divide, and what else they depend on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Basis {
    /// The newest ordinal when clustering was due.
    clustered: u64,
    /// The up axis as it was set, and along which the labels in force were found.
    up: (String, Option<[f64; 3]>),
    /// The shapes, by digest.
    pub(super) shapes: Vec<i64>,
}

/// The stored proposals.
pub(super) struct StoredProposals {
    pub(super) basis: Basis,
    /// See [`Proposals::set`].
    pub(super) set: String,
    /// Number of proxy faces of each shape.
    pub(super) n_faces: Vec<u32>,
    pub(super) rows: Vec<ProposalRow>,
}

/// The key of the proposals that a collection should have: the newest ordinal when clustering was
/// due, and the up axis.
pub(super) type Wanted = (u64, (String, Option<[f64; 3]>));

/// Returns the key of the proposals that a collection should have; `None` if none are made.
pub(super) fn wanted(reader: &Reader<'_>, row: &CollectionRow) -> Result<Option<Wanted>> {
    let state = State::of(row)?;
    let is_discovering = state.regime == Regime::Discovering;
    if !is_discovering || row.epoch == 0 || reader.n_shapes(row.id)? < MIN_PROPOSED_SHAPES {
        return Ok(None);
    }
    let axis = state.up.and_then(|up| up.vote().trusted());
    Ok(Some((state.clustered_ordinal(), (row.up.clone(), axis))))
}

/// Reads the stored proposals of a collection.
pub(super) fn stored(reader: &Reader<'_>, id: CollectionId) -> Result<Option<StoredProposals>> {
    let mut rows = reader.proposals(id)?;
    if rows.is_empty() {
        return Ok(None);
    }
    // The first row has no labels: it is there even if nothing can be proposed.
    let head = rows.remove(0);
    let bad = || damaged("proposals", "the row 0 is gone or cut");
    let (counts, []) = head.labels.as_chunks::<4>() else {
        return Err(bad());
    };
    let basis: Basis = from_json(&head.basis, "proposals")?;
    let n_faces: Vec<u32> = counts.iter().map(|n| u32::from_le_bytes(*n)).collect();
    let n_all: usize = n_faces.iter().map(|n| *n as usize).sum();
    let is_whole = |row: &ProposalRow| row.labels.len() == n_all;
    if head.n != 0 || n_faces.len() != basis.shapes.len() || !rows.iter().all(is_whole) {
        return Err(bad());
    }
    let digest = Digest::of(head.basis.as_bytes()).to_string();
    Ok(Some(StoredProposals {
        set: digest[..SET_CHARS].to_owned(),
        basis,
        n_faces,
        rows,
    }))
}

/// Number of characters of [`Proposals::set`].
const SET_CHARS: usize = 16;

impl Basis {
    /// Returns whether proposals for these shapes are those that a collection should have.
    pub(super) fn is_wanted(&self, wanted: &Wanted) -> bool {
        (self.clustered, &self.up) == (wanted.0, &wanted.1)
    }
}

impl StoredProposals {
    /// Returns the labels of one proposal on each shape.
    pub(super) fn labels(&self, row: &ProposalRow) -> Vec<Vec<u32>> {
        let mut rest = row.labels.iter().map(|l| u32::from(*l));
        let of = |n: &u32| rest.by_ref().take(*n as usize).collect();
        self.n_faces.iter().map(of).collect()
    }

    /// Returns the proposal with a number from 1.
    pub(super) fn find(&self, collection: &str, n: u32) -> Result<&ProposalRow> {
        let found = self.rows.iter().find(|row| row.n == n);
        found.ok_or_else(|| {
            let message = format!(
                "proposal {n} is named, but collection {collection:?} has {}; list them",
                self.rows.len()
            );
            LibraryError::invalid(Reason::FieldRange, message)
        })
    }
}

impl Library {
    /// Returns whether a collection lacks proposals for its present labels, so that
    /// [`Library::propose_next`] has something to do.
    ///
    /// # Errors
    /// There is no such collection.
    pub fn lacks_proposals(&self, collection: &str) -> Result<bool> {
        self.store.catalog().read(|r| {
            let row = require_collection(r, collection)?;
            let Some(wanted) = wanted(r, &row)? else {
                return Ok(false);
            };
            let Some(basis) = r.proposals_basis(row.id)? else {
                return Ok(true);
            };
            let basis: Basis = from_json(&basis, "proposals")?;
            Ok(!basis.is_wanted(&wanted))
        })
    }

    /// Makes one step towards the proposals of a collection: the candidates with one number of
    /// labels, or the choice among all. Returns false if there is nothing to do. The proposals do
    /// not depend on when the steps are made, unless shapes are removed in between.
    ///
    /// # Errors
    /// There is no such collection, or the store fails.
    pub fn propose_next(&self, collection: &str) -> Result<bool> {
        if !self.lacks_proposals(collection)? {
            return Ok(false);
        }
        let found = self.store.catalog().read(|r| -> Result<_> {
            let row = require_collection(r, collection)?;
            let wanted = wanted(r, &row)?;
            let candidates = r.candidates(row.id)?;
            Ok((wanted, candidates, Collection::load(r, row)?))
        })?;
        let (Some((clustered, up)), rows, collection) = found else {
            return Ok(false);
        };
        let at = chosen::divided(&collection);
        let basis = Basis {
            clustered,
            up,
            shapes: at.iter().map(|at| collection.shapes()[*at].id.0).collect(),
        };
        let text = to_json(&basis);
        let rows: Vec<CandidatesRow> = rows.into_iter().filter(|r| r.basis == text).collect();
        let known = at
            .iter()
            .map(|at| self.store.known(collection.shapes()[*at].id));
        let known: Vec<Known> = known.collect::<Result<_>>()?;
        let views: Vec<DescriptionView<'_>> = known.iter().map(Known::view).collect();
        let axis = collection.label_model().and_then(|m| m.up);
        let mut ks = PROPOSED_LABELS.map(|k| k as u32);
        let next = ks.find(|k| rows.iter().all(|row| row.n_labels != *k));
        let id = collection.id();
        let Some(k) = next else {
            return self.pick_proposals(id, &text, &views, axis, &rows);
        };
        let row = CandidatesRow {
            n_labels: k,
            basis: text,
            found: encoded(&proposal_candidates(&views, axis, k as usize)),
        };
        self.store.catalog().write(|tx| -> Result<bool> {
            let is_there = tx.collection_by_id(id)?.is_some();
            if is_there {
                tx.put_candidates(id, &row)?;
            }
            Ok(is_there)
        })
    }

    /// Picks the proposals among the candidates and stores them.
    fn pick_proposals(
        &self,
        id: CollectionId,
        basis: &str,
        views: &[DescriptionView<'_>],
        axis: Option<[f64; 3]>,
        rows: &[CandidatesRow],
    ) -> Result<bool> {
        let n_patches: usize = views.iter().map(|v| n_patches(v)).sum();
        let mut candidates = Vec::new();
        for row in rows {
            candidates.extend(decoded(row, n_patches)?);
        }
        let row = |n: usize, n_labels: usize, value: f64, labels: Vec<u8>| ProposalRow {
            n: n as u32,
            basis: basis.to_owned(),
            n_labels: n_labels as u32,
            value,
            labels,
        };
        let counts = views
            .iter()
            .flat_map(|v| (v.faces.len() as u32).to_le_bytes());
        let mut all = vec![row(0, 0, 0.0, counts.collect())];
        let found = proposals(views, axis, &candidates);
        all.extend(found.iter().enumerate().map(|(at, p)| {
            let labels = p.labels.concat().iter().map(|l| *l as u8).collect();
            row(at + 1, p.n_labels, p.value, labels)
        }));
        self.store.catalog().write(|tx| -> Result<bool> {
            let is_there = tx.collection_by_id(id)?.is_some();
            if is_there {
                tx.set_proposals(id, &all)?;
            }
            Ok(is_there)
        })
    }
}

/// Returns the error for a collection that has no proposals, and gets none.
pub(super) fn nothing_proposed(row: &CollectionRow) -> LibraryError {
    let name = &row.name;
    let is_discovering = State::of(row).is_ok_and(|s| s.regime == Regime::Discovering);
    let message = match is_discovering {
        true => format!(
            "nothing is proposed for collection {name:?} yet: proposals are made from \
             {MIN_PROPOSED_SHAPES} shapes on, and some seconds after shapes were added; add \
             shapes, or wait"
        ),
        false => format!(
            "nothing is proposed for collection {name:?}: a person labelled it before proposals \
             were made, and labels are discovered only until then; undo these changes to get some"
        ),
    };
    LibraryError::FailedPrecondition {
        reason: Reason::NoProposals,
        message,
    }
}

fn n_patches(view: &DescriptionView<'_>) -> usize {
    view.patches.iter().max().map_or(0, |p| *p as usize + 1)
}

/// Encodes candidates with the same number of labels: of each its value (f64), and a byte for each
/// patch.
fn encoded(candidates: &[Candidate]) -> Vec<u8> {
    let mut out = Vec::new();
    for c in candidates {
        out.extend(c.value.to_le_bytes());
        out.extend(c.of_patch.iter().map(|l| *l as u8));
    }
    out
}

fn decoded(row: &CandidatesRow, n_patches: usize) -> Result<Vec<Candidate>> {
    let bad = || damaged("candidates", "a candidate is cut or has too large a label");
    let mut found = Vec::new();
    for bytes in row.found.chunks(size_of::<f64>() + n_patches) {
        let (value, labels) = bytes.split_first_chunk().ok_or_else(bad)?;
        if labels.len() != n_patches || labels.iter().any(|l| u32::from(*l) >= row.n_labels) {
            return Err(bad());
        }
        found.push(Candidate {
            n_labels: row.n_labels as usize,
            value: f64::from_le_bytes(*value),
            of_patch: labels.iter().map(|l| u32::from(*l)).collect(),
        });
    }
    Ok(found)
}

/// Returns a stored proposal as a division of those of its shapes that are `kept`.
pub(super) fn division(stored: &StoredProposals, row: &ProposalRow, kept: &[bool]) -> Proposal {
    let labels = stored.labels(row).into_iter().zip(kept);
    Proposal {
        n_labels: row.n_labels as usize,
        value: row.value,
        labels: labels.filter(|l| *l.1).map(|l| l.0).collect(),
    }
}
