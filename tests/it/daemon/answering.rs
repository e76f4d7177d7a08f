//! Tests that a computation or a change costs at most its request: the daemon continues, and
//! reports the reason.

use super::{create_with, raw};
use crate::harness::{Daemon, Home, add, skittle, wait_idle};
use coseg::call;
use coseg::daemon::POISON_VARIABLE;
use coseg::ipc::client::Client;
use coseg::ipc::wire::{
    self, ErrorCode, ErrorReason, Reply, correct_labels_request::Correction, event::Kind, reply,
    request::Body,
};
use prost::Message as _;
use std::time::{Duration, Instant};

fn poisoned(poison: &str) -> String {
    skittle(3).replacen("OFF\n", &format!("OFF # poison: {poison}\n"), 1)
}

fn c() -> String {
    "c".to_owned()
}

/// Sends a raw request and returns the reply.
fn ask(endpoint: &str, request: &wire::Request) -> Result<reply::Result, wire::Error> {
    let dealer = raw(zmq::DEALER, endpoint);
    dealer.send(request.encode_to_vec(), 0).unwrap();
    let reply = dealer.recv_multipart(0).unwrap();
    match Reply::decode(reply[0].as_slice()).unwrap().result.unwrap() {
        reply::Result::Error(e) => Err(e),
        result => Ok(result),
    }
}

fn request_of(body: Body, deadline_ms: u64) -> wire::Request {
    wire::Request {
        request_id: "asked".to_owned(),
        deadline_ms,
        body: Some(body),
        ..Default::default()
    }
}

/// A map of this size is not stored, since none was requested before.
fn map(from: &str, k: u32) -> Body {
    Body::GetFunctionalMap(wire::GetFunctionalMapRequest {
        collection: c(),
        from: from.to_owned(),
        to: "a".to_owned(),
        points: Some(wire::PointMapOptions {
            k,
            ..Default::default()
        }),
        ..Default::default()
    })
}

fn correction(shape: &str) -> Body {
    let part = wire::LabelledPart { part: 0, label: 7 };
    Body::CorrectLabels(wire::CorrectLabelsRequest {
        collection: c(),
        shape: shape.to_owned(),
        correction: Some(Correction::Part(part)),
        by: String::new(),
        closed: None,
    })
}

/// Running child processes of the daemon.
fn n_workers(daemon: &Daemon) -> usize {
    let parent = format!("PPid:\t{}", daemon.child.id());
    let status = |entry: std::fs::DirEntry| std::fs::read_to_string(entry.path().join("status"));
    let all = std::fs::read_dir("/proc").unwrap().flatten();
    all.filter_map(|entry| status(entry).ok())
        .filter(|status| status.lines().any(|line| line == parent))
        .count()
}

fn pid(client: &mut Client) -> u32 {
    call!(client, Stats(wire::StatsRequest {})).unwrap().pid
}

#[test]
fn what_poisons_an_answer_costs_that_request_alone() {
    let home = Home::new();
    let daemon = home.start();
    let client = &mut daemon.client();
    let kinds = ["abort", "panic", "alloc", "stack", "loop"];
    let poisons = kinds.map(|kind| format!("{kind}-answering"));
    let texts = poisons.each_ref().map(|poison| poisoned(poison));
    let mut shapes = vec![("a", skittle(0)), ("b", skittle(1))];
    shapes.extend(kinds.into_iter().zip(texts));
    let shapes: Vec<_> = shapes.iter().map(|(n, t)| (*n, t.as_str())).collect();
    let job = add(client, "c", &shapes);
    assert!(job.items.iter().all(|i| i.error.is_none()), "{job:?}");
    wait_idle(client, "c");
    // Nothing remains to be done in the background.
    super::proposals(client, "c");
    drop(daemon);
    // The limit is set only now, since describing takes long on a busy machine.
    let env = [(POISON_VARIABLE, "1"), ("COSEG__WORK__SHAPE_SECONDS", "8")];
    let daemon = home.start_with(&["--workers", "2"], &env);
    let client = &mut daemon.client();
    let events = super::events_since(client, "c").len();

    let requests = |kind: &str| {
        let kind = kind.to_owned();
        let portrait = wire::GetPortraitsRequest {
            collection: c(),
            shapes: vec!["a".to_owned(), kind.clone()],
            detail: wire::PortraitDetail::Surface.into(),
            proposal: 0,
        };
        let parts = wire::GetPartCorrespondenceRequest {
            collection: c(),
            shape_a: "b".to_owned(),
            shape_b: kind.clone(),
        };
        [
            map(&kind, 20),
            correction(&kind),
            Body::GetPortraits(portrait),
            Body::GetPartCorrespondence(parts),
        ]
    };
    for (kind, code, reason) in [
        ("abort", ErrorCode::Internal, ErrorReason::WorkerDied),
        ("stack", ErrorCode::Internal, ErrorReason::WorkerDied),
        ("panic", ErrorCode::Internal, ErrorReason::Panic),
        (
            "alloc",
            ErrorCode::ResourceExhausted,
            ErrorReason::ShapeMemory,
        ),
    ] {
        for body in requests(kind) {
            let what = format!("{kind}: {body:?}");
            let error = ask(&daemon.endpoint, &request_of(body, 0)).expect_err(&what);
            assert_eq!(
                (error.code(), error.reason()),
                (code, reason),
                "{what}: {error:?}"
            );
            assert!(
                error.message.contains("the work on this request"),
                "{what}: {error:?}"
            );
            assert_eq!(pid(client), daemon.child.id(), "{what}: the same process");
        }
    }
    // An endless computation ends at the limit; others are served meanwhile.
    let endpoint = daemon.endpoint.as_str();
    std::thread::scope(|scope| {
        let endless = [map("loop", 20), correction("loop")]
            .map(|body| scope.spawn(|| ask(endpoint, &request_of(body, 0))));
        let begin = Instant::now();
        while n_workers(&daemon) < 3 && begin.elapsed() < Duration::from_secs(5) {
            std::thread::sleep(Duration::from_millis(20));
        }
        ask(&daemon.endpoint, &request_of(map("b", 30), 0)).unwrap();
        assert!(!endless.iter().any(|e| e.is_finished()));
        for answer in endless {
            let error = answer.join().unwrap().unwrap_err();
            assert_eq!(error.reason(), ErrorReason::ShapeTimeout, "{error:?}");
            assert_eq!(error.code(), ErrorCode::DeadlineExceeded);
        }
    });
    // Requests of vanished clients no longer occupy a processor.
    let error = ask(&daemon.endpoint, &request_of(map("loop", 21), 300)).unwrap_err();
    assert_eq!(error.reason(), ErrorReason::Deadline, "{error:?}");
    let begin = Instant::now();
    // At most two workers each for describing, placing and answering.
    while is_busy(&daemon) {
        assert!(begin.elapsed() < Duration::from_secs(5), "it goes on");
        std::thread::sleep(Duration::from_millis(50));
    }
    // Nothing was changed, and all changes are possible.
    assert_eq!(super::events_since(client, "c").len(), events);
    assert_eq!(pid(client), daemon.child.id());
    ask(&daemon.endpoint, &request_of(correction("b"), 0)).unwrap();
    wait_idle(client, "c");
}

