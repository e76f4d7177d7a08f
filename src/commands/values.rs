//! Values at the faces of a shape are read from and written to files: NumPy arrays, or text with a row a face.

use super::CommandError;
use coseg::library::PolygonValues;
use std::path::Path;

/// Where every NumPy file begins.
const MAGIC: &[u8] = b"\x93NUMPY";

/// The values in a file: integers are labels, others functions.
pub(crate) fn read(path: &Path) -> Result<PolygonValues, CommandError> {
    let bytes = std::fs::read(path).map_err(|source| CommandError::File {
        path: path.display().to_string(),
        source,
    })?;
    let parsed = match bytes.starts_with(MAGIC) {
        true => from_npy(&bytes),
        false => from_text(&String::from_utf8_lossy(&bytes)),
    };
    parsed.map_err(|e| CommandError::Failed(format!("{}: {e}", path.display())))
}

/// The values as the bytes of a file: NumPy if its name ends so, else text.
pub(crate) fn bytes(path: &Path, values: &PolygonValues) -> Vec<u8> {
    match path.extension().is_some_and(|e| e == "npy") {
        true => to_npy(values),
        false => text(values).into_bytes(),
    }
}

/// The values as text, a row a line.
pub(crate) fn text(values: &PolygonValues) -> String {
    match values {
        PolygonValues::Labels(labels) => labels.iter().map(|l| format!("{l}\n")).collect(),
        PolygonValues::Functions(x, dim) => {
            let rows = x.chunks_exact((*dim).max(1));
            rows.map(|row| {
                let row: Vec<String> = row.iter().map(f32::to_string).collect();
                format!("{}\n", row.join(" "))
            })
            .collect()
        }
    }
}

fn from_text(text: &str) -> Result<PolygonValues, String> {
    let rows: Vec<Vec<&str>> = text
        .lines()
        .map(|line| line.split_whitespace().collect())
        .filter(|row: &Vec<&str>| !row.is_empty())
        .collect();
    let dim = rows.first().map_or(0, Vec::len);
    if let Some(at) = rows.iter().position(|row| row.len() != dim) {
        let n = rows[at].len();
        return Err(format!(
            "row {} has {n} values, but the first has {dim}",
            at + 1
        ));
    }
    let words = || rows.iter().flatten();
    let labels: Result<Vec<i32>, _> = words().map(|w| w.parse()).collect();
    match labels {
        Ok(labels) if dim == 1 => Ok(PolygonValues::Labels(labels)),
        _ => {
            let number = |w: &&str| w.parse::<f32>().map_err(|_| format!("{w:?} is no number"));
            let values: Result<Vec<f32>, String> = words().map(number).collect();
            Ok(PolygonValues::Functions(values?, dim.max(1)))
        }
    }
}

