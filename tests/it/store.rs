//! Tests the store through its public interface: round trips, faults, crashes, damage.

mod array_files;
mod catalog;
mod crash;
mod damage;
mod jobs;
mod log;
mod model;
mod readers;
mod space;

use coseg::mesh::CleanReport;
use coseg::pipeline::Description;
use coseg::store::rows::{
    CollectionId, LabelRow, LabelSummary, LabelVersionRow, MapRow, NewCollection, NewJobItem,
    NewShapeRow, RequestRow, ShapeId, confidence_to_u8,
};
use coseg::store::{Digest, Store, StoreError};

/// A description of `n` vertices on a strip, its values a function of `seed`.
pub(crate) fn description(n: usize, seed: u32) -> Description {
    let value = |i: usize| ((i as u32).wrapping_mul(2_654_435_761) ^ seed) as f32 / 4e9 - 0.5;
    let values = |count: usize| (0..count).map(value).collect::<Vec<_>>();
    let m = n - 2;
    let n_polygons = 2 * m + 1;
    Description {
        area: 3.25 + f64::from(seed),
        report: CleanReport {
            n_polygons,
            n_triangles: 2 * m + 2,
            n_vertices: n + 1,
            n_isolated_vertices: 1,
            n_components: 1,
            n_proxy_faces: m,
            n_proxy_vertices: n,
            n_bridges: seed as usize,
            ..CleanReport::default()
        },
        vertices: (0..n)
            .map(|i| [value(i), value(i + n), value(i + 2 * n)])
            .collect(),
        faces: (0..m as u32).map(|i| [i, i + 1, i + 2]).collect(),
        mass: values(n),
        eigenvalues: (0..7)
            .map(|i| f64::from(i) * 1.1 + f64::from(seed))
            .collect(),
        eigenvectors: values(n * 5),
        n_eigenvectors: 5,
        hks: values(n * 100),
        face_descriptors: values(m * 9),
        n_descriptors: 9,
        patches: (0..m as u32).map(|i| i / 3).collect(),
        face_map: (0..n_polygons).map(|i| (i / 2 % m) as u32).collect(),
        polygon_area: values(n_polygons),
        signature: values(11),
    }
}

/// A new library in a folder of its own.
fn opened() -> (tempfile::TempDir, Store) {
    let dir = tempfile::tempdir().expect("a folder");
    let store = Store::open(&dir.path().join("deep/library")).expect("opens");
    (dir, store)
}

const PARAMS: &str = r#"{"operator":"tufted","working_faces":2500}"#;

fn new_collection(name: &str) -> NewCollection {
    NewCollection {
        name: name.into(),
        n_parts: Some(3),
        up: "+y".into(),
        operator: "tufted".into(),
        working_faces: 2_500,
        state: b"state".to_vec(),
    }
}

fn label_version(shape: &Description, version: u64, sequence: u64) -> LabelVersionRow {
    let label = |i: usize| (i as u64 * 7 + version).rem_euclid(4) as i32 - 1;
    let (m, n_polygons) = (shape.faces.len(), shape.face_map.len());
    LabelVersionRow {
        version,
        sequence,
        cause: "added".into(),
        proxy_labels: (0..m).map(label).collect(),
        proxy_probabilities: (0..3 * m)
            .map(|i| confidence_to_u8(i as f32 / m as f32))
            .collect(),
        polygon_labels: (0..n_polygons).map(label).collect(),
        polygon_confidence: vec![200; n_polygons],
        sources_json: r#"[{"shape":"a","version":1,"weight":1.0}]"#.into(),
    }
}

fn summary(label_epoch: u64, labels: &[u32]) -> LabelSummary {
    let share = 1.0 / labels.len().max(1) as f64;
    LabelSummary {
        label_epoch,
        parts_json: r#"[{"label":0,"area_share":1.0,"confidence":0.5}]"#.into(),
        area_shares: labels.iter().map(|&label| (label, share)).collect(),
    }
}

