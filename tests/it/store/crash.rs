//! Two processes, and processes that are killed.

use super::{add_shape, collection_id};
use coseg::store::check::check;
use coseg::store::rows::ObjectKind;
use coseg::store::{Store, StoreError};
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::Duration;

/// Tells a child process, which is this binary again, which folder to work on.
const CHILD_LIBRARY: &str = "COSEG_TEST_STORE_CHILD";

fn child(test: &str, library: &Path) -> (Child, BufReader<ChildStdout>) {
    let mut child = Command::new(std::env::current_exe().expect("a path"))
        .args(["--exact", test, "--nocapture", "--test-threads=1"])
        .env(CHILD_LIBRARY, library)
        .stdout(Stdio::piped())
        .spawn()
        .expect("starts");
    let stdout = child.stdout.take().expect("piped");
    (child, BufReader::new(stdout))
}

/// Reads lines until one says `prefix`, and returns what follows.
fn line_after(lines: &mut impl BufRead, prefix: &str) -> Option<String> {
    let mut line = String::new();
    while lines.read_line(&mut line).expect("readable") > 0 {
        if let Some((_, rest)) = line.split_once(prefix) {
            return Some(rest.trim().to_string());
        }
        line.clear();
    }
    None
}

/// Not a test of its own: what the killed process does.
#[test]
fn child_adds_shapes_until_it_is_killed() {
    let Some(library) = std::env::var_os(CHILD_LIBRARY) else { return };
    let store = Store::open(Path::new(&library)).expect("opens");
    let seen = store.catalog().read(|r| r.totals()).expect("readable").n_shapes as u32;
    println!("ready {seen}");
    for seed in seen.. {
        add_shape(&store, "chairs", &format!("s{seed}"), seed).expect("added");
        println!("acknowledged {seed}");
    }
}

#[test]
fn one_process_holds_a_library() {
    let dir = tempfile::tempdir().expect("a folder");
    let (mut process, mut lines) =
        child("store::crash::child_adds_shapes_until_it_is_killed", dir.path());
    line_after(&mut lines, "ready ").expect("the child opened the library");
    let second = Store::open(dir.path()).err().expect("refused");
    assert!(matches!(second, StoreError::Locked { .. }), "{second}");
    process.kill().expect("killed");
    process.wait().expect("ended");
    let store = Store::open(dir.path()).expect("a killed process holds nothing");
    assert!(matches!(Store::open(dir.path()), Err(StoreError::Locked { .. })));
    drop(store);
    Store::open(dir.path()).expect("a closed store holds nothing");
}

#[test]
fn what_was_acknowledged_survives_a_kill() {
    let dir = tempfile::tempdir().expect("a folder");
    let mut n_acknowledged = 0;
    for round in 0..12 {
        let (mut process, mut lines) =
            child("store::crash::child_adds_shapes_until_it_is_killed", dir.path());
        let seen = line_after(&mut lines, "ready ").expect("opens").parse::<u32>().expect("a count");
        // One may have become durable and not been heard of.
        assert!(seen == n_acknowledged || seen == n_acknowledged + 1, "{seen} {n_acknowledged}");
        n_acknowledged = seen;
        for _ in 0..round % 5 {
            line_after(&mut lines, "acknowledged ").expect("goes on");
            n_acknowledged += 1;
        }
        // The point within an addition is the scheduler's choice, spread by a varying delay.
        std::thread::sleep(Duration::from_micros(700 * round));
        process.kill().expect("killed");
        process.wait().expect("ended");
        while line_after(&mut lines, "acknowledged ").is_some() {
            n_acknowledged += 1;
        }
        let damage: Vec<_> =
            check(dir.path()).expect("runs").into_iter().filter(|f| f.damage).collect();
        assert_eq!(damage, [], "after kill {round}");
    }
    let store = Store::open(dir.path()).expect("opens");
    let id = collection_id(&store, "chairs");
    let shapes = store.catalog().read(|r| r.shapes(id, 0, usize::MAX, None)).expect("readable");
    assert!(shapes.len() as u32 >= n_acknowledged);
    assert!(n_acknowledged > 0);
    for (seed, shape) in shapes.iter().enumerate() {
        assert_eq!(shape.name, format!("s{seed}"));
        let object = store
            .catalog()
            .read(|r| r.object(ObjectKind::Original, &shape.content_digest))
            .expect("readable");
        let bytes = store.objects().original(&object.expect("catalogued")).expect("whole");
        assert_eq!(bytes, format!("OFF chairs s{seed} {seed}").into_bytes());
    }
}
