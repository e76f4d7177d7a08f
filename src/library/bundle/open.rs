//! Opens a bundle: compares every byte with its digest, then checks that the content is sound.

use super::content::{Bundle, BundleInfo, Bundled, BundledLabel, Manifest, ManifestShape, id_of};
use super::error::BundleError;
use super::file::{
    BUNDLE_FORMAT, DIGEST_CHARS, Digests, KIND, MODEL, PADDING, array_name, padded, position_of,
};
use super::publish::processor;
use super::sound;
use crate::library::collection::{Collection, KnownShape, ModelState};
use crate::library::placement;
use crate::library::submit::params_of;
use crate::pipeline::ALGORITHM_VERSION;
use crate::store::{
    CollectionId, CollectionRow, Digest, LabelRow, LabelVersionRow, MappedDescription, MappedFile,
    PreparedShapes, ShapeRow,
};
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};
use std::collections::{BTreeSet, HashMap};
use std::path::Path;

/// What is wrong with a bundle.
type Checked<T> = Result<T, String>;

impl Bundle {
    /// Opens the bundle at `path`. Nobody may write into the file as long as it is used; it may be
    /// removed or replaced by another file.
    ///
    /// # Errors
    /// The file cannot be read, is no bundle or one of another version, or is not byte for byte
    /// what was published.
    pub fn open(path: &Path) -> Result<Self, BundleError> {
        let damaged = |message: String| BundleError::damaged(path, message);
        let file = MappedFile::open(path).map_err(|e| match e {
            crate::store::ArrayFileError::Io(e) => BundleError::io(path, e),
            other => BundleError::not_a_bundle(path, other.to_string()),
        })?;
        let (header, manifest) = header(path, file.bytes())?;
        let tensors = SafeTensors::deserialize(file.bytes());
        let tensors = tensors.map_err(|e| damaged(e.to_string()))?;
        let files = verify(&tensors, &header.digests).map_err(damaged)?;
        let manifest: Manifest =
            serde_json::from_str(&manifest).map_err(|e| damaged(format!("the manifest: {e}")))?;
        if manifest.algorithm != ALGORITHM_VERSION {
            return Err(BundleError::Algorithm {
                path: path.display().to_string(),
                found: format!("algorithm {}", manifest.algorithm),
                supported: format!("algorithm {ALGORITHM_VERSION}"),
            });
        }
        bundle(header.id, manifest, &tensors, (&file, &files)).map_err(damaged)
    }
}

/// The digests of a bundle, by its header, and its own.
struct Header {
    id: Digest,
    digests: Digests,
}

/// Reads and verifies the header. Returns the manifest as text.
fn header(path: &Path, bytes: &[u8]) -> Result<(Header, String), BundleError> {
    let not_a_bundle = |message: &str| BundleError::not_a_bundle(path, message);
    let damaged = |message: &str| BundleError::damaged(path, message);
    let read = SafeTensors::read_metadata(bytes);
    let (n_header, metadata) = read.map_err(|e| match bytes.starts_with(b"PK") {
        true => not_a_bundle("it is a zip archive"),
        false => not_a_bundle(&format!("its header cannot be read, or it is cut ({e})")),
    })?;
    let none = HashMap::new();
    let metadata = metadata.metadata().as_ref().unwrap_or(&none);
    let text = |key: &str| metadata.get(key).map(String::as_str);
    if text("kind") != Some(KIND) {
        return Err(not_a_bundle("its header names no bundle"));
    }
    match text("format") {
        Some(found) if found == BUNDLE_FORMAT.to_string() => {}
        found => {
            return Err(BundleError::Version {
                path: path.display().to_string(),
                found: found.unwrap_or("none").chars().take(20).collect(),
                supported: BUNDLE_FORMAT,
            });
        }
    }
    let digits = text("blake3").unwrap_or_default();
    let id = digits.parse::<Digest>();
    // Capital digits would be another file of the same name.
    let id = id.ok().filter(|id| id.to_string() == digits);
    let id = id.ok_or_else(|| damaged("its header has no digest"))?;
    let mut whole = bytes[..8 + n_header].to_vec();
    let at = position_of(&whole, digits).ok_or_else(|| damaged("its header has no digest"))?;
    whole[at..at + DIGEST_CHARS].fill(b'0');
    if Digest::of(&whole) != id {
        return Err(damaged("the header does not have the digest that it names"));
    }
    let digests = text("digests").unwrap_or_default();
    let digests = serde_json::from_str(digests);
    let digests = digests.map_err(|e| damaged(&format!("the digests: {e}")))?;
    let manifest = text("manifest").unwrap_or_default().to_owned();
    Ok((Header { id, digests }, manifest))
}

