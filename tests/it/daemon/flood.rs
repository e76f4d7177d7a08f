//! Tests clients that exhaust shared resources: they never read, never finish a message, subscribe
//! without end, or connect without end. The daemon's memory stays bounded, and other clients are
//! served meanwhile.

use crate::harness::{Daemon, Home, add, skittle};
use coseg::call;
use coseg::ipc::client::{Client, ClientError};
use coseg::ipc::wire::{self, Request, request::Body};
use prost::Message as _;
use std::collections::VecDeque;
use std::io::{Read as _, Write as _};
use std::os::unix::net::UnixStream;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// The least value of `limits.memory`; the daemon must not grow beyond it plus a quarter.
const LIMIT: u64 = 256 << 20;
const SMALL: [(&str, &str); 2] = [
    ("COSEG__LIMITS__MEMORY", "256MiB"),
    ("COSEG__LIMITS__MAX_MESSAGE", "16MiB"),
];
/// A time limit that suffices on a machine that is busy with other tests.
const PATIENCE: Duration = Duration::from_secs(60);

/// A connection with a hand-written implementation of ZeroMQ's protocol.
struct Hand(UnixStream);

impl Hand {
    fn new(path: &str, socket_type: &str) -> Self {
        let mut hand = Self::greeting(path);
        let mut ready = b"\x05READY\x0bSocket-Type".to_vec();
        ready.extend((socket_type.len() as u32).to_be_bytes());
        ready.extend(socket_type.as_bytes());
        hand.send(4, &ready).unwrap();
        // Its greeting, and the beginning of its own READY.
        hand.0.read_exact(&mut [0; 66]).unwrap();
        hand
    }

    fn greeting(path: &str) -> Self {
        let mut stream = UnixStream::connect(path).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream.set_write_timeout(Some(PATIENCE)).unwrap();
        let mut greeting = vec![0xFF, 0, 0, 0, 0, 0, 0, 0, 0, 0x7F, 3, 0];
        greeting.extend(b"NULL");
        greeting.resize(64, 0);
        stream.write_all(&greeting).unwrap();
        Self(stream)
    }

    /// Sends a frame with these flags: 1 for more frames to come, 4 for a command.
    fn send(&mut self, flags: u8, body: &[u8]) -> std::io::Result<()> {
        let mut frame = vec![flags | 2];
        frame.extend((body.len() as u64).to_be_bytes());
        self.0.write_all(&frame)?;
        self.0.write_all(body)
    }

    /// Whether the daemon ends the connection.
    fn ends(&mut self) -> bool {
        let mut rest = [0; 1 << 16];
        loop {
            match self.0.read(&mut rest) {
                Ok(0) => return true,
                Ok(_) => {}
                Err(e) => return e.kind() == std::io::ErrorKind::ConnectionReset,
            }
        }
    }
}

fn peak(daemon: &Daemon) -> u64 {
    let path = format!("/proc/{}/status", daemon.child.id());
    let status = std::fs::read_to_string(path).unwrap();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    let kilobytes = line.unwrap().trim().trim_end_matches(" kB");
    kilobytes.parse::<u64>().unwrap() << 10
}

/// The daemon's counters. A busy daemon refuses for a moment, which a good client accepts.
fn stats(client: &mut Client) -> wire::StatsReply {
    let begin = Instant::now();
    loop {
        match call!(client, Stats(wire::StatsRequest {})) {
            Ok(stats) => return stats,
            Err(ClientError::Refused(e)) if e.retry_after_ms > 0 && begin.elapsed() < PATIENCE => {
                std::thread::sleep(Duration::from_millis(e.retry_after_ms));
            }
            Err(e) => panic!("{e}"),
        }
    }
}

/// The 99th percentile of the response times for a well-behaved client while `work` runs.
fn beside<T>(daemon: &Daemon, work: impl FnOnce() -> T) -> (Duration, T) {
    let over = AtomicBool::new(false);
    let mut client = daemon.client();
    stats(&mut client);
    std::thread::scope(|scope| {
        let over = &over;
        let good = scope.spawn(move || {
            let mut times = Vec::new();
            while !over.load(Ordering::Relaxed) || times.len() < 200 {
                let begin = Instant::now();
                let request = wire::GetShapeRequest {
                    collection: "c".to_owned(),
                    shape: "a".to_owned(),
                };
                call!(client, GetShape(request)).unwrap();
                times.push(begin.elapsed());
            }
            times.sort();
            times[times.len() * 99 / 100]
        });
        let done = std::panic::catch_unwind(std::panic::AssertUnwindSafe(work));
        over.store(true, Ordering::Relaxed);
        let p99 = good.join().unwrap();
        (p99, done.unwrap())
    })
}

