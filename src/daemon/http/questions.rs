//! What the viewer sends and shows of questions, answers and verdicts.

use crate::ipc::convert;
use crate::ipc::frames::FrameReader;
use crate::ipc::json;
use crate::ipc::wire::{self, ErrorReason, answer_question_request::Answer};
use bytes::Bytes;
use serde::Deserialize;
use serde_json::{Value, json};

/// The body of `POST /api/answer`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct AnswerBody {
    collection: String,
    shape: String,
    part: u32,
    label: Option<u32>,
    named: Option<String>,
    #[serde(default)]
    skip: bool,
    #[serde(default)]
    cut_wrongly: bool,
    #[serde(default)]
    by: String,
}

impl AnswerBody {
    /// The request; its body must have one answer.
    pub(super) fn request(self) -> Result<wire::AnswerQuestionRequest, wire::Error> {
        let answers = [
            self.label.map(Answer::Label),
            self.named.map(Answer::Named),
            self.skip.then_some(Answer::Skip(true)),
            self.cut_wrongly.then_some(Answer::CutWrongly(true)),
        ];
        let mut given: Vec<Answer> = answers.into_iter().flatten().collect();
        let answer = given.pop().filter(|_| given.is_empty());
        if answer.is_none() {
            let message = "one of label, named, skip and cut_wrongly is needed".to_owned();
            return Err(convert::field_error(
                ErrorReason::FieldMissing,
                "label",
                message,
            ));
        }
        Ok(wire::AnswerQuestionRequest {
            collection: self.collection,
            shape: self.shape,
            part: self.part,
            answer,
            by: self.by,
        })
    }
}

/// The body of `POST /api/review`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ReviewBody {
    collection: String,
    shape: String,
    state: String,
    #[serde(default)]
    by: String,
}

impl ReviewBody {
    /// The request.
    pub(super) fn request(self) -> Result<wire::ReviewShapeRequest, wire::Error> {
        let state = match self.state.as_str() {
            "approved" => wire::ReviewState::Approved,
            "doubtful" => wire::ReviewState::Doubtful,
            other => {
                let message = format!("state is {other:?}, not approved or doubtful");
                return Err(convert::field_error(
                    ErrorReason::FieldRange,
                    "state",
                    message,
                ));
            }
        };
        Ok(wire::ReviewShapeRequest {
            collection: self.collection,
            shape: self.shape,
            state: state.into(),
            by: self.by,
        })
    }
}

/// A question as the page shows it.
pub(super) fn question(
    q: &wire::NextQuestionReply,
    frames: &[Bytes],
) -> Result<Value, wire::Error> {
    let faces = FrameReader::new(frames).u32_array(q.faces.as_ref(), "faces");
    let (faces, _) = faces.map_err(|e| convert::frame_error(&e))?;
    Ok(json::question(q, &faces))
}

/// What an answer did.
pub(super) fn answered(reply: &wire::AnswerQuestionReply) -> Value {
    json!({
        "label": reply.label,
        "corrected": reply.corrected.as_ref().map(json::corrected),
    })
}
