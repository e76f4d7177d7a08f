//! Carries out computations and edits in a worker, so that one that aborts, loops or takes too much
//! memory costs its request only.
//!
//! They are tried once. An edit is one transaction, so a worker that ends has made all of it or
//! nothing. A client that gave a request id can send the request again to learn which.

use crate::config::Limits;
use crate::daemon::answer::{Answer, panicked, refused};
use crate::daemon::failures::{died, failed, too_long};
use crate::daemon::operation::{Compute, Edit, Remote};
use crate::daemon::shared::{Daemon, Notice, blocking};
use crate::daemon::worker::{Ended, RemoteWork, read_answer};
use crate::daemon::writes::{Done, may_change};
use crate::ipc::convert;
use crate::ipc::wire;
use crate::library::{Code, Reason, RequestKey};
use bytes::Bytes;
use prost::Message as _;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Computes an answer. If the future is dropped, because no client waits any more, the work ends.
pub(crate) async fn compute(daemon: &Arc<Daemon>, compute: Compute, frames: Vec<Bytes>) -> Answer {
    let caller = Arc::new(());
    let waiting = Arc::downgrade(&caller);
    let answer = blocking(daemon, move |d| {
        let wanted = || waiting.strong_count() > 0;
        run(d, Remote::Compute(compute), &frames, None, &wanted)
    });
    let answer = answer.await;
    drop(caller);
    answer.unwrap_or_else(|panic| Err(panicked(&panic)))
}

/// Makes an edit. Waits for the collection.
pub(crate) fn edit(
    daemon: &Arc<Daemon>,
    edit: Edit,
    frames: &[Bytes],
    key: Option<&RequestKey>,
) -> Result<Done, wire::Error> {
    may_change(daemon, key)?;
    let writable = daemon.library.store().health().writable();
    writable.map_err(|e| refused(e.into()))?;
    let collection = edit.collection().to_owned();
    let make = || {
        let runtime = tokio::runtime::Handle::current();
        let _permit = runtime.block_on(daemon.capacity.editing.acquire());
        run(daemon, Remote::Edit(edit), frames, key, &|| true)
    };
    let made = daemon
        .library
        .with_exclusive(&collection, make)
        .map_err(refused)?;
    // Also after a failure: a worker may have ended just after the commit.
    daemon.notice(Notice::Changed(collection.clone()));
    daemon.nudge(&collection);
    daemon.needs_sweep();
    made.map(|(reply, _)| Done::Now(Box::new(reply)))
}

/// Runs work in a worker, for as long as the answer is `wanted`.
fn run(
    daemon: &Arc<Daemon>,
    work: Remote,
    frames: &[Bytes],
    key: Option<&RequestKey>,
    wanted: &dyn Fn() -> bool,
) -> Answer {
    let config = daemon.config();
    let limit = Duration::from_secs(config.work.shape_seconds);
    let begin = Instant::now();
    let collection = work.collection().to_owned();
    let n_bytes = frames.iter().map(|f| f.len() as u64).sum::<u64>() + n_bytes_read(daemon, &work);
    let (client_id, request_id) = key.map_or_else(Default::default, |k| {
        (k.client_id.clone(), k.request_id.clone())
    });
    let request = wire::Request {
        client_id,
        request_id,
        body: Some(work.into()),
        ..wire::Request::default()
    };
    let work = RemoteWork {
        request: &request.encode_to_vec(),
        frames,
        memory: Limits::to_describe(n_bytes),
        max_bytes: config.limits.max_message.0,
    };
    let in_time = || begin.elapsed() < limit && wanted();
    let failure = match daemon.pool.answer(&collection, &work, &in_time) {
        Ok(pieces) => match read_answer(pieces) {
            Ok((stopped, answer)) => {
                if let Some(cause) = stopped {
                    // The failure of its disk is the failure of this process's disk.
                    daemon.library.store().health().stop(cause);
                }
                return answer;
            }
            Err(text) => failed(Code::Internal, Reason::WorkerDied, text),
        },
        Err(Ended::Stopped) => too_long("answering", begin.elapsed(), limit),
        Err(Ended::Died {
            text,
            out_of_memory,
        }) => {
            daemon.telemetry.metrics.workers_died.inc();
            tracing::warn!(
                collection,
                text,
                "a worker ended while it answered a request"
            );
            died(
                "the work on this request ended its process",
                &text,
                out_of_memory,
            )
        }
    };
    Err(convert::failure(&failure))
}

/// Bytes of the mesh files that are read for the work.
fn n_bytes_read(daemon: &Daemon, work: &Remote) -> u64 {
    let Remote::Compute(compute) = work else {
        return 0;
    };
    let names: Vec<&String> = match compute {
        Compute::GetPortraits(r) if r.detail() == wire::PortraitDetail::Surface => {
            r.shapes.iter().collect()
        }
        // Arrays on the proxy are stored: these are of the mesh as sent.
        Compute::GetSpectrum(r) => vec![&r.shape],
        Compute::GetHks(r) => vec![&r.shape],
        // Files are read for some of these.
        Compute::GetFunctionalMap(r) => vec![&r.from, &r.to],
        Compute::TransferFunction(r) => vec![&r.from, &r.to],
        _ => Vec::new(),
    };
    let length = |name: &&String| daemon.library.original_length(compute.collection(), name);
    // A missing shape is refused by the worker.
    names.iter().filter_map(|name| length(name).ok()).sum()
}
