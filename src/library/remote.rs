//! Places a shape in another process: defines the ticket that it gets and the state that it
//! returns.
//!
//! The other process opens the library beside the process that holds it, and commits by itself. If
//! it dies in the middle, the library is as after a crash, without the change. Meanwhile the holder
//! does not use the collection. It detects by the collection's row that it must reload it.

use super::error::{LibraryError, Result};
use super::facade::Library;
use super::rows::{damaged, from_json, to_json};
use super::sources::Sources;
use super::submit::Described;
use super::types::{ItemState, JobItem};
use crate::store::{Digest, Kept, ObjectKind, ObjectRow, Store};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::path::Path;
use std::time::Instant;

/// The origin of the other process's text, in errors.
const LOCATION: &str = "work handed over";

/// A described shape on disk, and its item.
#[derive(Debug, Serialize, Deserialize)]
struct Ticket {
    job: u64,
    index: u32,
    collection: String,
    name: String,
    digest: String,
    file: String,
    length: u64,
    blake3: String,
    stages_ms: Vec<(String, f64)>,
}

/// Names the shape that another process is to place. Its description stays on disk until this is
/// dropped.
#[derive(Debug)]
pub struct PlacementTicket {
    /// The argument of [`Library::place_ticket`].
    pub words: Value,
    _kept: Kept,
}

impl Ticket {
    fn object(&self) -> Result<ObjectRow> {
        let digest = |text: &str| -> Result<Digest> {
            text.parse()
                .map_err(|e| damaged(LOCATION, &format!("{text:?}: {e}")))
        };
        Ok(ObjectRow {
            kind: ObjectKind::Description,
            digest: digest(&self.digest)?,
            file: self.file.clone(),
            length: self.length,
            blake3: digest(&self.blake3)?,
        })
    }

    fn item(&self) -> JobItem {
        JobItem {
            job: self.job,
            index: self.index,
            collection: self.collection.clone(),
            name: self.name.clone(),
            state: ItemState::Queued,
            attempts: 0,
        }
    }
}

impl Library {
    /// Opens the library in `dir` beside the process that holds it. That process has started this
    /// one, and gives it exclusive use ([`Library::with_exclusive`]) of each collection that it is
    /// to change.
    ///
    /// # Errors
    /// There is no library of this version's format, or it cannot be read.
    pub fn open_beside(dir: &Path) -> Result<Self> {
        Ok(Self::over(Store::open_beside(dir)?))
    }

    /// Makes a description durable for [`Library::place_ticket`] in another process. That process
    /// must end before the returned ticket is dropped.
    ///
    /// # Errors
    /// The description cannot be stored.
    pub fn placement_ticket(
        &self,
        item: &JobItem,
        described: &Described,
    ) -> Result<PlacementTicket> {
        let begin = Instant::now();
        let object = self.store.objects().put_description(
            described.digest,
            &described.description,
            &described.params_json,
        )?;
        let mut stages_ms = described.stages_ms.clone();
        stages_ms.push(("store".to_owned(), begin.elapsed().as_secs_f64() * 1e3));
        let ticket = Ticket {
            job: item.job,
            index: item.index,
            collection: item.collection.clone(),
            name: item.name.clone(),
            digest: object.digest.to_string(),
            file: object.file.clone(),
            length: object.length,
            blake3: object.blake3.to_string(),
            stages_ms,
        };
        let words = serde_json::to_value(ticket);
        Ok(PlacementTicket {
            words: words.expect("invariant: strings and numbers are JSON"),
            _kept: object,
        })
    }

    /// Does what [`Library::place_item`] does with the description that a ticket names.
    ///
    /// # Errors
    /// Those of [`Library::place_item`]; or the description cannot be read.
    pub fn place_ticket(&self, ticket: &Value) -> Result<ItemState> {
        let ticket: Ticket = from_json(&ticket.to_string(), LOCATION)?;
        let object = ticket.object()?;
        let mapped = self.store.objects().open_description(&object)?;
        let described = Described {
            description: mapped.to_description(),
            digest: object.digest,
            params_json: mapped.params_json().to_owned(),
            stages_ms: ticket.stages_ms.clone(),
            stored: Some(object),
        };
        self.place_item(&ticket.item(), Ok(described))
    }

    /// Returns the bytes of the mesh file of the shape that a ticket names.
    ///
    /// # Errors
    /// There is no such item, or its bytes cannot be read.
    pub fn ticket_bytes(&self, ticket: &Value) -> Result<Vec<u8>> {
        let ticket: Ticket = from_json(&ticket.to_string(), LOCATION)?;
        let row = self.item_row(&ticket.item())?;
        self.store.original(&row.item.original_digest)
    }

    /// Returns whether a shape of a collection is stale.
    ///
    /// # Errors
    /// There is no such collection.
    pub fn has_stale(&self, collection: &str) -> Result<bool> {
        let id = self.collection_row(collection)?.id;
        let next = self
            .store
            .catalog()
            .read(|r| r.next_stale(Some(id)).map_err(LibraryError::from))?;
        Ok(next.is_some())
    }

