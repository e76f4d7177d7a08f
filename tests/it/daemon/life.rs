//! Tests that the daemon starts, stops, is killed and recovers.

use super::{events_since, wait_idle};
use crate::harness::{DEADLINE, Daemon, Home, add_request, exists, refusal, skittle};
use coseg::call;
use coseg::ipc::client::Client;
use coseg::ipc::wire::{self, ErrorCode, ErrorReason, ItemState, event::Kind, reply, request};
use rustix::process::Signal;

#[test]
fn term_drains_and_exits_0() {
    let home = Home::new();
    let mut daemon = home.start();
    daemon.client().hello().unwrap();
    daemon.signal(Signal::TERM);
    daemon.await_notice("STOPPING=1");
    let (status, printed) = daemon.ended();
    assert_eq!(status.code(), Some(0), "{printed:?}");
    assert!(!exists(home.path("s")), "the socket file is gone");
    assert!(printed.iter().any(|l| l.contains("drained")), "{printed:?}");
}

#[test]
fn what_term_leaves_is_taken_up_at_the_next_start() {
    let home = Home::new();
    let texts: Vec<_> = (0..10).map(|i| (format!("s{i}"), skittle(i))).collect();
    let shapes: Vec<_> = texts
        .iter()
        .map(|(n, t)| (n.as_str(), t.as_str()))
        .collect();
    let daemon = home.start();
    let (body, frames) = add_request("c", &shapes, wire::AddMode::Job);
    daemon.client().call(body, frames).unwrap();
    daemon.signal(Signal::TERM);
    let (status, printed) = daemon.ended();
    assert_eq!(status.code(), Some(0), "{printed:?}");
    let daemon = home.start();
    let client = &mut daemon.client();
    wait_idle(client, "c");
    let request = wire::ListShapesRequest {
        collection: "c".to_owned(),
        ..Default::default()
    };
    let names: Vec<_> = call!(client, ListShapes(request)).unwrap().shapes;
    let names: Vec<_> = names.iter().map(|s| s.name.as_str()).collect();
    assert_eq!(names, shapes.iter().map(|(n, _)| *n).collect::<Vec<_>>());
}

#[test]
fn a_second_term_exits_at_once() {
    let home = Home::new();
    let mut daemon = home.start();
    // The daemon blocks when it reports the stop to the service manager, because nothing reads.
    daemon.notify.set_nonblocking(true).unwrap();
    let filler = std::os::unix::net::UnixDatagram::unbound().unwrap();
    filler.set_nonblocking(true).unwrap();
    while filler.send_to(b"x", home.path("notify")).is_ok() {}
    daemon.signal(Signal::TERM);
    daemon.await_line("draining");
    daemon.signal(Signal::TERM);
    let (status, _) = daemon.ended();
    assert_eq!(status.code(), Some(143));
}

#[test]
fn hup_reloads_limits_and_keeps_a_configuration_that_is_wrong_out() {
    let home = Home::new();
    let file = home.mesh("coseg.toml", "[limits]\nmax_shapes_per_request = 3\n");
    let mut daemon = home.start_with(&["--config", &file], &[]);
    let limit = |daemon: &Daemon| {
        daemon
            .client()
            .hello()
            .unwrap()
            .limits
            .unwrap()
            .max_shapes_per_request
    };
    assert_eq!(limit(&daemon), 3);
    home.mesh(
        "coseg.toml",
        "[limits]\nmax_shapes_per_request = 5\nmax_requests = 7\n",
    );
    daemon.signal(Signal::HUP);
    let notice = daemon.await_notice("RELOADING=1");
    assert!(notice.contains("MONOTONIC_USEC="), "{notice}");
    daemon.await_notice("READY=1");
    assert_eq!(limit(&daemon), 5);
    assert!(
        daemon
            .await_line("reloaded")
            .contains("limits.max_requests")
    );
    home.mesh("coseg.toml", "[limits]\nmax_shape_per_request = 9\n");
    daemon.signal(Signal::HUP);
    daemon.await_notice("RELOADING=1");
    daemon.await_notice("READY=1");
    assert!(
        daemon
            .await_line("stays as it was")
            .contains("limits.max_shapes_per_request")
    );
    assert_eq!(limit(&daemon), 5);
}

#[test]
fn the_watchdog_is_fed() {
    let home = Home::new();
    let mut daemon = home.start_with(&[], &[("WATCHDOG_USEC", "900000")]);
    for _ in 0..3 {
        daemon.await_notice("WATCHDOG=1");
    }
}

