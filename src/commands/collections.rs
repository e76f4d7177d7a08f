//! `coseg collections`: collections come and go.

use super::confirm::confirmed;
use super::session::Session;
use super::{Outcome, json};
use crate::cli::Collections;
use coseg::call;
use coseg::ipc::wire;
use serde_json::json;

pub(crate) fn run(command: &Collections, mut session: Session) -> Outcome {
    match command {
        Collections::Create { name, settings } => {
            let request = wire::CreateCollectionRequest {
                spec: Some(settings.to_spec(name)),
            };
            let reply = call!(session.client, CreateCollection(request))?;
            if session.json {
                session.print_json(&json::collection(&reply.collection.unwrap_or_default()))?;
            } else {
                eprintln!("{name}: created");
            }
        }
        Collections::Delete { name, yes } => {
            let about = session.describe(name)?;
            let n_labels = about.labels.iter().filter(|l| l.n_shapes > 0).count();
            let with = format!("{} shapes and {n_labels} labels", about.n_shapes);
            let question =
                format!("Delete {name} with its {with}, and all corrections? It cannot be undone.");
            if !confirmed(&question, *yes)? {
                eprintln!("nothing was deleted");
                return Ok(false);
            }
            let request = wire::DeleteCollectionRequest {
                collection: name.clone(),
            };
            call!(session.client, DeleteCollection(request))?;
            if session.json {
                let n_shapes = about.n_shapes;
                session.print_json(&json!({ "deleted": name, "n_shapes": n_shapes }))?;
            } else {
                eprintln!("{name}: deleted, with {with}");
            }
        }
    }
    Ok(true)
}
