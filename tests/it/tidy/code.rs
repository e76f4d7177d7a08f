//! Checks the order of modules, purity, `unsafe` and the length of files, with a small lexer for
//! Rust.

/// The first module of the shell; the modules before it are pure.
const FIRST_OF_SHELL: &str = "store";
/// The only file that may be unsafe: it maps files into memory.
const UNSAFE_FILE: &str = "src/store/mapped.rs";
/// The only pure file that maps memory, without a file.
const MEMORY_FILE: &str = "crates/geometry/src/linalg/basis.rs";
/// The pure files that read and write JSON: that of a file format.
const JSON_FILES: [&str; 8] = [
    "crates/geometry/src/mesh/parse/gltf/document.rs",
    "crates/geometry/src/mesh/write/attributes.rs",
    "crates/geometry/src/mesh/write/attributes/tests.rs",
    "crates/geometry/src/mesh/write/glb.rs",
    "crates/geometry/src/mesh/write/gltf.rs",
    "crates/geometry/src/mesh/write/gltf/tests.rs",
    "crates/geometry/src/mesh/write/obj_glb.rs",
    "crates/geometry/src/mesh/write/paint.rs",
];
/// Maximum number of lines of a source file.
const MAX_LINES: usize = 700;
/// Modules of the standard library that a pure module may not name: files, clocks, the process and
/// its environment.
const IMPURE_STD: [&str; 7] = ["env", "fs", "net", "os", "process", "thread", "time"];
/// Crates for files, sockets, logs and formats, which pure modules may not use.
const IMPURE_CRATES: [&str; 13] = [
    "clap",
    "indicatif",
    "memmap2",
    "prost",
    "rusqlite",
    "rustix",
    "sd_notify",
    "serde",
    "serde_json",
    "signal_hook",
    "tokio",
    "tracing",
    "zmq",
];
const PRINTS: [&str; 4] = ["eprint", "eprintln", "print", "println"];

/// The one file that applies changes to a collection in memory.
const CHANGE_FILE: &str = "src/library/change.rs";
/// The folder of its modules. They and the file are the only ones that write what follows from
/// labels.
const CHANGE_FOLDER: &str = "src/library/change/";
/// The one file that changes a collection in memory, and the methods that may.
const COLLECTION_FILE: &str = "src/library/collection/mod.rs";
const COLLECTION_CHANGES: [&str; 2] = ["apply", "set_aside"];
/// Methods of the store's transactions that write what follows from labels.
const LABEL_WRITES: [&str; 19] = [
    "append_event",
    "delete_correction",
    "delete_shape",
    "insert_correction",
    "insert_shape",
    "mark_all_stale",
    "mark_stale_before",
    "put_label",
    "put_labels",
    "put_map",
    "reserve_label",
    "set_epoch",
    "set_model",
    "set_parameters",
    "set_pins",
    "set_stale",
    "set_state",
    "take_labels",
    "take_ordinal",
];

/// The modules of a crate in the order of the data flow, as its `lib.rs` lists them.
pub(super) struct Flow {
    /// The folder of its sources, from the root of the project.
    pub(super) sources: String,
    pub(super) modules: Vec<String>,
    /// Names at the root of the crate, and the module each comes from.
    reexports: Vec<(String, String)>,
}

impl Flow {
    pub(super) fn read(sources: &str, lib: &str) -> Self {
        let tokens = tokens(lib);
        let (mut modules, mut reexports) = (Vec::new(), Vec::new());
        for window in tokens.windows(6) {
            match window.iter().map(String::as_str).collect::<Vec<_>>()[..] {
                ["pub", "mod", name, ";", ..] => modules.push(name.to_owned()),
                ["pub", "use", module, "::", name, ";"] => {
                    reexports.push((name.to_owned(), module.to_owned()));
                }
                _ => {}
            }
        }
        Self {
            sources: sources.to_owned(),
            modules,
            reexports,
        }
    }

    pub(super) fn pure(&self) -> &[String] {
        let shell = self.modules.iter().position(|m| m == FIRST_OF_SHELL);
        &self.modules[..shell.unwrap_or(self.modules.len())]
    }

    fn rank(&self, name: &str) -> Option<usize> {
        let alias = self.reexports.iter().find(|r| r.0 == name);
        let module = alias.map_or(name, |r| r.1.as_str());
        self.modules.iter().position(|m| m == module)
    }
}

