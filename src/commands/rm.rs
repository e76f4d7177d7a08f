//! `coseg rm`: shapes leave a collection.

use super::session::Session;
use super::{CommandError, Outcome, json};
use crate::cli::Rm;
use coseg::call;
use coseg::ipc::client::ClientError;
use coseg::ipc::wire;
use coseg::library::shown;
use serde_json::json;

pub(crate) fn run(args: &Rm, mut session: Session) -> Outcome {
    let collection = session.collection(&args.within)?;
    let (mut removed, mut failed) = (Vec::new(), Vec::new());
    for shape in &args.shapes {
        let request = wire::RemoveShapeRequest {
            collection: collection.clone(),
            shape: shape.clone(),
        };
        match call!(session.client, RemoveShape(request)) {
            Ok(_) => removed.push(shape.clone()),
            Err(ClientError::Refused(e)) => {
                eprintln!("coseg: {}: {}", shown(shape), e.message);
                failed.push(json!({ "name": shape, "error": json::error(&e) }));
            }
            Err(e) => return Err(CommandError::Client(e)),
        }
    }
    if session.json {
        session.print_json(&json!({ "removed": removed, "failed": failed }))?;
    }
    Ok(failed.is_empty())
}
