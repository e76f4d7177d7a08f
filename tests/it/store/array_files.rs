//! Tests array files: they read back as written, and every kind of damage is an error.

use super::{PARAMS, description};
use coseg::pipeline::Description;
use coseg::store::Digest;
use coseg::store::mapped::{ArrayFileError, MappedDescription, write_description};
use serde_json::{Value, json};
use std::path::Path;

fn open_bytes(bytes: &[u8]) -> Result<MappedDescription, ArrayFileError> {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("a.safetensors");
    std::fs::write(&path, bytes).expect("written");
    MappedDescription::open(&path, bytes.len() as u64, None)
}

/// Header and data of a file, split without the crate's help.
fn parts(file: &[u8]) -> (Value, Vec<u8>) {
    let length = u64::from_le_bytes(file[..8].try_into().expect("eight bytes")) as usize;
    let header = serde_json::from_slice(&file[8..8 + length]).expect("JSON");
    (header, file[8 + length..].to_vec())
}

fn joined(header: &Value, data: &[u8]) -> Vec<u8> {
    let mut text = header.to_string().into_bytes();
    text.resize((8 + text.len()).next_multiple_of(64) - 8, b' ');
    let mut file = (text.len() as u64).to_le_bytes().to_vec();
    file.extend(text);
    file.extend(data);
    file
}

#[test]
fn a_description_reads_back_bit_for_bit() {
    let mut odd = description(24, 3);
    odd.mass[0] = f32::NAN;
    odd.hks[7] = f32::NEG_INFINITY;
    odd.eigenvalues[0] = -1e-300;
    odd.area = 0.1 + 0.2;
    let file = write_description(&odd, PARAMS).expect("consistent");
    assert_eq!(
        file,
        write_description(&odd, PARAMS).expect("consistent"),
        "same bytes"
    );
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("odd.safetensors");
    std::fs::write(&path, &file).expect("written");
    let blake3 = Digest::of(&file).0;
    let mapped = MappedDescription::open(&path, file.len() as u64, Some(blake3)).expect("whole");
    std::fs::remove_file(&path).expect("removed");
    assert_eq!(mapped.params_json(), PARAMS);
    assert_eq!(mapped.report(), &odd.report);
    assert_eq!(mapped.area().to_bits(), odd.area.to_bits());
    let read = mapped.to_description();
    assert_eq!(write_description(&read, PARAMS).expect("consistent"), file);
    assert!(read.mass[0].is_nan());
    let plain = description(24, 4);
    let file = write_description(&plain, PARAMS).expect("consistent");
    assert_eq!(open_bytes(&file).expect("whole").to_description(), plain);
}

#[test]
fn the_smallest_description_reads_back() {
    for empty in [
        Description::default(),
        Description {
            area: 1.0,
            ..description(3, 0)
        },
    ] {
        let file = write_description(&empty, "").expect("consistent");
        assert_eq!(open_bytes(&file).expect("whole").to_description(), empty);
    }
}

/// The view of a reader without our code: safetensors, data at a multiple of 64, right shapes.
#[test]
fn the_file_is_plain_safetensors() {
    let description = description(21, 9);
    let file = write_description(&description, PARAMS).expect("consistent");
    let (header, data) = parts(&file);
    assert_eq!((file.len() - data.len()) % 64, 0);
    assert_eq!(header["__metadata__"]["format"], "1");
    assert_eq!(header["__metadata__"]["params"], PARAMS);
    assert_eq!(header["__metadata__"]["area"], "12.25");
    assert_eq!(header["__metadata__"]["n_bridges"], "9");
    let expected = [
        ("vertices", "F32", json!([21, 3])),
        ("faces", "U32", json!([19, 3])),
        ("mass", "F32", json!([21])),
        ("eigenvalues", "F64", json!([7])),
        ("eigenvectors", "F32", json!([21, 5])),
        ("hks", "F32", json!([21, 100])),
        ("face_descriptors", "F32", json!([19, 9])),
        ("patches", "U32", json!([19])),
        ("face_map", "U32", json!([39])),
        ("polygon_area", "F32", json!([39])),
        ("signature", "F32", json!([11])),
    ];
    assert_eq!(header.as_object().expect("a map").len(), expected.len() + 1);
    for (name, dtype, shape) in expected {
        assert_eq!(header[name]["dtype"], dtype, "{name}");
        assert_eq!(header[name]["shape"], shape, "{name}");
    }
    let offsets = &header["faces"]["data_offsets"];
    let (begin, end) = (
        offsets[0].as_u64().expect("a"),
        offsets[1].as_u64().expect("b"),
    );
    let faces = &data[begin as usize..end as usize];
    let expected: Vec<u8> = description
        .faces
        .as_flattened()
        .iter()
        .flat_map(|v| v.to_le_bytes())
        .collect();
    assert_eq!(faces, expected);
}

