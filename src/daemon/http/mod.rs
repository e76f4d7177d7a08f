//! A small HTTP endpoint: health and metrics for monitoring, the viewer and its interface for browsers.
//!
//! Without a token it listens on loopback only; beyond it asks for one ([`guard`], [`token`]). It
//! has a runtime, memory and places of its own ([`door`], [`hands`]): whatever a page asks for, the
//! sockets and signals are served all the same.

mod api;
mod door;
mod guard;
mod hands;
mod runs;
mod token;

pub use token::TokenError;

use crate::config::Config;
use crate::daemon::requests::{Answer, busy};
use crate::daemon::sockets::{Incoming, ReplyTo};
use crate::daemon::{Daemon, StartError, reads};
use crate::ipc::convert;
use crate::ipc::wire::{
    self, ErrorCode, ErrorReason, Request as WireRequest, reply, request::Body,
};
use crate::viewer::page;
use bytes::Bytes;
use door::{Connection, PEER_TIME};
use guard::Guard;
use hands::Hands;
use http_body_util::{BodyExt as _, Full};
use hyper::body::{Body as _, Incoming as HttpBody};
use hyper::header::{self, HeaderValue};
use hyper::{Method, Request, Response, StatusCode};
use std::net::{SocketAddr, TcpListener};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, LazyLock};
use std::time::{Duration, Instant};
use tokio::runtime::Runtime;
use tokio::sync::{mpsc, oneshot};

/// Bytes of the body of a change: runs of labels.
const MAX_BODY: u64 = 8 << 20;
/// Bytes that are set aside for each byte of a body when it comes: for itself, in a buffer that
/// doubles, and for the runs that it is read to.
const PER_BODY_BYTE: u64 = 5;
/// A request that takes longer has failed for the page.
const ANSWER_MS: u64 = 60_000;
/// Threads that show that they live do so twice a second; after this long without it they hang.
const HANG: Duration = Duration::from_secs(10);
/// How often is looked whether they do.
const LOOK: Duration = Duration::from_secs(1);
/// Metrics are read anew after this long, however many ask.
const METRICS_AGE: Duration = Duration::from_millis(100);
/// Who all HTTP requests count for: no client of the sockets, whose identities have five bytes if they begin with a zero.
const CLIENT: Bytes = Bytes::from_static(b"\0http requests");

static SCRIPT: LazyLock<Bytes> = LazyLock::new(|| page::script().into());
static PAGE: LazyLock<Bytes> = LazyLock::new(|| page::live().into());
/// What a token is turned into the cookie with. The page asks for itself once more: a browser shows
/// such a cookie to no page that another site led to, but to one that this page led to.
const AGAIN: &str = "<!doctype html><meta charset=\"utf-8\"><meta http-equiv=\"refresh\" content=\"0;url=/\">\
                     <title>coseg</title><a href=\"/\">The viewer</a>";

/// An answer, its body in memory.
type Page = Response<Full<Bytes>>;

/// What connections share.
pub(crate) struct Server {
    daemon: Arc<Daemon>,
    requests: mpsc::Sender<Incoming>,
    guard: Guard,
    hands: Hands,
    /// The metrics as they were last read.
    metrics: Arc<tokio::sync::Mutex<Option<(Instant, Bytes)>>>,
    threads: [Thread; 2],
}

/// A thread of the daemon that should live.
struct Thread {
    name: &'static str,
    /// Advances while it does.
    tick: Arc<AtomicU64>,
    /// Milliseconds after the start at which it last had.
    seen: AtomicU64,
}

/// An address that is bound, and what is asked of those who come.
pub(crate) struct Bound {
    listener: TcpListener,
    guard: Guard,
}

/// Binds the address that is configured, if one is. The token, if one is needed and there is none,
/// is made in the folder of the library, which must be there.
pub(crate) fn bind(config: &Config, library: &Path) -> Result<Option<Bound>, StartError> {
    let Some(address) = config.http.address()? else {
        return Ok(None);
    };
    let failed = |source| StartError::Http { address, source };
    let listener = TcpListener::bind(address).map_err(failed)?;
    listener.set_nonblocking(true).map_err(failed)?;
    let local = address.ip().is_loopback();
    let path = token::path(&config.http.token_file, library);
    let asks = !local || !config.http.token_file.as_os_str().is_empty();
    let token = asks
        .then(|| token::Token::read_or_make(&path))
        .transpose()?;
    if asks {
        let file = path.display();
        tracing::info!(%file, "HTTP asks for the token of this file: /?token=… opens the viewer");
    }
    let guard = Guard {
        local,
        token,
        open_monitoring: config.http.open_monitoring,
    };
    Ok(Some(Bound { listener, guard }))
}

impl Bound {
    /// The address, with the port that was chosen.
    pub(crate) fn address(&self) -> Option<SocketAddr> {
        self.listener.local_addr().ok()
    }

