//! `coseg merge` merges two labels into one; `coseg split` splits one into two.

use super::session::Session;
use super::{Outcome, json};
use crate::cli::{Merge, Split};
use coseg::call;
use coseg::ipc::wire;
use coseg::text::counted;
use serde_json::json;

pub(crate) fn merge(args: &Merge, mut session: Session) -> Outcome {
    let collection = session.collection(&args.within)?;
    let label = session.label(&collection, &args.label)?;
    let into = session.label(&collection, &args.into)?;
    let request = wire::MergeLabelsRequest {
        collection,
        label,
        into,
    };
    let done = call!(session.client, MergeLabels(request))?;
    if session.json {
        let label = json::label(&done.label.unwrap_or_default());
        session.print_json(&json!({ "label": label, "n_shapes": done.n_shapes }))?;
    } else {
        let shapes = counted(done.n_shapes, "shape");
        eprintln!("label {label} is {into} now, on {shapes}");
    }
    Ok(true)
}

pub(crate) fn split(args: &Split, mut session: Session) -> Outcome {
    let collection = session.collection(&args.within)?;
    let split = session.label(&collection, &args.label)?;
    let request = wire::SplitLabelRequest {
        collection: collection.clone(),
        label: split,
    };
    let done = call!(session.client, SplitLabel(request))?;
    if !args.no_wait {
        session.wait_until_idle(&collection)?;
    }
    let label = done.label.unwrap_or_default();
    if session.json {
        session.print_json(&json::label(&label))?;
    } else {
        session.line(&label.id.to_string())?;
        eprintln!("label {split} is {split} and {} now", label.id);
    }
    Ok(true)
}
