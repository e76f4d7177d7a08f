//! `coseg undo` undoes the newest change by a person.

use super::Outcome;
use super::session::Session;
use crate::cli::Undo;
use coseg::call;
use coseg::ipc::wire;
use serde_json::json;

pub(crate) fn run(args: &Undo, mut session: Session) -> Outcome {
    let collection = session.collection(&args.of.within())?;
    let request = wire::UndoRequest {
        collection: collection.clone(),
    };
    let done = call!(session.client, Undo(request))?;
    if !args.no_wait {
        session.wait_until_idle(&collection)?;
    }
    if session.json {
        session.print_json(&json!({
            "undone": done.change,
            "subject": done.subject,
            "n_left": done.n_left,
            "sequence": done.sequence,
        }))?;
    } else {
        let (change, subject, n_left) = (&done.change, &done.subject, done.n_left);
        let of = if subject.is_empty() { "" } else { " of " };
        let changes = if n_left == 1 { "change" } else { "changes" };
        eprintln!("{change}{of}{subject} undone, {n_left} {changes} left");
    }
    Ok(true)
}
