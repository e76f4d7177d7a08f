//! A request that arrived, from the sockets or from HTTP.

use crate::daemon::answer::ReplyTo;
use crate::daemon::memory::Reservation;
use crate::daemon::operation::{Operation, request_key};
use crate::daemon::quota::Ticket;
use crate::library::RequestKey;
use bytes::Bytes;
use std::time::{Duration, Instant};

pub(crate) struct Incoming {
    pub(crate) reply_to: ReplyTo,
    /// The client's key, if connections are authenticated.
    pub(crate) user: Option<String>,
    pub(crate) client_id: String,
    pub(crate) request_id: String,
    /// Milliseconds after its arrival until it must be answered; 0: none.
    pub(crate) deadline_ms: u64,
    /// None if this version does not know it.
    pub(crate) operation: Option<Operation>,
    pub(crate) frames: Vec<Bytes>,
    pub(crate) received: Instant,
    /// Held for as long as the frames are.
    pub(crate) memory: Option<Reservation>,
    /// Counts it for its client.
    pub(crate) ticket: Ticket,
}

impl Incoming {
    /// The idempotency key.
    pub(crate) fn key(&self) -> Option<RequestKey> {
        request_key(&self.client_id, &self.request_id, self.user.as_deref())
    }

    pub(crate) fn deadline(&self) -> Option<Instant> {
        let ms = self.deadline_ms;
        (ms > 0)
            .then(|| self.received.checked_add(Duration::from_millis(ms)))
            .flatten()
    }
}
