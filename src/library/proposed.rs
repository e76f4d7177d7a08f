//! Lists the proposals of a collection, and reads their labels.

use super::error::{LibraryError, Result};
use super::facade::Library;
use super::lookup::require_collection;
use super::proposals::{
    Basis, ProposalInfo, Proposals, ProposedLabels, StoredProposals, nothing_proposed, stored,
    wanted,
};
use super::reason::Reason;
use super::rows::from_json;
use super::sources::{Known, Sources, mapped_shape};
use crate::labels::{PROPOSED_LABELS, agreement};
use crate::segmentation::Surface;
use crate::store::{CandidatesRow, CollectionRow, MappedDescription, ProposalRow, ShapeId};

/// Difference below which the labels in force count as one of the proposals.
const SAME: f64 = 0.01;

impl Library {
    /// Returns the proposals of a collection: those for its present labels or, while new ones are
    /// made, the previous ones.
    ///
    /// # Errors
    /// There is no such collection, or nothing is proposed for it; the error says why.
    pub fn proposals(&self, collection: &str) -> Result<Proposals> {
        let (row, wanted, stored, candidates) = self.store.catalog().read(|r| -> Result<_> {
            let row = require_collection(r, collection)?;
            let (wanted, stored) = (wanted(r, &row)?, stored(r, row.id)?);
            let candidates = r.candidates(row.id)?;
            Ok((row, wanted, stored, candidates))
        })?;
        let lacks = match (&wanted, &stored) {
            (Some(wanted), Some(stored)) => !stored.basis.is_wanted(wanted),
            (wanted, _) => wanted.is_some(),
        };
        let (mut n_steps, mut n_done) = (0, 0);
        if lacks {
            n_steps = PROPOSED_LABELS.count() as u32 + 1;
            let of = |c: &&CandidatesRow| {
                let basis = from_json::<Basis>(&c.basis, "candidates").ok();
                let basis = basis.zip(wanted.as_ref());
                basis.is_some_and(|(basis, wanted)| basis.is_wanted(wanted))
            };
            n_done = candidates.iter().filter(of).count() as u32;
        }
        let Some(stored) = stored else {
            if !lacks {
                return Err(nothing_proposed(&row));
            }
            return Ok(Proposals {
                proposals: Vec::new(),
                set: String::new(),
                n_steps,
                n_done,
                n_shapes: 0,
                shapes: Vec::new(),
            });
        };
        let divided = self.divided_shapes(&stored)?;
        let mut named: Vec<(u64, String)> = (divided.iter().flatten())
            .map(|known| (known.row.ordinal, known.row.name.clone()))
            .collect();
        named.sort();
        Ok(Proposals {
            proposals: compared(&stored, &divided),
            n_steps,
            n_done,
            n_shapes: stored.basis.shapes.len() as u64,
            shapes: named.into_iter().map(|(_, name)| name).collect(),
            set: stored.set,
        })
    }

    /// Returns the shapes that proposals divide; `None` for those that are not there any more.
    fn divided_shapes(&self, stored: &StoredProposals) -> Result<Vec<Option<Known>>> {
        let shapes = stored.basis.shapes.iter().zip(&stored.n_faces);
        shapes
            .map(|(id, n_faces)| self.divided_shape(ShapeId(*id), *n_faces))
            .collect()
    }

    /// Returns a shape that proposals divide, unless it was removed or described again.
    pub(super) fn divided_shape(&self, id: ShapeId, n_faces: u32) -> Result<Option<Known>> {
        if self.store.version(id)? == 0 {
            return Ok(None);
        }
        let known = self.store.known(id)?;
        let is_same = known.view().faces.len() == n_faces as usize;
        Ok(is_same.then_some(known))
    }

