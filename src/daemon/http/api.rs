//! What the viewer asks, as the requests that any client could send; JSON, or packs of arrays, come back.

use super::hands::{Kept, full};
use super::runs::{Run, labels_of};
use super::{Server, unexpected};
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

/// What is answered.
pub(super) struct Found {
    pub(super) kind: &'static str,
    pub(super) bytes: Bytes,
}

type Answer = Result<Found, wire::Error>;

/// Asks, and takes the reply of the variant named with its frames.
macro_rules! ask {
    ($server:expr, $variant:ident($body:expr)) => {
        ask!($server, $variant($body), None)
    };
    ($server:expr, $variant:ident($body:expr), $frames:expr) => {
        match $server.ask(Body::$variant($body), $frames).await? {
            (reply::Result::$variant(reply), frames) => Ok((reply, frames)),
            (other, _) => Err(unexpected(&other)),
        }
    };
}

/// Parameters of a query.
struct Query<'a>(&'a [(String, String)]);

impl Query<'_> {
    fn find(&self, name: &str) -> Option<&str> {
        let found = self.0.iter().find(|(key, _)| key == name);
        found.map(|(_, value)| value.as_str())
    }

    fn text(&self, name: &str) -> Result<String, wire::Error> {
        let found = self.find(name).map(str::to_owned);
        found.ok_or_else(|| {
            bad(
                ErrorReason::FieldMissing,
                name,
                format!("{name} is missing"),
            )
        })
    }

    fn number<T: std::str::FromStr + Default>(&self, name: &str) -> Result<T, wire::Error> {
        let Some(text) = self.find(name) else {
            return Ok(T::default());
        };
        text.parse().map_err(|_| {
            let message = format!("{name} is {text:?}, which is no number here");
            bad(ErrorReason::FieldRange, name, message)
        })
    }
}

fn bad(reason: ErrorReason, field: &str, message: String) -> wire::Error {
    convert::field_error(reason, field, message)
}

/// JSON, for which memory was set aside.
fn json_page(text: Kept<String>) -> Found {
    let Kept { it, memory } = text;
    let it = Bytes::from(it);
    Found {
        kind: "application/json",
        bytes: Kept { it, memory }.into_bytes(),
    }
}

/// Makes JSON of what can be large, off the threads that wait.
async fn json_of(server: &Server, make: impl FnOnce() -> Value + Send + 'static) -> Answer {
    let it = server.hands.work(move || make().to_string()).await?;
    let memory = server.hands.memory(it.capacity() as u64).ok_or_else(full)?;
    Ok(json_page(Kept { it, memory }))
}

