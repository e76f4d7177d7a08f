//! Accessors of a glTF file become numbers: every range is checked before anything is read or allocated.

use super::json::{Accessor, Root, Shape};
use super::{ParseError, fault};
use std::borrow::Cow;

/// Component types, by their numbers in the file.
const I8: u32 = 5120;
const U8: u32 = 5121;
const I16: u32 = 5122;
const U16: u32 = 5123;
const U32: u32 = 5125;
const F32: u32 = 5126;

/// Data of the file, decoded when it is first asked for.
pub(super) struct Buffers<'a> {
    root: &'a Root<'a>,
    binary: Option<&'a [u8]>,
    decoded: Vec<Option<Cow<'a, [u8]>>>,
}

/// Entries at equal distances.
struct Strided<'a> {
    bytes: &'a [u8],
    stride: usize,
    size: usize,
    count: usize,
}

impl Strided<'_> {
    fn entries(&self) -> impl Iterator<Item = &[u8]> {
        (0..self.count).map(|i| &self.bytes[i * self.stride..i * self.stride + self.size])
    }
}

impl<'a> Buffers<'a> {
    pub(super) fn new(root: &'a Root<'a>, binary: Option<&'a [u8]>) -> Self {
        Self {
            root,
            binary,
            decoded: vec![None; root.buffers.0.len()],
        }
    }

