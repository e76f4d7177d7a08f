//! `coseg correct` sends a person's labels of a shape, which the daemon propagates to all others.

use super::session::Session;
use super::{CommandError, Outcome, label_file};
use crate::cli::Correct;
use bytes::Bytes;
use coseg::call;
use coseg::ipc::frames::FrameWriter;
use coseg::ipc::wire::{self, correct_labels_request::Correction};
use coseg::text::counted;
use serde_json::json;
use std::time::Instant;

pub(crate) fn run(args: &Correct, mut session: Session) -> Outcome {
    let collection = session.collection(&args.within)?;
    let mut frames = FrameWriter::default();
    let correction = match (&args.labels, args.part, &args.label) {
        (Some(path), ..) => {
            let labels = label_file::read(path)?;
            let request = wire::GetShapeRequest {
                collection: collection.clone(),
                shape: args.shape.clone(),
            };
            let shape = call!(session.client, GetShape(request))?.shape;
            let n_faces = shape.unwrap_or_default().n_polygons;
            if labels.len() as u64 != n_faces {
                return Err(CommandError::Failed(format!(
                    "{} has {}, but shape {:?} has {}",
                    path.display(),
                    counted(labels.len() as u64, "label"),
                    args.shape,
                    counted(n_faces, "face")
                )));
            }
            Correction::Labels(frames.i32_array(&labels, &[labels.len()]))
        }
        (None, Some(part), Some(label)) => {
            let label = session.label(&collection, label)?;
            Correction::Part(wire::LabelledPart { part, label })
        }
        (None, ..) => unreachable!("invariant: clap requires a file, or part and label"),
    };
    let request = wire::CorrectLabelsRequest {
        collection: collection.clone(),
        shape: args.shape.clone(),
        correction: Some(correction),
        by: args.person.name(),
        closed: match (args.closed, args.open) {
            (true, _) => Some(true),
            (_, true) => Some(false),
            (false, false) => None,
        },
    };
    let frames: Vec<Bytes> = frames.finish();
    let begin = Instant::now();
    let elapsed_ms = || begin.elapsed().as_secs_f64() * 1e3;
    let done = call!(session.client, CorrectLabels(request), frames, with_frames)?.0;
    let first_ms = elapsed_ms();
    let mut all_ms = None;
    if !args.no_wait {
        session.wait_until_idle(&collection)?;
        all_ms = Some(elapsed_ms());
    }
    if session.json {
        session.print_json(&json!({
            "shape": args.shape,
            "version": done.version,
            "sequence": done.sequence,
            "n_faces": done.n_faces,
            "area_share": done.area_share,
            "changed_share": done.changed_share,
            "n_shapes": done.n_stale,
            "job_id": done.job_id,
            "first_ms": first_ms,
            "all_ms": all_ms,
        }))?;
    } else {
        let propagated = if args.no_wait {
            "to be propagated"
        } else {
            "propagated"
        };
        eprintln!(
            "{}: {:.1} % of its area changed; {propagated} to {}",
            args.shape,
            100.0 * done.changed_share,
            counted(done.n_stale, "shape")
        );
    }
    Ok(true)
}
