//! `coseg collections`: collections come and go.

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
            }
        }
        Collections::Delete { name } => {
            let request = wire::DeleteCollectionRequest {
                collection: name.clone(),
            };
            call!(session.client, DeleteCollection(request))?;
            if session.json {
                session.print_json(&json!({ "deleted": name }))?;
            }
        }
    }
    Ok(true)
}