/// The same through numpy, if it is installed.
#[test]
fn python_reads_the_file_without_our_code() {
    let script = r#"
import json, struct, sys
import numpy as np
path = sys.argv[1]
with open(path, "rb") as f:
    (n,) = struct.unpack("<Q", f.read(8))
    header = json.loads(f.read(n))
a, b = header["eigenvalues"]["data_offsets"]
v = np.memmap(path, "<f8", "r", 8 + n + a, tuple(header["eigenvalues"]["shape"]))
print(float(v[1]))
"#;
    let python = std::process::Command::new("python3")
        .args(["-c", "import numpy"])
        .output();
    if !python.is_ok_and(|output| output.status.success()) {
        println!("skipped: no python3 with numpy");
        return;
    }
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("a.safetensors");
    let file = write_description(&description(9, 0), PARAMS).expect("consistent");
    std::fs::write(&path, file).expect("written");
    let run = std::process::Command::new("python3")
        .args(["-c", script])
        .arg(&path)
        .output();
    let output = run.expect("python3 runs");
    assert_eq!(
        String::from_utf8_lossy(&output.stdout).trim(),
        "1.1",
        "{output:?}"
    );
}

#[test]
fn a_file_cut_anywhere_is_refused() {
    let file = write_description(&description(5, 1), PARAMS).expect("consistent");
    for end in 0..file.len() {
        assert!(
            open_bytes(&file[..end]).is_err(),
            "cut at {end} of {}",
            file.len()
        );
    }
    let mut longer = file.clone();
    longer.push(0);
    assert!(matches!(
        open_bytes(&longer),
        Err(ArrayFileError::Header(_))
    ));
}

#[test]
fn length_and_digest_are_the_catalogs() {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("a.safetensors");
    let file = write_description(&description(5, 1), PARAMS).expect("consistent");
    let other = write_description(&description(5, 2), PARAMS).expect("consistent");
    std::fs::write(&path, &file).expect("written");
    let (length, digest) = (file.len() as u64, Digest::of(&file).0);
    let open = |length| MappedDescription::open(&path, length, Some(digest));
    assert!(open(length).is_ok());
    for wrong in [0, length - 1, length + 1, length + 4096] {
        assert!(
            matches!(open(wrong), Err(ArrayFileError::Length { .. })),
            "{wrong}"
        );
    }
    // Replaced by another whole file, padded here to the same length by its parameters.
    assert_eq!(other.len(), file.len());
    std::fs::write(&path, &other).expect("written");
    assert!(matches!(open(length), Err(ArrayFileError::Digest { .. })));
    let missing = MappedDescription::open(Path::new("/nonexistent/a"), 1, None);
    assert!(matches!(missing, Err(ArrayFileError::Io(_))));
    let folder = MappedDescription::open(dir.path(), 4096, None);
    assert!(folder.is_err());
}

#[test]
fn every_flipped_bit_is_noticed() {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("a.safetensors");
    let mut file = write_description(&description(3, 1), "").expect("consistent");
    let (length, digest) = (file.len() as u64, Digest::of(&file).0);
    for at in 0..file.len() {
        file[at] ^= 1 << (at % 8);
        std::fs::write(&path, &file).expect("written");
        assert!(
            MappedDescription::open(&path, length, Some(digest)).is_err(),
            "byte {at}"
        );
        // Without the digest no contents may cause a panic.
        if let Ok(mapped) = MappedDescription::open(&path, length, None) {
            let view = mapped.view();
            assert!(
                view.faces
                    .as_flattened()
                    .iter()
                    .all(|&v| (v as usize) < view.vertices.len())
            );
        }
        file[at] ^= 1 << (at % 8);
    }
}

#[test]
fn headers_that_lie_are_refused() {
    let file = write_description(&description(6, 1), PARAMS).expect("consistent");
    let (header, data) = parts(&file);
    assert!(
        open_bytes(&joined(&header, &data)).is_ok(),
        "the unchanged header is accepted"
    );
    let changed = |change: &dyn Fn(&mut Value)| {
        let mut header = header.clone();
        change(&mut header);
        open_bytes(&joined(&header, &data))
            .expect_err("a lie")
            .to_string()
    };
    type Lie = dyn Fn(&mut Value);
    let lies: [(&str, &Lie); 17] = [
        ("dtype", &|h| h["mass"]["dtype"] = json!("U32")),
        ("dtype", &|h| h["eigenvalues"]["dtype"] = json!("I64")),
        ("dtype", &|h| h["faces"]["dtype"] = json!("F32")),
        ("header", &|h| h["mass"]["dtype"] = json!("F64")),
        ("header", &|h| h["mass"]["dtype"] = json!("X9")),
        ("header", &|h| h["mass"]["shape"] = json!([7])),
        ("header", &|h| {
            h["mass"]["shape"] = json!([u64::MAX, u64::MAX])
        }),
        ("header", &|h| h["mass"]["shape"] = json!([-1])),
        ("shape", &|h| h["vertices"]["shape"] = json!([9, 2])),
        ("shape", &|h| h["vertices"]["shape"] = json!([18])),
        ("shape", &|h| h["mass"]["shape"] = json!([6, 1])),
        ("shape", &|h| h["hks"]["shape"] = json!([100, 6])),
        ("header", &|h| {
            h["signature"]["data_offsets"][1] = json!(1_u64 << 40)
        }),
        ("header", &|h| {
            h["vertices"]["data_offsets"] = json!([0, 72])
        }),
        ("missing", &|h| h["signature_"] = h["signature"].clone()),
        ("metadata", &|h| h["__metadata__"]["area"] = json!("wide")),
        ("format 2", &|h| h["__metadata__"]["format"] = json!("2")),
    ];
    for (at, (message, lie)) in lies.iter().enumerate() {
        let lie_with_removal = |h: &mut Value| {
            lie(h);
            if let Some(map) = h
                .as_object_mut()
                .filter(|map| map.contains_key("signature_"))
            {
                map.remove("signature_");
                map.remove("signature");
            }
        };
        let error = changed(&lie_with_removal);
        let tail_lost = *message == "missing" && error.contains("header");
        assert!(
            error.contains(message) || tail_lost,
            "{at}: {error} should speak of {message}"
        );
    }
    for key in ["format", "area", "params", "n_bridges"] {
        let error = changed(&|h| {
            h["__metadata__"]
                .as_object_mut()
                .expect("a map")
                .remove(key);
        });
        assert!(error.contains(key), "{error}");
    }
    let no_metadata = changed(&|h| {
        h.as_object_mut().expect("a map").remove("__metadata__");
    });
    assert!(no_metadata.contains("format"), "{no_metadata}");
}

