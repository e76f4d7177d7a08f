//! Tests repeated requests, and a subscriber that loses its connection and its daemon, and stalls.

use super::{events_since, wait_idle};
use crate::harness::{Daemon, Home, add_request, number, seed, skittle};
use coseg::call;
use coseg::ipc::client::Client;
use coseg::ipc::wire::{self, event::Kind, reply, request::Body};
use prost::Message as _;
use rand::{Rng as _, SeedableRng as _};
use rustix::process::Signal;
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

/// `COSEG_TEST_ROUNDS` makes the test longer.
#[test]
fn each_request_has_one_effect_however_often_it_is_sent() {
    let (n_rounds, seed) = (number("COSEG_TEST_ROUNDS", 1), seed());
    println!("{n_rounds} rounds, COSEG_TEST_SEED={seed}");
    for round in 0..n_rounds {
        send_each_again_and_again(seed + round);
    }
}

fn send_each_again_and_again(seed: u64) {
    let mut random = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
    let home = Home::new();
    let mut daemon = home.start();
    let c = || "c".to_owned();
    let add = |name: &str, variant| {
        let (body, frames) = add_request("c", &[(name, &skittle(variant))], wire::AddMode::Wait);
        (body, frames)
    };
    let remove = Body::RemoveShape(wire::RemoveShapeRequest {
        collection: c(),
        shape: "b".to_owned(),
    });
    let part = wire::LabelledPart { part: 0, label: 7 };
    let correct = Body::CorrectLabels(wire::CorrectLabelsRequest {
        collection: c(),
        shape: "a".to_owned(),
        correction: Some(wire::correct_labels_request::Correction::Part(part)),
        by: String::new(),
        closed: None,
    });
    let name = Body::NameLabel(wire::NameLabelRequest {
        collection: c(),
        label: 7,
        name: "leg".to_owned(),
    });
    let split = Body::SplitLabel(wire::SplitLabelRequest {
        collection: c(),
        label: 1,
    });
    let merge = Body::MergeLabels(wire::MergeLabelsRequest {
        collection: c(),
        label: 7,
        into: 1,
    });
    let undo = Body::Undo(wire::UndoRequest { collection: c() });
    let up = |up: wire::Up| {
        let (collection, up) = (c(), up.into());
        Body::UpdateCollection(wire::UpdateCollectionRequest { collection, up })
    };
    let requests = [
        add("a", 0),
        add("b", 1),
        add("x", 2),
        (up(wire::Up::PlusZ), vec![]),
        (remove, vec![]),
        (split, vec![]),
        (correct, vec![]),
        (name, vec![]),
        (merge, vec![]),
        (undo, vec![]),
        (up(wire::Up::Auto), vec![]),
    ];
    let connect = |daemon: &Daemon| {
        let mut client = daemon.client();
        client.set_client_id("the one");
        client
    };
    let mut client = connect(&daemon);
    let mut replies: Vec<reply::Result> = Vec::new();
    for (i, (body, frames)) in requests.iter().enumerate() {
        let send = |client: &mut Client, i: usize| {
            let (body, frames): &(Body, Vec<bytes::Bytes>) = &requests[i];
            client
                .call_as(&format!("request {i}"), body.clone(), frames.clone())
                .unwrap()
                .0
        };
        let first = client
            .call_as(&format!("request {i}"), body.clone(), frames.clone())
            .unwrap()
            .0;
        wait_idle(&mut client, "c");
        replies.push(first);
        let events = events_since(&mut client, "c");
        if [2, 3, 5, 8].contains(&i) {
            daemon.signal(Signal::KILL);
            drop(daemon.ended());
            daemon = home.start();
            client = connect(&daemon);
        }
        // This request, and earlier ones in any order.
        for _ in 0..random.random_range(1..5) {
            let again = random.random_range(0..=i);
            assert_eq!(
                send(&mut client, again),
                replies[again],
                "seed {seed}: {again} after {i}"
            );
        }
        assert_eq!(
            events_since(&mut client, "c"),
            events,
            "seed {seed}: no further event"
        );
    }
    let other = client.call_as("request 0", requests[1].0.clone(), requests[1].1.clone());
    assert!(other.is_err(), "the id of another request");
}

/// Maintains a copy of a collection as docs/protocol.md prescribes for clients.
struct Subscriber {
    socket: zmq::Socket,
    client: Client,
    sequence: u64,
    /// Shape and version of its labels.
    shapes: BTreeMap<String, u64>,
    n_gaps: u32,
}

impl Subscriber {
    fn new(daemon: &Daemon) -> Self {
        let mut client = daemon.client();
        let socket = client.subscribe(Some("c")).unwrap();
        let mut new = Self {
            socket,
            client,
            sequence: 0,
            shapes: BTreeMap::new(),
            n_gaps: 0,
        };
        new.snapshot();
        new
    }

