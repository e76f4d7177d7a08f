//! Reads NumPy's .npz: a zip of .npy arrays, deflated or stored.

use std::io::Read;
use std::path::Path;

/// An array, in the order of the file (C order), as doubles.
pub(super) struct Array {
    pub(super) shape: Vec<usize>,
    pub(super) values: Vec<f64>,
}

fn number(bytes: &[u8], at: usize, size: usize) -> usize {
    let mut word = [0u8; 8];
    word[..size].copy_from_slice(&bytes[at..at + size]);
    usize::try_from(u64::from_le_bytes(word)).unwrap()
}

/// The array with this name.
pub(super) fn read(path: &Path, name: &str) -> Array {
    let zip = std::fs::read(path).unwrap();
    // The end record, then the central directory that it refers to.
    let end = zip.windows(4).rposition(|w| w == b"PK\x05\x06").unwrap();
    let (count, mut at) = (number(&zip, end + 10, 2), number(&zip, end + 16, 4));
    for _ in 0..count {
        let (name_length, extra, comment) = (
            number(&zip, at + 28, 2),
            number(&zip, at + 30, 2),
            number(&zip, at + 32, 2),
        );
        if zip[at + 46..at + 46 + name_length] == *format!("{name}.npy").as_bytes() {
            let (method, size, local) = (
                number(&zip, at + 10, 2),
                number(&zip, at + 20, 4),
                number(&zip, at + 42, 4),
            );
            let data = local + 30 + number(&zip, local + 26, 2) + number(&zip, local + 28, 2);
            let packed = &zip[data..data + size];
            let mut bytes = Vec::new();
            match method {
                0 => bytes.extend_from_slice(packed),
                8 => {
                    let mut inflate = flate2::read::DeflateDecoder::new(packed);
                    inflate.read_to_end(&mut bytes).unwrap();
                }
                other => panic!("{name}: compression method {other}"),
            }
            return npy(&bytes);
        }
        at += 46 + name_length + extra + comment;
    }
    panic!("{} has no {name}", path.display());
}

fn npy(bytes: &[u8]) -> Array {
    assert_eq!(&bytes[..6], b"\x93NUMPY");
    let (start, length) = match bytes[6] {
        1 => (10, number(bytes, 8, 2)),
        _ => (12, number(bytes, 8, 4)),
    };
    let header = std::str::from_utf8(&bytes[start..start + length]).unwrap();
    assert!(header.contains("'fortran_order': False"), "{header}");
    let after = |key: &str| header.split_once(key).unwrap().1;
    let shape = after("'shape': (").split_once(')').unwrap().0;
    let shape: Vec<usize> = shape
        .split(',')
        .filter_map(|n| n.trim().parse().ok())
        .collect();
    let kind = after("'descr': '").split_once('\'').unwrap().0;
    let words = bytes[start + length..].as_chunks::<8>().0;
    let values: Vec<f64> = match kind {
        "<f8" => words.iter().map(|w| f64::from_le_bytes(*w)).collect(),
        "<i8" => words
            .iter()
            .map(|w| i64::from_le_bytes(*w) as f64)
            .collect(),
        other => panic!("element type {other}"),
    };
    assert_eq!(values.len(), shape.iter().product::<usize>());
    Array { shape, values }
}
