//! Keys: who is on the list gets in, and may do what the role says; nobody else gets anywhere.

use super::create;
use crate::harness::{Daemon, Home, add, coseg, refusal, skittle};
use coseg::call;
use coseg::ipc::client::{Client, ClientError};
use coseg::ipc::keys::{ClientKeys, KeyPair, read_public};
use coseg::ipc::wire::{self, ErrorCode, ErrorReason, request::Body};
use std::io::Write as _;
use std::net::TcpStream;
use std::time::{Duration, Instant};

/// Long enough for a handshake on a busy machine, where one is to be refused.
const REFUSED: Duration = Duration::from_secs(2);
const SERVED: Duration = Duration::from_secs(60);

/// A daemon on every address of this machine, its folder of keys made by the commands.
fn secured(home: &Home) -> (Daemon, String) {
    let keys = home.path("keys").display().to_string();
    let keys_command = |args: &[&str]| {
        let out = coseg().args(["keys", "--dir", &keys]).args(args).output();
        let out = out.unwrap();
        assert!(
            out.status.success(),
            "{args:?}: {}",
            String::from_utf8_lossy(&out.stderr)
        );
        String::from_utf8(out.stdout).unwrap()
    };
    keys_command(&["generate", "--server"]);
    for (name, role) in [
        ("reader", "read-only"),
        ("feeder", "ingest"),
        ("boss", "admin"),
    ] {
        keys_command(&["generate", name, "--role", role]);
    }
    let listed = keys_command(&["list"]);
    assert_eq!(listed.lines().count(), 4, "{listed}");
    let mut daemon = home.start_with(&["--endpoint", "tcp://0.0.0.0:*", "--keys", &keys], &[]);
    let line = daemon.await_line("serving");
    let bound = line.split("endpoint=").nth(1).unwrap();
    let port = bound.split(' ').next().unwrap().rsplit(':').next().unwrap();
    (daemon, format!("tcp://127.0.0.1:{port}"))
}

fn keys(home: &Home, name: &str) -> ClientKeys {
    ClientKeys {
        server: read_public(&home.path("keys/server.pub")).unwrap(),
        own: KeyPair::read(&home.path(&format!("keys/{name}.key"))).unwrap(),
    }
}

fn is_unanswered(endpoint: &str, keys: Option<ClientKeys>) -> bool {
    let mut client = Client::connect_with(endpoint, REFUSED, keys).unwrap();
    matches!(client.hello(), Err(ClientError::NoAnswer { .. }))
}

#[test]
fn only_keys_on_the_list_get_in_and_roles_bound_what_they_do() {
    let home = Home::new();
    let (daemon, endpoint) = secured(&home);
    let connect =
        |name: &str| Client::connect_with(&endpoint, SERVED, Some(keys(&home, name))).unwrap();
    let (mut reader, mut feeder, mut boss) =
        (connect("reader"), connect("feeder"), connect("boss"));
    reader.hello().unwrap();

    assert!(is_unanswered(&endpoint, None), "a plain client");
    let unknown = ClientKeys {
        own: KeyPair::generate().unwrap(),
        ..keys(&home, "boss")
    };
    assert!(is_unanswered(&endpoint, Some(unknown)), "an unknown key");
    let other_server = ClientKeys {
        server: KeyPair::generate().unwrap().public().clone(),
        ..keys(&home, "boss")
    };
    assert!(
        is_unanswered(&endpoint, Some(other_server)),
        "another daemon's key"
    );

    create(&mut feeder, "c");
    add(&mut feeder, "d", &[("a", &skittle(0))]);
    let denied = (ErrorCode::PermissionDenied, ErrorReason::RoleTooLow);
    let spec = wire::CollectionSpec {
        name: "x".to_owned(),
        ..Default::default()
    };
    let creating = Body::CreateCollection(wire::CreateCollectionRequest { spec: Some(spec) });
    assert_eq!(refusal(&mut reader, creating), denied);
    let collection = "c".to_owned();
    let deleting = Body::DeleteCollection(wire::DeleteCollectionRequest { collection });
    assert_eq!(refusal(&mut feeder, deleting.clone()), denied);
    assert_eq!(
        refusal(&mut feeder, Body::Drain(wire::DrainRequest {})),
        denied
    );
    boss.call(deleting, Vec::new()).unwrap();
    let n = call!(reader, ListCollections(wire::ListCollectionsRequest {})).unwrap();
    assert_eq!(n.collections.len(), 1);

    // The command line takes the same files.
    let stats = coseg()
        .args(["stats", "--endpoint", &endpoint, "--timeout", "60"])
        .env("COSEG_SERVER_KEY", home.path("keys/server.pub"))
        .env("COSEG_CLIENT_KEY", home.path("keys/reader.key"))
        .output()
        .unwrap();
    assert!(stats.status.success(), "{stats:?}");

    // An administrator may end the daemon over TCP.
    boss.call(Body::Drain(wire::DrainRequest {}), Vec::new())
        .unwrap();
    assert_eq!(daemon.ended().0.code(), Some(0));
}

