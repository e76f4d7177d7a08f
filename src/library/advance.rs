//! A collection is brought towards the labels that follow from it, one committed step at a time.

use super::change::{Change, commit};
use super::collection::state::Phase;
use super::collection::{Collection, Regime, discovered, fit, supervised};
use super::error::Result;
use super::facade::Library;
use crate::store::Store;

impl Library {
    /// Recomputes the labels of one stale shape of the collection, or of any if `None`; false: none
    /// was stale.
    ///
    /// # Errors
    /// There is no such collection, or the store fails.
    pub fn relabel_next(&self, collection: Option<&str>) -> Result<bool> {
        let wanted = collection.map(|name| self.collection_row(name));
        let wanted = wanted.transpose()?;
        let next = self.store.catalog().read(|r| -> Result<_> {
            let Some(shape) = r.next_stale(wanted.map(|c| c.id))? else {
                return Ok(None);
            };
            let row = r.collection_by_id(shape.collection)?;
            Ok(row.map(|row| (row, shape.id)))
        })?;
        let Some((row, id)) = next else {
            return Ok(false);
        };
        self.with_collection(row, |collection| match collection.position(id) {
            Some(at) => relabel(&self.store, collection, at),
            None => Ok(false),
        })
    }
}

/// One step towards the labels of a stale shape: fits the model if the training shapes have
/// changed, otherwise relabels the shape. False: there was nothing to do.
fn relabel(store: &Store, collection: &mut Collection, at: usize) -> Result<bool> {
    let change = match &collection.state().regime {
        Regime::Discovering => discovered::relabel(collection, store, at)?,
        Regime::Supervised(s) if s.phase() == Phase::Fitted => {
            supervised::relabel(collection, store, at)?
        }
        Regime::Supervised(_) => fit::step(collection, store)?,
    };
    taken(store, collection, change)
}

/// Relabels those of some shapes that are stale, while labels are discovered; how many.
pub(super) fn relabel_all(store: &Store, collection: &mut Collection, at: &[usize]) -> Result<u32> {
    let mut n = 0;
    for at in at {
        let change = discovered::relabel(collection, store, *at)?;
        n += u32::from(taken(store, collection, change)?);
    }
    Ok(n)
}

/// Fits the model to the training shapes, if it is not.
pub(super) fn fit_model(store: &Store, collection: &mut Collection) -> Result<()> {
    let is_fitted = |c: &Collection| match c.state().regime.supervision() {
        Some(supervision) => supervision.phase() == Phase::Fitted,
        None => true,
    };
    while !is_fitted(collection) {
        let step = fit::step(collection, store)?;
        if !taken(store, collection, step)? {
            break;
        }
    }
    Ok(())
}

fn taken(store: &Store, collection: &mut Collection, change: Option<Change>) -> Result<bool> {
    match change {
        Some(change) => commit(store, collection, change, |_, _| Ok(true)),
        None => Ok(false),
    }
}
