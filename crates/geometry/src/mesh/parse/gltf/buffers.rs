//! Reads the numbers of the accessors of a glTF file; every range is checked before it is read or
//! allocated.

use super::super::{ParseError, shown};
use super::document::{Accessor, Buffer, Document, View, Whole, named};
use super::{compressed, fault};
use base64::Engine as _;
use base64::engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig};
use bytemuck::Pod;
use percent_encoding::percent_decode_str;
use std::borrow::Cow;
use std::cell::{Cell, OnceCell};

/// Standard base64, with or without padding.
pub(in crate::mesh) const BASE64: GeneralPurpose = GeneralPurpose::new(
    &base64::alphabet::STANDARD,
    GeneralPurposeConfig::new().with_decode_padding_mode(DecodePaddingMode::Indifferent),
);

/// The data of a file, or the reason why it has none.
pub(super) struct Buffers<'a> {
    document: &'a Document,
    data: Vec<Result<Cow<'a, [u8]>, ParseError>>,
    /// Decompressed views; each is filled at its first use.
    decoded: Vec<OnceCell<Result<Vec<u8>, ParseError>>>,
    n_decoded: Cell<usize>,
}

/// The range of the entries of an accessor: in a view from `offset` on.
struct Range<'a> {
    view: Whole,
    /// The location that refers to the view.
    named: &'a str,
    offset: usize,
    count: usize,
    /// Whether entries may have gaps between them.
    strides: bool,
}

impl<'a> Buffers<'a> {
    pub(super) fn new(document: &'a Document, binary: Option<&'a [u8]>) -> Self {
        let buffers = document.buffers.iter().enumerate();
        Self {
            document,
            data: buffers.map(|(i, buffer)| data(i, buffer, binary)).collect(),
            decoded: document
                .buffer_views
                .iter()
                .map(|_| OnceCell::new())
                .collect(),
            n_decoded: Cell::new(0),
        }
    }

    /// Number of bytes of decompressed views.
    pub(super) fn n_decoded(&self) -> usize {
        self.n_decoded.get()
    }

    /// Decompresses the view of an accessor, if it is compressed: its contents count as part of the
    /// file.
    pub(super) fn prepare(&self, accessor: &Accessor) {
        if let Some(view) = accessor.buffer_view {
            // An error is reported where the accessor is read.
            let _ = self.view(view, "");
        }
    }

    /// The positions of an accessor; normalised integers are in −1 to 1.
    pub(super) fn positions(&self, accessor: Whole) -> Result<Vec<[f64; 3]>, ParseError> {
        let wrong = || {
            fault(
                format_args!("accessor {}", accessor.0),
                "holds positions, but not as VEC3 of float, byte or short",
            )
        };
        let it = &self.document.accessors[accessor.0];
        if it.dimensions != "VEC3" {
            return Err(wrong());
        }
        self.reals(accessor)?.ok_or_else(wrong)
    }

    /// The entries of an accessor of two to four real numbers, padded with zeros; normalised
    /// integers are in −1 to 1.
    pub(super) fn vectors(&self, accessor: Whole) -> Result<Vec<[f64; 4]>, ParseError> {
        fn padded<const N: usize>(values: Vec<[f64; N]>) -> Vec<[f64; 4]> {
            let pad = |v: [f64; N]| std::array::from_fn(|i| v.get(i).copied().unwrap_or(0.0));
            values.into_iter().map(pad).collect()
        }
        let found = match self.document.accessors[accessor.0].dimensions.as_str() {
            "VEC2" => self.reals::<2>(accessor)?.map(padded),
            "VEC3" => self.reals::<3>(accessor)?.map(padded),
            "VEC4" => self.reals::<4>(accessor)?.map(padded),
            _ => None,
        };
        found.ok_or_else(|| {
            let location = format_args!("accessor {}", accessor.0);
            fault(location, "holds no vectors of float, byte or short")
        })
    }

    /// `None` for integers of 32 bits, which glTF has for indices alone.
    fn reals<const N: usize>(&self, accessor: Whole) -> Result<Option<Vec<[f64; N]>>, ParseError>
    where
        [f32; N]: Pod,
        [i8; N]: Pod,
        [u8; N]: Pod,
        [i16; N]: Pod,
        [u16; N]: Pod,
    {
        let code = self.document.accessors[accessor.0].component_type;
        let found = match component(code, || format!("accessors[{}]", accessor.0))? {
            Component::F32 => self.points::<f32, N>(accessor, None),
            Component::I8 => self.points::<i8, N>(accessor, Some(127.0)),
            Component::U8 => self.points::<u8, N>(accessor, Some(255.0)),
            Component::I16 => self.points::<i16, N>(accessor, Some(32_767.0)),
            Component::U16 => self.points::<u16, N>(accessor, Some(65_535.0)),
            Component::U32 => return Ok(None),
        };
        found.map(Some)
    }

