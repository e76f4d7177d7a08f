//! Checks promises of the layout and the documents that the compiler does not check. Every check is
//! itself tested with planted faults.

mod circles;
mod code;
mod docs;
mod figures;
mod words;

use crate::harness::coseg;
use circles::circles;
use code::{Flow, change_faults, code_faults};
use docs::{commands_in, has_flag, link_faults};
use figures::{accuracy_faults, demo_faults};
use std::fs;
use std::path::{Path, PathBuf};
use words::word_faults;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Files below `dir` with the extension, with their paths from the root of the project, sorted.
fn files(dir: &Path, extension: &str) -> Vec<(String, String)> {
    let mut found = Vec::new();
    let mut open = vec![dir.to_path_buf()];
    while let Some(dir) = open.pop() {
        for entry in fs::read_dir(&dir).unwrap() {
            let path: PathBuf = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else if path.extension().is_some_and(|e| e == extension) {
                let name = path
                    .strip_prefix(root())
                    .unwrap()
                    .to_str()
                    .unwrap()
                    .to_owned();
                found.push((name, fs::read_to_string(&path).unwrap()));
            }
        }
    }
    found.sort();
    found
}

fn assert_none(faults: &[String]) {
    assert!(faults.is_empty(), "\n{}", faults.join("\n"));
}

/// The sources of each crate.
const CRATES: [&str; 2] = ["crates/geometry/src", "src"];

fn flow(sources: &str) -> Flow {
    let lib = root().join(sources).join("lib.rs");
    Flow::read(sources, &fs::read_to_string(lib).unwrap())
}

#[test]
fn the_code_keeps_to_the_layout() {
    let mut faults = Vec::new();
    for sources in CRATES {
        let flow = flow(sources);
        for (file, text) in files(&root().join(sources), "rs") {
            faults.extend(code_faults(&flow, &file, &text));
        }
    }
    for (file, text) in files(&root().join("tests"), "rs") {
        faults.extend(code_faults(&flow("src"), &file, &text));
    }
    assert_none(&faults);
}

/// Folders whose files do not name each other in a circle.
const STRAIGHT: [&str; 2] = ["src/daemon", "src/library"];

#[test]
fn files_do_not_name_each_other_in_a_circle() {
    for folder in STRAIGHT {
        assert_none(&circles(&files(&root().join(folder), "rs")));
    }
}

#[test]
fn lines_and_words_are_plain() {
    let mut checked = Vec::new();
    for folder in ["benches", "crates", "examples", "src", "tests"] {
        checked.extend(files(&root().join(folder), "rs"));
    }
    checked.extend(files(&root().join("src/viewer/page"), "js"));
    checked.extend(files(&root().join("proto"), "proto"));
    checked.extend(files(&root().join("config"), "toml"));
    let faults: Vec<String> = checked
        .iter()
        .flat_map(|(file, text)| word_faults(file, text))
        .collect();
    assert_none(&faults);
}

#[test]
fn one_file_writes_what_follows_from_labels() {
    let library = files(&root().join("src/library"), "rs");
    assert!(
        library
            .iter()
            .any(|(file, _)| file == "src/library/change.rs")
    );
    let faults = library
        .iter()
        .flat_map(|(file, text)| change_faults(file, text));
    assert_none(&faults.collect::<Vec<_>>());
}

#[test]
fn the_order_of_modules_is_complete() {
    // Modules of the binary only; no module of the library can name them.
    let binary = ["main", "cli", "commands", "telemetry", "lib"];
    for sources in CRATES {
        let mut modules = Vec::new();
        for entry in fs::read_dir(root().join(sources)).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
            if !binary.contains(&name.as_str()) && !modules.contains(&name) {
                modules.push(name);
            }
        }
        modules.sort();
        let mut listed = flow(sources).modules;
        listed.sort();
        assert_eq!(listed, modules, "{sources}");
    }
    let geometry = flow("crates/geometry/src");
    assert_eq!(geometry.pure(), geometry.modules);
    assert_eq!(geometry.modules.first().map(String::as_str), Some("linalg"));
    let library = flow("src");
    assert!(library.pure().iter().any(|m| m == "pipeline"));
    assert!(library.pure().len() < library.modules.len());
}

#[test]
fn links_lead_somewhere() {
    let mut faults = Vec::new();
    let mut documents = files(&root().join("docs"), "md");
    for name in ["README.md", "CHANGELOG.md", "CONTRIBUTING.md"] {
        let text = fs::read_to_string(root().join(name)).unwrap();
        documents.push((name.into(), text));
    }
    for (file, text) in documents
        .into_iter()
        .chain(CRATES.iter().flat_map(|s| files(&root().join(s), "rs")))
    {
        faults.extend(link_faults(root(), &file, &text));
    }
    assert_none(&faults);
}

/// Figures of accuracy in the README equal the measured ones, and its demonstration exists.
#[test]
fn figures_of_the_readme_are_those_of_the_pages() {
    let read = |name: &str| fs::read_to_string(root().join(name)).unwrap();
    let readme = read("README.md");
    assert_none(&accuracy_faults(&readme, &read("docs/accuracy.md")));
    let help = coseg().args(["demo", "--help"]).output().unwrap();
    assert_none(&demo_faults(
        &readme,
        &String::from_utf8(help.stdout).unwrap(),
    ));
}

/// A package contains only its own folder, so each package has the licences beside it.
#[test]
fn every_package_has_the_licence() {
    for text in ["LICENSE-MIT", "LICENSE-APACHE"] {
        let ours = fs::read_to_string(root().join(text)).unwrap();
        for client in ["clients/python", "clients/typescript"] {
            let beside = root().join(client).join(text);
            let same = fs::read_to_string(&beside).is_ok_and(|theirs| theirs == ours);
            assert!(same, "{} differs from {text}", beside.display());
        }
    }
    for file in [
        "Cargo.toml",
        "clients/python/pyproject.toml",
        "clients/typescript/package.json",
    ] {
        let text = fs::read_to_string(root().join(file)).unwrap();
        assert!(text.contains("MIT OR Apache-2.0"), "{file}");
    }
}

/// Commands in the README exist.
#[test]
fn commands_of_the_readme_exist() {
    let readme = fs::read_to_string(root().join("README.md")).unwrap();
    let commands = commands_in(&readme);
    assert!(
        commands.len() >= 10,
        "only {} commands in README.md",
        commands.len()
    );
    let mut faults = Vec::new();
    for (command, flags) in commands {
        let help = coseg().args([&command, "--help"]).output().unwrap();
        let help_text = String::from_utf8(help.stdout).unwrap();
        if !help.status.success() {
            faults.push(format!("README.md: there is no coseg {command}"));
        }
        for flag in flags.iter().filter(|f| !has_flag(&help_text, f)) {
            faults.push(format!("README.md: coseg {command} has no {flag}"));
        }
    }
    assert_none(&faults);
}
