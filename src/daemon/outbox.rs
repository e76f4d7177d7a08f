//! Messages that the other threads leave for the socket thread to send, and its count of the
//! connections that it ended.

use crate::daemon::answer::{Peer, busy};
use crate::daemon::replies::{Frame, Replies};
use crate::ipc::wire::{Reply, reply};
use bytes::Bytes;
use prost::Message as _;
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::time::{Duration, Instant};

/// Between two lines of the log that report ended connections.
const REPORT_PACE: Duration = Duration::from_secs(10);

pub(crate) enum Outgoing {
    Reply {
        peer: Peer,
        frames: Vec<Frame>,
    },
    /// Ends the connection of a client that does not read.
    End(Bytes),
    Event {
        topic: Vec<u8>,
        body: Vec<u8>,
    },
    Reload,
    Stop,
}

/// The queue of messages to be sent.
pub(crate) struct Outbox {
    queue: mpsc::Sender<Outgoing>,
    wake: Mutex<zmq::Socket>,
    replies: Arc<Replies>,
}

impl Outbox {
    /// The outbox, and the end of its queue for the socket thread.
    pub(crate) fn new(
        wake: zmq::Socket,
        replies: Arc<Replies>,
    ) -> (Arc<Self>, mpsc::Receiver<Outgoing>) {
        let (sender, queue) = mpsc::channel();
        let outbox = Self {
            queue: sender,
            wake: Mutex::new(wake),
            replies,
        };
        (Arc::new(outbox), queue)
    }

    /// Sends a reply or, if there is no room for it, an error that says so.
    pub(crate) fn reply(&self, peer: Peer, mut reply: Reply, mut frames: Vec<Bytes>) {
        frames.insert(0, reply.encode_to_vec().into());
        let taken = self.replies.take(&peer.identity, frames).or_else(|_| {
            self.replies.end_stalled(|client| self.end(client));
            let text = "replies that are not read yet leave no memory for this one";
            reply.result = Some(reply::Result::Error(busy(text)));
            self.replies
                .take(&peer.identity, vec![reply.encode_to_vec().into()])
        });
        match taken {
            Ok(frames) => self.push(Outgoing::Reply { peer, frames }),
            Err(_) => self.end(peer.identity),
        }
    }

    /// Ends the connection of a client that does not read.
    pub(crate) fn end(&self, client: Bytes) {
        self.replies.ends(&client);
        self.push(Outgoing::End(client));
    }

    pub(crate) fn event(&self, topic: Vec<u8>, body: Vec<u8>) {
        self.push(Outgoing::Event { topic, body });
    }

    /// Reads the allow list again.
    pub(crate) fn reload(&self) {
        self.push(Outgoing::Reload);
    }

    pub(crate) fn stop(&self) {
        self.push(Outgoing::Stop);
    }

    fn push(&self, outgoing: Outgoing) {
        // The thread is gone, and with it the receivers of this.
        if self.queue.send(outgoing).is_err() {
            return;
        }
        let wake = self.wake.lock().unwrap_or_else(PoisonError::into_inner);
        match wake.send(zmq::Message::new(), zmq::DONTWAIT) {
            // Full: a wake-up is under way already.
            Ok(()) | Err(zmq::Error::EAGAIN) => {}
            Err(e) => tracing::error!(error = %e, "the socket thread cannot be woken"),
        }
    }
}

/// Connections that were ended since the start, and the last report of them.
#[derive(Default)]
pub(crate) struct Dropped {
    /// Their clients did not read.
    pub(crate) unread: u64,
    /// They sent more, before a message was whole, than there is memory for.
    pub(crate) excess: u64,
    /// They subscribed to more than they may.
    pub(crate) subscriptions: u64,
    reported: Option<(Instant, u64)>,
}

impl Dropped {
    /// Logs the counts if they have changed, and not too often.
    pub(crate) fn report(&mut self) {
        let all = self.unread + self.excess + self.subscriptions;
        let recently = |at: Instant| at.elapsed() < REPORT_PACE;
        if self
            .reported
            .map_or(all == 0, |(at, n)| n == all || recently(at))
        {
            return;
        }
        self.reported = Some((Instant::now(), all));
        tracing::warn!(
            unread = self.unread,
            excess = self.excess,
            subscriptions = self.subscriptions,
            "connections were ended, since the start: of clients that do not read their replies, \
             that send more than limits.memory has room for, or that subscribe to too much"
        );
    }
}

/// Sends the frames of a reply, without copying them.
pub(crate) fn send_reply(
    router: &mut zmq::Socket,
    peer: &Peer,
    frames: Vec<Frame>,
) -> zmq::Result<()> {
    router.send(&peer.identity[..], zmq::DONTWAIT | zmq::SNDMORE)?;
    if peer.delimiter {
        router.send(zmq::Message::new(), zmq::DONTWAIT | zmq::SNDMORE)?;
    }
    let last = frames.len().saturating_sub(1);
    for (i, frame) in frames.into_iter().enumerate() {
        let more = if i < last { zmq::SNDMORE } else { 0 };
        zmq_bounds::send_owned(router, frame, zmq::DONTWAIT | more)?;
    }
    Ok(())
}
