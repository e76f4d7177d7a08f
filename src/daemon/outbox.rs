//! What the other threads leave for the socket thread to send, and what it tells of clients that do not read.

use crate::daemon::replies::{Frame, Replies};
use crate::daemon::requests;
use crate::ipc::wire::{Reply, reply};
use bytes::Bytes;
use prost::Message as _;
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::time::{Duration, Instant};

/// Between two lines of the log that say that connections were dropped.
const SAY_DROPPED: Duration = Duration::from_secs(10);

/// Where a reply goes.
#[derive(Debug, Clone)]
pub(crate) struct Peer {
    pub(crate) identity: Bytes,
    /// Whether the peer puts an empty frame before the header, as a REQ socket does.
    pub(crate) delimiter: bool,
}

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

/// Where the other threads leave what is to be sent.
pub(crate) struct Outbox {
    queue: mpsc::Sender<Outgoing>,
    wake: Mutex<zmq::Socket>,
    replies: Arc<Replies>,
}

impl Outbox {
    /// With where the socket thread finds what is left here.
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

    /// Sends a reply; or, where there is no room for it, says so.
    pub(crate) fn reply(&self, peer: Peer, mut reply: Reply, mut frames: Vec<Bytes>) {
        frames.insert(0, reply.encode_to_vec().into());
        let taken = self.replies.take(&peer.identity, frames).or_else(|_| {
            self.replies.end_stalled(|client| self.end(client));
            let text = "replies that are not read yet leave no memory for this one";
            reply.result = Some(reply::Result::Error(requests::busy(text)));
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
        // The thread is gone: so is whoever waits for this.
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

/// Connections that were ended since the start, and what of that was said.
#[derive(Default)]
pub(crate) struct Dropped {
    /// Their clients did not read.
    pub(crate) unread: u64,
    /// They sent more, before a message was whole, than there is memory for.
    pub(crate) excess: u64,
    /// They subscribed to more than they may.
    pub(crate) subscriptions: u64,
    said: Option<(Instant, u64)>,
}

impl Dropped {
    /// Says it if there is something new, and not too often.
    pub(crate) fn say(&mut self) {
        let all = self.unread + self.excess + self.subscriptions;
        let recently = |at: Instant| at.elapsed() < SAY_DROPPED;
        if self
            .said
            .map_or(all == 0, |(at, n)| n == all || recently(at))
        {
            return;
        }
        self.said = Some((Instant::now(), all));
        tracing::warn!(
            unread = self.unread,
            excess = self.excess,
            subscriptions = self.subscriptions,
            "connections were ended, since the start: of clients that do not read their replies, that send more \
             than limits.memory has room for, or that subscribe to too much"
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
