//! Formats the daemon's replies as JSON.

use crate::ipc::convert::up_name;
use crate::ipc::wire::{self, event::Kind};
use crate::text::counted;
use serde_json::{Map, Value, json};

/// The name of an enum value without its prefix, in lower case.
fn short(name: &str, prefix: &str) -> String {
    name.strip_prefix(prefix)
        .unwrap_or(name)
        .to_ascii_lowercase()
}

/// The outcome of an added shape.
pub fn outcome(outcome: wire::Outcome) -> String {
    short(outcome.as_str_name(), "OUTCOME_")
}

/// `#rrggbb`.
pub fn colour(rgb: u32) -> String {
    format!("#{:06x}", rgb & 0xff_ffff)
}

/// An estimate of the up axis.
pub fn up_estimate(e: &wire::UpEstimate) -> Value {
    json!({ "up": up_name(e.up()), "agreement": e.agreement })
}

/// A collection with its labels.
pub fn collection(c: &wire::Collection) -> Value {
    let spec = c.spec.clone().unwrap_or_default();
    json!({
        "name": spec.name,
        "n_parts": spec.n_parts.filter(|&n| n > 0),
        "up": up_name(spec.up()),
        "up_estimate": c.up_estimate.as_ref().map(up_estimate),
        "up_disagrees": c.up_disagrees.as_ref().map(up_estimate),
        "operator": short(spec.operator().as_str_name(), "OPERATOR_").replace('_', "-"),
        "working_faces": spec.working_faces,
        "sequence": c.sequence,
        "n_shapes": c.n_shapes,
        "n_stale": c.n_stale,
        "n_undoable": c.n_undoable,
        "reviews": review_counts(&c.reviews.unwrap_or_default()),
        "labels": c.labels.iter().map(label).collect::<Vec<_>>(),
    })
}

/// Numbers of shapes by verdict.
pub fn review_counts(counts: &wire::ReviewCounts) -> Value {
    json!({
        "unseen": counts.unseen,
        "corrected": counts.corrected,
        "approved": counts.approved,
        "doubtful": counts.doubtful,
    })
}

/// A label.
pub fn label(l: &wire::LabelInfo) -> Value {
    json!({
        "id": l.id,
        "name": Some(&l.name).filter(|n| !n.is_empty()),
        "colour": colour(l.colour_rgb),
        "merged_into": l.merged_into,
        "n_shapes": l.n_shapes,
        "area_share": l.area_share,
        "unclaimed": l.unclaimed,
    })
}

/// A shape with its parts and sources.
pub fn shape(s: &wire::Shape) -> Value {
    let parts = s.parts.iter().map(
        |p| json!({ "label": p.label, "area_share": p.area_share, "confidence": p.confidence }),
    );
    let sources = s
        .sources
        .iter()
        .map(|s| json!({ "shape": s.shape, "version": s.version, "weight": s.weight }));
    json!({
        "name": s.name,
        "ordinal": s.ordinal,
        "version": s.version,
        "stale": s.stale,
        "n_polygons": s.n_polygons,
        "area": s.area,
        "content_digest": s.content_digest,
        "report": s.report.as_ref().map(report),
        "parts": parts.collect::<Vec<_>>(),
        "sources": sources.collect::<Vec<_>>(),
        "stored_bytes": s.stored_bytes,
        "review": s.review.as_ref().map(review),
    })
}

/// What a correction did.
pub fn corrected(c: &wire::CorrectLabelsReply) -> Value {
    json!({
        "version": c.version,
        "sequence": c.sequence,
        "n_faces": c.n_faces,
        "area_share": c.area_share,
        "changed_share": c.changed_share,
        "n_stale": c.n_stale,
    })
}

