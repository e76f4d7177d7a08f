//! Tests adding shapes: labelled, refused, cancelled, repeated.

use super::{add_again, create, describe, events_since, raw, raw_error, wait_idle};
use crate::harness::{Daemon, Home, SKITTLE_FACES, add, add_request, additions, skittle};
use coseg::call;
use coseg::ipc::client::ClientError;
use coseg::ipc::frames::FrameReader;
use coseg::ipc::wire::{
    self, ErrorCode, ErrorReason, ItemState, Outcome, Request, error::Subject, event::Kind, reply,
    request,
};
use prost::Message as _;
use rustix::process::Signal;
use std::collections::BTreeSet;
use std::time::Duration;

#[test]
fn shapes_are_labelled_in_the_order_of_their_faces() {
    let home = Home::new();
    let daemon = home.start();
    let client = &mut daemon.client();
    let text = skittle(0);
    let job = add(client, "c", &[("a", &text), ("b", &skittle(1))]);
    assert!(
        job.finished && job.items.iter().all(|i| i.state() == ItemState::Done),
        "{job:?}"
    );
    wait_idle(client, "c");
    let (collection, shape) = ("c".to_owned(), "a".to_owned());
    let request = wire::GetLabelsRequest {
        collection,
        shape,
        version: 0,
        confidence: true,
    };
    let (labels, frames) = call!(client, GetLabels(request), frames).unwrap();
    let reader = FrameReader::new(&frames);
    let (values, extents) = reader.i32_array(labels.labels.as_ref(), "labels").unwrap();
    assert_eq!(extents, [SKITTLE_FACES]);
    assert!(values.iter().all(|&l| l >= 0));
    let (confidence, _) = reader
        .f32_array(labels.confidence.as_ref(), "confidence")
        .unwrap();
    assert!(confidence.iter().all(|c| (0.0..=1.0).contains(c)));

    let (collection, shape) = ("c".to_owned(), "a".to_owned());
    let request = wire::GetOriginalRequest { collection, shape };
    let (original, frames) = call!(client, GetOriginal(request), frames).unwrap();
    let bytes = FrameReader::new(&frames)
        .file(original.bytes.as_ref(), "bytes")
        .unwrap();
    assert_eq!(bytes.as_ref(), text.as_bytes());

    let (collection, shape) = ("c".to_owned(), "a".to_owned());
    let request = wire::GetSpectrumRequest {
        collection,
        shape,
        eigenvectors: true,
        ..Default::default()
    };
    let (spectrum, frames) = call!(client, GetSpectrum(request), frames).unwrap();
    let reader = FrameReader::new(&frames);
    let (values, _) = reader
        .f64_array(spectrum.eigenvalues.as_ref(), "eigenvalues")
        .unwrap();
    assert!(values.is_sorted() && values[0].abs() < 1e-6 && values[1] > 0.0);
    let (_, extents) = reader
        .f32_array(spectrum.eigenvectors.as_ref(), "vectors")
        .unwrap();
    let (mass, _) = reader.f32_array(spectrum.mass.as_ref(), "mass").unwrap();
    assert_eq!(extents[0], mass.len());
    assert!((mass.iter().sum::<f32>() - 1.0).abs() < 1e-3);
    assert!(spectrum.area > 1.0);

    let request = wire::ListShapesRequest {
        collection: "c".to_owned(),
        page_size: 1,
        ..Default::default()
    };
    let page = call!(client, ListShapes(request.clone())).unwrap();
    assert_eq!(page.shapes[0].name, "a");
    let page_token = page.next_page_token;
    let page = call!(
        client,
        ListShapes(wire::ListShapesRequest {
            page_token,
            ..request
        })
    )
    .unwrap();
    assert_eq!(
        (page.shapes[0].name.as_str(), page.next_page_token.as_str()),
        ("b", "")
    );
}

