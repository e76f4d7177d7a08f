//! Arrays become one block of bytes that a page reads without a library: JSON, then raw arrays.
//!
//! A pack is a little-endian u32, the length of the JSON text that follows, and, from the next
//! multiple of 8 bytes on, arrays. The JSON refers to each as `{"type", "shape", "at"}`. Quantised
//! arrays also have `low` and `high` for each column: the values of the least and the greatest
//! integer of the type.

use serde_json::{Value, json};

/// Alignment of arrays in bytes.
const ALIGN: usize = 8;

/// A pack under construction.
#[derive(Debug, Default)]
pub struct Pack {
    bytes: Vec<u8>,
}

impl Pack {
    fn push(&mut self, kind: &str, bytes: &[u8], shape: &[usize]) -> Value {
        self.bytes
            .resize(self.bytes.len().next_multiple_of(ALIGN), 0);
        let at = self.bytes.len();
        self.bytes.extend_from_slice(bytes);
        json!({ "type": kind, "shape": shape, "at": at })
    }

    /// Adds non-negative integers, in the smallest type that holds the largest.
    pub fn integers(&mut self, values: &[u32], shape: &[usize]) -> Value {
        let largest = values.iter().copied().max().unwrap_or(0);
        if largest <= u8::MAX.into() {
            let bytes: Vec<u8> = values.iter().map(|&v| v as u8).collect();
            self.push("u8", &bytes, shape)
        } else if largest <= u16::MAX.into() {
            let bytes: Vec<u8> = values
                .iter()
                .flat_map(|&v| (v as u16).to_le_bytes())
                .collect();
            self.push("u16", &bytes, shape)
        } else {
            let bytes: Vec<u8> = values.iter().flat_map(|&v| v.to_le_bytes()).collect();
            self.push("u32", &bytes, shape)
        }
    }

    /// Adds numbers without quantisation.
    pub fn floats(&mut self, values: &[f32], shape: &[usize]) -> Value {
        let bytes: Vec<u8> = values.iter().flat_map(|&v| v.to_le_bytes()).collect();
        self.push("f32", &bytes, shape)
    }

    /// Adds rows of numbers in `n_columns` columns, with 16 bits each.
    pub fn words(&mut self, values: &[f32], n_columns: usize) -> Value {
        let (low, high) = ranges(values, n_columns);
        let steps = quantised(values, &low, &high, f64::from(u16::MAX));
        let bytes: Vec<u8> = steps.flat_map(|v| (v as u16).to_le_bytes()).collect();
        self.ranged("u16", &bytes, values.len(), low, high)
    }

    /// Adds rows of numbers in `n_columns` columns, with 8 bits each.
    pub fn octets(&mut self, values: &[f32], n_columns: usize) -> Value {
        let (low, high) = ranges(values, n_columns);
        let bytes: Vec<u8> = quantised(values, &low, &high, f64::from(u8::MAX))
            .map(|v| v as u8)
            .collect();
        self.ranged("u8", &bytes, values.len(), low, high)
    }

    fn ranged(
        &mut self,
        kind: &str,
        bytes: &[u8],
        n: usize,
        low: Vec<f32>,
        high: Vec<f32>,
    ) -> Value {
        let n_columns = low.len();
        let mut array = self.push(kind, bytes, &[n / n_columns.max(1), n_columns]);
        array["low"] = low.into();
        array["high"] = high.into();
        array
    }

    /// Returns the pack, with `header` as its JSON.
    pub fn finish(self, header: &Value) -> Vec<u8> {
        let text = header.to_string();
        let length = u32::try_from(text.len()).expect("invariant: headers are far below 4 GiB");
        let mut out = length.to_le_bytes().to_vec();
        out.extend_from_slice(text.as_bytes());
        out.resize(out.len().next_multiple_of(ALIGN), b' ');
        out.extend_from_slice(&self.bytes);
        out
    }
}

/// Returns the least and the greatest value of each column. A value that is not a number counts as
/// 0.
fn ranges(values: &[f32], n_columns: usize) -> (Vec<f32>, Vec<f32>) {
    let mut low = vec![f32::INFINITY; n_columns];
    let mut high = vec![f32::NEG_INFINITY; n_columns];
    for row in values.chunks_exact(n_columns.max(1)) {
        for (i, &value) in row.iter().enumerate() {
            let value = if value.is_finite() { value } else { 0.0 };
            low[i] = low[i].min(value);
            high[i] = high[i].max(value);
        }
    }
    if values.is_empty() {
        (low, high) = (vec![0.0; n_columns], vec![0.0; n_columns]);
    }
    (low, high)
}

fn quantised<'a>(
    values: &'a [f32],
    low: &'a [f32],
    high: &'a [f32],
    steps: f64,
) -> impl Iterator<Item = f64> + 'a {
    values.iter().enumerate().map(move |(i, &value)| {
        let column = i % low.len();
        let (low, high) = (f64::from(low[column]), f64::from(high[column]));
        let share = (f64::from(value) - low) / (high - low).max(f64::MIN_POSITIVE);
        // A value that is not a number becomes 0 in the cast.
        (share.clamp(0.0, 1.0) * steps).round()
    })
}

#[cfg(test)]
mod tests {
    use super::Pack;
    use serde_json::{Value, json};

    #[test]
    fn arrays_come_back_within_half_a_step() {
        let mut pack = Pack::default();
        let values = [0.0, -3.0, 0.5, 5.0, 1.0, 1.0_f32];
        let words = pack.words(&values, 2);
        let ids = pack.integers(&[1, 300], &[2]);
        let bytes = pack.finish(&json!({ "words": words, "ids": ids }));
        let n = u32::from_le_bytes(bytes[..4].try_into().unwrap()) as usize;
        let header: Value = serde_json::from_slice(&bytes[4..4 + n]).unwrap();
        let arrays = &bytes[(4 + n).next_multiple_of(8)..];
        let words = &header["words"];
        assert_eq!(words["shape"], json!([3, 2]));
        for (i, value) in values.iter().enumerate() {
            let at = words["at"].as_u64().unwrap() as usize + 2 * i;
            let step = u16::from_le_bytes([arrays[at], arrays[at + 1]]);
            let bound = |name: &str| words[name][i % 2].as_f64().unwrap();
            let (low, high) = (bound("low"), bound("high"));
            let back = low + (high - low) * f64::from(step) / 65_535.0;
            assert!((back - f64::from(*value)).abs() <= (high - low) / 131_000.0);
        }
        assert_eq!(header["ids"]["type"], "u16");
        assert_eq!(header["ids"]["at"].as_u64().unwrap() % 8, 0);
    }

    #[test]
    fn nothing_and_what_is_no_number_are_packed_too() {
        let mut pack = Pack::default();
        assert_eq!(pack.octets(&[], 3)["shape"], json!([0, 3]));
        let flat = pack.octets(&[2.0, 2.0], 1);
        assert_eq!(
            (&flat["low"], &flat["high"]),
            (&json!([2.0]), &json!([2.0]))
        );
        pack.words(&[f32::NAN, 1.0], 1);
    }
}
