//! `coseg correct`: a person's labels of a shape, carried to all others.

use super::session::Session;
use super::{CommandError, Outcome};
use crate::cli::Correct;
use bytes::Bytes;
use coseg::call;
use coseg::ipc::frames::FrameWriter;
use coseg::ipc::wire::{self, correct_labels_request::Correction};
use coseg::library::MAX_LABEL;
use serde_json::json;
use std::path::Path;

pub(crate) fn run(args: &Correct, mut session: Session) -> Outcome {
    let collection = session.collection(&args.within)?;
    let mut frames = FrameWriter::default();
    let correction = match (&args.labels, args.part, &args.label) {
        (Some(path), ..) => {
            let labels = read(path)?;
            let request = wire::GetShapeRequest {
                collection: collection.clone(),
                shape: args.shape.clone(),
            };
            let shape = call!(session.client, GetShape(request))?.shape;
            let n_faces = shape.unwrap_or_default().n_polygons;
            if labels.len() as u64 != n_faces {
                return Err(CommandError::Failed(format!(
                    "{} has {} labels, but shape {:?} has {n_faces} faces",
                    path.display(),
                    labels.len(),
                    args.shape
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
    };
    let frames: Vec<Bytes> = frames.finish();
    let done = call!(session.client, CorrectLabels(request), frames, with_frames)?.0;
    if !args.no_wait {
        session.wait_until_idle(&collection)?;
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
        }))?;
    } else {
        let carried = if args.no_wait {
            "to be carried"
        } else {
            "carried"
        };
        eprintln!(
            "{}: {:.1} % of its area changed; {carried} to {} shapes",
            args.shape,
            100.0 * done.changed_share,
            done.n_stale
        );
    }
    Ok(true)
}

/// The labels in a file, one a line.
fn read(path: &Path) -> Result<Vec<i32>, CommandError> {
    let text = std::fs::read_to_string(path).map_err(|source| CommandError::File {
        path: path.display().to_string(),
        source,
    })?;
    labels_of(&text).map_err(|why| CommandError::Failed(format!("{}: {why}", path.display())))
}

fn labels_of(text: &str) -> Result<Vec<i32>, String> {
    let mut labels = Vec::new();
    for (i, line) in text.lines().enumerate() {
        let word = line.trim();
        let number = i + 1;
        let label: i64 = word
            .parse()
            .map_err(|_| format!("line {number} is {word:?}, but must be an integer"))?;
        if !(-1..=i64::from(MAX_LABEL)).contains(&label) {
            return Err(format!(
                "line {number} is {label}, but must be -1 to {MAX_LABEL}"
            ));
        }
        labels.push(label as i32);
    }
    Ok(labels)
}

#[cfg(test)]
mod tests {
    use super::labels_of;

    #[test]
    fn labels_are_one_a_line() {
        assert_eq!(labels_of("3\n-1\n 65535 \n"), Ok(vec![3, -1, 65_535]));
        assert_eq!(labels_of(""), Ok(vec![]));
    }

    #[test]
    fn what_is_no_label_is_named_with_its_line_and_the_limit() {
        for (text, message) in [
            ("1\nx\n", "line 2 is \"x\", but must be an integer"),
            ("1\n\n2\n", "line 2 is \"\", but must be an integer"),
            ("-2\n", "line 1 is -2, but must be -1 to 65535"),
            ("0\n65536", "line 2 is 65536, but must be -1 to 65535"),
            ("1.5", "line 1 is \"1.5\", but must be an integer"),
        ] {
            assert_eq!(labels_of(text).unwrap_err(), message);
        }
    }
}
