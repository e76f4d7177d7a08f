//! Tests a subscriber that is stopped during a rapid stream of events, and others that join and
//! leave.
//!
//! `COSEG_TEST_EVENTS` makes the test longer.

use crate::harness::{Home, add, number, skittle};
use coseg::call;
use coseg::ipc::client::Client;
use coseg::ipc::wire::{self, request::Body};
use rustix::process::{Pid, Signal, kill_process};
use std::io::{BufRead as _, BufReader};
use std::process::Stdio;
use std::time::{Duration, Instant};

fn p99(mut times: Vec<Duration>) -> Duration {
    times.sort();
    times[times.len() * 99 / 100]
}

fn hello(client: &mut Client) -> Duration {
    let begin = Instant::now();
    client
        .call(Body::Hello(wire::HelloRequest {}), Vec::new())
        .unwrap();
    begin.elapsed()
}

#[test]
fn a_stopped_subscriber_harms_nobody_and_misses_nothing() {
    let n_events = number("COSEG_TEST_EVENTS", 600);
    let home = Home::new();
    let daemon = home.start();
    let client = &mut daemon.client();
    add(client, "c", &[("a", &skittle(0)), ("b", &skittle(1))]);
    super::wait_idle(client, "c");
    let events = super::events_since(client, "c");
    let first = events.last().unwrap().sequence;
    let mut watcher = crate::harness::coseg()
        .args(["watch", "--collection", "c", "--json", "--timeout", "600"])
        .args(["--endpoint", &home.endpoint(), "--since", "0"])
        .args(["--limit", &(first + n_events).to_string()])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let lines = BufReader::new(watcher.stdout.take().unwrap()).lines();
    let (sender, heard) = std::sync::mpsc::channel();
    std::thread::spawn(move || {
        for line in lines.map_while(Result::ok) {
            let event: serde_json::Value = serde_json::from_str(&line).unwrap();
            if sender.send(event["sequence"].as_u64().unwrap()).is_err() {
                return;
            }
        }
    });
    // It receives the past events, and is stopped.
    let next = || heard.recv_timeout(Duration::from_secs(60)).unwrap();
    for sequence in 1..=first {
        assert_eq!(next(), sequence);
    }
    let pid = Pid::from_child(&watcher);
    let mut name_next = |n: u64| {
        let request = wire::NameLabelRequest {
            collection: "c".to_owned(),
            label: 0,
            name: format!("name {n}"),
        };
        call!(client, NameLabel(request)).unwrap();
    };
    let mut other = daemon.client();
    let resident = |client: &mut Client| {
        let stats = call!(client, Stats(wire::StatsRequest {})).unwrap();
        stats.resident_bytes
    };
    let (mut alone, mut beside) = (Vec::new(), Vec::new());
    let before = resident(&mut other);
    for n in 0..n_events {
        if n == n_events / 3 {
            kill_process(pid, Signal::STOP).unwrap();
        }
        name_next(n);
        let times = if n < n_events / 3 {
            &mut alone
        } else {
            &mut beside
        };
        times.push(hello(&mut other));
        // A hundred others join and leave.
        if n % (n_events / 100).max(1) == 0 {
            drop(daemon.client().subscribe(None).unwrap());
        }
    }
    let grown = resident(&mut other).saturating_sub(before);
    let (alone, beside) = (p99(alone), p99(beside));
    println!(
        "{n_events} events; p99 of hello {alone:?} before, {beside:?} beside the stopped one; {} \
         MB more resident",
        grown >> 20
    );
    assert!(grown < 64 << 20, "{grown}");
    // A machine that is busy with other tests has delays of its own.
    assert!(
        beside <= (alone * 12 / 10).max(Duration::from_millis(200)),
        "{alone:?} {beside:?}"
    );
    kill_process(pid, Signal::CONT).unwrap();
    for sequence in first + 1..=first + n_events {
        assert_eq!(next(), sequence, "each once and in order");
    }
    assert!(watcher.wait().unwrap().success());
}