#[test]
fn arrays_are_added_like_files() {
    let home = Home::new();
    let daemon = home.start();
    let client = &mut daemon.client();
    create(client, "c");
    let text = skittle(0);
    let numbers = |line: &str| {
        line.split(' ')
            .map(|x| x.parse::<f64>().unwrap())
            .collect::<Vec<_>>()
    };
    let n = 2 + 16 * 23;
    let lines: Vec<_> = text.lines().skip(2).map(numbers).collect();
    let vertices: Vec<f64> = lines[..n].concat();
    let faces: Vec<u32> = lines[n..]
        .iter()
        .flat_map(|l| l[1..].iter().map(|&v| v as u32))
        .collect();
    let mut frames = coseg::ipc::frames::FrameWriter::default();
    let mesh = wire::ArrayMesh {
        vertices: Some(frames.f64_array(&vertices, &[n, 3])),
        faces: Some(frames.u32_array(&faces, &[SKITTLE_FACES, 3])),
    };
    let shape = wire::ShapeInput {
        name: "arrays".to_owned(),
        replace: false,
        source: Some(wire::shape_input::Source::Arrays(mesh)),
    };
    let request = wire::AddShapesRequest {
        collection: "c".to_owned(),
        shapes: vec![shape],
        mode: wire::AddMode::Wait.into(),
        create: None,
    };
    let (reply, _) = call!(client, AddShapes(request), frames.finish(), with_frames).unwrap();
    assert_eq!(reply.job.unwrap().items[0].state(), ItemState::Done);
    // The same mesh as a file with the same digits is the same shape.
    let job = add_again(client, "c", "arrays", &text);
    assert_eq!(
        job.items[0].placed.as_ref().unwrap().outcome(),
        Outcome::Unchanged
    );
}

#[test]
fn refused_meshes_fail_alone_and_say_where() {
    let home = Home::new();
    let daemon = home.start();
    let client = &mut daemon.client();
    let bad_index = "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 9\n";
    let shapes = [
        ("good", skittle(0)),
        ("bad", bad_index.to_owned()),
        ("junk", "hello".to_owned()),
    ];
    let shapes: Vec<(&str, &str)> = shapes.iter().map(|(n, t)| (*n, t.as_str())).collect();
    let job = add(client, "c", &shapes);
    assert_eq!(job.items[0].state(), ItemState::Done);
    let error = job.items[1].error.clone().unwrap();
    assert_eq!(
        (error.code(), error.reason()),
        (ErrorCode::InvalidArgument, ErrorReason::VertexIndex)
    );
    assert_eq!(error.subject, Some(Subject::Face(0)));
    assert_eq!(
        job.items[2].error.as_ref().unwrap().reason(),
        ErrorReason::Parse
    );
    // The same bytes again are unchanged; other bytes under the same name are refused.
    let again = add_again(client, "c", "good", &skittle(0));
    assert_eq!(
        again.items[0].placed.as_ref().unwrap().outcome(),
        Outcome::Unchanged
    );
    let other = add_again(client, "c", "good", &skittle(1));
    let error = other.items[0].error.as_ref().unwrap();
    assert_eq!(
        (error.code(), error.reason()),
        (ErrorCode::AlreadyExists, ErrorReason::NameTaken)
    );
}

#[test]
fn the_same_request_again_has_one_effect_and_the_same_reply_across_a_restart() {
    let home = Home::new();
    let text = skittle(0);
    let send = |daemon: &Daemon| {
        let mut client = daemon.client();
        client.set_client_id("importer");
        let (body, frames) = add_request("c", &[("a", &text)], wire::AddMode::Job);
        match client.call_as("17", body, frames).unwrap().0 {
            reply::Result::AddShapes(reply) => reply,
            other => panic!("unexpected: {other:?}"),
        }
    };
    let daemon = home.start();
    let replies = [send(&daemon), send(&daemon)];
    wait_idle(&mut daemon.client(), "c");
    daemon.signal(Signal::KILL);
    drop(daemon.ended());
    let daemon = home.start();
    let last = send(&daemon);
    assert!(replies.iter().all(|r| *r == last), "{replies:?}, {last:?}");
    let client = &mut daemon.client();
    wait_idle(client, "c");
    let added = events_since(client, "c");
    let added = added
        .iter()
        .filter(|e| matches!(e.kind, Some(Kind::ShapeAdded(_))))
        .count();
    assert_eq!(added, 1);
    // The same id for another request is refused, rather than answered with the wrong reply.
    client.set_client_id("importer");
    let (body, frames) = add_request("c", &[("b", &text)], wire::AddMode::Job);
    match client.call_as("17", body, frames) {
        Err(ClientError::Refused(e)) => assert_eq!(e.reason(), ErrorReason::RequestIdReused),
        other => panic!("unexpected: {:?}", other.map(|(r, _)| r)),
    }
}

