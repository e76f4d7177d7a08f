//! Whether the daemon waits for the peer of a connection, and for how long it may.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::Notify;

/// Time for the head of a request, also of the first and the next on a connection that is kept
/// open; for its body; and for a peer to take the next bytes of an answer.
pub(super) const PEER_TIME: Duration = Duration::from_secs(10);

/// The state of one connection.
pub(super) struct Connection {
    /// Since when the daemon waits for the peer; none while it works on a request. Changed by the
    /// connection's task, read by the one that accepts.
    waiting: Mutex<Option<Instant>>,
    changed: Arc<Notify>,
}

impl Connection {
    /// A new connection, whose peer must send a request. `changed` is notified when it waits.
    pub(super) fn new(changed: Arc<Notify>) -> Self {
        Self {
            waiting: Mutex::new(Some(Instant::now())),
            changed,
        }
    }

    /// The daemon works on a request, and the connection keeps its place.
    pub(super) fn works(&self) {
        *self.waiting.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }

    /// The daemon waits for a request, for the rest of one, or for an answer to be read.
    pub(super) fn waits(&self) {
        *self.waiting.lock().unwrap_or_else(PoisonError::into_inner) = Some(Instant::now());
        self.changed.notify_one();
    }

    pub(super) fn waiting_since(&self) -> Option<Instant> {
        *self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