/// Compares every array with its digest. Returns the lengths of the array files by name.
fn verify(tensors: &SafeTensors<'_>, digests: &Digests) -> Checked<HashMap<String, usize>> {
    let mut lengths = HashMap::new();
    let expected = digests.arrays.keys().chain(digests.files.keys());
    let expected: BTreeSet<&str> = expected.map(String::as_str).collect();
    let found: BTreeSet<&str> = tensors.names().into_iter().collect();
    if let Some(name) = expected.symmetric_difference(&found).next() {
        return Err(format!(
            "array {name:?} is not both in it and in its digests"
        ));
    }
    for (name, digest) in &digests.arrays {
        let data = tensors.tensor(name).map_err(|e| e.to_string())?;
        if Digest::of(data.data()).to_string() != *digest {
            return Err(format!("array {name:?} does not have its digest {digest}"));
        }
    }
    for (name, (digest, length)) in &digests.files {
        let data = tensors.tensor(name).map_err(|e| e.to_string())?.data();
        if length.checked_next_multiple_of(64).is_none() || padded(*length) != data.len() as u64 {
            return Err(format!(
                "array {name:?} has not the length of its file, {length}"
            ));
        }
        let (file, zeros) = data.split_at(*length as usize);
        if Digest::of(file).to_string() != *digest || zeros.iter().any(|z| *z != 0) {
            return Err(format!("array {name:?} does not have its digest {digest}"));
        }
        lengths.insert(name.clone(), *length as usize);
    }
    match tensors.tensor(PADDING) {
        Ok(padding) if padding.data().iter().all(|z| *z == 0) => Ok(lengths),
        _ => Err(format!("array {PADDING:?} is not all zeros")),
    }
}

/// Makes the bundle of verified bytes.
fn bundle(
    id: Digest,
    manifest: Manifest,
    tensors: &SafeTensors<'_>,
    files: (&MappedFile, &HashMap<String, usize>),
) -> Checked<Bundle> {
    let model = tensors.tensor(MODEL).map_err(|e| e.to_string())?;
    let model = ModelState::decode(model.data())?;
    sound::model(&model)?;
    let row = collection_row(&manifest);
    let params = params_of(&row).map_err(|e| e.to_string())?;
    sound::settings(&row)?;
    let (mut shapes, mut known) = (HashMap::new(), Vec::new());
    let mut last = 0;
    for shape in manifest.shapes {
        if shape.ordinal <= last || i64::try_from(shape.ordinal).is_err() {
            return Err(format!("shape {} follows shape {last}", shape.ordinal));
        }
        last = shape.ordinal;
        let digest = shape.digest.parse();
        let digest: Digest = digest.map_err(|_| format!("shape {last} has no digest"))?;
        let bundled = bundled(shape, digest, tensors, files)?;
        sound::shape(&bundled, &model.model)?;
        known.push(KnownShape {
            id: bundled.row.id,
            ordinal: last,
            digest,
            stale: false,
            pinned: bundled.pins.is_some(),
            signature: bundled.arrays.view().signature.to_vec(),
        });
        shapes.insert(bundled.row.id, bundled);
    }
    let links: Vec<_> = manifest.links.into_iter().map(|l| l.row()).collect();
    sound::links(&links, &shapes)?;
    let collection = Collection::published(row, model, known).map_err(|e| e.to_string())?;
    sound::state(&collection)?;
    let label_model = collection.label_model().ok_or("it has no model")?;
    let label = |l: &super::content::ManifestLabel| BundledLabel {
        id: l.id,
        name: l.name.clone(),
        colour: l.colour,
        merged_into: l.merged_into,
        in_use: label_model.labels.contains(&l.id),
    };
    let info = BundleInfo {
        id,
        collection: manifest.collection,
        sequence: manifest.sequence,
        epoch: label_model.epoch,
        n_shapes: manifest.n_shapes,
        n_bundled: shapes.len(),
        up: collection.up(),
        axis: label_model.up,
        clusters_next: placement::clusters(&collection),
        same_processor: manifest.processor == processor(),
        labels: manifest.labels.iter().map(label).collect(),
    };
    let rows = manifest.labels.into_iter().map(|l| LabelRow {
        id: l.id,
        name: l.name,
        colour: l.colour,
        merged_into: l.merged_into,
    });
    Ok(Bundle {
        info,
        params,
        collection,
        shapes,
        labels: rows.collect(),
        links,
        prepared: PreparedShapes::default(),
    })
}