#[test]
fn a_second_daemon_is_refused_and_a_dead_ones_socket_replaced() {
    let home = Home::new();
    let daemon = home.start();
    let (status, printed) = home.spawn(&[], &[]).ended();
    assert_eq!(status.code(), Some(1));
    assert!(
        printed
            .iter()
            .any(|l| l.contains("/s is in use by a running daemon, process ")),
        "{printed:?}"
    );
    daemon.client().hello().unwrap();
    daemon.signal(Signal::KILL);
    drop(daemon.ended());
    assert!(
        exists(home.path("s")),
        "the dead daemon's socket file is there"
    );
    home.start().client().hello().unwrap();
}

#[test]
fn endpoints_that_others_could_reach_are_refused() {
    let home = Home::new();
    let long = format!("ipc:///tmp/{}", "x".repeat(120));
    for (endpoint, message) in [
        ("tcp://0.0.0.0:0", "is not loopback"),
        (
            "udp://127.0.0.1:7",
            "is neither ipc://PATH nor tcp://HOST:PORT",
        ),
        ("inproc://x", "is neither ipc://PATH nor tcp://HOST:PORT"),
        (&long, "its socket path has 125 bytes, the limit is 100"),
    ] {
        let (status, printed) = home.spawn(&["--endpoint", endpoint], &[]).ended();
        assert_eq!(status.code(), Some(2), "{endpoint}: {printed:?}");
        assert!(
            printed.iter().any(|l| l.contains(message)),
            "{endpoint}: {printed:?}"
        );
    }
}

#[test]
fn tcp_on_loopback_serves_but_does_not_let_clients_stop_it() {
    let home = Home::new();
    let mut daemon = home.start_with(&["--endpoint", "tcp://127.0.0.1:*"], &[]);
    let line = daemon.await_line("serving");
    let endpoint = line
        .split("endpoint=")
        .nth(1)
        .unwrap()
        .split(' ')
        .next()
        .unwrap();
    let client = &mut Client::connect(endpoint, DEADLINE).unwrap();
    let events = client.hello().unwrap().event_endpoint.clone();
    assert!(
        events.starts_with("tcp://127.0.0.1:") && events != endpoint,
        "{events}"
    );
    client.subscribe(None).unwrap().recv_msg(0).unwrap();
    let drain = request::Body::Drain(wire::DrainRequest {});
    let expected = (ErrorCode::PermissionDenied, ErrorReason::AdminIpcOnly);
    assert_eq!(refusal(client, drain), expected);
}

#[test]
fn a_client_can_drain_over_ipc() {
    let home = Home::new();
    let daemon = home.start();
    call!(daemon.client(), Drain(wire::DrainRequest {})).unwrap();
    let (status, printed) = daemon.ended();
    assert_eq!(status.code(), Some(0), "{printed:?}");
}

#[test]
fn kill_9_loses_nothing_that_was_accepted() {
    let home = Home::new();
    let texts: Vec<_> = (0..8).map(|i| (format!("s{i}"), skittle(i))).collect();
    let shapes: Vec<_> = texts
        .iter()
        .map(|(n, t)| (n.as_str(), t.as_str()))
        .collect();
    let daemon = home.start();
    let client = &mut daemon.client();
    let (body, frames) = add_request("c", &shapes, wire::AddMode::Job);
    let reply::Result::AddShapes(accepted) = client.call(body, frames).unwrap().0 else {
        panic!("not accepted")
    };
    let job_id = accepted.job_id;
    // The kill comes in the middle: as soon as one shape is placed.
    let mut revision = 0;
    loop {
        let request = wire::WatchJobRequest {
            job_id,
            revision,
            wait_ms: 1_000,
        };
        let job = call!(client, WatchJob(request)).unwrap().job.unwrap();
        revision = job.revision;
        if job.items[0].state() == ItemState::Done {
            break;
        }
    }
    daemon.signal(Signal::KILL);
    drop(daemon.ended());
    let daemon = home.start();
    let client = &mut daemon.client();
    wait_idle(client, "c");
    let job = call!(client, GetJob(wire::GetJobRequest { job_id }))
        .unwrap()
        .job
        .unwrap();
    assert!(
        job.items.iter().all(|i| i.state() == ItemState::Done),
        "{job:?}"
    );
    let events = events_since(client, "c");
    let added: Vec<_> = events
        .iter()
        .filter_map(|e| match &e.kind {
            Some(Kind::ShapeAdded(a)) => Some(a.shape.as_str()),
            _ => None,
        })
        .collect();
    let expected: Vec<_> = shapes.iter().map(|(n, _)| *n).collect();
    assert_eq!(added, expected, "in order of acceptance, each once");
}