/// The faults of a file of the crate, or of `tests`.
pub(super) fn code_faults(flow: &Flow, file: &str, text: &str) -> Vec<String> {
    let tokens = tokens(text);
    let mut faults = Vec::new();
    if file != UNSAFE_FILE && tokens.iter().any(|t| t == "unsafe") {
        faults.push(format!("{file} is unsafe, but only {UNSAFE_FILE} may be"));
    }
    let inside = file.strip_prefix(flow.sources.as_str());
    let Some(inside) = inside.and_then(|f| f.strip_prefix('/')) else {
        return faults;
    };
    let n_lines = text.lines().count();
    if n_lines > MAX_LINES {
        faults.push(format!(
            "{file} has {n_lines} lines, but the limit is {MAX_LINES}"
        ));
    }
    let path: Vec<&str> = inside.trim_end_matches(".rs").split('/').collect();
    let Some(rank) = flow.modules.iter().position(|m| m == path[0]) else {
        return faults;
    };
    // This number of `super` reaches the root of the crate.
    let depth = path.len() - usize::from(path.last() == Some(&"mod"));
    for name in named_at_root(&tokens, depth) {
        if flow.rank(name) > Some(rank) {
            faults.push(format!(
                "{file} names {name}, which comes later in {}/lib.rs",
                flow.sources
            ));
        }
    }
    if rank < flow.pure().len() {
        let allowed = |what: &str| match what {
            "memmap2" => file == MEMORY_FILE,
            "serde" | "serde_json" => JSON_FILES.contains(&file),
            _ => false,
        };
        impurities(&tokens, |what| {
            if !allowed(&what) {
                faults.push(format!("{file} is pure, but names {what}"));
            }
        });
    }
    faults
}

/// Where a file of the library writes what follows from labels, or changes a collection in memory,
/// though only one module may.
pub(super) fn change_faults(file: &str, text: &str) -> Vec<String> {
    let mut faults = Vec::new();
    if !file.starts_with("src/library/") || file.ends_with("/tests.rs") {
        return faults;
    }
    let tokens = tokens(text);
    for called in tokens.windows(3) {
        let [dot, name, open] = called else { continue };
        let is_call = dot == "." && open == "(";
        let may_write = file == CHANGE_FILE || file.starts_with(CHANGE_FOLDER);
        if is_call && LABEL_WRITES.contains(&name.as_str()) && !may_write {
            faults.push(format!("{file} calls {name}, but only {CHANGE_FILE} may"));
        }
        if is_call && name == "apply" && file != CHANGE_FILE {
            faults.push(format!("{file} calls apply, but only {CHANGE_FILE} may"));
        }
    }
    if file == COLLECTION_FILE {
        for method in tokens.windows(6) {
            let is_mut = method[2..] == ["(", "&", "mut", "self"];
            if is_mut && method[0] == "fn" && !COLLECTION_CHANGES.contains(&method[1].as_str()) {
                faults.push(format!("{file}: {} changes the collection", method[1]));
            }
        }
    }
    faults
}

fn impurities(tokens: &[String], mut fault: impl FnMut(String)) {
    for (i, token) in tokens.iter().enumerate() {
        let next = tokens.get(i + 1).map_or("", String::as_str);
        let begins_path = next == "::" && (i == 0 || tokens[i - 1] != "::");
        let used_whole = i > 0 && tokens[i - 1] == "use";
        if begins_path && token == "std" {
            let named = first_names(tokens, i + 2);
            named
                .into_iter()
                .filter(|n| IMPURE_STD.contains(n))
                .for_each(|n| fault(format!("std::{n}")));
        } else if (begins_path || used_whole) && IMPURE_CRATES.contains(&token.as_str()) {
            fault(token.clone());
        } else if next == "!" && PRINTS.contains(&token.as_str()) {
            fault(format!("{token}!"));
        }
    }
}

/// The names that follow the root of the crate: `crate`, or enough `super`s.
fn named_at_root(tokens: &[String], depth: usize) -> Vec<&str> {
    let mut names = Vec::new();
    let mut i = 0;
    while i < tokens.len() {
        let begin = i;
        let mut n_super = 0;
        while tokens[i] == "super" && tokens.get(i + 1).is_some_and(|t| t == "::") {
            n_super += 1;
            i += 2;
            if i == tokens.len() {
                return names;
            }
        }
        let from_crate =
            n_super == 0 && tokens[i] == "crate" && tokens.get(i + 1).is_some_and(|t| t == "::");
        if from_crate {
            i += 2;
        }
        if from_crate || n_super >= depth.max(1) {
            names.extend(first_names(tokens, i));
        }
        i = i.max(begin + 1);
    }
    names
}

/// The first name of each path at `at`: of one path, or of every path in braces.
fn first_names(tokens: &[String], at: usize) -> Vec<&str> {
    let is_name = |t: &str| t.starts_with(|c: char| c.is_alphabetic() || c == '_');
    if tokens.get(at).is_none_or(|t| t != "{") {
        return tokens
            .get(at)
            .map(String::as_str)
            .filter(|t| is_name(t))
            .into_iter()
            .collect();
    }
    let (mut names, mut depth) = (Vec::new(), 0);
    for i in at..tokens.len() {
        match tokens[i].as_str() {
            "{" => depth += 1,
            "}" => depth -= 1,
            name if depth == 1 && is_name(name) && ["{", ","].contains(&tokens[i - 1].as_str()) => {
                names.push(name);
            }
            _ => {}
        }
        if depth == 0 {
            break;
        }
    }
    names
}

