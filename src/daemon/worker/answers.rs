//! Computes answers from shapes and makes edits, with an open library.

use super::resolution;
use crate::Library;
use crate::daemon::answer::{Answer, page_size, refused};
use crate::daemon::operation::{Compute, Edit};
use crate::ipc::convert;
use crate::ipc::frames::{FrameReader, FrameWriter};
use crate::ipc::wire::{self, ErrorCode, ErrorReason, reply::Result as Reply};
use crate::library::{CorrectionOptions, RequestKey};
use crate::viewer::{Pack, PortraitError, portrait};
use bytes::Bytes;

/// Neighbours when the request does not say how many.
const DEFAULT_NEIGHBORS: u32 = 5;

/// Computes an answer. `sent` are the raw frames of the request.
pub(super) fn compute(library: &Library, compute: Compute, sent: &[Bytes]) -> Answer {
    let mut frames = FrameWriter::default();
    let result = match compute {
        Compute::GetSpectrum(r) => {
            Reply::GetSpectrum(resolution::spectrum(library, &r, &mut frames)?)
        }
        Compute::GetHks(r) => Reply::GetHks(resolution::hks(library, &r, &mut frames)?),
        Compute::GetFunctionalMap(r) => {
            Reply::GetFunctionalMap(resolution::functional_map(library, &r, &mut frames)?)
        }
        Compute::TransferFunction(r) => {
            let values = convert::polygon_values(r.values.as_ref(), FrameReader::new(sent))?;
            Reply::TransferFunction(resolution::transfer(library, &r, &values, &mut frames)?)
        }
        Compute::GetPartCorrespondence(r) => {
            let (matches, quality) = library
                .part_correspondence(&r.collection, &r.shape_a, &r.shape_b)
                .map_err(refused)?;
            Reply::GetPartCorrespondence(convert::part_correspondence(&matches, &quality))
        }
        Compute::Nearest(r) => {
            let limit = page_size("limit", r.limit, DEFAULT_NEIGHBORS)?;
            let nearest = library
                .nearest(&r.collection, &r.shape, limit)
                .map_err(refused)?;
            Reply::Nearest(convert::nearest(nearest))
        }
        Compute::GetPortraits(r) => Reply::GetPortraits(portraits(library, &r, &mut frames)?),
        Compute::SuggestNext(r) => {
            let suggestion = library.suggest(&r.collection).map_err(refused)?;
            Reply::SuggestNext(convert::suggested(&suggestion))
        }
        Compute::NextQuestion(r) => {
            let question = library.next_question(&r.collection, r.passed);
            Reply::NextQuestion(convert::question(&question.map_err(refused)?, &mut frames))
        }
        Compute::ListProposals(r) => {
            let proposals = library.proposals(&r.collection).map_err(refused)?;
            Reply::ListProposals(convert::proposals(&proposals))
        }
        Compute::GetProposal(r) => {
            let labels = library
                .proposed_labels(&r.collection, r.n)
                .map_err(refused)?;
            Reply::GetProposal(convert::proposed_labels(&labels, &mut frames))
        }
    };
    Ok((result, frames.finish()))
}

