//! Requests that change nothing, answered from what is stored: rows are read, arrays are copied, nothing is computed from
//! shapes.

use crate::daemon::Daemon;
use crate::daemon::metrics::Now;
use crate::daemon::sockets::{MAX_FRAMES, MAX_HEADER_BYTES, MAX_ID_CHARS};
use crate::daemon::waits::MAX_WAIT_MS;
use crate::ipc::frames::FrameWriter;
use crate::ipc::wire::{self, ErrorReason, reply::Result as Reply, request::Body};
use crate::ipc::{PROTOCOL, convert};
use crate::library::{JobFilter, Library, LibraryError};
use crate::mesh::Format;
use bytes::Bytes;
use std::sync::Arc;
use std::sync::atomic::Ordering;

/// Entries of a page.
const MAX_PAGE: u32 = 1_000;
/// What this version knows beyond the names of its requests.
const CAPABILITIES: [&str; 6] = [
    "add_shapes.create",
    "add_shapes.wait",
    "add_shapes.arrays",
    "add_shapes.path",
    "idempotency",
    "events",
];

/// What is known of a request that changes nothing.
#[allow(clippy::large_enum_variant)] // returned once, never in a collection
pub(crate) enum Looked {
    /// Its answer, as it is stored.
    Up((Reply, Vec<Bytes>)),
    /// Its answer is to be computed from shapes, which this process does not do.
    ToCompute(Body),
}

/// Answers one request from what is stored.
pub(crate) fn look_up(daemon: &Arc<Daemon>, body: Body) -> Result<Looked, wire::Error> {
    let library = &daemon.library;
    let mut frames = FrameWriter::default();
    let result = match body {
        Body::Hello(_) => Reply::Hello(hello(daemon)),
        Body::Stats(_) => Reply::Stats(stats(daemon).map_err(refuse)?),
        Body::ListCollections(_) => {
            let collections = library.collections().map_err(refuse)?;
            let collections = collections.iter().map(convert::collection).collect();
            Reply::ListCollections(wire::ListCollectionsReply { collections })
        }
        Body::DescribeCollection(r) => {
            let collection = library.collection(&r.collection).map_err(refuse)?;
            let collection = Some(convert::collection(&collection));
            Reply::DescribeCollection(wire::DescribeCollectionReply { collection })
        }
        Body::GetJob(r) => {
            let job = library.job(r.job_id).map_err(refuse)?;
            Reply::GetJob(wire::GetJobReply {
                job: Some(daemon.job_to_wire(&job)),
            })
        }
        Body::ListJobs(r) => Reply::ListJobs(list_jobs(daemon, &r)?),
        Body::ListShapes(r) => Reply::ListShapes(list_shapes(daemon, &r)?),
        Body::GetShape(r) => {
            let shape = library.shape(&r.collection, &r.shape).map_err(refuse)?;
            Reply::GetShape(wire::GetShapeReply {
                shape: Some(convert::shape(&shape)),
            })
        }
        Body::GetLabels(r) => {
            let version = Some(r.version).filter(|&v| v > 0);
            let labels = library
                .labels(&r.collection, &r.shape, version)
                .map_err(refuse)?;
            Reply::GetLabels(convert::labels(&labels, r.confidence, &mut frames))
        }
        Body::GetOriginal(r) => {
            let (bytes, format) = library.original(&r.collection, &r.shape).map_err(refuse)?;
            Reply::GetOriginal(convert::original(bytes, format, &mut frames))
        }
        Body::LabelsSnapshot(r) => {
            let (sequence, shapes) = library.labels_snapshot(&r.collection).map_err(refuse)?;
            Reply::LabelsSnapshot(convert::labels_snapshot(sequence, &shapes, &mut frames))
        }
        Body::GetSpectrum(r) => {
            let area = library.shape(&r.collection, &r.shape).map_err(refuse)?.area;
            let description = library
                .description(&r.collection, &r.shape)
                .map_err(refuse)?;
            let view = description.view();
            Reply::GetSpectrum(convert::spectrum(&view, area, r.eigenvectors, &mut frames))
        }
        Body::GetHks(r) => {
            let description = library
                .description(&r.collection, &r.shape)
                .map_err(refuse)?;
            Reply::GetHks(convert::hks(&description.view(), &mut frames))
        }
        Body::GetDescriptors(r) => {
            let description = library
                .description(&r.collection, &r.shape)
                .map_err(refuse)?;
            Reply::GetDescriptors(convert::descriptors(&description.view(), &mut frames))
        }
        Body::GetFunctionalMap(r) => match kept_map(library, &r, &mut frames)? {
            Some(reply) => Reply::GetFunctionalMap(reply),
            None => return Ok(Looked::ToCompute(Body::GetFunctionalMap(r))),
        },
        computed @ (Body::TransferFunction(_)
        | Body::GetPartCorrespondence(_)
        | Body::Nearest(_)
        | Body::GetPortraits(_)
        | Body::SuggestNext(_)) => return Ok(Looked::ToCompute(computed)),
        Body::EventsSince(r) => Reply::EventsSince(events_since(daemon, &r)?),
        Body::CreateCollection(_)
        | Body::DeleteCollection(_)
        | Body::NameLabel(_)
        | Body::UpdateCollection(_)
        | Body::CorrectLabels(_)
        | Body::MergeLabels(_)
        | Body::SplitLabel(_)
        | Body::Undo(_)
        | Body::AddShapes(_)
        | Body::CancelJob(_)
        | Body::RetryJob(_)
        | Body::RemoveShape(_)
        | Body::Drain(_)
        | Body::WatchJob(_)
        | Body::WaitIdle(_) => unreachable!("invariant: dispatch sends only reads here"),
    };
    Ok(Looked::Up((result, frames.finish())))
}

