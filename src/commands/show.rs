//! `coseg show` prints one shape with its parts and the sources of its labels, or one collection
//! with its labels.

use super::collections::warn_of_up;
use super::session::Session;
use super::{CommandError, Outcome, json, links};
use crate::cli::Show;
use coseg::call;
use coseg::ipc::convert::up_name;
use coseg::ipc::wire;
use coseg::text::counted;
use coseg::text::table;

pub(crate) fn run(args: &Show, mut session: Session) -> Outcome {
    match &args.shape {
        Some(name) => {
            let found = shape(args, name, &mut session);
            let (shape, collection) = found.map_err(|e| session.explain_shape(e, name))?;
            let name = collection.spec.as_ref().map_or("", |s| &s.name);
            let links = links::of_shape(name, &shape.name, &mut session)?;
            show_shape(&shape, &collection, &links, &session)
        }
        None => {
            let collection = session.collection(&args.within)?;
            show_collection(&session.describe(&collection)?, &session)
        }
    }
}

fn shape(
    args: &Show,
    name: &str,
    session: &mut Session,
) -> Result<(wire::Shape, wire::Collection), CommandError> {
    let collection = session.collection(&args.within)?;
    let described = session.describe(&collection)?;
    let request = wire::GetShapeRequest {
        collection,
        shape: name.to_owned(),
    };
    let shape = call!(session.client, GetShape(request))?.shape;
    Ok((shape.unwrap_or_default(), described))
}

/// The name of a label, or its id.
fn label_name(collection: &wire::Collection, id: u32) -> String {
    let label = collection.labels.iter().find(|l| l.id == id);
    let name = label.map(|l| l.name.as_str()).filter(|n| !n.is_empty());
    name.map_or_else(|| id.to_string(), |name| format!("{id} {name}"))
}

fn show_collection(c: &wire::Collection, session: &Session) -> Outcome {
    warn_of_up(c);
    if session.json {
        session.print_json(&json::collection(c))?;
        return Ok(true);
    }
    let spec = c.spec.clone().unwrap_or_default();
    let n_parts = spec.n_parts.filter(|&n| n > 0);
    let parts = n_parts.map_or_else(|| "estimated".to_owned(), |n| n.to_string());
    let sure = c.up_estimate.map_or_else(String::new, |e| {
        let percent = 100.0 * e.agreement;
        format!(" ({}, {percent:.0} % of the shapes agree)", up_name(e.up()))
    });
    session.line(&format!(
        "{}: {} ({} stale), parts {parts}, up {}{sure}, sequence {}",
        spec.name,
        counted(c.n_shapes, "shape"),
        c.n_stale,
        up_name(spec.up()),
        c.sequence
    ))?;
    let mut rows = vec![
        ["label", "name", "colour", "area", "state"]
            .map(str::to_owned)
            .to_vec(),
    ];
    for l in &c.labels {
        let state = l.merged_into.map(|id| format!("merged into {id}"));
        rows.push(vec![
            l.id.to_string(),
            l.name.clone(),
            json::colour(l.colour_rgb),
            format!("{:.1} %", 100.0 * l.area_share),
            state.unwrap_or_else(|| match l.n_shapes {
                0 => "out of use".to_owned(),
                n if l.unclaimed => format!("on {}, unclaimed", counted(n, "shape")),
                n => format!("on {}", counted(n, "shape")),
            }),
        ]);
    }
    session.line(&table(&rows))?;
    let unclaimed = c.labels.iter().filter(|l| l.unclaimed && l.n_shapes > 0);
    let area: f64 = unclaimed.clone().map(|l| l.area_share).sum();
    if let n @ 1.. = unclaimed.count() as u64 {
        session.line(&format!(
            "{:.1} % of the area has {} that no labelled shape shows: name, merge or label them, \
             or say `coseg correct --closed` if there are no such parts",
            100.0 * area,
            counted(n, "discovered label")
        ))?;
    }
    Ok(true)
}

/// The findings and actions of cleaning as text.
pub(super) fn found(r: &wire::CleanReport) -> String {
    let inner = format!(
        "inner walls represented by outer ones ({} triangles)",
        r.n_inner_triangles
    );
    let counts = [
        ("vertices welded", r.n_welded_vertices),
        ("isolated vertices", r.n_isolated_vertices),
        ("degenerate triangles dropped", r.n_degenerate_triangles),
        ("duplicate triangles dropped", r.n_duplicate_triangles),
        ("triangles flipped", r.n_flipped_triangles),
        ("non-manifold edges", r.n_nonmanifold_edges),
        ("boundary edges", r.n_boundary_edges),
        (inner.as_str(), r.n_inner_walls),
        ("virtual edges between components", r.n_bridges),
        ("concave polygons", r.n_concave_polygons),
        ("polygons not planar", r.n_nonplanar_polygons),
        (
            "polygons that cross themselves or have no area",
            r.n_nonsimple_polygons,
        ),
        (
            "statements read that programs interpret differently",
            r.n_tolerated_statements,
        ),
        ("other statements not read", r.n_unread_statements),
    ];
    let found: Vec<String> = counts
        .iter()
        .filter(|(_, n)| *n > 0)
        .map(|(what, n)| format!("{n} {what}"))
        .collect();
    let found = match found.as_slice() {
        [] => "clean".to_owned(),
        found => found.join(", "),
    };
    format!("{}, {found}", counted(r.n_components, "component"))
}

fn show_shape(
    s: &wire::Shape,
    collection: &wire::Collection,
    links: &[wire::Link],
    session: &Session,
) -> Outcome {
    if session.json {
        let mut shape = json::shape(s);
        shape["links"] = links.iter().map(json::link).collect();
        session.print_json(&shape)?;
        return Ok(true);
    }
    let state = if s.stale { "stale" } else { "current" };
    session.line(&format!(
        "{}: shape {} of its collection, {} faces, area {}, labels version {} ({state})",
        s.name, s.ordinal, s.n_polygons, s.area, s.version
    ))?;
    if let Some(r) = &s.report {
        session.line(&format!(
            "mesh: {}; proxy of {} faces",
            found(r),
            r.n_proxy_faces
        ))?;
    }
    let mut rows = vec![
        ["part", "label", "area", "confidence"]
            .map(str::to_owned)
            .to_vec(),
    ];
    for (i, p) in s.parts.iter().enumerate() {
        rows.push(vec![
            i.to_string(),
            label_name(collection, p.label),
            format!("{:.1} %", p.area_share * 100.0),
            format!("{:.2}", p.confidence),
        ]);
    }
    session.line(&table(&rows))?;
    if !s.sources.is_empty() {
        let sources = s.sources.iter();
        let sources: Vec<_> = sources
            .map(|s| {
                format!(
                    "{} version {} ({:.0} %)",
                    s.shape,
                    s.version,
                    s.weight * 100.0
                )
            })
            .collect();
        session.line(&format!("labels propagated from {}", sources.join(", ")))?;
    }
    for link in links {
        let (text, state) = (links::text(link), links::state(link));
        session.line(&format!("link {}: {text} ({state})", link.id))?;
    }
    Ok(true)
}
