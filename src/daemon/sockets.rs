//! The one thread that touches the sockets: it receives, checks and admits requests, and sends
//! replies and events.

use crate::daemon::answer::{
    BUSY_RETRY_MS, MAX_FRAMES, MAX_HEADER_BYTES, MAX_ID_CHARS, Peer, ReplyTo,
};
use crate::daemon::bind::Bound;
use crate::daemon::incoming::Incoming;
use crate::daemon::operation::Operation;
use crate::daemon::outbox::{Dropped, Outgoing, send_reply};
use crate::daemon::replies::Frame;
use crate::daemon::shared::{Admission, Telemetry};
use crate::ipc::convert;
use crate::ipc::fields::{self, MAX_FIELDS};
use crate::ipc::frames::{self, FrameLimits};
use crate::ipc::keys::Role;
use crate::ipc::size;
use crate::ipc::wire::{self, ErrorCode, ErrorReason, Reply, Request, reply};
use bytes::Bytes;
use prost::Message as _;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Bytes of memory that a decoded header takes for each of its bytes, and a frame beside its bytes.
const DECODED: u64 = 8;
const FRAME_COST: u64 = 256;
/// Routing frames before the raw frames of a received message: identity, perhaps a delimiter,
/// header.
const N_LEADING: usize = 3;
/// Milliseconds after which the thread checks its state even if nothing came, for the watchdog.
const POLL_MS: i64 = 500;
/// Requests, and bytes of their headers, that are read before replies get their turn.
const READ_BATCH: usize = 64;
const READ_BATCH_BYTES: usize = 256 << 10;
/// How long an address that was just given back is tried at a time.
const REBIND: Duration = Duration::from_millis(500);

/// The state that the socket thread shares with the daemon.
pub(crate) struct Shared {
    pub(crate) admission: Arc<Admission>,
    pub(crate) telemetry: Arc<Telemetry>,
    /// Advances while the thread lives.
    pub(crate) tick: Arc<AtomicU64>,
    pub(crate) max_message_bytes: u64,
}

/// Serves the sockets in a thread of their own until [`Outbox::stop`].
pub(crate) fn serve(
    bound: Bound,
    shared: Shared,
    requests: tokio::sync::mpsc::Sender<Incoming>,
) -> std::io::Result<JoinHandle<()>> {
    let limits = FrameLimits {
        max_message_bytes: shared.max_message_bytes,
        max_frames: MAX_FRAMES,
        max_header_bytes: MAX_HEADER_BYTES,
    };
    let thread = SocketThread {
        bound,
        shared,
        requests,
        limits,
        must_bind: false,
        dropped: Dropped::default(),
    };
    std::thread::Builder::new()
        .name("sockets".to_owned())
        .spawn(move || thread.run())
}

struct SocketThread {
    bound: Bound,
    shared: Shared,
    requests: tokio::sync::mpsc::Sender<Incoming>,
    limits: FrameLimits,
    /// The event socket was unbound and is not bound again yet.
    must_bind: bool,
    dropped: Dropped,
}

impl SocketThread {
    fn run(mut self) {
        let mut checked = Instant::now();
        loop {
            self.shared.tick.fetch_add(1, Ordering::Relaxed);
            let mut items = [
                self.bound.router.as_poll_item(zmq::POLLIN),
                self.bound.wake.as_poll_item(zmq::POLLIN),
                self.bound.zap.as_poll_item(zmq::POLLIN),
                // It has nothing to read, but processes subscriptions only when it is polled.
                self.bound.publisher.as_poll_item(zmq::POLLIN),
            ];
            match zmq::poll(&mut items, POLL_MS) {
                Ok(_) | Err(zmq::Error::EINTR) => {}
                Err(e) => {
                    tracing::error!(error = %e, "the sockets cannot be polled");
                    std::thread::sleep(Duration::from_millis(100));
                }
            }
            if checked.elapsed() >= Duration::from_millis(POLL_MS.unsigned_abs()) {
                checked = Instant::now();
                self.reload(false);
                self.check_connections();
            }
            self.answer_zap();
            while self.bound.wake.recv_msg(zmq::DONTWAIT).is_ok() {}
            while let Ok(outgoing) = self.bound.queue.try_recv() {
                match outgoing {
                    Outgoing::Reply { peer, frames } => self.send(&peer, frames),
                    Outgoing::End(client) => self.end(&client),
                    Outgoing::Event { topic, body } => self.publish(topic, body),
                    Outgoing::Reload => self.reload(true),
                    Outgoing::Stop => return,
                }
            }
            let mut read = 0;
            for _ in 0..READ_BATCH {
                if read > READ_BATCH_BYTES {
                    break;
                }
                let router = &self.bound.router;
                match frames::receive_from(router, zmq::DONTWAIT, &self.limits, N_LEADING) {
                    Ok((user, Ok(message))) => {
                        read += message
                            .iter()
                            .take(N_LEADING)
                            .map(Bytes::len)
                            .sum::<usize>();
                        self.request(user, message);
                    }
                    Ok((_, Err((leading, e)))) => {
                        let Some((peer, header, _)) = split(leading) else {
                            continue;
                        };
                        let id = Request::decode(header).unwrap_or_default().request_id;
                        self.refuse(&peer, id, convert::frame_error(&e));
                    }
                    Err(zmq::Error::EAGAIN | zmq::Error::EINTR) => break,
                    Err(e) => {
                        tracing::error!(error = %e, "a request cannot be received");
                        break;
                    }
                }
            }
        }
    }