/// A question about a part with these faces.
pub fn question(q: &wire::NextQuestionReply, faces: &[u32]) -> Value {
    let likeliest = q.likeliest.iter().map(|l| {
        json!({
            "label": l.label,
            "name": Some(&l.name).filter(|n| !n.is_empty()),
            "probability": l.probability,
            "used": l.used,
        })
    });
    json!({
        "shape": q.shape,
        "part": q.part,
        "id": format!("{}:{}", q.shape, q.part),
        "faces": faces,
        "area_share": q.area_share,
        "doubt": q.doubt,
        "gain": q.gain,
        "likeliest": likeliest.collect::<Vec<_>>(),
        "n_answered": q.n_answered,
    })
}

/// A proposal.
pub fn proposal(p: &wire::Proposal) -> Value {
    json!({
        "n": p.n,
        "n_labels": p.n_labels,
        "value": p.value,
        "in_force": p.in_force,
        "differs": p.differs,
    })
}

/// A link between two parts.
pub fn link(l: &wire::Link) -> Value {
    json!({
        "id": l.id,
        "kind": link_kind(l.kind()),
        "a": l.a.as_ref().map(part_of_shape),
        "b": l.b.as_ref().map(part_of_shape),
        "by": l.by,
        "unix_ms": l.unix_ms,
        "holds": l.holds,
        "overruled": l.overruled,
    })
}

fn part_of_shape(p: &wire::PartOfShape) -> Value {
    json!({ "shape": p.shape, "part": p.part })
}

/// What a link demands, in lower case.
pub fn link_kind(kind: wire::LinkKind) -> String {
    short(kind.as_str_name(), "LINK_KIND_")
}

/// The state of a verdict in lower case.
pub fn review_state(state: wire::ReviewState) -> String {
    short(state.as_str_name(), "REVIEW_STATE_")
}

fn review(r: &wire::Review) -> Value {
    json!({
        "state": review_state(r.state()),
        "by": r.by,
        "unix_ms": r.unix_ms,
    })
}

/// What cleaning found and did.
pub fn report(r: &wire::CleanReport) -> Value {
    json!({
        "n_polygons": r.n_polygons,
        "n_triangles": r.n_triangles,
        "n_vertices": r.n_vertices,
        "n_welded_vertices": r.n_welded_vertices,
        "n_isolated_vertices": r.n_isolated_vertices,
        "n_degenerate_triangles": r.n_degenerate_triangles,
        "n_duplicate_triangles": r.n_duplicate_triangles,
        "n_flipped_triangles": r.n_flipped_triangles,
        "n_nonmanifold_edges": r.n_nonmanifold_edges,
        "n_boundary_edges": r.n_boundary_edges,
        "n_components": r.n_components,
        "n_proxy_faces": r.n_proxy_faces,
        "n_proxy_vertices": r.n_proxy_vertices,
        "n_bridges": r.n_bridges,
        "n_concave_polygons": r.n_concave_polygons,
        "n_nonplanar_polygons": r.n_nonplanar_polygons,
        "n_nonsimple_polygons": r.n_nonsimple_polygons,
        "n_tolerated_statements": r.n_tolerated_statements,
        "n_unread_statements": r.n_unread_statements,
        "n_inner_walls": r.n_inner_walls,
        "n_inner_triangles": r.n_inner_triangles,
    })
}

/// One shape of a job; times are in milliseconds for each stage.
pub fn job_item(i: &wire::JobItem) -> Value {
    let mut value =
        json!({ "name": i.name, "outcome": short(i.state().as_str_name(), "ITEM_STATE_") });
    if let Some(p) = &i.placed {
        value["outcome"] = outcome(p.outcome()).into();
        value["version"] = p.version.into();
        value["sequence"] = p.sequence.into();
        value["n_maps"] = p.n_maps.into();
        value["n_relabelled"] = p.n_relabelled.into();
        value["n_inconsistent"] = p.n_inconsistent.into();
        let stages = p.stages.iter().map(|s| (s.stage.clone(), s.ms.into()));
        value["stages_ms"] = Value::Object(stages.collect());
    }
    if let Some(e) = &i.error {
        value["error"] = error(e);
    }
    value
}

/// An error: code, reason, message.
pub fn error(e: &wire::Error) -> Value {
    json!({
        "code": e.code().as_str_name().trim_start_matches("ERROR_CODE_"),
        "reason": e.reason().as_str_name().trim_start_matches("ERROR_REASON_"),
        "message": e.message,
    })
}

