//! What is read of stored shapes in order to label others: from a store, or from memory in a test.

use super::error::{LibraryError, Result};
use super::rows::damaged;
use crate::description::DescriptionView;
use crate::store::{
    CollectionId, Digest, LabelRow, LabelVersionRow, MapRow, MappedDescription, ObjectKind,
    ObjectRow, ShapeId, ShapeRow, Store,
};

/// The arrays of a stored shape.
#[derive(Debug)]
pub(super) enum Arrays {
    /// Mapped from its file.
    Mapped(MappedDescription),
    /// In memory.
    #[cfg(test)]
    Owned(Box<crate::description::Description>),
}

/// A stored shape: its row, its arrays and its newest labels, as of one moment.
#[derive(Debug)]
pub(super) struct Known {
    pub(super) row: ShapeRow,
    pub(super) arrays: Arrays,
    pub(super) labels: LabelVersionRow,
}

impl Known {
    /// The arrays.
    pub(super) fn view(&self) -> DescriptionView<'_> {
        match &self.arrays {
            Arrays::Mapped(mapped) => mapped.view(),
            #[cfg(test)]
            Arrays::Owned(description) => description.view(),
        }
    }
}

/// Reads stored shapes with their labels, pins and maps. Nothing here writes.
pub(super) trait Sources: Sync {
    /// A shape with its arrays and newest labels.
    fn known(&self, id: ShapeId) -> Result<Known>;
    /// Version of a shape's newest labels; 0 if there is no such shape.
    fn version(&self, id: ShapeId) -> Result<u64>;
    /// One version of a shape's labels, if it is still stored.
    fn labels_at(&self, id: ShapeId, version: u64) -> Result<Option<LabelVersionRow>>;
    /// The label of each polygon that a person labelled, -1 elsewhere; `None` if nothing is pinned.
    fn pins(&self, id: ShapeId) -> Result<Option<Vec<i32>>>;
    /// The stored map from one shape to another.
    fn map(&self, from: ShapeId, to: ShapeId) -> Result<Option<MapRow>>;
    /// All stored maps to a shape.
    fn maps_into(&self, to: ShapeId) -> Result<Vec<MapRow>>;
    /// The labels of a collection.
    fn labels(&self, collection: CollectionId) -> Result<Vec<LabelRow>>;
    /// The bytes of a mesh file by their digest.
    fn original(&self, digest: &Digest) -> Result<Vec<u8>>;
}

impl Sources for Store {
    fn known(&self, id: ShapeId) -> Result<Known> {
        let (row, mapped, labels) = mapped_shape(self, id)?;
        let arrays = Arrays::Mapped(mapped);
        Ok(Known {
            row,
            arrays,
            labels,
        })
    }

    fn version(&self, id: ShapeId) -> Result<u64> {
        let row = self.catalog().read(|r| r.shape(id))?;
        Ok(row.map_or(0, |row| row.version))
    }

    fn labels_at(&self, id: ShapeId, version: u64) -> Result<Option<LabelVersionRow>> {
        Ok(self.catalog().read(|r| r.labels_at(id, version))?)
    }

    fn pins(&self, id: ShapeId) -> Result<Option<Vec<i32>>> {
        Ok(self.catalog().read(|r| r.pins(id))?)
    }

    fn map(&self, from: ShapeId, to: ShapeId) -> Result<Option<MapRow>> {
        Ok(self.catalog().read(|r| r.map(from, to))?)
    }

    fn maps_into(&self, to: ShapeId) -> Result<Vec<MapRow>> {
        Ok(self.catalog().read(|r| r.maps_into(to))?)
    }

    fn labels(&self, collection: CollectionId) -> Result<Vec<LabelRow>> {
        Ok(self.catalog().read(|r| r.labels(collection))?)
    }

    fn original(&self, digest: &Digest) -> Result<Vec<u8>> {
        let row = object(self, ObjectKind::Original, digest)?;
        Ok(self.objects().original(&row)?)
    }
}

/// A shape with its mapped arrays and newest labels.
pub(super) fn mapped_shape(
    store: &Store,
    id: ShapeId,
) -> Result<(ShapeRow, MappedDescription, LabelVersionRow)> {
    let gone = |what: &str| damaged("shapes", &format!("{what} of row {id} is gone"));
    let (row, object, labels) = store.catalog().read(|r| -> Result<_> {
        let row = r.shape(id)?.ok_or_else(|| gone("name"))?;
        let object = r.object(ObjectKind::Description, &row.description_digest)?;
        let labels = r.newest_labels(id)?.ok_or_else(|| gone("newest labels"))?;
        Ok((row, object.ok_or_else(|| gone("description"))?, labels))
    })?;
    Ok((row, store.objects().open_description(&object)?, labels))
}

/// The row of an object file that must be there.
pub(super) fn object(store: &Store, kind: ObjectKind, digest: &Digest) -> Result<ObjectRow> {
    let catalog = store.catalog();
    let row = catalog.read(|r| r.object(kind, digest).map_err(LibraryError::from))?;
    row.ok_or_else(|| damaged("objects", &format!("no row for {digest}")))
}
