//! Turns the viewer's requests into those that any client could send, and the replies into JSON or
//! packs of arrays.

use super::choices;
use super::exchange::{Answer, Found, Query, json_of, json_page, parsed, request};
use super::hands::{Reserved, full};
use super::questions::{AnswerBody, ReviewBody, answered, question};
use super::runs::{Run, labels_of};
use super::server::Server;
use crate::daemon::attention::MAX_SHOWN;
use crate::ipc::convert;
use crate::ipc::frames::{FrameReader, FrameWriter};
use crate::ipc::json;
use crate::ipc::wire::{
    self, ErrorReason, PortraitDetail, correct_labels_request, reply, request::Body,
};
use crate::viewer::portrait;
use bytes::Bytes;
use serde::Deserialize;
use serde_json::{Value, json};
use std::mem::size_of;

/// Portraits of one answer.
const MAX_PORTRAITS: u32 = 64;

/// Answers a request that changes nothing.
pub(super) async fn read(server: &Server, path: &str, query: &[(String, String)]) -> Answer {
    let query = Query(query);
    match path {
        "library" => {
            note_shown(server, &query)?;
            library(server).await
        }
        "collection" => collection(server, query.text("collection")?).await,
        "portraits" => portraits(server, &query).await,
        "proposals" => choices::proposals(server, query.text("collection")?).await,
        "links" => choices::links(server, query.text("collection")?).await,
        "map" => map(server, &query).await,
        "nearest" => {
            let request = wire::NearestRequest {
                collection: query.text("collection")?,
                shape: query.text("shape")?,
                limit: query.number("limit")?,
            };
            let (reply, _) = request!(server, Nearest(request))?;
            json_of(server, move || {
                let found = reply.neighbors.iter();
                let found: Vec<Value> = found.map(|n| json!([n.shape, n.distance])).collect();
                json!({ "neighbors": found })
            })
            .await
        }
        "question" => {
            let request = wire::NextQuestionRequest {
                collection: query.text("collection")?,
                passed: query.find("passed") == Some("true"),
            };
            let (reply, frames) = request!(server, NextQuestion(request))?;
            let found = question(&reply, &frames)?;
            json_of(server, move || found).await
        }
        "suggest" => {
            let request = wire::SuggestNextRequest {
                collection: query.text("collection")?,
            };
            let (reply, _) = request!(server, SuggestNext(request))?;
            json_of(
                server,
                move || json!({ "shape": reply.shape, "reason": reply.reason }),
            )
            .await
        }
        "events" => {
            let request = wire::EventsSinceRequest {
                collection: query.text("collection")?,
                sequence: query.number("since")?,
                limit: query.number("limit")?,
            };
            let (reply, _) = request!(server, EventsSince(request))?;
            json_of(server, move || {
                let events: Vec<Value> = reply.events.iter().map(json::event).collect();
                json!({ "events": events, "more": reply.more })
            })
            .await
        }
        _ => Err(unknown(path)),
    }
}

fn unknown(path: &str) -> wire::Error {
    let text = format!("there is no /api/{path}");
    convert::error(wire::ErrorCode::NotFound, ErrorReason::UnknownRequest, text)
}

/// Notes which shapes of a collection the page shows, so that these are relabelled first.
fn note_shown(server: &Server, query: &Query<'_>) -> Result<(), wire::Error> {
    let Some(collection) = query.find("collection") else {
        return Ok(());
    };
    let shown = query.0.iter().filter(|(key, _)| key == "first");
    let shown: Vec<String> = shown.map(|(_, name)| name.clone()).collect();
    if shown.len() > MAX_SHOWN {
        let message = format!(
            "first names {} shapes, the limit is {MAX_SHOWN}",
            shown.len()
        );
        let reason = ErrorReason::FieldRange;
        return Err(convert::field_error(reason, "first", message));
    }
    server.daemon.work.attention().shows(collection, shown);
    Ok(())
}

async fn library(server: &Server) -> Answer {
    let request = wire::ListCollectionsRequest {};
    let (reply, _) = request!(server, ListCollections(request))?;
    let (queues, queued, at_work) = {
        let progress = server.daemon.work.progress();
        let of = |c: &wire::Collection| progress.n_live(c.spec.as_ref().map(|s| s.name.as_str()));
        let queues: Vec<usize> = reply.collections.iter().map(of).collect();
        (queues, progress.n_live(None), progress.n_at_stages())
    };
    let instance = server.daemon.identity.instance.clone();
    let edit = server.check_edit().is_ok();
    json_of(server, move || {
        let about = |(c, n_queued): (&wire::Collection, usize)| {
            let mut about = json::collection(c);
            about["n_queued"] = n_queued.into();
            about
        };
        let collections = reply.collections.iter().zip(queues);
        let collections: Vec<Value> = collections.map(about).collect();
        json!({
            "version": env!("CARGO_PKG_VERSION"),
            "instance": instance,
            "edit": edit,
            "n_queued": queued,
            "stages": at_work,
            "collections": collections,
        })
    })
    .await
}

