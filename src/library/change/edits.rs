//! Writes edits of a collection's labels, each with its event.

use super::log::event;
use crate::library::error::Result;
use crate::library::event::EventKind;
use crate::library::rows::label_colour;
use crate::library::types::LabelId;
use crate::pipeline::LabelChange;
use crate::store::{CollectionId, LabelRow, Tx};

/// An edit of a label of the collection.
#[derive(Debug)]
pub(in crate::library) enum LabelEdit {
    /// A label is created, merged or split.
    Changed(LabelChange),
    /// A person uses the label; it is created if it does not exist.
    Used(LabelId),
    /// The label is no longer in use.
    Retired(LabelId),
    /// The label gets a name.
    Named(LabelRow, String),
    /// The label is restored to an earlier state.
    Restored(LabelRow),
}

impl From<LabelChange> for LabelEdit {
    fn from(change: LabelChange) -> Self {
        Self::Changed(change)
    }
}

impl LabelEdit {
    pub(super) fn write(&self, tx: &Tx<'_>, collection: CollectionId) -> Result<()> {
        match self {
            Self::Changed(change) => label_change(tx, collection, change),
            Self::Used(id) => use_label(tx, collection, *id),
            Self::Retired(label) => {
                event(tx, collection, &EventKind::LabelRetired { label: *label })?;
                Ok(())
            }
            Self::Named(row, name) => {
                let named = LabelRow {
                    name: Some(name.clone()),
                    ..row.clone()
                };
                tx.put_label(collection, &named)?;
                let named = EventKind::LabelNamed {
                    label: row.id,
                    name: name.clone(),
                };
                event(tx, collection, &named)?;
                Ok(())
            }
            Self::Restored(row) => Ok(tx.put_label(collection, row)?),
        }
    }
}

fn label_change(tx: &Tx<'_>, collection: CollectionId, change: &LabelChange) -> Result<()> {
    match *change {
        LabelChange::Created(id) => {
            let taken = tx.take_labels(collection, 1)?;
            assert_eq!(
                taken, id,
                "invariant: new labels are numbered as they are created"
            );
            tx.put_label(collection, &new_label(id))?;
            event(tx, collection, &EventKind::LabelCreated { label: id })?;
        }
        LabelChange::Merged { from, into } => {
            if let Some(row) = tx.labels(collection)?.into_iter().find(|l| l.id == from) {
                let merged = LabelRow {
                    merged_into: Some(into),
                    ..row
                };
                tx.put_label(collection, &merged)?;
            }
            event(tx, collection, &EventKind::LabelMerged { from, into })?;
        }
        LabelChange::Split { from, into } => {
            let into = vec![into];
            event(tx, collection, &EventKind::LabelSplit { from, into })?;
        }
    }
    Ok(())
}

/// Puts a label into use that a person named by its id.
fn use_label(tx: &Tx<'_>, collection: CollectionId, id: LabelId) -> Result<()> {
    let there = tx.labels(collection)?.into_iter().find(|l| l.id == id);
    let row = match there {
        // Faces that were merged into another label keep that label.
        Some(row) => LabelRow {
            merged_into: None,
            ..row
        },
        None => new_label(id),
    };
    tx.reserve_label(collection, id)?;
    tx.put_label(collection, &row)?;
    event(tx, collection, &EventKind::LabelCreated { label: id })?;
    Ok(())
}

fn new_label(id: LabelId) -> LabelRow {
    LabelRow {
        id,
        name: None,
        colour: label_colour(id),
        merged_into: None,
    }
}
