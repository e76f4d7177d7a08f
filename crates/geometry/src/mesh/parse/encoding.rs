//! Converts text in any Unicode encoding to UTF-8 without a byte-order mark.
//!
//! UTF-16 and UTF-32 are recognised by their byte-order marks, UTF-16 also by its zeros, because
//! programs that save "Unicode" write it without a mark, too. Every other text stays unchanged:
//! keywords and numbers are the same bytes in UTF-8, Latin-1 and all encodings that extend ASCII,
//! and names are ignored.

use std::borrow::Cow;

/// Number of pairs of bytes at the beginning by which UTF-16 without a mark is recognised.
const N_PAIRS: usize = 8;

#[derive(Clone, Copy)]
enum Order {
    Little,
    Big,
}

/// The text in UTF-8 without a byte-order mark, or the same bytes if they are in no other Unicode
/// encoding.
///
/// ```
/// use coseg_geometry::mesh::as_utf8;
///
/// assert_eq!(*as_utf8(b"\xff\xfeO\0F\0F\0"), *b"OFF");
/// assert_eq!(*as_utf8(b"OFF"), *b"OFF");
/// ```
pub fn as_utf8(bytes: &[u8]) -> Cow<'_, [u8]> {
    if let Some(rest) = bytes.strip_prefix(b"\xef\xbb\xbf") {
        return Cow::Borrowed(rest);
    }
    // The mark of UTF-32 begins with that of UTF-16.
    let utf_32 = bytes.len().is_multiple_of(4);
    if let Some(rest) = bytes.strip_prefix(b"\xff\xfe\0\0").filter(|_| utf_32) {
        return Cow::Owned(from_utf_32(rest, u32::from_le_bytes));
    }
    if let Some(rest) = bytes.strip_prefix(b"\0\0\xfe\xff").filter(|_| utf_32) {
        return Cow::Owned(from_utf_32(rest, u32::from_be_bytes));
    }
    let marked = |mark: &[u8], order| bytes.strip_prefix(mark).map(|rest| (rest, order));
    let found = marked(b"\xff\xfe", Order::Little)
        .or_else(|| marked(b"\xfe\xff", Order::Big))
        .or_else(|| unmarked(bytes).map(|order| (bytes, order)));
    match found {
        Some((rest, order)) => Cow::Owned(from_utf_16(rest, order)),
        None => Cow::Borrowed(bytes),
    }
}

/// The byte order of a text in UTF-16 that begins with ASCII characters.
fn unmarked(bytes: &[u8]) -> Option<Order> {
    let (pairs, _) = bytes.as_chunks::<2>();
    let begin = &pairs[..pairs.len().min(N_PAIRS)];
    let text = |b: u8| matches!(b, b'\t' | b'\n' | b'\r' | b' '..=b'~');
    let all = |of: fn(&[u8; 2]) -> (u8, u8)| {
        begin.len() > 1
            && begin
                .iter()
                .map(of)
                .all(|(low, high)| text(low) && high == 0)
    };
    match (all(|p| (p[0], p[1])), all(|p| (p[1], p[0]))) {
        (true, _) => Some(Order::Little),
        (_, true) => Some(Order::Big),
        _ => None,
    }
}

fn from_utf_16(bytes: &[u8], order: Order) -> Vec<u8> {
    let (pairs, _) = bytes.as_chunks::<2>();
    let units = pairs.iter().map(|&pair| match order {
        Order::Little => u16::from_le_bytes(pair),
        Order::Big => u16::from_be_bytes(pair),
    });
    let mut text = String::with_capacity(pairs.len());
    text.extend(char::decode_utf16(units).map(|c| c.unwrap_or(char::REPLACEMENT_CHARACTER)));
    text.into_bytes()
}

fn from_utf_32(bytes: &[u8], unit: fn([u8; 4]) -> u32) -> Vec<u8> {
    let (fours, _) = bytes.as_chunks::<4>();
    let mut text = String::with_capacity(fours.len());
    let character = |&four: &[u8; 4]| char::from_u32(unit(four));
    text.extend(
        fours
            .iter()
            .map(|f| character(f).unwrap_or(char::REPLACEMENT_CHARACTER)),
    );
    text.into_bytes()
}

#[cfg(test)]
mod tests {
    use super::as_utf8;

    const TEXT: &str = "v 0 0 0 # Größe 𝄞\nf 1 1 1\n";

    #[test]
    fn a_text_is_the_same_in_every_encoding() {
        let little: Vec<u8> = TEXT.encode_utf16().flat_map(u16::to_le_bytes).collect();
        let big: Vec<u8> = TEXT.encode_utf16().flat_map(u16::to_be_bytes).collect();
        let four: Vec<u8> = TEXT
            .chars()
            .flat_map(|c| u32::from(c).to_le_bytes())
            .collect();
        let four_big: Vec<u8> = TEXT
            .chars()
            .flat_map(|c| u32::from(c).to_be_bytes())
            .collect();
        for bytes in [
            TEXT.as_bytes().to_vec(),
            [b"\xef\xbb\xbf", TEXT.as_bytes()].concat(),
            [b"\xff\xfe", little.as_slice()].concat(),
            [b"\xfe\xff", big.as_slice()].concat(),
            [b"\xff\xfe\0\0", four.as_slice()].concat(),
            [b"\0\0\xfe\xff", four_big.as_slice()].concat(),
            little,
            big,
        ] {
            assert_eq!(as_utf8(&bytes), TEXT.as_bytes(), "{bytes:?}");
        }
    }

    #[test]
    fn what_is_no_unicode_stays_as_it_is() {
        for bytes in [
            &b""[..],
            b"v",
            b"v\0",
            b"glTF\x02\0\0\0",
            b"\0\0\0\0",
            b"# Gr\xf6\xdfe\n",
        ] {
            assert_eq!(as_utf8(bytes), bytes);
        }
        // The text ends in half a character, and in half of a pair.
        assert_eq!(as_utf8(b"\xff\xfea\0b"), &b"a"[..]);
        assert_eq!(as_utf8(b"\xff\xfe\0\xd8a\0"), "\u{fffd}a".as_bytes());
    }
}