    fn snapshot(&mut self) {
        let collection = "c".to_owned();
        let request = wire::LabelsSnapshotRequest { collection };
        let reply = call!(self.client, LabelsSnapshot(request)).unwrap();
        self.sequence = reply.sequence;
        self.shapes = reply
            .shapes
            .into_iter()
            .map(|s| (s.shape, s.version))
            .collect();
    }

    fn apply(&mut self, event: &wire::Event) {
        if event.sequence != self.sequence + 1 {
            return;
        }
        self.sequence = event.sequence;
        match event.kind.as_ref().unwrap() {
            Kind::ShapeAdded(e) => {
                self.shapes.insert(e.shape.clone(), e.version);
            }
            Kind::ShapeRemoved(e) => {
                self.shapes.remove(&e.shape);
            }
            Kind::LabelsChanged(e) => {
                self.shapes.insert(e.shape.clone(), e.version);
            }
            _ => {}
        }
    }

    /// Reads pending events, and requests missed ones.
    fn read(&mut self, wait: Duration) {
        let until = Instant::now() + wait;
        while let Some(left) = until.checked_duration_since(Instant::now()) {
            self.socket.set_rcvtimeo(left.as_millis() as i32).unwrap();
            let Ok(frames) = self.socket.recv_multipart(0) else {
                return;
            };
            let event = wire::Event::decode(frames[1].as_slice()).unwrap();
            let announced = match &event.kind {
                Some(Kind::Heartbeat(h)) => {
                    let mine = h.collections.iter().find(|c| c.collection == "c");
                    mine.map_or(0, |c| c.sequence)
                }
                _ => event.sequence,
            };
            self.apply(&event);
            if announced > self.sequence {
                self.n_gaps += 1;
                for event in super::events_after(&mut self.client, "c", self.sequence) {
                    self.apply(&event);
                }
            }
        }
    }
}

#[test]
fn a_subscriber_converges_after_losses_restarts_and_stalls() {
    let home = Home::new();
    let mut daemon = home.start();
    let feed = |daemon: &Daemon, range: std::ops::Range<u32>| {
        let texts: Vec<_> = range.map(|i| (format!("s{i}"), skittle(i % 9))).collect();
        let shapes: Vec<_> = texts
            .iter()
            .map(|(n, t)| (n.as_str(), t.as_str()))
            .collect();
        let (body, frames) = add_request("c", &shapes, wire::AddMode::Job);
        daemon.client().call(body, frames).unwrap();
    };
    super::create_with(&mut daemon.client(), "c", 2);
    let mut subscriber = Subscriber::new(&daemon);
    feed(&daemon, 0..4);
    subscriber.read(Duration::from_millis(300));
    // It loses its connection for a while, and returns with its state.
    subscriber.socket = zmq::Context::new().socket(zmq::SUB).unwrap();
    feed(&daemon, 4..8);
    wait_idle(&mut daemon.client(), "c");
    subscriber.socket = subscriber.client.subscribe(Some("c")).unwrap();
    subscriber.read(Duration::from_millis(1_500));
    // The daemon is killed in the middle of its work.
    feed(&daemon, 8..14);
    daemon.signal(Signal::KILL);
    drop(daemon.ended());
    daemon = home.start();
    // It stalls while shapes are added and removed, and other subscribers join and leave.
    let crowd: Vec<_> = (0..20)
        .map(|_| daemon.client().subscribe(None).unwrap())
        .collect();
    feed(&daemon, 14..18);
    wait_idle(&mut daemon.client(), "c");
    drop(crowd);
    for shape in ["s1", "s5", "s9"] {
        let (collection, shape) = ("c".to_owned(), shape.to_owned());
        let request = wire::RemoveShapeRequest { collection, shape };
        call!(daemon.client(), RemoveShape(request)).unwrap();
    }
    wait_idle(&mut daemon.client(), "c");
    let mut truth = Subscriber::new(&daemon);
    truth.snapshot();
    let begin = Instant::now();
    while subscriber.sequence < truth.sequence {
        assert!(
            begin.elapsed() < Duration::from_secs(60),
            "{} of {}",
            subscriber.sequence,
            truth.sequence
        );
        subscriber.read(Duration::from_millis(500));
    }
    assert_eq!(subscriber.shapes, truth.shapes);
    assert_eq!(subscriber.shapes.len(), 15);
    println!(
        "{} events, {} gaps closed",
        subscriber.sequence, subscriber.n_gaps
    );
    assert!(
        subscriber.n_gaps > 0,
        "nothing was lost: the test tests nothing"
    );
}
