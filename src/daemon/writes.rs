//! Requests that change something, carried out one after the other.

use crate::config;
use crate::daemon::progress::{Load, Waiting};
use crate::daemon::publish::Notice;
use crate::daemon::requests::draining;
use crate::daemon::{Daemon, asked};
use crate::ipc::convert;
use crate::ipc::endpoint::Endpoint;
use crate::ipc::frames::FrameReader;
use crate::ipc::wire::{self, ErrorCode, ErrorReason, reply::Result as Reply, request::Body};
use crate::library::{KeptShapes, LibraryError, RequestKey};
use bytes::Bytes;
use std::io::Read as _;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;

/// Milliseconds, at least and at most, after which a queue of shapes that is full is worth another try.
const QUEUE_RETRY_MS: (u64, u64) = (250, 60_000);

/// How a change is answered.
#[allow(clippy::large_enum_variant)] // returned once, never in a collection
pub(crate) enum Done {
    /// With this.
    Now(Box<Reply>),
    /// With this job, once it is finished.
    WhenPlaced(u64),
}

/// The idempotency key of a request, if its client has a name.
pub(crate) fn key(request: &wire::Request) -> Option<RequestKey> {
    (!request.client_id.is_empty()).then(|| RequestKey {
        client_id: request.client_id.clone(),
        request_id: request.request_id.clone(),
    })
}

/// Carries out one change, durably.
pub(crate) fn change(
    daemon: &Arc<Daemon>,
    body: &Body,
    frames: &[Bytes],
    key: Option<&RequestKey>,
) -> Result<Done, wire::Error> {
    if let Body::Drain(_) = body {
        return drain(daemon).map(|reply| Done::Now(Box::new(reply)));
    }
    may_change(daemon, key)?;
    let library = &daemon.library;
    let reply = match body {
        Body::CreateCollection(r) => {
            let spec = r.spec.as_ref().ok_or_else(|| {
                convert::field_error(ErrorReason::FieldMissing, "spec", "spec is missing")
            })?;
            let spec = convert::collection_spec(spec, "spec")?;
            let info = library.create_collection(&spec, key).map_err(refuse)?;
            daemon.notice(Notice::Created(spec.name, info.sequence));
            let collection = Some(convert::collection(&info));
            Reply::CreateCollection(wire::CreateCollectionReply { collection })
        }
        Body::DeleteCollection(r) => {
            library
                .delete_collection(&r.collection, key)
                .map_err(refuse)?;
            daemon.work.progress().remove_idle_lane(&r.collection);
            daemon.notice(Notice::Changed(r.collection.clone()));
            Reply::DeleteCollection(wire::DeleteCollectionReply {})
        }
        Body::NameLabel(r) => {
            let label = library
                .name_label(&r.collection, r.label, &r.name, key)
                .map_err(refuse)?;
            daemon.notice(Notice::Changed(r.collection.clone()));
            Reply::NameLabel(wire::NameLabelReply {
                label: Some(convert::label_info(&label)),
            })
        }
        Body::CorrectLabels(_)
        | Body::MergeLabels(_)
        | Body::SplitLabel(_)
        | Body::Undo(_)
        | Body::RemoveShape(_) => asked::change(daemon, body, frames, key)?,
        Body::CancelJob(r) => {
            let job = library.cancel(r.job_id).map_err(refuse)?;
            daemon.forget_cancelled(&job);
            Reply::CancelJob(wire::CancelJobReply {
                job: Some(daemon.job_to_wire(&job)),
            })
        }
        Body::RetryJob(r) => {
            let (job, items) = library.retry(r.job_id).map_err(refuse)?;
            let n_queued = items.len() as u32;
            let mut waiting = Vec::new();
            for item in items {
                let n_bytes = library.item_bytes(&item).map_err(refuse)?;
                waiting.push(Waiting { item, n_bytes });
            }
            daemon.take_up_items(waiting);
            Reply::RetryJob(wire::RetryJobReply {
                job: Some(daemon.job_to_wire(&job)),
                n_queued,
            })
        }
        other => unreachable!("invariant: dispatch sends only changes here, not {other:?}"),
    };
    Ok(Done::Now(Box::new(reply)))
}

/// Refuses changes while the daemon drains, and those of a named client without an id.
fn may_change(daemon: &Daemon, key: Option<&RequestKey>) -> Result<(), wire::Error> {
    if daemon.is_draining() {
        return Err(draining());
    }
    if key.is_some_and(|k| k.request_id.is_empty()) {
        let text = "a change by a named client needs a request_id";
        return Err(convert::field_error(
            ErrorReason::FieldMissing,
            "request_id",
            text,
        ));
    }
    Ok(())
}

fn refuse(e: LibraryError) -> wire::Error {
    convert::library_error(&e)
}

