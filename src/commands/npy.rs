//! Reads and writes NumPy files: versions 1 to 3, integers and floats in either byte order.

/// The first bytes of every NumPy file.
pub(crate) const MAGIC: &[u8] = b"\x93NUMPY";

/// The elements of an array, rows first.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Elements {
    /// Elements of any integer type.
    Integers(Vec<i64>),
    /// Elements of four or eight bytes.
    Floats(Vec<f64>),
}

/// An array of one or two axes.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Array {
    pub(crate) elements: Elements,
    /// Length of the second axis, if there is one.
    pub(crate) n_columns: Option<usize>,
}

/// Parses the array in a file; the error describes the fault.
pub(crate) fn read(bytes: &[u8]) -> Result<Array, String> {
    let short = || "the file ends within its header".to_owned();
    let major = *bytes.get(6).ok_or_else(short)?;
    let (at, length) = match (major, bytes.get(8..12)) {
        (1, Some(n)) => (10_usize, usize::from(u16::from_le_bytes([n[0], n[1]]))),
        (2 | 3, Some(n)) => (12, u32::from_le_bytes([n[0], n[1], n[2], n[3]]) as usize),
        (_, None) => return Err(short()),
        _ => return Err(format!("version {major} of the format is unknown")),
    };
    let heading = bytes.get(at..at.saturating_add(length)).ok_or_else(short)?;
    let heading = String::from_utf8_lossy(heading);
    let data = &bytes[at + length..];
    let after = |key: &str| {
        let from = heading.find(&format!("'{key}':"))? + key.len() + 3;
        Some(heading[from..].trim_start())
    };
    let kind = after("descr").and_then(|t| t.strip_prefix('\''));
    let kind = kind.and_then(|t| t.split('\'').next()).unwrap_or_default();
    let shape = after("shape").and_then(|t| t.strip_prefix('(')?.split(')').next());
    let extents: Result<Vec<usize>, _> = shape
        .unwrap_or_default()
        .split(',')
        .map(str::trim)
        .filter(|t| !t.is_empty())
        .map(str::parse)
        .collect();
    let extents = extents.map_err(|e| format!("its shape: {e}"))?;
    let n_columns = match extents[..] {
        [_] => None,
        [_, n] if n > 0 => Some(n),
        _ => {
            let n = extents.len();
            return Err(format!("it has {n} axes, but may have 1 or 2"));
        }
    };
    let rows_first = after("fortran_order").is_some_and(|t| t.starts_with("False"));
    if !rows_first && n_columns.is_some_and(|n| n > 1) {
        return Err("columns come first; save it in row-major order".to_owned());
    }
    let count = extents.iter().try_fold(1usize, |n, e| n.checked_mul(*e));
    Ok(Array {
        elements: elements(kind, data, count)?,
        n_columns,
    })
}

/// Parses elements of a kind such as `<i4`, of which there must be `count`.
fn elements(kind: &str, data: &[u8], count: Option<usize>) -> Result<Elements, String> {
    let unknown = || format!("elements of kind {kind:?}, but integers, <f4 and <f8 are read");
    let (&order, what) = kind.as_bytes().split_first().ok_or_else(unknown)?;
    let (class, size) = match what {
        [class @ (b'i' | b'u'), size @ (b'1' | b'2' | b'4' | b'8')] => (class, size),
        [class @ b'b', size @ b'1'] | [class @ b'f', size @ (b'4' | b'8')] => (class, size),
        _ => return Err(unknown()),
    };
    let size = usize::from(size - b'0');
    if count.and_then(|n| n.checked_mul(size)) != Some(data.len()) {
        let n = data.len();
        return Err(format!("{n} bytes of data, which contradicts its header"));
    }
    // Converts an element to eight bytes, lowest first, extended by `fill`.
    let word = |element: &[u8], fill: fn(u8) -> u8| -> [u8; 8] {
        let byte = |i: usize| if order == b'>' { size - 1 - i } else { i };
        let high = fill(element[byte(size - 1)]);
        std::array::from_fn(|i| if i < size { element[byte(i)] } else { high })
    };
    let elements = data.chunks_exact(size);
    let zero = |_| 0;
    match (class, size) {
        (b'i', _) => {
            let sign = |top: u8| if top >= 0x80 { 0xff } else { 0 };
            let values = elements.map(|e| i64::from_le_bytes(word(e, sign)));
            Ok(Elements::Integers(values.collect()))
        }
        (b'u' | b'b', _) => {
            let value = |e: &[u8]| {
                let value = u64::from_le_bytes(word(e, zero));
                i64::try_from(value).map_err(|_| format!("{value} is too large"))
            };
            Ok(Elements::Integers(
                elements.map(value).collect::<Result<_, _>>()?,
            ))
        }
        (_, 4) => {
            let bits = |e: &[u8]| u64::from_le_bytes(word(e, zero)) as u32;
            let values = elements.map(|e| f64::from(f32::from_bits(bits(e))));
            Ok(Elements::Floats(values.collect()))
        }
        _ => {
            let values = elements.map(|e| f64::from_le_bytes(word(e, zero)));
            Ok(Elements::Floats(values.collect()))
        }
    }
}

