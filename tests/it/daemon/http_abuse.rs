//! Tests that HTTP requests cost only HTTP: monitoring, the sockets and signals are served
//! meanwhile.

use crate::harness::{Daemon, Home, SKITTLE_FACES, add, skittle};
use crate::viewing::{exchange, get, served};
use coseg::ipc::client::Client;
use coseg::ipc::wire::{self, request::Body};
use rustix::process::Signal;
use std::io::{ErrorKind, Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

/// More connections than the daemon keeps.
const CROWD: usize = 200;
/// The promised limit, and the limit of the fastest of several attempts on a machine that is busy
/// with other tests.
const PROMISED: Duration = Duration::from_millis(100);
/// The daemon waits ten seconds for a peer. A request that takes half of that waited for a place.
const WAITED: Duration = Duration::from_secs(5);

/// The fastest of several attempts, which measures the work rather than the load of the machine.
/// None of them waits until hanging peers have reached their time limit.
fn fastest(what: &str, mut ask: impl FnMut()) -> Duration {
    let times = (0..10).map(|_| {
        let begin = Instant::now();
        ask();
        begin.elapsed()
    });
    let mut times: Vec<Duration> = times.collect();
    times.sort();
    println!(
        "{what}: {:?} to {:?}, median {:?}",
        times[0], times[9], times[5]
    );
    assert!(times[9] < WAITED, "{what}: {:?}", times[9]);
    times[0]
}

fn hello(client: &mut Client) {
    client
        .call(Body::Hello(wire::HelloRequest {}), Vec::new())
        .unwrap();
}

/// Checks that monitoring and the sockets answer within the promised time.
fn assert_served(beside: &str, daemon: &Daemon, address: SocketAddr) {
    for path in ["/healthz", "/readyz", "/metrics"] {
        let took = fastest(&format!("{path} beside {beside}"), || {
            assert_eq!(get(address, path).0, 200, "{path} beside {beside}");
        });
        assert!(took < PROMISED, "{path} beside {beside}: {took:?}");
    }
    let mut client = daemon.client();
    let took = fastest(&format!("hello beside {beside}"), || hello(&mut client));
    assert!(took < PROMISED, "hello beside {beside}: {took:?}");
}

fn crowd(address: SocketAddr, says: &str) -> Vec<TcpStream> {
    let one = |_| {
        let mut stream = TcpStream::connect(address).unwrap();
        // The displaced connections are closed.
        let _ = stream.write_all(says.as_bytes());
        stream
    };
    (0..CROWD).map(one).collect()
}

fn post(address: SocketAddr, path: &str, length: usize) -> String {
    format!(
        "POST {path} HTTP/1.1\r\nhost: {address}\r\nx-coseg: 1\r\ncontent-length: {length}\r\n\r\n"
    )
}

#[test]
fn connections_that_hang_make_way_for_monitors_and_viewers() {
    let home = Home::new();
    let (daemon, address) = served(&home, &[]);
    add(&mut daemon.client(), "c", &[("a", &skittle(0))]);
    let page = format!("GET /viewer.js HTTP/1.1\r\nhost: {address}\r\n\r\n");
    let map = format!("GET /api/collection?collection=c HTTP/1.1\r\nhost: {address}\r\n\r\n");
    for (beside, says) in [
        ("half requests", "GET / HTTP/1.1\r\nhost: x\r\n".to_owned()),
        ("silence", String::new()),
        ("requests whose answers nobody reads", page.repeat(400)),
        ("questions whose answers nobody reads", map.repeat(20)),
        (
            "bodies that never come",
            format!("{}{{", post(address, "/api/undo", 8_000_000)),
        ),
    ] {
        let crowd = crowd(address, &says);
        assert_served(beside, &daemon, address);
        let host = format!("host: {address}\r\nx-coseg: 1\r\n");
        let name = r#"{"collection":"c","label":0,"name":"x"}"#;
        let (status, _, body) = exchange(address, "POST /api/name", &host, name);
        let body = String::from_utf8_lossy(&body);
        assert_eq!(status, 200, "beside {beside}: {body}");
        // Its answer needs memory, which bodies that are only announced must not take.
        fastest(&format!("a portrait beside {beside}"), || {
            let begin = Instant::now();
            loop {
                let (status, body) = get(address, "/api/portraits?collection=c&shape=a");
                if status == 200 {
                    break;
                }
                let full = body.contains("too many requests of viewers wait");
                let waits = full && begin.elapsed() < WAITED;
                assert!(waits, "beside {beside}: {status} {body}");
            }
        });
        drop(crowd);
    }
}

#[test]
fn runs_without_end_are_refused_and_freeze_nothing() {
    let home = Home::new();
    let (daemon, address) = served(&home, &[]);
    add(&mut daemon.client(), "c", &[("a", &skittle(0))]);
    let host = format!("host: {address}\r\nx-coseg: 1\r\n");
    let correct = |shape: &str, n: u64, runs: &str| {
        let body =
            format!(r#"{{"collection":"c","shape":"{shape}","n_polygons":{n},"runs":[{runs}]}}"#);
        let (status, _, reply) = exchange(address, "POST /api/correct", &host, &body);
        (status, String::from_utf8(reply).unwrap())
    };
    let n = SKITTLE_FACES as u64;
    for (shape, n, runs, expected) in [
        ("none", 10_000_000, "[0,10000000,1]", "NO_SHAPE"),
        (
            "a",
            10_000_000,
            "[0,10000000,1]",
            "n_polygons is 10000000, but the shape has 736",
        ),
        (
            "a",
            n,
            "[0,1152921504606846976,1]",
            "a run of 1152921504606846976 polygons",
        ),
        (
            "a",
            n,
            "[18446744073709551615,1,1]",
            "begins at polygon 18446744073709551615",
        ),
        (
            "a",
            n,
            "[0,700,1],[0,700,2]",
            "the runs have 1400 polygons together",
        ),
    ] {
        let (status, text) = correct(shape, n, runs);
        assert!(status == 400 || status == 404, "{runs}: {status}");
        assert!(text.contains(expected), "{runs}: {text}");
    }
    // As many faces as a body may have, each over the whole shape, from several pages at once.
    let runs = format!("[0,{n},1],").repeat(500_000);
    let runs = runs.trim_end_matches(',');
    std::thread::scope(|scope| {
        let pages: Vec<_> = (0..4)
            .map(|_| scope.spawn(|| correct("a", n, runs)))
            .collect();
        assert_served("runs without end", &daemon, address);
        for page in pages {
            let (status, text) = page.join().unwrap();
            assert_eq!(status, 400, "{text}");
            assert!(text.contains("the runs have 368000000 polygons"), "{text}");
        }
    });
    assert_eq!(correct("a", n, "[0,10,1]").0, 200);
    // The daemon ends on request even if pages continue to send requests.
    let body = format!(r#"{{"collection":"c","shape":"a","n_polygons":{n},"runs":[{runs}]}}"#);
    let request = format!("{}{body}", post(address, "/api/correct", body.len()));
    let pages: Vec<_> = (0..4)
        .map(|_| {
            let (mut stream, request) = (TcpStream::connect(address).unwrap(), request.clone());
            std::thread::spawn(move || stream.write_all(request.as_bytes()).map(|()| stream))
        })
        .collect();
    let crowd = crowd(address, &format!("{}{{", post(address, "/api/undo", 9_000)));
    daemon.signal(Signal::TERM);
    let begin = Instant::now();
    assert_eq!(daemon.ended().0.code(), Some(0));
    let took = begin.elapsed();
    println!("ended {took:?} after the signal");
    assert!(took < Duration::from_secs(20), "{took:?}");
    drop((crowd, pages));
}

/// The bytes that are read until the daemon ends the connection.
fn until_ended(stream: &mut TcpStream) -> Vec<u8> {
    let mut read = Vec::new();
    stream
        .set_read_timeout(Some(Duration::from_secs(60)))
        .unwrap();
    match stream.read_to_end(&mut read) {
        Ok(_) => read,
        Err(e) if e.kind() == ErrorKind::ConnectionReset => read,
        Err(e) => panic!("not ended: {e}"),
    }
}

#[test]
fn peers_have_ten_seconds_each_time() {
    let home = Home::new();
    let (_daemon, address) = served(&home, &[]);
    let in_time = |begin: Instant| {
        let took = begin.elapsed().as_secs_f64();
        assert!((9.0..30.0).contains(&took), "ended after {took} s");
    };
    let page = format!("GET /viewer.js HTTP/1.1\r\nhost: {address}\r\n\r\n");
    let length = exchange(
        address,
        "GET /viewer.js",
        &format!("host: {address}\r\n"),
        "",
    )
    .2
    .len();
    // The request stays below the limits on its head and on data read ahead.
    let n = 500;
    let mut unread = TcpStream::connect(address).unwrap();
    unread.write_all(page.repeat(n).as_bytes()).unwrap();
    let mut slow: Vec<TcpStream> = ["", "GET / HT", "GET / HTTP/1.1\r\nhost: x\r\n"]
        .into_iter()
        .map(|says| {
            let mut stream = TcpStream::connect(address).unwrap();
            stream.write_all(says.as_bytes()).unwrap();
            stream
        })
        .collect();
    let begin = Instant::now();
    let mut kept = TcpStream::connect(address).unwrap();
    kept.write_all(page.as_bytes()).unwrap();
    let mut body = TcpStream::connect(address).unwrap();
    let says = format!("{}{{", post(address, "/api/undo", 1_000));
    body.write_all(says.as_bytes()).unwrap();
    for stream in &mut slow {
        until_ended(stream);
    }
    in_time(begin);
    let reply = String::from_utf8(until_ended(&mut body)).unwrap();
    assert!(reply.starts_with("HTTP/1.1 408 "), "{reply}");
    in_time(begin);
    let reply = until_ended(&mut kept);
    assert!(reply.starts_with(b"HTTP/1.1 200 ") && reply.len() > length);
    in_time(begin);
    // The same time again, so that requests in flight surely finish and no others arrive.
    until_ended(&mut TcpStream::connect(address).unwrap());
    let all = until_ended(&mut unread).len();
    println!("{all} bytes of {n} answers of {length} each");
    assert!(all < n * length, "everything was kept for it");
}