/// Answers what changes nothing.
pub(super) async fn read(server: &Server, path: &str, query: &[(String, String)]) -> Answer {
    let query = Query(query);
    match path {
        "library" => library(server).await,
        "collection" => collection(server, query.text("collection")?).await,
        "portraits" => portraits(server, &query).await,
        "map" => map(server, &query).await,
        "nearest" => {
            let request = wire::NearestRequest {
                collection: query.text("collection")?,
                shape: query.text("shape")?,
                limit: query.number("limit")?,
            };
            let (reply, _) = ask!(server, Nearest(request))?;
            json_of(server, move || {
                let found = reply.neighbors.iter();
                let found: Vec<Value> = found.map(|n| json!([n.shape, n.distance])).collect();
                json!({ "neighbors": found })
            })
            .await
        }
        "events" => {
            let request = wire::EventsSinceRequest {
                collection: query.text("collection")?,
                sequence: query.number("since")?,
                limit: query.number("limit")?,
            };
            let (reply, _) = ask!(server, EventsSince(request))?;
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

async fn library(server: &Server) -> Answer {
    let request = wire::ListCollectionsRequest {};
    let (reply, _) = ask!(server, ListCollections(request))?;
    let (queues, queued, at_work) = {
        let progress = server.daemon.work.progress();
        let of = |c: &wire::Collection| progress.n_live(c.spec.as_ref().map(|s| s.name.as_str()));
        let queues: Vec<usize> = reply.collections.iter().map(of).collect();
        (queues, progress.n_live(None), progress.n_at_stages())
    };
    let instance = server.daemon.instance.clone();
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
    let (reply, _) = ask!(server, DescribeCollection(request))?;
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
        let (reply, _) = ask!(server, ListShapes(request))?;
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
    Ok(json_page(Kept { it: text, memory }))
}

/// Asks for a pack, whose size nobody knows before it is there.
async fn portraits(server: &Server, query: &Query<'_>) -> Answer {
    let collection = query.text("collection")?;
    let detail = match query.find("detail") {
        None | Some("proxy") => PortraitDetail::Proxy,
        Some("surface") => PortraitDetail::Surface,
        Some("functions") => PortraitDetail::Functions,
        Some(other) => {
            let message = format!("detail is {other:?}, not proxy, surface or functions");
            return Err(bad(ErrorReason::FieldRange, "detail", message));
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
            let (reply, _) = ask!(server, ListShapes(request))?;
            reply.shapes.into_iter().map(|s| s.name).collect()
        }
    };
    let request = wire::GetPortraitsRequest {
        collection,
        shapes,
        detail: detail.into(),
    };
    let memory = server.hands.memory_of_answer().await?;
    let (reply, frames) = ask!(server, GetPortraits(request))?;
    let pack = FrameReader::new(&frames).file(reply.pack.as_ref(), "pack");
    let it = pack.map_err(|e| convert::frame_error(&e))?.clone();
    Ok(pack_page(Kept { it, memory }))
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
    let (reply, frames) = ask!(server, GetFunctionalMap(request))?;
    let pack = move || portrait::map(&from, &to, &reply, &frames);
    let pack = server.hands.work(pack).await?;
    let it = pack.map_err(|e| convert::frame_error(&e))?.into();
    Ok(pack_page(Kept { it, memory }))
}

fn pack_page(pack: Kept<Bytes>) -> Found {
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
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Undo {
    collection: String,
}

/// Reads the body of a change, off the threads that wait. Its memory is given back when what was
/// read is dropped.
async fn parsed<T: serde::de::DeserializeOwned + Send + 'static>(
    server: &Server,
    sent: Kept<Vec<u8>>,
) -> Result<Kept<T>, wire::Error> {
    let Kept { it: bytes, memory } = sent;
    let read = move || serde_json::from_slice(&bytes);
    let it = server.hands.work(read).await?.map_err(|e| {
        let text = format!("the body is not what is expected: {e}");
        let code = wire::ErrorCode::InvalidArgument;
        convert::error(code, ErrorReason::MalformedMessage, text)
    })?;
    Ok(Kept { it, memory })
}

/// Carries out a change.
pub(super) async fn change(server: &Server, path: &str, sent: Kept<Vec<u8>>) -> Answer {
    match path {
        "name" => {
            let wish = parsed::<NameLabel>(server, sent).await?.it;
            let request = wire::NameLabelRequest {
                collection: wish.collection,
                label: wish.label,
                name: wish.name,
            };
            let (reply, _) = ask!(server, NameLabel(request))?;
            json_of(server, move || {
                let label = reply.label.as_ref().map(json::label);
                json!({ "label": label })
            })
            .await
        }
        "correct" => correct(server, parsed(server, sent).await?).await,
        "undo" => {
            let wish = parsed::<Undo>(server, sent).await?.it;
            let request = wire::UndoRequest {
                collection: wish.collection,
            };
            let (reply, _) = ask!(server, Undo(request))?;
            json_of(
                server,
                move || json!({ "change": reply.change, "n_left": reply.n_left }),
            )
            .await
        }
        _ => Err(unknown(path)),
    }
}

async fn correct(server: &Server, wish: Kept<Correct>) -> Answer {
    let Kept { it: wish, memory } = wish;
    // How large the shape is decides what is laid out, not what the request says.
    let request = wire::GetShapeRequest {
        collection: wish.collection.clone(),
        shape: wish.shape.clone(),
    };
    let (reply, _) = ask!(server, GetShape(request))?;
    let n = reply.shape.unwrap_or_default().n_polygons;
    if wish.n_polygons != n {
        let message = format!("n_polygons is {}, but the shape has {n}", wish.n_polygons);
        return Err(bad(ErrorReason::LabelCount, "n_polygons", message));
    }
    // The labels, and the frame they are copied to.
    let needed = n * size_of::<i32>() as u64;
    let mut held = server.hands.memory(2 * needed).ok_or_else(full)?;
    let runs = wish.runs;
    let laid_out = move || {
        let labels = labels_of(usize::try_from(n).unwrap_or(usize::MAX), &runs)?;
        drop((runs, memory));
        let mut frames = FrameWriter::default();
        let labels = frames.i32_array(&labels, &[labels.len()]);
        Ok((labels, frames.finish()))
    };
    let (labels, frames) = server
        .hands
        .work(laid_out)
        .await?
        .map_err(|message: String| bad(ErrorReason::FieldRange, "runs", message))?;
    held.shrink_to(needed);
    let frames = Kept {
        it: frames,
        memory: held,
    };
    let request = wire::CorrectLabelsRequest {
        collection: wish.collection,
        shape: wish.shape,
        correction: Some(correct_labels_request::Correction::Labels(labels)),
    };
    let (done, _) = ask!(server, CorrectLabels(request), Some(frames))?;
    json_of(server, move || {
        json!({
            "version": done.version,
            "sequence": done.sequence,
            "n_faces": done.n_faces,
            "area_share": done.area_share,
            "changed_share": done.changed_share,
            "n_stale": done.n_stale,
        })
    })
    .await
}