fn drain(daemon: &Daemon) -> Result<Reply, wire::Error> {
    if !daemon.has_keys && matches!(daemon.endpoint, Endpoint::Tcp { .. }) {
        return Err(convert::error(
            ErrorCode::PermissionDenied,
            ErrorReason::AdminIpcOnly,
            "without keys, only a client on an ipc endpoint may drain the daemon",
        ));
    }
    let n_queued = daemon.work.progress().n_live(None) as u64;
    Ok(Reply::Drain(wire::DrainReply { n_queued }))
}

/// Room in the queue for shapes that are being taken in, given back when dropped.
pub(crate) struct Room {
    daemon: Arc<Daemon>,
    n_bytes: Vec<u64>,
}

impl Room {
    /// Reserves room for so many shapes, whatever their size, or refuses them.
    pub(crate) fn reserve(daemon: &Arc<Daemon>, n_shapes: usize) -> Result<Self, wire::Error> {
        let mut room = Self {
            daemon: Arc::clone(daemon),
            n_bytes: Vec::new(),
        };
        // Where nothing is taken in, that is the reason to tell; what can never be taken in is looked at
        // closely, and told what is wrong with it.
        match room.resize(vec![0; n_shapes]) {
            Err(full) if full.code() == ErrorCode::ResourceExhausted && !daemon.is_draining() => {
                Err(full)
            }
            _ => Ok(room),
        }
    }

    /// Reserves room for shapes of so many bytes in place of what is reserved, which is kept if there is none: by number, by
    /// bytes, and by the time that placing all of them is estimated to take.
    fn resize(&mut self, n_bytes: Vec<u64>) -> Result<(), wire::Error> {
        let mut progress = self.daemon.work.progress();
        progress.release(&self.n_bytes);
        let admitted = admit(&self.daemon, &progress.load(), &n_bytes);
        if admitted.is_ok() {
            self.n_bytes = n_bytes;
        }
        progress.reserve(&self.n_bytes);
        admitted
    }
}

impl Drop for Room {
    fn drop(&mut self) {
        self.daemon.work.progress().release(&self.n_bytes);
    }
}

/// Shapes whose files are durable, to be accepted in turn.
pub(crate) struct Addition {
    request: wire::AddShapesRequest,
    shapes: KeptShapes,
    room: Room,
}

/// Writes the files of shapes, durably. Whether there is such a collection shows when it is their turn: a request before
/// theirs may create it.
pub(crate) fn keep(
    daemon: &Arc<Daemon>,
    request: wire::AddShapesRequest,
    frames: &[Bytes],
    mut room: Room,
    key: Option<&RequestKey>,
) -> Result<Addition, wire::Error> {
    may_change(daemon, key)?;
    let config = daemon.config();
    let (limits, roots) = (&config.limits, &config.ingest.paths);
    let max_shape_bytes = limits.shape_bytes();
    let read_path = |path: &Path| read_allowed(path, roots, max_shape_bytes);
    let ingest = convert::Ingest {
        max_shapes: limits.max_shapes_per_request,
        max_shape_bytes,
        read_path: &read_path,
    };
    let shapes = convert::new_shapes(&request, FrameReader::new(frames), &ingest)?;
    room.resize(shapes.iter().map(|s| s.bytes.len() as u64).collect())?;
    let shapes = daemon.library.keep(shapes).map_err(refuse)?;
    Ok(Addition {
        request,
        shapes,
        room,
    })
}

/// Accepts shapes whose files are there, durably.
pub(crate) fn accept(
    daemon: &Arc<Daemon>,
    addition: &Addition,
    key: Option<&RequestKey>,
) -> Result<Done, wire::Error> {
    may_change(daemon, key)?;
    let request = &addition.request;
    if let Some(create) = &request.create {
        ensure_collection(daemon, &request.collection, create)?;
    }
    let job = daemon
        .library
        .submit(&request.collection, &addition.shapes, key)
        .map_err(refuse)?;
    daemon.take_up(&job, &addition.room.n_bytes);
    match request.mode() {
        wire::AddMode::Wait => Ok(Done::WhenPlaced(job.id)),
        wire::AddMode::Job | wire::AddMode::Unspecified => {
            let reply = convert::add_shapes(job.id, job.items.len(), None);
            Ok(Done::Now(Box::new(Reply::AddShapes(reply))))
        }
    }
}

/// Refuses shapes for which a queue with that load has no room.
fn admit(daemon: &Daemon, load: &Load, n_bytes: &[u64]) -> Result<(), wire::Error> {
    let limits = &daemon.config().limits;
    let (n, bytes) = (n_bytes.len(), n_bytes.iter().sum::<u64>());
    let secs = load.seconds_of(n, bytes);
    let max_secs = limits.max_queued_seconds as f64;
    let max_shapes = limits.max_queued_shapes as f64;
    let max_bytes = limits.max_queued_bytes.0 as f64;
    for (what, asked, queued, limit) in [
        ("shapes", n as f64, load.n_shapes as f64, max_shapes),
        ("bytes", bytes as f64, load.n_bytes as f64, max_bytes),
        // An estimate alone refuses nothing for good: an empty queue takes whatever it says.
        (
            "seconds of work",
            secs.ceil().min(max_secs),
            load.seconds().floor(),
            max_secs,
        ),
    ] {
        if asked > limit {
            let text = format!("the request has {asked} {what}, the whole queue holds {limit}");
            let code = ErrorCode::InvalidArgument;
            return Err(convert::error(code, ErrorReason::MessageTooLarge, text));
        }
        if queued + asked > limit {
            let text = format!(
                "{queued} {what} are queued and {asked} more asked for, the limit is {limit}"
            );
            let code = ErrorCode::ResourceExhausted;
            let mut error = convert::error(code, ErrorReason::QueueFull, text);
            // Until as much is done as there is too much of.
            let wait = load.seconds() * (queued + asked - limit) / queued.max(1.0);
            let n_refused = daemon.counters.refused.fetch_add(1, Ordering::Relaxed);
            error.retry_after_ms = spread_out(wait * 1e3, n_refused);
            return Err(error);
        }
    }
    Ok(())
}

