//! `coseg stats` prints the counters of the daemon.

use super::Outcome;
use super::session::Session;
use coseg::call;
use coseg::ipc::wire;
use coseg::text::table;
use serde_json::{Value, json};

/// The counters as JSON.
pub(crate) fn json(s: &wire::StatsReply) -> Value {
    let stages = s.stages.iter().map(|s| {
        json!({
            "stage": s.stage,
            "n_shapes": s.n_shapes,
            "total_ms": s.total_ms,
            "n_now": s.n_now,
        })
    });
    json!({
        "version": s.version,
        "instance": s.instance,
        "pid": s.pid,
        "uptime_ms": s.uptime_ms,
        "workers": s.workers,
        "n_collections": s.n_collections,
        "n_shapes": s.n_shapes,
        "n_queued": s.n_queued,
        "n_stale": s.n_stale,
        "stored_bytes": s.stored_bytes,
        "catalog_bytes": s.catalog_bytes,
        "max_relabelled": s.max_relabelled,
        "max_maps": s.max_maps,
        "n_requests": s.n_requests,
        "n_refused": s.n_refused,
        "n_failed": s.n_failed,
        "memory_limit_bytes": s.memory_limit_bytes,
        "memory_reserved_bytes": s.memory_reserved_bytes,
        "resident_bytes": s.resident_bytes,
        "n_placed": s.n_placed,
        "n_relabelled": s.n_relabelled,
        "n_inconsistent_maps": s.n_inconsistent_maps,
        "n_events": s.n_events,
        "received_bytes": s.received_bytes,
        "sent_bytes": s.sent_bytes,
        "stages": stages.collect::<Vec<_>>(),
    })
}

pub(crate) fn run(mut session: Session) -> Outcome {
    let s = call!(session.client, Stats(wire::StatsRequest {}))?;
    let value = json(&s);
    if session.json {
        session.print_json(&value)?;
        return Ok(true);
    }
    // `coseg top` shows the stages.
    let entries = value.as_object().into_iter().flatten();
    let entries = entries.filter(|(_, value)| !value.is_array());
    let rows = entries.map(|(key, value)| {
        let text = match value {
            Value::String(text) => text.clone(),
            other => other.to_string(),
        };
        vec![key.clone(), text]
    });
    session.line(&table(&rows.collect::<Vec<_>>()))?;
    Ok(true)
}
