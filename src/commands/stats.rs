//! `coseg stats`: counters of the daemon.

use super::Outcome;
use super::session::{Session, table};
use coseg::call;
use coseg::ipc::wire;
use serde_json::{Value, json};

pub(crate) fn run(mut session: Session) -> Outcome {
    let s = call!(session.client, Stats(wire::StatsRequest {}))?;
    let value = json!({
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
    });
    if session.json {
        session.print_json(&value)?;
        return Ok(true);
    }
    let entries = value.as_object().into_iter().flatten();
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
