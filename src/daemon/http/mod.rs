//! A small HTTP endpoint: health and metrics for monitoring, the viewer and its interface for browsers.
//!
//! It has no authentication, so it listens on loopback unless the configuration says otherwise. Against pages of
//! other sites that a browser on the same machine may have open: requests must name a loopback host (a name that
//! was made to point here does not), and changes must carry a header that a form of another site cannot send.

mod api;

use crate::daemon::requests::{Answer, busy};
use crate::daemon::sockets::{Incoming, ReplyTo};
use crate::daemon::{Daemon, StartError, blocking, reads};
use crate::ipc::convert;
use crate::ipc::wire::{
    self, ErrorCode, ErrorReason, Request as WireRequest, reply, request::Body,
};
use crate::viewer::page;
use bytes::Bytes;
use http_body_util::{BodyExt as _, Full, Limited};
use hyper::body::Incoming as HttpBody;
use hyper::header::{self, HeaderMap, HeaderValue};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Method, Request, Response, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use std::convert::Infallible;
use std::net::{IpAddr, SocketAddr, TcpListener};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::{Semaphore, mpsc, oneshot};

/// Connections at a time; further ones wait.
const MAX_CONNECTIONS: usize = 64;
/// Until a request's headers must be there, also on a connection that is kept open.
const HEADER_TIME: Duration = Duration::from_secs(30);
/// Until a request's body must be there.
const BODY_TIME: Duration = Duration::from_secs(30);
/// After which a connection ends whatever it is at.
const CONNECTION_TIME: Duration = Duration::from_secs(900);
/// Bytes of the body of a change: runs of labels.
const MAX_BODY: usize = 8 << 20;
/// A request that takes longer has failed for the page.
const ANSWER_MS: u64 = 60_000;
/// The socket thread looks around twice a second; after this long without it hangs.
const SOCKETS_HANG: Duration = Duration::from_secs(10);
/// Header without which nothing is changed.
const GUARD: &str = "x-coseg";
/// Who all HTTP requests count for: no client of the sockets, whose identities have five bytes if they begin with a zero.
const CLIENT: Bytes = Bytes::from_static(b"\0http requests");

/// An answer, its body in memory.
type Page = Response<Full<Bytes>>;

/// What connections share.
#[derive(Clone)]
pub(crate) struct Server {
    daemon: Arc<Daemon>,
    requests: mpsc::Sender<Incoming>,
    /// Milliseconds after the start at which the socket thread was last seen to live.
    sockets_seen: Arc<AtomicU64>,
}

/// Binds the address, before the runtime is there.
pub(crate) fn bind(address: SocketAddr) -> Result<TcpListener, StartError> {
    let failed = |source| StartError::Http { address, source };
    let listener = TcpListener::bind(address).map_err(failed)?;
    listener.set_nonblocking(true).map_err(failed)?;
    Ok(listener)
}

/// Serves connections until the runtime ends.
pub(crate) async fn serve(server: Server, listener: tokio::net::TcpListener) {
    let connections = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    loop {
        let connection = Arc::clone(&connections).acquire_owned().await;
        let connection = connection.expect("invariant: the semaphore is never closed");
        let stream = match listener.accept().await {
            Ok((stream, _)) => stream,
            Err(e) => {
                // Out of file descriptors, mostly: some come back.
                tracing::warn!(error = %e, "a connection cannot be accepted");
                tokio::time::sleep(Duration::from_millis(200)).await;
                continue;
            }
        };
        let server = server.clone();
        tokio::spawn(async move {
            let service =
                service_fn(|request| async { Ok::<_, Infallible>(server.respond(request).await) });
            let served = http1::Builder::new()
                .timer(TokioTimer::new())
                .header_read_timeout(HEADER_TIME)
                .serve_connection(TokioIo::new(stream), service);
            match tokio::time::timeout(CONNECTION_TIME, served).await {
                Ok(Ok(())) | Err(_) => {}
                Ok(Err(e)) => tracing::debug!(error = %e, "an HTTP connection ended early"),
            }
            drop(connection);
        });
    }
}

impl Server {
    pub(crate) fn new(daemon: Arc<Daemon>, requests: mpsc::Sender<Incoming>) -> Self {
        Self {
            daemon,
            requests,
            sockets_seen: Arc::default(),
        }
    }

    /// Notes when the socket thread was last seen to live.
    pub(crate) fn watch(&self, tick: Arc<AtomicU64>) -> impl Future<Output = ()> + use<> {
        let (daemon, seen) = (Arc::clone(&self.daemon), Arc::clone(&self.sockets_seen));
        async move {
            let mut last = None;
            loop {
                let now = tick.load(Ordering::Relaxed);
                if last != Some(now) {
                    last = Some(now);
                    let ms = daemon.started.elapsed().as_millis() as u64;
                    seen.store(ms, Ordering::Relaxed);
                }
                tokio::time::sleep(Duration::from_secs(1)).await;
            }
        }
    }

