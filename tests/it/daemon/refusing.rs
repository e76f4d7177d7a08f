//! Tests requests that are invalid regardless of the library.

use crate::harness::{Home, additions, refusal};
use coseg::ipc::client::ClientError;
use coseg::ipc::wire::{self, ErrorCode, ErrorReason, request::Body};

#[test]
fn frames_and_values_beyond_those_that_are_known_are_refused() {
    let home = Home::new();
    let daemon = home.start();
    let mut client = daemon.client();
    super::create(&mut client, "c");
    let mut stray = |body: Body, n_frames: usize| {
        let frames = vec![bytes::Bytes::from("x"); n_frames];
        match client.call(body, frames) {
            Err(ClientError::Refused(e)) => (e.code(), e.reason(), e.message),
            other => panic!("not refused: {other:?}"),
        }
    };
    let (request, _) = additions("c", &[("a", "")], wire::AddMode::Job);
    for (body, n_frames) in [
        (Body::Hello(wire::HelloRequest {}), 1),
        (Body::Stats(wire::StatsRequest {}), 3),
        (Body::AddShapes(request.clone()), 2),
    ] {
        let (code, reason, message) = stray(body, n_frames);
        let expected = (ErrorCode::InvalidArgument, ErrorReason::FrameMissing);
        assert_eq!((code, reason), expected, "{message}");
        assert!(message.contains("no field names frame"), "{message}");
    }
    let with_mode = wire::AddShapesRequest {
        mode: 99,
        ..request
    };
    let points = |orientation, n| {
        Body::GetFunctionalMap(wire::GetFunctionalMapRequest {
            points: Some(wire::PointMapOptions {
                orientation,
                landmarks: vec![wire::Landmark::default(); n],
                ..Default::default()
            }),
            ..Default::default()
        })
    };
    let spec = wire::CollectionSpec {
        up: 99,
        ..Default::default()
    };
    let create = wire::CreateCollectionRequest { spec: Some(spec) };
    let name = wire::CollectionSpec {
        name: "c\u{202e}".to_owned(),
        ..Default::default()
    };
    let hidden = wire::CreateCollectionRequest { spec: Some(name) };
    for (body, reason) in [
        (Body::CreateCollection(create), ErrorReason::FieldRange),
        (points(99, 0), ErrorReason::FieldRange),
        (points(0, 1_001), ErrorReason::FieldRange),
        (Body::CreateCollection(hidden), ErrorReason::BadName),
    ] {
        let what = format!("{body:?}");
        let expected = (ErrorCode::InvalidArgument, reason);
        assert_eq!(refusal(&mut client, body), expected, "{what}");
    }
    let frames = vec![bytes::Bytes::from("x")];
    let refused = client.call(Body::AddShapes(with_mode), frames);
    assert!(matches!(refused, Err(ClientError::Refused(e)) if e.message.contains("mode is 99")));
}
