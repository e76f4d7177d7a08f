//! The one thread that touches sockets: ROUTER for requests, PUB for events, an inproc PULL socket that
//! wakes it when there is something to send.

use crate::config::Limits;
use crate::daemon::access::{Access, ZAP_ENDPOINT};
use crate::daemon::memory::{Budget, Reservation};
use crate::daemon::metrics::Metrics;
use crate::daemon::outbox::{Dropped, Outbox, Outgoing, Peer, send_reply};
use crate::daemon::quota::{Quotas, Ticket};
use crate::daemon::replies::{Frame, Replies};
use crate::daemon::requests::Answer;
use crate::daemon::{Counters, StartError};
use crate::ipc::convert;
use crate::ipc::endpoint::{Endpoint, claim_socket};
use crate::ipc::fields::{self, MAX_FIELDS};
use crate::ipc::frames::{self, FrameLimits};
use crate::ipc::size;
use crate::ipc::wire::{self, ErrorCode, ErrorReason, Reply, Request, reply};
use bytes::Bytes;
use prost::Message as _;
use std::os::unix::fs::PermissionsExt;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, mpsc};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use zmq_bounds::Bounds;

/// Raw frames of one message; a shape takes at most two.
pub(crate) const MAX_FRAMES: usize = 1_024;
/// Bytes of a header frame.
pub(crate) const MAX_HEADER_BYTES: u64 = 1 << 20;
/// What a header takes when it is decoded, by its bytes, and a frame beside its bytes.
const DECODED: u64 = 8;
const FRAME_COST: u64 = 256;
/// Characters of the ids of a request.
pub(crate) const MAX_ID_CHARS: usize = 128;
/// Routing frames before the raw frames of a received message: identity, perhaps a delimiter, header.
const N_LEADING: usize = 3;
/// Messages that ZeroMQ keeps for one peer in each direction.
const PEER_HWM: i32 = 256;
/// Events that ZeroMQ keeps for one subscriber; beyond, the subscriber loses events and sees the gap.
const SUBSCRIBER_HWM: i32 = 4_096;
/// Bytes of a subscription; a topic is a collection's name.
const MAX_SUBSCRIPTION_BYTES: i64 = 1_024;
/// Subscriptions of one subscriber.
const MAX_SUBSCRIPTIONS: i32 = 1_024;
/// Bytes of memory that the subscriptions of all subscribers may take, and of those that are not looked at yet.
const MAX_SUBSCRIBED: i64 = 32 << 20;
const MAX_SUBSCRIBING: i64 = 8 << 20;
/// Descriptors that are set aside for files, workers and pages, and how many more for each worker's process.
const KEPT_FILES: u64 = 192;
/// Milliseconds between heartbeats on a connection, and until a silent peer is given up.
const HEARTBEAT_MS: i32 = 10_000;
const HEARTBEAT_TIMEOUT_MS: i32 = 30_000;
/// Milliseconds that closing waits for replies that are under way.
const LINGER_MS: i32 = 1_000;
/// Milliseconds after which the thread looks around even if nothing came, for the watchdog.
const POLL_MS: i64 = 500;
/// Requests, and bytes of their headers, that are read before replies get their turn.
const READ_BATCH: usize = 64;
const READ_BATCH_BYTES: usize = 256 << 10;
/// Milliseconds in which a connection must have said who it is.
const HANDSHAKE_MS: i32 = 5_000;
/// How long an address that was just given back is tried at a time.
const REBIND: Duration = Duration::from_millis(500);
/// Pairs of ports that are tried where any will do.
const MAX_PAIRS: u32 = 64;
/// Connections that the kernel keeps until they are taken.
const BACKLOG: i32 = 1_024;
/// What a client that finds the queue or the memory full should wait.
pub(crate) const BUSY_RETRY_MS: u64 = 250;
/// Owner and group may connect; the directory decides who gets that far.
const SOCKET_MODE: u32 = 0o660;

/// Who is waiting for a reply.
pub(crate) enum ReplyTo {
    /// A client of the sockets.
    Peer(Peer),
    /// A task of this process.
    Task(tokio::sync::oneshot::Sender<Answer>),
}