/// Whether a child process of the daemon is running.
fn is_busy(daemon: &Daemon) -> bool {
    let parent = daemon.child.id().to_string();
    let stat = |entry: std::fs::DirEntry| std::fs::read_to_string(entry.path().join("stat"));
    let all = std::fs::read_dir("/proc").unwrap().flatten();
    all.filter_map(|entry| stat(entry).ok()).any(|stat| {
        // The state and the parent follow the name in brackets.
        let rest = stat.rsplit(") ").next().unwrap_or_default();
        let mut words = rest.split(' ');
        words.next() == Some("R") && words.next() == Some(&parent)
    })
}

#[test]
fn a_change_that_outlasts_its_deadline_goes_on_and_is_told_to_who_asks_again() {
    let home = Home::new();
    let daemon = home.start_with(&[], &[(POISON_VARIABLE, "1")]);
    let client = &mut daemon.client();
    create_with(client, "c", 2);
    let slow = poisoned("slow-answering");
    add(client, "c", &[("a", &skittle(0)), ("slow", &slow)]);
    wait_idle(client, "c");
    let named = |deadline_ms: u64| wire::Request {
        client_id: "somebody".to_owned(),
        request_id: "once".to_owned(),
        ..request_of(correction("slow"), deadline_ms)
    };
    let begin = Instant::now();
    let late = ask(&daemon.endpoint, &named(400)).unwrap_err();
    let took = begin.elapsed();
    assert_eq!(late.reason(), ErrorReason::Deadline, "{late:?}");
    assert!(late.message.contains("the change goes on"), "{late:?}");
    assert!(late.message.contains("its request_id"), "{late:?}");
    // The request is answered while the change, which takes two seconds, is running.
    assert!(took < Duration::from_millis(1500), "{took:?}");
    println!("a deadline of 400 ms was answered after {took:?}");
    // A change that waits behind it has not begun when its deadline passes, and is not made later.
    let behind = ask(&daemon.endpoint, &request_of(correction("a"), 200)).unwrap_err();
    assert!(behind.message.contains("was not begun"), "{behind:?}");
    let Ok(reply::Result::CorrectLabels(done)) = ask(&daemon.endpoint, &named(0)) else {
        panic!("not told")
    };
    assert!(done.job_id > 0, "{done:?}");
    let Ok(reply::Result::CorrectLabels(again)) = ask(&daemon.endpoint, &named(0)) else {
        panic!("not told again")
    };
    assert_eq!(done, again);
    wait_idle(client, "c");
    let corrected = |client: &mut Client| {
        let events = super::events_since(client, "c");
        let is_correction = |e: &&wire::Event| matches!(e.kind, Some(Kind::Corrected(_)));
        events.iter().filter(is_correction).count()
    };
    assert_eq!(corrected(client), 1);
    // Without a request id it cannot be repeated, but it continues nevertheless.
    let unnamed = ask(&daemon.endpoint, &request_of(correction("slow"), 400)).unwrap_err();
    assert!(
        unnamed.message.ends_with("the change goes on"),
        "{unnamed:?}"
    );
    let begin = Instant::now();
    while corrected(client) < 2 {
        assert!(
            begin.elapsed() < Duration::from_secs(60),
            "it did not go on"
        );
        std::thread::sleep(Duration::from_millis(50));
    }
}
