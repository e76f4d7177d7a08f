//! The layout of a bundle: a safetensors file whose header has a digest of itself and of every
//! array, so that no byte can change unseen. It begins with its head, the header and all arrays but
//! the array files of shapes, which follow as they are in the library.

use super::error::BundleError;
use crate::store::{DATA_ALIGNMENT, Digest, array_file_header};
use safetensors::tensor::Dtype;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// Version of the layout; files of other versions are refused.
pub(super) const BUNDLE_FORMAT: u32 = 1;
/// The value of the header's `kind`.
pub(super) const KIND: &str = "coseg bundle";
/// Characters of a digest in text.
pub(super) const DIGEST_CHARS: usize = 64;
/// Name of the array with the label model.
pub(super) const MODEL: &str = "model";
/// Name of the array of zeros behind which array files begin.
pub(super) const PADDING: &str = "padding";

/// Names of the arrays of the shape with an ordinal.
pub(super) fn array_name(ordinal: u64, what: &str) -> String {
    format!("{ordinal}.{what}")
}

/// The beginning of a bundle, and the array files that follow it.
#[derive(Debug, Clone, PartialEq)]
pub struct BundleHead {
    /// The header and all arrays but the array files.
    pub bytes: Vec<u8>,
    /// The array files in their order. Each begins at a multiple of 64 bytes, with zeros between.
    pub files: Vec<BundleFile>,
    /// Names the content of the bundle: the digest in its header.
    pub id: Digest,
    /// Sequence number of the collection.
    pub sequence: u64,
    /// Epoch of its labels.
    pub epoch: u64,
    /// Bytes of the whole bundle.
    pub n_bytes: u64,
    /// Whether the next shape clusters the collection again, perhaps with other labels than now.
    pub clusters_next: bool,
}

/// An array file of a bundle.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BundleFile {
    /// The shape that it describes.
    pub shape: String,
    /// BLAKE3 of the file.
    pub blake3: Digest,
    /// Its bytes.
    pub length: u64,
}

/// The bytes of an array file, as they are received.
pub type ArrayFile = bytes::Bytes;

/// An array of a head.
pub(super) struct Array {
    pub(super) name: String,
    pub(super) dtype: Dtype,
    pub(super) bytes: Vec<u8>,
}

/// What a header says besides the places of arrays.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Digests {
    /// BLAKE3 of each array of the head by its name.
    pub(super) arrays: BTreeMap<String, String>,
    /// BLAKE3 and length of each array file by the name of its array.
    pub(super) files: BTreeMap<String, (String, u64)>,
}

/// Returns the head of a bundle: its bytes, its digest and the length of the whole. `files` are the
/// ordinals and the array files of the shapes.
pub(super) fn head(
    manifest: &str,
    mut arrays: Vec<Array>,
    files: &[(u64, BundleFile)],
) -> (Vec<u8>, Digest, u64) {
    // Wide elements first, so that all of them are aligned.
    arrays.sort_by_key(|a| std::cmp::Reverse(a.dtype.bitsize()));
    let n_bytes: usize = arrays.iter().map(|a| a.bytes.len()).sum();
    arrays.push(Array {
        name: PADDING.into(),
        dtype: Dtype::U8,
        bytes: vec![0; n_bytes.next_multiple_of(DATA_ALIGNMENT) - n_bytes],
    });
    let digests = Digests {
        arrays: arrays
            .iter()
            .map(|a| (a.name.clone(), Digest::of(&a.bytes).to_string()))
            .collect(),
        files: files
            .iter()
            .map(|(ordinal, f)| {
                let name = array_name(*ordinal, "description");
                (name, (f.blake3.to_string(), f.length))
            })
            .collect(),
    };
    let digests = serde_json::to_string(&digests).expect("invariant: plain values serialise");
    let mut places: Vec<(String, Dtype, Vec<usize>)> = arrays
        .iter()
        .map(|a| {
            let n = a.bytes.len() / (a.dtype.bitsize() / 8);
            (a.name.clone(), a.dtype, vec![n])
        })
        .collect();
    places.extend(files.iter().map(|(ordinal, file)| {
        let name = array_name(*ordinal, "description");
        (name, Dtype::U8, vec![padded(file.length) as usize])
    }));
    let zeros = "0".repeat(DIGEST_CHARS);
    let mut metadata = serde_json::Map::new();
    for (key, value) in [
        ("blake3", zeros.as_str()),
        ("digests", &digests),
        ("format", &BUNDLE_FORMAT.to_string()),
        ("kind", KIND),
        ("manifest", manifest),
    ] {
        metadata.insert(key.into(), value.into());
    }
    let places = places.iter().map(|p| (p.0.as_str(), p.1, p.2.as_slice()));
    let mut bytes = array_file_header(Some(metadata), places);
    let id = Digest::of(&bytes);
    let at = position_of(&bytes, &zeros).expect("invariant: the digits were just written");
    bytes[at..at + DIGEST_CHARS].copy_from_slice(id.to_string().as_bytes());
    for array in &arrays {
        bytes.extend_from_slice(&array.bytes);
    }
    let n_files: u64 = files.iter().map(|(_, f)| padded(f.length)).sum();
    let n_bytes = bytes.len() as u64 + n_files;
    (bytes, id, n_bytes)
}

