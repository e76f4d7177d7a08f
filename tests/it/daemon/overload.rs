//! Tests overload: requests are refused with a delay, no acknowledged shape is lost, other requests
//! are served.

use super::{create, wait_idle};
use crate::harness::{Home, add_request, additions, refusal, skittle};
use coseg::call;
use coseg::ipc::client::{Client, ClientError};
use coseg::ipc::wire::{self, ErrorCode, ErrorReason, request::Body};
use std::collections::BTreeSet;
use std::sync::{Barrier, Mutex};
use std::time::{Duration, Instant};

fn p99(mut times: Vec<Duration>) -> Duration {
    times.sort();
    times
        .get(times.len() * 99 / 100)
        .copied()
        .unwrap_or_default()
}

#[test]
fn ten_times_too_much_from_64_clients_is_refused_politely() {
    let home = Home::new();
    let env = [("COSEG__LIMITS__MAX_QUEUED_SHAPES", "32")];
    let daemon = home.start_with(&[], &env);
    create(&mut daemon.client(), "c");
    let mesh = skittle(0);
    let hello = |client: &mut Client| {
        let begin = Instant::now();
        client
            .call(Body::Hello(wire::HelloRequest {}), Vec::new())
            .unwrap();
        begin.elapsed()
    };
    let one = &mut daemon.client();
    let alone = p99((0..300).map(|_| hello(one)).collect());
    let accepted = Mutex::new(BTreeSet::new());
    let (refused, waits) = (Mutex::new(0_u32), Mutex::new(Vec::new()));
    std::thread::scope(|scope| {
        for client in 0..64 {
            let (accepted, refused, waits, mesh) = (&accepted, &refused, &waits, &mesh);
            let mut connection = daemon.client();
            scope.spawn(move || {
                for shape in 0..5 {
                    let name = format!("{client}-{shape}");
                    let (request, frames) = additions("c", &[(&name, mesh)], wire::AddMode::Job);
                    let begin = Instant::now();
                    match connection.call(Body::AddShapes(request), frames) {
                        Ok(_) => {
                            waits.lock().unwrap().push(begin.elapsed());
                            accepted.lock().unwrap().insert(name);
                        }
                        Err(ClientError::Refused(e)) => {
                            assert_eq!(e.code(), ErrorCode::ResourceExhausted, "{e:?}");
                            assert!((250..=60_000).contains(&e.retry_after_ms), "{e:?}");
                            *refused.lock().unwrap() += 1;
                        }
                        Err(e) => panic!("{e}"),
                    }
                }
            });
        }
    });
    let during = p99((0..300).map(|_| hello(one)).collect());
    let (accepted, refused) = (
        accepted.into_inner().unwrap(),
        refused.into_inner().unwrap(),
    );
    println!(
        "{} accepted, {refused} refused; p99 of accepted {:?}, of hello {alone:?} alone, \
         {during:?} loaded",
        accepted.len(),
        p99(waits.into_inner().unwrap())
    );
    assert!(refused > 200, "{refused}");
    assert!(accepted.len() >= 32, "{}", accepted.len());
    assert!(
        during <= (2 * alone).max(Duration::from_millis(200)),
        "{alone:?} {during:?}"
    );
    wait_idle(one, "c");
    let request = wire::ListShapesRequest {
        collection: "c".to_owned(),
        ..Default::default()
    };
    let shapes = call!(one, ListShapes(request)).unwrap().shapes;
    let placed: BTreeSet<String> = shapes.into_iter().map(|s| s.name).collect();
    assert_eq!(
        placed, accepted,
        "what was acknowledged is there, and nothing else"
    );
    let stats = call!(one, Stats(wire::StatsRequest {})).unwrap();
    assert_eq!(stats.n_refused, u64::from(refused));
    assert!(stats.resident_bytes < stats.memory_limit_bytes);
}

