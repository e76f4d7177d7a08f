//! Reports of workers, as the daemon reads them.

use crate::daemon::answer::Answer;
use crate::daemon::failures::panicked;
use crate::ipc::wire::{self, reply};
use crate::library::{self, Failure, ItemState, LibraryError};
use crate::store::StoreError;
use bytes::Bytes;
use prost::Message as _;
use serde_json::{Value, json};

/// The outcome of work that needs the library.
#[derive(Debug)]
pub(crate) enum Outcome {
    /// The shape is placed, or finished otherwise.
    State(ItemState),
    /// How many stale shapes were relabelled.
    Relabelled(u64),
    /// Whether a step towards proposals was made.
    Proposed(bool),
    /// The library refused or failed.
    Failed(Failure),
}

/// The report of a worker that places or relabels.
#[derive(Debug)]
pub(crate) enum Report {
    Outcome(Outcome),
    /// The disk is full: nothing was changed.
    NoSpace(String),
    /// A sync failed in the worker, which ends the writing of the daemon too.
    ReadOnly(String),
}

/// The report that a shape was placed, or is finished otherwise.
pub(super) fn placed(state: &ItemState) -> Value {
    json!({ "state": library::state_to_json(state) })
}

/// The report of how many shapes were relabelled.
pub(super) fn relabelled(n_shapes: usize) -> Value {
    json!({ "relabelled": n_shapes })
}

/// The report of whether a step towards proposals was made.
pub(super) fn proposed(was_made: bool) -> Value {
    json!({ "proposed": was_made })
}

/// The report of a panic.
pub(super) fn panic(text: &str) -> Value {
    json!({ "panic": text })
}

/// The report of an error of the library.
pub(super) fn refusal(error: &LibraryError) -> Value {
    match error {
        LibraryError::Store(StoreError::NoSpace { path }) => json!({ "no_space": path }),
        LibraryError::Store(StoreError::ReadOnly { cause, .. }) => json!({ "read_only": cause }),
        other => json!({ "error": Failure::from(other) }),
    }
}

/// Reads a report. The error is for people.
pub(crate) fn read_report(report: &Value) -> Result<Report, String> {
    let text = |name: &str| report[name].as_str().map(str::to_owned);
    if let Some(path) = text("no_space") {
        return Ok(Report::NoSpace(path));
    }
    if let Some(cause) = text("read_only") {
        return Ok(Report::ReadOnly(cause));
    }
    let bad = |e: &dyn std::fmt::Display| format!("a worker reported {report}: {e}");
    Ok(Report::Outcome(
        if let Some(n_shapes) = report["relabelled"].as_u64() {
            Outcome::Relabelled(n_shapes)
        } else if let Some(was_made) = report["proposed"].as_bool() {
            Outcome::Proposed(was_made)
        } else if let Some(text) = text("panic") {
            Outcome::Failed(panicked(&text))
        } else if let Some(failure) = report.get("error") {
            Outcome::Failed(serde_json::from_value(failure.clone()).map_err(|e| bad(&e))?)
        } else {
            Outcome::State(library::state_from_json(&report["state"]).map_err(|e| bad(&e))?)
        },
    ))
}

/// Reads the pieces of an answer: why the library must not be written any more (if so), and the
/// answer. The error is for people.
pub(crate) fn read_answer(mut pieces: Vec<Bytes>) -> Result<(Option<String>, Answer), String> {
    if pieces.len() < 2 {
        return Err(format!("a worker sent {} pieces", pieces.len()));
    }
    let frames = pieces.split_off(2);
    let cause = String::from_utf8_lossy(&pieces[0]).into_owned();
    let reply = wire::Reply::decode(pieces.remove(1)).map_err(|e| e.to_string())?;
    let answer = match reply.result {
        Some(reply::Result::Error(error)) => Err(error),
        Some(result) => Ok((result, frames)),
        None => return Err("a worker sent a reply without a result".to_owned()),
    };
    Ok((Some(cause).filter(|c| !c.is_empty()), answer))
}