/// A collection with all of its shapes, written a page at a time: as values they take many times
/// their text.
async fn collection(server: &Server, name: String) -> Answer {
    let request = wire::DescribeCollectionRequest {
        collection: name.clone(),
    };
    let (reply, _) = request!(server, DescribeCollection(request))?;
    let begin = move || {
        let about = json::collection(&reply.collection.unwrap_or_default());
        format!("{{\"collection\":{about},\"shapes\":[")
    };
    let mut text = server.hands.work(begin).await?;
    let mut memory = server.hands.memory(0).ok_or_else(full)?;
    let mut page_token = String::new();
    loop {
        let request = wire::ListShapesRequest {
            collection: name.clone(),
            page_token,
            ..Default::default()
        };
        let (reply, _) = request!(server, ListShapes(request))?;
        page_token = reply.next_page_token;
        let held = text.capacity();
        let write = move || {
            for shape in &reply.shapes {
                text.push_str(&json::shape(shape).to_string());
                text.push(',');
            }
            text
        };
        text = server.hands.work(write).await?;
        let grown = text.capacity().saturating_sub(held) as u64;
        if !memory.try_grow(grown) {
            return Err(full());
        }
        if page_token.is_empty() {
            break;
        }
    }
    if text.ends_with(',') {
        text.pop();
    }
    text.push_str("]}");
    Ok(json_page(Reserved {
        value: text,
        memory,
    }))
}

/// Requests a pack. Its size is unknown before it comes, so memory for the largest is reserved.
async fn portraits(server: &Server, query: &Query<'_>) -> Answer {
    let collection = query.text("collection")?;
    let detail = match query.find("detail") {
        None | Some("proxy") => PortraitDetail::Proxy,
        Some("surface") => PortraitDetail::Surface,
        Some("functions") => PortraitDetail::Functions,
        Some(other) => {
            let message = format!("detail is {other:?}, not proxy, surface or functions");
            return Err(convert::field_error(
                ErrorReason::FieldRange,
                "detail",
                message,
            ));
        }
    };
    let named = query.0.iter().filter(|(key, _)| key == "shape");
    let named: Vec<String> = named.map(|(_, name)| name.clone()).collect();
    let shapes = match named.is_empty() {
        false => named,
        true => {
            let limit: u32 = query.number("limit")?;
            let after: u64 = query.number("after")?;
            let request = wire::ListShapesRequest {
                collection: collection.clone(),
                page_size: limit.clamp(1, MAX_PORTRAITS),
                page_token: after.to_string(),
                ..Default::default()
            };
            let (reply, _) = request!(server, ListShapes(request))?;
            reply.shapes.into_iter().map(|s| s.name).collect()
        }
    };
    let request = wire::GetPortraitsRequest {
        collection,
        shapes,
        detail: detail.into(),
        proposal: query.number("proposal")?,
    };
    let memory = server.hands.memory_of_answer().await?;
    let (reply, frames) = request!(server, GetPortraits(request))?;
    let pack = FrameReader::new(&frames).file(reply.pack.as_ref(), "pack");
    let value = pack.map_err(|e| convert::frame_error(&e))?.clone();
    Ok(pack_page(Reserved { value, memory }))
}

async fn map(server: &Server, query: &Query<'_>) -> Answer {
    let (from, to) = (query.text("from")?, query.text("to")?);
    let request = wire::GetFunctionalMapRequest {
        collection: query.text("collection")?,
        from: from.clone(),
        to: to.clone(),
        ..Default::default()
    };
    let memory = server.hands.memory_of_answer().await?;
    let (reply, frames) = request!(server, GetFunctionalMap(request))?;
    let pack = move || portrait::map(&from, &to, &reply, &frames);
    let pack = server.hands.work(pack).await?;
    let value = pack.map_err(|e| convert::frame_error(&e))?.into();
    Ok(pack_page(Reserved { value, memory }))
}

