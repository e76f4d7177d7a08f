//! Recomputes outdated labels and models of a collection, one committed step at a time.

use super::change::{Change, commit};
use super::collection::state::Phase;
use super::collection::{Collection, Regime, discovered, fit, supervised};
use super::error::Result;
use super::facade::Library;
use crate::store::Store;
use rayon::prelude::*;

/// Maximum number of stale shapes that [`Library::relabel_batch`] relabels. It is enough for all
/// processors and for one sync to matter little, and takes less than a second on two processors.
pub const MAX_BATCH: usize = 16;
/// Maximum number of polygons of all shapes of a batch. Each of them is read and cleaned in memory
/// to refine its boundaries. A larger shape is a batch of its own.
const MAX_BATCH_POLYGONS: u64 = 500_000;

impl Library {
    /// Recomputes the labels of one stale shape of the collection, or of any collection if `None`.
    /// Returns false if no shape was stale.
    ///
    /// # Errors
    /// There is no such collection, or the store fails.
    pub fn relabel_next(&self, collection: Option<&str>) -> Result<bool> {
        Ok(self.relabel_batch(collection, 1)? > 0)
    }

    /// Recomputes the labels of up to `most` stale shapes of the collection, or of one that has any
    /// if `None`, in parallel, and commits them together. Returns their number, where a step of
    /// fitting the model counts as one; 0 if no shape was stale. The labels do not depend on
    /// `most`.
    ///
    /// # Errors
    /// There is no such collection, or the store fails. A shape that cannot be relabelled is an
    /// error once it is the first of the stale shapes.
    pub fn relabel_batch(&self, collection: Option<&str>, most: usize) -> Result<usize> {
        self.relabel_first(collection, most, &[])
    }

    /// Does what [`Library::relabel_batch`] does, beginning with the stale ones of the shapes
    /// `first`, in their order. Names of other shapes mean nothing. The final labels do not depend
    /// on `first`.
    ///
    /// # Errors
    /// Those of [`Library::relabel_batch`].
    pub fn relabel_first(
        &self,
        collection: Option<&str>,
        most: usize,
        first: &[String],
    ) -> Result<usize> {
        let named = first;
        let wanted = collection.map(|name| self.collection_row(name));
        let wanted = wanted.transpose()?;
        let catalog = self.store.catalog();
        let next = catalog.read(|r| -> Result<_> {
            let Some(shape) = r.next_stale(wanted.map(|c| c.id))? else {
                return Ok(None);
            };
            let row = r.collection_by_id(shape.collection)?;
            Ok(row.map(|row| (row, shape.id)))
        })?;
        let Some((row, first)) = next else {
            return Ok(0);
        };
        self.with_collection(row, |collection| {
            let Some(first) = collection.position(first) else {
                return Ok(0);
            };
            if let Regime::Supervised(s) = &collection.state().regime
                && s.phase() != Phase::Fitted
            {
                let step = fit::step(collection, &self.store)?;
                return Ok(usize::from(taken(&self.store, collection, step)?));
            }
            let batch = self.batch(collection, (first, named), most)?;
            relabel(&self.store, collection, &batch)
        })
    }

    /// Returns the indices of up to `most` stale shapes: those that are named, then those from the
    /// one at `first` on.
    fn batch(
        &self,
        collection: &Collection,
        (first, named): (usize, &[String]),
        most: usize,
    ) -> Result<Vec<usize>> {
        let shapes = collection.shapes();
        let catalog = self.store.catalog();
        let mut wanted = catalog.read(|r| -> Result<Vec<usize>> {
            let mut found = Vec::new();
            for name in named {
                let row = r.shape_by_name(collection.id(), name)?;
                let at = row.and_then(|row| collection.position(row.id));
                found.extend(at.filter(|at| shapes[*at].stale && !found.contains(at)));
            }
            Ok(found)
        })?;
        let others = (first..shapes.len()).filter(|at| shapes[*at].stale && !wanted.contains(at));
        let others: Vec<usize> = others.take(most).collect();
        wanted.extend(others);
        let (mut batch, mut n_polygons) = (Vec::new(), 0);
        for at in wanted.into_iter().take(most) {
            let row = catalog.read(|r| r.shape(shapes[at].id))?;
            n_polygons += row.map_or(0, |row| row.n_polygons);
            if n_polygons > MAX_BATCH_POLYGONS && !batch.is_empty() {
                break;
            }
            batch.push(at);
        }
        Ok(batch)
    }
}

/// Relabels stale shapes in parallel, commits them together in this order, and returns their
/// number. They are independent of each other, because only shapes vote that are not stale, or that
/// have labels from a person.
fn relabel(store: &Store, collection: &mut Collection, batch: &[usize]) -> Result<usize> {
    let is_supervised = collection.state().regime.supervision().is_some();
    let relabelled = batch.par_iter().map(|at| match is_supervised {
        true => supervised::relabel(collection, store, *at),
        false => discovered::relabel(collection, store, *at),
    });
    let results: Vec<Result<Option<Change>>> = relabelled.collect();
    let (mut n, mut all) = (0, Change::default());
    for (at, result) in results.into_iter().enumerate() {
        match result {
            Ok(Some(change)) => {
                n += 1;
                all.join(change);
            }
            Ok(None) => {}
            Err(error) if at == 0 => return Err(error),
            // The shapes before it are labelled; the next batch begins with it.
            Err(_) => break,
        }
    }
    if n > 0 {
        commit(store, collection, all, |_, _| Ok(()))?;
    }
    Ok(n)
}

/// Relabels those of some shapes that are stale, while labels are discovered. Returns their number.
pub(super) fn relabel_all(store: &Store, collection: &mut Collection, at: &[usize]) -> Result<u32> {
    let mut n = 0;
    for at in at {
        let change = discovered::relabel(collection, store, *at)?;
        n += u32::from(taken(store, collection, change)?);
    }
    Ok(n)
}

/// Fits the model to the training shapes, if it is out of date.
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
