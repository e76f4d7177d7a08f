//! `coseg stop`: the daemon finishes what it is at and ends.

use super::Outcome;
use super::session::Session;
use coseg::call;
use coseg::ipc::wire;
use serde_json::json;

pub(crate) fn run(mut session: Session) -> Outcome {
    let reply = call!(session.client, Drain(wire::DrainRequest {}))?;
    if session.json {
        session.print_json(&json!({ "n_queued": reply.n_queued }))?;
    } else if reply.n_queued > 0 {
        eprintln!("{} shapes are left for the next start", reply.n_queued);
    }
    Ok(true)
}