    /// Serves connections in a runtime of its own, until that is dropped.
    pub(crate) fn serve(
        self,
        daemon: Arc<Daemon>,
        requests: mpsc::Sender<Incoming>,
        [sockets, runtime]: [&Arc<AtomicU64>; 2],
    ) -> std::io::Result<Runtime> {
        let own = hands::runtime()?;
        let thread = |name, tick: &Arc<AtomicU64>| Thread {
            name,
            tick: Arc::clone(tick),
            seen: AtomicU64::new(0),
        };
        let server = Arc::new(Server {
            guard: self.guard,
            hands: Hands::new(&daemon.config().limits),
            metrics: Arc::default(),
            threads: [
                thread("the socket thread", sockets),
                thread("the runtime", runtime),
            ],
            daemon,
            requests,
        });
        let guard = own.enter();
        let listener = tokio::net::TcpListener::from_std(self.listener)?;
        tokio::spawn(watch(Arc::clone(&server)));
        tokio::spawn(door::serve(server, listener));
        drop(guard);
        Ok(own)
    }
}

/// Notes when the threads were last seen to live.
async fn watch(server: Arc<Server>) {
    let mut last = [None; 2];
    loop {
        for (thread, last) in server.threads.iter().zip(&mut last) {
            let now = thread.tick.load(Ordering::Relaxed);
            if *last != Some(now) {
                *last = Some(now);
                let ms = server.daemon.started.elapsed().as_millis() as u64;
                thread.seen.store(ms, Ordering::Relaxed);
            }
        }
        tokio::time::sleep(LOOK).await;
    }
}

