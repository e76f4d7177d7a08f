//! Answers to requests: their form, who waits for them, the errors that several handlers return,
//! and the limits that `hello` reports.

use crate::ipc::convert;
use crate::ipc::wire::{self, ErrorCode, ErrorReason, reply};
use crate::library::LibraryError;
use bytes::Bytes;
use std::any::Any;

/// Raw frames of one message; a shape takes at most two.
pub(crate) const MAX_FRAMES: usize = 1_024;
/// Bytes of a header frame.
pub(crate) const MAX_HEADER_BYTES: u64 = 1 << 20;
/// Characters of the ids of a request.
pub(crate) const MAX_ID_CHARS: usize = 128;
/// Entries of a page.
pub(crate) const MAX_PAGE: u32 = 1_000;
/// Longest wait of `watch_job` and `wait_idle`, in milliseconds.
pub(crate) const MAX_WAIT_MS: u64 = 30_000;
/// Delay after which a client that found the queue or the memory full should try again.
pub(crate) const BUSY_RETRY_MS: u64 = 250;

/// The result and raw frames of a reply.
pub(crate) type Answer = Result<(reply::Result, Vec<Bytes>), wire::Error>;

/// A client of the sockets.
#[derive(Debug, Clone)]
pub(crate) struct Peer {
    pub(crate) identity: Bytes,
    /// Whether the peer puts an empty frame before the header, as a REQ socket does.
    pub(crate) delimiter: bool,
}

/// The receiver of a reply.
pub(crate) enum ReplyTo {
    /// A client of the sockets.
    Peer(Peer),
    /// A task of this process.
    Task(tokio::sync::oneshot::Sender<Answer>),
}

impl ReplyTo {
    /// The identity of the client of the sockets that waits.
    pub(crate) fn client(&self) -> Option<&Bytes> {
        match self {
            Self::Peer(peer) => Some(&peer.identity),
            Self::Task(_) => None,
        }
    }
}

/// The number of entries that the request wants, or `default` if it gives 0.
pub(crate) fn page_size(field: &str, wanted: u32, default: u32) -> Result<usize, wire::Error> {
    if wanted > MAX_PAGE {
        let text = format!("{field} is {wanted}, the limit is {MAX_PAGE}");
        return Err(convert::field_error(ErrorReason::FieldRange, field, text));
    }
    Ok(if wanted == 0 { default } else { wanted } as usize)
}

/// An operation of the library failed.
pub(crate) fn refused(e: LibraryError) -> wire::Error {
    convert::library_error(&e)
}

/// The daemon has no room for the request at the moment.
pub(crate) fn busy(message: &str) -> wire::Error {
    let mut error = convert::error(
        ErrorCode::ResourceExhausted,
        ErrorReason::QueueFull,
        message,
    );
    error.retry_after_ms = BUSY_RETRY_MS;
    error
}

/// A handler panicked with this text.
pub(crate) fn panicked(panic: &str) -> wire::Error {
    convert::error(
        ErrorCode::Internal,
        ErrorReason::Panic,
        format!("answering panicked: {panic}"),
    )
}

/// The daemon accepts no changes any more.
pub(crate) fn draining() -> wire::Error {
    convert::error(
        ErrorCode::FailedPrecondition,
        ErrorReason::Draining,
        "the daemon is shutting down; what it accepted is resumed at its next start",
    )
}

/// The client's key is not on the allow list; `rest` says what becomes of the request.
pub(crate) fn not_allowed(rest: &str) -> wire::Error {
    let text = format!("the client's key is not, or no longer, on the allow list{rest}");
    convert::error(
        ErrorCode::PermissionDenied,
        ErrorReason::KeyNotAllowed,
        text,
    )
}

/// The message of a panic.
pub(crate) fn panic_text(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|s| (*s).to_owned());
    text.or_else(|| panic.downcast_ref::<String>().cloned())
        .unwrap_or_else(|| "no message".to_owned())
}
