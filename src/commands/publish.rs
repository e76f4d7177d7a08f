//! `coseg publish` writes everything that labels new shapes of a collection to one file, which
//! `coseg label` reads.

use super::export::bad_reply;
use super::session::{Session, bar};
use super::{CommandError, Outcome};
use crate::cli::Publish;
use coseg::call;
use coseg::ipc::client::ClientError;
use coseg::ipc::convert::bundle_head_from_wire;
use coseg::ipc::frames::FrameReader;
use coseg::ipc::wire;
use coseg::library::{ArrayFile, Bundle, BundleFile, write_bundle};
use coseg::text::counted;
use serde_json::json;

pub(crate) fn run(args: &Publish, mut session: Session) -> Outcome {
    let collection = session.settled_collection(&args.of, args.no_wait)?;
    let request = wire::PublishRequest {
        collection: collection.clone(),
    };
    let (reply, frames) = call!(session.client, Publish(request), frames)?;
    let head = bundle_head_from_wire(reply, &FrameReader::new(&frames)).map_err(bad_reply)?;
    drop(frames);
    let progress = bar(head.files.len() as u64);
    write_bundle(&args.out, &head, |file| {
        progress.set_message(file.shape.clone());
        let bytes = receive(&mut session, &collection, file);
        progress.inc(1);
        bytes
    })?;
    progress.finish_and_clear();
    // Whoever gets the file shall not be the first to find that it cannot be read.
    let bundle = Bundle::open(&args.out)?;
    let info = bundle.info();
    if session.json {
        session.print_json(&json!({
            "collection": collection,
            "file": args.out.display().to_string(),
            "bundle": info.id.to_string(),
            "sequence": info.sequence,
            "epoch": info.epoch,
            "n_shapes": info.n_shapes,
            "n_bundled": info.n_bundled,
            "n_bytes": head.n_bytes,
            "clusters_next": info.clusters_next,
        }))?;
    } else {
        let megabytes = head.n_bytes as f64 / 1e6;
        let shapes = counted(info.n_bundled as u64, "shape");
        eprintln!(
            "{collection} at sequence {} written to {}: {shapes} that may vote, {megabytes:.1} MB",
            info.sequence,
            args.out.display(),
        );
    }
    if info.clusters_next {
        eprintln!(
            "coseg: the next shape clusters {collection:?} again, so labelling by this bundle \
             takes some seconds for each shape and can find labels that {collection:?} does not \
             have; add a shape, choose a proposal or correct a shape, and publish it then"
        );
    }
    Ok(true)
}

fn receive(
    session: &mut Session,
    collection: &str,
    file: &BundleFile,
) -> Result<ArrayFile, CommandError> {
    let request = wire::GetArrayFileRequest {
        collection: collection.to_owned(),
        shape: file.shape.clone(),
        blake3: file.blake3.to_string(),
    };
    let (reply, frames) = call!(session.client, GetArrayFile(request), frames)?;
    let bytes = FrameReader::new(&frames).file(reply.bytes.as_ref(), "bytes");
    let bytes = bytes.map_err(|e| ClientError::BadReply(e.to_string()))?;
    Ok(bytes.clone())
}
