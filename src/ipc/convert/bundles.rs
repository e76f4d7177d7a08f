//! Converts the heads of bundles.

use super::errors::field_error;
use crate::ipc::frames::{FrameReader, FrameWriter};
use crate::ipc::wire::{self, ErrorReason};
use crate::library::{BundleFile, BundleHead};
use crate::store::Digest;

/// The head of a bundle.
pub fn bundle_head(head: BundleHead, frames: &mut FrameWriter) -> wire::PublishReply {
    let files = head.files.into_iter().map(|f| wire::BundleFile {
        shape: f.shape,
        blake3: f.blake3.to_string(),
        length: f.length,
    });
    wire::PublishReply {
        files: files.collect(),
        head: Some(frames.file(head.bytes)),
        bundle: head.id.to_string(),
        sequence: head.sequence,
        epoch: head.epoch,
        n_bytes: head.n_bytes,
        clusters_next: head.clusters_next,
    }
}

/// The head of a bundle in a reply; an error says what is wrong with it.
pub fn bundle_head_from_wire(
    reply: wire::PublishReply,
    frames: &FrameReader<'_>,
) -> Result<BundleHead, String> {
    let bytes = frames.file(reply.head.as_ref(), "head");
    let digest = |text: &str| {
        let parsed = text.parse::<Digest>();
        parsed.map_err(|e| format!("{text:?} is no digest: {e}"))
    };
    let files = reply.files.into_iter().map(|f| {
        Ok(BundleFile {
            blake3: digest(&f.blake3)?,
            shape: f.shape,
            length: f.length,
        })
    });
    Ok(BundleHead {
        bytes: bytes.map_err(|e| e.to_string())?.to_vec(),
        files: files.collect::<Result<_, String>>()?,
        id: digest(&reply.bundle)?,
        sequence: reply.sequence,
        epoch: reply.epoch,
        n_bytes: reply.n_bytes,
        clusters_next: reply.clusters_next,
    })
}

/// The digest of a requested array file.
pub fn array_file_digest(request: &wire::GetArrayFileRequest) -> Result<Digest, wire::Error> {
    request.blake3.parse().map_err(|_| {
        let text = "blake3 is not 64 lower-case hexadecimal digits";
        field_error(ErrorReason::FieldRange, "blake3", text)
    })
}
