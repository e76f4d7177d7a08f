//! Converts corrections and their results.

use super::errors::{field_error, frame_error};
use crate::ipc::frames::FrameReader;
use crate::ipc::wire::{self, ErrorReason, correct_labels_request::Correction as Wire};
use crate::library::{Corrected, Correction, Suggestion, Undone};

/// The labels of a shape in a request.
pub fn correction(
    request: &wire::CorrectLabelsRequest,
    frames: FrameReader<'_>,
) -> Result<Correction, wire::Error> {
    let one_axis = |field: &str, extents: &[usize]| match extents {
        [_] => Ok(()),
        _ => {
            let text = format!("{field} has {} axes, but must have 1", extents.len());
            Err(field_error(ErrorReason::FieldRange, field, text))
        }
    };
    match &request.correction {
        None => Err(field_error(
            ErrorReason::FieldMissing,
            "correction",
            "correction is missing",
        )),
        Some(Wire::Labels(labels)) => {
            let read = frames.i32_array(Some(labels), "labels");
            let (labels, extents) = read.map_err(|e| frame_error(&e))?;
            one_axis("labels", &extents)?;
            Ok(Correction::Whole(labels))
        }
        Some(Wire::Faces(faces)) => {
            let read = frames.u32_array(faces.faces.as_ref(), "faces.faces");
            let (indices, extents) = read.map_err(|e| frame_error(&e))?;
            one_axis("faces.faces", &extents)?;
            Ok(Correction::Faces {
                faces: indices,
                label: faces.label,
            })
        }
        Some(Wire::Part(part)) => Ok(Correction::Part {
            part: part.part,
            label: part.label,
        }),
    }
}

/// The result of a correction.
pub fn corrected(c: &Corrected) -> wire::CorrectLabelsReply {
    wire::CorrectLabelsReply {
        version: c.version,
        sequence: c.sequence,
        n_faces: c.n_faces,
        area_share: c.area_share,
        changed_share: c.changed_share,
        n_stale: c.n_stale,
        job_id: c.job,
    }
}

/// The result of an undo.
pub fn undone(u: &Undone) -> wire::UndoReply {
    wire::UndoReply {
        change: u.change.clone(),
        n_left: u.n_left,
        sequence: u.sequence,
        subject: u.subject.clone(),
    }
}

/// The shape to label next.
pub fn suggested(s: &Suggestion) -> wire::SuggestNextReply {
    wire::SuggestNextReply {
        shape: s.shape.clone(),
        gain: s.gain,
        uncertainty: s.uncertainty,
        n_nearest: s.n_nearest,
        reason: s.reason.clone(),
        n_corrected: s.n_corrected,
    }
}