/// The quality of a functional map.
pub fn quality(q: &wire::MapQuality) -> Value {
    json!({
        "descriptor_residual": q.descriptor_residual,
        "orthogonality": q.orthogonality,
        "coverage": q.coverage,
        "near_zero": q.near_zero,
        "round_trip": q.round_trip,
        "smoothness": q.smoothness,
        "orientation": q.orientation,
        "expected_error": q.expected_error,
        "matched": q.matched,
        "descriptor_return": q.descriptor_return,
        "confidence": q.confidence,
    })
}

/// The agreement of a map with the others of its collection.
pub fn agreement(a: &wire::MapAgreement) -> Value {
    json!({
        "n_triangles": a.n_triangles,
        "departure": a.departure,
        "inconsistent": a.inconsistent,
    })
}

/// A pair of matching parts.
pub fn part_match(m: &wire::PartMatch) -> Value {
    json!({
        "part_a": m.part_a,
        "part_b": m.part_b,
        "label_a": m.label_a,
        "label_b": m.label_b,
        "overlap": m.overlap,
    })
}

/// An event as a flat object: `kind` and its data beside sequence and collection.
pub fn event(e: &wire::Event) -> Value {
    let (kind, body) = match &e.kind {
        None => ("unknown", json!({})),
        Some(Kind::CollectionCreated(_)) => ("collection_created", json!({})),
        Some(Kind::CollectionDeleted(_)) => ("collection_deleted", json!({})),
        Some(Kind::ShapeAdded(a)) => {
            let shares = a.area_shares.iter();
            let shares = shares.map(|s| json!({ "label": s.label, "area_share": s.area_share }));
            let shares: Vec<_> = shares.collect();
            (
                "shape_added",
                json!({ "shape": a.shape, "version": a.version, "area_shares": shares }),
            )
        }
        Some(Kind::ShapeRemoved(r)) => ("shape_removed", json!({ "shape": r.shape })),
        Some(Kind::LabelsChanged(c)) => {
            let moves = c.moves.iter();
            let moves = moves
                .map(|m| json!({ "from": m.from, "to": m.to, "area_share": m.area_share }))
                .collect::<Vec<_>>();
            let (shape, version, cause) = (&c.shape, c.version, &c.cause);
            let body =
                json!({ "shape": shape, "version": version, "cause": cause, "moves": moves });
            ("labels_changed", body)
        }
        Some(Kind::LabelCreated(l)) => ("label_created", json!({ "label": l.label })),
        Some(Kind::LabelMerged(m)) => ("label_merged", json!({ "from": m.from, "into": m.into })),
        Some(Kind::LabelSplit(s)) => ("label_split", json!({ "from": s.from, "into": s.into })),
        Some(Kind::LabelNamed(n)) => ("label_named", json!({ "label": n.label, "name": n.name })),
        Some(Kind::LabelRetired(l)) => ("label_retired", json!({ "label": l.label })),
        Some(Kind::Corrected(c)) => {
            let body = json!({
                "shape": c.shape,
                "version": c.version,
                "n_faces": c.n_faces,
                "area_share": c.area_share,
            });
            ("corrected", body)
        }
        Some(Kind::Undone(u)) => ("undone", json!({ "change": u.change })),
        Some(Kind::UpChanged(c)) => ("up_changed", json!({ "from": c.from, "to": c.to })),
        Some(Kind::Chosen(c)) => {
            let body = json!({
                "proposal": c.proposal,
                "n_labels": c.n_labels,
                "value": c.value,
            });
            ("chosen", body)
        }
        Some(Kind::PartsLinked(l)) => {
            let body = json!({
                "link": l.link,
                "demand": link_kind(l.kind()),
                "a": l.a.as_ref().map(part_of_shape),
                "b": l.b.as_ref().map(part_of_shape),
            });
            ("parts_linked", body)
        }
        Some(Kind::PartsUnlinked(l)) => ("parts_unlinked", json!({ "link": l.link })),
        Some(Kind::Reclustered(r)) => {
            let body = json!({
                "score_before": r.score_before,
                "score_after": r.score_after,
                "accepted": r.accepted,
            });
            ("reclustered", body)
        }
        Some(Kind::Heartbeat(_)) => ("heartbeat", json!({})),
    };
    let mut value = Map::new();
    value.insert("sequence".to_owned(), e.sequence.into());
    value.insert("collection".to_owned(), e.collection.clone().into());
    value.insert("kind".to_owned(), kind.into());
    if let Value::Object(body) = body {
        value.extend(body);
    }
    Value::Object(value)
}

