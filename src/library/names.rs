//! Checks names, so that people, file systems and logs can handle them, and shows text that may
//! contain others.

use super::error::{LibraryError, Result};
use super::reason::Reason;
use std::borrow::Cow;

/// Letters of other scripts that look like Latin ones.
const LOOKALIKES: &str = "АВЕКМНОРСТУХаеорсухіІјЈѕЅһԁԛԜԝҮүӀӏ\
                          ΑΒΕΖΗΙΚΜΝΟΡΤΥΧοναινυρ";

/// Maximum number of characters of a shape's name.
const MAX_SHAPE_NAME: usize = 255;

/// Refuses a name that is not valid for a shape.
///
/// # Errors
/// The name is too long or empty, or contains characters that are not allowed.
pub fn check_shape_name(name: &str) -> Result<()> {
    check_name("shape", name, MAX_SHAPE_NAME)
}

/// Refuses a name that is too long, cannot be part of a path, or contains invisible characters.
pub(super) fn check_name(what: &str, name: &str, limit: usize) -> Result<()> {
    let bad = |message: String| Err(LibraryError::invalid(Reason::BadName, message));
    let n = name.chars().count();
    if n == 0 || n > limit {
        return bad(format!(
            "the {what} name has {n} characters, but must have 1 to {limit}"
        ));
    }
    if let Some(c) = name.chars().find(|c| *c == '/' || c.is_control()) {
        return bad(format!(
            "the {what} name {name:?} has {c:?}, but / and control characters are not allowed"
        ));
    }
    let chars: Vec<char> = name.chars().collect();
    if let Some(i) = (0..n).find(|&i| is_hidden(&chars, i)) {
        let (text, code) = (shown(name), u32::from(chars[i]));
        return bad(format!(
            "the {what} name \"{text}\" has the character U+{code:04X}, but characters that \
             cannot be seen, or that turn the direction of others, are not allowed"
        ));
    }
    if name == "." || name == ".." {
        return bad(format!("the {what} name is {name:?}"));
    }
    Ok(())
}

/// Whether a character is invisible: names that differ by it look the same, or look like others.
/// Joiners are part of scripts and of pictures, but are invisible between letters of ASCII and at
/// the ends of a name.
fn is_hidden(chars: &[char], i: usize) -> bool {
    match chars[i] {
        '\u{200c}' | '\u{200d}' => {
            let joins = |j: Option<usize>| {
                j.and_then(|j| chars.get(j))
                    .is_some_and(|c| !c.is_ascii() && !is_blank(*c))
            };
            !joins(i.checked_sub(1)) || !joins(Some(i + 1))
        }
        c => is_blank(c),
    }
}

fn is_blank(c: char) -> bool {
    matches!(
        c,
        '\u{ad}'
            | '\u{34f}'
            | '\u{61c}'
            | '\u{115f}'
            | '\u{1160}'
            | '\u{17b4}'
            | '\u{17b5}'
            | '\u{180e}'
            | '\u{200b}'
            | '\u{200e}'
            | '\u{200f}'
            | '\u{2028}'..='\u{202e}'
            | '\u{2060}'..='\u{206f}'
            | '\u{3164}'
            | '\u{feff}'
            | '\u{ffa0}'
            | '\u{fff0}'..='\u{fffb}'
            | '\u{1d173}'..='\u{1d17a}'
            | '\u{e0000}'..='\u{e007f}'
    )
}

/// Returns text that contains names, for people. Invisible characters are replaced by their
/// numbers, and so are letters that look like Latin ones within a word that also has Latin ones.
pub fn shown(text: &str) -> Cow<'_, str> {
    if text.is_ascii() {
        return Cow::Borrowed(text);
    }
    let chars: Vec<char> = text.chars().collect();
    let is_odd = |c: char| LOOKALIKES.contains(c);
    let mut hidden: Vec<bool> = (0..chars.len()).map(|i| is_hidden(&chars, i)).collect();
    let mut begin = 0;
    for end in 0..=chars.len() {
        if end < chars.len() && chars[end].is_alphabetic() {
            continue;
        }
        let word = &chars[begin..end];
        if word.iter().any(char::is_ascii_alphabetic) {
            for (i, c) in word.iter().enumerate() {
                hidden[begin + i] |= is_odd(*c);
            }
        }
        begin = end + 1;
    }
    if !hidden.contains(&true) {
        return Cow::Borrowed(text);
    }
    let escape = |(c, hidden): (&char, &bool)| match hidden {
        true => format!("\\u{{{:x}}}", u32::from(*c)),
        false => c.to_string(),
    };
    Cow::Owned(chars.iter().zip(&hidden).map(escape).collect())
}

#[cfg(test)]
mod tests {
    use super::{check_name, shown};

    #[test]
    fn names_of_all_scripts_are_taken() {
        for name in [
            "chair",
            "chair 2 (old).v3",
            "Стул_v2",
            "стул",
            "כיסא",
            "كرسي",
            "صندلی\u{200c}ها",
            "椅子",
            "椅子\u{e0101}",
            "Δx",
            "👩\u{200d}🔧",
            "☂\u{fe0f}",
            "Stühle",
            "µ-chair",
        ] {
            assert!(check_name("shape", name, 255).is_ok(), "{name}");
            assert_eq!(shown(name), name);
        }
    }

    #[test]
    fn what_cannot_be_seen_is_refused_and_shown() {
        for (name, readable) in [
            ("chair\u{202e}fbo", "chair\\u{202e}fbo"),
            ("\u{2066}chair\u{2069}", "\\u{2066}chair\\u{2069}"),
            ("chair\u{200f}", "chair\\u{200f}"),
            ("ch\u{200b}air", "ch\\u{200b}air"),
            ("ch\u{200d}air", "ch\\u{200d}air"),
            ("椅子\u{200d}", "椅子\\u{200d}"),
            ("椅\u{200d}\u{200b}子", "椅\\u{200d}\\u{200b}子"),
            ("\u{feff}chair", "\\u{feff}chair"),
            ("chair\u{e0041}", "chair\\u{e0041}"),
            ("a\u{2028}b", "a\\u{2028}b"),
            ("\u{3164}", "\\u{3164}"),
        ] {
            let e = check_name("shape", name, 255).unwrap_err().to_string();
            assert!(e.contains(readable) && e.contains("U+"), "{e}");
            assert!(
                e.chars()
                    .all(|c| !name.contains(c) || c.is_ascii() || c == '椅' || c == '子')
            );
            assert_eq!(shown(name), readable);
        }
        for name in ["", ".", "..", "a/b", "a\nb", "a\u{85}b"] {
            assert!(check_name("shape", name, 255).is_err(), "{name:?}");
        }
    }

    #[test]
    fn words_of_two_scripts_show_which_letters_are_not_latin() {
        assert_eq!(shown("ch\u{430}ir-2 стул"), "ch\\u{430}ir-2 стул");
        assert_eq!(shown("\u{421}hair"), "\\u{421}hair");
        assert_eq!(shown("сосуд_A"), "сосуд_A");
    }
}
