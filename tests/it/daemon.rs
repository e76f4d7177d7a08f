//! The daemon over its real sockets.

use crate::harness::{DEADLINE, Home, SKITTLE_FACES, add, add_request, exists, refusal, skittle};
use coseg::call;
use coseg::ipc::client::{Client, ClientError};
use coseg::ipc::frames::FrameReader;
use coseg::ipc::wire::{
    self, ErrorCode, ErrorReason, ItemState, Outcome, Reply, Request, error::Subject, event::Kind,
    reply, request,
};
use prost::Message as _;
use rustix::process::Signal;

/// A socket that sends whatever it likes.
fn raw(kind: zmq::SocketType, endpoint: &str) -> zmq::Socket {
    let socket = zmq::Context::new().socket(kind).unwrap();
    socket.set_linger(0).unwrap();
    socket.set_rcvtimeo(DEADLINE.as_millis() as i32).unwrap();
    socket.connect(endpoint).unwrap();
    socket
}

fn raw_error(socket: &zmq::Socket, frames: &[&[u8]]) -> wire::Error {
    socket.send_multipart(frames, 0).unwrap();
    let reply = socket.recv_multipart(0).unwrap();
    match Reply::decode(reply[0].as_slice()).unwrap().result {
        Some(reply::Result::Error(e)) => e,
        other => panic!("unexpected: {other:?}"),
    }
}

fn create(client: &mut Client, name: &str) -> wire::Collection {
    let spec = wire::CollectionSpec {
        name: name.to_owned(),
        ..Default::default()
    };
    let request = wire::CreateCollectionRequest { spec: Some(spec) };
    call!(client, CreateCollection(request))
        .unwrap()
        .collection
        .unwrap()
}

fn events_since(client: &mut Client, collection: &str) -> Vec<wire::Event> {
    let request = wire::EventsSinceRequest {
        collection: collection.to_owned(),
        sequence: 0,
        limit: 0,
    };
    call!(client, EventsSince(request)).unwrap().events
}

fn wait_idle(client: &mut Client, collection: &str) {
    let request = wire::WaitIdleRequest {
        collection: collection.to_owned(),
        wait_ms: 30_000,
    };
    while !call!(client, WaitIdle(request.clone())).unwrap().idle {}
}

#[test]
fn hello_tells_limits_formats_and_where_events_are() {
    let home = Home::new();
    let daemon = home.start();
    let hello = daemon.client().hello().unwrap().clone();
    assert_eq!(hello.protocol, "coseg.v1");
    assert_eq!(hello.event_endpoint, format!("{}.events", home.endpoint()));
    assert_eq!(
        hello.formats,
        [wire::MeshFormat::Obj as i32, wire::MeshFormat::Off as i32]
    );
    let limits = hello.limits.unwrap();
    assert_eq!(limits.max_message_bytes, 128 << 20);
    assert_eq!(limits.max_shapes_per_request, 256);
}

#[test]
fn junk_gets_an_error_and_the_daemon_lives() {
    let home = Home::new();
    let daemon = home.start();
    let dealer = raw(zmq::DEALER, &home.endpoint());
    for junk in [
        &b"\xff\xff\xff\xff"[..],
        b"GET / HTTP/1.1",
        &[0x52, 0xff, 0xff, 0xff, 0x7f],
    ] {
        let error = raw_error(&dealer, &[junk]);
        assert_eq!(error.code(), ErrorCode::InvalidArgument);
        assert_eq!(error.reason(), ErrorReason::MalformedMessage);
    }
    // Length-delimited fields of unknown number, one inside the other.
    let mut deep = Vec::new();
    for _ in 0..1_000 {
        let mut outer = vec![0xa2, 0x06]; // field 100
        prost::encoding::encode_varint(deep.len() as u64, &mut outer);
        outer.extend_from_slice(&deep);
        deep = outer;
    }
    assert_eq!(
        raw_error(&dealer, &[&deep]).reason(),
        ErrorReason::UnknownRequest
    );
    assert_eq!(
        raw_error(&dealer, &[b""]).reason(),
        ErrorReason::UnknownRequest
    );
    let long = Request {
        request_id: "x".repeat(129),
        ..Default::default()
    }
    .encode_to_vec();
    let error = raw_error(&dealer, &[&long]);
    assert_eq!(
        error.message,
        "request_id has 129 characters, the limit is 128"
    );
    assert_eq!(error.subject, Some(Subject::Field("request_id".to_owned())));
    daemon.client().hello().unwrap();
}