/// Requests far more data than fits into memory, and reads nothing.
fn read_nothing(path: &str) -> Vec<Hand> {
    let asking = |_| {
        let mut hand = Hand::new(path, "DEALER");
        for i in 0..24 {
            let original = wire::GetOriginalRequest {
                collection: "c".to_owned(),
                shape: "large".to_owned(),
            };
            let request = Request {
                request_id: format!("{i}"),
                body: Some(Body::GetOriginal(original)),
                ..Default::default()
            };
            if hand.send(0, &request.encode_to_vec()).is_err() {
                break;
            }
        }
        hand
    };
    (0..12).map(asking).collect()
}

/// Sends messages that do not end.
fn finish_nothing(path: &str) {
    let mut several: Vec<Hand> = (0..4).map(|_| Hand::new(path, "DEALER")).collect();
    let piece = vec![7; 4 << 20];
    // The clients send in turn, so that all have equally much in flight; together far more than the
    // limit.
    for _ in 0..40 {
        several.retain_mut(|hand| hand.send(1, &piece).is_ok());
    }
    // Each message is within the limit of a single client.
    assert!(several.len() < 4, "none was ended");
    let mut one = Hand::new(path, "DEALER");
    let sent = (0..100).take_while(|_| one.send(1, &piece).is_ok()).count();
    assert!(sent < 100, "one alone has no end");
    let mut crumbs = Hand::new(path, "DEALER");
    let all = [1, 0].repeat(1 << 20);
    assert!(
        crumbs.0.write_all(&all).is_err() || crumbs.ends(),
        "a million frames"
    );
    let mut vain = Hand::greeting(path);
    let mut ready = b"\x05READY\x0bSocket-Type\0\0\0\x06DEALER\x01X\0\x10\0\0".to_vec();
    ready.resize(ready.len() + (1 << 20), b'x');
    assert!(
        vain.send(4, &ready).is_err() || vain.ends(),
        "a megabyte about itself"
    );
    let mut large = Hand::greeting(path);
    let mut ready = b"\x05READY\x0bSocket-Type\0\0\0\x06DEALER\x08Identity\0\0\x03\xe8".to_vec();
    ready.resize(ready.len() + 1_000, b'x');
    assert!(
        large.send(4, &ready).is_err() || large.ends(),
        "a name of 1,000 bytes"
    );
}

/// Subscribes endlessly to collections that do not exist.
fn subscribe_to_all(path: &str) -> Vec<Hand> {
    let path = format!("{path}.events");
    let subscribing = |n: u32| {
        let mut hand = Hand::new(&path, "SUB");
        let topic = |i: u32| {
            let mut topic = vec![1];
            topic.extend(n.to_be_bytes());
            topic.extend(i.wrapping_mul(0x9E37_79B9).to_be_bytes());
            topic.resize(1_000, i as u8);
            topic
        };
        let ended = (0..4_000).any(|i| hand.send(0, &topic(i)).is_err());
        assert!(ended || hand.ends(), "4,000 subscriptions");
        // This connection may stay.
        let mut hand = Hand::new(&path, "SUB");
        hand.send(0, &topic(0)[..20]).unwrap();
        hand
    };
    (0..16).map(subscribing).collect()
}

#[test]
fn memory_is_bounded_whatever_clients_do_not_do() {
    let home = Home::new();
    let mut daemon = home.start_with(&[], &SMALL);
    let path = home.endpoint().strip_prefix("ipc://").unwrap().to_owned();
    let mut client = daemon.client();
    let mesh = skittle(0);
    // Its comment is stored and sent, and does not compress.
    let mut state = 1_u64;
    let noise = (0..4 << 20).map(|_| {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1);
        char::from(b'!' + (state >> 33) as u8 % 90)
    });
    let large = mesh.replacen('\n', &format!("\n#{}\n", noise.collect::<String>()), 1);
    let job = add(&mut client, "c", &[("a", &mesh), ("large", &large)]);
    assert!(job.items.iter().all(|i| i.error.is_none()), "{job:?}");
    let (alone, ()) = beside(&daemon, || ());
    let allowed = (2 * alone).max(Duration::from_millis(100));
    let check = |what: &str, p99: Duration, daemon: &Daemon| {
        let peak = peak(daemon);
        println!(
            "{what}: at most {} MB resident, p99 {p99:?}, {alone:?} alone",
            peak >> 20
        );
        assert!(peak < LIMIT + LIMIT / 4, "{what}: {peak}");
        assert!(p99 <= allowed, "{what}: {p99:?}, alone {alone:?}");
    };

    let mut watching = daemon.client();
    let (p99, silent) = beside(&daemon, || {
        let silent = read_nothing(&path);
        // Their memory is reported.
        let begin = Instant::now();
        while stats(&mut watching).memory_reserved_bytes < 16 << 20 {
            assert!(begin.elapsed() < PATIENCE, "nothing is reserved");
        }
        silent
    });
    check("reading nothing", p99, &daemon);
    daemon.await_line("connections were ended");
    drop(silent);
    let (p99, ()) = beside(&daemon, || finish_nothing(&path));
    check("finishing nothing", p99, &daemon);
    let (p99, subscribed) = beside(&daemon, || subscribe_to_all(&path));
    check("subscribing to all", p99, &daemon);
    // Later clients are served as before.
    let heard = watching.subscribe(None).unwrap();
    heard.set_rcvtimeo(PATIENCE.as_millis() as i32).unwrap();
    heard.recv_msg(0).unwrap();
    drop(subscribed);

    let (p99, held) = beside(&daemon, || {
        std::thread::scope(|scope| {
            let silent = scope.spawn(|| read_nothing(&path));
            scope.spawn(|| finish_nothing(&path));
            let subscribed = subscribe_to_all(&path);
            (silent.join().unwrap(), subscribed)
        })
    });
    check("all together", p99, &daemon);
    drop(held);
    let begin = Instant::now();
    // The memory of this request itself is excepted.
    while stats(&mut client).memory_reserved_bytes > 1 << 20 {
        assert!(begin.elapsed() < PATIENCE, "memory stays reserved");
    }
}