    /// Returns the labels of one proposal on the shapes that it divides, in the order of their
    /// arrival.
    ///
    /// # Errors
    /// There is no such collection or proposal.
    pub fn proposed_labels(&self, collection: &str, n: u32) -> Result<Vec<ProposedLabels>> {
        let (row, stored) = self.stored_proposals(collection)?;
        let stored = stored.ok_or_else(|| nothing_proposed(&row))?;
        let labels = stored.labels(stored.find(collection, n)?);
        let mut found = Vec::new();
        for (known, labels) in self.divided_shapes(&stored)?.into_iter().zip(labels) {
            if let Some(known) = known {
                let of_polygon = known.view().face_map.iter();
                let labels = of_polygon.map(|f| labels[*f as usize] as i32).collect();
                let shape = known.row.name.clone();
                found.push((known.row.ordinal, ProposedLabels { shape, labels }));
            }
        }
        found.sort_by_key(|f| f.0);
        Ok(found.into_iter().map(|f| f.1).collect())
    }

    /// Returns the arrays of a shape, the class of each face of its proxy in a proposal, from 0,
    /// and the version of its labels in force.
    ///
    /// # Errors
    /// There is no such collection, shape or proposal; or the proposal does not divide the shape.
    pub fn proposed_proxy(
        &self,
        collection: &str,
        shape: &str,
        n: u32,
    ) -> Result<(MappedDescription, Vec<i32>, u64)> {
        let (row, stored) = self.stored_proposals(collection)?;
        let stored = stored.ok_or_else(|| nothing_proposed(&row))?;
        let proposal = stored.find(collection, n)?;
        let (_, found) = self.shape_row(collection, shape)?;
        let at = stored.basis.shapes.iter().position(|id| *id == found.id.0);
        let known = at.map(|at| self.divided_shape(found.id, stored.n_faces[at]));
        let Some((at, _)) = at.zip(known.transpose()?.flatten()) else {
            let message = format!(
                "proposal {n} of collection {collection:?} does not divide shape {shape:?}; list \
                 the proposals to see which shapes they divide"
            );
            return Err(LibraryError::invalid(Reason::FieldRange, message));
        };
        let classes = stored.labels(proposal).swap_remove(at);
        let classes = classes.into_iter().map(|l| l as i32).collect();
        let (_, mapped, labels) = mapped_shape(&self.store, found.id)?;
        Ok((mapped, classes, labels.version))
    }

    fn stored_proposals(
        &self,
        collection: &str,
    ) -> Result<(CollectionRow, Option<StoredProposals>)> {
        self.store.catalog().read(|r| {
            let row = require_collection(r, collection)?;
            let stored = stored(r, row.id)?;
            Ok((row, stored))
        })
    }
}

/// Compares proposals with the labels in force, on the shapes that are still there.
fn compared(stored: &StoredProposals, divided: &[Option<Known>]) -> Vec<ProposalInfo> {
    let (mut in_force, mut area) = (Vec::new(), Vec::new());
    for known in divided.iter().flatten() {
        in_force.extend(known.labels.proxy_labels.iter().map(|l| *l as u32));
        area.extend(Surface::new(&known.view().mesh()).area);
    }
    let differs = |row: &ProposalRow| {
        let labels = stored.labels(row).into_iter().zip(divided);
        let kept = labels.filter(|(_, known)| known.is_some());
        let labels: Vec<u32> = kept.flat_map(|(labels, _)| labels).collect();
        1.0 - agreement(&labels, &in_force, &area)
    };
    let differs: Vec<f64> = stored.rows.iter().map(differs).collect();
    let least = differs.iter().copied().fold(SAME, f64::min);
    let nearest = differs.iter().position(|d| *d <= least && *d < SAME);
    let rows = stored.rows.iter().zip(differs).enumerate();
    let info = |(at, (row, differs)): (usize, (&ProposalRow, f64))| ProposalInfo {
        n: row.n,
        n_labels: row.n_labels,
        value: row.value,
        in_force: Some(at) == nearest,
        differs,
    };
    rows.map(info).collect()
}
