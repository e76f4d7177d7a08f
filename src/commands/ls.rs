//! `coseg ls` lists collections, or the shapes of one.

use super::collections::warn_of_up;
use super::session::Session;
use super::{Outcome, json};
use crate::cli::{Ls, Verdict};
use coseg::call;
use coseg::ipc::convert::up_name;
use coseg::ipc::wire;
use coseg::text::table;
use serde_json::{Value, json};

pub(crate) fn run(args: &Ls, mut session: Session) -> Outcome {
    if args.of.named().is_none() && args.label.is_none() && args.review.is_none() {
        return collections(&mut session);
    }
    let collection = session.collection(&args.of.within())?;
    let label = args.label.as_ref();
    let label = label.map(|l| session.label(&collection, l)).transpose()?;
    shapes(&collection, (label, wanted(args.review)), &mut session)
}

fn wanted(review: Option<Verdict>) -> wire::ReviewState {
    match review {
        None => wire::ReviewState::Unspecified,
        Some(Verdict::Unseen) => wire::ReviewState::Unseen,
        Some(Verdict::Corrected) => wire::ReviewState::Corrected,
        Some(Verdict::Approved) => wire::ReviewState::Approved,
        Some(Verdict::Doubtful) => wire::ReviewState::Doubtful,
    }
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
        "unseen",
        "corrected",
        "approved",
        "doubtful",
    ];
    let mut rows = vec![heading.map(str::to_owned).to_vec()];
    for c in &reply.collections {
        let spec = c.spec.clone().unwrap_or_default();
        let reviews = c.reviews.unwrap_or_default();
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
            reviews.unseen.to_string(),
            reviews.corrected.to_string(),
            reviews.approved.to_string(),
            reviews.doubtful.to_string(),
        ]);
    }
    session.line(&table(&rows))?;
    Ok(true)
}

fn shapes(
    collection: &str,
    (label, review): (Option<u32>, wire::ReviewState),
    session: &mut Session,
) -> Outcome {
    let shapes = session.shapes_reviewed(collection, label, review)?;
    let counts = review_counts(&shapes);
    if session.json {
        let list: Vec<Value> = shapes.iter().map(json::shape).collect();
        session.print_json(&json!({
            "collection": collection,
            "shapes": list,
            "reviews": json::review_counts(&counts),
        }))?;
        return Ok(true);
    }
    let heading = [
        "shape", "faces", "parts", "labels", "version", "state", "review",
    ];
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
            json::review_state(
                s.review
                    .as_ref()
                    .map_or_else(Default::default, |r| r.state()),
            ),
        ]);
    }
    session.line(&table(&rows))?;
    eprintln!("{}", reviews_text(&counts));
    Ok(true)
}

/// Counts shapes by verdict.
fn review_counts(shapes: &[wire::Shape]) -> wire::ReviewCounts {
    let mut counts = wire::ReviewCounts::default();
    for shape in shapes {
        let state = shape.review.as_ref().map(wire::Review::state);
        *match state.unwrap_or(wire::ReviewState::Unseen) {
            wire::ReviewState::Unspecified | wire::ReviewState::Unseen => &mut counts.unseen,
            wire::ReviewState::Corrected => &mut counts.corrected,
            wire::ReviewState::Approved => &mut counts.approved,
            wire::ReviewState::Doubtful => &mut counts.doubtful,
        } += 1;
    }
    counts
}

fn reviews_text(counts: &wire::ReviewCounts) -> String {
    format!(
        "{} unseen, {} corrected, {} approved, {} doubtful",
        counts.unseen, counts.corrected, counts.approved, counts.doubtful
    )
}
