//! Makes the head of a bundle from a collection, as of one moment.

use super::content::{Manifest, ManifestEnd, ManifestLabel, ManifestLink, ManifestShape};
use super::file::{Array, BundleFile, BundleHead, MODEL, array_name, head};
use crate::library::collection::state::Phase;
use crate::library::collection::{Collection, KnownShape};
use crate::library::error::{LibraryError, Result};
use crate::library::facade::Library;
use crate::library::lookup::{require_collection, require_shape};
use crate::library::placement;
use crate::library::reason::Reason;
use crate::library::rows::{damaged, to_json};
use crate::pipeline::ALGORITHM_VERSION;
use crate::store::{Digest, LinkRow, MappedDescription, ObjectKind, Reader, ShapeId};
use safetensors::tensor::Dtype;
use std::collections::HashMap;

/// Least number of shapes of a collection that can be published while its labels are discovered:
/// below, every shape clusters the collection again.
pub const MIN_DISCOVERED_SHAPES: usize = 5;

impl Library {
    /// Returns the head of a bundle of everything that labels a new shape of a collection now, as
    /// of one moment. [`Library::array_file`] returns the array files that follow it, and
    /// [`write_bundle`](super::write_bundle) writes the whole.
    ///
    /// # Errors
    /// There is no such collection, or it has too few labelled shapes, or shapes wait to be
    /// relabelled.
    pub fn bundle_head(&self, collection: &str) -> Result<BundleHead> {
        self.store.catalog().read(|r| {
            let row = require_collection(r, collection)?;
            let collection = Collection::load(r, row)?;
            check(&collection)?;
            head_of(r, &collection)
        })
    }

    /// Maps the array file with this BLAKE3 of a shape.
    ///
    /// # Errors
    /// There is no such shape, its array file is damaged, or it is another one meanwhile.
    pub fn array_file(
        &self,
        collection: &str,
        shape: &str,
        blake3: &Digest,
    ) -> Result<MappedDescription> {
        let object = self.store.catalog().read(|r| -> Result<_> {
            let (_, row) = require_shape(r, collection, shape)?;
            let object = r.object(ObjectKind::Description, &row.description_digest)?;
            object.ok_or_else(|| damaged("objects", &format!("no row for {shape:?}")))
        })?;
        if object.blake3 != *blake3 {
            return Err(LibraryError::FailedPrecondition {
                reason: Reason::Gone,
                message: format!(
                    "shape {shape:?} of collection {collection:?} has another array file than \
                     {blake3}: it was replaced meanwhile; publish the collection again"
                ),
            });
        }
        Ok(self.store.objects().open_description(&object)?)
    }
}

/// Refuses a collection that cannot label a new shape as it is.
fn check(collection: &Collection) -> Result<()> {
    let refused = |why: String| {
        let name = &collection.row().name;
        Err(LibraryError::FailedPrecondition {
            reason: Reason::NotPublishable,
            message: format!("collection {name:?} cannot be published: {why}"),
        })
    };
    let n_shapes = collection.shapes().len();
    let supervision = collection.state().regime.supervision();
    if collection.model().is_none() || n_shapes == 0 {
        return refused("it has no labelled shape; add shapes first".into());
    }
    if supervision.is_none() && n_shapes < MIN_DISCOVERED_SHAPES {
        return refused(format!(
            "it has {n_shapes} shapes, and below {MIN_DISCOVERED_SHAPES} every new one changes the \
             discovered labels; add shapes, or label one by hand"
        ));
    }
    let n_stale = collection.shapes().iter().filter(|s| s.stale).count();
    if n_stale > 0 || supervision.is_some_and(|s| s.phase() != Phase::Fitted) {
        return refused(format!(
            "{n_stale} of its shapes wait to be relabelled; wait until it is idle (`coseg wait`), \
             then publish it"
        ));
    }
    Ok(())
}

/// Returns the shapes that may vote for a new one: all of them or, after a person labelled faces,
/// those with such faces and those to which the model was fitted.
fn voters(collection: &Collection) -> Vec<&KnownShape> {
    let supervision = collection.state().regime.supervision();
    let may_vote = |shape: &&KnownShape| match supervision {
        None => true,
        Some(s) => shape.pinned || s.trained().contains(&shape.ordinal),
    };
    collection.shapes().iter().filter(may_vote).collect()
}