    /// The accessor of that number.
    pub(super) fn accessor(&self, index: u32) -> Result<&'a Accessor, ParseError> {
        let accessors = &self.root.accessors.0;
        accessors.get(index as usize).ok_or_else(|| {
            let n = accessors.len();
            fault(
                format_args!("a primitive"),
                format_args!("names accessor {index}, but the file has {n}"),
            )
        })
    }

    /// Positions that an accessor holds.
    pub(super) fn positions(&mut self, index: u32) -> Result<Vec<[f64; 3]>, ParseError> {
        let accessor = self.accessor(index)?;
        if accessor.shape != Shape::Vec3 || accessor.component_type == U32 {
            return Err(fault(
                format_args!("accessor {index}"),
                format_args!("holds positions, but not as VEC3 of float, byte or short"),
            ));
        }
        let kind = accessor.component_type;
        let size = component_size(kind, index)?;
        let read = |entry: &[u8]| -> [f64; 3] {
            std::array::from_fn(|i| {
                component(kind, accessor.normalized, &entry[i * size..(i + 1) * size])
            })
        };
        self.values(accessor, index, 3 * size, [0.0; 3], read)
    }

    /// Indices that an accessor holds.
    pub(super) fn indices(&mut self, index: u32) -> Result<Vec<u32>, ParseError> {
        let accessor = self.accessor(index)?;
        let kind = accessor.component_type;
        if accessor.shape != Shape::Scalar || ![U8, U16, U32].contains(&kind) {
            return Err(fault(
                format_args!("accessor {index}"),
                format_args!("holds indices, but not as SCALAR of unsigned integers"),
            ));
        }
        let size = component_size(kind, index)?;
        self.values(accessor, index, size, 0, |entry| {
            component(kind, false, entry) as u32
        })
    }

    /// The entries of an accessor, with its sparse ones in their places.
    fn values<T: Clone>(
        &mut self,
        accessor: &Accessor,
        index: u32,
        size: usize,
        zero: T,
        read: impl Fn(&[u8]) -> T,
    ) -> Result<Vec<T>, ParseError> {
        let place = format!("accessor {index}");
        let mut values = match accessor.buffer_view {
            Some(view) => {
                let range = (accessor.byte_offset, accessor.count, size);
                self.strided(view, range, true, &place)?
                    .entries()
                    .map(&read)
                    .collect()
            }
            // All zeros; the caller has bounded their number.
            None => vec![zero; accessor.count as usize],
        };
        let Some(sparse) = &accessor.sparse else {
            return Ok(values);
        };
        if sparse.count > accessor.count {
            return Err(fault(
                format_args!("{place}"),
                format_args!(
                    "replaces {} entries, but has {}",
                    sparse.count, accessor.count
                ),
            ));
        }
        let kind = sparse.indices.component_type;
        if ![U8, U16, U32].contains(&kind) {
            return Err(fault(
                format_args!("{place}"),
                format_args!("has sparse indices that are no unsigned integers"),
            ));
        }
        let index_size = component_size(kind, index)?;
        let range = (sparse.indices.byte_offset, sparse.count, index_size);
        let indices = self.strided(sparse.indices.buffer_view, range, false, &place)?;
        let at: Vec<u32> = indices
            .entries()
            .map(|e| component(kind, false, e) as u32)
            .collect();
        let range = (sparse.values.byte_offset, sparse.count, size);
        let replacements = self.strided(sparse.values.buffer_view, range, false, &place)?;
        let n = values.len();
        for (at, entry) in at.into_iter().zip(replacements.entries()) {
            *values.get_mut(at as usize).ok_or_else(|| {
                fault(
                    format_args!("{place}"),
                    format_args!("replaces entry {at}, but has {n}"),
                )
            })? = read(entry);
        }
        Ok(values)
    }

    /// `count` entries of `size` bytes from `offset` on in a buffer view.
    fn strided(
        &mut self,
        view: u32,
        (offset, count, size): (u64, u64, usize),
        may_stride: bool,
        place: &str,
    ) -> Result<Strided<'_>, ParseError> {
        let views = &self.root.buffer_views.0;
        let n_views = views.len();
        let found = views.get(view as usize).ok_or_else(|| {
            fault(
                format_args!("{place}"),
                format_args!("names buffer view {view}, but the file has {n_views}"),
            )
        })?;
        let buffer = self.buffer(found.buffer)?;
        let n_bytes = buffer.len();
        let bytes = part(buffer, found.byte_offset, found.byte_length).ok_or_else(|| {
            fault(
                format_args!("buffer view {view}"),
                format_args!(
                    "has {} bytes from byte {} on, but buffer {} has {n_bytes}",
                    found.byte_length, found.byte_offset, found.buffer
                ),
            )
        })?;
        let stride = found
            .byte_stride
            .filter(|_| may_stride)
            .unwrap_or(size as u64);
        if stride < size as u64 {
            return Err(fault(
                format_args!("buffer view {view}"),
                format_args!("has a stride of {stride} bytes, but an entry takes {size}"),
            ));
        }
        let needed = match count {
            0 => Some(0),
            n => stride
                .checked_mul(n - 1)
                .and_then(|b| b.checked_add(size as u64)),
        };
        let bytes = needed.and_then(|needed| part(bytes, offset, needed)).ok_or_else(|| {
            fault(
                format_args!("{place}"),
                format_args!(
                    "has {count} entries from byte {offset} on, but buffer view {view} has {} bytes",
                    found.byte_length
                ),
            )
        })?;
        Ok(Strided {
            bytes,
            stride: stride as usize,
            size,
            count: count as usize,
        })
    }

    fn buffer(&mut self, index: u32) -> Result<&[u8], ParseError> {
        let buffers = &self.root.buffers.0;
        let Some(buffer) = buffers.get(index as usize) else {
            let n = buffers.len();
            return Err(fault(
                format_args!("a buffer view"),
                format_args!("names buffer {index}, but the file has {n}"),
            ));
        };
        let slot = &mut self.decoded[index as usize];
        if slot.is_none() {
            let bytes = match (&buffer.uri, self.binary) {
                (None, Some(binary)) if index == 0 => Cow::Borrowed(binary),
                (None, _) => {
                    return Err(fault(
                        format_args!("buffer {index}"),
                        format_args!("has no data in the file"),
                    ));
                }
                (Some(uri), _) => Cow::Owned(data_uri(uri, index)?),
            };
            let (found, declared) = (bytes.len() as u64, buffer.byte_length);
            if declared > found {
                return Err(fault(
                    format_args!("buffer {index}"),
                    format_args!("declares {declared} bytes, but has {found}"),
                ));
            }
            *slot = Some(bytes);
        }
        // A binary chunk may be padded beyond the buffer.
        Ok(slot
            .as_ref()
            .map_or(&[][..], |bytes| &bytes[..buffer.byte_length as usize]))
    }
}

