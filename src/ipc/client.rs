//! A blocking client: sends one request, receives its reply, and repeats the request if no answer
//! comes.

use crate::ipc::endpoint::{Endpoint, EndpointError};
use crate::ipc::frames::{self, FrameLimits};
use crate::ipc::keys::{ClientKeys, KeyError};
use crate::ipc::wire::{self, Reply, Request, reply, request};
use bytes::Bytes;
use prost::Message as _;
use std::time::{Duration, Instant};

/// Default time limit for an answer.
pub const DEFAULT_TIMEOUT: Duration = Duration::from_secs(5);
/// Number of tries within the timeout: the second one uses a new connection, in case the first was
/// lost.
const TRIES: u32 = 2;
/// Milliseconds for which a closed socket continues to send.
const LINGER_MS: i32 = 0;
/// The limits that a client sets on replies; the daemon's own limits are on requests.
const REPLY_LIMITS: FrameLimits = FrameLimits {
    max_message_bytes: 4 << 30,
    max_frames: 1 << 20,
    max_header_bytes: 256 << 20,
};

/// The reason why a request has no result.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum ClientError {
    #[error(
        "no answer from {endpoint} within {} s; is a daemon running there?",
        timeout.as_secs_f64()
    )]
    NoAnswer { endpoint: String, timeout: Duration },
    #[error(transparent)]
    Endpoint(#[from] EndpointError),
    #[error(transparent)]
    Keys(#[from] KeyError),
    #[error("{}", .0.message)]
    Refused(Box<wire::Error>),
    #[error("{}", frames::too_large(what, *found, *limit))]
    TooLarge {
        what: &'static str,
        found: u64,
        limit: u64,
    },
    #[error("the daemon's reply cannot be understood: {0}")]
    BadReply(String),
    #[error("{endpoint}: {source}")]
    Socket {
        endpoint: String,
        source: zmq::Error,
    },
}

/// A reply's result and its raw frames.
pub type Answer = (reply::Result, Vec<Bytes>);

/// A connection to a daemon. It processes one request at a time.
pub struct Client {
    context: zmq::Context,
    socket: zmq::Socket,
    endpoint: Endpoint,
    keys: Option<ClientKeys>,
    client_id: String,
    n_requests: u64,
    timeout: Duration,
    hello: Option<wire::HelloReply>,
}

impl Client {
    /// Connects to `uri`. A missing listener is noticed at the first request.
    pub fn connect(uri: &str, timeout: Duration) -> Result<Self, ClientError> {
        Self::connect_with(uri, timeout, None)
    }

    /// Connects with keys, to a daemon that has them.
    pub fn connect_with(
        uri: &str,
        timeout: Duration,
        keys: Option<ClientKeys>,
    ) -> Result<Self, ClientError> {
        let endpoint = Endpoint::parse(uri)?;
        let context = zmq::Context::new();
        let socket = dealer(&context, &endpoint, keys.as_ref())?;
        // Unique among all clients at all times: two runs must not share idempotency keys.
        let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
        let nanos = since.map_or(0, |d| d.as_nanos());
        let client_id = format!("rust-{}-{nanos:x}", std::process::id());
        Ok(Self {
            context,
            socket,
            endpoint,
            keys,
            client_id,
            n_requests: 0,
            timeout,
            hello: None,
        })
    }

    /// Sets another client id than the unique one of [`Client::connect`], for callers that repeat
    /// requests across processes.
    pub fn set_client_id(&mut self, client_id: impl Into<String>) {
        self.client_id = client_id.into();
    }

    /// The time limit for an answer.
    pub fn timeout(&self) -> Duration {
        self.timeout
    }

    /// The address of the daemon.
    pub fn endpoint(&self) -> &Endpoint {
        &self.endpoint
    }

    /// Sends a request and waits for its result; an error reply is [`ClientError::Refused`].
    pub fn call(&mut self, body: request::Body, frames: Vec<Bytes>) -> Result<Answer, ClientError> {
        self.n_requests += 1;
        let request_id = self.n_requests.to_string();
        self.call_as(&request_id, body, frames)
    }

    /// Like [`Client::call`], with a request id chosen by the caller: equal ids mean the same
    /// request.
    pub fn call_as(
        &mut self,
        request_id: &str,
        body: request::Body,
        frames: Vec<Bytes>,
    ) -> Result<Answer, ClientError> {
        let request = Request {
            request_id: request_id.to_owned(),
            client_id: self.client_id.clone(),
            deadline_ms: 0,
            body: Some(body),
        };
        let header = request.encode_to_vec();
        self.check_limits(&header, &frames)?;
        let sent = std::iter::once(&header[..]).chain(frames.iter().map(AsRef::as_ref));
        let sent: Vec<&[u8]> = sent.collect();
        let mut until = Instant::now() + self.timeout / TRIES;
        let mut alive_as = None;
        let mut answer = self.exchange(&sent, request_id, until)?;
        while answer.is_none() {
            // The request is either lost or still running. A daemon that answers a Hello on a new
            // connection within the other half of the time is alive, and the client waits for it: a
            // correction may wait while its collection is busy.
            let Some(instance) = self.instance()? else {
                return Err(ClientError::NoAnswer {
                    endpoint: self.endpoint.to_string(),
                    timeout: self.timeout,
                });
            };
            until = Instant::now() + self.timeout / TRIES;
            answer = if alive_as.as_ref() == Some(&instance) {
                self.reply_to(request_id, until)?
            } else {
                // At the first repetition, or if the daemon has restarted, the request may be lost.
                // Repeating it is safe, because changes have one effect.
                self.socket = dealer(&self.context, &self.endpoint, self.keys.as_ref())?;
                alive_as = Some(instance);
                self.exchange(&sent, request_id, until)?
            };
        }
        let (reply, frames) = answer.expect("invariant: the loop ends with an answer");
        match reply.result {
            Some(reply::Result::Error(e)) => Err(ClientError::Refused(Box::new(e))),
            Some(result) => Ok((result, frames)),
            None => Err(ClientError::BadReply("it has no result".to_owned())),
        }
    }

    /// The instance of the daemon that answers, requested on a separate connection; `None` after
    /// half of the timeout.
    fn instance(&self) -> Result<Option<String>, ClientError> {
        let request = Request {
            request_id: "alive".to_owned(),
            body: Some(request::Body::Hello(wire::HelloRequest {})),
            ..Request::default()
        };
        let other = Self {
            context: self.context.clone(),
            socket: dealer(&self.context, &self.endpoint, self.keys.as_ref())?,
            endpoint: self.endpoint.clone(),
            keys: None,
            client_id: String::new(),
            n_requests: 0,
            timeout: self.timeout,
            hello: None,
        };
        let until = Instant::now() + self.timeout / TRIES;
        let header = request.encode_to_vec();
        let answer = other.exchange(&[&header], &request.request_id, until)?;
        Ok(answer.and_then(|(reply, _)| match reply.result {
            Some(reply::Result::Hello(hello)) => Some(hello.instance),
            // The daemon is alive, even if it only refuses.
            Some(_) => Some(String::new()),
            None => None,
        }))
    }

    /// Like [`Client::call`], but repeats the request to a daemon that is at a limit after the
    /// delay that it names, as long as it answers.
    pub fn call_patiently(
        &mut self,
        body: &request::Body,
        frames: &[Bytes],
    ) -> Result<Answer, ClientError> {
        self.n_requests += 1;
        let request_id = self.n_requests.to_string();
        loop {
            match self.call_as(&request_id, body.clone(), frames.to_vec()) {
                Err(ClientError::Refused(e))
                    if e.code() == wire::ErrorCode::ResourceExhausted && e.retry_after_ms > 0 =>
                {
                    std::thread::sleep(Duration::from_millis(e.retry_after_ms));
                }
                other => return other,
            }
        }
    }

    /// The daemon's description of itself; requested once.
    pub fn hello(&mut self) -> Result<&wire::HelloReply, ClientError> {
        if self.hello.is_none() {
            let body = request::Body::Hello(wire::HelloRequest {});
            match self.call(body, Vec::new())?.0 {
                reply::Result::Hello(hello) => self.hello = Some(hello),
                other => return Err(unexpected(&other)),
            }
        }
        Ok(self.hello.as_ref().expect("invariant: set above"))
    }

    /// A socket that receives the events of `collection`, or of all collections, and heartbeats.
    pub fn subscribe(&mut self, collection: Option<&str>) -> Result<zmq::Socket, ClientError> {
        let endpoint = self.events()?;
        let socket_error = |source| ClientError::Socket {
            endpoint: endpoint.clone(),
            source,
        };
        let socket = self.context.socket(zmq::SUB).map_err(socket_error)?;
        let subscribe = || {
            socket.set_linger(LINGER_MS)?;
            self.keys.as_ref().map_or(Ok(()), |k| k.apply(&socket))?;
            match collection {
                Some(name) => {
                    socket.set_subscribe(&crate::ipc::topic(name))?;
                    socket.set_subscribe(crate::ipc::HEARTBEAT_TOPIC)?;
                }
                None => socket.set_subscribe(b"")?,
            }
            socket.connect(&endpoint)
        };
        subscribe().map_err(socket_error)?;
        Ok(socket)
    }

    /// The address of events: on the host that the client knows, if the daemon listens on all its
    /// addresses.
    fn events(&mut self) -> Result<String, ClientError> {
        let announced = self.hello()?.event_endpoint.clone();
        match (Endpoint::parse(&announced)?, &self.endpoint) {
            (Endpoint::Tcp { host, port }, Endpoint::Tcp { host: known, .. })
                if host == "0.0.0.0" || host == "[::]" =>
            {
                Ok(Endpoint::Tcp {
                    host: known.clone(),
                    port,
                }
                .to_string())
            }
            _ => Ok(announced),
        }
    }

    fn check_limits(&self, header: &[u8], frames: &[Bytes]) -> Result<(), ClientError> {
        let Some(limits) = self.hello.as_ref().and_then(|h| h.limits.as_ref()) else {
            return Ok(());
        };
        let n_bytes = header.len() as u64 + frames.iter().map(|f| f.len() as u64).sum::<u64>();
        for (what, found, limit) in [
            ("bytes", n_bytes, limits.max_message_bytes),
            ("frames", frames.len() as u64, u64::from(limits.max_frames)),
            (
                "bytes of header",
                header.len() as u64,
                limits.max_header_bytes,
            ),
        ] {
            if found > limit {
                return Err(ClientError::TooLarge { what, found, limit });
            }
        }
        Ok(())
    }

    /// Sends once and waits for the reply to `request_id` until `until`; drops replies to earlier
    /// requests.
    fn exchange(
        &self,
        parts: &[&[u8]],
        request_id: &str,
        until: Instant,
    ) -> Result<Option<(Reply, Vec<Bytes>)>, ClientError> {
        let socket_error = |source| self.socket_error(source);
        self.socket
            .set_sndtimeo(ms_until(until))
            .map_err(socket_error)?;
        let parts = parts.iter().map(|p| zmq::Message::from(*p)).collect();
        match frames::send(&self.socket, parts, 0) {
            Ok(()) => self.reply_to(request_id, until),
            Err(zmq::Error::EAGAIN) => Ok(None),
            Err(e) => Err(socket_error(e)),
        }
    }

    /// Waits for the reply to `request_id` until `until`; drops replies to earlier requests.
    fn reply_to(
        &self,
        request_id: &str,
        until: Instant,
    ) -> Result<Option<(Reply, Vec<Bytes>)>, ClientError> {
        let socket_error = |source| self.socket_error(source);
        loop {
            self.socket
                .set_rcvtimeo(ms_until(until))
                .map_err(socket_error)?;
            let message = match frames::receive(&self.socket, 0, &REPLY_LIMITS, 1) {
                Ok(Ok(message)) => message,
                Ok(Err((_, e))) => return Err(ClientError::BadReply(e.to_string())),
                Err(zmq::Error::EAGAIN) => return Ok(None),
                Err(zmq::Error::EINTR) => continue,
                Err(e) => return Err(socket_error(e)),
            };
            let mut frames = message.into_iter();
            let header = frames.next().unwrap_or_default();
            let reply = Reply::decode(header).map_err(|e| ClientError::BadReply(e.to_string()))?;
            if reply.request_id == request_id {
                return Ok(Some((reply, frames.collect())));
            }
        }
    }

    fn socket_error(&self, source: zmq::Error) -> ClientError {
        ClientError::Socket {
            endpoint: self.endpoint.to_string(),
            source,
        }
    }
}

fn ms_until(until: Instant) -> i32 {
    let ms = until.saturating_duration_since(Instant::now()).as_millis();
    i32::try_from(ms).unwrap_or(i32::MAX)
}

fn dealer(
    context: &zmq::Context,
    endpoint: &Endpoint,
    keys: Option<&ClientKeys>,
) -> Result<zmq::Socket, ClientError> {
    let connect = || {
        let socket = context.socket(zmq::DEALER)?;
        socket.set_linger(LINGER_MS)?;
        // ZMQ_IMMEDIATE is not set: with it, a reply that has arrived is lost if the daemon closes
        // the connection before it is read, as it does after the last reply of a drain.
        let v6 = matches!(endpoint, Endpoint::Tcp { host, .. } if host.starts_with('['));
        socket.set_ipv6(v6)?;
        keys.map_or(Ok(()), |k| k.apply(&socket))?;
        socket.connect(&endpoint.to_string())?;
        Ok(socket)
    };
    connect().map_err(|source| ClientError::Socket {
        endpoint: endpoint.to_string(),
        source,
    })
}

/// The error for a reply whose result does not belong to the request.
pub fn unexpected(result: &reply::Result) -> ClientError {
    let text = format!("{result:?}");
    let name = text.split(['(', ' ']).next().unwrap_or_default();
    ClientError::BadReply(format!("an unexpected {name}"))
}

/// Sends a request, and extracts the result of the named variant.
///
/// `call!(client, Hello(HelloRequest {}))` is the `HelloReply`; with `, frames` at the end it is
/// the pair of the reply and its raw frames.
#[macro_export]
macro_rules! call {
    ($client:expr, $variant:ident($body:expr)) => {
        $crate::call!($client, $variant($body), Vec::new(), with_frames).map(|(reply, _)| reply)
    };
    ($client:expr, $variant:ident($body:expr), frames) => {
        $crate::call!($client, $variant($body), Vec::new(), with_frames)
    };
    ($client:expr, $variant:ident($body:expr), $frames:expr, with_frames) => {
        match $client.call($crate::ipc::wire::request::Body::$variant($body), $frames) {
            Ok(($crate::ipc::wire::reply::Result::$variant(reply), frames)) => Ok((reply, frames)),
            Ok((other, _)) => Err($crate::ipc::client::unexpected(&other)),
            Err(e) => Err(e),
        }
    };
}

#[cfg(test)]
mod tests {
    use super::{Client, ClientError};
    use crate::ipc::wire::{self, Reply, Request, reply};
    use prost::Message as _;
    use std::time::{Duration, Instant};

    #[test]
    fn the_last_answer_of_a_daemon_that_goes_is_received() {
        let directory = tempfile::tempdir().unwrap();
        for round in 0..50 {
            let uri = format!("ipc://{}/{round}", directory.path().display());
            let (bound, wait) = std::sync::mpsc::channel();
            let (there, uri) = (uri.clone(), uri);
            let daemon = std::thread::spawn(move || {
                let context = zmq::Context::new();
                let socket = context.socket(zmq::ROUTER).unwrap();
                socket.bind(&there).unwrap();
                bound.send(()).unwrap();
                let message = socket.recv_multipart(0).unwrap();
                let request = Request::decode(message[1].as_slice()).unwrap();
                let reply = Reply {
                    request_id: request.request_id,
                    result: Some(reply::Result::Hello(wire::HelloReply::default())),
                };
                let parts = [message[0].clone(), reply.encode_to_vec()];
                socket.send_multipart(parts, 0).unwrap();
            });
            wait.recv().unwrap();
            let mut client = Client::connect(&uri, Duration::from_secs(3)).unwrap();
            assert!(client.hello().is_ok(), "round {round}");
            daemon.join().unwrap();
        }
    }

    #[test]
    fn a_client_without_a_daemon_gives_up_in_time() {
        let directory = tempfile::tempdir().unwrap();
        let uri = format!("ipc://{}/s", directory.path().display());
        let begin = Instant::now();
        let timeout = Duration::from_millis(200);
        let mut client = Client::connect(&uri, timeout).unwrap();
        assert!(matches!(client.hello(), Err(ClientError::NoAnswer { .. })));
        assert!(begin.elapsed() >= timeout - Duration::from_millis(5));
        assert!(begin.elapsed() < Duration::from_secs(3));
    }
}
