//! Bytes of a text format become lines and words, with the number of the line.

use super::{ParseError, shown};

/// Lines with their numbers from 1, without their ends.
pub(super) struct Lines<'a> {
    rest: Option<&'a [u8]>,
    number: usize,
}

impl<'a> Lines<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self {
            rest: Some(bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes)),
            number: 0,
        }
    }
}

impl<'a> Iterator for Lines<'a> {
    type Item = (usize, &'a [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        let rest = self.rest?;
        self.number += 1;
        let end = rest.iter().position(|&b| b == b'\n');
        self.rest = end.map(|end| &rest[end + 1..]);
        Some((self.number, &rest[..end.unwrap_or(rest.len())]))
    }
}

/// What comes before the first `#`.
pub(super) fn before_comment(line: &[u8]) -> &[u8] {
    let end = line.iter().position(|&b| b == b'#');
    &line[..end.unwrap_or(line.len())]
}

/// Words between white space.
pub(super) fn words(line: &[u8]) -> impl Iterator<Item = &[u8]> {
    line.split(u8::is_ascii_whitespace)
        .filter(|word| !word.is_empty())
}

/// A word as a number.
pub(super) fn number<T: std::str::FromStr>(line: usize, token: &[u8]) -> Result<T, ParseError> {
    std::str::from_utf8(token)
        .ok()
        .and_then(|t| t.parse().ok())
        .ok_or_else(|| ParseError::NotANumber {
            line,
            token: shown(token),
        })
}

/// The first three words as a position; what follows them is no geometry.
pub(super) fn position<'a>(
    line: usize,
    words: &mut impl Iterator<Item = &'a [u8]>,
) -> Result<[f64; 3], ParseError> {
    let mut position = [0.0; 3];
    for (found, x) in position.iter_mut().enumerate() {
        let word = words
            .next()
            .ok_or(ParseError::ShortVertex { line, found })?;
        *x = number(line, word)?;
    }
    Ok(position)
}
