//! Binds the sockets: ROUTER for requests, PUB for events, REP for ZeroMQ's questions about
//! connections, and an inproc PULL socket that wakes the socket thread when there is something to
//! send.

use crate::config::Limits;
use crate::daemon::access::{Access, ZAP_ENDPOINT};
use crate::daemon::answer::MAX_FRAMES;
use crate::daemon::error::StartError;
use crate::daemon::outbox::{Outbox, Outgoing};
use crate::daemon::replies::Replies;
use crate::ipc::endpoint::{Endpoint, claim_socket};
use std::fs::{File, Permissions};
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::sync::{Arc, mpsc};
use zmq_bounds::Bounds;

/// Messages that ZeroMQ keeps for one peer in each direction.
const PEER_HWM: i32 = 256;
/// Events that ZeroMQ keeps for one subscriber; beyond, the subscriber loses events and sees the
/// gap.
const SUBSCRIBER_HWM: i32 = 4_096;
/// Bytes of a subscription; a topic is a collection's name.
const MAX_SUBSCRIPTION_BYTES: i64 = 1_024;
/// Subscriptions of one subscriber.
const MAX_SUBSCRIPTIONS: i32 = 1_024;
/// Bytes of memory for the subscriptions of all subscribers, and for those that are not processed
/// yet.
const MAX_SUBSCRIBED: i64 = 32 << 20;
const MAX_SUBSCRIBING: i64 = 8 << 20;
/// Descriptors that are reserved for files, workers and pages.
const RESERVED_FILES: u64 = 192;
/// Milliseconds between heartbeats on a connection, and until a silent peer is given up.
const HEARTBEAT_MS: i32 = 10_000;
const HEARTBEAT_TIMEOUT_MS: i32 = 30_000;
/// Milliseconds that closing waits for replies that are under way.
const LINGER_MS: i32 = 1_000;
/// Milliseconds in which a connection must have authenticated itself.
const HANDSHAKE_MS: i32 = 5_000;
/// Pairs of ports that are tried where any will do.
const MAX_PAIRS: u32 = 64;
/// Connections that the kernel queues until they are accepted.
const BACKLOG: i32 = 1_024;
/// Owner and group may connect; the directory decides who gets that far.
const SOCKET_MODE: u32 = 0o660;