    /// Answers ZeroMQ's questions whether connections may be made.
    fn answer_zap(&self) {
        while let Ok(question) = self.bound.zap.recv_multipart(zmq::DONTWAIT) {
            let answer = self.bound.access.zap(&question);
            if let Err(e) = self.bound.zap.send_multipart(answer, zmq::DONTWAIT) {
                tracing::error!(error = %e, "a connection cannot be answered");
            }
        }
    }

    /// Reads the allow list again. If a key was taken off it, subscribers must connect again, since
    /// ZeroMQ cannot end one connection. They miss the events of the meantime, see the gap, and ask
    /// for them.
    fn reload(&mut self, always: bool) {
        if self.bound.access.reload(always) {
            let uri = self.bound.events.to_string();
            // This ends its connections. An error means that an earlier attempt has done it.
            let _ = self.bound.publisher.unbind(&uri);
            self.must_bind = true;
        }
        if !self.must_bind {
            return;
        }
        // The port is free a moment after it is given back.
        let begin = Instant::now();
        let bound = loop {
            match self.bound.bind_events() {
                Err(zmq::Error::EADDRINUSE) if begin.elapsed() < REBIND => {
                    std::thread::sleep(Duration::from_millis(10));
                }
                bound => break bound,
            }
        };
        match bound {
            Ok(()) => self.must_bind = false,
            Err(e) => tracing::error!(error = %e, "events cannot be published; trying again"),
        }
    }

    /// Decodes, admits and forwards a message. `user` is the sender's key, if there are keys.
    fn request(&self, user: Option<String>, message: Vec<Bytes>) {
        let received = Instant::now();
        let n_bytes = message.iter().map(|f| f.len() as u64).sum();
        let n_frames = message.len() as u64;
        let metrics = &self.shared.telemetry.metrics;
        metrics.received_bytes.inc_by(n_bytes);
        let Some((peer, header, frames)) = split(message) else {
            return;
        };
        let header_bytes = header.len() as u64;
        let mut request = match self.decode(header) {
            Ok(request) => request,
            Err(error) => return self.refuse(&peer, String::new(), error),
        };
        let operation = request.body.take().map(Operation::from);
        let role = operation.as_ref().map_or(Role::ReadOnly, Operation::role);
        if let Err(error) = self.bound.access.check(user.as_deref(), role) {
            let refused = &self.shared.telemetry.counters.refused;
            refused.fetch_add(1, Ordering::Relaxed);
            return self.refuse(&peer, request.request_id, error);
        }
        let Admission { quotas, memory, .. } = &*self.shared.admission;
        let most = quotas.max_bytes().min(memory.limit());
        if n_bytes > most {
            let key = "limits.max_bytes_per_client, limits.memory";
            let error = too_large(size::beyond("the message", n_bytes, most, key));
            return self.refuse(&peer, request.request_id, error);
        }
        let client = user.clone();
        let client = client.map_or_else(|| peer.identity.clone(), Bytes::from);
        let ticket = match quotas.admit(&client, n_bytes) {
            Ok(ticket) => ticket,
            Err(text) => {
                return self.busy(&peer, request.request_id, ErrorReason::ClientQuota, text);
            }
        };
        // A header is decoded, and each frame has an owner.
        let n_reserved = (n_bytes + DECODED * header_bytes + FRAME_COST * n_frames).min(most);
        let Some(memory) = memory.try_reserve(n_reserved) else {
            let text = format!("requests in hand leave no memory for {n_bytes} bytes more");
            return self.busy(&peer, request.request_id, ErrorReason::MemoryLimit, text);
        };
        let incoming = Incoming {
            reply_to: ReplyTo::Peer(peer.clone()),
            user,
            client_id: request.client_id,
            request_id: request.request_id,
            deadline_ms: request.deadline_ms,
            operation,
            frames,
            received,
            memory: Some(memory),
            ticket,
        };
        if let Err(refused) = self.requests.try_send(incoming) {
            let id = refused.into_inner().request_id;
            let text = "too many requests wait".to_owned();
            self.busy(&peer, id, ErrorReason::QueueFull, text);
        }
    }

