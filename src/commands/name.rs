//! `coseg name` gives a label a name.

use super::session::Session;
use super::{Outcome, json};
use crate::cli::Name;
use coseg::call;
use coseg::ipc::wire;

pub(crate) fn run(args: &Name, mut session: Session) -> Outcome {
    let collection = session.collection(&args.within)?;
    let label = session.label(&collection, &args.label)?;
    let request = wire::NameLabelRequest {
        collection,
        label,
        name: args.name.clone(),
    };
    let label = call!(session.client, NameLabel(request))?
        .label
        .unwrap_or_default();
    if session.json {
        session.print_json(&json::label(&label))?;
    } else {
        eprintln!("label {} is named {:?}", label.id, label.name);
    }
    Ok(true)
}
