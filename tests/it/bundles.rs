//! Opens bundles that are cut, changed or forged: each is an error that says what is wrong, never
//! a panic.

use crate::pipeline::{COLLECTION, file, library};
use coseg::library::{Bundle, BundleError, Correction, Up, write_bundle};
use coseg::mesh::Format;
use coseg::mesh::write::off;
use coseg::store::Digest;
use coseg::synth::{Family, Labelled, Options, family};
use coseg::{Library, label};
use serde_json::Value;
use std::path::Path;
use tempfile::TempDir;

const TINY: Options = Options {
    n_faces: 400,
    rotate: false,
};

/// Writes the bundle of a collection of `n` pliers, the first of which a person labelled, and one
/// more mesh.
fn published(n: u32) -> (TempDir, Vec<u8>, Labelled) {
    let mut shapes = family(Family::Pliers, 3, n + 1, &TINY);
    let new = shapes.pop().unwrap();
    let (folder, library) = library(3, Up::Unknown);
    for s in &shapes {
        library.add(COLLECTION, file(&s.name, &s.mesh)).unwrap();
    }
    let labels: Vec<i32> = shapes[0].labels.iter().map(|l| *l as i32).collect();
    let correction = Correction::Whole(labels);
    library
        .correct(COLLECTION, &shapes[0].name, &correction, None)
        .unwrap();
    while library.relabel_next(Some(COLLECTION)).unwrap() {}
    let path = folder.path().join("a.coseg");
    publish(&library, &path);
    let bytes = std::fs::read(&path).unwrap();
    (folder, bytes, new)
}

fn publish(library: &Library, path: &Path) {
    let head = library.bundle_head(COLLECTION).unwrap();
    let written = write_bundle::<BundleError>(path, &head, |file| {
        let found = library
            .array_file(COLLECTION, &file.shape, &file.blake3)
            .unwrap();
        Ok(found.file_bytes().to_vec().into())
    });
    written.unwrap();
    assert_eq!(std::fs::metadata(path).unwrap().len(), head.n_bytes);
    assert_eq!(Bundle::open(path).unwrap().info().id, head.id);
}

/// Opens bytes as a bundle; a panic fails the test.
fn open(folder: &TempDir, bytes: &[u8]) -> Result<Bundle, BundleError> {
    let path = folder.path().join("changed.coseg");
    std::fs::write(&path, bytes).unwrap();
    Bundle::open(&path)
}

/// The header's JSON and the data behind it.
fn parts(bytes: &[u8]) -> (Value, &[u8]) {
    let n = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let header = serde_json::from_slice(&bytes[8..8 + n]).unwrap();
    (header, &bytes[8 + n..])
}

/// A bundle whose digests fit, however wrong its content is.
fn sealed(mut header: Value, data: &[u8]) -> Vec<u8> {
    let digest = "0".repeat(64);
    header["__metadata__"]["blake3"] = digest.as_str().into();
    let text = header.to_string();
    let n = (8 + text.len()).next_multiple_of(64) - 8;
    let mut bytes = (n as u64).to_le_bytes().to_vec();
    bytes.extend_from_slice(text.as_bytes());
    bytes.resize(8 + n, b' ');
    let found = Digest::of(&bytes).to_string();
    let wanted = format!("\"blake3\":\"{digest}\"");
    let at = bytes
        .windows(wanted.len())
        .position(|w| w == wanted.as_bytes())
        .unwrap();
    let end = at + wanted.len() - 1;
    bytes[end - 64..end].copy_from_slice(found.as_bytes());
    bytes.extend_from_slice(data);
    bytes
}

/// A bundle with another text under a key of the header's metadata.
fn with_text(bytes: &[u8], key: &str, change: impl FnOnce(&mut Value)) -> Vec<u8> {
    let (mut header, data) = parts(bytes);
    let text = header["__metadata__"][key].as_str().unwrap();
    let mut value = serde_json::from_str(text).unwrap();
    change(&mut value);
    header["__metadata__"][key] = value.to_string().into();
    sealed(header, data)
}

