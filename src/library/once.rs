//! Each request takes effect once: the reply is stored with the effect, under the request's key.

use super::error::{LibraryError, Result};
use super::reason::Reason;
use super::rows::{damaged, from_json};
use super::types::RequestKey;
use crate::store::{Digest, RequestRow, Store, Tx};
use serde::Deserialize;
use std::time::{SystemTime, UNIX_EPOCH};

/// A request that takes effect at most once.
#[derive(Debug, Clone, Copy)]
pub(super) struct Request<'a> {
    /// `None` if nobody repeats the request.
    pub(super) key: Option<&'a RequestKey>,
    /// Distinguishes the request from another one with the same key.
    pub(super) digest: Digest,
    /// The digest that an earlier version computed for the same request, if it differs.
    pub(super) earlier: Option<Digest>,
}

impl<'a> Request<'a> {
    /// A request that is identified by this text.
    pub(super) fn of(key: Option<&'a RequestKey>, text: &str) -> Self {
        Self::new(key, Digest::of(text.as_bytes()))
    }

    pub(super) fn new(key: Option<&'a RequestKey>, digest: Digest) -> Self {
        Self {
            key,
            digest,
            earlier: None,
        }
    }

    fn is_of(&self, digest: &Digest) -> bool {
        *digest == self.digest || Some(*digest) == self.earlier
    }
}

/// Runs a change within a transaction unless its request was answered before. Returns the new or
/// the stored reply.
pub(super) fn once(
    tx: &Tx<'_>,
    request: &Request<'_>,
    change: impl FnOnce(&Tx<'_>) -> Result<Vec<u8>>,
) -> Result<Vec<u8>> {
    let Some(key) = request.key else {
        return change(tx);
    };
    if let Some(row) = tx.request(&key.client_id, &key.request_id)? {
        return same(request, key, row);
    }
    let reply = change(tx)?;
    tx.put_request(&RequestRow {
        client_id: key.client_id.clone(),
        request_id: key.request_id.clone(),
        request_digest: request.digest,
        reply: reply.clone(),
        created_unix_secs: unix_secs(),
    })?;
    Ok(reply)
}

/// Returns the reply to a request that was answered before.
pub(super) fn answered(store: &Store, request: &Request<'_>) -> Result<Option<Vec<u8>>> {
    let Some(key) = request.key else {
        return Ok(None);
    };
    let read = |r: &crate::store::Reader<'_>| r.request(&key.client_id, &key.request_id);
    let row = store
        .catalog()
        .read(|r| read(r).map_err(LibraryError::from))?;
    row.map(|row| same(request, key, row)).transpose()
}

fn same(request: &Request<'_>, key: &RequestKey, row: RequestRow) -> Result<Vec<u8>> {
    if request.is_of(&row.request_digest) {
        return Ok(row.reply);
    }
    Err(LibraryError::FailedPrecondition {
        reason: Reason::RequestIdReused,
        message: format!(
            "client {:?} used request id {:?} for another request before",
            key.client_id, key.request_id
        ),
    })
}

/// Decodes a stored reply.
pub(super) fn from_reply<T: for<'de> Deserialize<'de>>(reply: &[u8]) -> Result<T> {
    let text = std::str::from_utf8(reply).map_err(|e| damaged("requests", &e.to_string()))?;
    from_json(text, "requests")
}

/// Returns the time in milliseconds since 1970.
pub(super) fn unix_ms() -> u64 {
    let elapsed = SystemTime::now().duration_since(UNIX_EPOCH);
    elapsed.map_or(0, |e| u64::try_from(e.as_millis()).unwrap_or(u64::MAX))
}

/// Returns the time in seconds since 1970.
pub(super) fn unix_secs() -> u64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    now.map_or(0, |d| d.as_secs())
}
