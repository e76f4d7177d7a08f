//! What the viewer asks, as the requests that any client could send; JSON, or packs of arrays, come back.

use super::{Server, unexpected};
use crate::ipc::convert;
use crate::ipc::frames::{FrameReader, FrameWriter};
use crate::ipc::json;
use crate::ipc::wire::{self, ErrorReason, correct_labels_request, reply, request::Body};
use crate::viewer::portrait;
use bytes::Bytes;
use serde::Deserialize;
use serde_json::{Value, json};

/// Portraits of one answer.
const MAX_PORTRAITS: u32 = 64;
/// Polygons that a painted correction may be about.
const MAX_POLYGONS: usize = 10_000_000;

/// What is answered.
pub(super) enum Found {
    Json(Value),
    Pack(Bytes),
}

type Answer = Result<Found, wire::Error>;

/// Asks, and takes the reply of the variant named with its frames.
macro_rules! ask {
    ($server:expr, $variant:ident($body:expr)) => {
        ask!($server, $variant($body), Vec::new())
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

/// Answers what changes nothing.
pub(super) async fn read(server: &Server, path: &str, query: &[(String, String)]) -> Answer {
    let query = Query(query);
    match path {
        "library" => library(server).await,
        "collection" => collection(server, query.text("collection")?).await,
        "portraits" => portraits(server, &query).await,
        "map" => {
            let (from, to) = (query.text("from")?, query.text("to")?);
            #[allow(clippy::needless_update)] // the message may gain fields
            let request = wire::GetFunctionalMapRequest {
                collection: query.text("collection")?,
                from: from.clone(),
                to: to.clone(),
                ..Default::default()
            };
            let (reply, frames) = ask!(server, GetFunctionalMap(request))?;
            let pack = portrait::map(&from, &to, &reply, &frames);
            pack.map(|p| Found::Pack(p.into()))
                .map_err(|e| convert::frame_error(&e))
        }
        "nearest" => {
            let request = wire::NearestRequest {
                collection: query.text("collection")?,
                shape: query.text("shape")?,
                limit: query.number("limit")?,
            };
            let (reply, _) = ask!(server, Nearest(request))?;
            let found = reply.neighbors.iter();
            let found: Vec<Value> = found.map(|n| json!([n.shape, n.distance])).collect();
            Ok(Found::Json(json!({ "neighbors": found })))
        }
        "events" => {
            let request = wire::EventsSinceRequest {
                collection: query.text("collection")?,
                sequence: query.number("since")?,
                limit: query.number("limit")?,
            };
            let (reply, _) = ask!(server, EventsSince(request))?;
            let events: Vec<Value> = reply.events.iter().map(json::event).collect();
            Ok(Found::Json(json!({ "events": events, "more": reply.more })))
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
    let (collections, queued, at_work): (Vec<Value>, _, _) = {
        let progress = server.daemon.work.progress();
        let collections = reply.collections.iter().map(|c| {
            let mut about = json::collection(c);
            let name = c.spec.as_ref().map(|s| s.name.as_str());
            about["n_queued"] = progress.n_live(name).into();
            about
        });
        let collections = collections.collect();
        (collections, progress.n_live(None), progress.n_at_stages())
    };
    Ok(Found::Json(json!({
        "version": env!("CARGO_PKG_VERSION"),
        "instance": server.daemon.instance,
        "edit": server.daemon.config().http.edit && !server.daemon.has_keys,
        "n_queued": queued,
        "stages": at_work,
        "collections": collections,
    })))
}

async fn collection(server: &Server, name: String) -> Answer {
    let request = wire::DescribeCollectionRequest {
        collection: name.clone(),
    };
    let (reply, _) = ask!(server, DescribeCollection(request))?;
    let about = reply.collection.unwrap_or_default();
    let mut shapes: Vec<Value> = Vec::new();
    let mut page_token = String::new();
    loop {
        let request = wire::ListShapesRequest {
            collection: name.clone(),
            page_token,
            ..Default::default()
        };
        let (reply, _) = ask!(server, ListShapes(request))?;
        shapes.extend(reply.shapes.iter().map(json::shape));
        page_token = reply.next_page_token;
        if page_token.is_empty() {
            break;
        }
    }
    Ok(Found::Json(
        json!({ "collection": json::collection(&about), "shapes": shapes }),
    ))
}

async fn portraits(server: &Server, query: &Query<'_>) -> Answer {
    let collection = query.text("collection")?;
    let detail = match query.find("detail") {
        None | Some("proxy") => wire::PortraitDetail::Proxy,
        Some("surface") => wire::PortraitDetail::Surface,
        Some("functions") => wire::PortraitDetail::Functions,
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
    let (reply, frames) = ask!(server, GetPortraits(request))?;
    let pack = FrameReader::new(&frames).file(reply.pack.as_ref(), "pack");
    pack.map(|p| Found::Pack(p.clone()))
        .map_err(|e| convert::frame_error(&e))
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NameLabel {
    collection: String,
    label: u32,
    name: String,
}

/// Labels as runs of polygons: `[first, count, label]`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Correct {
    collection: String,
    shape: String,
    n_polygons: usize,
    runs: Vec<(usize, usize, i32)>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Undo {
    collection: String,
}

fn parsed<'a, T: Deserialize<'a>>(sent: &'a [u8]) -> Result<T, wire::Error> {
    serde_json::from_slice(sent).map_err(|e| {
        let text = format!("the body is not what is expected: {e}");
        let code = wire::ErrorCode::InvalidArgument;
        convert::error(code, ErrorReason::MalformedMessage, text)
    })
}

/// Carries out a change.
pub(super) async fn change(server: &Server, path: &str, sent: &[u8]) -> Answer {
    match path {
        "name" => {
            let wish: NameLabel = parsed(sent)?;
            let request = wire::NameLabelRequest {
                collection: wish.collection,
                label: wish.label,
                name: wish.name,
            };
            let (reply, _) = ask!(server, NameLabel(request))?;
            let label = reply.label.as_ref().map(json::label);
            Ok(Found::Json(json!({ "label": label })))
        }
        "correct" => correct(server, parsed(sent)?).await,
        "undo" => {
            let wish: Undo = parsed(sent)?;
            let request = wire::UndoRequest {
                collection: wish.collection,
            };
            let (reply, _) = ask!(server, Undo(request))?;
            Ok(Found::Json(
                json!({ "change": reply.change, "n_left": reply.n_left }),
            ))
        }
        _ => Err(unknown(path)),
    }
}

async fn correct(server: &Server, wish: Correct) -> Answer {
    let labels = labels_of(wish.n_polygons, &wish.runs)
        .map_err(|message| bad(ErrorReason::FieldRange, "runs", message))?;
    let mut frames = FrameWriter::default();
    let labels = frames.i32_array(&labels, &[wish.n_polygons]);
    let request = wire::CorrectLabelsRequest {
        collection: wish.collection,
        shape: wish.shape,
        correction: Some(correct_labels_request::Correction::Labels(labels)),
    };
    let (done, _) = ask!(server, CorrectLabels(request), frames.finish())?;
    Ok(Found::Json(json!({
        "version": done.version,
        "sequence": done.sequence,
        "n_faces": done.n_faces,
        "area_share": done.area_share,
        "changed_share": done.changed_share,
        "n_stale": done.n_stale,
    })))
}

/// A label for each polygon; -1 where no run says one.
fn labels_of(n_polygons: usize, runs: &[(usize, usize, i32)]) -> Result<Vec<i32>, String> {
    if n_polygons > MAX_POLYGONS {
        return Err(format!(
            "{n_polygons} polygons, the limit is {MAX_POLYGONS}"
        ));
    }
    let mut labels = vec![-1; n_polygons];
    for &(first, count, label) in runs {
        let end = first.checked_add(count);
        let run = end.and_then(|end| labels.get_mut(first..end));
        run.ok_or_else(|| {
            format!("a run of {count} begins at polygon {first}, the shape has {n_polygons}")
        })?
        .fill(label);
    }
    Ok(labels)
}

#[cfg(test)]
mod tests {
    use super::labels_of;

    #[test]
    fn runs_become_a_label_for_each_polygon() {
        let labels = labels_of(6, &[(1, 2, 4), (5, 1, 0)]).unwrap();
        assert_eq!(labels, [-1, 4, 4, -1, -1, 0]);
        for runs in [[(5, 2, 0)], [(usize::MAX, 2, 0)], [(7, 0, 0)]] {
            assert!(labels_of(6, &runs).is_err(), "{runs:?}");
        }
        assert!(labels_of(usize::MAX, &[]).is_err());
    }
}
