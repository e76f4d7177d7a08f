//! Tests the daemon over its real sockets.

mod adding;
mod answering;
mod asking;
mod correcting;
mod flood;
mod http_abuse;
mod isolation;
mod life;
mod linking;
mod overload;
mod paths;
mod proposing;
mod publishing;
mod refusing;
mod repeats;
mod resident;
mod security;
mod stages;
mod stopped;
mod upright;

use crate::harness::{DEADLINE, Home, add, add_request, additions, refusal, skittle, wait_idle};
use coseg::call;
use coseg::ipc::client::{Client, ClientError};
use coseg::ipc::wire::{
    self, ErrorCode, ErrorReason, Reply, Request, error::Subject, event::Kind, reply, request,
};
use prost::Message as _;

/// A socket that sends arbitrary frames.
fn raw(kind: zmq::SocketType, endpoint: &str) -> zmq::Socket {
    let socket = zmq::Context::new().socket(kind).unwrap();
    socket.set_linger(0).unwrap();
    socket.set_rcvtimeo(DEADLINE.as_millis() as i32).unwrap();
    socket.connect(endpoint).unwrap();
    socket
}

/// The proposals of a collection, once they are those for its present labels.
fn proposals(client: &mut Client, collection: &str) -> wire::ListProposalsReply {
    let begin = std::time::Instant::now();
    loop {
        let collection = collection.to_owned();
        let request = wire::ListProposalsRequest { collection };
        let found = call!(client, ListProposals(request)).unwrap();
        if found.n_steps == 0 {
            return found;
        }
        assert!(begin.elapsed() < 4 * DEADLINE, "{found:?}");
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
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
    create_with(client, name, 0)
}

fn create_with(client: &mut Client, name: &str, n_parts: u32) -> wire::Collection {
    let spec = wire::CollectionSpec {
        name: name.to_owned(),
        n_parts: Some(n_parts),
        ..Default::default()
    };
    let request = wire::CreateCollectionRequest { spec: Some(spec) };
    call!(client, CreateCollection(request))
        .unwrap()
        .collection
        .unwrap()
}

fn events_since(client: &mut Client, collection: &str) -> Vec<wire::Event> {
    events_after(client, collection, 0)
}

fn events_after(client: &mut Client, collection: &str, sequence: u64) -> Vec<wire::Event> {
    let request = wire::EventsSinceRequest {
        collection: collection.to_owned(),
        sequence,
        limit: 0,
    };
    call!(client, EventsSince(request)).unwrap().events
}

/// Adds shapes without settings of the collection.
fn add_again(client: &mut Client, collection: &str, name: &str, text: &str) -> wire::Job {
    let (request, frames) = additions(collection, &[(name, text)], wire::AddMode::Wait);
    call!(client, AddShapes(request), frames, with_frames)
        .unwrap()
        .0
        .job
        .unwrap()
}

fn describe(collection: &str) -> request::Body {
    let collection = collection.to_owned();
    request::Body::DescribeCollection(wire::DescribeCollectionRequest { collection })
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
        [
            wire::MeshFormat::Obj as i32,
            wire::MeshFormat::Off as i32,
            wire::MeshFormat::Ply as i32,
            wire::MeshFormat::Stl as i32,
            wire::MeshFormat::Gltf as i32,
        ]
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
    // Nested length-delimited fields with unknown numbers.
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
        error
            .message
            .contains("the limit is 64 KiB (limits.max_message"),
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
    // A frame beyond the limit ends that connection; others are not affected.
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
            review: 0,
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
    // The first heartbeat shows that the subscription works, and the ends of the logs.
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
    let begin = std::time::Instant::now();
    while received.len() + 1 < log.len() {
        assert!(
            begin.elapsed() < DEADLINE,
            "{} of {}",
            received.len() + 1,
            log.len()
        );
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
    // The name can be used again, and its log continues.
    assert_eq!(create(client, "c").sequence, kinds.len() as u64 + 1);
}
