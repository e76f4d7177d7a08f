//! Tests two processes, killed processes, and failing system calls.

use super::{add_shape, collection_id};
use crate::harness::number;
use coseg::store::check::check;
use coseg::store::rows::ObjectKind;
use coseg::store::{Store, StoreError};
use std::collections::VecDeque;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::Duration;

/// Names the folder for a child process, which is this binary again.
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

/// Reads lines until one begins with `prefix`, and returns the rest of it.
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

/// Not a test of its own: the work of the killed process.
#[test]
fn child_adds_shapes_until_it_is_killed() {
    let Some(library) = std::env::var_os(CHILD_LIBRARY) else {
        return;
    };
    let store = Store::open(Path::new(&library)).expect("opens");
    let seen = store
        .catalog()
        .read(|r| r.totals())
        .expect("readable")
        .n_shapes as u32;
    println!("ready {seen}");
    for seed in seen.. {
        add_shape(&store, "chairs", &format!("s{seed}"), seed).expect("added");
        println!("acknowledged {seed}");
    }
}

#[test]
fn one_process_holds_a_library() {
    let dir = tempfile::tempdir().expect("a folder");
    let (mut process, mut lines) = child(
        "store::crash::child_adds_shapes_until_it_is_killed",
        dir.path(),
    );
    line_after(&mut lines, "ready ").expect("the child opened the library");
    let second = Store::open(dir.path()).err().expect("refused");
    assert!(matches!(second, StoreError::Locked { .. }), "{second}");
    process.kill().expect("killed");
    process.wait().expect("ended");
    let store = Store::open(dir.path()).expect("a killed process holds nothing");
    assert!(matches!(
        Store::open(dir.path()),
        Err(StoreError::Locked { .. })
    ));
    drop(store);
    Store::open(dir.path()).expect("a closed store holds nothing");
}

#[test]
fn what_was_acknowledged_survives_a_kill() {
    let dir = tempfile::tempdir().expect("a folder");
    let mut n_acknowledged = 0;
    for round in 0..12 {
        let (mut process, mut lines) = child(
            "store::crash::child_adds_shapes_until_it_is_killed",
            dir.path(),
        );
        let seen = line_after(&mut lines, "ready ")
            .expect("opens")
            .parse::<u32>()
            .expect("a count");
        // One commit may have become durable without being reported.
        assert!(
            seen == n_acknowledged || seen == n_acknowledged + 1,
            "{seen} {n_acknowledged}"
        );
        n_acknowledged = seen;
        for _ in 0..round % 5 {
            line_after(&mut lines, "acknowledged ").expect("goes on");
            n_acknowledged += 1;
        }
        // The scheduler chooses the point within an addition; a varying delay spreads it.
        std::thread::sleep(Duration::from_micros(700 * round));
        process.kill().expect("killed");
        process.wait().expect("ended");
        while line_after(&mut lines, "acknowledged ").is_some() {
            n_acknowledged += 1;
        }
        let damage: Vec<_> = check(dir.path())
            .expect("runs")
            .into_iter()
            .filter(|f| f.damage)
            .collect();
        assert_eq!(damage, [], "after kill {round}");
    }
    let store = Store::open(dir.path()).expect("opens");
    let id = collection_id(&store, "chairs");
    let shapes = store
        .catalog()
        .read(|r| r.shapes(id, 0, usize::MAX, None))
        .expect("readable");
    assert!(shapes.len() as u32 >= n_acknowledged);
    assert!(n_acknowledged > 0);
    for (seed, shape) in shapes.iter().enumerate() {
        assert_eq!(shape.name, format!("s{seed}"));
        let object = store
            .catalog()
            .read(|r| r.object(ObjectKind::Original, &shape.content_digest))
            .expect("readable");
        let bytes = store
            .objects()
            .original(&object.expect("catalogued"))
            .expect("whole");
        assert_eq!(bytes, format!("OFF chairs s{seed} {seed}").into_bytes());
    }
}

/// Number of shapes that the traced child adds.
const N_TRACED: u32 = 3;

