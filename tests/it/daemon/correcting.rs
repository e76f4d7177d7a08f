//! Tests corrections over the real socket and the command line: propagated, refused, undone,
//! resumed.

use super::{events_since, wait_idle};
use crate::harness::{Daemon, Home, SKITTLE_FACES, add, json, refusal, skittle, stdout};
use coseg::call;
use coseg::ipc::client::Client;
use coseg::ipc::frames::{FrameReader, FrameWriter};
use coseg::ipc::wire::{
    self, ErrorCode, ErrorReason, correct_labels_request::Correction, event::Kind, request,
};
use rustix::process::Signal;
use std::collections::BTreeMap;

/// Labels of a [`skittle`]: 9 up to the neck, 4 above; faces are numbered from the bottom up,
/// sector by sector.
fn truth() -> Vec<i32> {
    let per_sector = SKITTLE_FACES / 16;
    let ring = |face: usize| (face % per_sector).saturating_sub(2) / 2 + 1;
    let label = |face: usize| match face % per_sector {
        0 => 9,
        1 => 4,
        _ if ring(face) < 16 => 9,
        _ => 4,
    };
    (0..SKITTLE_FACES).map(label).collect()
}

/// A daemon with some skittles in collection c.
fn stocked(home: &Home, n: u32) -> (Daemon, Client) {
    let daemon = home.start();
    let mut client = daemon.client();
    let texts: Vec<_> = (0..n).map(|i| (format!("s{i}"), skittle(i))).collect();
    let shapes: Vec<_> = texts
        .iter()
        .map(|(n, t)| (n.as_str(), t.as_str()))
        .collect();
    add(&mut client, "c", &shapes);
    wait_idle(&mut client, "c");
    (daemon, client)
}

fn snapshot(client: &mut Client) -> BTreeMap<String, Vec<i32>> {
    let request = wire::LabelsSnapshotRequest {
        collection: "c".to_owned(),
    };
    let (reply, frames) = call!(client, LabelsSnapshot(request), frames).unwrap();
    let reader = FrameReader::new(&frames);
    let labels = |s: &wire::ShapeLabels| reader.i32_array(s.labels.as_ref(), "labels").unwrap().0;
    reply
        .shapes
        .iter()
        .map(|s| (s.shape.clone(), labels(s)))
        .collect()
}

fn correct_request(shape: &str, labels: &[i32]) -> (wire::CorrectLabelsRequest, FrameWriter) {
    let mut frames = FrameWriter::default();
    let labels = frames.i32_array(labels, &[labels.len()]);
    let request = wire::CorrectLabelsRequest {
        collection: "c".to_owned(),
        shape: shape.to_owned(),
        correction: Some(Correction::Labels(labels)),
        by: String::new(),
        closed: None,
    };
    (request, frames)
}

fn correct(client: &mut Client, shape: &str, labels: &[i32]) -> wire::CorrectLabelsReply {
    let (request, frames) = correct_request(shape, labels);
    call!(client, CorrectLabels(request), frames.finish(), with_frames)
        .unwrap()
        .0
}

/// Least share of right faces over all shapes but one.
fn worst(found: &BTreeMap<String, Vec<i32>>, except: &str) -> f64 {
    let truth = truth();
    let right = |labels: &Vec<i32>| {
        let hits = labels.iter().zip(&truth).filter(|(l, t)| l == t).count();
        hits as f64 / truth.len() as f64
    };
    let others = found.iter().filter(|(name, _)| *name != except);
    others.map(|(_, labels)| right(labels)).fold(1.0, f64::min)
}

#[test]
fn a_correction_is_a_job_with_progress() {
    let home = Home::new();
    let (_daemon, mut client) = stocked(&home, 5);
    let done = correct(&mut client, "s1", &truth());
    let (mut progress, mut revision) = (Vec::new(), 0);
    let job = loop {
        let request = wire::WatchJobRequest {
            job_id: done.job_id,
            revision,
            wait_ms: 10_000,
        };
        let job = call!(client, WatchJob(request)).unwrap().job.unwrap();
        progress.push(job.progress);
        if job.finished {
            break job;
        }
        revision = job.revision;
    };
    assert!(progress.is_sorted() && job.progress == 1.0, "{progress:?}");
    let all = wire::Carrying {
        n_shapes: 4,
        n_left: 0,
    };
    assert_eq!((job.items.len(), job.carrying), (0, Some(all)));
    assert_eq!(worst(&snapshot(&mut client), "s1"), {
        wait_idle(&mut client, "c");
        worst(&snapshot(&mut client), "s1")
    });

    let next = correct(&mut client, "s3", &truth());
    assert!(next.job_id > done.job_id);
    let first = wire::GetJobRequest {
        job_id: done.job_id,
    };
    let first = call!(client, GetJob(first)).unwrap().job.unwrap();
    assert!(first.finished && first.carrying == Some(wire::Carrying::default()));
}

