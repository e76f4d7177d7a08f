//! Splits the bytes of a text format into lines and words, with line numbers.

use super::{ParseError, shown};

/// Lines with their numbers from 1, without their ends.
pub(super) struct Lines<'a> {
    rest: Option<&'a [u8]>,
    number: usize,
}

impl<'a> Lines<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self {
            rest: Some(bytes),
            number: 0,
        }
    }
}

impl<'a> Iterator for Lines<'a> {
    type Item = (usize, &'a [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        let rest = self.rest?;
        self.number += 1;
        let (line, taken) = first_line(rest);
        self.rest = (taken > line.len()).then(|| &rest[taken..]);
        Some((self.number, line))
    }
}

/// The first line without its end, and its length including its end. A line ends in LF, in CR LF,
/// in CR CR LF (a text that was converted twice), or in CR alone.
pub(super) fn first_line(text: &[u8]) -> (&[u8], usize) {
    let Some(end) = text.iter().position(|b| matches!(b, b'\n' | b'\r')) else {
        return (text, text.len());
    };
    let n = match &text[end..] {
        [b'\r', b'\r', b'\n', ..] => 3,
        [b'\r', b'\n', ..] => 2,
        _ => 1,
    };
    (&text[..end], end + n)
}

/// Number of lines that end in CR alone, in a text that also has LF: version 0.1.0 treated such a
/// CR as a space.
pub(super) fn n_mixed_ends(text: &[u8]) -> usize {
    if !text.contains(&b'\r') || !text.contains(&b'\n') {
        return 0;
    }
    let mut n = 0;
    let mut rest = text;
    while !rest.is_empty() {
        let (line, taken) = first_line(rest);
        n += usize::from(&rest[line.len()..taken] == b"\r");
        rest = &rest[taken..];
    }
    n
}

/// The part of a line before the first `#`.
pub(super) fn before_comment(line: &[u8]) -> &[u8] {
    let end = line.iter().position(|&b| b == b'#');
    &line[..end.unwrap_or(line.len())]
}

/// Words separated by white space.
pub(in crate::mesh) fn words(line: &[u8]) -> impl Iterator<Item = &[u8]> {
    line.split(u8::is_ascii_whitespace)
        .filter(|word| !word.is_empty())
}

/// Parses a word as a number.
pub(super) fn number<T: std::str::FromStr>(line: usize, token: &[u8]) -> Result<T, ParseError> {
    std::str::from_utf8(token)
        .ok()
        .and_then(|t| t.parse().ok())
        .ok_or_else(|| ParseError::NotANumber {
            line,
            token: shown(token),
        })
}

/// The first three words as a position; later words are not geometry.
pub(super) fn position<'a>(
    line: usize,
    words: &mut impl Iterator<Item = &'a [u8]>,
) -> Result<[f64; 3], ParseError> {
    let mut position = [0.0; 3];
    for (found, x) in position.iter_mut().enumerate() {
        let word = words.next().ok_or(ParseError::ShortVertex {
            line,
            found,
            needed: 3,
        })?;
        *x = number(line, word)?;
    }
    Ok(position)
}