/// A bundle with other bytes in an array, and the digest of these.
fn with_array(bytes: &[u8], name: &str, change: impl FnOnce(&mut [u8])) -> Vec<u8> {
    let (header, data) = parts(bytes);
    let mut data = data.to_vec();
    let offset = |i: usize| header[name]["data_offsets"][i].as_u64().unwrap() as usize;
    let array = &mut data[offset(0)..offset(1)];
    change(array);
    let digest = Digest::of(array).to_string();
    let changed = sealed(header, &data);
    with_text(&changed, "digests", |d| d["arrays"][name] = digest.into())
}

#[test]
fn every_changed_byte_and_every_cut_is_found() {
    let (folder, bytes, _) = published(2);
    let n_header = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize + 8;
    let in_header = (0..n_header).step_by(3);
    let behind = (n_header..bytes.len()).step_by(bytes.len() / 500 + 1);
    let mut n = 0;
    for at in in_header.chain(behind).chain([bytes.len() - 1]) {
        for bit in [0x01, 0x20] {
            let mut changed = bytes.clone();
            changed[at] ^= bit;
            let error = open(&folder, &changed).err();
            let error = error.unwrap_or_else(|| panic!("byte {at} ^ {bit} is not noticed"));
            assert!(error.to_string().contains("changed.coseg"), "{error}");
            n += 1;
        }
    }
    assert!(n > 1_000);
    for length in (0..bytes.len())
        .step_by(bytes.len() / 200)
        .chain([bytes.len() - 1])
    {
        assert!(open(&folder, &bytes[..length]).is_err(), "cut to {length}");
    }
    let longer = [&bytes[..], &[0; 64]].concat();
    assert!(open(&folder, &longer).is_err());
    assert!(open(&folder, &bytes).is_ok());
}