#[test]
fn a_missing_or_additional_array_is_refused() {
    let whole = description(6, 1);
    let (mut header, data) = parts(&write_description(&whole, PARAMS).expect("consistent"));
    let last = header["signature"].clone();
    header["other"] = last;
    header.as_object_mut().expect("a map").remove("signature");
    let error = open_bytes(&joined(&header, &data)).expect_err("another name");
    assert!(
        matches!(&error, ArrayFileError::Unexpected { name } if name == "other"),
        "{error}"
    );
    header.as_object_mut().expect("a map").remove("other");
    let data = &data[..data.len() - whole.signature.len() * 4];
    let error = open_bytes(&joined(&header, data)).expect_err("one too few");
    assert!(
        matches!(error, ArrayFileError::Missing { name: "signature" }),
        "{error}"
    );
}

#[test]
fn a_header_that_is_not_text_or_not_aligned_is_refused() {
    let file = write_description(&description(6, 1), PARAMS).expect("consistent");
    let mut not_text = file.clone();
    let at = file
        .windows(4)
        .position(|bytes| bytes == b"mass")
        .expect("a name");
    not_text[at] = 0xff;
    assert!(matches!(
        open_bytes(&not_text),
        Err(ArrayFileError::Header(_))
    ));
    for length in [
        0,
        1,
        7,
        u64::MAX,
        u64::MAX / 2,
        1 << 62,
        100_000_000,
        100_000_001,
    ] {
        let mut lying = file.clone();
        lying[..8].copy_from_slice(&length.to_le_bytes());
        assert!(
            matches!(open_bytes(&lying), Err(ArrayFileError::Header(_))),
            "{length}"
        );
    }
    // One more space in the header: still safetensors, but eigenvalues begin at an odd byte.
    let (header, data) = parts(&file);
    let mut text = header.to_string().into_bytes();
    text.resize((8 + text.len()).next_multiple_of(64) - 7, b' ');
    let mut odd = (text.len() as u64).to_le_bytes().to_vec();
    odd.extend(text);
    odd.extend(data);
    assert!(open_bytes(&odd).is_err());
}

#[test]
fn indices_out_of_range_are_refused_when_written_and_when_read() {
    let whole = description(6, 1);
    let (header, data) = parts(&write_description(&whole, PARAMS).expect("consistent"));
    for name in ["faces", "patches", "face_map"] {
        let mut bad = whole.clone();
        match name {
            "faces" => bad.faces[1][2] = 6,
            "patches" => bad.patches[0] = 4,
            _ => bad.face_map[8] = u32::MAX,
        }
        let error = write_description(&bad, PARAMS)
            .expect_err("out of range")
            .to_string();
        assert!(error.starts_with(name), "{error}");
        let mut data = data.clone();
        let begin = header[name]["data_offsets"][0].as_u64().expect("a number") as usize;
        data[begin..begin + 4].copy_from_slice(&6_u32.to_le_bytes());
        let error = open_bytes(&joined(&header, &data))
            .expect_err("out of range")
            .to_string();
        assert!(error.starts_with(&format!("{name}[0] is 6")), "{error}");
    }
}

#[test]
fn arrays_that_do_not_fit_each_other_are_not_written() {
    let spoil: [fn(&mut Description); 6] = [
        |d| d.mass.truncate(3),
        |d| d.eigenvectors.push(0.0),
        |d| d.hks.truncate(7),
        |d| d.n_descriptors += 1,
        |d| d.patches.push(0),
        |d| d.polygon_area.clear(),
    ];
    for (at, spoil) in spoil.into_iter().enumerate() {
        let mut bad = description(6, 1);
        spoil(&mut bad);
        let error = write_description(&bad, PARAMS).expect_err("does not fit");
        assert!(
            matches!(error, ArrayFileError::Shape { .. }),
            "{at}: {error}"
        );
    }
}
