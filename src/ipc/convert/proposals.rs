//! Converts proposals.

use crate::ipc::frames::FrameWriter;
use crate::ipc::wire;
use crate::library::{Chosen, Proposals, ProposedLabels};

/// The proposals of a collection.
pub fn proposals(p: &Proposals) -> wire::ListProposalsReply {
    let proposals = p.proposals.iter().map(|p| wire::Proposal {
        n: p.n,
        n_labels: p.n_labels,
        value: p.value,
        in_force: p.in_force,
        differs: p.differs,
    });
    wire::ListProposalsReply {
        proposals: proposals.collect(),
        set: p.set.clone(),
        n_steps: p.n_steps,
        n_done: p.n_done,
        n_shapes: p.n_shapes,
        shapes: p.shapes.clone(),
    }
}

/// The labels of one proposal.
pub fn proposed_labels(
    labels: &[ProposedLabels],
    frames: &mut FrameWriter,
) -> wire::GetProposalReply {
    let shapes = labels.iter().map(|l| wire::ProposedLabels {
        shape: l.shape.clone(),
        labels: Some(frames.i32_array(&l.labels, &[l.labels.len()])),
    });
    wire::GetProposalReply {
        shapes: shapes.collect(),
    }
}

/// The result of choosing a proposal.
pub fn chosen(c: &Chosen) -> wire::ChooseProposalReply {
    wire::ChooseProposalReply {
        n_labels: c.n_labels,
        n_stale: c.n_stale,
        sequence: c.sequence,
    }
}