/// An event as one line for people.
pub fn event_line(e: &wire::Event) -> String {
    let percent = |share: f64| format!("{:.0} %", share * 100.0);
    let body = match &e.kind {
        None => "unknown event".to_owned(),
        Some(Kind::CollectionCreated(_)) => "collection created".to_owned(),
        Some(Kind::CollectionDeleted(_)) => "collection deleted".to_owned(),
        Some(Kind::ShapeAdded(a)) => {
            let shares = a.area_shares.iter();
            let shares: Vec<_> = shares
                .map(|s| format!("{}: {}", s.label, percent(s.area_share)))
                .collect();
            format!(
                "{} added, version {}, labels {}",
                a.shape,
                a.version,
                shares.join(", ")
            )
        }
        Some(Kind::ShapeRemoved(r)) => format!("{} removed", r.shape),
        Some(Kind::LabelsChanged(c)) => {
            let moves = c.moves.iter();
            let moves: Vec<_> = moves
                .map(|m| format!("{} to {}: {}", m.from, m.to, percent(m.area_share)))
                .collect();
            format!(
                "{} relabelled ({}), version {}, {}",
                c.shape,
                c.cause,
                c.version,
                moves.join(", ")
            )
        }
        Some(Kind::LabelCreated(l)) => format!("label {} created", l.label),
        Some(Kind::LabelMerged(m)) => format!("label {} merged into {}", m.from, m.into),
        Some(Kind::LabelSplit(s)) => format!("label {} split into {:?}", s.from, s.into),
        Some(Kind::LabelNamed(n)) => format!("label {} named {:?}", n.label, n.name),
        Some(Kind::LabelRetired(l)) => format!("label {} out of use", l.label),
        Some(Kind::Corrected(c)) => format!(
            "{} corrected, version {}, {} ({}) labelled by hand",
            c.shape,
            c.version,
            counted(c.n_faces, "face"),
            percent(c.area_share)
        ),
        Some(Kind::Undone(u)) => format!("{} undone", u.change),
        Some(Kind::UpChanged(c)) => {
            format!("up axis {} instead of {}", c.to, c.from)
        }
        Some(Kind::Chosen(c)) => format!(
            "proposal {} chosen, {}",
            c.proposal,
            counted(c.n_labels.into(), "label")
        ),
        Some(Kind::PartsLinked(l)) => {
            let part = |p: &Option<wire::PartOfShape>| {
                let part = p.as_ref();
                part.map_or_else(String::new, |p| format!("{}:{}", p.shape, p.part))
            };
            let demand = match l.kind() {
                wire::LinkKind::Differ => "has another label than",
                _ => "has the label of",
            };
            format!("link {}: {} {demand} {}", l.link, part(&l.a), part(&l.b))
        }
        Some(Kind::PartsUnlinked(l)) => format!("link {} removed", l.link),
        Some(Kind::Reclustered(r)) => {
            let taken = if r.accepted { "taken" } else { "not taken" };
            let before = r
                .score_before
                .map_or("none".to_owned(), |s| format!("{s:.3}"));
            format!(
                "reclustered, score {before} to {:.3}, {taken}",
                r.score_after
            )
        }
        Some(Kind::Heartbeat(_)) => "heartbeat".to_owned(),
    };
    format!("{} {} {body}", e.collection, e.sequence)
}
