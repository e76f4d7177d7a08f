//! Appends to the log of a collection's events.

use crate::library::error::Result;
use crate::library::event::EventKind;
use crate::library::rows::to_json;
use crate::store::{CollectionId, Tx};

/// Appends an event to a collection's log and returns its sequence number.
pub(in crate::library) fn event(
    tx: &Tx<'_>,
    collection: CollectionId,
    kind: &EventKind,
) -> Result<u64> {
    Ok(tx.append_event(collection, kind.name(), &to_json(kind))?)
}
