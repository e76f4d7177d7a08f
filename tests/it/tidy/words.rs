//! Checks the width of lines, and words that have plainer replacements.

/// Maximum width of a line of code or comments.
const MAX_COLUMNS: usize = 100;
/// Words to replace, with their replacements.
const PLAINER: [(&str, &str); 1] = [("anew", "again or re-")];

/// Lines of a file that are too wide, or contain a word of [`PLAINER`]. Tests may contain them,
/// since they quote messages.
pub(super) fn word_faults(file: &str, text: &str) -> Vec<String> {
    let mut faults = Vec::new();
    for (i, line) in text.lines().enumerate() {
        let at = format!("{file}, line {}", i + 1);
        let n_columns = line.chars().count();
        if n_columns > MAX_COLUMNS {
            faults.push(format!(
                "{at} has {n_columns} columns, but the limit is {MAX_COLUMNS}"
            ));
        }
        let has = |word: &str| {
            line.split(|c: char| !c.is_alphanumeric())
                .any(|w| w == word)
        };
        let is_test = file.starts_with("tests/");
        let found = PLAINER.iter().filter(|(word, _)| !is_test && has(word));
        faults.extend(found.map(|(word, plainer)| format!("{at} has {word:?}; write {plainer}")));
    }
    faults
}

#[test]
fn planted_faults_of_words_are_found() {
    let wide = "é".repeat(MAX_COLUMNS + 1);
    for (text, fault) in [
        (wide.as_str(), "x.rs, line 1 has 101 columns"),
        ("\n// Computes it anew.", "x.rs, line 2 has \"anew\""),
    ] {
        let faults = word_faults("x.rs", text);
        assert!(
            faults.len() == 1 && faults[0].starts_with(fault),
            "{text:.80}: {faults:?}"
        );
    }
    let fits = format!("{}\n// renewal, manewer", "é".repeat(MAX_COLUMNS));
    assert_eq!(word_faults("x.rs", &fits), Vec::<String>::new());
}