impl ReplyTo {
    /// The client of the sockets that waits.
    pub(crate) fn client(&self) -> Option<&Bytes> {
        match self {
            Self::Peer(peer) => Some(&peer.identity),
            Self::Task(_) => None,
        }
    }
}

/// A request that arrived.
pub(crate) struct Incoming {
    pub(crate) reply_to: ReplyTo,
    /// The key of whoever asks, if connections are authenticated.
    pub(crate) user: Option<String>,
    pub(crate) request: Request,
    pub(crate) frames: Vec<Bytes>,
    pub(crate) received: Instant,
    /// Held for as long as the frames are.
    pub(crate) memory: Option<Reservation>,
    /// Counts it for its client.
    pub(crate) ticket: Ticket,
}

/// Sockets that are bound but not yet served.
pub(crate) struct Bound {
    context: zmq::Context,
    router: zmq::Socket,
    publisher: zmq::Socket,
    wake: zmq::Socket,
    /// Where ZeroMQ asks who may connect.
    zap: zmq::Socket,
    access: Access,
    max_fd: i32,
    queue: mpsc::Receiver<Outgoing>,
    pub(crate) outbox: Arc<Outbox>,
    pub(crate) endpoint: Endpoint,
    pub(crate) events: Endpoint,
    locks: Vec<std::fs::File>,
}

/// Binds both endpoints.
pub(crate) fn bind(
    endpoint: &Endpoint,
    limits: &Limits,
    access: Access,
    replies: Arc<Replies>,
) -> Result<Bound, StartError> {
    endpoint.check_servable(access.has_keys())?;
    let context = zmq::Context::new();
    let failed = |source| StartError::Socket {
        endpoint: endpoint.to_string(),
        source,
    };
    let max_fd = max_connection(limits);
    let sockets = || {
        let mut router = context.socket(zmq::ROUTER)?;
        router.set_router_mandatory(true)?;
        router.set_maxmsgsize(i64::try_from(limits.max_message.0).unwrap_or(i64::MAX))?;
        router.set_rcvhwm(PEER_HWM)?;
        router.set_sndhwm(PEER_HWM)?;
        protect(&router, endpoint, &access)?;
        let bounds = Bounds {
            max_fd,
            max_frames: 4 * MAX_FRAMES as i32,
            max_held: i64::try_from(limits.arriving_bytes()).unwrap_or(i64::MAX),
            ..Bounds::default()
        };
        zmq_bounds::set_bounds(&mut router, &bounds)?;
        let publisher = publisher(&context, endpoint, &access, max_fd)?;
        // Before any socket is bound, or connections would be let in unasked.
        let zap = context.socket(zmq::REP)?;
        zap.set_linger(0)?;
        zap.bind(ZAP_ENDPOINT)?;
        let (wake, wake_sender) = (context.socket(zmq::PULL)?, context.socket(zmq::PUSH)?);
        wake.bind("inproc://wake")?;
        wake_sender.connect("inproc://wake")?;
        wake_sender.set_linger(0)?;
        Ok((router, publisher, wake, wake_sender, zap))
    };
    let (router, publisher, wake, wake_sender, zap) = sockets().map_err(failed)?;
    let mut locks = Vec::new();
    let mut listen = |socket: &zmq::Socket, endpoint: &Endpoint| -> Result<Endpoint, StartError> {
        if let Endpoint::Ipc(path) = endpoint {
            locks.push(claim_socket(path)?);
        }
        let failed = |source| StartError::Socket {
            endpoint: endpoint.to_string(),
            source,
        };
        let uri = match endpoint {
            Endpoint::Tcp { host, port: 0 } => format!("tcp://{host}:*"),
            other => other.to_string(),
        };
        socket.bind(&uri).map_err(failed)?;
        match endpoint {
            Endpoint::Ipc(path) => {
                std::fs::set_permissions(path, std::fs::Permissions::from_mode(SOCKET_MODE))
                    .map_err(|_| failed(zmq::Error::EACCES))?;
                Ok(endpoint.clone())
            }
            Endpoint::Tcp { .. } => {
                let last = socket.get_last_endpoint().map_err(failed)?;
                Ok(Endpoint::parse(
                    &last.map_err(|_| failed(zmq::Error::EINVAL))?,
                )?)
            }
        }
    };
    let any_port = matches!(endpoint, Endpoint::Tcp { port: 0, .. });
    let mut n_pairs = 0;
    let (endpoint, events) = loop {
        let bound = listen(&router, endpoint)?;
        n_pairs += 1;
        match listen(&publisher, &bound.events()?) {
            // Somebody has the port after it, which events need: another pair.
            Err(StartError::Socket {
                source: zmq::Error::EADDRINUSE,
                ..
            }) if any_port && n_pairs < MAX_PAIRS => {
                router.unbind(&bound.to_string()).map_err(failed)?;
            }
            events => break (bound, events?),
        }
    };
    let (outbox, queue) = Outbox::new(wake_sender, replies);
    Ok(Bound {
        context,
        zap,
        access,
        max_fd,
        router,
        publisher,
        wake,
        queue,
        outbox,
        endpoint,
        events,
        locks,
    })
}

