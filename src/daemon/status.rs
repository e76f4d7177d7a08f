//! The state of the daemon as numbers: for `hello`, `stats`, the metrics and the readiness probe.

use crate::daemon::answer::{MAX_FRAMES, MAX_HEADER_BYTES, MAX_ID_CHARS, MAX_PAGE, MAX_WAIT_MS};
use crate::daemon::metrics::Now;
use crate::daemon::shared::Daemon;
use crate::ipc::wire;
use crate::ipc::{PROTOCOL, convert};
use crate::library::LibraryError;
use crate::mesh::Format;
use std::sync::atomic::{AtomicU64, Ordering};

/// Abilities of this version beyond the names of its requests.
const CAPABILITIES: [&str; 6] = [
    "add_shapes.create",
    "add_shapes.wait",
    "add_shapes.arrays",
    "add_shapes.path",
    "idempotency",
    "events",
];

pub(crate) fn hello(daemon: &Daemon) -> wire::HelloReply {
    let limits = daemon.config().limits.clone();
    wire::HelloReply {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        protocol: PROTOCOL.to_owned(),
        limits: Some(wire::Limits {
            max_message_bytes: limits.max_message.0,
            max_frames: MAX_FRAMES as u32,
            max_header_bytes: MAX_HEADER_BYTES,
            max_shapes_per_request: u32::try_from(limits.max_shapes_per_request)
                .unwrap_or(u32::MAX),
            max_shape_bytes: limits.shape_bytes(),
            max_queued_shapes: limits.max_queued_shapes as u64,
            max_page: MAX_PAGE,
            max_wait_ms: MAX_WAIT_MS,
            max_id_chars: MAX_ID_CHARS as u32,
        }),
        formats: Format::ALL.map(|f| convert::mesh_format(f).into()).to_vec(),
        capabilities: CAPABILITIES.map(str::to_owned).to_vec(),
        event_endpoint: daemon.identity.events.to_string(),
        instance: daemon.identity.instance.clone(),
    }
}

pub(crate) fn stats(daemon: &Daemon) -> Result<wire::StatsReply, LibraryError> {
    let s = daemon.library.stats()?;
    let count = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
    let config = daemon.config();
    Ok(wire::StatsReply {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        instance: daemon.identity.instance.clone(),
        pid: std::process::id(),
        uptime_ms: u64::try_from(daemon.identity.started.elapsed().as_millis()).unwrap_or(u64::MAX),
        n_collections: s.n_collections,
        n_shapes: s.n_shapes,
        n_queued: s.n_queued,
        n_stale: s.n_stale,
        stored_bytes: s.stored_bytes,
        catalog_bytes: s.catalog_bytes,
        max_relabelled: s.max_relabelled,
        max_maps: s.max_maps,
        n_requests: count(&daemon.telemetry.counters.requests),
        n_refused: count(&daemon.telemetry.counters.refused),
        n_failed: count(&daemon.telemetry.counters.failed),
        memory_limit_bytes: config.limits.memory.0,
        memory_reserved_bytes: memory_reserved(daemon).iter().map(|(_, n)| n).sum(),
        resident_bytes: resident_bytes(),
        workers: daemon.capacity.n_workers as u32,
        n_placed: daemon.telemetry.metrics.n_placed(),
        n_relabelled: daemon.telemetry.metrics.relabelled.get(),
        n_inconsistent_maps: daemon.telemetry.metrics.inconsistent.get(),
        n_events: daemon.telemetry.metrics.events.get(),
        received_bytes: daemon.telemetry.metrics.received_bytes.get(),
        sent_bytes: daemon.telemetry.metrics.sent_bytes.get(),
        stages: daemon
            .telemetry
            .metrics
            .stages(&daemon.work.progress().n_at_stages()),
    })
}

/// Reserved bytes of memory, by purpose.
fn memory_reserved(daemon: &Daemon) -> [(&'static str, u64); 4] {
    [
        ("requests", daemon.admission.memory.used()),
        (
            "arriving",
            daemon.telemetry.arriving.load(Ordering::Relaxed),
        ),
        ("replies", daemon.admission.replies.used()),
        ("describing", daemon.capacity.describe_memory.used()),
    ]
}

/// All metrics, as text for Prometheus.
pub(crate) fn metrics(daemon: &Daemon) -> Result<String, LibraryError> {
    let library = daemon.library.stats()?;
    let (n_queued, n_jobs, at_stages) = {
        let progress = daemon.work.progress();
        (
            progress.n_live(None),
            progress.n_jobs(),
            progress.n_at_stages(),
        )
    };
    let admission = &daemon.admission;
    let now = Now {
        library,
        n_queued,
        n_jobs,
        at_stages,
        memory_limit: daemon.config().limits.memory.0,
        memory_reserved: memory_reserved(daemon),
        resident_bytes: resident_bytes(),
        workers: daemon.capacity.n_workers,
        uptime_secs: daemon.identity.started.elapsed().as_secs_f64(),
        requests_in_flight: admission.max_in_flight - admission.in_flight.available_permits(),
        ready: not_ready(daemon).is_none(),
    };
    Ok(daemon.telemetry.metrics.text(&now))
}

/// Why changes are refused, if they are.
pub(crate) fn not_ready(daemon: &Daemon) -> Option<String> {
    if daemon.is_draining() {
        return Some("draining".to_owned());
    }
    let stopped = daemon.library.store().health().read_only();
    stopped.map(|(since, cause)| format!("the store refuses writes since {since}: {cause}"))
}

/// Resident memory of this process as the kernel counts it; 0 if it is unknown.
fn resident_bytes() -> u64 {
    let Ok(status) = std::fs::read_to_string("/proc/self/status") else {
        return 0;
    };
    let kib = status
        .lines()
        .find_map(|l| l.strip_prefix("VmRSS:")?.trim().strip_suffix(" kB"));
    kib.and_then(|n| n.parse::<u64>().ok()).unwrap_or(0) << 10
}