    fn points<T: Pod + Into<f64>, const N: usize>(
        &self,
        accessor: Whole,
        largest: Option<f64>,
    ) -> Result<Vec<[f64; N]>, ParseError>
    where
        [T; N]: Pod,
    {
        let largest = largest.filter(|_| self.document.accessors[accessor.0].normalized);
        let real = |value: T| match largest {
            Some(largest) => (value.into() / largest).max(-1.0),
            None => value.into(),
        };
        let values = self.values::<[T; N]>(accessor)?;
        Ok(values.into_iter().map(|point| point.map(real)).collect())
    }

    /// The indices of an accessor.
    pub(super) fn indices(&self, accessor: Whole) -> Result<Vec<u32>, ParseError> {
        let it = &self.document.accessors[accessor.0];
        let scalar = it.dimensions == "SCALAR";
        match component(it.component_type, || format!("accessors[{}]", accessor.0))? {
            Component::U8 if scalar => self.integers::<u8>(accessor),
            Component::U16 if scalar => self.integers::<u16>(accessor),
            Component::U32 if scalar => self.integers::<u32>(accessor),
            _ => Err(fault(
                format_args!("accessor {}", accessor.0),
                "holds indices, but not as SCALAR of unsigned integers",
            )),
        }
    }

    fn integers<T: Pod + Into<u32>>(&self, accessor: Whole) -> Result<Vec<u32>, ParseError> {
        let values = self.values::<T>(accessor)?;
        Ok(values.into_iter().map(Into::into).collect())
    }

    /// The entries of an accessor, including its sparse ones.
    fn values<T: Pod>(&self, accessor: Whole) -> Result<Vec<T>, ParseError> {
        let (it, location) = (
            &self.document.accessors[accessor.0],
            format!("accessor {}", accessor.0),
        );
        let path = |rest: &str| format!("accessors[{}].{rest}", accessor.0);
        let count = it.count.0;
        let mut values: Vec<T> = match it.buffer_view {
            Some(view) => {
                let range = Range {
                    view,
                    named: &path("bufferView"),
                    offset: it.byte_offset.0,
                    count,
                    strides: true,
                };
                self.entries(&range, &location)?
            }
            // An accessor without a view is all zeros; the caller has bounded their number.
            None => vec![T::zeroed(); count],
        };
        let Some(sparse) = &it.sparse else {
            return Ok(values);
        };
        let n = values.len();
        if sparse.count.0 > n {
            let why = format!("replaces {} entries, but has {n}", sparse.count.0);
            return Err(fault(location, why));
        }
        let at = Range {
            view: sparse.indices.buffer_view,
            named: &path("sparse.indices.bufferView"),
            offset: sparse.indices.byte_offset.0,
            count: sparse.count.0,
            strides: false,
        };
        let code = sparse.indices.component_type;
        let at: Vec<u32> = match component(code, || path("sparse.indices"))? {
            Component::U8 => widened(self.entries::<u8>(&at, &location)?),
            Component::U16 => widened(self.entries::<u16>(&at, &location)?),
            Component::U32 => self.entries::<u32>(&at, &location)?,
            _ => {
                return Err(fault(
                    location,
                    "has sparse indices that are no unsigned integers",
                ));
            }
        };
        let replacements = Range {
            view: sparse.values.buffer_view,
            named: &path("sparse.values.bufferView"),
            offset: sparse.values.byte_offset.0,
            count: sparse.count.0,
            strides: false,
        };
        for (at, value) in at.into_iter().zip(self.entries(&replacements, &location)?) {
            *values.get_mut(at as usize).ok_or_else(|| {
                fault(&location, format_args!("replaces entry {at}, but has {n}"))
            })? = value;
        }
        Ok(values)
    }

    /// The entries of a range, all of which must exist.
    fn entries<T: Pod>(&self, range: &Range<'_>, location: &str) -> Result<Vec<T>, ParseError> {
        let size = size_of::<T>();
        let (view, bytes) = self.view(range.view, range.named)?;
        let compressed = view.compressed().map(|c| c.byte_stride);
        let stride = view.byte_stride.or(compressed).filter(|_| range.strides);
        let stride = stride.map_or(size, |stride| stride.0);
        if stride < size {
            return Err(fault(
                format_args!("buffer view {}", range.view.0),
                format_args!("has a stride of {stride} bytes, but an entry takes {size}"),
            ));
        }
        let needed = match range.count {
            0 => Some(0),
            n => stride.checked_mul(n - 1).and_then(|b| b.checked_add(size)),
        };
        let found = needed.and_then(|needed| part(bytes, range.offset, needed));
        let found = found.ok_or_else(|| {
            fault(
                location,
                format_args!(
                    "has {} entries from byte {} on, but buffer view {} has {} bytes",
                    range.count,
                    range.offset,
                    range.view.0,
                    bytes.len()
                ),
            )
        })?;
        let entry = |i: usize| bytemuck::pod_read_unaligned(&found[i * stride..][..size]);
        Ok((0..range.count).map(entry).collect())
    }