/// Commits one shape like a library: objects, then everything else in one transaction.
fn add_shape(
    store: &Store,
    collection: &str,
    name: &str,
    seed: u32,
) -> Result<ShapeId, StoreError> {
    let description = description(20 + seed as usize % 5, seed);
    let bytes = format!("OFF {collection} {name} {seed}").into_bytes();
    let original = store.objects().put_original(&bytes)?;
    let digest = Digest::of_description(&original.digest, PARAMS, "1 scalar");
    let arrays = store
        .objects()
        .put_description(digest, &description, PARAMS)?;
    store.catalog().write(|tx| {
        tx.insert_object(&original)?;
        tx.insert_object(&arrays)?;
        let collection = match tx.collection(collection)? {
            Some(row) => row.id,
            None => {
                let id = tx.insert_collection(&new_collection(collection))?;
                for label in 0..3 {
                    let id_in_use = tx.take_labels(id, 1)?;
                    assert_eq!(id_in_use, label);
                    let colour = [label as u8, 100, 200];
                    let row = LabelRow {
                        id: label,
                        name: None,
                        colour,
                        merged_into: None,
                    };
                    tx.put_label(id, &row)?;
                }
                tx.append_event(id, "CollectionCreated", "{}")?;
                tx.set_model(id, &[7; 1000])?;
                id
            }
        };
        let ordinal = tx.take_ordinal(collection)?;
        let shape = tx.insert_shape(&NewShapeRow {
            collection,
            name: name.into(),
            ordinal,
            content_digest: original.digest,
            format: "off".into(),
            description_digest: digest,
            n_polygons: description.face_map.len() as u64,
            area: description.area,
            report_json: r#"{"n_vertices":21}"#.into(),
            version: 0,
            signature: description.signature.clone(),
            stored_bytes: original.length + arrays.length,
        })?;
        let sequence =
            tx.append_event(collection, "ShapeAdded", &format!("{{\"shape\":{name:?}}}"))?;
        let labels = label_version(&description, 1, sequence);
        tx.put_labels(shape, &labels, &summary(0, &[0, seed % 3]).distinct())?;
        tx.put_stats(shape, 0, &seed.to_le_bytes())?;
        let before = tx.shapes(collection, ordinal.saturating_sub(2), 1, None)?;
        if let Some(before) = before.first().filter(|before| before.id != shape) {
            let n1 = tx.object_vertices(store, before.description_digest);
            tx.put_map(&MapRow {
                from: before.id,
                to: shape,
                k1: 2,
                k2: 3,
                c_12: vec![0.5, -0.5, 0.25, 1.0, 0.0, -1.0],
                p2p_21: (0..description.vertices.len())
                    .map(|i| (i % n1) as u32)
                    .collect(),
                confidence: vec![seed as u8; description.vertices.len()],
                quality_json: "{}".into(),
            })?;
        }
        let item = NewJobItem {
            name: name.into(),
            original_digest: original.digest,
            format: "off".into(),
            replace: false,
        };
        tx.insert_job("chairs", 1_000, &[item])?;
        tx.put_request(&RequestRow {
            client_id: "client".into(),
            request_id: format!("{}-{name}", collection.0),
            request_digest: Digest::of(&bytes),
            reply: name.as_bytes().to_vec(),
            created_unix_secs: 1_000,
        })?;
        Ok(shape)
    })
}

/// The row of a collection that must exist.
fn collection_id(store: &Store, name: &str) -> CollectionId {
    let row = store
        .catalog()
        .read(|r| r.collection(name))
        .expect("readable");
    row.expect("the collection is there").id
}

trait Distinct {
    fn distinct(self) -> Self;
}

impl Distinct for LabelSummary {
    /// A shape has each label once.
    fn distinct(mut self) -> Self {
        self.area_shares.dedup_by_key(|share| share.0);
        self
    }
}

trait ObjectVertices {
    fn object_vertices(&self, store: &Store, digest: Digest) -> usize;
}

impl ObjectVertices for coseg::store::Tx<'_> {
    fn object_vertices(&self, store: &Store, digest: Digest) -> usize {
        use coseg::store::rows::ObjectKind;
        let row = self
            .object(ObjectKind::Description, &digest)
            .expect("readable");
        let mapped = store
            .objects()
            .open_description(&row.expect("catalogued"))
            .expect("whole");
        mapped.view().vertices.len()
    }
}