/// Makes an edit. `sent` are the raw frames of the request.
pub(super) fn edit(
    library: &Library,
    edit: Edit,
    sent: &[Bytes],
    key: Option<&RequestKey>,
) -> Result<Reply, wire::Error> {
    Ok(match edit {
        Edit::UpdateCollection(r) => {
            let up = convert::new_up(&r)?;
            let done = library.set_up(&r.collection, up, key).map_err(refused)?;
            Reply::UpdateCollection(convert::updated(&done))
        }
        Edit::CorrectLabels(r) => {
            let correction = convert::correction(&r, FrameReader::new(sent))?;
            let options = CorrectionOptions {
                by: &r.by,
                closed: r.closed,
            };
            let done = library
                .correct_with(&r.collection, &r.shape, &correction, &options, key)
                .map_err(refused)?;
            Reply::CorrectLabels(convert::corrected(&done))
        }
        Edit::AnswerQuestion(r) => {
            let answer = convert::answer(&r)?;
            let done = library
                .answer(&r.collection, (&r.shape, r.part), &answer, &r.by, key)
                .map_err(refused)?;
            Reply::AnswerQuestion(convert::answered(&done))
        }
        Edit::ReviewShape(r) => {
            let corrected = match r.state() {
                wire::ReviewState::Doubtful => {
                    library
                        .doubt(&r.collection, &r.shape, &r.by, key)
                        .map_err(refused)?;
                    None
                }
                _ => {
                    let done = library.approve(&r.collection, &r.shape, &r.by, key);
                    Some(convert::corrected(&done.map_err(refused)?))
                }
            };
            Reply::ReviewShape(wire::ReviewShapeReply { corrected })
        }
        Edit::MergeLabels(r) => {
            let (label, n_shapes) = library
                .merge_labels(&r.collection, r.label, r.into, key)
                .map_err(refused)?;
            let label = Some(convert::label_info(&label));
            Reply::MergeLabels(wire::MergeLabelsReply { label, n_shapes })
        }
        Edit::SplitLabel(r) => {
            let (label, n_shapes) = library
                .split_label(&r.collection, r.label, key)
                .map_err(refused)?;
            let label = Some(convert::label_info(&label));
            Reply::SplitLabel(wire::SplitLabelReply { label, n_shapes })
        }
        Edit::ChooseProposal(r) => {
            let done = library.choose(&r.collection, r.n, &r.set, key);
            Reply::ChooseProposal(convert::chosen(&done.map_err(refused)?))
        }
        Edit::LinkParts(r) => {
            let (kind, parts) = convert::new_link(&r)?;
            let done = library.link_parts(&r.collection, kind, &parts, &r.by, key);
            Reply::LinkParts(convert::linked(&done.map_err(refused)?))
        }
        Edit::UnlinkParts(r) => {
            let done = library.unlink_parts(&r.collection, r.id, key);
            Reply::UnlinkParts(convert::unlinked(&done.map_err(refused)?))
        }
        Edit::Undo(r) => {
            let undone = library.undo(&r.collection, key).map_err(refused)?;
            Reply::Undo(convert::undone(&undone))
        }
        Edit::RemoveShape(r) => {
            library
                .remove(&r.collection, &r.shape, key)
                .map_err(refused)?;
            Reply::RemoveShape(wire::RemoveShapeReply {})
        }
    })
}

fn undrawable(e: &PortraitError) -> wire::Error {
    let (code, reason) = match e {
        PortraitError::TooLarge { .. } => {
            (ErrorCode::FailedPrecondition, ErrorReason::MeshTooLarge)
        }
        PortraitError::Unreadable { .. } => (ErrorCode::DataLoss, ErrorReason::Damaged),
    };
    convert::error(code, reason, e.to_string())
}

/// Shapes in the form that the viewer draws.
fn portraits(
    library: &Library,
    r: &wire::GetPortraitsRequest,
    frames: &mut FrameWriter,
) -> Result<wire::GetPortraitsReply, wire::Error> {
    let mut pack = Pack::default();
    let mut shapes = Vec::new();
    for name in &r.shapes {
        shapes.push(match r.detail() {
            wire::PortraitDetail::Unspecified | wire::PortraitDetail::Proxy => {
                let found = match r.proposal {
                    0 => library.labelled_proxy(&r.collection, name),
                    n => library.proposed_proxy(&r.collection, name, n),
                };
                let (mapped, labels, version) = found.map_err(refused)?;
                portrait::proxy(&mut pack, name, version, &mapped.view(), &labels)
            }
            wire::PortraitDetail::Functions => {
                let mapped = library.description(&r.collection, name).map_err(refused)?;
                portrait::functions(&mut pack, name, &mapped.view())
            }
            wire::PortraitDetail::Surface => {
                let (bytes, format) = library.original(&r.collection, name).map_err(refused)?;
                let labels = library.labels(&r.collection, name, None).map_err(refused)?;
                let of = (bytes.as_slice(), format);
                portrait::surface(&mut pack, name, labels.version, of, &labels.labels)
                    .map_err(|e| undrawable(&e))?
            }
        });
    }
    let pack = pack.finish(&serde_json::json!({ "shapes": shapes }));
    Ok(wire::GetPortraitsReply {
        pack: Some(frames.file(pack)),
    })
}