/// What every socket that is bound needs.
fn protect(socket: &zmq::Socket, endpoint: &Endpoint, access: &Access) -> zmq::Result<()> {
    socket.set_linger(LINGER_MS)?;
    socket.set_heartbeat_ivl(HEARTBEAT_MS)?;
    socket.set_heartbeat_timeout(HEARTBEAT_TIMEOUT_MS)?;
    socket.set_handshake_ivl(HANDSHAKE_MS)?;
    socket.set_backlog(BACKLOG)?;
    // Not for an IPv4 address, which would come back as one mapped into IPv6.
    let v6 = matches!(endpoint, Endpoint::Tcp { host, .. } if host.starts_with('['));
    socket.set_ipv6(v6)?;
    access.protect(socket)
}

fn publisher(
    context: &zmq::Context,
    endpoint: &Endpoint,
    access: &Access,
    max_fd: i32,
) -> zmq::Result<zmq::Socket> {
    let mut publisher = context.socket(zmq::PUB)?;
    publisher.set_maxmsgsize(MAX_SUBSCRIPTION_BYTES)?;
    publisher.set_sndhwm(SUBSCRIBER_HWM)?;
    protect(&publisher, endpoint, access)?;
    let bounds = Bounds {
        max_fd,
        max_frames: 1,
        max_held: MAX_SUBSCRIBING,
        max_subscriptions: MAX_SUBSCRIPTIONS,
        max_subscribed: MAX_SUBSCRIBED,
    };
    zmq_bounds::set_bounds(&mut publisher, &bounds)?;
    Ok(publisher)
}

