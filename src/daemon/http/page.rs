//! Pages: responses whose body is in memory.

use crate::ipc::convert;
use crate::ipc::wire::{self, ErrorCode, ErrorReason, reply};
use bytes::Bytes;
use http_body_util::Full;
use hyper::header::{self, HeaderValue};
use hyper::{Response, StatusCode};

/// A response with its body in memory.
pub(super) type Page = Response<Full<Bytes>>;

pub(super) fn body(status: StatusCode, kind: &'static str, bytes: impl Into<Bytes>) -> Page {
    let mut page = Response::new(Full::new(bytes.into()));
    *page.status_mut() = status;
    let headers = page.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(kind));
    page
}

pub(super) fn text(status: StatusCode, text: &str) -> Page {
    body(status, "text/plain; charset=utf-8", format!("{text}\n"))
}

pub(super) fn method_not_allowed(allowed: &'static str) -> Page {
    let mut page = text(StatusCode::METHOD_NOT_ALLOWED, "not this way");
    page.headers_mut()
        .insert(header::ALLOW, HeaderValue::from_static(allowed));
    page
}

/// An error of the daemon, as JSON with a status of its kind.
pub(super) fn failed(e: &wire::Error) -> Page {
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

/// The reply is of another kind than the request.
pub(super) fn unexpected(result: &reply::Result) -> wire::Error {
    convert::error(
        ErrorCode::Internal,
        ErrorReason::Unspecified,
        format!("an unexpected reply: {result:?}"),
    )
}
