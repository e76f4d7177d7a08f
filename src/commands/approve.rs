//! `coseg approve`: a person's verdict on a shape.

use super::Outcome;
use super::session::Session;
use crate::cli::Approve;
use coseg::call;
use coseg::ipc::wire;
use serde_json::json;

pub(crate) fn run(args: &Approve, mut session: Session) -> Outcome {
    let collection = session.collection(&args.within)?;
    let state = match args.doubtful {
        true => wire::ReviewState::Doubtful,
        false => wire::ReviewState::Approved,
    };
    let request = wire::ReviewShapeRequest {
        collection: collection.clone(),
        shape: args.shape.clone(),
        state: state.into(),
        by: args.person.name(),
    };
    let done = call!(session.client, ReviewShape(request))?;
    let waits = done.corrected.is_some() && !args.no_wait;
    if waits {
        session.wait_until_idle(&collection)?;
    }
    let corrected = done.corrected.unwrap_or_default();
    if session.json {
        session.print_json(&json!({
            "shape": args.shape,
            "review": if args.doubtful { "doubtful" } else { "approved" },
            "version": corrected.version,
            "n_faces": corrected.n_faces,
            "n_shapes": corrected.n_stale,
            "job_id": corrected.job_id,
        }))?;
    } else if args.doubtful {
        eprintln!("{} is doubtful", args.shape);
    } else {
        let propagated = if waits {
            "propagated"
        } else {
            "to be propagated"
        };
        let n = corrected.n_stale;
        eprintln!("{} is approved; {propagated} to {n} shapes", args.shape);
    }
    Ok(true)
}