fn collection_row(manifest: &Manifest) -> CollectionRow {
    CollectionRow {
        id: CollectionId(1),
        name: manifest.collection.clone(),
        n_parts: manifest.n_parts,
        up: manifest.up.clone(),
        operator: manifest.operator.clone(),
        working_faces: manifest.working_faces,
        sequence: manifest.sequence,
        next_ordinal: manifest.next_ordinal,
        next_label: manifest.next_label,
        epoch: manifest.epoch,
        state: manifest.state.clone().into_bytes(),
    }
}

/// Reads one shape.
fn bundled(
    shape: ManifestShape,
    digest: Digest,
    tensors: &SafeTensors<'_>,
    (file, lengths): (&MappedFile, &HashMap<String, usize>),
) -> Checked<Bundled> {
    let array = |what: &str| {
        let name = array_name(shape.ordinal, what);
        let found = tensors.tensor(&name).map_err(|e| e.to_string())?;
        Ok::<_, String>((name, found))
    };
    let (name, description) = array("description")?;
    let length = *lengths.get(&name).ok_or(format!("{name:?} is no file"))?;
    let begin = description.data().as_ptr().addr() - file.bytes().as_ptr().addr();
    let arrays = MappedDescription::within(file, begin..begin + length, None);
    let arrays = arrays.map_err(|e| format!("{name:?}: {e}"))?;
    let pins = match shape.pinned {
        true => Some(labels(&array("pins")?.1)?),
        false => None,
    };
    let labels = LabelVersionRow {
        version: shape.version,
        proxy_labels: labels(&array("labels")?.1)?,
        proxy_probabilities: array("probabilities")?.1.data().to_vec(),
        ..LabelVersionRow::default()
    };
    let row = ShapeRow {
        id: id_of(shape.ordinal),
        collection: CollectionId(1),
        name: shape.name,
        ordinal: shape.ordinal,
        content_digest: digest,
        format: String::new(),
        description_digest: digest,
        n_polygons: arrays.view().face_map.len() as u64,
        area: arrays.area(),
        report_json: String::new(),
        version: shape.version,
        label_epoch: shape.label_epoch,
        stale: false,
        parts_json: String::new(),
        sources_json: String::new(),
        stored_bytes: length as u64,
    };
    Ok(Bundled {
        row,
        file: Digest::of(arrays.file_bytes()),
        arrays,
        labels,
        pins,
    })
}

fn labels(array: &TensorView<'_>) -> Checked<Vec<i32>> {
    let (values, rest) = array.data().as_chunks::<4>();
    match array.dtype() == Dtype::I32 && rest.is_empty() {
        true => Ok(values.iter().map(|v| i32::from_le_bytes(*v)).collect()),
        false => Err(format!("labels are {:?}, not I32", array.dtype())),
    }
}