/// The map that is asked for, if it is kept.
fn kept_map(
    library: &Library,
    r: &wire::GetFunctionalMapRequest,
    frames: &mut FrameWriter,
) -> Result<Option<wire::GetFunctionalMapReply>, wire::Error> {
    let (collection, from, to) = (&r.collection, &r.from, &r.to);
    let found = match &r.points {
        Some(points) => library
            .kept_point_maps(collection, from, to, &convert::point_request(points))
            .map_err(refuse)?
            .map(|maps| convert::point_maps(&maps, frames)),
        // To compare it with the others is to compute.
        None if r.agreement => None,
        None => library
            .kept_map(collection, from, to)
            .map_err(refuse)?
            .map(|map| convert::functional_map(&map, frames)),
    };
    let Some(found) = found else { return Ok(None) };
    let n1 = library.n_proxy_vertices(collection, from).map_err(refuse)?;
    Ok(Some(convert::from_vertices(found, n1)))
}

fn refuse(e: LibraryError) -> wire::Error {
    convert::library_error(&e)
}

/// The number of entries asked for, or `default` if 0.
pub(crate) fn page(field: &str, asked: u32, default: u32) -> Result<usize, wire::Error> {
    if asked > MAX_PAGE {
        let text = format!("{field} is {asked}, the limit is {MAX_PAGE}");
        return Err(convert::field_error(ErrorReason::FieldRange, field, text));
    }
    Ok(if asked == 0 { default } else { asked } as usize)
}

fn list_shapes(
    daemon: &Daemon,
    r: &wire::ListShapesRequest,
) -> Result<wire::ListShapesReply, wire::Error> {
    let size = page("page_size", r.page_size, MAX_PAGE)?;
    let after = match r.page_token.as_str() {
        "" => 0,
        token => token.parse().map_err(|_| {
            let text = format!("page_token {token:?} was not made by this daemon");
            convert::field_error(ErrorReason::FieldRange, "page_token", text)
        })?,
    };
    // One more tells whether there is another page.
    let mut shapes = daemon
        .library
        .shapes(&r.collection, after, size + 1, r.label)
        .map_err(refuse)?;
    let more = shapes.len() > size;
    shapes.truncate(size);
    let last = shapes
        .last()
        .filter(|_| more)
        .map(|s| s.ordinal.to_string());
    Ok(wire::ListShapesReply {
        shapes: shapes.iter().map(convert::shape).collect(),
        next_page_token: last.unwrap_or_default(),
    })
}

fn list_jobs(
    daemon: &Daemon,
    r: &wire::ListJobsRequest,
) -> Result<wire::ListJobsReply, wire::Error> {
    let size = page("page_size", r.page_size, MAX_PAGE)?;
    let filter = JobFilter {
        failed: r.failed,
        before: r.before,
        collection: Some(r.collection.clone()).filter(|c| !c.is_empty()),
    };
    let mut jobs = daemon.library.jobs(&filter, size + 1).map_err(refuse)?;
    let more = jobs.len() > size;
    jobs.truncate(size);
    Ok(wire::ListJobsReply {
        jobs: jobs.iter().map(|j| daemon.job_to_wire(j)).collect(),
        more,
    })
}

