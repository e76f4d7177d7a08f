//! `coseg events` prints the events in a collection's log.

use super::session::Session;
use super::{CommandError, Outcome, json};
use crate::cli::Events;
use coseg::call;
use coseg::ipc::wire;
use serde_json::{Value, json};

/// The events of a collection after `sequence`, at most `limit`, page by page.
pub(crate) fn since(
    session: &mut Session,
    collection: &str,
    mut sequence: u64,
    limit: Option<u64>,
) -> Result<Vec<wire::Event>, CommandError> {
    let mut events = Vec::new();
    let left = |events: &Vec<wire::Event>| limit.map(|n| n.saturating_sub(events.len() as u64));
    while left(&events) != Some(0) {
        let request = wire::EventsSinceRequest {
            collection: collection.to_owned(),
            sequence,
            limit: 0,
        };
        let reply = call!(session.client, EventsSince(request))?;
        events.extend(reply.events);
        sequence = events.last().map_or(sequence, |e: &wire::Event| e.sequence);
        if !reply.more {
            break;
        }
    }
    if let Some(limit) = limit {
        events.truncate(usize::try_from(limit).unwrap_or(usize::MAX));
    }
    Ok(events)
}

pub(crate) fn run(args: &Events, mut session: Session) -> Outcome {
    let collection = session.collection(&args.of.within())?;
    let events = since(&mut session, &collection, args.since, args.limit)?;
    if session.json {
        let list: Vec<Value> = events.iter().map(json::event).collect();
        session.print_json(&json!({ "collection": collection, "events": list }))?;
        return Ok(true);
    }
    for event in &events {
        session.line(&json::event_line(event))?;
    }
    Ok(true)
}
