//! Questions to a person, answers, and verdicts on shapes.

use super::corrections::corrected;
use super::errors::field_error;
use crate::ipc::frames::FrameWriter;
use crate::ipc::wire::{self, ErrorReason, answer_question_request::Answer as Wire};
use crate::library::{Answer, Answered, PartQuestion, Review, ReviewState};

/// The part to ask a person about.
pub fn question(q: &PartQuestion, frames: &mut FrameWriter) -> wire::NextQuestionReply {
    wire::NextQuestionReply {
        shape: q.shape.clone(),
        part: q.part,
        faces: Some(frames.u32_array(&q.faces, &[q.faces.len()])),
        area_share: q.area_share,
        doubt: q.doubt,
        gain: q.gain,
        likeliest: q
            .likeliest
            .iter()
            .map(|l| wire::OfferedLabel {
                label: l.label,
                name: l.name.clone().unwrap_or_default(),
                probability: l.probability,
                used: l.used,
            })
            .collect(),
        n_answered: q.n_answered,
    }
}

/// A person's answer.
pub fn answer(request: &wire::AnswerQuestionRequest) -> Result<Answer, wire::Error> {
    Ok(match &request.answer {
        Some(Wire::Label(label)) => Answer::Label(*label),
        Some(Wire::Named(name)) => Answer::Named(name.clone()),
        Some(Wire::Skip(true)) => Answer::Skip,
        Some(Wire::CutWrongly(true)) => Answer::CutWrongly,
        Some(Wire::Skip(false) | Wire::CutWrongly(false)) | None => {
            let text = "answer is missing";
            return Err(field_error(ErrorReason::FieldMissing, "answer", text));
        }
    })
}

/// What an answer did.
pub fn answered(a: &Answered) -> wire::AnswerQuestionReply {
    wire::AnswerQuestionReply {
        label: a.label,
        corrected: a.corrected.as_ref().map(corrected),
    }
}

/// The state of a verdict.
fn review_state(state: ReviewState) -> wire::ReviewState {
    match state {
        ReviewState::Unseen => wire::ReviewState::Unseen,
        ReviewState::Corrected => wire::ReviewState::Corrected,
        ReviewState::Approved => wire::ReviewState::Approved,
        ReviewState::Doubtful => wire::ReviewState::Doubtful,
    }
}

/// The verdict that a request wants; `None`: any.
pub fn wanted_review(state: wire::ReviewState) -> Option<ReviewState> {
    match state {
        wire::ReviewState::Unspecified => None,
        wire::ReviewState::Unseen => Some(ReviewState::Unseen),
        wire::ReviewState::Corrected => Some(ReviewState::Corrected),
        wire::ReviewState::Approved => Some(ReviewState::Approved),
        wire::ReviewState::Doubtful => Some(ReviewState::Doubtful),
    }
}

/// A verdict with who gave it and when.
pub fn review(r: &Review) -> wire::Review {
    wire::Review {
        state: review_state(r.state).into(),
        by: r.by.clone(),
        unix_ms: r.unix_ms,
    }
}