    /// The request of a header frame, if its size and its ids are within the limits.
    fn decode(&self, header: Bytes) -> Result<Request, wire::Error> {
        if header.len() as u64 > self.limits.max_header_bytes {
            return Err(too_large(format!(
                "the header frame has {} bytes, the limit is {}",
                header.len(),
                self.limits.max_header_bytes
            )));
        }
        if fields::count(&header, MAX_FIELDS) > MAX_FIELDS {
            let text = format!("the header frame has more than {MAX_FIELDS} fields, the limit");
            return Err(too_large(text));
        }
        let request = Request::decode(header).map_err(|e| {
            let text = format!("the header frame is not a coseg.v1.Request: {e}");
            convert::error(
                ErrorCode::InvalidArgument,
                ErrorReason::MalformedMessage,
                text,
            )
        })?;
        for (field, id) in [
            ("request_id", &request.request_id),
            ("client_id", &request.client_id),
        ] {
            let found = id.chars().count();
            if found > MAX_ID_CHARS {
                let text = format!("{field} has {found} characters, the limit is {MAX_ID_CHARS}");
                return Err(convert::field_error(ErrorReason::FieldRange, field, text));
            }
        }
        Ok(request)
    }

    fn busy(&self, peer: &Peer, request_id: String, reason: ErrorReason, text: String) {
        let mut error = convert::error(ErrorCode::ResourceExhausted, reason, text);
        error.retry_after_ms = BUSY_RETRY_MS;
        let refused = &self.shared.telemetry.counters.refused;
        refused.fetch_add(1, Ordering::Relaxed);
        self.refuse(peer, request_id, error);
    }

    fn refuse(&self, peer: &Peer, request_id: String, error: wire::Error) {
        self.shared.telemetry.metrics.refused(&error);
        let reply = Reply {
            request_id,
            result: Some(reply::Result::Error(error)),
        };
        self.bound.outbox.reply(peer.clone(), reply, Vec::new());
    }

    fn send(&mut self, peer: &Peer, frames: Vec<Frame>) {
        let telemetry = &self.shared.telemetry;
        telemetry.counters.requests.fetch_add(1, Ordering::Relaxed);
        let metrics = &telemetry.metrics;
        metrics.replies.inc();
        let n_bytes = frames.iter().map(|f| f.as_ref().len() as u64).sum();
        metrics.sent_bytes.inc_by(n_bytes);
        match send_reply(&mut self.bound.router, peer, frames) {
            Ok(()) => {}
            Err(zmq::Error::EHOSTUNREACH) => tracing::debug!("a client left before its reply"),
            // Its queue of replies is full.
            Err(zmq::Error::EAGAIN) => {
                self.shared.admission.replies.ends(&peer.identity);
                self.end(&peer.identity);
            }
            Err(e) => tracing::warn!(error = %e, "a reply was dropped"),
        }
    }

    /// Ends the connection of a client that does not read.
    fn end(&mut self, client: &Bytes) {
        match zmq_bounds::drop_peer(&mut self.bound.router, client) {
            Ok(()) => self.dropped.unread += 1,
            Err(zmq::Error::EHOSTUNREACH) => {}
            Err(e) => tracing::error!(error = %e, "a connection cannot be ended"),
        }
    }

    /// Notes the bytes of unfinished messages, and reports ended connections.
    fn check_connections(&mut self) {
        let bound = &mut self.bound;
        let sockets = [&mut bound.router, &mut bound.publisher];
        let [router, publisher] = sockets.map(|socket| {
            let held = zmq_bounds::held(socket).unwrap_or(0);
            (held, zmq_bounds::dropped(socket).unwrap_or(0))
        });
        let arriving = router.0 + publisher.0;
        self.shared
            .telemetry
            .arriving
            .store(arriving, Ordering::Relaxed);
        self.dropped.excess = router.1;
        self.dropped.subscriptions = publisher.1;
        self.dropped.report();
    }

    fn publish(&self, topic: Vec<u8>, body: Vec<u8>) {
        let parts = vec![zmq::Message::from(topic), zmq::Message::from(body)];
        if let Err(e) = frames::send(&self.bound.publisher, parts, zmq::DONTWAIT) {
            // Subscribers see the gap and ask for the events.
            tracing::warn!(error = %e, "an event was not published");
        }
    }
}

fn too_large(text: String) -> wire::Error {
    convert::error(
        ErrorCode::InvalidArgument,
        ErrorReason::MessageTooLarge,
        text,
    )
}

/// Peer, header and raw frames of a message as a ROUTER socket receives it.
fn split(message: Vec<Bytes>) -> Option<(Peer, Bytes, Vec<Bytes>)> {
    let mut parts = message.into_iter().peekable();
    let identity = parts.next()?;
    let first = parts.next().unwrap_or_default();
    // A DEALER's message with an empty header and frames would be a request without a body anyway.
    let delimiter = first.is_empty() && parts.peek().is_some();
    let header = if delimiter { parts.next()? } else { first };
    Some((
        Peer {
            identity,
            delimiter,
        },
        header,
        parts.collect(),
    ))
}
