//! Tests the questions and messages at a terminal, and the behaviour in a script.

use super::{home_with_folder, stderr};
use crate::harness::{Home, coseg, json, skittle, stdout};
use rustix::process::{Pid, Signal, kill_process};
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::os::unix::process::ExitStatusExt as _;
use std::process::{Command, Stdio};

/// Runs a command at a terminal of `script`, and types an answer; returns the status and the
/// output.
fn typed(home: &Home, command: &str, answer: &str) -> (Option<i32>, String) {
    let program = env!("CARGO_BIN_EXE_coseg");
    let mut child = Command::new("script")
        .args([
            "-qec",
            &format!("{program} {command} --timeout 60"),
            "/dev/null",
        ])
        .env("COSEG_ENDPOINT", home.endpoint())
        .env("NO_COLOR", "1")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .expect("`script` of util-linux is there");
    let mut stdin = child.stdin.take().unwrap();
    stdin.write_all(answer.as_bytes()).unwrap();
    let mut seen = String::new();
    child
        .stdout
        .take()
        .unwrap()
        .read_to_string(&mut seen)
        .unwrap();
    drop(stdin);
    (child.wait().unwrap().code(), seen.replace('\r', ""))
}

#[test]
fn what_cannot_be_undone_is_asked_at_a_terminal_and_nowhere_else() {
    let (home, folder) = home_with_folder();
    let _daemon = home.start();
    stdout(&home.coseg(&["add", &folder, "-c", "c", "--parts", "2"]), 0);
    let (status, seen) = typed(&home, "rm 9 10", "n\n");
    assert_eq!(status, Some(1), "{seen}");
    assert!(seen.contains("Remove 9, 10 from c, "), "{seen}");
    assert!(
        seen.contains("[y/N]") && seen.contains("nothing was removed"),
        "{seen}"
    );
    // Return alone means no.
    let (status, seen) = typed(&home, "collections delete c", "\n");
    assert_eq!(status, Some(1), "{seen}");
    assert!(seen.contains("Delete c with its 3 shapes and "), "{seen}");
    assert!(seen.contains("nothing was deleted"), "{seen}");
    let n_shapes = || json(&home.coseg(&["stats", "--json"]), 0)["n_shapes"].clone();
    assert_eq!(n_shapes(), 3);

    let (status, seen) = typed(&home, "rm 9", "y\n");
    assert_eq!(status, Some(0), "{seen}");
    assert!(seen.contains("9: removed from c"), "{seen}");
    let (status, seen) = typed(&home, "rm --yes 10", "");
    assert_eq!(status, Some(0), "{seen}");
    assert!(
        !seen.contains("[y/N]") && seen.contains("10: removed from c"),
        "{seen}"
    );
    assert_eq!(n_shapes(), 1);

    // A script is not asked; the message still names the removed shapes.
    let output = home.coseg(&["collections", "delete", "c"]);
    assert_eq!(stdout(&output, 0), "");
    assert!(
        stderr(&output).starts_with("c: deleted, with 1 shape and "),
        "{}",
        stderr(&output)
    );
    assert_eq!(n_shapes(), 0);
}

#[test]
fn an_interrupted_addition_says_what_goes_on_and_how_to_cancel_it() {
    let home = Home::new();
    let _daemon = home.start_with(&["--workers", "1"], &[]);
    let folder = home.path("many");
    std::fs::create_dir(&folder).unwrap();
    for i in 0..80 {
        std::fs::write(folder.join(format!("{i}.off")), skittle(i)).unwrap();
    }
    let mut add = coseg();
    add.args(["add", "-c", "c", "--parts", "2", "--timeout", "60"])
        .arg(&folder);
    add.env("COSEG_ENDPOINT", home.endpoint());
    let mut child = add
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    // The first shape is stored, so its job and those sent ahead are accepted.
    // The pipe stays open, since closing it would end the command in another way.
    let mut lines = BufReader::new(child.stdout.take().unwrap());
    let mut first = String::new();
    lines.read_line(&mut first).unwrap();
    assert!(first.starts_with("0: added"), "{first}");
    kill_process(Pid::from_child(&child), Signal::INT).unwrap();
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.signal(), Some(Signal::INT.as_raw()));
    let message = stderr(&output);
    assert!(
        message.contains("the daemon continues with the accepted work"),
        "{message}"
    );
    assert!(
        message.contains("to follow: coseg wait -c \"c\""),
        "{message}"
    );
    let line = message
        .lines()
        .find_map(|l| l.trim().strip_prefix("to cancel: coseg "));
    let cancel: Vec<&str> = line.expect("how to cancel").split(' ').collect();
    assert!(cancel.len() >= 2 && cancel[0] == "cancel", "{message}");

    let cancelled = home.coseg(&cancel);
    stdout(&cancelled, 0);
    let counted = stderr(&cancelled);
    assert!(
        counted.contains("of \"c\": shapes ") && counted.contains(" cancelled"),
        "{counted}"
    );
    stdout(&home.coseg(&["wait", "c"]), 0);
    let n = json(&home.coseg(&["stats", "--json"]), 0)["n_shapes"]
        .as_u64()
        .unwrap();
    assert!((1..80).contains(&n), "{n} shapes");
    // The command cancels all unfinished jobs of the collection; none is left.
    let nothing = home.coseg(&["cancel", "-c", "c"]);
    assert_eq!(stdout(&nothing, 0), "");
    assert!(
        stderr(&nothing).contains("nothing was cancelled"),
        "{}",
        stderr(&nothing)
    );
    let unknown = home.coseg(&["cancel", "7777"]);
    assert_eq!(stderr(&unknown), "coseg: no job named \"7777\"\n");
    assert_eq!(unknown.status.code(), Some(1));
}

#[test]
fn stopping_says_what_is_waited_for_and_waits() {
    let home = Home::new();
    let daemon = home.start();
    let output = home.coseg(&["stop"]);
    assert_eq!(stdout(&output, 0), "");
    let expected = "the daemon answers pending requests, then ends\nthe daemon has ended\n";
    assert_eq!(stderr(&output), expected);
    assert_eq!(daemon.ended().0.code(), Some(0));
    let output = home.coseg(&["stop", "--timeout", "0.2"]);
    assert_eq!(output.status.code(), Some(3));

    let daemon = home.start();
    let report = json(&home.coseg(&["stop", "--no-wait", "--json"]), 0);
    assert_eq!(report["ended"], false);
    assert_eq!(daemon.ended().0.code(), Some(0));
}