fn pack_page(pack: Reserved<Bytes>) -> Found {
    Found {
        kind: "application/octet-stream",
        bytes: pack.into_bytes(),
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NameLabel {
    collection: String,
    label: u32,
    name: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Correct {
    collection: String,
    shape: String,
    n_polygons: u64,
    runs: Vec<Run>,
    #[serde(default)]
    by: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Merge {
    collection: String,
    label: u32,
    into: u32,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Split {
    collection: String,
    label: u32,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Undo {
    collection: String,
}

/// Makes a change.
pub(super) async fn change(server: &Server, path: &str, sent: Reserved<Vec<u8>>) -> Answer {
    match path {
        "name" => {
            let change = parsed::<NameLabel>(server, sent).await?.value;
            let request = wire::NameLabelRequest {
                collection: change.collection,
                label: change.label,
                name: change.name,
            };
            let (reply, _) = request!(server, NameLabel(request))?;
            json_of(server, move || {
                let label = reply.label.as_ref().map(json::label);
                json!({ "label": label })
            })
            .await
        }
        "correct" => correct(server, parsed(server, sent).await?).await,
        "answer" => {
            let request = parsed::<AnswerBody>(server, sent).await?.value.request()?;
            let (reply, _) = request!(server, AnswerQuestion(request))?;
            json_of(server, move || answered(&reply)).await
        }
        "review" => {
            let request = parsed::<ReviewBody>(server, sent).await?.value.request()?;
            let (reply, _) = request!(server, ReviewShape(request))?;
            let corrected = reply.corrected;
            json_of(
                server,
                move || json!({ "corrected": corrected.as_ref().map(json::corrected) }),
            )
            .await
        }
        "merge" => {
            let change = parsed::<Merge>(server, sent).await?.value;
            let request = wire::MergeLabelsRequest {
                collection: change.collection,
                label: change.label,
                into: change.into,
            };
            let (reply, _) = request!(server, MergeLabels(request))?;
            json_of(server, move || json!({ "n_shapes": reply.n_shapes })).await
        }
        "split" => {
            let change = parsed::<Split>(server, sent).await?.value;
            let request = wire::SplitLabelRequest {
                collection: change.collection,
                label: change.label,
            };
            let (reply, _) = request!(server, SplitLabel(request))?;
            json_of(server, move || {
                let label = reply.label.as_ref().map(json::label);
                json!({ "label": label, "n_shapes": reply.n_shapes })
            })
            .await
        }
        "choose" => choices::choose(server, sent).await,
        "link" => choices::link(server, sent).await,
        "unlink" => choices::unlink(server, sent).await,
        "undo" => {
            let change = parsed::<Undo>(server, sent).await?.value;
            let request = wire::UndoRequest {
                collection: change.collection,
            };
            let (reply, _) = request!(server, Undo(request))?;
            json_of(server, move || {
                json!({
                    "change": reply.change,
                    "subject": reply.subject,
                    "n_left": reply.n_left,
                })
            })
            .await
        }
        _ => Err(unknown(path)),
    }
}

async fn correct(server: &Server, sent: Reserved<Correct>) -> Answer {
    let Reserved {
        value: correction,
        memory,
    } = sent;
    // The size of the shape decides how many labels are expanded, not the request.
    let request = wire::GetShapeRequest {
        collection: correction.collection.clone(),
        shape: correction.shape.clone(),
    };
    let (reply, _) = request!(server, GetShape(request))?;
    let n = reply.shape.unwrap_or_default().n_polygons;
    if correction.n_polygons != n {
        let message = format!(
            "n_polygons is {}, but the shape has {n}",
            correction.n_polygons
        );
        return Err(convert::field_error(
            ErrorReason::LabelCount,
            "n_polygons",
            message,
        ));
    }
    // The labels, and the frame they are copied to.
    let needed = n * size_of::<i32>() as u64;
    let mut held = server.hands.memory(2 * needed).ok_or_else(full)?;
    let runs = correction.runs;
    let expand = move || {
        let labels = labels_of(usize::try_from(n).unwrap_or(usize::MAX), &runs)?;
        drop((runs, memory));
        let mut frames = FrameWriter::default();
        let labels = frames.i32_array(&labels, &[labels.len()]);
        Ok((labels, frames.finish()))
    };
    let (labels, frames) = server
        .hands
        .work(expand)
        .await?
        .map_err(|message: String| {
            convert::field_error(ErrorReason::FieldRange, "runs", message)
        })?;
    held.shrink_to(needed);
    let frames = Reserved {
        value: frames,
        memory: held,
    };
    let request = wire::CorrectLabelsRequest {
        collection: correction.collection,
        shape: correction.shape,
        correction: Some(correct_labels_request::Correction::Labels(labels)),
        by: correction.by,
        closed: None,
    };
    let (done, _) = request!(server, CorrectLabels(request), Some(frames))?;
    json_of(server, move || json::corrected(&done)).await
}
