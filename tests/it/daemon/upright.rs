//! Tests changes of the up axis over the real socket and the command line: the warning, the change,
//! a kill in the middle.

use super::{events_since, wait_idle};
use crate::harness::{Home, add, json, refusal, stdout};
use coseg::call;
use coseg::ipc::wire::{self, ErrorCode, ErrorReason, event::Kind, request::Body};
use coseg::mesh::write::off;
use coseg::synth::{Family, Options, family};
use rustix::process::Signal;

const FEW_FACES: Options = Options {
    n_faces: 1_000,
    rotate: false,
};

/// A folder with chairs that stand along +y.
fn folder_of_chairs(home: &Home, n: u32) -> String {
    let folder = home.path("chairs");
    std::fs::create_dir(&folder).unwrap();
    for chair in family(Family::Chair, 31, n, &FEW_FACES) {
        std::fs::write(folder.join(format!("{}.off", chair.name)), off(&chair.mesh)).unwrap();
    }
    folder.display().to_string()
}

#[test]
fn the_command_line_warns_of_a_wrong_axis_and_changes_it() {
    let home = Home::new();
    let _daemon = home.start();
    let folder = folder_of_chairs(&home, 4);
    let run = |args: &[&str]| home.coseg(args);
    let warned = |output: &std::process::Output| -> bool {
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        let warns = text.contains("of its shapes stand along +y");
        assert_eq!(
            warns,
            text.contains("coseg collections set fallen --up +y"),
            "{text}"
        );
        warns
    };
    let added = run(&[
        "add",
        &folder,
        "--collection",
        "fallen",
        "--parts",
        "4",
        "--up",
        "-z",
        "--json",
    ]);
    assert!(warned(&added));
    assert_eq!(json(&added, 0)["up_disagrees"]["up"], "+y");
    for args in [&["show", "--collection", "fallen"][..], &["ls"]] {
        let shown = run(args);
        assert!(warned(&shown), "{args:?}");
        stdout(&shown, 0);
    }
    let set = run(&["collections", "set", "fallen", "--up", "+y", "--json"]);
    assert!(!warned(&set));
    let set = json(&set, 0);
    assert_eq!(
        (&set["changed"], &set["up"], &set["n_stale"]),
        (&true.into(), &"+y".into(), &0.into())
    );
    assert_eq!(set["up_disagrees"], serde_json::Value::Null);
    assert!(!warned(&run(&["show", "--collection", "fallen"])));
    let again = json(
        &run(&["collections", "set", "fallen", "--up", "+y", "--json"]),
        0,
    );
    assert_eq!(
        (&again["changed"], &again["n_undoable"]),
        (&false.into(), &1.into())
    );
    let undone = json(&run(&["undo", "--collection", "fallen", "--json"]), 0);
    assert_eq!(undone["undone"], "up");
    assert!(warned(&run(&["show", "--collection", "fallen"])));
    let events = json(&run(&["events", "--collection", "fallen", "--json"]), 0);
    let changed = events["events"]
        .as_array()
        .unwrap()
        .iter()
        .find(|e| e["kind"] == "up_changed");
    let changed = changed.unwrap();
    assert_eq!(
        (&changed["from"], &changed["to"]),
        (&"-z".into(), &"+y".into())
    );
}

#[test]
fn an_axis_that_is_missing_or_unknown_is_refused() {
    let home = Home::new();
    let daemon = home.start();
    let mut client = daemon.client();
    add(&mut client, "c", &[("a", &crate::harness::skittle(0))]);
    let mut refused = |collection: &str, up: i32| {
        let collection = collection.to_owned();
        let body = Body::UpdateCollection(wire::UpdateCollectionRequest { collection, up });
        refusal(&mut client, body)
    };
    let invalid = ErrorCode::InvalidArgument;
    assert_eq!(refused("c", 0), (invalid, ErrorReason::FieldMissing));
    assert_eq!(refused("c", 99), (invalid, ErrorReason::FieldRange));
    assert_eq!(
        refused("none", wire::Up::PlusX.into()).0,
        ErrorCode::NotFound
    );
}

/// The number of requests that are answered before the kill varies its moment.
#[test]
fn kill_9_while_the_axis_changes_leaves_the_old_or_the_new_one() {
    for n_answers in [0, 3, 30] {
        let home = Home::new();
        let daemon = home.start();
        let folder = folder_of_chairs(&home, 4);
        stdout(
            &home.coseg(&[
                "add",
                &folder,
                "--collection",
                "c",
                "--parts",
                "4",
                "--up",
                "-z",
            ]),
            0,
        );
        let body = Body::UpdateCollection(wire::UpdateCollectionRequest {
            collection: "c".to_owned(),
            up: wire::Up::PlusY.into(),
        });
        let mut sender = daemon.client();
        sender.set_client_id("me");
        let sent = body.clone();
        let asking = std::thread::spawn(move || sender.call_as("once", sent, vec![]).is_ok());
        let mut client = daemon.client();
        for _ in 0..n_answers {
            call!(client, Stats(wire::StatsRequest {})).unwrap();
        }
        daemon.signal(Signal::KILL);
        drop(daemon.ended());
        let daemon = home.start();
        let answered = asking.join().unwrap();
        let mut client = daemon.client();
        client.set_client_id("me");
        let describe = wire::DescribeCollectionRequest {
            collection: "c".to_owned(),
        };
        let found = call!(client, DescribeCollection(describe.clone()))
            .unwrap()
            .collection
            .unwrap();
        let is_new = found.spec.unwrap().up() == wire::Up::PlusY;
        assert_eq!(
            is_new,
            found.up_disagrees.is_none(),
            "axis and state change together"
        );
        assert_eq!(found.n_undoable, u64::from(is_new));
        assert!(is_new || !answered, "what was answered is durable");
        // Repeating the request has one effect.
        client.call_as("once", body, vec![]).unwrap();
        wait_idle(&mut client, "c");
        let events = events_since(&mut client, "c");
        let n_changes = events
            .iter()
            .filter(|e| matches!(e.kind, Some(Kind::UpChanged(_))))
            .count();
        assert_eq!(n_changes, 1, "after {n_answers} answers");
        let found = call!(client, DescribeCollection(describe))
            .unwrap()
            .collection
            .unwrap();
        assert_eq!((found.n_undoable, found.n_stale), (1, 0));
        drop(daemon);
        let library = home.path("library").display().to_string();
        stdout(&home.coseg(&["check", "--library", &library]), 0);
    }
}
