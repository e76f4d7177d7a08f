//! Writes edits of the links between parts.

use super::log::event;
use crate::library::error::Result;
use crate::library::event::EventKind;
use crate::library::linked::{LinkKind, PartName};
use crate::store::{CollectionId, LinkRow, Tx};

/// An edit of the links between parts of a collection.
#[derive(Debug)]
pub(in crate::library) enum LinkEdit {
    /// A person makes a link.
    Made {
        row: LinkRow,
        kind: LinkKind,
        parts: [PartName; 2],
    },
    /// A person removes a link.
    Removed { row: LinkRow },
    /// A link that was made is taken back.
    TakenBack { id: i64 },
    /// A link that was removed is restored.
    Restored { row: LinkRow },
}

impl LinkEdit {
    pub(super) fn write(&self, tx: &Tx<'_>, collection: CollectionId) -> Result<()> {
        match self {
            Self::Made { row, kind, parts } => {
                let made = EventKind::PartsLinked {
                    link: tx.insert_link(collection, row)?.unsigned_abs(),
                    kind: *kind,
                    parts: parts.clone(),
                };
                event(tx, collection, &made)?;
            }
            Self::Removed { row } => {
                tx.delete_link(row.id)?;
                let link = row.id.unsigned_abs();
                event(tx, collection, &EventKind::PartsUnlinked { link })?;
            }
            Self::TakenBack { id } => tx.delete_link(*id)?,
            Self::Restored { row } => {
                tx.insert_link(collection, row)?;
            }
        }
        Ok(())
    }
}