#[test]
fn req_sockets_are_answered_with_their_delimiter() {
    let home = Home::new();
    let _daemon = home.start();
    let socket = raw(zmq::REQ, &home.endpoint());
    let body = Some(request::Body::Hello(wire::HelloRequest {}));
    let request = Request {
        request_id: "7".to_owned(),
        body,
        ..Default::default()
    };
    socket.send(request.encode_to_vec(), 0).unwrap();
    let reply = Reply::decode(socket.recv_bytes(0).unwrap().as_slice()).unwrap();
    assert_eq!(reply.request_id, "7");
    assert!(matches!(reply.result, Some(reply::Result::Hello(_))));
}

#[test]
fn oversized_messages_are_refused_and_others_are_served() {
    let home = Home::new();
    let daemon = home.start_with(&[], &[("COSEG__LIMITS__MAX_MESSAGE", "64KiB")]);
    let half = vec![7_u8; 40 << 10];
    let request = Request {
        request_id: "big".to_owned(),
        ..Default::default()
    }
    .encode_to_vec();
    let dealer = raw(zmq::DEALER, &home.endpoint());
    let error = raw_error(&dealer, &[&request, &half, &half]);
    assert_eq!(error.reason(), ErrorReason::MessageTooLarge);
    assert!(
        error.message.ends_with("the limit is 65536"),
        "{}",
        error.message
    );
    let many: Vec<&[u8]> = std::iter::once(&request[..])
        .chain((0..1_100).map(|_| &b"x"[..]))
        .collect();
    assert_eq!(
        raw_error(&dealer, &many).reason(),
        ErrorReason::MessageTooLarge
    );
    // A frame beyond the limit ends that connection; no other notices.
    raw(zmq::DEALER, &home.endpoint())
        .send(vec![0_u8; 1 << 20], 0)
        .unwrap();
    let mut client = daemon.client();
    client.hello().unwrap();
    let (body, _) = add_request("c", &[("a", "")], wire::AddMode::Job);
    let frames = vec![bytes::Bytes::from(vec![0_u8; 70 << 10])];
    assert!(matches!(
        client.call(body, frames),
        Err(ClientError::TooLarge { .. })
    ));
}

#[test]
fn what_is_not_there_or_not_allowed_is_named() {
    let home = Home::new();
    let daemon = home.start();
    let client = &mut daemon.client();
    create(client, "c");
    let name = |name: &str| wire::CollectionSpec {
        name: name.to_owned(),
        ..Default::default()
    };
    let created = |spec| request::Body::CreateCollection(wire::CreateCollectionRequest { spec });
    let shape = |collection: &str| {
        let (collection, shape) = (collection.to_owned(), "s".to_owned());
        request::Body::GetShape(wire::GetShapeRequest { collection, shape })
    };
    let add = |shapes: &[(&str, &str)], collection: &str| {
        let (body, _) = add_request(collection, shapes, wire::AddMode::Job);
        body
    };
    let list = |page_token: &str, page_size| {
        let (collection, page_token) = ("c".to_owned(), page_token.to_owned());
        let label = None;
        request::Body::ListShapes(wire::ListShapesRequest {
            collection,
            page_size,
            page_token,
            label,
        })
    };
    use ErrorCode::{AlreadyExists, InvalidArgument, NotFound};
    for (body, code, reason) in [
        (shape("none"), NotFound, ErrorReason::NoCollection),
        (shape("c"), NotFound, ErrorReason::NoShape),
        (
            created(Some(name("c"))),
            AlreadyExists,
            ErrorReason::CollectionExists,
        ),
        (
            created(Some(name(""))),
            InvalidArgument,
            ErrorReason::BadName,
        ),
        (
            created(Some(name("a/b"))),
            InvalidArgument,
            ErrorReason::BadName,
        ),
        (
            created(Some(name(&"x".repeat(129)))),
            InvalidArgument,
            ErrorReason::BadName,
        ),
        (created(None), InvalidArgument, ErrorReason::FieldMissing),
        (add(&[], "c"), InvalidArgument, ErrorReason::FieldMissing),
        (
            add(&[("a", "")], "c"),
            InvalidArgument,
            ErrorReason::FrameMissing,
        ),
        (list("x", 0), InvalidArgument, ErrorReason::FieldRange),
        (list("", 1_001), InvalidArgument, ErrorReason::FieldRange),
        (
            request::Body::GetJob(wire::GetJobRequest { job_id: 99 }),
            NotFound,
            ErrorReason::NoJob,
        ),
        (
            request::Body::WaitIdle(wire::WaitIdleRequest {
                collection: String::new(),
                wait_ms: 1 << 40,
            }),
            InvalidArgument,
            ErrorReason::FieldRange,
        ),
        (
            request::Body::RemoveShape(wire::RemoveShapeRequest {
                collection: "c".to_owned(),
                shape: "s".to_owned(),
            }),
            NotFound,
            ErrorReason::NoShape,
        ),
    ] {
        let what = format!("{body:?}");
        assert_eq!(refusal(client, body), (code, reason), "{what}");
    }
}

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
    // The same mesh as a file of the same digits is the same shape.
    let job = add_again(client, "c", "arrays", &text);
    assert_eq!(
        job.items[0].placed.as_ref().unwrap().outcome(),
        Outcome::Unchanged
    );
}