/// Names, numbers, `::` and other single characters, without comments and strings.
pub(super) fn tokens(text: &str) -> Vec<String> {
    let chars: Vec<char> = text.chars().collect();
    let is_word = |c: char| c.is_alphanumeric() || c == '_';
    let at = |i: usize| chars.get(i).copied().unwrap_or('\0');
    let mut out: Vec<String> = Vec::new();
    let mut i = 0;
    while i < chars.len() {
        match chars[i] {
            '/' if at(i + 1) == '/' => {
                while i < chars.len() && chars[i] != '\n' {
                    i += 1;
                }
            }
            '/' if at(i + 1) == '*' => {
                i += 2;
                while i < chars.len() && (chars[i], at(i + 1)) != ('*', '/') {
                    i += 1;
                }
                i += 2;
            }
            '"' => i = after_string(&chars, i + 1),
            // A character, unless it is a lifetime.
            '\'' if at(i + 1) == '\\' => {
                i += 3;
                while i < chars.len() && chars[i] != '\'' {
                    i += 1;
                }
                i += 1;
            }
            '\'' if at(i + 2) == '\'' => i += 3,
            c if is_word(c) => {
                let begin = i;
                while i < chars.len() && is_word(chars[i]) {
                    i += 1;
                }
                let word: String = chars[begin..i].iter().collect();
                let mut hashes = 0;
                while at(i + hashes) == '#' {
                    hashes += 1;
                }
                if ["r", "br", "cr"].contains(&word.as_str()) && at(i + hashes) == '"' {
                    i = after_raw_string(&chars, i + hashes + 1, hashes);
                } else if !(["b", "c"].contains(&word.as_str()) && at(i) == '"') {
                    out.push(word);
                }
            }
            ':' if at(i + 1) == ':' => {
                out.push("::".into());
                i += 2;
            }
            c => {
                if !c.is_whitespace() {
                    out.push(c.into());
                }
                i += 1;
            }
        }
    }
    out
}

fn after_string(chars: &[char], mut i: usize) -> usize {
    while i < chars.len() && chars[i] != '"' {
        i += if chars[i] == '\\' { 2 } else { 1 };
    }
    i + 1
}

fn after_raw_string(chars: &[char], mut i: usize, hashes: usize) -> usize {
    while i < chars.len() {
        let end = chars[i] == '"' && (1..=hashes).all(|h| chars.get(i + h) == Some(&'#'));
        i += 1;
        if end {
            return i + hashes;
        }
    }
    i
}

const SAMPLE: &str = "
//! pub mod comment;
// Pure.
pub mod mesh;
pub mod labels;
pub mod pipeline;
// Shell.
pub mod store;
pub mod library;
pub mod daemon;
pub use library::Library;
";

#[test]
fn the_flow_is_read_from_the_root_of_the_library() {
    let flow = Flow::read("src", SAMPLE);
    assert_eq!(
        flow.modules,
        ["mesh", "labels", "pipeline", "store", "library", "daemon"]
    );
    assert_eq!(flow.pure(), ["mesh", "labels", "pipeline"]);
}