#[test]
fn settings_that_differ_are_refused() {
    let home = Home::new();
    let daemon = home.start();
    let client = &mut daemon.client();
    add(client, "c", &[("a", &skittle(0))]);
    let (body, frames) = add_request("c", &[("b", &skittle(1))], wire::AddMode::Wait);
    let request::Body::AddShapes(mut request) = body else {
        unreachable!()
    };
    request.create = Some(wire::CollectionSpec {
        n_parts: Some(3),
        ..Default::default()
    });
    match call!(client, AddShapes(request), frames, with_frames) {
        Err(ClientError::Refused(e)) => {
            assert_eq!(e.reason(), ErrorReason::CollectionDiffers);
            assert_eq!(e.message, "collection \"c\" has n_parts 2, not 3");
        }
        other => panic!("unexpected: {other:?}"),
    }
}

/// Sends requests one after the other without waiting; returns their replies in the order of
/// arrival, with their ids.
fn pipelined(
    endpoint: &str,
    requests: Vec<(String, request::Body, Vec<bytes::Bytes>)>,
) -> Vec<(String, reply::Result)> {
    let dealer = raw(zmq::DEALER, endpoint);
    let n = requests.len();
    for (request_id, body, frames) in requests {
        let request = Request {
            request_id,
            client_id: "one".to_owned(),
            body: Some(body),
            ..Default::default()
        };
        let mut message = vec![request.encode_to_vec()];
        message.extend(frames.iter().map(|f| f.to_vec()));
        dealer.send_multipart(message, 0).unwrap();
    }
    let replies = (0..n).map(|_| dealer.recv_multipart(0).unwrap());
    let decoded = replies.map(|r| wire::Reply::decode(r[0].as_slice()).unwrap());
    decoded
        .map(|reply| (reply.request_id, reply.result.unwrap()))
        .collect()
}

/// A request that creates the collection "c", and one with a file so large that later requests wait
/// for their turn.
fn before_the_others() -> Vec<(String, request::Body, Vec<bytes::Bytes>)> {
    let spec = wire::CollectionSpec {
        name: "c".to_owned(),
        n_parts: Some(2),
        ..Default::default()
    };
    let create = wire::CreateCollectionRequest { spec: Some(spec) };
    let create = request::Body::CreateCollection(create);
    let large = format!("{}{}", skittle(0), "# nothing\n".repeat(2 << 20));
    vec![
        ("create".to_owned(), create, Vec::new()),
        adding("0", "c", "s0", &large),
    ]
}

fn adding(
    id: &str,
    collection: &str,
    name: &str,
    text: &str,
) -> (String, request::Body, Vec<bytes::Bytes>) {
    let (request, frames) = additions(collection, &[(name, text)], wire::AddMode::Job);
    (id.to_owned(), request::Body::AddShapes(request), frames)
}

