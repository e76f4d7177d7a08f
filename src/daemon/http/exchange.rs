//! Sends the requests of pages to the daemon, reads what they send and writes what they get.

use super::hands::{Reserved, full};
use super::server::Server;
use crate::ipc::convert;
use crate::ipc::wire::{self, ErrorReason};
use bytes::Bytes;
use serde_json::Value;

/// The body of a page.
pub(super) struct Found {
    pub(super) kind: &'static str,
    pub(super) bytes: Bytes,
}

pub(super) type Answer = Result<Found, wire::Error>;

/// Sends the request of the named variant, and returns its reply with the frames.
macro_rules! request {
    ($server:expr, $variant:ident($body:expr)) => {
        request!($server, $variant($body), None)
    };
    ($server:expr, $variant:ident($body:expr), $frames:expr) => {
        match $server.ask(Body::$variant($body), $frames).await? {
            (reply::Result::$variant(reply), frames) => Ok((reply, frames)),
            (other, _) => Err(super::page::unexpected(&other)),
        }
    };
}
pub(super) use request;

/// Parameters of a query.
pub(super) struct Query<'a>(pub(super) &'a [(String, String)]);

impl Query<'_> {
    pub(super) fn find(&self, name: &str) -> Option<&str> {
        let found = self.0.iter().find(|(key, _)| key == name);
        found.map(|(_, value)| value.as_str())
    }

    pub(super) fn text(&self, name: &str) -> Result<String, wire::Error> {
        let found = self.find(name).map(str::to_owned);
        found.ok_or_else(|| {
            convert::field_error(
                ErrorReason::FieldMissing,
                name,
                format!("{name} is missing"),
            )
        })
    }

    pub(super) fn number<T: std::str::FromStr + Default>(
        &self,
        name: &str,
    ) -> Result<T, wire::Error> {
        let Some(text) = self.find(name) else {
            return Ok(T::default());
        };
        text.parse().map_err(|_| {
            let message = format!("{name} is {text:?}, which is no number here");
            convert::field_error(ErrorReason::FieldRange, name, message)
        })
    }
}

/// JSON, for which memory is reserved.
pub(super) fn json_page(text: Reserved<String>) -> Found {
    let Reserved { value, memory } = text;
    let value = Bytes::from(value);
    Found {
        kind: "application/json",
        bytes: Reserved { value, memory }.into_bytes(),
    }
}

/// Makes JSON that can be large, off the threads that wait.
pub(super) async fn json_of(
    server: &Server,
    make: impl FnOnce() -> Value + Send + 'static,
) -> Answer {
    let value = server.hands.work(move || make().to_string()).await?;
    let memory = server
        .hands
        .memory(value.capacity() as u64)
        .ok_or_else(full)?;
    Ok(json_page(Reserved { value, memory }))
}

/// Parses the body of a change, off the threads that wait. Its memory is given back when the parsed
/// value is dropped.
pub(super) async fn parsed<T: serde::de::DeserializeOwned + Send + 'static>(
    server: &Server,
    sent: Reserved<Vec<u8>>,
) -> Result<Reserved<T>, wire::Error> {
    let Reserved {
        value: bytes,
        memory,
    } = sent;
    let read = move || serde_json::from_slice(&bytes);
    let value = server.hands.work(read).await?.map_err(|e| {
        let text = format!("the body is not what is expected: {e}");
        let code = wire::ErrorCode::InvalidArgument;
        convert::error(code, ErrorReason::MalformedMessage, text)
    })?;
    Ok(Reserved { value, memory })
}