fn head_of(r: &Reader<'_>, collection: &Collection) -> Result<BundleHead> {
    let row = collection.row();
    let gone = || damaged("collections", &format!("{:?} has no model", row.name));
    let model = collection.model().ok_or_else(gone)?;
    let mut arrays = vec![Array {
        name: MODEL.into(),
        dtype: Dtype::U8,
        bytes: model.encode(),
    }];
    let described = r.descriptions(row.id)?;
    let described: HashMap<ShapeId, _> = described.into_iter().map(|d| (d.shape, d)).collect();
    let (mut shapes, mut files) = (Vec::new(), Vec::new());
    for shape in voters(collection) {
        let lost = |what: &str| damaged("shapes", &format!("{what} of row {} is gone", shape.id));
        let row = r.shape(shape.id)?.ok_or_else(|| lost("name"))?;
        let found = described.get(&shape.id);
        let object = &found.ok_or_else(|| lost("description"))?.object;
        let labels = r.newest_labels(shape.id)?;
        let labels = labels.ok_or_else(|| lost("newest labels"))?;
        let mut array = |what: &str, dtype, bytes| {
            let name = array_name(shape.ordinal, what);
            arrays.push(Array { name, dtype, bytes });
        };
        array("labels", Dtype::I32, bytes_of(&labels.proxy_labels));
        array("probabilities", Dtype::U8, labels.proxy_probabilities);
        if shape.pinned {
            let pins = r.pins(shape.id)?.ok_or_else(|| lost("pins"))?;
            array("pins", Dtype::I32, bytes_of(&pins));
        }
        files.push((
            shape.ordinal,
            BundleFile {
                shape: row.name.clone(),
                blake3: object.blake3,
                length: object.length,
            },
        ));
        shapes.push(ManifestShape {
            ordinal: shape.ordinal,
            name: row.name,
            digest: shape.digest.to_string(),
            version: row.version,
            label_epoch: row.label_epoch,
            pinned: shape.pinned,
        });
    }
    let manifest = manifest(r, collection, shapes)?;
    let (bytes, id, n_bytes) = head(&to_json(&manifest), arrays, &files);
    Ok(BundleHead {
        bytes,
        files: files.into_iter().map(|(_, file)| file).collect(),
        id,
        sequence: row.sequence,
        epoch: model.model.epoch,
        n_bytes,
        clusters_next: placement::clusters(collection),
    })
}

fn manifest(
    r: &Reader<'_>,
    collection: &Collection,
    shapes: Vec<ManifestShape>,
) -> Result<Manifest> {
    let row = collection.row();
    let location = format!("collections {}", row.name);
    let state = String::from_utf8(row.state.clone());
    let labels = r.labels(row.id)?.into_iter().map(|l| ManifestLabel {
        id: l.id,
        name: l.name,
        colour: l.colour,
        merged_into: l.merged_into,
    });
    // Links decide how shapes are clustered; a fitted model has learnt from them.
    let links = match collection.state().regime.supervision() {
        None => r.links(row.id)?,
        Some(_) => Vec::new(),
    };
    let links = links.into_iter().map(|link| linked(collection, link));
    Ok(Manifest {
        algorithm: ALGORITHM_VERSION,
        processor: processor(),
        collection: row.name.clone(),
        sequence: row.sequence,
        epoch: row.epoch,
        n_shapes: collection.shapes().len() as u64,
        n_parts: row.n_parts,
        up: row.up.clone(),
        operator: row.operator.clone(),
        working_faces: row.working_faces,
        next_ordinal: row.next_ordinal,
        next_label: row.next_label,
        state: state.map_err(|e| damaged(&location, &e.to_string()))?,
        labels: labels.collect(),
        links: links.collect::<Result<_>>()?,
        shapes,
    })
}

fn linked(collection: &Collection, link: LinkRow) -> Result<ManifestLink> {
    let [a, b] = link.ends.map(|end| {
        let at = collection.position(end.shape);
        let at = at.ok_or_else(|| damaged("links", &format!("no shape {}", end.shape)))?;
        Ok::<_, LibraryError>(ManifestEnd {
            shape: collection.shapes()[at].ordinal,
            part: end.part,
            polygons: end.polygons,
        })
    });
    Ok(ManifestLink {
        id: link.id,
        kind: link.kind,
        ends: [a?, b?],
    })
}

/// The kind of this processor, as far as it decides bits: the instruction set that kernels choose.
pub(super) fn processor() -> String {
    format!("{:?}", pulp::Arch::new())
}

fn bytes_of(values: &[i32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}