/// Sources with one fault each, which must be found.
#[test]
fn planted_faults_of_the_code_are_found() {
    let flow = Flow::read("src", SAMPLE);
    let long = "//\n".repeat(MAX_LINES + 1);
    for (file, text, fault) in [
        (
            "src/labels/model.rs",
            "pub fn f(_: crate::store::S) {}",
            "names store",
        ),
        (
            "src/mesh/mod.rs",
            "use crate::{labels::{self}, mesh::T};",
            "names labels",
        ),
        (
            "src/mesh/mod.rs",
            "use crate::{\n    mesh::{A, B},\n    daemon::W,\n};",
            "names daemon",
        ),
        (
            "src/mesh/mod.rs",
            "pub fn g(_: super::store::S) {}",
            "names store",
        ),
        ("src/mesh.rs", "use super::labels;", "names labels"),
        (
            "src/mesh/parse/obj.rs",
            "use super::super::super::labels::L;",
            "names labels",
        ),
        (
            "src/mesh/clean.rs",
            "use super::super::{T, pipeline};",
            "names pipeline",
        ),
        ("src/store/mod.rs", "use crate::Library;", "names Library"),
        (
            "src/store/mod.rs",
            "#[cfg(test)] mod tests { use crate::daemon::Event; }",
            "names daemon",
        ),
        ("src/mesh/mod.rs", "use std::fs;", "names std::fs"),
        (
            "src/mesh/mod.rs",
            "use std::{collections::BTreeMap, fs};",
            "names std::fs",
        ),
        (
            "src/mesh/mod.rs",
            "fn h() { std::env::var(\"X\"); }",
            "names std::env",
        ),
        (
            "src/labels/mod.rs",
            "use std::time::Instant;",
            "names std::time",
        ),
        (
            "src/labels/mod.rs",
            "fn h() { println!(\"//\"); }",
            "names println!",
        ),
        ("src/labels/mod.rs", "use memmap2::Mmap;", "names memmap2"),
        (
            "src/labels/mod.rs",
            "#[derive(serde::Serialize)] struct S;",
            "names serde",
        ),
        (
            "src/pipeline/mod.rs",
            "use tracing as log;",
            "names tracing",
        ),
        (
            "src/main.rs",
            "fn f() { let c = '\"'; unsafe { g() } }",
            "is unsafe",
        ),
        (
            "src/store/rows.rs",
            "fn f<'a>(x: &'a str) { unsafe { g(x) } }",
            "is unsafe",
        ),
        (
            "tests/it/cli.rs",
            "const S: &str = r#\"\"\"#; unsafe fn f() {}",
            "is unsafe",
        ),
        ("src/mesh/long.rs", &long, "has 701 lines"),
        ("src/commands/long.rs", &long, "has 701 lines"),
    ] {
        let faults = code_faults(&flow, file, text);
        assert!(
            faults.len() == 1 && faults[0].contains(fault),
            "{file}: {text:.80}: {faults:?}"
        );
    }
}

#[test]
fn changes_of_labels_elsewhere_are_found() {
    let sets = "fn f(tx: &Tx) { tx.set_state(id, b\"\")?; }";
    let applies = "fn f(c: &mut Collection) { c.apply(change); }";
    let changes = "impl Collection { fn apply(&mut self) {} fn grow(&mut self) {} }";
    for (file, text, fault) in [
        ("src/library/merge.rs", sets, Some("calls set_state")),
        (
            "src/library/collection/fit.rs",
            applies,
            Some("calls apply"),
        ),
        (
            COLLECTION_FILE,
            changes,
            Some("grow changes the collection"),
        ),
        (CHANGE_FILE, sets, None),
        (CHANGE_FILE, applies, None),
        ("src/library/change/edits.rs", sets, None),
        ("src/library/change/edits.rs", applies, Some("calls apply")),
        ("src/library/change_list.rs", sets, Some("calls set_state")),
        ("src/store/check.rs", sets, None),
        (
            "src/library/merge.rs",
            "// tx.set_state(id)\nlet set_state = 1;",
            None,
        ),
    ] {
        let faults = change_faults(file, text);
        match fault {
            Some(fault) => assert!(faults.len() == 1 && faults[0].contains(fault), "{faults:?}"),
            None => assert!(faults.is_empty(), "{faults:?}"),
        }
    }
}

#[test]
fn nothing_is_held_against_code_that_keeps_to_the_layout() {
    let flow = Flow::read("src", SAMPLE);
    let long = "//\n".repeat(MAX_LINES);
    for (file, text) in [
        (
            "src/mesh/mod.rs",
            "// see crate::store for the format\n/* use std::fs; */",
        ),
        (
            "src/mesh/mod.rs",
            "const S: &str = \"unsafe crate::store \\\" println!\";",
        ),
        (
            "src/mesh/mod.rs",
            "const S: &[u8] = br##\"crate::store \"# unsafe\"##;",
        ),
        (
            "src/mesh/mod.rs",
            "use std::{collections::HashMap, fmt}; use std::io::Read;",
        ),
        (
            "src/labels/mod.rs",
            "use crate::{mesh::{TriMesh, store}, labels::L};",
        ),
        ("src/mesh/parse/mod.rs", "use super::store::S;"),
        (
            "src/labels/mod.rs",
            "fn f(mesh: M) { mesh.daemon(); fs::f(); }",
        ),
        ("src/store/mapped.rs", "fn f() { unsafe { g() } }"),
        (
            "src/store/mod.rs",
            "use std::fs::File; use crate::pipeline::Description;",
        ),
        (
            "src/daemon/mod.rs",
            "use crate::{Library, store}; fn f() { println!(); }",
        ),
        ("src/commands/add.rs", "use crate::daemon; use std::fs;"),
        ("src/mesh/mod.rs", "#![deny(unsafe_code)]"),
        ("src/mesh/long.rs", &long),
        ("tests/it/long.rs", &"//\n".repeat(2 * MAX_LINES)),
    ] {
        let faults = code_faults(&flow, file, text);
        assert!(faults.is_empty(), "{file}: {text:.80}: {faults:?}");
    }
}