fn events_since(
    daemon: &Daemon,
    r: &wire::EventsSinceRequest,
) -> Result<wire::EventsSinceReply, wire::Error> {
    let limit = page("limit", r.limit, MAX_PAGE)?;
    let mut events = daemon
        .library
        .events_since(&r.collection, r.sequence, limit + 1)
        .map_err(refuse)?;
    let more = events.len() > limit;
    events.truncate(limit);
    let events = events
        .iter()
        .map(|e| convert::event(&r.collection, e))
        .collect();
    Ok(wire::EventsSinceReply { events, more })
}

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
        event_endpoint: daemon.events.to_string(),
        instance: daemon.instance.clone(),
    }
}

fn stats(daemon: &Daemon) -> Result<wire::StatsReply, LibraryError> {
    let s = daemon.library.stats()?;
    let count = |counter: &std::sync::atomic::AtomicU64| counter.load(Ordering::Relaxed);
    let config = daemon.config();
    Ok(wire::StatsReply {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        instance: daemon.instance.clone(),
        pid: std::process::id(),
        uptime_ms: u64::try_from(daemon.started.elapsed().as_millis()).unwrap_or(u64::MAX),
        n_collections: s.n_collections,
        n_shapes: s.n_shapes,
        n_queued: s.n_queued,
        n_stale: s.n_stale,
        stored_bytes: s.stored_bytes,
        catalog_bytes: s.catalog_bytes,
        max_relabelled: s.max_relabelled,
        max_maps: s.max_maps,
        n_requests: count(&daemon.counters.requests),
        n_refused: count(&daemon.counters.refused),
        n_failed: count(&daemon.counters.failed),
        memory_limit_bytes: config.limits.memory.0,
        memory_reserved_bytes: memory_reserved(daemon).iter().map(|(_, n)| n).sum(),
        resident_bytes: resident_bytes(),
        workers: daemon.n_workers as u32,
        n_placed: daemon.metrics.n_placed(),
        n_relabelled: daemon.metrics.relabelled.get(),
        n_inconsistent_maps: daemon.metrics.inconsistent.get(),
        n_events: daemon.metrics.events.get(),
        received_bytes: daemon.metrics.received_bytes.get(),
        sent_bytes: daemon.metrics.sent_bytes.get(),
        stages: daemon.metrics.stages(&daemon.work.progress().n_at_stages()),
    })
}

/// What memory is reserved for, and how much.
fn memory_reserved(daemon: &Daemon) -> [(&'static str, u64); 4] {
    [
        ("requests", daemon.request_memory.used()),
        ("arriving", daemon.arriving.load(Ordering::Relaxed)),
        ("replies", daemon.replies.used()),
        ("describing", daemon.describe_memory.used()),
    ]
}

/// All that is measured, as text for Prometheus.
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
    let now = Now {
        library,
        n_queued,
        n_jobs,
        at_stages,
        memory_limit: daemon.config().limits.memory.0,
        memory_reserved: memory_reserved(daemon),
        resident_bytes: resident_bytes(),
        workers: daemon.n_workers,
        uptime_secs: daemon.started.elapsed().as_secs_f64(),
        requests_in_hand: daemon.max_pending - daemon.pending.available_permits(),
        ready: not_ready(daemon).is_none(),
    };
    Ok(daemon.metrics.text(&now))
}

/// Why changes are refused; `None` while they are not.
pub(crate) fn not_ready(daemon: &Daemon) -> Option<String> {
    if daemon.is_draining() {
        return Some("draining".to_owned());
    }
    let stopped = daemon.library.store().health().read_only();
    stopped.map(|(since, cause)| format!("the store refuses writes since {since}: {cause}"))
}

/// Resident memory of this process as the kernel counts it; 0 if it does not say.
fn resident_bytes() -> u64 {
    let Ok(status) = std::fs::read_to_string("/proc/self/status") else {
        return 0;
    };
    let kib = status
        .lines()
        .find_map(|l| l.strip_prefix("VmRSS:")?.trim().strip_suffix(" kB"));
    kib.and_then(|n| n.parse::<u64>().ok()).unwrap_or(0) << 10
}

/// Stored shapes whose labels wait to be recomputed, of one collection or of all.
pub(crate) fn n_stale(daemon: &Daemon, collection: Option<&str>) -> Result<u64, LibraryError> {
    match collection {
        Some(name) => Ok(daemon.library.collection(name)?.n_stale),
        None => Ok(daemon.library.stats()?.n_stale),
    }
}
