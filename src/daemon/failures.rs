//! Why the work on a shape, or on a request, failed in its worker.

use crate::library::{Code, Failure, Reason};
use std::time::Duration;

pub(crate) fn failed(code: Code, reason: Reason, message: String) -> Failure {
    Failure {
        code,
        reason,
        message,
        subject: None,
    }
}

pub(crate) fn cancelled() -> Failure {
    let message = "the job was cancelled before this shape was placed".to_owned();
    failed(Code::Cancelled, Reason::Cancelled, message)
}

pub(crate) fn too_long(doing: &str, took: Duration, limit: Duration) -> Failure {
    let (found, limit) = (took.as_secs_f64(), limit.as_secs());
    let message = format!("{doing} it took {found:.0} s, the limit is {limit} s");
    failed(Code::DeadlineExceeded, Reason::ShapeTimeout, message)
}

/// The work ended its worker.
pub(crate) fn died(what: &str, text: &str, out_of_memory: bool) -> Failure {
    let (code, reason) = match out_of_memory {
        true => (Code::ResourceExhausted, Reason::ShapeMemory),
        false => (Code::Internal, Reason::WorkerDied),
    };
    failed(code, reason, format!("{what}: {text}"))
}

/// The last attempt at a shape ended its worker like the others.
pub(crate) fn died_each_time(text: &str, out_of_memory: bool, attempts: u32) -> Failure {
    let what = format!("the work on this shape ended its process {attempts} times, the last time");
    died(&what, text, out_of_memory)
}

/// The work on a shape panicked, perhaps for lack of memory.
pub(crate) fn panicked(text: &str) -> Failure {
    let out_of_memory = ["AllocError", "out of memory"]
        .iter()
        .any(|sign| text.contains(sign));
    let (code, reason) = match out_of_memory {
        true => (Code::ResourceExhausted, Reason::ShapeMemory),
        false => (Code::Internal, Reason::Panic),
    };
    failed(
        code,
        reason,
        format!("the work on this shape panicked: {text}"),
    )
}
