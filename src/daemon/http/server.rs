//! The state that HTTP connections share, and their requests to the daemon.

use super::connection::PEER_TIME;
use super::guard::Guard;
use super::hands::{self, Hands, Reserved};
use super::page::{Page, failed, text};
use crate::daemon::answer::{Answer, ReplyTo, busy};
use crate::daemon::incoming::Incoming;
use crate::daemon::operation::Operation;
use crate::daemon::shared::Daemon;
use crate::ipc::convert;
use crate::ipc::wire::{ErrorCode, ErrorReason, request::Body};
use bytes::Bytes;
use http_body_util::BodyExt as _;
use hyper::StatusCode;
use hyper::body::{Body as _, Incoming as HttpBody};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, oneshot};

/// Bytes of the body of a change: runs of labels.
const MAX_BODY: u64 = 8 << 20;
/// Bytes that are reserved for each byte of a body when it comes: for itself, in a buffer that
/// doubles, and for the runs that are read from it.
const PER_BODY_BYTE: u64 = 5;
/// A request that takes longer has failed for the page.
const ANSWER_MS: u64 = 60_000;
/// Between checks of the threads.
const LOOK: Duration = Duration::from_secs(1);
/// The client that all HTTP requests count for. It is no client of the sockets, whose identities
/// have five bytes if they begin with a zero.
const CLIENT: Bytes = Bytes::from_static(b"\0http requests");

/// The state that connections share. It is fixed at the start, except for the metrics.
pub(super) struct Server {
    pub(super) daemon: Arc<Daemon>,
    requests: mpsc::Sender<Incoming>,
    pub(super) guard: Guard,
    pub(super) hands: Hands,
    /// The metrics as they were last read. Locked while one request reads them, for which the
    /// others wait.
    pub(super) metrics: Arc<tokio::sync::Mutex<Option<(Instant, Bytes)>>>,
    /// The threads that `/healthz` watches.
    pub(super) threads: [Thread; 2],
}

/// A thread of the daemon that must not hang.
pub(super) struct Thread {
    pub(super) name: &'static str,
    /// Advances while the thread lives.
    tick: Arc<AtomicU64>,
    /// Milliseconds after the start at which it last had advanced.
    seen: AtomicU64,
}

impl Thread {
    pub(super) fn new(name: &'static str, tick: &Arc<AtomicU64>) -> Self {
        Self {
            name,
            tick: Arc::clone(tick),
            seen: AtomicU64::new(0),
        }
    }

    /// The time after the start at which it was last seen to live.
    pub(super) fn seen(&self) -> Duration {
        Duration::from_millis(self.seen.load(Ordering::Relaxed))
    }
}

/// Notes when the threads were last seen to live.
pub(super) async fn watch(server: Arc<Server>) {
    let mut last = [None; 2];
    loop {
        for (thread, last) in server.threads.iter().zip(&mut last) {
            let now = thread.tick.load(Ordering::Relaxed);
            if *last != Some(now) {
                *last = Some(now);
                let ms = server.daemon.identity.started.elapsed().as_millis() as u64;
                thread.seen.store(ms, Ordering::Relaxed);
            }
        }
        tokio::time::sleep(LOOK).await;
    }
}

impl Server {
    pub(super) fn new(
        daemon: Arc<Daemon>,
        requests: mpsc::Sender<Incoming>,
        guard: Guard,
        threads: [Thread; 2],
    ) -> Arc<Self> {
        Arc::new(Self {
            guard,
            hands: Hands::new(&daemon.config().limits),
            metrics: Arc::default(),
            threads,
            daemon,
            requests,
        })
    }

    /// Refuses changes if the configuration allows none.
    pub(super) fn check_edit(&self) -> Result<(), String> {
        if !self.daemon.config().http.edit {
            return Err("http.edit is false: this viewer only shows".to_owned());
        }
        if self.daemon.has_keys() {
            return Err(
                "security.keys is set, and HTTP cannot tell who asks: this viewer only shows"
                    .to_owned(),
            );
        }
        Ok(())
    }

    /// Reads the body of a request. Memory is reserved for the bytes that came, not for those that
    /// are announced.
    pub(super) async fn collect(&self, mut sent: HttpBody) -> Result<Reserved<Vec<u8>>, Page> {
        let too_large = |found: u64| {
            let why = format!("the body has {found} bytes or more, the limit is {MAX_BODY}");
            text(StatusCode::PAYLOAD_TOO_LARGE, &why)
        };
        let announced = sent.size_hint().lower();
        if announced > MAX_BODY {
            return Err(too_large(announced));
        }
        let collected = async {
            let full = || failed(&hands::full());
            let mut memory = self.hands.memory(0).ok_or_else(full)?;
            let mut bytes = Vec::new();
            while let Some(frame) = sent.frame().await {
                let frame = frame.map_err(|e| {
                    text(
                        StatusCode::BAD_REQUEST,
                        &format!("the body cannot be read: {e}"),
                    )
                })?;
                // The daemon ignores trailers.
                let Ok(data) = frame.into_data() else {
                    continue;
                };
                let found = (bytes.len() + data.len()) as u64;
                if found > MAX_BODY {
                    return Err(too_large(found));
                }
                if !memory.try_grow(data.len() as u64 * PER_BODY_BYTE) {
                    return Err(full());
                }
                bytes.extend_from_slice(&data);
            }
            Ok(Reserved {
                value: bytes,
                memory,
            })
        };
        match tokio::time::timeout(PEER_TIME, collected).await {
            Ok(done) => done,
            Err(_) => {
                let why = format!("the body did not arrive within {} s", PEER_TIME.as_secs());
                Err(text(StatusCode::REQUEST_TIMEOUT, &why))
            }
        }
    }

    /// Sends a request that a client of the sockets could send, with the same order, limits and
    /// counters. The memory of frames goes with them.
    pub(super) async fn ask(&self, body: Body, frames: Option<Reserved<Vec<Bytes>>>) -> Answer {
        let (frames, memory) = frames.map_or((Vec::new(), None), |f| (f.value, Some(f.memory)));
        let n_bytes: u64 = frames.iter().map(|f| f.len() as u64).sum();
        let ticket = self.daemon.admission.quotas.admit(&CLIENT, n_bytes);
        let ticket = ticket.map_err(|text| busy(&text))?;
        let (sender, receiver) = oneshot::channel();
        let incoming = Incoming {
            reply_to: ReplyTo::Task(sender),
            user: None,
            client_id: String::new(),
            request_id: String::new(),
            deadline_ms: ANSWER_MS,
            operation: Some(Operation::from(body)),
            frames,
            received: Instant::now(),
            memory,
            ticket,
        };
        if self.requests.try_send(incoming).is_err() {
            return Err(busy("too many requests wait"));
        }
        receiver.await.unwrap_or_else(|_| {
            let text = "the daemon ended before it answered";
            Err(convert::error(
                ErrorCode::Internal,
                ErrorReason::Draining,
                text,
            ))
        })
    }
}
