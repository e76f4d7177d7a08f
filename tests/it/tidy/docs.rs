//! Checks the links, paths and commands in documents.

use std::path::Path;

/// Folders whose files documents name in backquotes.
const TOP: [&str; 9] = [
    "src/",
    "crates/",
    "docs/",
    "proto/",
    "config/",
    "systemd/",
    "tests/",
    "comparisons/",
    ".ci/",
];

/// Broken links of a document, and missing paths named in a document or a source.
pub(super) fn link_faults(root: &Path, file: &str, text: &str) -> Vec<String> {
    let mut faults = Vec::new();
    if file.ends_with(".rs") {
        let is_path = |c: char| c.is_alphanumeric() || "./-_".contains(c);
        for word in text.split(|c| !is_path(c)).map(|w| w.trim_end_matches('.')) {
            if word.starts_with("docs/") && !root.join(word).is_file() {
                faults.push(format!("{file} names {word}, which is not there"));
            }
        }
        return faults;
    }
    for line in prose(text) {
        for target in links(line) {
            if let Some(why) = broken(root, file, target) {
                faults.push(format!("{file} links to {target}, {why}"));
            }
        }
        for quoted in line.split('`').skip(1).step_by(2) {
            let named =
                TOP.iter().any(|top| quoted.starts_with(top)) && !quoted.contains(['*', ' ', '{']);
            if named && !root.join(quoted).exists() {
                faults.push(format!("{file} names {quoted}, which is not there"));
            }
        }
    }
    faults
}

/// Lines outside code fences.
fn prose(text: &str) -> impl Iterator<Item = &str> {
    let mut fenced = false;
    text.lines().filter(move |line| {
        let fence = line.trim_start().starts_with("```");
        fenced ^= fence;
        !fence && !fenced
    })
}

/// Targets of inline links.
fn links(line: &str) -> impl Iterator<Item = &str> {
    line.split("](")
        .skip(1)
        .filter_map(|rest| rest.split_once(')').map(|found| found.0))
}

fn broken(root: &Path, file: &str, target: &str) -> Option<&'static str> {
    if target.contains("://") {
        return None;
    }
    let (path, anchor) = target
        .split_once('#')
        .map_or((target, None), |(p, a)| (p, Some(a)));
    let from = root.join(file);
    let to = if path.is_empty() {
        from
    } else {
        from.parent()?.join(path)
    };
    if !to.exists() {
        return Some("which is not there");
    }
    let anchor = anchor?;
    let text = std::fs::read_to_string(&to).unwrap_or_default();
    let found = prose(&text)
        .filter(|l| l.starts_with('#'))
        .any(|l| slug(l) == anchor);
    (!found).then_some("which has no such heading")
}

/// The anchor of a heading, in the form of code forges.
fn slug(heading: &str) -> String {
    let text = heading.trim_start_matches('#').trim().to_lowercase();
    let kept = text
        .chars()
        .filter(|c| c.is_alphanumeric() || "-_ ".contains(*c));
    kept.map(|c| if c == ' ' { '-' } else { c }).collect()
}

/// Subcommands of coseg in the shell blocks of a document, each with its long flags.
pub(super) fn commands_in(text: &str) -> Vec<(String, Vec<String>)> {
    let mut commands = Vec::new();
    let mut shell = false;
    for line in text.lines().map(str::trim) {
        if line.starts_with("```") {
            shell = line == "```sh";
        }
        let typed = line.split('#').next().unwrap_or_default();
        let after = ["coseg ", "cargo run --release -- "]
            .iter()
            .find_map(|p| typed.strip_prefix(p));
        let Some(mut words) = after.filter(|_| shell).map(str::split_whitespace) else {
            continue;
        };
        if let Some(command) = words.next() {
            let flags = words
                .filter(|w| w.starts_with("--"))
                .map(str::to_owned)
                .collect();
            commands.push((command.to_owned(), flags));
        }
    }
    commands
}

/// Whether a help text has a flag, rather than one that begins with it.
pub(super) fn has_flag(help: &str, flag: &str) -> bool {
    let goes_on = |c: char| c.is_alphanumeric() || c == '-';
    help.match_indices(flag)
        .any(|(at, _)| !help[at + flag.len()..].starts_with(goes_on))
}

#[test]
fn planted_faults_of_documents_are_found() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir(dir.path().join("docs")).unwrap();
    let page = "# Page\n\n## On-disk *format*\n\n```\n# not a heading\n```\n";
    std::fs::write(dir.path().join("docs/page.md"), page).unwrap();
    for (file, text, n_faults) in [
        (
            "README.md",
            "[a](docs/page.md) [b](docs/page.md#on-disk-format) [c](https://x.org/y)",
            0,
        ),
        (
            "docs/page.md",
            "[a](../docs/page.md), [b](#page), `docs/page.md`, `src/*.rs`",
            0,
        ),
        ("README.md", "```\n[a](nowhere.md)\n```\nafter", 0),
        ("README.md", "[a](docs/page.md) and [b](docs/paeg.md)", 1),
        ("README.md", "[a](docs/page.md#format)", 1),
        ("README.md", "[a](docs/page.md#not-a-heading)", 1),
        ("docs/page.md", "[a](docs/page.md)", 1),
        (
            "README.md",
            "the code is in `src/gone.rs` and `docs/page.md`",
            1,
        ),
        ("README.md", "```\nx\n```\n[a](nowhere.md)", 1),
        (
            "src/lib.rs",
            "//! See docs/page.md.\n// and docs/operations.md",
            1,
        ),
    ] {
        let faults = link_faults(dir.path(), file, text);
        assert_eq!(faults.len(), n_faults, "{file}: {text}: {faults:?}");
    }
}

#[test]
fn commands_are_found_in_shell_blocks_only() {
    let text = "coseg no\n```sh\ncoseg add x --up +y   # --no\n  cargo run --release -- \
                demo\nls\n```\n\
                ```python\ncoseg no\n```\n";
    let expected = [
        ("add".to_owned(), vec!["--up".to_owned()]),
        ("demo".to_owned(), Vec::new()),
    ];
    assert_eq!(commands_in(text), expected);
    assert!(has_flag("  --up <AXIS>", "--up") && has_flag("[--up]", "--up"));
    assert!(!has_flag("  --upper, --up-axis", "--up"));
}
