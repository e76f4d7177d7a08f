//! Reads a label for each face from a file: text with one on each line, NumPy, or a file of `coseg
//! export`.

use super::CommandError;
use super::npy::{self, Elements};
use super::values::lines;
use coseg::library::MAX_LABEL;
use serde_json::Value;
use std::path::Path;

/// The labels in a file. The format is recognised by its content.
pub(crate) fn read(path: &Path) -> Result<Vec<i32>, CommandError> {
    let bytes = std::fs::read(path).map_err(|source| CommandError::File {
        path: path.display().to_string(),
        source,
    })?;
    labels_of(&bytes).map_err(|why| CommandError::Failed(format!("{}: {why}", path.display())))
}

fn labels_of(bytes: &[u8]) -> Result<Vec<i32>, String> {
    if bytes.starts_with(npy::MAGIC) {
        return from_npy(bytes);
    }
    let text = lines(bytes);
    match text.trim_start().starts_with(['{', '[']) {
        true => from_json(&text),
        false => from_text(&text),
    }
}

/// Converts a number to a label; `location` describes its position in messages.
fn label(number: i64, location: impl Fn() -> String) -> Result<i32, String> {
    match i32::try_from(number) {
        Ok(label) if (-1..=i64::from(MAX_LABEL)).contains(&number) => Ok(label),
        _ => Err(format!(
            "{} is {number}, but must be -1 to {MAX_LABEL}",
            location()
        )),
    }
}

/// Blank lines may follow the last label; a blank line between labels is a missing label.
fn from_text(text: &str) -> Result<Vec<i32>, String> {
    let labels = text.trim_end().lines().enumerate().map(|(i, line)| {
        let word = line.trim();
        let location = || format!("line {}", i + 1);
        let number: i64 = word
            .parse()
            .map_err(|_| format!("{} is {word:?}, but must be an integer", location()))?;
        label(number, location)
    });
    labels.collect()
}

fn from_npy(bytes: &[u8]) -> Result<Vec<i32>, String> {
    let array = npy::read(bytes)?;
    if let Some(n) = array.n_columns.filter(|n| *n > 1) {
        return Err(format!("it has {n} columns, but labels have one axis"));
    }
    let Elements::Integers(numbers) = array.elements else {
        return Err("its elements are floats, but labels are integers".to_owned());
    };
    let numbers = numbers.into_iter().enumerate();
    numbers
        .map(|(i, n)| label(n, || format!("the label of face {i}")))
        .collect()
}

/// A list of labels, or an object that has one under `labels`.
fn from_json(text: &str) -> Result<Vec<i32>, String> {
    let value: Value = serde_json::from_str(text).map_err(|e| format!("it is not JSON: {e}"))?;
    let list = value.as_array().or_else(|| value.get("labels")?.as_array());
    let list = list.ok_or("its JSON has no list \"labels\"")?;
    let labels = list.iter().enumerate().map(|(i, value)| {
        let location = || format!("the label of face {i}");
        let number = value.as_i64();
        label(
            number.ok_or_else(|| format!("{} is {value}, but must be an integer", location()))?,
            location,
        )
    });
    labels.collect()
}

#[cfg(test)]
mod tests {
    use super::labels_of;
    use coseg::mesh::write::{npy, seg};

    const LABELS: [i32; 4] = [3, -1, 65_535, 0];

    #[test]
    fn labels_are_read_from_every_file_that_is_exported() {
        let json = br#"{"shape": "a", "labels": [3, -1, 65535, 0], "names": {"3": "leg"}}"#;
        for bytes in [npy(&LABELS), seg(&LABELS).into_bytes(), json.to_vec()] {
            assert_eq!(labels_of(&bytes), Ok(LABELS.to_vec()));
        }
        assert_eq!(labels_of(b"[3, -1, 65535, 0]"), Ok(LABELS.to_vec()));
        assert_eq!(labels_of(b""), Ok(vec![]));
    }

    #[test]
    fn text_is_read_however_it_was_saved() {
        let wide: Vec<u8> = "3\r\n-1\r\n65535\r\n0\r\n"
            .encode_utf16()
            .flat_map(u16::to_le_bytes)
            .collect();
        for bytes in [
            &b"3\n-1\n65535\n0"[..],
            b"3\r\n-1\r\n 65535 \r\n0\r\n",
            b"3\r-1\r65535\r0\r",
            b"\xef\xbb\xbf3\n-1\n65535\n0\n\n \n\n",
            &[b"\xff\xfe", wide.as_slice()].concat(),
            &wide,
        ] {
            assert_eq!(labels_of(bytes), Ok(LABELS.to_vec()), "{bytes:?}");
        }
    }

    #[test]
    fn what_is_no_label_is_named_with_its_location_and_the_limit() {
        let message = |bytes: &[u8]| labels_of(bytes).unwrap_err();
        for (text, wanted) in [
            ("1\nx\n", "line 2 is \"x\", but must be an integer"),
            ("1\n\n2\n", "line 2 is \"\", but must be an integer"),
            ("-2\n", "line 1 is -2, but must be -1 to 65535"),
            ("0\n65536", "line 2 is 65536, but must be -1 to 65535"),
            ("1.5", "line 1 is \"1.5\", but must be an integer"),
            (
                "[1, 1.5]",
                "the label of face 1 is 1.5, but must be an integer",
            ),
            (
                "[1, 65536]",
                "the label of face 1 is 65536, but must be -1 to 65535",
            ),
            ("{\"names\": {}}", "its JSON has no list \"labels\""),
        ] {
            assert_eq!(message(text.as_bytes()), wanted);
        }
        assert!(message(b"{\"labels\": [").starts_with("it is not JSON: "));
        assert_eq!(
            message(&npy(&[0, -2])),
            "the label of face 1 is -2, but must be -1 to 65535"
        );
        assert_eq!(
            message(&super::npy::floats(&[0.0], 1)),
            "its elements are floats, but labels are integers"
        );
        assert_eq!(
            message(&super::npy::floats(&[0.0; 4], 2)),
            "it has 2 columns, but labels have one axis"
        );
    }
}