    /// Returns the state of an item in the catalog. If it is done, the counters include the work of
    /// another process for it.
    ///
    /// # Errors
    /// There is no such item.
    pub fn item_state(&self, item: &JobItem) -> Result<ItemState> {
        let state = self.item(self.item_row(item)?)?.state;
        if let ItemState::Done(placed) = &state {
            self.note(placed);
        }
        Ok(state)
    }
}

/// Encodes the state of a finished item for another process.
pub fn state_to_json(state: &ItemState) -> Value {
    let value = |text: String| serde_json::from_str::<Value>(&text).unwrap_or_default();
    match state {
        ItemState::Queued | ItemState::Running(_) => json!("queued"),
        ItemState::Cancelled => json!("cancelled"),
        ItemState::Done(placed) => json!({ "done": value(to_json(placed)) }),
        ItemState::Failed(why) => json!({ "failed": value(to_json(why)) }),
    }
}

/// Decodes the state that [`state_to_json`] encoded.
///
/// # Errors
/// The value is not such a state.
pub fn state_from_json(value: &Value) -> Result<ItemState> {
    let other = || damaged(LOCATION, &format!("{value} is no state"));
    if let Some(word) = value.as_str() {
        return match word {
            "queued" => Ok(ItemState::Queued),
            "cancelled" => Ok(ItemState::Cancelled),
            _ => Err(other()),
        };
    }
    if let Some(placed) = value.get("done") {
        let placed = from_json(&placed.to_string(), LOCATION)?;
        return Ok(ItemState::Done(Box::new(placed)));
    }
    let why = value.get("failed").ok_or_else(other)?;
    Ok(ItemState::Failed(from_json(&why.to_string(), LOCATION)?))
}

#[cfg(test)]
mod tests {
    use super::{Library, state_from_json, state_to_json};
    use crate::library::{Code, Reason};
    use crate::library::{CollectionSpec, Failure, ItemState, NewShape};
    use crate::mesh::Format;

    const TETRAHEDRON: &str =
        "OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n";

    /// Removes the times of a state, which lose their last bit in JSON.
    fn untimed(state: ItemState) -> ItemState {
        match state {
            ItemState::Done(mut placed) => {
                placed.stages_ms.clear();
                ItemState::Done(placed)
            }
            other => other,
        }
    }

    /// Two libraries over one folder represent two processes.
    #[test]
    fn what_is_placed_beside_is_what_the_holder_would_have_placed() {
        let dirs = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
        let holders = dirs.each_ref().map(|d| Library::open(d.path()).unwrap());
        let beside = Library::open_beside(dirs[0].path()).unwrap();
        for holder in &holders {
            let spec = CollectionSpec {
                name: "c".into(),
                n_parts: Some(1),
                ..CollectionSpec::default()
            };
            holder.create_collection(&spec, None).unwrap();
        }
        for n in 0..4 {
            let shape = NewShape {
                name: format!("s{n}"),
                bytes: TETRAHEDRON
                    .replace("0 0 1\n3", &format!("0 0 {}\n3", n + 1))
                    .into(),
                format: Format::Off,
                replace: false,
            };
            let [first, second] = holders.each_ref().map(|holder| {
                let job = holder
                    .submit(
                        "c",
                        &holder.store_originals(vec![shape.clone()]).unwrap(),
                        None,
                    )
                    .unwrap();
                let described = holder.describe_item(&job.items[0], &|_| true).unwrap();
                (job, described)
            });
            // In between, the holder uses the collection, as corrections do.
            holders[0]
                .name_label("c", 0, &format!("part {n}"), None)
                .ok();
            let ticket = holders[0]
                .placement_ticket(&first.0.items[0], &first.1)
                .unwrap();
            let state = holders[0]
                .with_exclusive("c", || beside.place_ticket(&ticket.words))
                .unwrap();
            let state = state.unwrap();
            assert!(matches!(state, ItemState::Done(_)), "{state:?}");
            let stored = holders[0].item_state(&first.0.items[0]).unwrap();
            assert_eq!(untimed(stored), untimed(state));
            holders[1]
                .place_item(&second.0.items[0], Ok(second.1))
                .unwrap();
        }
        for n in 0..4 {
            let labels = |l: &Library| l.labels("c", &format!("s{n}"), None).unwrap().labels;
            assert_eq!(labels(&holders[0]), labels(&holders[1]));
        }
        assert_eq!(
            holders[0]
                .store()
                .sweep_orphans(std::time::Duration::ZERO)
                .unwrap(),
            [""; 0]
        );
    }

    #[test]
    fn states_come_back() {
        let failed = Failure {
            code: Code::Internal,
            reason: Reason::Panic,
            message: "\"x\"\n".into(),
            subject: None,
        };
        for state in [
            ItemState::Failed(failed),
            ItemState::Cancelled,
            ItemState::Queued,
        ] {
            assert_eq!(state_from_json(&state_to_json(&state)).unwrap(), state);
        }
        assert!(state_from_json(&serde_json::json!("done")).is_err());
    }
}