impl Server {
    async fn respond(&self, request: Request<HttpBody>, connection: &Connection) -> Page {
        let (path, mut page) = self.route(request, connection).await;
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
    async fn route(
        &self,
        request: Request<HttpBody>,
        connection: &Connection,
    ) -> (&'static str, Page) {
        let reads = request.method() == Method::GET || request.method() == Method::HEAD;
        let path = request.uri().path().to_owned();
        let monitoring = ["/healthz", "/readyz", "/metrics"];
        let monitoring = monitoring.into_iter().find(|m| *m == path);
        let host = self.guard.check_host(request.uri(), request.headers());
        // Whether the daemon lives and is ready is no secret, and a probe may call it what it
        // likes.
        let is_probe = ["/healthz", "/readyz"].contains(&path.as_str());
        if let Err(why) = &host
            && !is_probe
        {
            return ("refused", text(StatusCode::FORBIDDEN, why));
        }
        let open = monitoring.is_some() && self.guard.open_monitoring;
        if !open && !self.guard.knows(request.headers()) {
            return ("refused", self.admit(&request));
        }
        if let Some(path) = monitoring {
            let page = match path {
                _ if !reads => not_allowed("GET"),
                "/healthz" => self.health(),
                "/readyz" => self.readiness(host.is_ok()),
                _ => self.metrics().await,
            };
            return (path, page);
        }
        if path.starts_with("/api/") {
            return ("/api", self.api(request, connection).await);
        }
        let page = match path.as_str() {
            _ if !reads => not_allowed("GET"),
            "/" => body(StatusCode::OK, "text/html; charset=utf-8", PAGE.clone()),
            "/viewer.css" => body(StatusCode::OK, "text/css; charset=utf-8", page::STYLE),
            "/viewer.js" => {
                let kind = "text/javascript; charset=utf-8";
                body(StatusCode::OK, kind, SCRIPT.clone())
            }
            _ => return ("unknown", text(StatusCode::NOT_FOUND, "no such page")),
        };
        ("/", page)
    }

    /// Turns the token of an address into a cookie, or asks for it.
    fn admit(&self, request: &Request<HttpBody>) -> Page {
        let query = request.uri().query().unwrap_or_default();
        let mut query = form_urlencoded::parse(query.as_bytes());
        let shown = query.find(|(name, _)| name == "token");
        let opens = request.method() == Method::GET && request.uri().path() == "/";
        let cookie = shown.as_ref().filter(|_| opens);
        if let Some(cookie) = cookie.and_then(|(_, token)| self.guard.cookie(token)) {
            let mut page = body(StatusCode::OK, "text/html; charset=utf-8", AGAIN);
            page.headers_mut().insert(header::SET_COOKIE, cookie);
            return page;
        }
        let why = match shown {
            Some(_) if opens => "this is not the token that the daemon asks for",
            _ => {
                "the daemon asks for a token: open /?token=TOKEN in a browser, or send the header \
                 Authorization: Bearer TOKEN; whoever runs the daemon finds it in http.token_file, by default \
                 http.token in the folder of the library"
            }
        };
        let mut page = text(StatusCode::UNAUTHORIZED, why);
        let scheme = HeaderValue::from_static("Bearer realm=\"coseg\"");
        page.headers_mut().insert(header::WWW_AUTHENTICATE, scheme);
        page
    }

    fn health(&self) -> Page {
        for thread in &self.threads {
            let seen = Duration::from_millis(thread.seen.load(Ordering::Relaxed));
            let silent = self.daemon.started.elapsed().saturating_sub(seen);
            if silent > HANG {
                let why = format!("{} hangs since {} s", thread.name, silent.as_secs());
                return text(StatusCode::SERVICE_UNAVAILABLE, &why);
            }
        }
        text(StatusCode::OK, "alive")
    }

    /// Whether changes are taken; why not is for those who know whom they ask.
    fn readiness(&self, in_words: bool) -> Page {
        match reads::not_ready(&self.daemon) {
            None => text(StatusCode::OK, "ready"),
            Some(why) if in_words => text(StatusCode::SERVICE_UNAVAILABLE, &why),
            Some(_) => text(StatusCode::SERVICE_UNAVAILABLE, "not ready"),
        }
    }

    /// One at a time reads them, and the others take what it read.
    async fn metrics(&self) -> Page {
        let kind = "application/openmetrics-text; version=1.0.0; charset=utf-8";
        let mut kept = Arc::clone(&self.metrics).lock_owned().await;
        let daemon = Arc::clone(&self.daemon);
        let read = hands::beside(move || {
            if let Some((read, text)) = &*kept
                && read.elapsed() < METRICS_AGE
            {
                return Ok(text.clone());
            }
            let text = Bytes::from(reads::metrics(&daemon)?);
            *kept = Some((Instant::now(), text.clone()));
            Ok::<_, crate::library::LibraryError>(text)
        });
        match read.await {
            Ok(Ok(metrics)) => body(StatusCode::OK, kind, metrics),
            Ok(Err(e)) => text(StatusCode::INTERNAL_SERVER_ERROR, &e.to_string()),
            Err(e) => text(StatusCode::INTERNAL_SERVER_ERROR, &e.message),
        }
    }

    /// Refuses a change where none are allowed.
    fn check_edit(&self) -> Result<(), String> {
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

    async fn api(&self, request: Request<HttpBody>, connection: &Connection) -> Page {
        let (head, sent) = request.into_parts();
        let changes = match head.method {
            Method::GET => false,
            Method::POST => true,
            _ => return not_allowed("GET, POST"),
        };
        let checked = guard::check_site(&head.headers);
        let checked = checked.and_then(|()| match changes {
            true => self
                .check_edit()
                .and_then(|()| guard::check_change(&head.headers)),
            false => Ok(()),
        });
        if let Err(why) = checked {
            let code = ErrorCode::PermissionDenied;
            return failed(&convert::error(code, ErrorReason::Unspecified, why));
        }
        let path = head.uri.path().trim_start_matches("/api/").to_owned();
        let answer = if changes {
            connection.waits();
            let sent = self.collect(sent).await;
            connection.works();
            match sent {
                Ok(sent) => match self.hands.change().await {
                    Ok(_turn) => api::change(self, &path, sent).await,
                    Err(e) => Err(e),
                },
                Err(page) => return page,
            }
        } else {
            let query = head.uri.query().unwrap_or_default();
            let query: Vec<(String, String)> = form_urlencoded::parse(query.as_bytes())
                .into_owned()
                .collect();
            match self.hands.read().await {
                Ok(_turn) => api::read(self, &path, &query).await,
                Err(e) => Err(e),
            }
        };
        match answer {
            Ok(found) => body(StatusCode::OK, found.kind, found.bytes),
            Err(e) => failed(&e),
        }
    }

    /// The body of a request. Memory is set aside for what has come, not for what is announced.
    async fn collect(&self, mut sent: HttpBody) -> Result<hands::Kept<Vec<u8>>, Page> {
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
                // Trailers are nothing to the daemon.
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
            Ok(hands::Kept { it: bytes, memory })
        };
        match tokio::time::timeout(PEER_TIME, collected).await {
            Ok(done) => done,
            Err(_) => {
                let why = format!("the body did not arrive within {} s", PEER_TIME.as_secs());
                Err(text(StatusCode::REQUEST_TIMEOUT, &why))
            }
        }
    }

    /// Asks what a client of the sockets could ask, on the same way: the same order, limits and
    /// counters. The memory of frames goes with them.
    async fn ask(&self, body: Body, frames: Option<hands::Kept<Vec<Bytes>>>) -> Answer {
        let (frames, memory) = frames.map_or((Vec::new(), None), |f| (f.it, Some(f.memory)));
        let n_bytes: u64 = frames.iter().map(|f| f.len() as u64).sum();
        let ticket = self.daemon.quotas.admit(&CLIENT, n_bytes);
        let ticket = ticket.map_err(|text| busy(&text))?;
        let (sender, receiver) = oneshot::channel();
        let incoming = Incoming {
            reply_to: ReplyTo::Task(sender),
            user: None,
            request: WireRequest {
                deadline_ms: ANSWER_MS,
                body: Some(body),
                ..WireRequest::default()
            },
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