/// Sockets that are bound but not yet served.
pub(crate) struct Bound {
    context: zmq::Context,
    pub(crate) router: zmq::Socket,
    pub(crate) publisher: zmq::Socket,
    pub(crate) wake: zmq::Socket,
    /// Receives ZeroMQ's questions about connections.
    pub(crate) zap: zmq::Socket,
    pub(crate) access: Access,
    max_fd: i32,
    pub(crate) queue: mpsc::Receiver<Outgoing>,
    pub(crate) outbox: Arc<Outbox>,
    pub(crate) endpoint: Endpoint,
    pub(crate) events: Endpoint,
    locks: Vec<File>,
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
    let failed = |source| socket_error(endpoint, source);
    let max_fd = max_connection(limits);
    let router = router(&context, endpoint, limits, &access, max_fd).map_err(failed)?;
    let publisher = publisher(&context, endpoint, &access, max_fd).map_err(failed)?;
    // Before any socket is bound, or connections would be accepted without authentication.
    let zap = zap(&context).map_err(failed)?;
    let (wake, wake_sender) = wake(&context).map_err(failed)?;
    let mut locks = Vec::new();
    let any_port = matches!(endpoint, Endpoint::Tcp { port: 0, .. });
    let mut n_pairs = 0;
    let (endpoint, events) = loop {
        let bound = listen(&router, endpoint, &mut locks)?;
        n_pairs += 1;
        match listen(&publisher, &bound.events()?, &mut locks) {
            // The next port, which events need, is in use: try another pair.
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

fn socket_error(endpoint: &Endpoint, source: zmq::Error) -> StartError {
    StartError::Socket {
        endpoint: endpoint.to_string(),
        source,
    }
}

/// Binds a socket, and returns the endpoint with the port that was chosen.
fn listen(
    socket: &zmq::Socket,
    endpoint: &Endpoint,
    locks: &mut Vec<File>,
) -> Result<Endpoint, StartError> {
    if let Endpoint::Ipc(path) = endpoint {
        locks.push(claim_socket(path)?);
    }
    let failed = |source| socket_error(endpoint, source);
    let uri = match endpoint {
        Endpoint::Tcp { host, port: 0 } => format!("tcp://{host}:*"),
        other => other.to_string(),
    };
    socket.bind(&uri).map_err(failed)?;
    match endpoint {
        Endpoint::Ipc(path) => {
            allow_group(path).map_err(failed)?;
            Ok(endpoint.clone())
        }
        Endpoint::Tcp { .. } => {
            let last = socket.get_last_endpoint().map_err(failed)?;
            Ok(Endpoint::parse(
                &last.map_err(|_| failed(zmq::Error::EINVAL))?,
            )?)
        }
    }
}

fn allow_group(path: &Path) -> zmq::Result<()> {
    std::fs::set_permissions(path, Permissions::from_mode(SOCKET_MODE))
        .map_err(|_| zmq::Error::EACCES)
}

fn zap(context: &zmq::Context) -> zmq::Result<zmq::Socket> {
    let zap = context.socket(zmq::REP)?;
    zap.set_linger(0)?;
    zap.bind(ZAP_ENDPOINT)?;
    Ok(zap)
}

/// The two ends of the way to wake the socket thread: its own, and that of the outbox.
fn wake(context: &zmq::Context) -> zmq::Result<(zmq::Socket, zmq::Socket)> {
    let (wake, sender) = (context.socket(zmq::PULL)?, context.socket(zmq::PUSH)?);
    wake.bind("inproc://wake")?;
    sender.connect("inproc://wake")?;
    sender.set_linger(0)?;
    Ok((wake, sender))
}

fn router(
    context: &zmq::Context,
    endpoint: &Endpoint,
    limits: &Limits,
    access: &Access,
    max_fd: i32,
) -> zmq::Result<zmq::Socket> {
    let mut router = context.socket(zmq::ROUTER)?;
    router.set_router_mandatory(true)?;
    router.set_maxmsgsize(i64::try_from(limits.max_message.0).unwrap_or(i64::MAX))?;
    router.set_rcvhwm(PEER_HWM)?;
    router.set_sndhwm(PEER_HWM)?;
    protect(&router, endpoint, access)?;
    let bounds = Bounds {
        max_fd,
        max_frames: 4 * MAX_FRAMES as i32,
        max_held: i64::try_from(limits.arriving_bytes()).unwrap_or(i64::MAX),
        ..Bounds::default()
    };
    zmq_bounds::set_bounds(&mut router, &bounds)?;
    Ok(router)
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

/// Sets what every bound socket needs.
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

impl Bound {
    /// Binds the event socket again, after it was unbound.
    pub(crate) fn bind_events(&mut self) -> zmq::Result<()> {
        let new = publisher(&self.context, &self.events, &self.access, self.max_fd)?;
        new.bind(&self.events.to_string())?;
        if let Endpoint::Ipc(path) = &self.events {
            allow_group(path)?;
        }
        self.publisher = new;
        Ok(())
    }
}

/// The descriptor from which on connections are closed at once, so that some, and memory, are left
/// for everything else.
fn max_connection(limits: &Limits) -> i32 {
    let files = rustix::process::getrlimit(rustix::process::Resource::Nofile);
    let files = files.current.unwrap_or(u64::MAX);
    let reserved = RESERVED_FILES.min(files / 2);
    i32::try_from((files - reserved).min(reserved + limits.connections())).unwrap_or(i32::MAX)
}

impl Drop for Bound {
    fn drop(&mut self) {
        // ZeroMQ leaves the files, which are this daemon's while the locks are held.
        for endpoint in [&self.endpoint, &self.events] {
            if let Endpoint::Ipc(path) = endpoint {
                let _ = std::fs::remove_file(path);
            }
        }
        self.locks.clear();
    }
}
