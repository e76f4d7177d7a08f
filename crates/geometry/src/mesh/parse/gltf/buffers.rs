//! Accessors of a glTF file become numbers: every range is checked before anything is read or allocated.

use super::{ParseError, fault, shown};
use base64::Engine as _;
use base64::engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig};
use gltf::accessor::sparse::IndexType;
use gltf::accessor::util::ItemIter;
use gltf::accessor::{DataType, Dimensions, Item};
use gltf::buffer::{Source, View};
use gltf::{Accessor, Document};
use std::borrow::Cow;

/// Standard base64, with or without padding.
const BASE64: GeneralPurpose = GeneralPurpose::new(
    &base64::alphabet::STANDARD,
    GeneralPurposeConfig::new().with_decode_padding_mode(DecodePaddingMode::Indifferent),
);

/// The data of a file, or why it has none.
pub(super) struct Buffers<'a>(Vec<Result<Cow<'a, [u8]>, ParseError>>);

/// Where the entries of an accessor are: in a view from `offset` on.
struct Range<'a> {
    view: View<'a>,
    offset: usize,
    count: usize,
    /// Whether entries may lie apart.
    strides: bool,
}

impl<'a> Buffers<'a> {
    pub(super) fn new(document: &'a Document, binary: Option<&'a [u8]>) -> Self {
        let data = |buffer: gltf::Buffer<'a>| {
            let place = format_args!("buffer {}", buffer.index()).to_string();
            let bytes = match buffer.source() {
                Source::Bin if buffer.index() == 0 => binary.map(Cow::Borrowed),
                Source::Bin => None,
                Source::Uri(uri) => Some(Cow::Owned(data_uri(uri, &place)?)),
            };
            let bytes = bytes.ok_or_else(|| fault(&place, "has no data in the file"))?;
            // A binary chunk may be padded beyond the buffer.
            let declared = buffer.length();
            if declared > bytes.len() {
                let found = bytes.len();
                let why = format_args!("declares {declared} bytes, but has {found}").to_string();
                return Err(fault(&place, why));
            }
            Ok(match bytes {
                Cow::Borrowed(bytes) => Cow::Borrowed(&bytes[..declared]),
                Cow::Owned(mut bytes) => {
                    bytes.truncate(declared);
                    Cow::Owned(bytes)
                }
            })
        };
        Self(document.buffers().map(data).collect())
    }

    /// Positions that an accessor holds; normalised integers are in −1 to 1.
    pub(super) fn positions(&self, accessor: &Accessor<'_>) -> Result<Vec<[f64; 3]>, ParseError> {
        let wrong = || {
            fault(
                format_args!("accessor {}", accessor.index()),
                "holds positions, but not as VEC3 of float, byte or short",
            )
        };
        if accessor.dimensions() != Dimensions::Vec3 {
            return Err(wrong());
        }
        match accessor.data_type() {
            DataType::F32 => self.points::<f32>(accessor, None),
            DataType::I8 => self.points::<i8>(accessor, Some(127.0)),
            DataType::U8 => self.points::<u8>(accessor, Some(255.0)),
            DataType::I16 => self.points::<i16>(accessor, Some(32_767.0)),
            DataType::U16 => self.points::<u16>(accessor, Some(65_535.0)),
            DataType::U32 => Err(wrong()),
        }
    }

    fn points<T: Item + Copy + Into<f64>>(
        &self,
        accessor: &Accessor<'_>,
        largest: Option<f64>,
    ) -> Result<Vec<[f64; 3]>, ParseError> {
        let largest = largest.filter(|_| accessor.normalized());
        let real = |value: T| match largest {
            Some(largest) => (value.into() / largest).max(-1.0),
            None => value.into(),
        };
        let values = self.values::<[T; 3]>(accessor)?;
        Ok(values.into_iter().map(|point| point.map(real)).collect())
    }

    /// Indices that an accessor holds.
    pub(super) fn indices(&self, accessor: &Accessor<'_>) -> Result<Vec<u32>, ParseError> {
        let scalar = accessor.dimensions() == Dimensions::Scalar;
        match accessor.data_type() {
            DataType::U8 if scalar => self.integers::<u8>(accessor),
            DataType::U16 if scalar => self.integers::<u16>(accessor),
            DataType::U32 if scalar => self.integers::<u32>(accessor),
            _ => Err(fault(
                format_args!("accessor {}", accessor.index()),
                "holds indices, but not as SCALAR of unsigned integers",
            )),
        }
    }

    fn integers<T: Item + Copy + Into<u32>>(
        &self,
        accessor: &Accessor<'_>,
    ) -> Result<Vec<u32>, ParseError> {
        let values = self.values::<T>(accessor)?;
        Ok(values.into_iter().map(Into::into).collect())
    }

    /// The entries of an accessor, with its sparse ones in their places.
    fn values<T: Item + Copy>(&self, accessor: &Accessor<'_>) -> Result<Vec<T>, ParseError> {
        let place = format!("accessor {}", accessor.index());
        let mut values: Vec<T> = match accessor.view() {
            Some(view) => {
                let range = Range {
                    view,
                    offset: accessor.offset(),
                    count: accessor.count(),
                    strides: true,
                };
                self.entries(range, &place)?.collect()
            }
            // All zeros; the caller has bounded their number.
            None => vec![T::zero(); accessor.count()],
        };
        let Some(sparse) = accessor.sparse() else {
            return Ok(values);
        };
        let n = values.len();
        if sparse.count() > n {
            let why = format!("replaces {} entries, but has {n}", sparse.count());
            return Err(fault(place, why));
        }
        let (at, replacements) = (sparse.indices(), sparse.values());
        let at = Range {
            view: at.view(),
            offset: at.offset(),
            count: sparse.count(),
            strides: false,
        };
        let at: Vec<u32> = match sparse.indices().index_type() {
            IndexType::U8 => self.entries::<u8>(at, &place)?.map(u32::from).collect(),
            IndexType::U16 => self.entries::<u16>(at, &place)?.map(u32::from).collect(),
            IndexType::U32 => self.entries::<u32>(at, &place)?.collect(),
        };
        let replacements = Range {
            view: replacements.view(),
            offset: replacements.offset(),
            count: sparse.count(),
            strides: false,
        };
        for (at, value) in at.into_iter().zip(self.entries(replacements, &place)?) {
            *values
                .get_mut(at as usize)
                .ok_or_else(|| fault(&place, format_args!("replaces entry {at}, but has {n}")))? =
                value;
        }
        Ok(values)
    }

    /// The entries of a range, all of which are there.
    fn entries<T: Item>(
        &self,
        range: Range<'_>,
        place: &str,
    ) -> Result<ItemIter<'_, T>, ParseError> {
        let (view, size) = (&range.view, size_of::<T>());
        let buffer = self.0[view.buffer().index()]
            .as_ref()
            .map_err(Clone::clone)?;
        let bytes = part(buffer, view.offset(), view.length()).ok_or_else(|| {
            fault(
                format_args!("buffer view {}", view.index()),
                format_args!(
                    "has {} bytes from byte {} on, but buffer {} has {}",
                    view.length(),
                    view.offset(),
                    view.buffer().index(),
                    buffer.len()
                ),
            )
        })?;
        let stride = view.stride().filter(|_| range.strides).unwrap_or(size);
        if stride < size {
            return Err(fault(
                format_args!("buffer view {}", view.index()),
                format_args!("has a stride of {stride} bytes, but an entry takes {size}"),
            ));
        }
        let needed = match range.count {
            0 => Some(0),
            n => stride.checked_mul(n - 1).and_then(|b| b.checked_add(size)),
        };
        let bytes = needed.and_then(|needed| part(bytes, range.offset, needed));
        let bytes = bytes.ok_or_else(|| {
            fault(
                place,
                format_args!(
                    "has {} entries from byte {} on, but buffer view {} has {} bytes",
                    range.count,
                    range.offset,
                    view.index(),
                    view.length()
                ),
            )
        })?;
        Ok(ItemIter::new(bytes, stride))
    }
}

fn part(bytes: &[u8], offset: usize, length: usize) -> Option<&[u8]> {
    bytes.get(offset..offset.checked_add(length)?)
}

/// The bytes of a `data:` URI; no other is followed.
fn data_uri(uri: &str, place: &str) -> Result<Vec<u8>, ParseError> {
    let Some(data) = uri.strip_prefix("data:") else {
        let shown = shown(uri.as_bytes());
        let why =
            format!("is in another file (\"{shown}\"), which is never read: export a single .glb");
        return Err(fault(place, why));
    };
    data.split_once(',')
        .filter(|(kind, _)| kind.ends_with(";base64"))
        .and_then(|(_, text)| BASE64.decode(text).ok())
        .ok_or_else(|| fault(place, "has a data URI that is not valid base64"))
}
