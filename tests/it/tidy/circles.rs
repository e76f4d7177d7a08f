//! Circles of files: files of a folder that name each other, directly or through others.

use super::code::tokens;
use std::collections::{BTreeMap, BTreeSet};

/// A fault for each file that leads back to itself. `files` are sources of one crate with their
/// paths from its root, `src/` included.
pub(super) fn circles(files: &[(String, String)]) -> Vec<String> {
    let modules: BTreeMap<Vec<&str>, &str> = files
        .iter()
        .map(|(file, _)| (module(file), file.as_str()))
        .collect();
    let named: BTreeMap<&str, BTreeSet<&str>> = files
        .iter()
        .map(|(file, text)| (file.as_str(), named_files(file, text, &modules)))
        .collect();
    let leads_to = |from: &str, to: &str| {
        let (mut seen, mut open) = (BTreeSet::new(), vec![from]);
        while let Some(file) = open.pop() {
            if file == to {
                return true;
            }
            if seen.insert(file) {
                open.extend(&named[file]);
            }
        }
        false
    };
    let mut faults = Vec::new();
    for (file, next) in &named {
        if let Some(next) = next.iter().find(|next| leads_to(next, file)) {
            faults.push(format!("{file} names {next}, which leads back to it"));
        }
    }
    faults
}

/// The path of the module in a file.
fn module(file: &str) -> Vec<&str> {
    let inside = file.strip_prefix("src/").unwrap_or(file);
    let mut path: Vec<&str> = inside.trim_end_matches(".rs").split('/').collect();
    if path.last() == Some(&"mod") {
        path.pop();
    }
    path
}

/// The files that the code of a file names, its tests left out.
fn named_files<'a>(
    file: &str,
    text: &str,
    modules: &BTreeMap<Vec<&str>, &'a str>,
) -> BTreeSet<&'a str> {
    let tokens = tokens(text);
    let tests = ["#", "[", "cfg", "(", "test", ")", "]"];
    let end = tokens.windows(tests.len()).position(|w| w == tests);
    let tokens = &tokens[..end.unwrap_or(tokens.len())];
    let own = module(file);
    let mut found = BTreeSet::new();
    for (i, token) in tokens.iter().enumerate() {
        let before = i.checked_sub(1).map_or("", |i| tokens[i].as_str());
        // The second is a visibility.
        if before == "::" || before == "in" || tokens.get(i + 1).is_none_or(|t| t != "::") {
            continue;
        }
        let begin = match token.as_str() {
            "crate" => Vec::new(),
            "super" => own[..own.len() - 1].to_vec(),
            "self" => own.clone(),
            name => {
                let child = [&own[..], &[name]].concat();
                if !modules.contains_key(&child) {
                    continue;
                }
                child
            }
        };
        for rest in paths(tokens, i + 2) {
            let mut path = begin.clone();
            for name in rest {
                match name {
                    "super" => {
                        path.pop();
                    }
                    "self" => {}
                    name => path.push(name),
                }
            }
            while !path.is_empty() && !modules.contains_key(&path) {
                path.pop();
            }
            found.extend(modules.get(&path).filter(|other| **other != file));
        }
    }
    found
}

/// The paths that begin at `at`; a group in braces stands for several.
fn paths(tokens: &[String], at: usize) -> Vec<Vec<&str>> {
    let Some(first) = tokens.get(at) else {
        return vec![Vec::new()];
    };
    if first != "{" {
        let mut all = vec![Vec::new()];
        if tokens.get(at + 1).is_some_and(|t| t == "::") {
            all = paths(tokens, at + 2);
        }
        for path in &mut all {
            path.insert(0, first.as_str());
        }
        return all;
    }
    let (mut all, mut depth) = (Vec::new(), 0);
    for i in at..tokens.len() {
        match tokens[i].as_str() {
            "{" => depth += 1,
            "}" => depth -= 1,
            _ if depth == 1 && ["{", ","].contains(&tokens[i - 1].as_str()) => {
                all.extend(paths(tokens, i));
            }
            _ => {}
        }
        if depth == 0 {
            break;
        }
    }
    all
}

#[test]
fn planted_circles_are_found() {
    let file = |name: &str, text: &str| (format!("src/{name}"), text.to_owned());
    let below = file("d/below.rs", "pub struct B; // crate::d::above");
    let straight = [
        file("d/mod.rs", "mod above; mod below; pub use above::A;"),
        file(
            "d/above.rs",
            "use super::below::B; pub(in crate::d) struct A(B);",
        ),
        below.clone(),
    ];
    assert_eq!(circles(&straight), Vec::<String>::new());
    for text in [
        "use crate::d::above::A;",
        "use crate::{d::{x::Y, above}};",
        "fn f(_: super::above::A) {}",
        "use super::A;",
    ] {
        let mut bent = straight.clone();
        bent[2] = file("d/below.rs", text);
        let faults = circles(&bent);
        assert!(faults.len() >= 2, "{text}: {faults:?}");
        bent[2] = file(
            "d/below.rs",
            &format!("#[cfg(test)]\nmod tests {{ {text} }}"),
        );
        assert_eq!(circles(&bent), Vec::<String>::new(), "{text}");
    }
}
