//! Implements the protocol: protobuf header frames and raw array frames over ZeroMQ, and its
//! client.
//!
//! `proto/coseg/v1` is the contract, `docs/protocol.md` explains it. [`convert`] is the only module
//! that knows both wire types and domain types.

pub mod client;
pub mod convert;
pub mod endpoint;
pub mod fields;
mod folder;
pub mod frames;
pub mod json;
pub mod keys;
pub mod size;

/// The generated messages of `proto/coseg/v1`.
#[allow(missing_docs, unreachable_pub, clippy::all, rustdoc::all)]
pub mod wire {
    include!(concat!(env!("OUT_DIR"), "/coseg.v1.rs"));
}

/// Name of the protocol, as in [`wire::HelloReply`].
pub const PROTOCOL: &str = "coseg.v1";

/// Topic of heartbeats on the event socket; see [`topic`].
pub const HEARTBEAT_TOPIC: &[u8] = b"\0";

/// Topic of a collection's events: its name and a NUL, so that no name is a prefix of another
/// topic.
pub fn topic(collection: &str) -> Vec<u8> {
    let mut topic = collection.as_bytes().to_vec();
    topic.push(0);
    topic
}
