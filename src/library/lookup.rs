//! Looks up rows by name. If there is none, the error suggests the name that was probably meant.

use super::error::{LibraryError, Named, Result};
use super::sources::object;
use crate::store::{CollectionRow, Digest, ObjectKind, Reader, ShapeRow, Store};

/// Maximum number of names among which a suggestion is sought, so that a wrong name costs little in
/// any library.
const MAX_COMPARED: u32 = 5_000;

/// Returns the collection of this name. If there is none, the error suggests another name.
pub(super) fn require_collection(reader: &Reader<'_>, name: &str) -> Result<CollectionRow> {
    if let Some(row) = reader.collection(name)? {
        return Ok(row);
    }
    let known = reader.collection_names(MAX_COMPARED)?;
    Err(LibraryError::none_of(Named::Collection, name, &known))
}

/// Returns a collection and a shape of it by their names.
pub(super) fn require_shape(
    reader: &Reader<'_>,
    collection: &str,
    shape: &str,
) -> Result<(CollectionRow, ShapeRow)> {
    let row = require_collection(reader, collection)?;
    match reader.shape_by_name(row.id, shape)? {
        Some(found) => Ok((row, found)),
        None => {
            let known = reader.shape_names(row.id, MAX_COMPARED)?;
            Err(LibraryError::none_of(Named::Shape, shape, &known))
        }
    }
}

/// Returns the number of bytes in the file of a stored mesh.
pub(super) fn object_length(store: &Store, original: &Digest) -> Result<u64> {
    Ok(object(store, ObjectKind::Original, original)?.length)
}
