//! `coseg wait` waits until a collection has no work left.

use super::Outcome;
use super::session::Session;
use crate::cli::Wait;
use serde_json::json;
use std::time::Instant;

pub(crate) fn run(args: &Wait, mut session: Session) -> Outcome {
    let begin = Instant::now();
    let collection = session.collection(&args.of.within())?;
    session.wait_until_idle(&collection)?;
    if session.json {
        let seconds = begin.elapsed().as_secs_f64();
        session
            .print_json(&json!({ "collection": collection, "idle": true, "seconds": seconds }))?;
    }
    Ok(true)
}