#[test]
fn a_slow_reader_gets_all_that_it_asked_for() {
    let home = Home::new();
    let daemon = home.start_with(&[], &SMALL);
    let mut client = daemon.client();
    let large = skittle(0).replacen('\n', &format!("\n#{}\n", "x".repeat(5 << 20)), 1);
    add(&mut client, "c", &[("large", &large)]);
    let socket = super::raw(zmq::DEALER, &home.endpoint());
    let n = 24;
    for i in 0..n {
        let original = wire::GetOriginalRequest {
            collection: "c".to_owned(),
            shape: "large".to_owned(),
        };
        let request = Request {
            request_id: format!("{i}"),
            body: Some(Body::GetOriginal(original)),
            ..Default::default()
        };
        socket.send(request.encode_to_vec(), 0).unwrap();
    }
    // The reply exceeds the share of a client and that of all replies, so it is sent as the client
    // reads.
    for _ in 0..n {
        let reply = socket.recv_multipart(0).unwrap();
        assert_eq!(
            reply.get(1).map(Vec::len),
            Some(large.len()),
            "{:?}",
            wire::Reply::decode(&reply[0][..])
        );
    }
}

#[test]
fn ten_thousand_connections_leave_a_good_client_served() {
    for tcp in [false, true] {
        let home = Home::new();
        let endpoint = if tcp {
            "tcp://127.0.0.1:*".to_owned()
        } else {
            home.endpoint()
        };
        let mut daemon = home.start_limited(512, &["--endpoint", &endpoint]);
        let line = daemon.await_line("serving");
        let bound = line.split("endpoint=").nth(1).unwrap();
        daemon.endpoint = bound.split(' ').next().unwrap().to_owned();
        let endpoint = daemon.endpoint.clone();
        let mut client = daemon.client();
        add(&mut client, "c", &[("a", &skittle(0))]);
        let (alone, ()) = beside(&daemon, || ());
        // More simultaneous connections than the daemon may open files.
        let (p99, crowd) = beside(&daemon, || {
            let mut crowd = VecDeque::new();
            for n in 0..10_000 {
                let connected: Option<Box<dyn std::any::Any>> = if tcp {
                    let address = endpoint.strip_prefix("tcp://").unwrap();
                    std::net::TcpStream::connect(address)
                        .ok()
                        .map(|s| Box::new(s) as _)
                } else {
                    let path = endpoint.strip_prefix("ipc://").unwrap();
                    UnixStream::connect(path).ok().map(|s| Box::new(s) as _)
                };
                crowd.extend(connected);
                if crowd.len() > 700 {
                    crowd.pop_front();
                }
                assert!(n > 0 || !crowd.is_empty(), "nobody is let in");
            }
            crowd
        });
        println!("{endpoint}: p99 {p99:?} beside 10,000 connections, {alone:?} alone");
        let allowed = (2 * alone).max(Duration::from_millis(100));
        assert!(p99 <= allowed, "{p99:?}, alone {alone:?}");
        assert!(crowd.len() > 300, "{}", crowd.len());
        // Beside the connections that remain, workers get their files, and new clients can connect.
        add(&mut client, "c", &[("b", &skittle(1))]);
        stats(&mut daemon.client());
        drop(crowd);
    }
}
