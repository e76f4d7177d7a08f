//! More than the daemon can take: refused with a delay, nothing acknowledged is lost, others are served.

use super::{create, wait_idle};
use crate::harness::{Home, add_request, refusal, skittle};
use coseg::call;
use coseg::ipc::client::{Client, ClientError};
use coseg::ipc::wire::{self, ErrorCode, ErrorReason, request::Body};
use std::collections::BTreeSet;
use std::sync::Mutex;
use std::time::{Duration, Instant};

fn p99(mut times: Vec<Duration>) -> Duration {
    times.sort();
    times[times.len() * 99 / 100]
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
                    let (body, frames) = add_request("c", &[(&name, mesh)], wire::AddMode::Job);
                    let Body::AddShapes(mut request) = body else {
                        unreachable!()
                    };
                    request.create = None;
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
        "{} accepted, {refused} refused; p99 of accepted {:?}, of hello {alone:?} alone, {during:?} loaded",
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
    // One client has at most four requests in hand; others have their own.
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
    // Something to wait for: it is not idle while these are placed.
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
    let (body, frames) = add_request("c", &[("endless", &endless)], wire::AddMode::Wait);
    let Body::AddShapes(mut request) = body else {
        unreachable!()
    };
    request.create = None;
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
