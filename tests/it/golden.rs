//! Replays recorded conversations with a fresh daemon, whose replies must equal the recorded ones.
//!
//! `tests/golden/record.py` writes the files; the clients in other languages replay them too.

use crate::harness::Home;
use coseg::ipc::wire::{Reply, Request, error::Subject, reply};
use prost::Message as _;
use serde_json::Value;
use std::path::PathBuf;

fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/golden")
}

/// The frames of a recorded message: for each its length and its bytes.
fn frames(name: &str, what: &str) -> Vec<Vec<u8>> {
    let path = folder().join(format!("{name}.{what}.bin"));
    let bytes = std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let mut rest = bytes.as_slice();
    let mut frames = Vec::new();
    while let Some((length, after)) = rest.split_first_chunk() {
        let (frame, after) = after.split_at(u32::from_le_bytes(*length) as usize);
        frames.push(frame.to_vec());
        rest = after;
    }
    frames
}

/// The parts of a reply that do not depend on the processor, the version or the clock: the kind of
/// result; a refusal without its message; the outcomes of shapes; the number of arrays.
fn gist(frames: &[Vec<u8>]) -> String {
    let reply = Reply::decode(frames[0].as_slice()).unwrap();
    let name = |result: &reply::Result| {
        let text = format!("{result:?}");
        text.split('(').next().unwrap().to_owned()
    };
    let refusal = |e: &coseg::ipc::wire::Error| {
        let place = e.subject.as_ref().map(|s| match s {
            Subject::JobId(_) => "a job".to_owned(),
            other => format!("{other:?}"),
        });
        let (code, reason) = (e.code().as_str_name(), e.reason().as_str_name());
        format!("{code}/{reason} at {place:?}, {} ms", e.retry_after_ms)
    };
    let result = reply.result.unwrap();
    let what = match &result {
        reply::Result::Error(e) => refusal(e),
        reply::Result::AddShapes(r) => {
            let job = r.job.clone().unwrap_or_default();
            let over = job.items.iter().map(|i| match (&i.placed, &i.error) {
                (Some(p), _) => p.outcome().as_str_name().to_owned(),
                (_, Some(e)) => refusal(e),
                _ => i.state().as_str_name().to_owned(),
            });
            over.collect::<Vec<_>>().join(", ")
        }
        _ => String::new(),
    };
    let n_arrays = frames.len() - 1;
    format!(
        "{} {} {what} {n_arrays} arrays",
        reply.request_id,
        name(&result)
    )
}

#[test]
fn recorded_conversations_are_answered_alike() {
    let text = std::fs::read_to_string(folder().join("index.json")).unwrap();
    let index: Vec<Value> = serde_json::from_str(&text).unwrap();
    assert!(index.len() >= 40, "only {} conversations", index.len());
    let settings: [(&str, &[(&str, &str)]); 5] = [
        ("plain", &[]),
        (
            "small",
            &[
                ("COSEG__LIMITS__MAX_QUEUED_SHAPES", "1"),
                ("COSEG__LIMITS__MAX_SHAPE", "2KiB"),
                ("COSEG__LIMITS__MAX_SHAPES_PER_REQUEST", "2"),
            ],
        ),
        ("tcp", &[]),
        ("asking", &[]),
        ("linking", &[]),
    ];
    let mut n_held = 0;
    let mut faults = Vec::new();
    for (daemon, env) in settings {
        let home = Home::new();
        let mut args = Vec::new();
        if daemon == "tcp" {
            args = vec!["--endpoint", "tcp://127.0.0.1:*"];
        }
        let mut running = home.start_with(&args, env);
        let mut endpoint = running.endpoint.clone();
        if daemon == "tcp" {
            let line = running.await_line("endpoint=");
            let after = line.split("endpoint=").nth(1).unwrap();
            endpoint = after.split_whitespace().next().unwrap().to_owned();
        }
        let socket = zmq::Context::new().socket(zmq::DEALER).unwrap();
        socket.set_linger(0).unwrap();
        socket.set_rcvtimeo(60_000).unwrap();
        socket.connect(&endpoint).unwrap();
        for entry in index.iter().filter(|e| e["daemon"] == daemon) {
            let name = entry["name"].as_str().unwrap();
            socket.send_multipart(frames(name, "request"), 0).unwrap();
            let (then, now) = (
                gist(&frames(name, "reply")),
                gist(&socket.recv_multipart(0).unwrap()),
            );
            if then != now {
                faults.push(format!("{name}: recorded {then}\n    now {now}"));
            }
            n_held += 1;
        }
    }
    assert!(n_held >= 40, "only {n_held} conversations were held");
    assert!(faults.is_empty(), "\n{}", faults.join("\n"));
}

/// The recorded headers equal those that this program sends, byte for byte.
#[test]
fn recorded_requests_are_encoded_alike() {
    let text = std::fs::read_to_string(folder().join("index.json")).unwrap();
    let index: Vec<Value> = serde_json::from_str(&text).unwrap();
    let mut n_known = 0;
    for entry in index.iter().filter(|e| e["request"].is_object()) {
        let name = entry["name"].as_str().unwrap();
        let header = &frames(name, "request")[0];
        let request = Request::decode(header.as_slice()).unwrap();
        assert!(request.body.is_some(), "{name} has no body");
        assert_eq!(&request.encode_to_vec(), header, "{name}");
        n_known += 1;
    }
    assert!(n_known >= 40);
}
