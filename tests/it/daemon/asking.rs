//! Questions, answers and verdicts over the command line.

use super::wait_idle;
use crate::harness::{Home, add, json, skittle, stdout};

#[test]
fn the_command_line_asks_answers_approves_and_undoes() {
    let home = Home::new();
    let daemon = home.start();
    let mut client = daemon.client();
    let texts: Vec<_> = (0..4).map(|i| (format!("s{i}"), skittle(i))).collect();
    let shapes: Vec<_> = texts
        .iter()
        .map(|(n, t)| (n.as_str(), t.as_str()))
        .collect();
    add(&mut client, "c", &shapes);
    wait_idle(&mut client, "c");
    let picture = home.path("part.png").display().to_string();
    let first = json(&home.coseg(&["ask", "c", "--json", "--png", &picture]), 0);
    assert_eq!(first["n_answered"], 0);
    assert!(std::fs::read(&picture).unwrap().starts_with(b"\x89PNG"));
    let id = first["id"].as_str().unwrap();
    let shape = first["shape"].as_str().unwrap();
    let done = json(
        &home.coseg(&["answer", id, "--new", "body", "--by", "ada", "--json"]),
        0,
    );
    assert_eq!(
        (&done["shape"], &done["n_shapes"]),
        (&first["shape"], &4.into())
    );
    let shown = stdout(&home.coseg(&["ask", "c"]), 0);
    assert!(shown.contains("body"), "{shown}");
    let second = json(&home.coseg(&["ask", "c", "--json"]), 0);
    assert_eq!(second["n_answered"], 1);
    let id = second["id"].as_str().unwrap();
    json(&home.coseg(&["answer", id, "body", "--json"]), 0);
    let third = json(&home.coseg(&["ask", "c", "--json"]), 0);
    let id = third["id"].as_str().unwrap();
    let skipped = json(&home.coseg(&["answer", id, "--skip", "--json"]), 0);
    assert!(skipped["label"].is_null());
    assert_ne!(
        json(&home.coseg(&["ask", "c", "--json"]), 0)["id"],
        third["id"]
    );

    let approved = json(&home.coseg(&["approve", "s3", "--by", "ada", "--json"]), 0);
    assert_eq!(approved["review"], "approved");
    stdout(&home.coseg(&["approve", "s2", "--doubtful"]), 0);
    let of = |state: &str| {
        let list = json(&home.coseg(&["ls", "c", "--review", state, "--json"]), 0);
        let shapes = list["shapes"].as_array().unwrap().clone();
        shapes.iter().map(|s| s["name"].clone()).collect::<Vec<_>>()
    };
    assert_eq!(of("approved"), ["s3"]);
    assert_eq!(of("doubtful"), ["s2"]);
    assert!(!of("corrected").contains(&"s3".into()));
    let undone = json(&home.coseg(&["undo", "--json"]), 0);
    assert_eq!(
        (&undone["undone"], &undone["subject"]),
        (&"doubt".into(), &"s2".into())
    );
    let undone = json(&home.coseg(&["undo", "--json"]), 0);
    assert_eq!(
        (&undone["undone"], &undone["subject"]),
        (&"approve".into(), &"s3".into())
    );
    let last = json(&home.coseg(&["undo", "--json"]), 0);
    assert_eq!(last["undone"], "answer");
    stdout(&home.coseg(&["undo"]), 0);
    assert!(of("corrected").is_empty());
    // Parts are written SHAPE:NUMBER, and one answer is required.
    assert_eq!(
        home.coseg(&["answer", shape, "body"]).status.code(),
        Some(2)
    );
    assert_eq!(home.coseg(&["answer", "s1:0"]).status.code(), Some(2));
    let both = home.coseg(&["answer", "s1:0", "body", "--skip"]);
    assert_eq!(both.status.code(), Some(2));
}