fn part(bytes: &[u8], offset: u64, length: u64) -> Option<&[u8]> {
    let start = usize::try_from(offset).ok()?;
    let end = start.checked_add(usize::try_from(length).ok()?)?;
    bytes.get(start..end)
}

fn component_size(kind: u32, accessor: u32) -> Result<usize, ParseError> {
    match kind {
        I8 | U8 => Ok(1),
        I16 | U16 => Ok(2),
        U32 | F32 => Ok(4),
        _ => Err(fault(
            format_args!("accessor {accessor}"),
            format_args!("has components of type {kind}, which glTF does not know"),
        )),
    }
}

/// A component of as many bytes as its type has; normalised integers are in −1 to 1.
fn component(kind: u32, normalized: bool, bytes: &[u8]) -> f64 {
    let mut word = [0; 4];
    word[..bytes.len()].copy_from_slice(bytes);
    let bits = u32::from_le_bytes(word);
    let (value, largest) = match kind {
        I8 => (f64::from(bits as i8), 127.0),
        U8 => (f64::from(bits as u8), 255.0),
        I16 => (f64::from(bits as i16), 32_767.0),
        U16 => (f64::from(bits as u16), 65_535.0),
        U32 => return f64::from(bits),
        _ => return f64::from(f32::from_bits(bits)),
    };
    if normalized {
        (value / largest).max(-1.0)
    } else {
        value
    }
}

/// The bytes of a `data:` URI; no other is followed.
fn data_uri(uri: &str, buffer: u32) -> Result<Vec<u8>, ParseError> {
    let place = format_args!("buffer {buffer}");
    let Some(data) = uri.strip_prefix("data:") else {
        let shown = super::shown(uri.as_bytes());
        return Err(fault(
            place,
            format_args!(
                "is in another file (\"{shown}\"), which is never read: export a single .glb"
            ),
        ));
    };
    let encoded = data
        .split_once(',')
        .filter(|(kind, _)| kind.ends_with(";base64"));
    let decoded = encoded.and_then(|(_, text)| base64(text.as_bytes()));
    decoded.ok_or_else(|| {
        fault(
            format_args!("buffer {buffer}"),
            format_args!("has a data URI that is not valid base64"),
        )
    })
}

/// Decodes base64 (RFC 4648, section 4), with or without padding.
fn base64(text: &[u8]) -> Option<Vec<u8>> {
    let text = text
        .strip_suffix(b"==")
        .or(text.strip_suffix(b"="))
        .unwrap_or(text);
    if text.len() % 4 == 1 {
        return None;
    }
    let mut bytes = Vec::with_capacity(text.len() / 4 * 3 + 2);
    for group in text.chunks(4) {
        let mut bits = 0_u32;
        for i in 0..4 {
            let sextet = match group.get(i) {
                Some(c @ b'A'..=b'Z') => c - b'A',
                Some(c @ b'a'..=b'z') => c - b'a' + 26,
                Some(c @ b'0'..=b'9') => c - b'0' + 52,
                Some(b'+') => 62,
                Some(b'/') => 63,
                Some(_) => return None,
                None => 0,
            };
            bits = bits << 6 | u32::from(sextet);
        }
        bytes.extend_from_slice(&bits.to_be_bytes()[1..group.len()]);
    }
    Some(bytes)
}

#[cfg(test)]
mod tests {
    use super::base64;

    #[test]
    fn base64_is_decoded_and_other_text_refused() {
        for (text, bytes) in [
            ("", &b""[..]),
            ("Zg==", b"f"),
            ("Zm8=", b"fo"),
            ("Zm8", b"fo"),
            ("Zm9v", b"foo"),
            ("+/9A", &[0xfb, 0xff, 0x40]),
        ] {
            assert_eq!(base64(text.as_bytes()).as_deref(), Some(bytes), "{text}");
        }
        for text in ["Z", "Zm9vY", "Zm 9", "Zm9-", "=Zg="] {
            assert_eq!(base64(text.as_bytes()), None, "{text}");
        }
    }
}