/// Files are written concurrently, so a small one is stored before a large one that was sent
/// earlier.
#[test]
fn what_one_client_sends_takes_effect_in_its_order() {
    let home = Home::new();
    let daemon = home.start();
    let mut requests = before_the_others();
    for i in 1..8 {
        let name = format!("s{i}");
        requests.push(adding(&i.to_string(), "c", &name, &skittle(i)));
    }
    let mut jobs = Vec::new();
    for (id, reply) in pipelined(&daemon.endpoint, requests) {
        match reply {
            reply::Result::CreateCollection(_) => {}
            reply::Result::AddShapes(added) => jobs.push((added.job_id, id)),
            other => panic!("unexpected: {other:?}"),
        }
    }
    jobs.sort_unstable();
    let order: Vec<String> = jobs.into_iter().map(|job| job.1).collect();
    assert_eq!(order, ["0", "1", "2", "3", "4", "5", "6", "7"]);
}

/// Requests that wait for their turn together are accepted in one transaction.
#[test]
fn who_is_refused_among_others_is_refused_alone() {
    let home = Home::new();
    let daemon = home.start();
    let mut requests = before_the_others();
    requests.extend([
        adding("1", "c", "s1", &skittle(1)),
        adding("nowhere", "d", "s2", &skittle(2)),
        // Another request under an id that was used.
        adding("1", "c", "s3", &skittle(3)),
        // The same request twice.
        adding("4", "c", "s4", &skittle(4)),
        adding("4", "c", "s4", &skittle(4)),
    ]);
    let (body, frames) = add_request("e", &[("s5", &skittle(5))], wire::AddMode::Job);
    requests.push(("creates".to_owned(), body, frames));
    requests.push(adding("6", "e", "s6", &skittle(6)));
    let mut outcomes: Vec<(String, String)> = Vec::new();
    let mut jobs = BTreeSet::new();
    for (id, reply) in pipelined(&daemon.endpoint, requests) {
        let outcome = match reply {
            reply::Result::CreateCollection(_) => continue,
            reply::Result::AddShapes(added) => {
                jobs.insert(added.job_id);
                "accepted".to_owned()
            }
            reply::Result::Error(e) => e.reason().as_str_name().to_owned(),
            other => panic!("unexpected: {other:?}"),
        };
        outcomes.push((id, outcome));
    }
    outcomes.sort_unstable();
    let outcomes: Vec<_> = outcomes.iter().map(|(i, o)| (&i[..], &o[..])).collect();
    let reused = ErrorReason::RequestIdReused.as_str_name();
    let nowhere = ErrorReason::NoCollection.as_str_name();
    assert_eq!(
        outcomes,
        [
            ("0", "accepted"),
            ("1", reused),
            ("1", "accepted"),
            ("4", "accepted"),
            ("4", "accepted"),
            ("6", "accepted"),
            ("creates", "accepted"),
            ("nowhere", nowhere),
        ]
    );
    assert_eq!(jobs.len(), 5, "what is sent twice is one job");
    let client = &mut daemon.client();
    wait_idle(client, "");
    let mut names = |collection: &str| -> Vec<String> {
        let request = wire::ListShapesRequest {
            collection: collection.to_owned(),
            ..Default::default()
        };
        let shapes = call!(client, ListShapes(request)).unwrap().shapes;
        shapes.into_iter().map(|s| s.name).collect()
    };
    assert_eq!(names("c"), ["s0", "s1", "s4"]);
    assert_eq!(names("e"), ["s5", "s6"]);
}

#[test]
fn a_deadline_ends_the_wait_and_not_the_work() {
    let home = Home::new();
    let daemon = home.start();
    let (body, frames) = add_request("c", &[("a", &skittle(0))], wire::AddMode::Wait);
    let request = Request {
        request_id: "1".to_owned(),
        deadline_ms: 1,
        body: Some(body),
        ..Default::default()
    };
    let dealer = raw(zmq::DEALER, &home.endpoint());
    let error = raw_error(&dealer, &[&request.encode_to_vec(), &frames[0]]);
    assert_eq!(
        (error.code(), error.reason()),
        (ErrorCode::DeadlineExceeded, ErrorReason::Deadline)
    );
    let client = &mut daemon.client();
    let Some(Subject::JobId(job_id)) = error.subject else {
        // If the deadline passes before the change begins, it has no effect; otherwise it continues
        // after the reply.
        for _ in 0..200 {
            let Ok((reply::Result::DescribeCollection(found), _)) =
                client.call(describe("c"), Vec::new())
            else {
                return;
            };
            if found.collection.is_some_and(|c| c.n_shapes == 1) {
                return;
            }
            std::thread::sleep(Duration::from_millis(100));
        }
        panic!("the collection is there, and the shape has not come in 20 s");
    };
    wait_idle(client, "c");
    let job = call!(client, GetJob(wire::GetJobRequest { job_id }))
        .unwrap()
        .job
        .unwrap();
    assert_eq!(job.items[0].state(), ItemState::Done);
}

