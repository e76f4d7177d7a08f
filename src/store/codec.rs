//! Packs arrays and opaque bytes as compact blobs for the catalog, and unpacks them.
//!
//! A packed blob is one byte of element width (1, 2 or 4), the number of elements (u32), and a zstd
//! frame of the little-endian elements. Labels are stored plus one, so that -1 and small ids fit
//! into a byte.

use std::io::{self, Read};

/// A blob that packing cannot have produced.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub(super) struct BadBlob(String);

fn bad<T>(message: impl Into<String>) -> Result<T, BadBlob> {
    Err(BadBlob(message.into()))
}

/// Level 3 packs labels to a few per cent; higher ones gain little on data this small.
const ZSTD_LEVEL: i32 = 3;

const HEADER: usize = 5;

fn pack(width: u8, count: usize, bytes: &[u8]) -> Vec<u8> {
    let count = u32::try_from(count).expect("invariant: arrays have fewer than 2^32 elements");
    let frame = zstd::bulk::compress(bytes, ZSTD_LEVEL)
        .expect("invariant: compressing into a buffer of the bound's size cannot fail");
    let mut blob = Vec::with_capacity(HEADER + frame.len());
    blob.push(width);
    blob.extend_from_slice(&count.to_le_bytes());
    blob.extend_from_slice(&frame);
    blob
}

/// Width and content; the content has exactly the number of elements in the header.
fn unpack(blob: &[u8]) -> Result<(u8, Vec<u8>), BadBlob> {
    let Some((header, frame)) = blob.split_first_chunk::<HEADER>() else {
        return bad(format!(
            "a packed blob has {} bytes, but at least {HEADER}",
            blob.len()
        ));
    };
    let [width, count @ ..] = *header;
    if !matches!(width, 1 | 2 | 4) {
        return bad(format!(
            "a packed blob has element width {width}, but 1, 2 or 4 is allowed"
        ));
    }
    let expected = u32::from_le_bytes(count) as usize * usize::from(width);
    match decompress(frame, expected) {
        Ok(bytes) if bytes.len() == expected => Ok((width, bytes)),
        Ok(bytes) => bad(format!(
            "a packed blob has {} bytes of {expected}",
            bytes.len()
        )),
        Err(e) => bad(format!("a packed blob does not decompress: {e}")),
    }
}

/// At most `limit` bytes of content; more is an error.
pub(super) fn decompress(stored: &[u8], limit: usize) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let decoder = zstd::stream::read::Decoder::with_buffer(stored)?;
    decoder
        .take((limit as u64).saturating_add(1))
        .read_to_end(&mut bytes)?;
    if bytes.len() > limit {
        return Err(io::Error::other(format!(
            "more than {limit} bytes of content"
        )));
    }
    Ok(bytes)
}

pub(super) fn pack_bytes(bytes: &[u8]) -> Vec<u8> {
    pack(1, bytes.len(), bytes)
}

pub(super) fn unpack_bytes(blob: &[u8]) -> Result<Vec<u8>, BadBlob> {
    match unpack(blob)? {
        (1, bytes) => Ok(bytes),
        (width, _) => bad(format!("packed bytes have element width {width}")),
    }
}

pub(super) fn pack_u32(values: &[u32]) -> Vec<u8> {
    match values.iter().max() {
        None | Some(0..=0xff) => {
            let bytes: Vec<u8> = values.iter().map(|&v| v as u8).collect();
            pack(1, values.len(), &bytes)
        }
        Some(0x100..=0xffff) => {
            let bytes: Vec<u8> = values
                .iter()
                .flat_map(|&v| (v as u16).to_le_bytes())
                .collect();
            pack(2, values.len(), &bytes)
        }
        Some(_) => pack(4, values.len(), bytemuck::cast_slice(values)),
    }
}

pub(super) fn unpack_u32(blob: &[u8]) -> Result<Vec<u32>, BadBlob> {
    let (width, bytes) = unpack(blob)?;
    Ok(match width {
        1 => bytes.into_iter().map(u32::from).collect(),
        2 => bytes
            .as_chunks()
            .0
            .iter()
            .map(|&v| u16::from_le_bytes(v).into())
            .collect(),
        _ => bytes
            .as_chunks()
            .0
            .iter()
            .map(|&v| u32::from_le_bytes(v))
            .collect(),
    })
}

pub(super) fn pack_labels(labels: &[i32]) -> Vec<u8> {
    let shifted: Vec<u32> = labels
        .iter()
        .map(|&label| label.wrapping_add(1) as u32)
        .collect();
    pack_u32(&shifted)
}

pub(super) fn unpack_labels(blob: &[u8]) -> Result<Vec<i32>, BadBlob> {
    Ok(unpack_u32(blob)?
        .into_iter()
        .map(|v| (v as i32).wrapping_sub(1))
        .collect())
}

/// Floats are stored uncompressed, since they hardly compress.
pub(super) fn floats_to_blob(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

pub(super) fn floats_from_blob(blob: &[u8]) -> Result<Vec<f32>, BadBlob> {
    match blob.as_chunks() {
        (values, []) => Ok(values.iter().map(|&v| f32::from_le_bytes(v)).collect()),
        _ => bad(format!(
            "{} bytes are not a whole number of floats",
            blob.len()
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_and_indices_of_every_width_read_back() {
        for labels in [
            vec![],
            vec![-1, 0, 1, 254],
            vec![-1, 255, 65_534],
            vec![65_535, i32::MAX, i32::MIN, -2],
        ] {
            assert_eq!(unpack_labels(&pack_labels(&labels)), Ok(labels));
        }
        for values in [vec![0, 255], vec![256, 65_535], vec![65_536, u32::MAX]] {
            assert_eq!(unpack_u32(&pack_u32(&values)), Ok(values));
        }
        assert_eq!(unpack_bytes(&pack_bytes(b"model")), Ok(b"model".to_vec()));
    }

    #[test]
    fn a_thousand_equal_labels_take_a_few_bytes() {
        assert!(pack_labels(&[3; 1000]).len() < 40);
    }

    #[test]
    fn bad_blobs_are_errors() {
        let blob = pack_labels(&[1, 2, 3, 400]);
        for end in 0..blob.len() {
            assert!(unpack_labels(&blob[..end]).is_err(), "cut at {end}");
        }
        let mut width = blob.clone();
        width[0] = 3;
        assert!(unpack_labels(&width).is_err());
        let mut count = blob.clone();
        count[1..5].copy_from_slice(&u32::MAX.to_le_bytes());
        assert!(unpack_labels(&count).is_err());
        count[1..5].copy_from_slice(&3_u32.to_le_bytes());
        assert!(unpack_labels(&count).is_err());
        assert!(unpack_bytes(&blob).is_err());
        assert!(floats_from_blob(&[0; 7]).is_err());
    }
}