#[test]
fn a_correction_changes_the_others_survives_a_restart_and_is_undone() {
    let home = Home::new();
    let (daemon, mut client) = stocked(&home, 6);
    let before = snapshot(&mut client);
    let n_events = events_since(&mut client, "c").len();
    let done = correct(&mut client, "s2", &truth());
    assert_eq!((done.n_faces as usize, done.n_stale), (SKITTLE_FACES, 5));
    wait_idle(&mut client, "c");
    let after = snapshot(&mut client);
    assert_eq!(after["s2"], truth());
    assert!(worst(&after, "s2") > 0.9, "{:.3}", worst(&after, "s2"));

    let events = events_since(&mut client, "c");
    let causes: Vec<_> = events[n_events..]
        .iter()
        .filter_map(|e| match &e.kind {
            Some(Kind::LabelsChanged(c)) => Some((c.cause.as_str(), c.shape.as_str())),
            Some(Kind::Corrected(c)) => Some(("corrected", c.shape.as_str())),
            _ => None,
        })
        .collect();
    assert_eq!(causes[..2], [("corrected", "s2"), ("correction", "s2")]);
    let mut carried: Vec<_> = causes[2..].to_vec();
    carried.sort_unstable();
    let expected = ["s0", "s1", "s3", "s4", "s5"].map(|s| ("carrying", s));
    assert_eq!(carried, expected);
    for change in &events[n_events..] {
        if let Some(Kind::LabelsChanged(c)) = &change.kind {
            assert!(c.moves.iter().all(|m| m.area_share > 0.0 && m.from != m.to));
        }
    }

    daemon.signal(Signal::TERM);
    drop(daemon.ended());
    let daemon = home.start();
    let mut client = daemon.client();
    assert_eq!(snapshot(&mut client), after);
    let undo = wire::UndoRequest {
        collection: "c".to_owned(),
    };
    let undone = call!(client, Undo(undo.clone())).unwrap();
    assert_eq!((undone.change.as_str(), undone.n_left), ("correct", 0));
    wait_idle(&mut client, "c");
    assert_eq!(snapshot(&mut client), before);
    let expected = (ErrorCode::FailedPrecondition, ErrorReason::NothingToUndo);
    assert_eq!(refusal(&mut client, request::Body::Undo(undo)), expected);
}

#[test]
fn kill_9_while_a_correction_is_carried_loses_nothing() {
    let home = Home::new();
    let (daemon, mut client) = stocked(&home, 6);
    // The result without interruption.
    correct(&mut client, "s1", &truth());
    wait_idle(&mut client, "c");
    let undisturbed = snapshot(&mut client);
    let undo = wire::UndoRequest {
        collection: "c".to_owned(),
    };
    call!(client, Undo(undo)).unwrap();
    wait_idle(&mut client, "c");
    correct(&mut client, "s1", &truth());
    daemon.signal(Signal::KILL);
    drop(daemon.ended());
    let daemon = home.start();
    let mut client = daemon.client();
    wait_idle(&mut client, "c");
    assert_eq!(snapshot(&mut client), undisturbed);
    drop(daemon);
    stdout(
        &home.coseg(&[
            "check",
            "--library",
            &home.path("library").display().to_string(),
        ]),
        0,
    );
}

#[test]
fn the_same_correction_again_has_one_effect_and_the_same_reply_across_a_restart() {
    let home = Home::new();
    let (daemon, mut client) = stocked(&home, 2);
    client.set_client_id("me");
    let (request, frames) = correct_request("s0", &truth());
    let (body, frames) = (request::Body::CorrectLabels(request), frames.finish());
    let first = client
        .call_as("once", body.clone(), frames.clone())
        .unwrap()
        .0;
    wait_idle(&mut client, "c");
    let n_events = events_since(&mut client, "c").len();
    assert_eq!(
        client
            .call_as("once", body.clone(), frames.clone())
            .unwrap()
            .0,
        first
    );
    daemon.signal(Signal::KILL);
    drop(daemon.ended());
    let daemon = home.start();
    let mut client = daemon.client();
    client.set_client_id("me");
    assert_eq!(client.call_as("once", body, frames).unwrap().0, first);
    assert_eq!(events_since(&mut client, "c").len(), n_events);
}

