//! Requests whose answers are computed from shapes, or that change their labels, are carried out in a worker: what aborts,
//! loops or takes too much memory there costs that request and nobody else.
//!
//! They are tried once. A change is one transaction, so a worker that ends has made all of it or nothing; whoever
//! named the request can send it again to learn which.

use crate::config::Limits;
use crate::daemon::publish::Notice;
use crate::daemon::requests::{Answer, panicked};
use crate::daemon::work::{died, failed, too_long};
use crate::daemon::worker::{self, Answering, Ended, subjects};
use crate::daemon::{Daemon, blocking};
use crate::ipc::convert;
use crate::ipc::wire::{self, reply::Result as Reply, request::Body};
use crate::library::{LibraryError, RequestKey};
use bytes::Bytes;
use prost::Message as _;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Answers a request that changes nothing. If the future is dropped, because whoever asked waits no longer, the work
/// ends.
pub(crate) async fn read(daemon: &Arc<Daemon>, body: Body, frames: Vec<Bytes>) -> Answer {
    let asking = Arc::new(());
    let waiting = Arc::downgrade(&asking);
    let answered = blocking(daemon, move |d| {
        let request = wire::Request {
            body: Some(body),
            ..wire::Request::default()
        };
        answer(d, &request, &frames, &|| waiting.strong_count() > 0)
    });
    let answered = answered.await;
    drop(asking);
    answered.unwrap_or_else(panicked)
}

/// Carries out a change of labels. Waits for the collection.
pub(crate) fn change(
    daemon: &Arc<Daemon>,
    body: &Body,
    frames: &[Bytes],
    key: Option<&RequestKey>,
) -> Result<Reply, wire::Error> {
    let writable = daemon.library.store().health().writable();
    writable.map_err(|e| convert::library_error(&e.into()))?;
    let key = key.cloned();
    let (client_id, request_id) =
        key.map_or_else(Default::default, |k| (k.client_id, k.request_id));
    let request = wire::Request {
        client_id,
        request_id,
        body: Some(body.clone()),
        ..wire::Request::default()
    };
    let (collection, _) = subjects(body);
    let carry_out = || {
        let runtime = tokio::runtime::Handle::current();
        let _permit = runtime.block_on(daemon.changing.acquire());
        answer(daemon, &request, frames, &|| true)
    };
    let changed = daemon.library.lend(collection, carry_out);
    let changed = changed.map_err(|e: LibraryError| convert::library_error(&e))?;
    // Also where it failed: a worker may have ended just after the commit.
    daemon.notice(Notice::Changed(collection.to_owned()));
    daemon.nudge(collection);
    changed.map(|(reply, _)| reply)
}

/// Answers a request in a worker, for as long as the answer is `wanted`.
fn answer(
    daemon: &Arc<Daemon>,
    request: &wire::Request,
    frames: &[Bytes],
    wanted: &dyn Fn() -> bool,
) -> Answer {
    let Some(body) = &request.body else {
        unreachable!("invariant: the dispatcher looked at the body");
    };
    let config = daemon.config();
    let limit = Duration::from_secs(config.work.shape_seconds);
    let begin = Instant::now();
    let n_bytes = frames.iter().map(|f| f.len() as u64).sum::<u64>() + n_bytes_read(daemon, body);
    let work = Answering {
        request: &request.encode_to_vec(),
        frames,
        memory: Limits::to_describe(n_bytes),
        max_bytes: config.limits.max_message.0,
    };
    let in_time = || begin.elapsed() < limit && wanted();
    let (collection, _) = subjects(body);
    let failure = match daemon.pool.answer(collection, &work, &in_time) {
        Ok(pieces) => match worker::read_answer(pieces) {
            Ok((stopped, answer)) => {
                if let Some(cause) = stopped {
                    // What its disk says counts for this process too.
                    daemon.library.store().health().stop(cause);
                }
                return answer;
            }
            Err(text) => failed("INTERNAL", "WORKER_DIED", text),
        },
        Err(Ended::Stopped) => too_long("answering", begin.elapsed(), limit),
        Err(Ended::Died {
            text,
            out_of_memory,
        }) => {
            daemon.metrics.workers_died.inc();
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

/// Bytes of the mesh files that are read to answer a request.
fn n_bytes_read(daemon: &Daemon, body: &Body) -> u64 {
    let Body::GetPortraits(r) = body else {
        return 0;
    };
    if r.detail() != wire::PortraitDetail::Surface {
        return 0;
    }
    let length = |name: &String| daemon.library.original_length(&r.collection, name);
    // What is not there is refused when its turn comes.
    r.shapes.iter().filter_map(|name| length(name).ok()).sum()
}
