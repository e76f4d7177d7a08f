//! What a bundle contains, and how its shapes are read like those of a store.

use crate::labels::LabelModel;
use crate::library::collection::Collection;
use crate::library::error::Result;
use crate::library::rows::damaged;
use crate::library::sources::{ArrayFile, Arrays, FileView, Known, Sources};
use crate::library::types::{LabelId, Up};
use crate::pipeline::{Params, Prepared};
use crate::segmentation::Surface;
use crate::store::{
    CollectionId, Digest, LabelRow, LabelVersionRow, LinkEnd, LinkRow, MapRow, MappedDescription,
    PreparedShapes, ShapeId, ShapeRow,
};
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::sync::Arc;

/// The JSON of a bundle's header.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Manifest {
    /// Version of the descriptions.
    pub(super) algorithm: u32,
    /// Kind of processor that the shapes were described on.
    pub(super) processor: String,
    pub(super) collection: String,
    pub(super) sequence: u64,
    pub(super) epoch: u64,
    /// Number of shapes of the collection, which may be more than the bundle has.
    pub(super) n_shapes: u64,
    pub(super) n_parts: Option<u32>,
    pub(super) up: String,
    pub(super) operator: String,
    pub(super) working_faces: u32,
    pub(super) next_ordinal: u64,
    pub(super) next_label: u32,
    /// The state of the collection, as in the catalog.
    pub(super) state: String,
    pub(super) labels: Vec<ManifestLabel>,
    pub(super) links: Vec<ManifestLink>,
    pub(super) shapes: Vec<ManifestShape>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ManifestLabel {
    pub(super) id: u32,
    pub(super) name: Option<String>,
    pub(super) colour: [u8; 3],
    pub(super) merged_into: Option<u32>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ManifestLink {
    pub(super) id: i64,
    pub(super) kind: String,
    pub(super) ends: [ManifestEnd; 2],
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ManifestEnd {
    /// Ordinal of the shape.
    pub(super) shape: u64,
    pub(super) part: u32,
    pub(super) polygons: Vec<u32>,
}

/// A shape that may vote.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ManifestShape {
    pub(super) ordinal: u64,
    pub(super) name: String,
    /// BLAKE3 of the file that was added.
    pub(super) digest: String,
    pub(super) version: u64,
    pub(super) label_epoch: u64,
    /// Whether a person labelled faces of it.
    pub(super) pinned: bool,
}

/// An opened bundle: every byte was compared with its digest. Threads can share it.
pub struct Bundle {
    pub(super) info: BundleInfo,
    pub(super) params: (Params, String),
    pub(super) collection: Collection,
    pub(super) shapes: HashMap<ShapeId, Bundled>,
    pub(super) labels: Vec<LabelRow>,
    pub(super) links: Vec<LinkRow>,
    pub(super) prepared: PreparedShapes,
}

/// What a bundle is.
#[derive(Debug, Clone, PartialEq)]
pub struct BundleInfo {
    /// Names the content of the bundle.
    pub id: Digest,
    /// The collection.
    pub collection: String,
    /// Its sequence number when the bundle was made.
    pub sequence: u64,
    /// Epoch of its labels.
    pub epoch: u64,
    /// Number of its shapes.
    pub n_shapes: u64,
    /// Number of shapes in the bundle: those that may vote.
    pub n_bundled: usize,
    /// The up axis as it was set.
    pub up: Up,
    /// The up axis by which shapes are labelled, if one is known.
    pub axis: Option<[f64; 3]>,
    /// Whether the next shape clusters the collection again, perhaps with other labels.
    pub clusters_next: bool,
    /// Whether the shapes were described on this kind of processor; if not, labels may differ in
    /// rare faces from those that the library would give.
    pub same_processor: bool,
    /// All labels that the collection ever had.
    pub labels: Vec<BundledLabel>,
}

/// A label of a bundle.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BundledLabel {
    /// Its id.
    pub id: LabelId,
    /// A name a person gave.
    pub name: Option<String>,
    /// sRGB colour.
    pub colour: [u8; 3],
    /// The label that it was merged into.
    pub merged_into: Option<LabelId>,
    /// Whether a new shape can have it.
    pub in_use: bool,
}