/// Clients that retry after the delay in the refusal, while the overload lasts.
#[test]
fn what_is_accepted_under_overload_is_accepted_quickly() {
    let seconds = crate::harness::number("COSEG_TEST_SECONDS", 8);
    let home = Home::new();
    let env = [("COSEG__LIMITS__MAX_QUEUED_SHAPES", "16")];
    let daemon = home.start_with(&[], &env);
    create(&mut daemon.client(), "c");
    let mesh = skittle(0);
    let request = |name: &str| {
        let (request, frames) = additions("c", &[(name, &mesh)], wire::AddMode::Job);
        (Body::AddShapes(request), frames)
    };
    // A single client that adds shapes one after the other, which leaves room in the queue.
    let mut alone = Vec::new();
    let one = &mut daemon.client();
    for n in 0..20 {
        let (body, frames) = request(&format!("alone {n}"));
        let begin = Instant::now();
        one.call(body, frames).unwrap();
        alone.push(begin.elapsed());
        wait_idle(one, "c");
    }
    let taken = Mutex::new((Vec::new(), Vec::new()));
    let later = Mutex::new(Vec::new());
    // The clients are connected beforehand, since connecting is not measured.
    let ready = Barrier::new(64);
    std::thread::scope(|scope| {
        for client in 0..64 {
            let (taken, later, request, ready) = (&taken, &later, &request, &ready);
            let mut connection = daemon.client();
            scope.spawn(move || {
                let mut n = 0;
                let hello = Body::Hello(wire::HelloRequest {});
                connection.call(hello, Vec::new()).unwrap();
                ready.wait();
                let start = Instant::now();
                let until = start + Duration::from_secs(seconds);
                while Instant::now() < until {
                    let (body, frames) = request(&format!("{client}-{n}"));
                    let begin = Instant::now();
                    match connection.call(body, frames) {
                        Ok(_) => {
                            let took = begin.elapsed();
                            taken.lock().unwrap().0.push(took);
                            if begin - start > Duration::from_secs(1) {
                                later.lock().unwrap().push(took);
                            }
                            n += 1;
                        }
                        Err(ClientError::Refused(e)) => {
                            taken.lock().unwrap().1.push(begin.elapsed());
                            assert_eq!(e.code(), ErrorCode::ResourceExhausted, "{e:?}");
                            let pause = Duration::from_millis(e.retry_after_ms);
                            std::thread::sleep(pause.min(until - Instant::now().min(until)));
                        }
                        Err(e) => panic!("{e}"),
                    }
                }
            });
        }
    });
    let (accepted, refused) = taken.into_inner().unwrap();
    let (n, n_refused) = (accepted.len(), refused.len());
    let mut median = accepted.clone();
    median.sort();
    let (alone, loaded) = (p99(alone), p99(accepted));
    println!(
        "{seconds} s: {n} accepted, {n_refused} refused; accepted in {:?} (median), {loaded:?} \
         (p99), {:?} (p99) after the first second; {alone:?} (p99) unloaded; refused in {:?} \
         (p99), {:?} \
         (slowest)",
        median[n / 2],
        p99(later.into_inner().unwrap()),
        p99(refused.clone()),
        refused.iter().max().expect("some are refused")
    );
    assert!(n_refused > 64, "{n_refused}");
    // In the first moment 64 threads of the clients compete for processors, too.
    let allowed = (2 * alone).max(Duration::from_secs(1));
    assert!(loaded <= allowed, "{loaded:?}, unloaded {alone:?}");
    let stats = call!(one, Stats(wire::StatsRequest {})).unwrap();
    assert!(stats.resident_bytes < stats.memory_limit_bytes);
}

/// With the default timeout of clients, while all workers are busy.
#[test]
fn large_files_are_taken_in_while_the_machine_is_busy() {
    let home = Home::new();
    let daemon = home.start();
    create(&mut daemon.client(), "c");
    let mesh = skittle(0);
    let names: Vec<String> = (0..24).map(|i| format!("s{i}")).collect();
    let shapes: Vec<_> = names.iter().map(|n| (n.as_str(), mesh.as_str())).collect();
    let (body, frames) = add_request("d", &shapes, wire::AddMode::Job);
    daemon.client().call(body, frames).unwrap();
    let large = format!(
        "{mesh}{}",
        "# a line that says nothing\n".repeat(36 << 20 >> 5)
    );
    assert!(large.len() > 28 << 20);
    let timeout = coseg::ipc::client::DEFAULT_TIMEOUT;
    let mut client = Client::connect(&home.endpoint(), timeout).unwrap();
    for name in ["x", "y", "z"] {
        let begin = Instant::now();
        let (request, frames) = additions("c", &[(name, &large)], wire::AddMode::Job);
        client.call(Body::AddShapes(request), frames).unwrap();
        let n = large.len() >> 20;
        println!("{n} MB were taken in within {:?}", begin.elapsed());
    }
}

