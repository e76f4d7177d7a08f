//! What the viewer sends and shows of proposals and links.

use super::exchange::{Answer, json_of, parsed, request};
use super::hands::Reserved;
use super::server::Server;
use crate::ipc::convert;
use crate::ipc::json;
use crate::ipc::wire::{self, ErrorReason, reply, request::Body};
use crate::labels::PROPOSED_LABELS;
use crate::library::label_colour;
use serde::Deserialize;
use serde_json::{Value, json};

/// The proposals of a collection. That there are none yet is an answer too, with the reason as
/// `why`: the page asks again and again.
pub(super) async fn proposals(server: &Server, collection: String) -> Answer {
    let request = wire::ListProposalsRequest { collection };
    let found = match server.ask(Body::ListProposals(request), None).await {
        Ok((reply::Result::ListProposals(found), _)) => found,
        Ok((other, _)) => return Err(super::page::unexpected(&other)),
        Err(e) if e.reason() == ErrorReason::NoProposals => {
            return json_of(server, move || json!({ "proposals": [], "why": e.message })).await;
        }
        Err(e) => return Err(e),
    };
    json_of(server, move || {
        let proposals: Vec<Value> = found.proposals.iter().map(json::proposal).collect();
        let colours = 0..*PROPOSED_LABELS.end() as u32;
        let colours = colours.map(|class| {
            let [r, g, b] = label_colour(class);
            format!("#{r:02x}{g:02x}{b:02x}")
        });
        json!({
            "proposals": proposals,
            "set": found.set,
            "n_steps": found.n_steps,
            "n_done": found.n_done,
            "shapes": found.shapes,
            "colours": colours.collect::<Vec<String>>(),
        })
    })
    .await
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Choose {
    collection: String,
    n: u32,
    set: String,
}

/// Makes a proposal the labels.
pub(super) async fn choose(server: &Server, sent: Reserved<Vec<u8>>) -> Answer {
    let change = parsed::<Choose>(server, sent).await?.value;
    let request = wire::ChooseProposalRequest {
        collection: change.collection,
        n: change.n,
        set: change.set,
    };
    let (done, _) = request!(server, ChooseProposal(request))?;
    json_of(
        server,
        move || json!({ "n_labels": done.n_labels, "n_stale": done.n_stale }),
    )
    .await
}

/// The links of a collection.
pub(super) async fn links(server: &Server, collection: String) -> Answer {
    let request = wire::ListLinksRequest {
        collection,
        shape: String::new(),
    };
    let (found, _) = request!(server, ListLinks(request))?;
    json_of(server, move || {
        let links: Vec<Value> = found.links.iter().map(json::link).collect();
        json!({ "links": links })
    })
    .await
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PartBody {
    shape: String,
    part: u32,
}

impl From<PartBody> for wire::PartOfShape {
    fn from(part: PartBody) -> Self {
        Self {
            shape: part.shape,
            part: part.part,
        }
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct LinkBody {
    collection: String,
    kind: String,
    a: PartBody,
    b: PartBody,
    #[serde(default)]
    by: String,
}

/// Links two parts.
pub(super) async fn link(server: &Server, sent: Reserved<Vec<u8>>) -> Answer {
    let change = parsed::<LinkBody>(server, sent).await?.value;
    let kind = match change.kind.as_str() {
        "same" => wire::LinkKind::Same,
        "differ" => wire::LinkKind::Differ,
        other => {
            let message = format!("kind is {other:?}, not same or differ");
            let reason = ErrorReason::FieldRange;
            return Err(convert::field_error(reason, "kind", message));
        }
    };
    let request = wire::LinkPartsRequest {
        collection: change.collection,
        kind: kind.into(),
        a: Some(change.a.into()),
        b: Some(change.b.into()),
        by: change.by,
    };
    let (done, _) = request!(server, LinkParts(request))?;
    json_of(server, move || {
        json!({
            "link": done.link.as_ref().map(json::link),
            "changed": done.changed,
            "n_stale": done.n_stale,
        })
    })
    .await
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Unlink {
    collection: String,
    id: u64,
}

/// Removes a link.
pub(super) async fn unlink(server: &Server, sent: Reserved<Vec<u8>>) -> Answer {
    let change = parsed::<Unlink>(server, sent).await?.value;
    let request = wire::UnlinkPartsRequest {
        collection: change.collection,
        id: change.id,
    };
    let (done, _) = request!(server, UnlinkParts(request))?;
    json_of(
        server,
        move || json!({ "link": done.link.as_ref().map(json::link), "n_stale": done.n_stale }),
    )
    .await
}