/// What the socket thread shares with the daemon.
pub(crate) struct Shared {
    pub(crate) memory: Arc<Budget>,
    pub(crate) replies: Arc<Replies>,
    /// Bytes of messages that arrive.
    pub(crate) arriving: Arc<AtomicU64>,
    pub(crate) quotas: Arc<Quotas>,
    pub(crate) counters: Arc<Counters>,
    pub(crate) metrics: Arc<Metrics>,
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
        let mut looked = Instant::now();
        loop {
            self.shared.tick.fetch_add(1, Ordering::Relaxed);
            let mut items = [
                self.bound.router.as_poll_item(zmq::POLLIN),
                self.bound.wake.as_poll_item(zmq::POLLIN),
                self.bound.zap.as_poll_item(zmq::POLLIN),
                // It has nothing to read, but takes in subscriptions only when it is asked.
                self.bound.publisher.as_poll_item(zmq::POLLIN),
            ];
            match zmq::poll(&mut items, POLL_MS) {
                Ok(_) | Err(zmq::Error::EINTR) => {}
                Err(e) => {
                    tracing::error!(error = %e, "the sockets cannot be polled");
                    std::thread::sleep(Duration::from_millis(100));
                }
            }
            if looked.elapsed() >= Duration::from_millis(POLL_MS.unsigned_abs()) {
                looked = Instant::now();
                self.reload(false);
                self.look();
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

    /// Answers ZeroMQ, which asks for each connection whether it may be.
    fn answer_zap(&self) {
        while let Ok(question) = self.bound.zap.recv_multipart(zmq::DONTWAIT) {
            let answer = self.bound.access.zap(&question);
            if let Err(e) = self.bound.zap.send_multipart(answer, zmq::DONTWAIT) {
                tracing::error!(error = %e, "a connection cannot be answered");
            }
        }
    }

    /// Reads the allow list again. If somebody was taken off it, subscribers must connect again: ZeroMQ has
    /// no way to end one connection. They miss what is published meanwhile, see the gap, and ask for it.
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
        let bound = &self.bound;
        let uri = bound.events.to_string();
        let again = || {
            let new = publisher(&bound.context, &bound.events, &bound.access, bound.max_fd)?;
            new.bind(&uri)?;
            if let Endpoint::Ipc(path) = &bound.events {
                std::fs::set_permissions(path, std::fs::Permissions::from_mode(SOCKET_MODE))
                    .map_err(|_| zmq::Error::EACCES)?;
            }
            Ok::<_, zmq::Error>(new)
        };
        // The port is free a moment after it is given back.
        let begin = Instant::now();
        let made = loop {
            match again() {
                Err(zmq::Error::EADDRINUSE) if begin.elapsed() < REBIND => {
                    std::thread::sleep(Duration::from_millis(10));
                }
                made => break made,
            }
        };
        match made {
            Ok(new) => {
                self.bound.publisher = new;
                self.must_bind = false;
            }
            Err(e) => tracing::error!(error = %e, "events cannot be published; trying again"),
        }
    }

    /// Decodes, admits and hands over a message. `user` is the sender's key, if there are keys.
    fn request(&self, user: Option<String>, message: Vec<Bytes>) {
        let received = Instant::now();
        let n_bytes = message.iter().map(|f| f.len() as u64).sum();
        let n_frames = message.len() as u64;
        self.shared.metrics.received_bytes.inc_by(n_bytes);
        let Some((peer, header, frames)) = split(message) else {
            return;
        };
        let header_bytes = header.len() as u64;
        let invalid =
            |reason, text: String| convert::error(ErrorCode::InvalidArgument, reason, text);
        if header.len() as u64 > self.limits.max_header_bytes {
            let text = format!(
                "the header frame has {} bytes, the limit is {}",
                header.len(),
                self.limits.max_header_bytes
            );
            return self.refuse(
                &peer,
                String::new(),
                invalid(ErrorReason::MessageTooLarge, text),
            );
        }
        if fields::count(&header, MAX_FIELDS) > MAX_FIELDS {
            let text = format!("the header frame has more than {MAX_FIELDS} fields, the limit");
            let error = invalid(ErrorReason::MessageTooLarge, text);
            return self.refuse(&peer, String::new(), error);
        }
        let request = match Request::decode(header) {
            Ok(request) => request,
            Err(e) => {
                let text = format!("the header frame is not a coseg.v1.Request: {e}");
                let error = invalid(ErrorReason::MalformedMessage, text);
                return self.refuse(&peer, String::new(), error);
            }
        };
        for (field, id) in [
            ("request_id", &request.request_id),
            ("client_id", &request.client_id),
        ] {
            let found = id.chars().count();
            if found > MAX_ID_CHARS {
                let text = format!("{field} has {found} characters, the limit is {MAX_ID_CHARS}");
                let error = convert::field_error(ErrorReason::FieldRange, field, text);
                return self.refuse(&peer, String::new(), error);
            }
        }
        if let Err(error) = self
            .bound
            .access
            .check(user.as_deref(), request.body.as_ref())
        {
            self.shared.counters.refused.fetch_add(1, Ordering::Relaxed);
            return self.refuse(&peer, request.request_id, error);
        }
        let most = self
            .shared
            .quotas
            .max_bytes()
            .min(self.shared.memory.limit());
        if n_bytes > most {
            let key = "limits.max_bytes_per_client, limits.memory";
            let text = size::beyond("the message", n_bytes, most, key);
            let error = invalid(ErrorReason::MessageTooLarge, text);
            return self.refuse(&peer, request.request_id, error);
        }
        let client = user.clone();
        let client = client.map_or_else(|| peer.identity.clone(), Bytes::from);
        let ticket = match self.shared.quotas.admit(&client, n_bytes) {
            Ok(ticket) => ticket,
            Err(text) => {
                return self.busy(&peer, request.request_id, ErrorReason::ClientQuota, text);
            }
        };
        // A header is decoded, and each frame has an owner.
        let n_reserved = (n_bytes + DECODED * header_bytes + FRAME_COST * n_frames).min(most);
        let Some(memory) = self.shared.memory.try_reserve(n_reserved) else {
            let text = format!("requests in hand leave no memory for {n_bytes} bytes more");
            return self.busy(&peer, request.request_id, ErrorReason::MemoryLimit, text);
        };
        let incoming = Incoming {
            reply_to: ReplyTo::Peer(peer.clone()),
            user,
            request,
            frames,
            received,
            memory: Some(memory),
            ticket,
        };
        if let Err(refused) = self.requests.try_send(incoming) {
            let incoming = refused.into_inner();
            let text = "too many requests wait".to_owned();
            let id = incoming.request.request_id;
            self.busy(&peer, id, ErrorReason::QueueFull, text);
        }
    }

    fn busy(&self, peer: &Peer, request_id: String, reason: ErrorReason, text: String) {
        let mut error = convert::error(ErrorCode::ResourceExhausted, reason, text);
        error.retry_after_ms = BUSY_RETRY_MS;
        self.shared.counters.refused.fetch_add(1, Ordering::Relaxed);
        self.refuse(peer, request_id, error);
    }

    fn refuse(&self, peer: &Peer, request_id: String, error: wire::Error) {
        self.shared.metrics.refused(&error);
        let reply = Reply {
            request_id,
            result: Some(reply::Result::Error(error)),
        };
        self.bound.outbox.reply(peer.clone(), reply, Vec::new());
    }

    fn send(&mut self, peer: &Peer, frames: Vec<Frame>) {
        self.shared
            .counters
            .requests
            .fetch_add(1, Ordering::Relaxed);
        let metrics = &self.shared.metrics;
        metrics.replies.inc();
        let n_bytes = frames.iter().map(|f| f.as_ref().len() as u64).sum();
        metrics.sent_bytes.inc_by(n_bytes);
        match send_reply(&mut self.bound.router, peer, frames) {
            Ok(()) => {}
            Err(zmq::Error::EHOSTUNREACH) => tracing::debug!("a client left before its reply"),
            // As many wait for it as may.
            Err(zmq::Error::EAGAIN) => {
                self.shared.replies.ends(&peer.identity);
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

    /// Looks at what arrives, and says what was dropped.
    fn look(&mut self) {
        let bound = &mut self.bound;
        let sockets = [&mut bound.router, &mut bound.publisher];
        let [router, publisher] = sockets.map(|socket| {
            let held = zmq_bounds::held(socket).unwrap_or(0);
            (held, zmq_bounds::dropped(socket).unwrap_or(0))
        });
        let arriving = router.0 + publisher.0;
        self.shared.arriving.store(arriving, Ordering::Relaxed);
        self.dropped.excess = router.1;
        self.dropped.subscriptions = publisher.1;
        self.dropped.say();
    }

    fn publish(&self, topic: Vec<u8>, body: Vec<u8>) {
        let parts = vec![zmq::Message::from(topic), zmq::Message::from(body)];
        if let Err(e) = frames::send(&self.bound.publisher, parts, zmq::DONTWAIT) {
            // Subscribers see the gap and ask for the events.
            tracing::warn!(error = %e, "an event was not published");
        }
    }
}

/// The descriptor from which on connections are closed at once, so that some are left for everything else, and memory.
fn max_connection(limits: &Limits) -> i32 {
    let files = rustix::process::getrlimit(rustix::process::Resource::Nofile);
    let files = files.current.unwrap_or(u64::MAX);
    let kept = KEPT_FILES.min(files / 2);
    i32::try_from((files - kept).min(kept + limits.connections())).unwrap_or(i32::MAX)
}

impl Drop for Bound {
    fn drop(&mut self) {
        // ZeroMQ leaves the files; while the locks are held they are this daemon's.
        for endpoint in [&self.endpoint, &self.events] {
            if let Endpoint::Ipc(path) = endpoint {
                let _ = std::fs::remove_file(path);
            }
        }
        self.locks.clear();
    }
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
