//! Decompresses views of `EXT_meshopt_compression` by `meshopt`.

use super::document::Compressed;
use meshopt::{
    decode_filter_exp, decode_index_buffer, decode_index_sequence, decode_vertex_buffer,
};

/// Limits on the size of decompressed views: a ratio, and bytes beyond it. A real mesh takes at
/// least one compressed byte for each triangle and three for each vertex.
const MAX_RATIO: usize = 64;
const ALLOWANCE: usize = 1 << 16;

/// An entry of `N` bytes, which the decoder writes word by word.
#[derive(Clone)]
#[repr(align(4))]
struct Entry<const N: usize>([u8; N]);

impl<const N: usize> Default for Entry<N> {
    fn default() -> Self {
        Self([0; N])
    }
}

/// The contents of a view, or the error of its decoder.
pub(super) fn decode(view: &Compressed, bytes: &[u8]) -> Result<Vec<u8>, String> {
    let (stride, count) = (view.byte_stride.0, view.count.0);
    let most = bytes
        .len()
        .saturating_mul(MAX_RATIO)
        .saturating_add(ALLOWANCE);
    if count.checked_mul(stride).is_none_or(|n| n > most) {
        return Err(format!(
            "declares {count} entries of {stride} bytes, but {} compressed bytes hold at most \
             {most}",
            bytes.len()
        ));
    }
    if stride == 0 {
        return Err("declares entries of 0 bytes".to_owned());
    }
    let damaged = |_| "cannot be decompressed: its bytes are damaged".to_owned();
    let mut decoded = match (view.mode.as_str(), stride) {
        ("ATTRIBUTES", 4..=256) if stride.is_multiple_of(4) => vertices(bytes, count, stride),
        ("TRIANGLES", 2) if count.is_multiple_of(3) => {
            decode_index_buffer::<u16>(bytes, count).map(raw)
        }
        ("TRIANGLES", 4) if count.is_multiple_of(3) => {
            decode_index_buffer::<u32>(bytes, count).map(raw)
        }
        ("INDICES", 2) => decode_index_sequence::<u16>(bytes, count).map(raw),
        ("INDICES", 4) => decode_index_sequence::<u32>(bytes, count).map(raw),
        (mode, _) => {
            return Err(format!(
                "is compressed in a way that is not known: mode {:?} with {count} entries of \
                 {stride} bytes",
                mode.chars().take(20).collect::<String>()
            ));
        }
    }
    .map_err(damaged)?;
    match view.filter.as_deref() {
        None | Some("NONE") => {}
        Some("EXPONENTIAL") => {
            let mut words: Vec<[u32; 1]> = decoded
                .chunks_exact(4)
                .map(|word| [bytemuck::pod_read_unaligned(word)])
                .collect();
            decode_filter_exp(&mut words);
            decoded = bytemuck::cast_slice(&words).to_vec();
        }
        // The filters of normals and rotations.
        Some(other) => {
            let other: String = other.chars().take(20).collect();
            return Err(format!(
                "has the filter {other:?}, which positions cannot have"
            ));
        }
    }
    Ok(decoded)
}

fn raw<T: bytemuck::NoUninit>(values: Vec<T>) -> Vec<u8> {
    bytemuck::cast_slice(&values).to_vec()
}

/// Decodes entries of a size known only at run time, by a decoder for each size.
fn vertices(bytes: &[u8], count: usize, stride: usize) -> meshopt::Result<Vec<u8>> {
    macro_rules! by_words {
        ($($words:literal)+) => {
            match stride / 4 {
                $($words => of_size::<{ 4 * $words }>(bytes, count),)+
                _ => unreachable!("strides are 4 to 256"),
            }
        };
    }
    by_words!(
        1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20 21 22 23 24 25 26 27 28 29 30 31 32
        33 34 35 36 37 38 39 40 41 42 43 44 45 46 47 48
        49 50 51 52 53 54 55 56 57 58 59 60 61 62 63 64
    )
}

fn of_size<const N: usize>(bytes: &[u8], count: usize) -> meshopt::Result<Vec<u8>> {
    let entries = decode_vertex_buffer::<Entry<N>>(bytes, count)?;
    Ok(entries.iter().flat_map(|entry| entry.0).collect())
}
