//! `coseg view` writes a collection as one HTML file that contains the viewer and all its data.

use super::session::{Session, bar};
use super::{CommandError, Outcome, events, json};
use crate::cli::View;
use coseg::call;
use coseg::ipc::client::ClientError;
use coseg::ipc::frames::{FrameError, FrameReader};
use coseg::ipc::wire;
use coseg::text::counted;
use coseg::viewer::{Embedded, portrait};
use serde_json::{Map, Value, json};

/// Number of shapes of one pack: the first pack is on the screen before the others are read.
const BATCH: usize = 25;
/// Number of neighbours of each shape.
const N_NEIGHBORS: u32 = 6;
/// Number of maps of each shape: from the sources of its labels, or from its nearest shapes.
const N_MAPS: usize = 2;

pub(crate) fn run(args: &View, mut session: Session) -> Outcome {
    let collection = session.settled_collection(&args.of, args.no_wait)?;
    let about = session.describe(&collection)?;
    let mut shapes = session.shapes(&collection, None)?;
    let n_stored = shapes.len();
    shapes.truncate(args.max.unwrap_or(usize::MAX));
    let names: Vec<String> = shapes.iter().map(|s| s.name.clone()).collect();
    let mut embedded = Embedded::default();
    let compressed = |e: std::io::Error| CommandError::Failed(format!("compressing: {e}"));
    let progress = bar(shapes.len() as u64);
    for (i, batch) in names.chunks(BATCH).enumerate() {
        let pack = portraits(
            &mut session,
            &collection,
            batch,
            wire::PortraitDetail::Proxy,
        )?;
        embedded
            .push("portraits", &i.to_string(), &pack)
            .map_err(compressed)?;
    }
    let (mut neighbors, mut maps) = (Map::new(), Vec::new());
    for (i, shape) in shapes.iter().enumerate() {
        progress.set_message(shape.name.clone());
        let near = nearest(&mut session, &collection, &shape.name)?;
        if i < args.functions {
            let of = std::slice::from_ref(&shape.name);
            let detail = wire::PortraitDetail::Functions;
            let pack = portraits(&mut session, &collection, of, detail)?;
            embedded
                .push("functions", &i.to_string(), &pack)
                .map_err(compressed)?;
        }
        if i < args.maps {
            for from in mapped_from(shape, &near, &names) {
                let pack = map(&mut session, &collection, &from, &shape.name)?;
                let key = maps.len().to_string();
                embedded.push("map", &key, &pack).map_err(compressed)?;
                maps.push(json!([from, shape.name]));
            }
        }
        let near = near.iter().map(|n| json!([n.shape, n.distance]));
        neighbors.insert(shape.name.clone(), near.collect());
        progress.inc(1);
    }
    progress.finish_and_clear();
    let log = events::since(&mut session, &collection, 0, None)?;
    let log: Vec<Value> = log.iter().map(json::event).collect();
    let n_functions = args.functions.min(shapes.len());
    let catalogue = json!({
        "version": env!("CARGO_PKG_VERSION"),
        "collection": json::collection(&about),
        "shapes": shapes.iter().map(json::shape).collect::<Vec<_>>(),
        "n_stored": n_stored,
        "neighbors": neighbors,
        "functions": names[..n_functions],
        "maps": maps,
        "events": log,
    });
    let page = embedded.page(&catalogue);
    std::fs::write(&args.out, &page).map_err(|source| CommandError::File {
        path: args.out.display().to_string(),
        source,
    })?;
    let n_maps = maps.len();
    if session.json {
        session.print_json(&json!({
            "collection": collection,
            "file": args.out.display().to_string(),
            "n_bytes": page.len(),
            "n_shapes": shapes.len(),
            "n_left_out": n_stored - shapes.len(),
            "n_functions": n_functions,
            "n_maps": n_maps,
        }))?;
    } else {
        let mb = page.len() as f64 / 1e6;
        eprintln!(
            "{}, {n_functions} with functions, {}: {mb:.1} MB in {}",
            counted(shapes.len() as u64, "shape"),
            counted(n_maps as u64, "map"),
            args.out.display()
        );
        if shapes.len() > n_functions || n_stored > shapes.len() {
            eprintln!("--max, --functions and --maps set how much the page contains");
        }
    }
    Ok(true)
}

fn bad(e: FrameError) -> CommandError {
    CommandError::Client(ClientError::BadReply(e.to_string()))
}

fn portraits(
    session: &mut Session,
    collection: &str,
    shapes: &[String],
    detail: wire::PortraitDetail,
) -> Result<Vec<u8>, CommandError> {
    let request = wire::GetPortraitsRequest {
        collection: collection.to_owned(),
        shapes: shapes.to_vec(),
        detail: detail.into(),
        proposal: 0,
    };
    let (reply, frames) = call!(session.client, GetPortraits(request), frames)?;
    let pack = FrameReader::new(&frames).file(reply.pack.as_ref(), "pack");
    Ok(pack.map_err(bad)?.to_vec())
}

fn nearest(
    session: &mut Session,
    collection: &str,
    shape: &str,
) -> Result<Vec<wire::Neighbor>, CommandError> {
    let request = wire::NearestRequest {
        collection: collection.to_owned(),
        shape: shape.to_owned(),
        limit: N_NEIGHBORS,
    };
    Ok(call!(session.client, Nearest(request))?.neighbors)
}

/// Shapes of the file whose maps to `shape` are shown; maps of label sources come first, since they
/// are stored.
fn mapped_from(shape: &wire::Shape, near: &[wire::Neighbor], names: &[String]) -> Vec<String> {
    let sources = shape.sources.iter().map(|s| &s.shape);
    let mut from: Vec<String> = Vec::new();
    for name in sources.chain(near.iter().map(|n| &n.shape)) {
        if from.len() < N_MAPS && names.contains(name) && !from.contains(name) {
            from.push(name.clone());
        }
    }
    from
}

fn map(
    session: &mut Session,
    collection: &str,
    from: &str,
    to: &str,
) -> Result<Vec<u8>, CommandError> {
    #[allow(clippy::needless_update)] // the message may gain fields
    let request = wire::GetFunctionalMapRequest {
        collection: collection.to_owned(),
        from: from.to_owned(),
        to: to.to_owned(),
        ..Default::default()
    };
    let (reply, frames) = call!(session.client, GetFunctionalMap(request), frames)?;
    portrait::map(from, to, &reply, &frames).map_err(bad)
}
