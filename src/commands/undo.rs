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
        let (change, n_left, sequence) = (&done.change, done.n_left, done.sequence);
        session.print_json(&json!({ "undone": change, "n_left": n_left, "sequence": sequence }))?;
    } else {
        eprintln!("{} undone, {} changes left", done.change, done.n_left);
    }
    Ok(true)
}