#[test]
fn a_revoked_key_is_refused_at_once_on_both_sockets() {
    let home = Home::new();
    let (_daemon, endpoint) = secured(&home);
    let connect =
        |name: &str| Client::connect_with(&endpoint, SERVED, Some(keys(&home, name))).unwrap();
    let (mut feeder, mut boss) = (connect("feeder"), connect("boss"));
    let next = |socket: &zmq::Socket, ms: i32| {
        socket.set_rcvtimeo(ms).unwrap();
        socket.recv_multipart(0).is_ok()
    };
    let (revoked, stays) = (
        feeder.subscribe(None).unwrap(),
        boss.subscribe(None).unwrap(),
    );
    assert!(
        next(&revoked, 30_000) && next(&stays, 30_000),
        "both hear heartbeats"
    );
    // Nobody hears who has no key.
    let plain = zmq::Context::new().socket(zmq::SUB).unwrap();
    plain.set_subscribe(b"").unwrap();
    let said = boss.hello().unwrap().event_endpoint.clone();
    let port = said.rsplit(':').next().unwrap();
    plain.connect(&format!("tcp://127.0.0.1:{port}")).unwrap();

    let keys_dir = home.path("keys").display().to_string();
    let out = coseg()
        .args(["keys", "--dir", &keys_dir, "revoke", "feeder"])
        .output();
    assert!(out.unwrap().status.success());
    let begin = Instant::now();
    loop {
        match feeder.call(Body::Hello(wire::HelloRequest {}), Vec::new()) {
            Ok(_) => assert!(begin.elapsed() < Duration::from_secs(20), "still served"),
            Err(ClientError::Refused(e)) => {
                assert_eq!(e.code(), ErrorCode::PermissionDenied);
                assert_eq!(e.reason(), ErrorReason::KeyNotAllowed);
                break;
            }
            Err(e) => panic!("{e}"),
        }
    }
    // What was under way may still arrive; then there is silence, where heartbeats came each second.
    let begin = Instant::now();
    while next(&revoked, 3_000) {
        let heard = begin.elapsed() < Duration::from_secs(20);
        assert!(heard, "events are still published to it");
    }
    assert!(!next(&plain, 0), "nor to a plain subscriber");
    while next(&stays, 0) {}
    assert!(next(&stays, 30_000), "others connect again by themselves");
    boss.hello().unwrap();
}

#[test]
fn crowds_and_monsters_at_the_door_do_not_keep_a_good_client_out() {
    let home = Home::new();
    let (daemon, endpoint) = secured(&home);
    let mut good = Client::connect_with(&endpoint, SERVED, Some(keys(&home, "reader"))).unwrap();
    let mut slowest_of = |n: usize| {
        let mut times: Vec<Duration> = (0..n)
            .map(|_| {
                let begin = Instant::now();
                good.call(Body::Hello(wire::HelloRequest {}), Vec::new())
                    .unwrap();
                begin.elapsed()
            })
            .collect();
        times.sort();
        times[n * 99 / 100]
    };
    let before = slowest_of(300);
    let address = endpoint.strip_prefix("tcp://").unwrap();
    // Half of them say nothing, the others something else than ZeroMQ.
    let crowd: Vec<TcpStream> = (0..1_000)
        .map(|i| {
            let mut stream = TcpStream::connect(address).unwrap();
            if i % 2 == 0 {
                stream.write_all(b"GET / HTTP/1.1\r\n\r\n").unwrap();
            }
            stream
        })
        .collect();
    let during = slowest_of(300);
    println!("p99 of a good client: {before:?} alone, {during:?} beside 1,000 open connections");
    // A machine that is busy with other tests has hiccups of its own.
    let allowed = (2 * before).max(Duration::from_millis(100));
    assert!(during <= allowed, "{during:?}, alone {before:?}");
    drop(crowd);
    // A topic and a frame beyond their limits: each ends its connection only.
    let context = zmq::Context::new();
    let keys = keys(&home, "feeder");
    let mut reader = Client::connect_with(&endpoint, SERVED, Some(keys.clone())).unwrap();
    let said = reader.hello().unwrap().event_endpoint.clone();
    let port = said.rsplit(':').next().unwrap();
    let subscriber = context.socket(zmq::SUB).unwrap();
    keys.apply(&subscriber).unwrap();
    subscriber.set_linger(0).unwrap();
    subscriber.set_subscribe(&vec![b'x'; 64 << 10]).unwrap();
    subscriber
        .connect(&format!("tcp://127.0.0.1:{port}"))
        .unwrap();
    subscriber.set_rcvtimeo(1_000).unwrap();
    assert!(subscriber.recv_msg(0).is_err());
    reader
        .call(Body::Hello(wire::HelloRequest {}), Vec::new())
        .unwrap();
    let stats = call!(reader, Stats(wire::StatsRequest {})).unwrap();
    assert_eq!(stats.pid, daemon.child.id());
    assert!(stats.resident_bytes < 512 << 20, "{}", stats.resident_bytes);
}