/// A shape of a bundle.
pub(super) struct Bundled {
    pub(super) row: ShapeRow,
    pub(super) arrays: MappedDescription,
    pub(super) file: Digest,
    pub(super) labels: LabelVersionRow,
    pub(super) pins: Option<Vec<i32>>,
}

impl Bundle {
    /// What the bundle is.
    pub fn info(&self) -> &BundleInfo {
        &self.info
    }

    fn shape(&self, id: ShapeId) -> Result<&Bundled> {
        let found = self.shapes.get(&id);
        found.ok_or_else(|| damaged("bundle", &format!("no shape {id}")))
    }
}

impl std::fmt::Debug for Bundle {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Bundle").field("info", &self.info).finish()
    }
}

impl Bundled {
    fn array_file(&self) -> ArrayFile {
        ArrayFile {
            arrays: Arrays::Mapped(self.arrays.clone()),
            digest: self.file,
        }
    }
}

/// A bundle, and the mesh that is labelled by it.
pub(super) struct Arriving<'a> {
    pub(super) bundle: &'a Bundle,
    pub(super) digest: Digest,
    pub(super) bytes: &'a [u8],
}

impl Sources for Arriving<'_> {
    fn known(&self, id: ShapeId) -> Result<Known> {
        let shape = self.bundle.shape(id)?;
        Ok(Known {
            row: shape.row.clone(),
            arrays: shape.array_file(),
            labels: shape.labels.clone(),
        })
    }

    fn arrays(&self, id: ShapeId) -> Result<ArrayFile> {
        Ok(self.bundle.shape(id)?.array_file())
    }

    fn surface(&self, shape: FileView<'_>) -> Arc<Surface> {
        self.bundle.prepared.surface(&shape.file, &shape.view)
    }

    fn prepared(&self, shape: FileView<'_>, model: &LabelModel) -> Arc<Prepared> {
        self.bundle.prepared.shape(&shape.file, &shape.view, model)
    }

    fn version(&self, id: ShapeId) -> Result<u64> {
        Ok(self.bundle.shape(id)?.row.version)
    }

    fn labels_at(&self, id: ShapeId, version: u64) -> Result<Option<LabelVersionRow>> {
        let shape = self.bundle.shape(id)?;
        Ok((shape.row.version == version).then(|| shape.labels.clone()))
    }

    fn pins(&self, id: ShapeId) -> Result<Option<Vec<i32>>> {
        Ok(self.bundle.shape(id)?.pins.clone())
    }

    fn map(&self, _: ShapeId, _: ShapeId) -> Result<Option<MapRow>> {
        Ok(None)
    }

    fn has_map(&self, _: ShapeId, _: ShapeId) -> Result<bool> {
        Ok(false)
    }

    fn maps_into(&self, _: ShapeId) -> Result<Vec<MapRow>> {
        Ok(Vec::new())
    }

    fn labels(&self, _: CollectionId) -> Result<Vec<LabelRow>> {
        Ok(self.bundle.labels.clone())
    }

    fn links(&self, _: CollectionId) -> Result<Vec<LinkRow>> {
        Ok(self.bundle.links.clone())
    }

    fn original(&self, digest: &Digest) -> Result<Vec<u8>> {
        match *digest == self.digest {
            true => Ok(self.bytes.to_vec()),
            false => Err(damaged("bundle", &format!("no mesh {digest}"))),
        }
    }
}

/// The id of the shape with an ordinal.
pub(super) fn id_of(ordinal: u64) -> ShapeId {
    ShapeId(ordinal as i64)
}

impl ManifestLink {
    pub(super) fn row(self) -> LinkRow {
        LinkRow {
            id: self.id,
            kind: self.kind,
            ends: self.ends.map(|end| LinkEnd {
                shape: id_of(end.shape),
                part: end.part,
                polygons: end.polygons,
            }),
            person: String::new(),
            unix_ms: 0,
        }
    }
}
