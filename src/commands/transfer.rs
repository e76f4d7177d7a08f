//! `coseg transfer` transfers labels or functions at the faces or vertices of one shape to another.

use super::session::{Session, print_line};
use super::{CommandError, Outcome, map, values};
use crate::cli::Transfer;
use coseg::call;
use coseg::ipc::convert;
use coseg::ipc::frames::{FrameReader, FrameWriter};
use coseg::ipc::wire;
use coseg::library::PolygonValues;
use serde_json::json;

pub(crate) fn run(args: &Transfer, mut session: Session) -> Outcome {
    let collection = session.collection(&args.within)?;
    let mut frames = FrameWriter::default();
    let sent = match values::read(&args.values)? {
        PolygonValues::Labels(labels) => frames.i32_array(&labels, &[labels.len()]),
        PolygonValues::Functions(x, 1) => frames.f32_array(&x, &[x.len()]),
        PolygonValues::Functions(x, dim) => frames.f32_array(&x, &[x.len() / dim, dim]),
    };
    let request = wire::TransferFunctionRequest {
        collection,
        from: args.from.clone(),
        to: args.to.clone(),
        values: Some(sent),
        points: Some(wire::PointMapOptions {
            alternative: false,
            ..map::options(&args.landmark, args.mirrored)
        }),
        resolution: map::rows(args.resolution).into(),
    };
    let frames = frames.finish();
    let (reply, frames) = call!(
        session.client,
        TransferFunction(request),
        frames,
        with_frames
    )?;
    map::check_rows(reply.resolution(), args.resolution)?;
    let carried = convert::polygon_values(reply.values.as_ref(), FrameReader::new(&frames));
    let carried = carried.map_err(|e| CommandError::Failed(e.message))?;
    let quality = reply.quality.unwrap_or_default();
    match &args.out {
        Some(path) => {
            let bytes = values::bytes(path, &carried);
            std::fs::write(path, bytes).map_err(|source| CommandError::File {
                path: path.display().to_string(),
                source,
            })?;
        }
        None if !session.json => print_line(values::text(&carried).trim_end())?,
        None => {}
    }
    if session.json {
        let rows = match &carried {
            PolygonValues::Labels(labels) => labels.len(),
            PolygonValues::Functions(x, dim) => x.len() / (*dim).max(1),
        };
        session.print_json(&json!({
            "from": args.from,
            "to": args.to,
            "rows": rows,
            "quality": super::json::quality(&quality),
        }))?;
    } else {
        eprintln!(
            "{} to {}: {}",
            args.from,
            args.to,
            map::match_line(&quality)
        );
    }
    Ok(true)
}