/// Milliseconds to be told to the `n`th who is refused: up to twice as many, evenly, so that those who were refused at the
/// same moment do not come back at the same moment.
fn spread_out(wait_ms: f64, n: u64) -> u64 {
    // The fraction of n times the golden ratio.
    let share = n.wrapping_mul(0x9E37_79B9_7F4A_7C15) as f64 / 2.0_f64.powi(64);
    let wait_ms = wait_ms.clamp(QUEUE_RETRY_MS.0 as f64, QUEUE_RETRY_MS.1 as f64);
    ((wait_ms * (1.0 + share)) as u64).min(QUEUE_RETRY_MS.1)
}

/// Creates the collection if it is missing, or compares it with what the request states.
fn ensure_collection(
    daemon: &Arc<Daemon>,
    name: &str,
    wish: &wire::CollectionSpec,
) -> Result<(), wire::Error> {
    if !wish.name.is_empty() && wish.name != name {
        let text = format!("create.name is {:?}, but collection is {name:?}", wish.name);
        return Err(convert::field_error(
            ErrorReason::FieldRange,
            "create.name",
            text,
        ));
    }
    let named = wire::CollectionSpec {
        name: name.to_owned(),
        ..wish.clone()
    };
    let spec = convert::collection_spec(&named, "create")?;
    match daemon.library.collection(name) {
        Ok(is) => match convert::collection_differs(&named, &is.spec) {
            None => Ok(()),
            Some((setting, wish, is)) => {
                let text = format!("collection {name:?} has {setting} {is}, not {wish}");
                let code = ErrorCode::FailedPrecondition;
                Err(convert::error(code, ErrorReason::CollectionDiffers, text))
            }
        },
        Err(LibraryError::NotFound { .. }) => {
            let info = daemon
                .library
                .create_collection(&spec, None)
                .map_err(refuse)?;
            daemon.notice(Notice::Created(name.to_owned(), info.sequence));
            Ok(())
        }
        Err(e) => Err(refuse(e)),
    }
}

/// The bytes of a file below one of `roots`.
fn read_allowed(
    path: &Path,
    roots: &[std::path::PathBuf],
    max_bytes: u64,
) -> Result<Vec<u8>, wire::Error> {
    let forbidden = || {
        let text = format!(
            "{} is not below a directory of ingest.paths",
            path.display()
        );
        convert::error(
            ErrorCode::PermissionDenied,
            ErrorReason::PathForbidden,
            text,
        )
    };
    if !path.is_absolute() || !config::is_below(path, roots) {
        return Err(forbidden());
    }
    let unreadable = |text: String| {
        convert::error(
            ErrorCode::InvalidArgument,
            ErrorReason::PathUnreadable,
            text,
        )
    };
    let io = |e: std::io::Error| unreadable(format!("{}: {e}", path.display()));
    let resolved = path.canonicalize().map_err(io)?;
    // A pipe or a device could block for ever or never end.
    if !std::fs::metadata(&resolved).map_err(io)?.is_file() {
        return Err(unreadable(format!(
            "{} is not a regular file",
            path.display()
        )));
    }
    let file = std::fs::File::open(&resolved).map_err(io)?;
    let mut bytes = Vec::new();
    // One byte more shows that the file is too large.
    file.take(max_bytes.saturating_add(1))
        .read_to_end(&mut bytes)
        .map_err(io)?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::{QUEUE_RETRY_MS, spread_out};

    #[test]
    fn those_who_are_refused_together_come_back_one_after_the_other() {
        let mut told: Vec<u64> = (0..64).map(|n| spread_out(0.0, n)).collect();
        told.sort_unstable();
        assert!(told[0] >= QUEUE_RETRY_MS.0 && told[63] < 2 * QUEUE_RETRY_MS.0);
        let gaps = told.windows(2).map(|w| w[1] - w[0]);
        assert!(gaps.clone().max() <= Some(8), "{told:?}");
        assert!(gaps.clone().filter(|gap| *gap == 0).count() < 4, "{told:?}");
        assert_eq!(spread_out(f64::INFINITY, 1), QUEUE_RETRY_MS.1);
    }
}