#[test]
fn other_files_and_versions_are_named() {
    let (folder, bytes, _) = published(2);
    let (header, data) = parts(&bytes);
    let with = |key: &str, value: &str| {
        let mut header = header.clone();
        header["__metadata__"][key] = value.into();
        sealed(header, data)
    };
    assert!(
        open(&folder, &sealed(header.clone(), data)).is_ok(),
        "the seal is right"
    );
    let newer = with_text(&bytes, "manifest", |m| m["algorithm"] = 99.into());
    for (bytes, expected) in [
        (
            with("format", "2"),
            "has bundle format 2, this version reads 1",
        ),
        (newer, "holds descriptions by algorithm 99, this version"),
        (with("kind", "something"), "its header names no bundle"),
        (b"OFF\n0 0 0\n".to_vec(), "its header cannot be read"),
        (b"PK\x03\x04........".to_vec(), "it is a zip archive"),
        (u64::MAX.to_le_bytes().to_vec(), "its header cannot be read"),
        (Vec::new(), "the file is empty"),
    ] {
        let error = open(&folder, &bytes).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
    let error = Bundle::open(&folder.path().join("nothing")).unwrap_err();
    assert!(matches!(error, BundleError::Io { .. }), "{error}");
    assert!(Bundle::open(folder.path()).is_err(), "a folder");
}

#[test]
fn forged_bundles_are_refused() {
    let (folder, bytes, _) = published(2);
    let manifest = |change: &dyn Fn(&mut Value)| with_text(&bytes, "manifest", change);
    let link = serde_json::json!({
        "id": 1, "kind": "same",
        "ends": [
            { "shape": 1, "part": 0, "polygons": [4_000_000_000_u32] },
            { "shape": 2, "part": 0, "polygons": [0] },
        ],
    });
    let refused: Vec<(Vec<u8>, &str)> = vec![
        (
            manifest(&|m| m["working_faces"] = 5.into()),
            "working_faces is 5",
        ),
        (
            manifest(&|m| m["n_parts"] = 5_000.into()),
            "the number of parts is 5000",
        ),
        (
            manifest(&|m| m["operator"] = "none".into()),
            "no operator is named",
        ),
        (
            manifest(&|m| m["next_label"] = u32::MAX.into()),
            "the next label is",
        ),
        (manifest(&|m| m["state"] = "{".into()), "EOF"),
        (
            manifest(&|m| m["shapes"] = serde_json::json!([])),
            "it has no shapes",
        ),
        (
            manifest(&|m| m["shapes"][1]["ordinal"] = 1.into()),
            "shape 1 follows shape 1",
        ),
        (
            manifest(&|m| m["shapes"][1]["pinned"] = true.into()),
            "2.pins",
        ),
        (
            manifest(&|m| m["shapes"][0]["digest"] = "x".into()),
            "has no digest",
        ),
        (manifest(&|m| m["more"] = 1.into()), "unknown field"),
        (
            manifest(&|m| m["links"] = serde_json::json!([link])),
            "polygons that no shape has",
        ),
        (
            with_text(&bytes, "digests", |d| {
                d["files"]["1.description"][1] = u64::MAX.into()
            }),
            "has not the length",
        ),
        (
            with_text(&bytes, "digests", |d| {
                d["files"]["1.description"][1] = 1.into()
            }),
            "has not the length",
        ),
        (
            with_text(&bytes, "digests", |d| d["arrays"]["none"] = "x".into()),
            "is not both in it and in its digests",
        ),
        (
            with_array(&bytes, "1.labels", |a| a.fill(0x7f)),
            "has a label above",
        ),
        (
            with_array(&bytes, "1.pins", |a| a.fill(0x7f)),
            "has a label above",
        ),
        (with_array(&bytes, "model", |a| a[..8].fill(0xff)), "header"),
        (
            with_array(&bytes, "model", |a| {
                let n = a.len();
                a[n - 8..].copy_from_slice(&f64::NAN.to_le_bytes());
            }),
            "not finite",
        ),
    ];
    for (bytes, expected) in refused {
        let error = open(&folder, &bytes).unwrap_err().to_string();
        assert!(
            error.to_lowercase().contains(&expected.to_lowercase()),
            "{expected}: {error}"
        );
    }
}

/// An array can name bytes of another one: digests fit, and the shapes do not.
#[test]
fn places_of_arrays_that_lie_are_refused() {
    let (folder, bytes, _) = published(2);
    let (header, data) = parts(&bytes);
    for (name, offsets) in [
        ("1.labels", [0, data.len() + 64]),
        ("1.labels", [64, 0]),
        ("1.description", [0, 64]),
    ] {
        let mut header = header.clone();
        header[name]["data_offsets"] = offsets.to_vec().into();
        assert!(
            open(&folder, &sealed(header, data)).is_err(),
            "{name}: {offsets:?}"
        );
    }
    let mut header = header.clone();
    header["1.labels"]["shape"] = vec![u64::MAX, u64::MAX].into();
    assert!(open(&folder, &sealed(header, data)).is_err());
}

#[test]
fn a_bundle_is_used_by_many_threads_and_outlives_its_name() {
    let (folder, bytes, new) = published(3);
    let bundle = open(&folder, &bytes).unwrap();
    std::fs::remove_file(folder.path().join("changed.coseg")).unwrap();
    let text = off(&new.mesh);
    let labelled = || label(text.as_bytes(), Format::Off, &bundle).unwrap();
    let first = labelled();
    assert_eq!(first.labels.len(), new.labels.len());
    assert!(first.n_maps >= 1 && !first.sources.is_empty());
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..3).map(|_| scope.spawn(labelled)).collect();
        for thread in threads {
            assert_eq!(thread.join().unwrap(), first);
        }
    });
    let refused = label(b"OFF\n1 1 0\n0 0 0\n3 0 1 2\n", Format::Off, &bundle).unwrap_err();
    assert_eq!(refused.reason, coseg::library::Reason::VertexIndex);
}
