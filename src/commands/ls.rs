//! `coseg ls` lists collections, or the shapes of one.

use super::collections::warn_of_up;
use super::session::Session;
use super::{Outcome, json};
use crate::cli::Ls;
use coseg::call;
use coseg::ipc::convert::up_name;
use coseg::ipc::wire;
use coseg::text::table;
use serde_json::{Value, json};

pub(crate) fn run(args: &Ls, mut session: Session) -> Outcome {
    if args.of.named().is_none() && args.label.is_none() {
        return collections(&mut session);
    }
    let collection = session.collection(&args.of.within())?;
    let label = args.label.as_ref();
    let label = label.map(|l| session.label(&collection, l)).transpose()?;
    shapes(&collection, label, &mut session)
}

fn collections(session: &mut Session) -> Outcome {
    let reply = call!(
        session.client,
        ListCollections(wire::ListCollectionsRequest {})
    )?;
    reply.collections.iter().for_each(warn_of_up);
    if session.json {
        let list: Vec<Value> = reply.collections.iter().map(json::collection).collect();
        session.print_json(&json!({ "collections": list }))?;
        return Ok(true);
    }
    let heading = [
        "collection",
        "shapes",
        "stale",
        "labels",
        "parts",
        "up",
        "sequence",
    ];
    let mut rows = vec![heading.map(str::to_owned).to_vec()];
    for c in &reply.collections {
        let spec = c.spec.clone().unwrap_or_default();
        let n_labels = c.labels.iter().filter(|l| l.n_shapes > 0).count();
        let parts = spec.n_parts.filter(|&n| n > 0);
        rows.push(vec![
            spec.name.clone(),
            c.n_shapes.to_string(),
            c.n_stale.to_string(),
            n_labels.to_string(),
            parts.map_or_else(|| "estimated".to_owned(), |n| n.to_string()),
            up_name(spec.up()).to_owned(),
            c.sequence.to_string(),
        ]);
    }
    session.line(&table(&rows))?;
    Ok(true)
}

fn shapes(collection: &str, label: Option<u32>, session: &mut Session) -> Outcome {
    let shapes = session.shapes(collection, label)?;
    if session.json {
        let list: Vec<Value> = shapes.iter().map(json::shape).collect();
        session.print_json(&json!({ "collection": collection, "shapes": list }))?;
        return Ok(true);
    }
    let heading = ["shape", "faces", "parts", "labels", "version", "state"];
    let mut rows = vec![heading.map(str::to_owned).to_vec()];
    for s in &shapes {
        let labels: std::collections::BTreeSet<u32> = s.parts.iter().map(|p| p.label).collect();
        let labels: Vec<String> = labels.iter().map(u32::to_string).collect();
        rows.push(vec![
            s.name.clone(),
            s.n_polygons.to_string(),
            s.parts.len().to_string(),
            labels.join(","),
            s.version.to_string(),
            if s.stale { "stale" } else { "current" }.to_owned(),
        ]);
    }
    session.line(&table(&rows))?;
    Ok(true)
}