/// Adds without settings of the collection.
fn add_again(client: &mut Client, collection: &str, name: &str, text: &str) -> wire::Job {
    let (body, frames) = add_request(collection, &[(name, text)], wire::AddMode::Wait);
    let request::Body::AddShapes(request) = body else {
        unreachable!()
    };
    let request = wire::AddShapesRequest {
        create: None,
        ..request
    };
    call!(client, AddShapes(request), frames, with_frames)
        .unwrap()
        .0
        .job
        .unwrap()
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
    // The same bytes again are unchanged, others under the name are not taken.
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
    let send = |daemon: &crate::harness::Daemon| {
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
    // The same id for another request is refused, not answered with the wrong reply.
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

#[test]
fn events_arrive_in_order_and_are_those_of_the_log() {
    let home = Home::new();
    let daemon = home.start();
    let client = &mut daemon.client();
    create(client, "c");
    create(client, "cc");
    let socket = client.subscribe(Some("c")).unwrap();
    socket.set_rcvtimeo(DEADLINE.as_millis() as i32).unwrap();
    let next = || {
        let frames = socket.recv_multipart(0).unwrap();
        (
            frames[0].clone(),
            wire::Event::decode(frames[1].as_slice()).unwrap(),
        )
    };
    // The first heartbeat shows that the subscription is there, and where the logs stand.
    let (topic, heartbeat) = next();
    assert_eq!(topic, b"\0");
    let Some(Kind::Heartbeat(heartbeat)) = heartbeat.kind else {
        panic!("no heartbeat")
    };
    let stands: Vec<_> = heartbeat
        .collections
        .iter()
        .map(|c| c.collection.as_str())
        .collect();
    assert_eq!(stands, ["c", "cc"]);
    add_again(client, "cc", "x", &skittle(3));
    for i in 0..3 {
        add_again(client, "c", &format!("s{i}"), &skittle(i));
    }
    wait_idle(client, "c");
    let log = events_since(client, "c");
    let mut received = Vec::new();
    while received.len() + 1 < log.len() {
        let (topic, event) = next();
        if topic == b"\0" {
            continue;
        }
        assert_eq!(topic, b"c\0");
        received.push(event);
    }
    assert!(
        log.iter()
            .enumerate()
            .all(|(i, e)| e.sequence == i as u64 + 1)
    );
    assert_eq!(received, log[1..]);
}

#[test]
fn removing_and_deleting_are_in_the_log() {
    let home = Home::new();
    let daemon = home.start();
    let client = &mut daemon.client();
    add(client, "c", &[("a", &skittle(0)), ("b", &skittle(1))]);
    let (collection, shape) = ("c".to_owned(), "a".to_owned());
    call!(
        client,
        RemoveShape(wire::RemoveShapeRequest { collection, shape })
    )
    .unwrap();
    let request = wire::DeleteCollectionRequest {
        collection: "c".to_owned(),
    };
    call!(client, DeleteCollection(request)).unwrap();
    let kinds: Vec<_> = events_since(client, "c")
        .into_iter()
        .filter_map(|e| e.kind)
        .collect();
    assert!(kinds.contains(&Kind::ShapeRemoved(wire::ShapeRemoved {
        shape: "a".to_owned()
    })));
    assert_eq!(
        kinds.last(),
        Some(&Kind::CollectionDeleted(wire::CollectionDeleted {}))
    );
    // The name can be used again, and its log goes on.
    assert_eq!(create(client, "c").sequence, kinds.len() as u64 + 1);
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
        // It was late before it was begun: then it has no effect.
        assert_eq!(refusal(client, describe("c")).1, ErrorReason::NoCollection);
        return;
    };
    wait_idle(client, "c");
    let job = call!(client, GetJob(wire::GetJobRequest { job_id }))
        .unwrap()
        .job
        .unwrap();
    assert_eq!(job.items[0].state(), ItemState::Done);
}

fn describe(collection: &str) -> request::Body {
    let collection = collection.to_owned();
    request::Body::DescribeCollection(wire::DescribeCollectionRequest { collection })
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
    let daemon = home.start_with(&[], &[("COSEG__LIMITS__MAX_QUEUED_SHAPES", "1")]);
    let client = &mut daemon.client();
    let text = skittle(0);
    let (body, frames) = add_request("c", &[("a", &text), ("b", &text)], wire::AddMode::Job);
    match client.call(body, frames) {
        Err(ClientError::Refused(e)) => {
            assert_eq!(e.code(), ErrorCode::ResourceExhausted);
            assert_eq!(e.reason(), ErrorReason::QueueFull);
            assert!(e.retry_after_ms > 0);
            assert_eq!(
                e.message,
                "0 shapes are queued and 2 more asked for, the limit is 1"
            );
        }
        other => panic!("unexpected: {:?}", other.map(|(r, _)| r)),
    }
    assert_eq!(
        add(client, "c", &[("a", &text)]).items[0].state(),
        ItemState::Done
    );
}

#[test]
fn paths_are_read_only_where_the_configuration_allows() {
    let home = Home::new();
    let allowed = home.path("allowed");
    std::fs::create_dir(&allowed).unwrap();
    std::fs::write(allowed.join("in.off"), skittle(0)).unwrap();
    let outside = home.mesh("out.off", &skittle(0));
    std::os::unix::fs::symlink(&outside, allowed.join("link.off")).unwrap();
    let roots = allowed.display().to_string();
    let daemon = home.start_with(&[], &[("COSEG__INGEST__PATHS", &roots)]);
    let client = &mut daemon.client();
    create(client, "c");
    let mut by_path = |path: String| {
        let shape = wire::ShapeInput {
            name: "a".to_owned(),
            replace: false,
            source: Some(wire::shape_input::Source::Path(path)),
        };
        let request = wire::AddShapesRequest {
            collection: "c".to_owned(),
            shapes: vec![shape],
            mode: wire::AddMode::Wait.into(),
            create: None,
        };
        call!(client, AddShapes(request))
    };
    for forbidden in [
        outside,
        format!("{roots}/../out.off"),
        format!("{roots}/link.off"),
        format!("{roots}/missing.off"),
        "in.off".to_owned(),
    ] {
        match by_path(forbidden.clone()) {
            Err(ClientError::Refused(e)) => {
                assert_eq!(e.reason(), ErrorReason::PathForbidden, "{forbidden}");
            }
            other => panic!("{forbidden}: {other:?}"),
        }
    }
    let job = by_path(format!("{roots}/in.off")).unwrap().job.unwrap();
    assert_eq!(job.items[0].state(), ItemState::Done);
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
    // In the middle: as soon as one is placed.
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

#[test]
fn term_drains_and_exits_0() {
    let home = Home::new();
    let mut daemon = home.start();
    daemon.client().hello().unwrap();
    daemon.signal(Signal::TERM);
    daemon.await_notice("STOPPING=1");
    let (status, said) = daemon.ended();
    assert_eq!(status.code(), Some(0), "{said:?}");
    assert!(!exists(home.path("s")), "the socket file is gone");
    assert!(said.iter().any(|l| l.contains("drained")), "{said:?}");
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
    let (status, said) = daemon.ended();
    assert_eq!(status.code(), Some(0), "{said:?}");
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
    // The daemon cannot get past telling the service manager that it stops: nobody reads.
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
    let limit = |daemon: &crate::harness::Daemon| {
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
    let (status, said) = home.spawn(&[], &[]).ended();
    assert_eq!(status.code(), Some(1));
    assert!(
        said.iter()
            .any(|l| l.ends_with("/s is in use by a running daemon")),
        "{said:?}"
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
        let (status, said) = home.spawn(&["--endpoint", endpoint], &[]).ended();
        assert_eq!(status.code(), Some(2), "{endpoint}: {said:?}");
        assert!(
            said.iter().any(|l| l.contains(message)),
            "{endpoint}: {said:?}"
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
    let (status, said) = daemon.ended();
    assert_eq!(status.code(), Some(0), "{said:?}");
}
