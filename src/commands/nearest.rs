//! `coseg nearest` lists the shapes most similar to one shape.

use super::session::Session;
use super::{CommandError, Outcome};
use crate::cli::Nearest;
use coseg::call;
use coseg::ipc::wire;
use coseg::text::table;
use serde_json::json;

fn nearest(args: &Nearest, session: &mut Session) -> Result<wire::NearestReply, CommandError> {
    let collection = session.collection(&args.within)?;
    let request = wire::NearestRequest {
        collection,
        shape: args.shape.clone(),
        limit: args.limit,
    };
    Ok(call!(session.client, Nearest(request))?)
}

pub(crate) fn run(args: &Nearest, mut session: Session) -> Outcome {
    let reply = nearest(args, &mut session);
    let reply = reply.map_err(|e| session.explain_shape(e, &args.shape))?;
    if session.json {
        let list = reply.neighbors.iter();
        let list: Vec<_> = list
            .map(|n| json!({ "shape": n.shape, "distance": n.distance }))
            .collect();
        session.print_json(&json!({ "shape": args.shape, "nearest": list }))?;
        return Ok(true);
    }
    let mut rows = vec![["shape", "distance"].map(str::to_owned).to_vec()];
    rows.extend(
        reply
            .neighbors
            .iter()
            .map(|n| vec![n.shape.clone(), format!("{:.4}", n.distance)]),
    );
    session.line(&table(&rows))?;
    Ok(true)
}