#[test]
fn a_cancelled_job_ends_and_the_next_is_done() {
    let home = Home::new();
    let daemon = home.start_with(&["--workers", "1"], &[]);
    let client = &mut daemon.client();
    let texts: Vec<_> = (0..12).map(|i| (format!("s{i}"), skittle(i))).collect();
    let shapes: Vec<_> = texts
        .iter()
        .map(|(n, t)| (n.as_str(), t.as_str()))
        .collect();
    let (body, frames) = add_request("c", &shapes, wire::AddMode::Job);
    let reply::Result::AddShapes(accepted) = client.call(body, frames).unwrap().0 else {
        panic!("not accepted")
    };
    let job_id = accepted.job_id;
    call!(client, CancelJob(wire::CancelJobRequest { job_id })).unwrap();
    let job = loop {
        let request = wire::WatchJobRequest {
            job_id,
            revision: 0,
            wait_ms: 1_000,
        };
        let job = call!(client, WatchJob(request)).unwrap().job.unwrap();
        if job.finished {
            break job;
        }
    };
    let n = |state| job.items.iter().filter(|i| i.state() == state).count();
    assert!(n(ItemState::Cancelled) > 0, "{job:?}");
    assert_eq!(n(ItemState::Cancelled) + n(ItemState::Done), 12);
    let later = add(client, "c", &[("later", &skittle(20))]);
    assert_eq!(later.items[0].state(), ItemState::Done);
}

#[test]
fn a_full_queue_is_said_with_a_delay() {
    let home = Home::new();
    let daemon = home.start_with(&[], &[("COSEG__LIMITS__MAX_QUEUED_SHAPES", "2")]);
    let client = &mut daemon.client();
    let text = skittle(0);
    let mut send = |names: &[&str]| {
        let shapes: Vec<(&str, &str)> = names.iter().map(|n| (*n, text.as_str())).collect();
        let (body, frames) = add_request("c", &shapes, wire::AddMode::Job);
        client.call(body, frames)
    };
    send(&["a", "b"]).unwrap();
    // Two shapes cannot be described and placed in the time of the next request.
    match send(&["c", "d"]) {
        Err(ClientError::Refused(e)) => {
            assert_eq!(e.code(), ErrorCode::ResourceExhausted);
            assert_eq!(e.reason(), ErrorReason::QueueFull);
            assert!(e.retry_after_ms > 0);
            let end = "shapes are queued and 2 shapes more asked for, the limit is 2 shapes \
                       (limits.max_queued_shapes)";
            assert!(e.message.ends_with(end), "{}", e.message);
        }
        other => panic!("unexpected: {:?}", other.map(|(r, _)| r)),
    }
    match send(&["e", "f", "g"]) {
        Err(ClientError::Refused(e)) => {
            assert_eq!(e.code(), ErrorCode::InvalidArgument);
            let text = "the request has 3 shapes, the whole queue holds 2 shapes \
                        (limits.max_queued_shapes)";
            assert_eq!(e.message, text);
        }
        other => panic!("unexpected: {:?}", other.map(|(r, _)| r)),
    }
    wait_idle(client, "c");
    assert_eq!(
        add(client, "c", &[("h", &text)]).items[0].state(),
        ItemState::Done
    );
}
