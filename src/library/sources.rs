//! Reads the stored shapes from which others are labelled: from a store, or from memory in a test.

use super::error::{LibraryError, Result};
use super::rows::damaged;
use crate::description::DescriptionView;
use crate::labels::LabelModel;
use crate::pipeline::Prepared;
use crate::segmentation::Surface;
use crate::store::{
    CollectionId, Digest, LabelRow, LabelVersionRow, LinkRow, MapRow, MappedDescription,
    ObjectKind, ObjectRow, Reader, ShapeId, ShapeRow, Store,
};
use std::sync::Arc;

/// The arrays of a stored shape.
#[derive(Debug)]
pub(super) enum Arrays {
    /// Mapped from its file.
    Mapped(MappedDescription),
    /// In memory.
    #[cfg(test)]
    Owned(Box<crate::description::Description>),
}

/// The arrays of a shape, stored or about to be.
#[derive(Debug, Clone, Copy)]
pub(super) struct FileView<'a> {
    pub(super) view: DescriptionView<'a>,
    /// BLAKE3 of the array file that holds them.
    pub(super) file: Digest,
}

/// The array file of a stored shape.
#[derive(Debug)]
pub(super) struct ArrayFile {
    pub(super) arrays: Arrays,
    /// BLAKE3 of the file.
    pub(super) digest: Digest,
}

/// A stored shape: its row, its arrays and its newest labels, as of one moment.
#[derive(Debug)]
pub(super) struct Known {
    pub(super) row: ShapeRow,
    pub(super) arrays: ArrayFile,
    pub(super) labels: LabelVersionRow,
}

impl ArrayFile {
    pub(super) fn view(&self) -> FileView<'_> {
        let view = match &self.arrays {
            Arrays::Mapped(mapped) => mapped.view(),
            #[cfg(test)]
            Arrays::Owned(description) => description.view(),
        };
        let file = self.digest;
        FileView { view, file }
    }
}

impl Known {
    /// The arrays.
    pub(super) fn view(&self) -> DescriptionView<'_> {
        self.arrays.view().view
    }

    /// The arrays and the digest of their file.
    pub(super) fn file(&self) -> FileView<'_> {
        self.arrays.view()
    }
}

/// Reads stored shapes with their labels, pins and maps. Nothing here writes.
pub(super) trait Sources: Sync {
    /// A shape with its arrays and newest labels.
    fn known(&self, id: ShapeId) -> Result<Known>;
    /// The arrays of a shape.
    fn arrays(&self, id: ShapeId) -> Result<ArrayFile>;
    /// The surface of a shape's proxy.
    fn surface(&self, shape: FileView<'_>) -> Arc<Surface>;
    /// A shape prepared under a model.
    fn prepared(&self, shape: FileView<'_>, model: &LabelModel) -> Arc<Prepared>;
    /// Version of a shape's newest labels; 0 if there is no such shape.
    fn version(&self, id: ShapeId) -> Result<u64>;
    /// One version of a shape's labels, if it is still stored.
    fn labels_at(&self, id: ShapeId, version: u64) -> Result<Option<LabelVersionRow>>;
    /// The label of each polygon that a person labelled, -1 elsewhere; `None` if nothing is pinned.
    fn pins(&self, id: ShapeId) -> Result<Option<Vec<i32>>>;
    /// The stored map from one shape to another.
    fn map(&self, from: ShapeId, to: ShapeId) -> Result<Option<MapRow>>;
    /// Whether the map from one shape to another is stored.
    fn has_map(&self, from: ShapeId, to: ShapeId) -> Result<bool>;
    /// All stored maps to a shape.
    fn maps_into(&self, to: ShapeId) -> Result<Vec<MapRow>>;
    /// The labels of a collection.
    fn labels(&self, collection: CollectionId) -> Result<Vec<LabelRow>>;
    /// The links between parts of a collection, the oldest first.
    fn links(&self, collection: CollectionId) -> Result<Vec<LinkRow>>;
    /// The bytes of a mesh file by their digest.
    fn original(&self, digest: &Digest) -> Result<Vec<u8>>;
}

impl Sources for Store {
    fn known(&self, id: ShapeId) -> Result<Known> {
        let (row, object, labels) = labelled_shape(self, id)?;
        Ok(Known {
            row,
            arrays: array_file(self, &object)?,
            labels,
        })
    }

    fn arrays(&self, id: ShapeId) -> Result<ArrayFile> {
        let (_, object) = self.catalog().read(|r| described_shape(r, id))?;
        array_file(self, &object)
    }

    fn surface(&self, shape: FileView<'_>) -> Arc<Surface> {
        Store::prepared(self).surface(&shape.file, &shape.view)
    }

    fn prepared(&self, shape: FileView<'_>, model: &LabelModel) -> Arc<Prepared> {
        Store::prepared(self).shape(&shape.file, &shape.view, model)
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

    fn has_map(&self, from: ShapeId, to: ShapeId) -> Result<bool> {
        Ok(self.catalog().read(|r| r.has_map(from, to))?)
    }

    fn maps_into(&self, to: ShapeId) -> Result<Vec<MapRow>> {
        Ok(self.catalog().read(|r| r.maps_into(to))?)
    }

    fn labels(&self, collection: CollectionId) -> Result<Vec<LabelRow>> {
        Ok(self.catalog().read(|r| r.labels(collection))?)
    }

    fn links(&self, collection: CollectionId) -> Result<Vec<LinkRow>> {
        Ok(self.catalog().read(|r| r.links(collection))?)
    }

    fn original(&self, digest: &Digest) -> Result<Vec<u8>> {
        let row = object(self, ObjectKind::Original, digest)?;
        Ok(self.objects().original(&row)?)
    }
}

/// Returns a shape with its mapped arrays and newest labels.
pub(super) fn mapped_shape(
    store: &Store,
    id: ShapeId,
) -> Result<(ShapeRow, MappedDescription, LabelVersionRow)> {
    let (row, object, labels) = labelled_shape(store, id)?;
    Ok((row, store.objects().open_description(&object)?, labels))
}

/// Returns the rows of a shape, of its array file and of its newest labels.
fn labelled_shape(store: &Store, id: ShapeId) -> Result<(ShapeRow, ObjectRow, LabelVersionRow)> {
    let gone = || damaged("shapes", &format!("newest labels of row {id} is gone"));
    store.catalog().read(|r| {
        let (row, object) = described_shape(r, id)?;
        let labels = r.newest_labels(id)?.ok_or_else(gone)?;
        Ok((row, object, labels))
    })
}

/// Returns the rows of a shape and of its array file.
fn described_shape(reader: &Reader<'_>, id: ShapeId) -> Result<(ShapeRow, ObjectRow)> {
    let gone = |what: &str| damaged("shapes", &format!("{what} of row {id} is gone"));
    let row = reader.shape(id)?.ok_or_else(|| gone("name"))?;
    let object = reader.object(ObjectKind::Description, &row.description_digest)?;
    Ok((row, object.ok_or_else(|| gone("description"))?))
}

fn array_file(store: &Store, object: &ObjectRow) -> Result<ArrayFile> {
    let mapped = store.objects().open_description(object)?;
    Ok(ArrayFile {
        arrays: Arrays::Mapped(mapped),
        digest: object.blake3,
    })
}

/// Returns the row of an object file that must exist.
pub(super) fn object(store: &Store, kind: ObjectKind, digest: &Digest) -> Result<ObjectRow> {
    let catalog = store.catalog();
    let row = catalog.read(|r| r.object(kind, digest).map_err(LibraryError::from))?;
    row.ok_or_else(|| damaged("objects", &format!("no row for {digest}")))
}