/// The length of an array file with the zeros behind it.
pub(super) fn padded(length: u64) -> u64 {
    length.next_multiple_of(DATA_ALIGNMENT as u64)
}

/// The position of the digits of a digest in a header: it comes first of all metadata.
pub(super) fn position_of(header: &[u8], digits: &str) -> Option<usize> {
    let wanted = format!("\"blake3\":\"{digits}\"");
    let found = header.windows(wanted.len());
    let mut found = found.enumerate().filter(|(_, w)| *w == wanted.as_bytes());
    let (at, _) = found.next()?;
    Some(at + wanted.len() - 1 - DIGEST_CHARS)
}

/// Writes a bundle to `path`: under another name first, so that the file at `path` is always whole.
/// `file` returns the bytes of an array file, which are checked.
///
/// # Errors
/// Those of `file`, or the folder cannot be written, or bytes are not those that were published.
pub fn write_bundle<E: From<BundleError>>(
    path: &Path,
    head: &BundleHead,
    mut file: impl FnMut(&BundleFile) -> Result<ArrayFile, E>,
) -> Result<(), E> {
    let part = Part::create(path).map_err(|e| BundleError::io(path, e))?;
    let write = |bytes: &[u8]| (&part.file).write_all(bytes);
    let written = |e| BundleError::io(path, e);
    write(&head.bytes).map_err(written)?;
    for wanted in &head.files {
        let bytes = file(wanted)?;
        let found = Digest::of(&bytes);
        if found != wanted.blake3 || bytes.len() as u64 != wanted.length {
            let (shape, expected) = (wanted.shape.clone(), wanted.blake3);
            Err(BundleError::File {
                shape,
                found,
                expected,
            })?;
        }
        write(&bytes).map_err(written)?;
        let n_zeros = padded(wanted.length) - wanted.length;
        write(&vec![0; n_zeros as usize]).map_err(written)?;
    }
    Ok(part.rename(path).map_err(written)?)
}

/// A file that is being written, and is removed unless it gets its name.
struct Part {
    file: File,
    path: PathBuf,
}

impl Part {
    fn create(path: &Path) -> io::Result<Self> {
        let name = path
            .file_name()
            .ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "names no file"))?;
        let mut part = name.to_owned();
        part.push(format!(".{}.part", std::process::id()));
        let part = path.with_file_name(part);
        Ok(Self {
            file: File::create(&part)?,
            path: part,
        })
    }

    fn rename(self, path: &Path) -> io::Result<()> {
        self.file.sync_all()?;
        fs::rename(&self.path, path)
    }
}

impl Drop for Part {
    fn drop(&mut self) {
        // After the rename there is none.
        let _ = fs::remove_file(&self.path);
    }
}