/// Not a test of its own: adds a few shapes, reports each result, and ends.
#[test]
fn child_adds_a_few_shapes() {
    let Some(library) = std::env::var_os(CHILD_LIBRARY) else {
        return;
    };
    let store = match Store::open(Path::new(&library)) {
        Ok(store) => store,
        Err(error) => return println!("not opened {error}"),
    };
    let seen = store
        .catalog()
        .read(|r| r.totals())
        .expect("readable")
        .n_shapes as u32;
    println!("ready {seen}");
    for seed in seen..seen + N_TRACED {
        // The same name until it succeeds, like a client.
        match add_shape(&store, "chairs", &format!("s{seed}"), seed) {
            Ok(_) => println!("acknowledged {seed}"),
            Err(error) => {
                // Only syncs fail here.
                let stopped = store.health().read_only().is_some();
                assert!(stopped, "{error}");
                assert!(matches!(error, StoreError::ReadOnly { .. }), "{error}");
                println!("refused {error}");
                let again = add_shape(&store, "chairs", &format!("s{seed}"), seed);
                assert!(
                    matches!(again, Err(StoreError::ReadOnly { .. })),
                    "{again:?}"
                );
                store
                    .catalog()
                    .read(|r| r.totals())
                    .expect("reads are served");
                return println!("ended");
            }
        }
    }
    println!("ended");
}

/// The result of a child with a manipulated system call.
struct Traced {
    /// Number of shapes that it found.
    n_found: Option<u32>,
    n_acknowledged: u32,
    refused: bool,
    ended: bool,
    tampered: bool,
}

/// Runs the child with the `n`th call of `call` manipulated, if it makes that many.
fn traced(library: &Path, call: &str, tamper: &str, n: u32) -> Traced {
    let log = tempfile::NamedTempFile::new().expect("a file");
    let output = Command::new("strace")
        .args(["-f", "-qq", "-e", &format!("trace={call}"), "-o"])
        .arg(log.path())
        .args(["-e", &format!("inject={call}:{tamper}:when={n}")])
        .arg(std::env::current_exe().expect("a path"))
        .args([
            "--exact",
            "store::crash::child_adds_a_few_shapes",
            "--nocapture",
        ])
        .args(["--test-threads=1"])
        .env(CHILD_LIBRARY, library)
        .output()
        .expect("runs");
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(!text.contains("panicked"), "{call} {n}: {text}");
    let found = text.split_once("ready ").map(|(_, rest)| rest);
    let found = found.and_then(|rest| rest.lines().next()?.trim().parse().ok());
    Traced {
        n_found: found,
        n_acknowledged: text.matches("acknowledged ").count() as u32,
        refused: text.contains("refused ") || text.contains("not opened "),
        ended: output.status.success(),
        tampered: std::fs::read_to_string(log.path())
            .expect("readable")
            .contains("(INJECTED)"),
    }
}

/// Whether system calls can be manipulated here.
fn can_trace() -> bool {
    let run = Command::new("strace")
        .args(["-qq", "-o", "/dev/null", "true"])
        .status();
    let can = run.is_ok_and(|status| status.success());
    if !can {
        println!("skipped: strace cannot trace here");
    }
    can
}

/// Checks a library after the child, which acknowledged this number of shapes in it.
fn assert_whole(library: &Path, n_acknowledged: u32, context: &str) {
    if library.join("catalog.db").exists() {
        let findings = check(library).unwrap_or_default();
        let damage: Vec<_> = findings.iter().filter(|finding| finding.damage).collect();
        // Before the very first commit no catalog exists.
        assert!(
            damage.is_empty() || n_acknowledged == 0,
            "{context}: {damage:?}"
        );
    }
    let store = Store::open(library).expect("starts unaided");
    let n_shapes = store
        .catalog()
        .read(|r| r.totals())
        .expect("readable")
        .n_shapes as u32;
    assert!(
        n_shapes == n_acknowledged || n_shapes == n_acknowledged + 1,
        "{context}: {n_shapes} shapes, {n_acknowledged} acknowledged"
    );
    add_shape(&store, "chairs", &format!("s{n_shapes}"), n_shapes).expect("goes on");
    drop(store);
    assert_eq!(
        check(library)
            .expect("runs")
            .iter()
            .filter(|f| f.damage)
            .count(),
        0,
        "{context}"
    );
}