/// Versions 1 to 3; rows first; little-endian integers and floats of four or eight bytes.
fn from_npy(bytes: &[u8]) -> Result<PolygonValues, String> {
    let short = || "the file ends within its heading".to_owned();
    let major = *bytes.get(6).ok_or_else(short)?;
    let (at, length) = match (major, bytes.get(8..12)) {
        (1, Some(n)) => (10_usize, usize::from(u16::from_le_bytes([n[0], n[1]]))),
        (2 | 3, Some(n)) => (12, u32::from_le_bytes([n[0], n[1], n[2], n[3]]) as usize),
        (_, None) => return Err(short()),
        _ => return Err(format!("version {major} of the format is not known")),
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
    if !after("fortran_order").is_some_and(|t| t.starts_with("False")) {
        return Err("columns come first; save it with rows first".to_owned());
    }
    let shape = after("shape").and_then(|t| t.strip_prefix('(')?.split(')').next());
    let extents: Result<Vec<usize>, _> = shape
        .unwrap_or_default()
        .split(',')
        .map(str::trim)
        .filter(|t| !t.is_empty())
        .map(str::parse)
        .collect();
    let extents = extents.map_err(|e| format!("its shape: {e}"))?;
    let dim = match extents[..] {
        [_] => 1,
        [_, dim] if dim > 0 => dim,
        _ => {
            return Err(format!(
                "it has {} axes, but may have 1 or 2",
                extents.len()
            ));
        }
    };
    let count = extents.iter().try_fold(1usize, |n, e| n.checked_mul(*e));
    let size = if kind.ends_with('8') { 8 } else { 4 };
    if count.and_then(|n| n.checked_mul(size)) != Some(data.len()) {
        let n = data.len();
        return Err(format!(
            "{n} bytes of data, which is not what its heading says"
        ));
    }
    let label = |x: i64| i32::try_from(x).map_err(|_| format!("label {x} is too large"));
    let (four, eight) = (data.as_chunks::<4>().0, data.as_chunks::<8>().0);
    let functions = |x: Vec<f32>| Ok(PolygonValues::Functions(x, dim));
    match kind {
        "<f4" => functions(four.iter().map(|b| f32::from_le_bytes(*b)).collect()),
        "<f8" => functions(
            eight
                .iter()
                .map(|b| f64::from_le_bytes(*b) as f32)
                .collect(),
        ),
        "<i4" | "<i8" if dim > 1 => Err("labels have one axis".to_owned()),
        "<i4" => {
            let labels = four.iter().map(|b| i32::from_le_bytes(*b));
            Ok(PolygonValues::Labels(labels.collect()))
        }
        "<i8" => {
            let labels: Result<Vec<i32>, String> = eight
                .iter()
                .map(|b| label(i64::from_le_bytes(*b)))
                .collect();
            labels.map(PolygonValues::Labels)
        }
        other => Err(format!(
            "elements of kind {other:?}, but <i4, <i8, <f4 and <f8 are read"
        )),
    }
}

fn to_npy(values: &PolygonValues) -> Vec<u8> {
    let (kind, shape, data): (_, _, Vec<u8>) = match values {
        PolygonValues::Labels(labels) => return coseg::mesh::write::npy(labels),
        PolygonValues::Functions(x, dim) => {
            let n = x.len() / (*dim).max(1);
            let shape = match dim {
                1 => format!("({n},)"),
                dim => format!("({n}, {dim})"),
            };
            (
                "<f4",
                shape,
                x.iter().flat_map(|x| x.to_le_bytes()).collect(),
            )
        }
    };
    let mut heading = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}");
    // Data begin at a multiple of 64 bytes, after a line end.
    while !(10 + heading.len() + 1).is_multiple_of(64) {
        heading.push(' ');
    }
    heading.push('\n');
    let mut out = MAGIC.to_vec();
    out.extend([1, 0]);
    out.extend((heading.len() as u16).to_le_bytes());
    out.extend(heading.as_bytes());
    out.extend(data);
    out
}

#[cfg(test)]
mod tests {
    use super::{from_npy, from_text, text, to_npy};
    use coseg::library::PolygonValues;

    #[test]
    fn text_and_numpy_read_back() {
        let labels = PolygonValues::Labels(vec![3, -1, 7]);
        let functions = PolygonValues::Functions(vec![0.5, 1.25, -2.0, f32::MAX], 2);
        for values in [&labels, &functions] {
            assert_eq!(from_text(&text(values)).as_ref(), Ok(values));
            assert_eq!(from_npy(&to_npy(values)).as_ref(), Ok(values));
        }
        let one = PolygonValues::Functions(vec![1.5, 2.0], 1);
        assert_eq!(from_text("1.5\n2\n"), Ok(one.clone()));
        assert_eq!(from_npy(&to_npy(&one)), Ok(one));
    }

    #[test]
    fn what_does_not_fit_is_told() {
        assert!(from_text("1 2\n3\n").unwrap_err().contains("row 2 has 1"));
        assert!(
            from_text("1\nx\n")
                .unwrap_err()
                .contains("\"x\" is no number")
        );
        let whole = to_npy(&PolygonValues::Labels(vec![1, 2, 3]));
        for end in 6..whole.len() {
            assert!(from_npy(&whole[..end]).is_err(), "cut at {end}");
        }
    }
}