#[test]
fn wrong_corrections_are_refused_with_their_place() {
    let home = Home::new();
    let (_daemon, mut client) = stocked(&home, 1);
    let refused = |client: &mut Client, labels: &[i32]| {
        let (request, frames) = correct_request("s0", labels);
        let body = request::Body::CorrectLabels(request);
        match client.call(body, frames.finish()) {
            Err(coseg::ipc::client::ClientError::Refused(e)) => *e,
            other => panic!("not refused: {other:?}"),
        }
    };
    let e = refused(&mut client, &[1, 2]);
    assert_eq!(e.reason(), ErrorReason::LabelCount);
    let mut labels = truth();
    labels[17] = -7;
    let e = refused(&mut client, &labels);
    assert_eq!(e.reason(), ErrorReason::LabelRange);
    assert_eq!(e.subject, Some(wire::error::Subject::Face(17)));
    assert_eq!(
        e.message,
        "the label of face 17 is -7, but must be -1 to 65535"
    );
}

#[test]
fn the_command_line_suggests_corrects_names_merges_splits_and_undoes() {
    let home = Home::new();
    let (_daemon, _) = stocked(&home, 4);
    let next = json(&home.coseg(&["suggest", "--json"]), 0);
    let shape = next["shape"].as_str().unwrap();
    assert_eq!(next["n_corrected"], 0);
    let file = |text: String| home.mesh("labels.txt", &text);
    let lines = |labels: &[i32]| labels.iter().map(|l| format!("{l}\n")).collect::<String>();
    for (text, message) in [
        (
            "4\nfour\n".to_owned(),
            "labels.txt: line 2 is \"four\", but must be an integer".to_owned(),
        ),
        (
            "4\n70000\n".to_owned(),
            "labels.txt: line 2 is 70000, but must be -1 to 65535".to_owned(),
        ),
        (
            "4\n9\n".to_owned(),
            format!("labels.txt has 2 labels, but shape {shape:?} has {SKITTLE_FACES} faces"),
        ),
    ] {
        let output = home.coseg(&["correct", shape, &file(text)]);
        assert_eq!(output.status.code(), Some(1));
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert!(stderr.trim_end().ends_with(&message), "{stderr}");
    }
    let good = file(lines(&truth()));
    let done = json(&home.coseg(&["correct", shape, &good, "--json"]), 0);
    assert_eq!(done["n_faces"], SKITTLE_FACES);
    let labels = stdout(&home.coseg(&["labels", shape]), 0);
    assert_eq!(labels, lines(&truth()));
    let other = if shape == "s0" { "s1" } else { "s0" };
    let carried = stdout(&home.coseg(&["labels", other]), 0);
    assert!(carried.lines().all(|l| l == "9" || l == "4"));

    stdout(&home.coseg(&["name", "9", "body"]), 0);
    let taken = home.coseg(&["name", "4", "body"]);
    assert_eq!(taken.status.code(), Some(1));
    let merged = json(&home.coseg(&["merge", "4", "9", "--json"]), 0);
    assert_eq!(
        (&merged["label"]["id"], &merged["n_shapes"]),
        (&9.into(), &4.into())
    );
    let split = json(&home.coseg(&["split", "9", "--json"]), 0);
    assert!(split["id"].as_u64().unwrap() > 9);
    for expected in ["split", "merge", "name", "correct"] {
        let undone = json(&home.coseg(&["undo", "--json"]), 0);
        assert_eq!(undone["undone"], expected);
        if expected == "merge" {
            assert_eq!(stdout(&home.coseg(&["labels", other]), 0), carried);
        }
    }
    assert_eq!(home.coseg(&["undo"]).status.code(), Some(1));
}

#[test]
fn a_collection_becomes_one_picture_and_the_same_one_again() {
    let home = Home::new();
    let (_daemon, _) = stocked(&home, 3);
    stdout(&home.coseg(&["name", "0", "body"]), 0);
    let file = |name: &str| home.path(name).display().to_string();
    let about = json(
        &home.coseg(&["render", "c", "-o", &file("a.png"), "--json"]),
        0,
    );
    stdout(&home.coseg(&["render", "-o", &file("b.png")]), 0);
    let one = std::fs::read(home.path("a.png")).unwrap();
    assert_eq!(one, std::fs::read(home.path("b.png")).unwrap());
    let decoder = png::Decoder::new(std::io::Cursor::new(one));
    let mut reader = decoder.read_info().unwrap();
    let (width, height) = reader.info().size();
    assert_eq!(
        (about["width"].as_u64(), about["height"].as_u64()),
        (Some(width.into()), Some(height.into()))
    );
    let mut pixels = vec![0; (width * height * 3) as usize];
    reader.next_frame(&mut pixels).unwrap();
    let coloured = pixels
        .chunks_exact(3)
        .filter(|p| p.iter().max() != p.iter().min())
        .count();
    assert!(coloured > 3_000, "{coloured} pixels have a colour");
    let fewer = json(
        &home.coseg(&["render", "-o", &file("c.png"), "--max", "1", "--json"]),
        0,
    );
    assert_eq!(fewer["n_shapes"], 1);
}
