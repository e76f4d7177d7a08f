//! `coseg labels` prints a label for each face of a shape's file.

use super::session::Session;
use super::{CommandError, Outcome};
use crate::cli::Labels;
use coseg::call;
use coseg::ipc::client::ClientError;
use coseg::ipc::frames::FrameReader;
use coseg::ipc::wire;
use serde_json::json;

/// Labels of one shape, as received.
pub(crate) struct Received {
    pub(crate) version: u64,
    pub(crate) labels: Vec<i32>,
    pub(crate) confidence: Option<Vec<f32>>,
}

/// Requests the labels of a shape; version 0 is the newest.
pub(crate) fn receive(
    session: &mut Session,
    request: wire::GetLabelsRequest,
) -> Result<Received, CommandError> {
    let (reply, frames) = call!(session.client, GetLabels(request), frames)?;
    let reader = FrameReader::new(&frames);
    let bad = |e: coseg::ipc::frames::FrameError| ClientError::BadReply(e.to_string());
    let (labels, _) = reader
        .i32_array(reply.labels.as_ref(), "labels")
        .map_err(bad)?;
    let confidence = reply.confidence.as_ref();
    let confidence = confidence
        .map(|c| {
            reader
                .f32_array(Some(c), "confidence")
                .map(|(values, _)| values)
        })
        .transpose()
        .map_err(bad)?;
    Ok(Received {
        version: reply.version,
        labels,
        confidence,
    })
}

fn wanted(args: &Labels, session: &mut Session) -> Result<Received, CommandError> {
    let collection = session.collection(&args.within)?;
    if !args.no_wait {
        session.wait_until_idle(&collection)?;
    }
    let request = wire::GetLabelsRequest {
        collection,
        shape: args.shape.clone(),
        version: args.version.unwrap_or(0),
        confidence: args.confidence,
    };
    receive(session, request)
}

pub(crate) fn run(args: &Labels, mut session: Session) -> Outcome {
    let received = wanted(args, &mut session);
    let received = received.map_err(|e| session.explain_shape(e, &args.shape))?;
    if session.json {
        let mut value = json!({
            "shape": args.shape,
            "version": received.version,
            "labels": received.labels,
        });
        if let Some(confidence) = received.confidence {
            value["confidence"] = confidence.into();
        }
        session.print_json(&value)?;
        return Ok(true);
    }
    let lines: Vec<String> = match &received.confidence {
        Some(c) => received
            .labels
            .iter()
            .zip(c)
            .map(|(l, c)| format!("{l} {c:.3}"))
            .collect(),
        None => received.labels.iter().map(i32::to_string).collect(),
    };
    if !lines.is_empty() {
        session.line(&lines.join("\n"))?;
    }
    Ok(true)
}