    /// A view and its bytes; `named_by` is the location that refers to it.
    fn view(&self, index: Whole, named_by: &str) -> Result<(&View, &[u8]), ParseError> {
        let view = named(&self.document.buffer_views, index, "buffer view", named_by)?;
        let location = || format!("bufferViews[{}]", index.0);
        let stored = || self.stored(view.buffer, view.byte_offset, view.byte_length, index);
        let Some(packed) = view.compressed() else {
            return stored().map(|bytes| (view, bytes));
        };
        // A file may also contain a compressed view in plain form, for readers without the decoder.
        if let Ok(bytes) = stored() {
            return Ok((view, bytes));
        }
        let decoded = self.decoded[index.0].get_or_init(|| {
            let bytes =
                self.stored(packed.buffer, packed.byte_offset, packed.byte_length, index)?;
            let decoded =
                compressed::decode(packed, bytes).map_err(|why| fault(location(), why))?;
            self.n_decoded.set(self.n_decoded.get() + decoded.len());
            Ok(decoded)
        });
        decoded
            .as_deref()
            .map(|bytes| (view, bytes))
            .map_err(Clone::clone)
    }

    /// The bytes of a buffer that belong to a view.
    fn stored(
        &self,
        buffer: Whole,
        offset: Whole,
        length: Whole,
        view: Whole,
    ) -> Result<&[u8], ParseError> {
        let data = named(
            &self.data,
            buffer,
            "buffer",
            format_args!("bufferViews[{}].buffer", view.0),
        )?;
        let data = data.as_ref().map_err(Clone::clone)?;
        part(data, offset.0, length.0).ok_or_else(|| {
            fault(
                format_args!("buffer view {}", view.0),
                format_args!(
                    "has {} bytes from byte {} on, but buffer {} has {}",
                    length.0,
                    offset.0,
                    buffer.0,
                    data.len()
                ),
            )
        })
    }
}

fn widened<T: Into<u32>>(values: Vec<T>) -> Vec<u32> {
    values.into_iter().map(Into::into).collect()
}

/// The bytes of a buffer, of its declared length.
fn data<'a>(
    index: usize,
    buffer: &Buffer,
    binary: Option<&'a [u8]>,
) -> Result<Cow<'a, [u8]>, ParseError> {
    let location = format!("buffer {index}");
    let bytes = match &buffer.uri {
        Some(uri) => Some(Cow::Owned(data_uri(uri, &location)?)),
        None if index == 0 => binary.map(Cow::Borrowed),
        None => None,
    };
    let bytes = bytes.ok_or_else(|| fault(&location, "has no data in the file"))?;
    // A binary chunk may be padded beyond the buffer.
    let declared = buffer.byte_length.0;
    if declared > bytes.len() {
        let found = bytes.len();
        let why = format!("declares {declared} bytes, but has {found}");
        return Err(fault(&location, why));
    }
    Ok(match bytes {
        Cow::Borrowed(bytes) => Cow::Borrowed(&bytes[..declared]),
        Cow::Owned(mut bytes) => {
            bytes.truncate(declared);
            Cow::Owned(bytes)
        }
    })
}

#[derive(Clone, Copy)]
enum Component {
    I8,
    U8,
    I16,
    U16,
    U32,
    F32,
}

fn component(code: Whole, location: impl Fn() -> String) -> Result<Component, ParseError> {
    Ok(match code.0 {
        5120 => Component::I8,
        5121 => Component::U8,
        5122 => Component::I16,
        5123 => Component::U16,
        5125 => Component::U32,
        5126 => Component::F32,
        other => {
            let location = format!("{}.componentType", location());
            return Err(fault(
                location,
                format_args!("is {other}, which glTF does not know"),
            ));
        }
    })
}

fn part(bytes: &[u8], offset: usize, length: usize) -> Option<&[u8]> {
    bytes.get(offset..offset.checked_add(length)?)
}

/// The bytes of a `data:` URI; other URIs are not followed.
pub(in crate::mesh) fn data_uri(uri: &str, location: &str) -> Result<Vec<u8>, ParseError> {
    let is_data = uri
        .get(..5)
        .is_some_and(|start| start.eq_ignore_ascii_case("data:"));
    if !is_data {
        let shown = shown(uri.as_bytes());
        let why = format!(
            "is in another file (\"{shown}\"), which is not sent along: `coseg add` and the \
             clients pack both into one when they are given the path; or export a single .glb"
        );
        return Err(fault(location, why));
    }
    let wrong = || fault(location, "has a data URI that is not valid base64");
    let (kind, text) = uri[5..].split_once(',').ok_or_else(wrong)?;
    let plain = Cow::from(percent_decode_str(text));
    if kind.to_ascii_lowercase().ends_with(";base64") {
        return BASE64.decode(plain).map_err(|_| wrong());
    }
    Ok(plain.into_owned())
}