#[test]
fn what_the_queue_can_never_hold_is_refused_for_good() {
    let home = Home::new();
    let env = [
        ("COSEG__LIMITS__MAX_QUEUED_SHAPES", "3"),
        ("COSEG__LIMITS__MAX_MESSAGE", "1MiB"),
        ("COSEG__LIMITS__MAX_BYTES_PER_CLIENT", "1MiB"),
        ("COSEG__LIMITS__MAX_REQUESTS_PER_CLIENT", "4"),
    ];
    let daemon = home.start_with(&[], &env);
    let client = &mut daemon.client();
    super::create_with(client, "c", 2);
    let mesh = skittle(0);
    let names = ["a", "b", "c", "d"];
    let shapes: Vec<_> = names.iter().map(|n| (*n, mesh.as_str())).collect();
    let (body, frames) = add_request("c", &shapes, wire::AddMode::Job);
    match client.call(body, frames) {
        Err(ClientError::Refused(e)) => {
            assert_eq!(e.code(), ErrorCode::InvalidArgument);
            assert_eq!(e.reason(), ErrorReason::MessageTooLarge);
            assert_eq!(e.retry_after_ms, 0);
            assert!(
                e.message.contains("the whole queue holds 3"),
                "{}",
                e.message
            );
        }
        other => panic!("{other:?}"),
    }
    // One client has at most four unfinished requests; others have limits of their own.
    let dealer = super::raw(zmq::DEALER, &home.endpoint());
    let waiting = |id: &str| {
        use prost::Message as _;
        let body = Body::WatchJob(wire::WatchJobRequest {
            job_id: 0,
            revision: 0,
            wait_ms: 0,
        });
        let idle = Body::WaitIdle(wire::WaitIdleRequest {
            collection: "c".to_owned(),
            wait_ms: 20_000,
        });
        wire::Request {
            request_id: id.to_owned(),
            body: Some(if id == "last" { body } else { idle }),
            ..Default::default()
        }
        .encode_to_vec()
    };
    // The daemon has work: it is not idle while these shapes are placed.
    let (body, frames) = add_request("c", &shapes[..3], wire::AddMode::Job);
    client.call(body, frames).unwrap();
    for id in ["1", "2", "3", "4"] {
        dealer.send(waiting(id), 0).unwrap();
    }
    let error = super::raw_error(&dealer, &[&waiting("last")]);
    assert_eq!(error.code(), ErrorCode::ResourceExhausted);
    assert_eq!(error.reason(), ErrorReason::ClientQuota);
    assert!(error.retry_after_ms > 0);
    let unknown = Body::GetJob(wire::GetJobRequest { job_id: 99 });
    assert_eq!(
        refusal(client, unknown),
        (ErrorCode::NotFound, ErrorReason::NoJob)
    );
}

#[test]
fn a_deadline_is_answered_when_it_passes() {
    let home = Home::new();
    let env = [(coseg::daemon::POISON_VARIABLE, "1")];
    let daemon = home.start_with(&["--workers", "1"], &env);
    create(&mut daemon.client(), "c");
    let endless = skittle(0).replacen("OFF\n", "OFF # poison: loop\n", 1);
    let (request, frames) = additions("c", &[("endless", &endless)], wire::AddMode::Wait);
    use prost::Message as _;
    let request = wire::Request {
        request_id: "r".to_owned(),
        deadline_ms: 300,
        body: Some(Body::AddShapes(request)),
        ..Default::default()
    }
    .encode_to_vec();
    let dealer = super::raw(zmq::DEALER, &home.endpoint());
    let begin = Instant::now();
    let error = super::raw_error(&dealer, &[&request, &frames[0]]);
    assert_eq!(error.code(), ErrorCode::DeadlineExceeded);
    assert!(matches!(
        error.subject,
        Some(wire::error::Subject::JobId(_))
    ));
    assert!(
        begin.elapsed() < Duration::from_secs(10),
        "{:?}",
        begin.elapsed()
    );
}
