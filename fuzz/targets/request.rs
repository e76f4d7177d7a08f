//! A request as a client may send it, written as tests/golden has it: header and frames, each after
//! its length.
#![no_main]

use bytes::Bytes;
use coseg::ipc::convert;
use coseg::ipc::frames::FrameReader;
use coseg::ipc::wire::{Request, request::Body};
use libfuzzer_sys::fuzz_target;
use prost::Message as _;

fn split(mut bytes: &[u8]) -> Vec<Bytes> {
    let mut frames = Vec::new();
    while let Some((length, rest)) = bytes.split_first_chunk::<4>() {
        let n = rest.len().min(u32::from_le_bytes(*length) as usize);
        frames.push(Bytes::copy_from_slice(&rest[..n]));
        bytes = &rest[n..];
    }
    frames
}

fuzz_target!(|bytes: &[u8]| {
    let mut frames = split(bytes);
    if frames.is_empty() {
        return;
    }
    let header = frames.remove(0);
    let Ok(request) = Request::decode(header) else {
        return;
    };
    let ingest = convert::Ingest {
        max_shapes: 16,
        max_shape_bytes: 1 << 20,
        read_path: &|_| Ok(Vec::new()),
    };
    match request.body {
        Some(Body::AddShapes(r)) => {
            let _ = convert::new_shapes(&r, FrameReader::new(&frames), &ingest);
        }
        Some(Body::CorrectLabels(r)) => {
            let _ = convert::correction(&r, FrameReader::new(&frames));
        }
        Some(Body::CreateCollection(r)) => {
            if let Some(spec) = &r.spec {
                let _ = convert::collection_spec(spec, "spec");
            }
        }
        _ => {}
    }
});
