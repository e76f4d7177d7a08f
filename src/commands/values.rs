//! Reads and writes values at the faces of a shape: NumPy arrays, or text with one row for each
//! face.

use super::CommandError;
use super::npy::{self, Array, Elements};
use coseg::library::PolygonValues;
use coseg::mesh::as_utf8;
use std::path::Path;

/// The values in a file: integers are labels, others functions.
pub(crate) fn read(path: &Path) -> Result<PolygonValues, CommandError> {
    let bytes = std::fs::read(path).map_err(|source| CommandError::File {
        path: path.display().to_string(),
        source,
    })?;
    let parsed = match bytes.starts_with(npy::MAGIC) {
        true => from_npy(&bytes),
        false => from_text(&lines(&bytes)),
    };
    parsed.map_err(|e| CommandError::Failed(format!("{}: {e}", path.display())))
}

/// Decodes text in any Unicode encoding, with lines ended by LF alone.
pub(super) fn lines(bytes: &[u8]) -> String {
    let text = as_utf8(bytes);
    let text = String::from_utf8_lossy(&text);
    text.replace("\r\n", "\n").replace('\r', "\n")
}

/// Formats the values as a file: NumPy if its name ends in .npy, else text.
pub(crate) fn bytes(path: &Path, values: &PolygonValues) -> Vec<u8> {
    match path.extension().is_some_and(|e| e == "npy") {
        true => to_npy(values),
        false => text(values).into_bytes(),
    }
}

/// Formats the values as text, one row on each line.
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

fn from_npy(bytes: &[u8]) -> Result<PolygonValues, String> {
    let Array {
        elements,
        n_columns,
    } = npy::read(bytes)?;
    let dim = n_columns.unwrap_or(1);
    match elements {
        Elements::Integers(_) if dim > 1 => Err("labels have one axis".to_owned()),
        Elements::Integers(x) => {
            let label = |x: &i64| i32::try_from(*x).map_err(|_| format!("label {x} is too large"));
            let labels: Result<Vec<i32>, String> = x.iter().map(label).collect();
            labels.map(PolygonValues::Labels)
        }
        Elements::Floats(x) => {
            let values = x.iter().map(|x| *x as f32);
            Ok(PolygonValues::Functions(values.collect(), dim))
        }
    }
}

fn to_npy(values: &PolygonValues) -> Vec<u8> {
    match values {
        PolygonValues::Labels(labels) => coseg::mesh::write::npy(labels),
        PolygonValues::Functions(x, dim) => npy::floats(x, *dim),
    }
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
