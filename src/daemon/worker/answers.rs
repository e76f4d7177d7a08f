//! Requests whose answers are computed from shapes, or that change their labels, answered from the library.

use crate::Library;
use crate::daemon::reads::page;
use crate::daemon::requests::Answer;
use crate::daemon::writes;
use crate::ipc::convert;
use crate::ipc::frames::{FrameReader, FrameWriter};
use crate::ipc::wire::{self, ErrorCode, ErrorReason, reply::Result as Reply, request::Body};
use crate::library::LibraryError;
use crate::viewer::{Pack, PortraitError, portrait};
use bytes::Bytes;

/// Neighbours when the request does not say how many.
const DEFAULT_NEIGHBORS: u32 = 5;

/// The collection that such a request is about, and the shapes it names.
pub(crate) fn subjects(body: &Body) -> (&str, Vec<&str>) {
    match body {
        Body::GetFunctionalMap(r) => (&r.collection, vec![&r.from, &r.to]),
        Body::TransferFunction(r) => (&r.collection, vec![&r.from, &r.to]),
        Body::GetPartCorrespondence(r) => (&r.collection, vec![&r.shape_a, &r.shape_b]),
        Body::Nearest(r) => (&r.collection, vec![&r.shape]),
        Body::GetPortraits(r) => (&r.collection, r.shapes.iter().map(String::as_str).collect()),
        Body::SuggestNext(r) => (&r.collection, Vec::new()),
        Body::UpdateCollection(r) => (&r.collection, Vec::new()),
        Body::CorrectLabels(r) => (&r.collection, vec![&r.shape]),
        Body::MergeLabels(r) => (&r.collection, Vec::new()),
        Body::SplitLabel(r) => (&r.collection, Vec::new()),
        Body::Undo(r) => (&r.collection, Vec::new()),
        Body::RemoveShape(r) => (&r.collection, vec![&r.shape]),
        other => unreachable!("invariant: only what computes comes here, not {other:?}"),
    }
}

/// Answers a request that came with these raw frames.
pub(super) fn answer(library: &Library, request: &wire::Request, sent: &[Bytes]) -> Answer {
    let mut frames = FrameWriter::default();
    // The daemon has put its owner into the name of the client.
    let key = writes::key(request, None);
    let key = key.as_ref();
    let Some(body) = &request.body else {
        let text = "the request has no body";
        let code = ErrorCode::InvalidArgument;
        return Err(convert::error(code, ErrorReason::UnknownRequest, text));
    };
    let result = match body {
        Body::GetFunctionalMap(r) => match &r.points {
            Some(points) => {
                let asked = convert::point_request(points);
                let maps = library
                    .point_maps(&r.collection, &r.from, &r.to, &asked)
                    .map_err(refuse)?;
                let n1 = library.n_proxy_vertices(&r.collection, &r.from);
                let reply = convert::point_maps(&maps, &mut frames);
                Reply::GetFunctionalMap(convert::from_vertices(reply, n1.map_err(refuse)?))
            }
            None => {
                let map = library.map(&r.collection, &r.from, &r.to).map_err(refuse)?;
                let mut reply = convert::functional_map(&map, &mut frames);
                if r.agreement {
                    let standing = library.standing(&r.collection, &r.from, &r.to, &map);
                    reply.agreement = standing.map_err(refuse)?.map(convert::agreement);
                }
                let n1 = library.n_proxy_vertices(&r.collection, &r.from);
                Reply::GetFunctionalMap(convert::from_vertices(reply, n1.map_err(refuse)?))
            }
        },
        Body::TransferFunction(r) => {
            let values = convert::polygon_values(r.values.as_ref(), FrameReader::new(sent))?;
            let asked = convert::point_request(&r.points.clone().unwrap_or_default());
            let (carried, map) = library
                .transfer(&r.collection, &r.from, &r.to, &values, &asked)
                .map_err(refuse)?;
            Reply::TransferFunction(convert::transferred(&carried, &map, &mut frames))
        }
        Body::GetPartCorrespondence(r) => {
            let (matches, quality) = library
                .part_correspondence(&r.collection, &r.shape_a, &r.shape_b)
                .map_err(refuse)?;
            Reply::GetPartCorrespondence(convert::part_correspondence(&matches, &quality))
        }
        Body::Nearest(r) => {
            let limit = page("limit", r.limit, DEFAULT_NEIGHBORS)?;
            let nearest = library
                .nearest(&r.collection, &r.shape, limit)
                .map_err(refuse)?;
            Reply::Nearest(convert::nearest(nearest))
        }
        Body::GetPortraits(r) => Reply::GetPortraits(portraits(library, r, &mut frames)?),
        Body::SuggestNext(r) => {
            let suggestion = library.suggest(&r.collection).map_err(refuse)?;
            Reply::SuggestNext(convert::suggested(&suggestion))
        }
        Body::UpdateCollection(r) => {
            let up = convert::new_up(r)?;
            let done = library.set_up(&r.collection, up, key).map_err(refuse)?;
            Reply::UpdateCollection(convert::updated(&done))
        }
        Body::CorrectLabels(r) => {
            let correction = convert::correction(r, FrameReader::new(sent))?;
            let done = library
                .correct(&r.collection, &r.shape, &correction, key)
                .map_err(refuse)?;
            Reply::CorrectLabels(convert::corrected(&done))
        }
        Body::MergeLabels(r) => {
            let (label, n_shapes) = library
                .merge_labels(&r.collection, r.label, r.into, key)
                .map_err(refuse)?;
            let label = Some(convert::label_info(&label));
            Reply::MergeLabels(wire::MergeLabelsReply { label, n_shapes })
        }
        Body::SplitLabel(r) => {
            let (label, n_shapes) = library
                .split_label(&r.collection, r.label, key)
                .map_err(refuse)?;
            let label = Some(convert::label_info(&label));
            Reply::SplitLabel(wire::SplitLabelReply { label, n_shapes })
        }
        Body::Undo(r) => {
            let undone = library.undo(&r.collection, key).map_err(refuse)?;
            Reply::Undo(convert::undone(&undone))
        }
        Body::RemoveShape(r) => {
            library
                .remove(&r.collection, &r.shape, key)
                .map_err(refuse)?;
            Reply::RemoveShape(wire::RemoveShapeReply {})
        }
        other => unreachable!("invariant: only what computes is sent here, not {other:?}"),
    };
    Ok((result, frames.finish()))
}

fn refuse(e: LibraryError) -> wire::Error {
    convert::library_error(&e)
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
                let (mapped, labels, version) = library
                    .labelled_proxy(&r.collection, name)
                    .map_err(refuse)?;
                portrait::proxy(&mut pack, name, version, &mapped.view(), &labels)
            }
            wire::PortraitDetail::Functions => {
                let mapped = library.description(&r.collection, name).map_err(refuse)?;
                portrait::functions(&mut pack, name, &mapped.view())
            }
            wire::PortraitDetail::Surface => {
                let (bytes, format) = library.original(&r.collection, name).map_err(refuse)?;
                let labels = library.labels(&r.collection, name, None).map_err(refuse)?;
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
