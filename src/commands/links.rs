//! `coseg same` and `coseg differ` link two parts, `coseg links` lists links, and `coseg unlink`
//! removes one.

use super::session::Session;
use super::{CommandError, Outcome, ask, json};
use crate::cli::{LinkParts, Links, Unlink};
use coseg::call;
use coseg::ipc::wire;
use coseg::text::{counted, table};
use serde_json::{Value, json};

pub(crate) fn link(args: &LinkParts, kind: wire::LinkKind, mut session: Session) -> Outcome {
    let (a, b) = (part(&args.a)?, part(&args.b)?);
    let collection = session.collection(&args.within)?;
    let request = wire::LinkPartsRequest {
        collection: collection.clone(),
        kind: kind.into(),
        a: Some(a),
        b: Some(b),
        by: args.person.name(),
    };
    let done = call!(session.client, LinkParts(request))?;
    let n = done.n_stale;
    if n > 0 && !args.no_wait {
        session.wait_until_idle(&collection)?;
    }
    let made = done.link.unwrap_or_default();
    if session.json {
        session.print_json(&json!({
            "link": json::link(&made),
            "changed": done.changed,
            "n_shapes": n,
            "job_id": done.job_id,
        }))?;
        return Ok(true);
    }
    session.line(&made.id.to_string())?;
    let there = if done.changed {
        ""
    } else {
        ", which was there"
    };
    eprintln!(
        "link {}: {}{there}; {}",
        made.id,
        text(&made),
        follows(n, args.no_wait)
    );
    Ok(true)
}

pub(crate) fn unlink(args: &Unlink, mut session: Session) -> Outcome {
    let collection = session.collection(&args.within)?;
    let request = wire::UnlinkPartsRequest {
        collection: collection.clone(),
        id: args.id,
    };
    let done = call!(session.client, UnlinkParts(request))?;
    let n = done.n_stale;
    if n > 0 && !args.no_wait {
        session.wait_until_idle(&collection)?;
    }
    let removed = done.link.unwrap_or_default();
    if session.json {
        session.print_json(&json!({
            "link": json::link(&removed),
            "n_shapes": n,
            "job_id": done.job_id,
        }))?;
    } else {
        let follows = follows(n, args.no_wait);
        eprintln!("link {} removed: {}; {follows}", removed.id, text(&removed));
    }
    Ok(true)
}

pub(crate) fn list(args: &Links, mut session: Session) -> Outcome {
    let collection = session.collection(&args.of.within())?;
    let shape = args.shape.clone().unwrap_or_default();
    let links = of_shape(&collection, &shape, &mut session)?;
    if session.json {
        let links: Vec<Value> = links.iter().map(json::link).collect();
        session.print_json(&json!({ "collection": collection, "links": links }))?;
        return Ok(true);
    }
    let heading = ["link", "part", "demand", "part", "state", "by"];
    let mut rows = vec![heading.map(str::to_owned).to_vec()];
    for link in &links {
        rows.push(vec![
            link.id.to_string(),
            shown(link.a.as_ref()),
            json::link_kind(link.kind()),
            shown(link.b.as_ref()),
            state(link).to_owned(),
            link.by.clone(),
        ]);
    }
    session.line(&table(&rows))?;
    Ok(true)
}

/// The links of parts of a shape; of all shapes if its name is empty.
pub(super) fn of_shape(
    collection: &str,
    shape: &str,
    session: &mut Session,
) -> Result<Vec<wire::Link>, CommandError> {
    let request = wire::ListLinksRequest {
        collection: collection.to_owned(),
        shape: shape.to_owned(),
    };
    Ok(call!(session.client, ListLinks(request))?.links)
}

/// A link in words: `a:1 has the label of b:2`.
pub(super) fn text(link: &wire::Link) -> String {
    let demand = match link.kind() {
        wire::LinkKind::Differ => "has another label than",
        _ => "has the label of",
    };
    let (a, b) = (shown(link.a.as_ref()), shown(link.b.as_ref()));
    format!("{a} {demand} {b}")
}

/// Whether the labels are as a link demands.
pub(super) fn state(link: &wire::Link) -> &'static str {
    match (link.overruled, link.holds) {
        (true, _) => "overruled by labels of persons",
        (false, true) => "holds",
        (false, false) => "does not hold",
    }
}

fn follows(n_stale: u64, no_wait: bool) -> String {
    match (n_stale, no_wait) {
        (0, _) => "all labels are up to date".to_owned(),
        (n, false) => format!("propagated to {}", counted(n, "shape")),
        (n, true) => format!("to be propagated to {}", counted(n, "shape")),
    }
}

fn shown(part: Option<&wire::PartOfShape>) -> String {
    part.map_or_else(String::new, |p| format!("{}:{}", p.shape, p.part))
}

fn part(typed: &str) -> Result<wire::PartOfShape, CommandError> {
    let (shape, part) = ask::part(typed)?;
    Ok(wire::PartOfShape {
        shape: shape.to_owned(),
        part,
    })
}