/// Formats an array of floats with rows of `dim` as a file; it has one axis if `dim` is 1.
pub(crate) fn floats(values: &[f32], dim: usize) -> Vec<u8> {
    let n = values.len() / dim.max(1);
    let shape = match dim {
        1 => format!("({n},)"),
        dim => format!("({n}, {dim})"),
    };
    let mut heading = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}");
    // Data begin at a multiple of 64 bytes, after a line end.
    while !(10 + heading.len() + 1).is_multiple_of(64) {
        heading.push(' ');
    }
    heading.push('\n');
    let mut out = MAGIC.to_vec();
    out.extend([1, 0]);
    out.extend((heading.len() as u16).to_le_bytes());
    out.extend(heading.as_bytes());
    out.extend(values.iter().flat_map(|x| x.to_le_bytes()));
    out
}

#[cfg(test)]
mod tests {
    use super::{Elements, MAGIC, floats, read};

    fn file(kind: &str, shape: &str, order: &str, data: &[u8]) -> Vec<u8> {
        let heading =
            format!("{{'descr': '{kind}', 'fortran_order': {order}, 'shape': {shape}}}\n");
        let length = (heading.len() as u16).to_le_bytes();
        [MAGIC, &[1, 0], &length, heading.as_bytes(), data].concat()
    }

    #[test]
    fn integers_of_every_type_are_read() {
        for (kind, data, values) in [
            ("|i1", &[0xff, 3][..], [-1, 3]),
            ("|u1", &[0xff, 3], [255, 3]),
            ("|b1", &[0, 1], [0, 1]),
            ("<i2", &[0xff, 0xff, 3, 0], [-1, 3]),
            (">i2", &[0xff, 0xff, 0, 3], [-1, 3]),
            ("<u2", &[0xff, 0xff, 3, 0], [65_535, 3]),
            ("<i4", &[0xfe, 0xff, 0xff, 0xff, 3, 0, 0, 0], [-2, 3]),
            (">u4", &[0, 0, 1, 0, 0, 0, 0, 3], [256, 3]),
            (
                "<i8",
                &[
                    254, 255, 255, 255, 255, 255, 255, 255, 3, 0, 0, 0, 0, 0, 0, 0,
                ],
                [-2, 3],
            ),
            (
                ">u8",
                &[0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 3],
                [256, 3],
            ),
        ] {
            for (shape, order) in [("(2,)", "False"), ("(2,)", "True"), ("(2, 1)", "False")] {
                let array = read(&file(kind, shape, order, data)).unwrap();
                assert_eq!(
                    array.elements,
                    Elements::Integers(values.to_vec()),
                    "{kind}"
                );
            }
        }
        let floats = read(&file(
            ">f4",
            "(1, 2)",
            "False",
            &[0x3f, 0x80, 0, 0, 0xc0, 0, 0, 0],
        ));
        let floats = floats.unwrap();
        assert_eq!(floats.elements, Elements::Floats(vec![1.0, -2.0]));
        assert_eq!(floats.n_columns, Some(2));
    }

    #[test]
    fn what_is_not_read_is_named() {
        let message = |kind, shape, order| read(&file(kind, shape, order, &[0; 8])).unwrap_err();
        for kind in ["<c8", "<U2", "|O", "", "<", "<i", "<i16", "<f2", "<f1"] {
            let message = message(kind, "(2,)", "False");
            assert!(
                message.contains(&format!("kind {kind:?}")),
                "{kind}: {message}"
            );
        }
        assert!(message("<i4", "(2, 1, 1)", "False").contains("3 axes"));
        assert!(message("<i4", "()", "False").contains("0 axes"));
        assert!(message("<i2", "(2, 2)", "True").contains("columns come first"));
        assert!(message("<i4", "(3,)", "False").contains("8 bytes of data"));
        let large = read(&file("<u8", "(1,)", "False", &[0xff; 8])).unwrap_err();
        assert_eq!(large, "18446744073709551615 is too large");
        let whole = super::floats(&[1.0, 2.0], 1);
        assert_eq!(
            read(&whole).unwrap().elements,
            Elements::Floats(vec![1.0, 2.0])
        );
        for end in 6..whole.len() {
            assert!(read(&whole[..end]).is_err(), "cut at {end}");
        }
        assert_eq!(floats(&[], 1).len(), 128);
    }
}
