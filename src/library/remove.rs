//! Removes shapes.

use super::change::{Change, LabelEdit, commit_once};
use super::collection::{Collection, Staleness, discovered, supervised};
use super::error::Result;
use super::facade::Library;
use super::once::{Request, answered};
use super::pins::{Instead, used_labels};
use super::sources::Sources;
use super::types::{LabelId, RequestKey};
use crate::store::ShapeRow;

impl Library {
    /// Removes a shape with its labels and maps, and subtracts its statistics from the label model.
    /// Labels of other shapes stay, unless the shape was a training shape.
    ///
    /// # Errors
    /// There is no such shape.
    pub fn remove(&self, collection: &str, shape: &str, key: Option<&RequestKey>) -> Result<()> {
        self.store
            .freeing(|| self.remove_once(collection, shape, key))
    }

    fn remove_once(&self, name: &str, shape: &str, key: Option<&RequestKey>) -> Result<()> {
        let request = Request::of(key, &format!("remove {name:?} {shape:?}"));
        let row = self.collection_row(name)?;
        self.with_collection(row, |collection| {
            if answered(&self.store, &request)?.is_some() {
                return Ok(());
            }
            let (_, gone) = self.shape_row(name, shape)?;
            let change = removal(collection, &self.store, &gone)?;
            commit_once(&self.store, collection, change, &request, |_, _| {
                Ok(Vec::new())
            })?;
            Ok(())
        })
    }
}

fn removal(collection: &Collection, sources: &dyn Sources, gone: &ShapeRow) -> Result<Change> {
    let shapes = collection.shapes();
    let was_pinned = collection
        .position(gone.id)
        .is_some_and(|at| shapes[at].pinned);
    let mut change = Change {
        removed: Some((gone.id, gone.name.clone())),
        model: discovered::model_without(collection, sources, gone.id)?,
        state: Some(collection.state().clone()),
        ..Change::default()
    };
    if !was_pinned {
        return Ok(change);
    }
    let refit = supervised::refit(collection, sources, Some(gone.id))?;
    if let Some(supervision) = refit {
        // The next fit retires labels of the model. Those that it never had are gone now.
        let before = used_labels(collection, sources, None)?.labels;
        let removed = Some(Instead::Removed(gone.id));
        let after = used_labels(collection, sources, removed)?.labels;
        let model = collection.label_model();
        let is_new = |label: &&LabelId| model.is_none_or(|m| !m.labels.contains(label));
        let retired = before.difference(&after).filter(is_new);
        change.labels = retired.map(|label| LabelEdit::Retired(*label)).collect();
        change.state = Some(supervised::with(collection, supervision));
        change.staleness = Staleness::All;
    }
    Ok(change)
}
