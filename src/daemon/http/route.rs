//! Routes HTTP requests: checks the client, then answers with health, metrics, the viewer or its
//! interface.

use super::api;
use super::connection::Connection;
use super::guard;
use super::hands;
use super::page::{Page, body, failed, method_not_allowed, text};
use super::server::Server;
use crate::daemon::status;
use crate::ipc::convert;
use crate::ipc::wire::{ErrorCode, ErrorReason};
use crate::library::LibraryError;
use crate::viewer::page;
use bytes::Bytes;
use hyper::body::Incoming as HttpBody;
use hyper::header::{self, HeaderValue};
use hyper::{Method, Request, StatusCode};
use std::sync::{Arc, LazyLock};
use std::time::{Duration, Instant};

/// Threads that show that they live do so twice a second; after this long without it they hang.
const HANG: Duration = Duration::from_secs(10);
/// Metrics are read at most once in this time, however many requests there are.
const METRICS_AGE: Duration = Duration::from_millis(100);
static SCRIPT: LazyLock<Bytes> = LazyLock::new(|| page::script().into());
static PAGE: LazyLock<Bytes> = LazyLock::new(|| page::live().into());
/// The page that sets the cookie for a token. It requests `/` again, since a browser sends such a
/// cookie with no request that another site led to, but with one that this page led to.
const AGAIN: &str = "<!doctype html><meta charset=\"utf-8\">\
                     <meta http-equiv=\"refresh\" content=\"0;url=/\">\
                     <title>coseg</title><a href=\"/\">The viewer</a>";

/// Answers a request, with the headers that every page has.
pub(super) async fn respond(
    server: &Server,
    request: Request<HttpBody>,
    connection: &Connection,
) -> Page {
    let (path, mut page) = server.route(request, connection).await;
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
    server
        .daemon
        .telemetry
        .metrics
        .page(path, page.status().as_u16());
    page
}

impl Server {
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
        // Whether the daemon lives and is ready is no secret, and a probe may use any host name.
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
                _ if !reads => method_not_allowed("GET"),
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
            _ if !reads => method_not_allowed("GET"),
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

    /// Sets the cookie for the token of an address, or asks for the token.
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
                 Authorization: Bearer TOKEN; whoever runs the daemon finds it in http.token_file, \
                 by default http.token in the folder of the library"
            }
        };
        let mut page = text(StatusCode::UNAUTHORIZED, why);
        let scheme = HeaderValue::from_static("Bearer realm=\"coseg\"");
        page.headers_mut().insert(header::WWW_AUTHENTICATE, scheme);
        page
    }

    fn health(&self) -> Page {
        for thread in &self.threads {
            let up = self.daemon.identity.started.elapsed();
            let silent = up.saturating_sub(thread.seen());
            if silent > HANG {
                let why = format!("{} hangs since {} s", thread.name, silent.as_secs());
                return text(StatusCode::SERVICE_UNAVAILABLE, &why);
            }
        }
        text(StatusCode::OK, "alive")
    }

    /// Whether changes are accepted. The reason why not is for requests with the right host only.
    fn readiness(&self, with_reason: bool) -> Page {
        match status::not_ready(&self.daemon) {
            None => text(StatusCode::OK, "ready"),
            Some(why) if with_reason => text(StatusCode::SERVICE_UNAVAILABLE, &why),
            Some(_) => text(StatusCode::SERVICE_UNAVAILABLE, "not ready"),
        }
    }

    /// One request at a time reads the metrics, and the others return what it read.
    async fn metrics(&self) -> Page {
        let kind = "application/openmetrics-text; version=1.0.0; charset=utf-8";
        let mut last = Arc::clone(&self.metrics).lock_owned().await;
        let daemon = Arc::clone(&self.daemon);
        let read = hands::beside(move || {
            if let Some((read, text)) = &*last
                && read.elapsed() < METRICS_AGE
            {
                return Ok(text.clone());
            }
            let text = Bytes::from(status::metrics(&daemon)?);
            *last = Some((Instant::now(), text.clone()));
            Ok::<_, LibraryError>(text)
        });
        match read.await {
            Ok(Ok(metrics)) => body(StatusCode::OK, kind, metrics),
            Ok(Err(e)) => text(StatusCode::INTERNAL_SERVER_ERROR, &e.to_string()),
            Err(e) => text(StatusCode::INTERNAL_SERVER_ERROR, &e.message),
        }
    }

    async fn api(&self, request: Request<HttpBody>, connection: &Connection) -> Page {
        let (head, sent) = request.into_parts();
        let changes = match head.method {
            Method::GET => false,
            Method::POST => true,
            _ => return method_not_allowed("GET, POST"),
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
}