    async fn respond(&self, request: Request<HttpBody>) -> Page {
        let (path, mut page) = self.route(request).await;
        let headers = page.headers_mut();
        for (name, value) in [
            (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
            (header::REFERRER_POLICY, "no-referrer"),
            (header::X_FRAME_OPTIONS, "DENY"),
            (header::CONTENT_SECURITY_POLICY, page::POLICY),
        ] {
            headers.insert(name, HeaderValue::from_static(value));
        }
        headers
            .entry(header::CACHE_CONTROL)
            .or_insert(HeaderValue::from_static("no-store"));
        self.daemon.metrics.page(path, page.status().as_u16());
        page
    }

    /// The answer, and the path under which it is counted.
    async fn route(&self, request: Request<HttpBody>) -> (&'static str, Page) {
        let reads = request.method() == Method::GET || request.method() == Method::HEAD;
        let path = request.uri().path().to_owned();
        let monitoring = match path.as_str() {
            "/healthz" => Some(("/healthz", self.health())),
            "/readyz" => Some(("/readyz", self.readiness())),
            "/metrics" => Some(("/metrics", self.metrics().await)),
            _ => None,
        };
        if let Some((path, page)) = monitoring {
            return (path, if reads { page } else { not_allowed("GET") });
        }
        if let Err(why) = self.check_host(request.headers()) {
            return ("refused", text(StatusCode::FORBIDDEN, &why));
        }
        if path.starts_with("/api/") {
            return ("/api", self.api(request).await);
        }
        let page = match path.as_str() {
            _ if !reads => not_allowed("GET"),
            "/" => body(StatusCode::OK, "text/html; charset=utf-8", page::live()),
            "/viewer.css" => body(StatusCode::OK, "text/css; charset=utf-8", page::STYLE),
            "/viewer.js" => body(
                StatusCode::OK,
                "text/javascript; charset=utf-8",
                page::script(),
            ),
            _ => return ("unknown", text(StatusCode::NOT_FOUND, "no such page")),
        };
        ("/", page)
    }

    fn health(&self) -> Page {
        let seen = Duration::from_millis(self.sockets_seen.load(Ordering::Relaxed));
        let silent = self.daemon.started.elapsed().saturating_sub(seen);
        if silent > SOCKETS_HANG {
            let why = format!("the socket thread hangs since {} s", silent.as_secs());
            return text(StatusCode::SERVICE_UNAVAILABLE, &why);
        }
        text(StatusCode::OK, "alive")
    }

    fn readiness(&self) -> Page {
        match reads::not_ready(&self.daemon) {
            None => text(StatusCode::OK, "ready"),
            Some(why) => text(StatusCode::SERVICE_UNAVAILABLE, &why),
        }
    }

    async fn metrics(&self) -> Page {
        let kind = "application/openmetrics-text; version=1.0.0; charset=utf-8";
        match blocking(&self.daemon, |d| reads::metrics(d)).await {
            Ok(Ok(metrics)) => body(StatusCode::OK, kind, metrics),
            Ok(Err(e)) => text(StatusCode::INTERNAL_SERVER_ERROR, &e.to_string()),
            Err(panic) => text(StatusCode::INTERNAL_SERVER_ERROR, &panic),
        }
    }

    /// A name that somebody made to point to this machine is not its own.
    fn check_host(&self, headers: &HeaderMap) -> Result<(), String> {
        let local = self.daemon.http.is_none_or(|a| a.ip().is_loopback());
        let host = headers.get(header::HOST).and_then(|h| h.to_str().ok());
        if !local || host.is_some_and(is_loopback) {
            return Ok(());
        }
        Err(format!(
            "the host {:?} is not this machine's loopback",
            host.unwrap_or_default()
        ))
    }

    /// Whether a change may be asked for at all: by the page itself, where changes are allowed.
    fn check_change(&self, headers: &HeaderMap) -> Result<(), String> {
        if !self.daemon.config().http.edit {
            return Err("http.edit is false: this viewer only shows".to_owned());
        }
        if self.daemon.has_keys {
            return Err(
                "security.keys is set, and HTTP cannot tell who asks: this viewer only shows"
                    .to_owned(),
            );
        }
        let value = |name: &str| headers.get(name).and_then(|v| v.to_str().ok());
        if value(GUARD) != Some("1") {
            return Err(format!("a change needs the header {GUARD}: 1"));
        }
        // A browser sends where the page came from; other programs need not.
        let own = value("host").map(|host| format!("//{host}"));
        let origin = value("origin").and_then(|o| o.split_once(':'));
        match origin {
            Some((_, rest)) if Some(rest) != own.as_deref() => {
                Err("a change must come from the page itself".to_owned())
            }
            _ => Ok(()),
        }
    }

    async fn api(&self, request: Request<HttpBody>) -> Page {
        let (head, sent) = request.into_parts();
        let query = head.uri.query().unwrap_or_default().to_owned();
        let query: Vec<(String, String)> = form_urlencoded::parse(query.as_bytes())
            .into_owned()
            .collect();
        let path = head.uri.path().trim_start_matches("/api/").to_owned();
        let answer = if head.method == Method::GET {
            api::read(self, &path, &query).await
        } else if head.method == Method::POST {
            if let Err(why) = self.check_change(&head.headers) {
                return failed(&convert::error(
                    ErrorCode::PermissionDenied,
                    ErrorReason::Unspecified,
                    why,
                ));
            }
            let Some(_memory) = self.daemon.request_memory.try_reserve(MAX_BODY as u64) else {
                return failed(&busy("requests in hand leave no memory for another change"));
            };
            let collected = Limited::new(sent, MAX_BODY).collect();
            let sent = match tokio::time::timeout(BODY_TIME, collected).await {
                Ok(Ok(sent)) => sent.to_bytes(),
                Ok(Err(e)) => {
                    return text(
                        StatusCode::PAYLOAD_TOO_LARGE,
                        &format!("the body cannot be read, its limit is {MAX_BODY} bytes: {e}"),
                    );
                }
                Err(_) => return text(StatusCode::REQUEST_TIMEOUT, "the body did not arrive"),
            };
            api::change(self, &path, &sent).await
        } else {
            return not_allowed("GET, POST");
        };
        match answer {
            Ok(api::Found::Json(value)) => {
                body(StatusCode::OK, "application/json", value.to_string())
            }
            Ok(api::Found::Pack(bytes)) => body(StatusCode::OK, "application/octet-stream", bytes),
            Err(e) => failed(&e),
        }
    }

    /// Asks what a client of the sockets could ask, on the same way: the same order, limits and counters.
    async fn ask(&self, body: Body, frames: Vec<Bytes>) -> Answer {
        let n_bytes: u64 = frames.iter().map(|f| f.len() as u64).sum();
        let Some(memory) = self.daemon.request_memory.try_reserve(n_bytes) else {
            return Err(busy("requests in hand leave no memory for this one"));
        };
        let ticket = self.daemon.quotas.admit(&CLIENT, n_bytes);
        let ticket = ticket.map_err(|text| busy(&text))?;
        let (sender, receiver) = oneshot::channel();
        let incoming = Incoming {
            reply_to: ReplyTo::Task(sender),
            request: WireRequest {
                deadline_ms: ANSWER_MS,
                body: Some(body),
                ..WireRequest::default()
            },
            frames,
            received: Instant::now(),
            memory: Some(memory),
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

/// Whether the host of a request, with or without a port, is a loopback address or `localhost`.
fn is_loopback(host: &str) -> bool {
    let name = match host.strip_prefix('[') {
        Some(v6) => v6.split(']').next().unwrap_or_default(),
        None => host.split(':').next().unwrap_or_default(),
    };
    name.eq_ignore_ascii_case("localhost")
        || name.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback())
}

fn body(status: StatusCode, kind: &'static str, bytes: impl Into<Bytes>) -> Page {
    let mut page = Response::new(Full::new(bytes.into()));
    *page.status_mut() = status;
    let headers = page.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(kind));
    page
}

fn text(status: StatusCode, text: &str) -> Page {
    body(status, "text/plain; charset=utf-8", format!("{text}\n"))
}

fn not_allowed(allowed: &'static str) -> Page {
    let mut page = text(StatusCode::METHOD_NOT_ALLOWED, "not this way");
    page.headers_mut()
        .insert(header::ALLOW, HeaderValue::from_static(allowed));
    page
}

/// An error of the daemon, as JSON with a status of its kind.
fn failed(e: &wire::Error) -> Page {
    let status = match e.code() {
        ErrorCode::InvalidArgument => StatusCode::BAD_REQUEST,
        ErrorCode::NotFound => StatusCode::NOT_FOUND,
        ErrorCode::AlreadyExists | ErrorCode::FailedPrecondition | ErrorCode::Cancelled => {
            StatusCode::CONFLICT
        }
        ErrorCode::ResourceExhausted => StatusCode::SERVICE_UNAVAILABLE,
        ErrorCode::DeadlineExceeded => StatusCode::GATEWAY_TIMEOUT,
        ErrorCode::PermissionDenied => StatusCode::FORBIDDEN,
        _ => StatusCode::INTERNAL_SERVER_ERROR,
    };
    let error = crate::ipc::json::error(e);
    let text = serde_json::json!({ "error": error }).to_string();
    body(status, "application/json", text)
}

/// A reply of another kind than was asked for.
fn unexpected(result: &reply::Result) -> wire::Error {
    convert::error(
        ErrorCode::Internal,
        ErrorReason::Unspecified,
        format!("an unexpected reply: {result:?}"),
    )
}

#[cfg(test)]
mod tests {
    use super::is_loopback;

    #[test]
    fn only_names_of_loopback_are_this_machine() {
        for host in [
            "localhost",
            "LocalHost:80",
            "127.0.0.1:8640",
            "127.1.2.3",
            "[::1]:80",
            "[::1]",
        ] {
            assert!(is_loopback(host), "{host}");
        }
        for host in [
            "",
            "example.org",
            "localhost.example.org",
            "10.0.0.1:80",
            "[::2]",
            "127.0.0.1.x",
        ] {
            assert!(!is_loopback(host), "{host}");
        }
    }
}