#[test]
fn a_kill_at_any_durable_call_loses_nothing() {
    if !can_trace() {
        return;
    }
    let mut n_kills = 0;
    // Every sync and rename; every seventh of the many writes, unless the environment requests all.
    let each = number("COSEG_TEST_EACH_WRITE", 0) != 0;
    let write_step = if each { 1 } else { 7 };
    for (call, step) in [
        ("fsync", 1),
        ("fdatasync", 1),
        ("rename", 1),
        ("pwrite64", write_step),
    ] {
        for n in (1..).step_by(step) {
            let dir = tempfile::tempdir().expect("a folder");
            let child = traced(dir.path(), call, "signal=KILL", n);
            assert_whole(dir.path(), child.n_acknowledged, &format!("{call} {n}"));
            if child.ended {
                assert_eq!(child.n_acknowledged, N_TRACED);
                break;
            }
            n_kills += 1;
        }
    }
    println!("killed {n_kills} times");
    assert!(n_kills > 40, "{n_kills}");
}

/// Kills the process that follows a killed one, while it opens the library and continues.
#[test]
fn a_kill_during_the_recovery_from_a_kill_loses_nothing() {
    if !can_trace() {
        return;
    }
    let n_wanted = number("COSEG_TEST_KILLS", 3) as usize;
    // In the middle of commits, between the files and their rows, and earlier; in turn, as long as
    // such calls occur.
    let mut firsts = VecDeque::from([
        ("fdatasync", 5, 1),
        ("rename", 2, 1),
        ("pwrite64", 40, 7),
        ("fsync", 1, 1),
    ]);
    let (mut n_kills, mut n_places) = (0_usize, 0);
    while n_places < n_wanted
        && let Some((call, n, step)) = firsts.pop_front()
    {
        let dir = tempfile::tempdir().expect("a folder");
        if traced(dir.path(), call, "signal=KILL", n).ended {
            continue;
        }
        firsts.push_back((call, n + step, step));
        n_places += 1;
        for (again, limit) in [("fsync", 4), ("fdatasync", 4), ("pwrite64", 12)] {
            for m in (1..=limit).step_by(if again == "pwrite64" { 4 } else { 1 }) {
                let dir = tempfile::tempdir().expect("a folder");
                let one = traced(dir.path(), call, "signal=KILL", n);
                let two = traced(dir.path(), again, "signal=KILL", m);
                let context = format!("{call} {n}, then {again} {m}");
                let seen = two.n_found.unwrap_or(one.n_acknowledged);
                let n = one.n_acknowledged;
                assert!(seen == n || seen == n + 1, "{context}: {seen} of {n}");
                // Unreported shapes may exist too, one from each process.
                let heard = if two.n_found.is_some() {
                    seen + two.n_acknowledged
                } else {
                    n
                };
                assert_whole(dir.path(), heard, &context);
                n_kills += usize::from(!one.ended) + usize::from(!two.ended);
            }
        }
    }
    println!("killed {n_kills} times, first at {n_places} places, then during the recovery");
    assert!(n_places >= n_wanted.min(20), "{n_places}");
    assert!(n_kills > 10 * n_places, "{n_kills}");
}

#[test]
fn a_failing_sync_is_answered_with_refusal() {
    if !can_trace() {
        return;
    }
    let mut n_refused = 0;
    for call in ["fsync", "fdatasync"] {
        for n in 1.. {
            let dir = tempfile::tempdir().expect("a folder");
            let child = traced(dir.path(), call, "error=EIO", n);
            assert!(child.ended, "{call} {n}");
            assert_whole(dir.path(), child.n_acknowledged, &format!("{call} {n}"));
            if !child.tampered {
                break;
            }
            // SQLite ignores failed syncs of the folder, which the store syncs again itself.
            assert!(
                child.refused || child.n_acknowledged == N_TRACED,
                "{call} {n}"
            );
            n_refused += u32::from(child.refused);
        }
    }
    println!("refused {n_refused} times");
    assert!(n_refused > 20, "{n_refused}");
}
