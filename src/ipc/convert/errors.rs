//! Converts failures of the library and of decoding to wire errors.

use crate::ipc::frames::FrameError;
use crate::ipc::wire::{Error, ErrorCode, ErrorReason, error::Subject};
use crate::library::{Failure, FailureSubject, LibraryError};
use crate::store::StoreError;

/// Maximum number of characters of an error's message.
const MAX_MESSAGE_CHARS: usize = 2_000;

/// Milliseconds after which a request may be retried on a full disk.
const DISK_FULL_RETRY_MS: u64 = 10_000;

/// An error without subject or retry delay.
pub fn error(code: ErrorCode, reason: ErrorReason, message: impl Into<String>) -> Error {
    let mut message = message.into();
    // A name sent by a client may be as long as its message.
    if let Some((end, _)) = message.char_indices().nth(MAX_MESSAGE_CHARS) {
        message.truncate(end);
        message.push('…');
    }
    Error {
        code: code.into(),
        reason: reason.into(),
        message,
        retry_after_ms: 0,
        subject: None,
    }
}

/// Adds `subject` to an error.
pub fn with_subject(mut error: Error, subject: Subject) -> Error {
    error.subject = Some(subject);
    error
}

/// The error INVALID_ARGUMENT for one field of the request.
pub fn field_error(reason: ErrorReason, field: &str, message: impl Into<String>) -> Error {
    let error = error(ErrorCode::InvalidArgument, reason, message);
    with_subject(error, Subject::Field(field.to_owned()))
}

/// The error for a message or an array that cannot be used.
pub fn frame_error(e: &FrameError) -> Error {
    let wire = error(ErrorCode::InvalidArgument, e.reason(), e.to_string());
    match e.field() {
        Some(field) => with_subject(wire, Subject::Field(field.to_owned())),
        None => wire,
    }
}

/// The reason with this stable name. A reason that this version of the protocol lacks stays
/// unspecified; the message describes it.
fn reason(name: &str) -> ErrorReason {
    ErrorReason::from_str_name(&format!("ERROR_REASON_{name}")).unwrap_or(ErrorReason::Unspecified)
}

/// The error for a failed operation of the library.
pub fn library_error(e: &LibraryError) -> Error {
    let message = e.to_string();
    match e {
        LibraryError::InvalidArgument { reason: name, .. } => {
            error(ErrorCode::InvalidArgument, reason(name), message)
        }
        LibraryError::InvalidFace {
            reason: name,
            subject: place,
            ..
        } => with_subject(
            error(ErrorCode::InvalidArgument, reason(name), message),
            subject(*place),
        ),
        LibraryError::NotFound { what, .. } => {
            let reason = match *what {
                "collection" => ErrorReason::NoCollection,
                "shape" => ErrorReason::NoShape,
                "label" => ErrorReason::NoLabel,
                "job" => ErrorReason::NoJob,
                "version" => ErrorReason::NoVersion,
                _ => ErrorReason::Unspecified,
            };
            error(ErrorCode::NotFound, reason, message)
        }
        LibraryError::AlreadyExists { reason: name, .. } => {
            error(ErrorCode::AlreadyExists, reason(name), message)
        }
        LibraryError::FailedPrecondition { reason: name, .. } => {
            error(ErrorCode::FailedPrecondition, reason(name), message)
        }
        LibraryError::Refused(why) => failure(why),
        LibraryError::Store(e) => store_error(e, message),
    }
}

fn store_error(e: &StoreError, message: String) -> Error {
    match e {
        StoreError::NoSpace { .. } => Error {
            retry_after_ms: DISK_FULL_RETRY_MS,
            ..error(ErrorCode::ResourceExhausted, ErrorReason::NoSpace, message)
        },
        StoreError::ReadOnly { .. } => error(
            ErrorCode::FailedPrecondition,
            ErrorReason::ReadOnly,
            message,
        ),
        e if e.is_damage() => error(ErrorCode::DataLoss, ErrorReason::Damaged, message),
        _ => error(ErrorCode::Internal, ErrorReason::Store, message),
    }
}

/// The error for a failed shape of a job.
pub fn failure(f: &Failure) -> Error {
    let code = ErrorCode::from_str_name(&format!("ERROR_CODE_{}", f.code));
    let error = error(
        code.unwrap_or(ErrorCode::Internal),
        reason(&f.reason),
        f.message.clone(),
    );
    Error {
        subject: f.subject.map(subject),
        ..error
    }
}

fn subject(place: FailureSubject) -> Subject {
    match place {
        FailureSubject::Face(i) => Subject::Face(i),
        FailureSubject::Vertex(i) => Subject::Vertex(i),
        FailureSubject::Line(i) => Subject::Line(i),
    }
}

/// The failure of a shape that the library refused to place.
pub fn library_failure(e: &LibraryError) -> Failure {
    let wire = library_error(e);
    let strip = |name: &'static str, prefix| name.strip_prefix(prefix).unwrap_or(name).to_owned();
    Failure {
        code: strip(wire.code().as_str_name(), "ERROR_CODE_"),
        reason: strip(wire.reason().as_str_name(), "ERROR_REASON_"),
        message: wire.message,
        subject: None,
    }
}

#[cfg(test)]
mod tests {
    use super::{ErrorCode, ErrorReason, failure, library_error};
    use crate::library::{Failure, LibraryError};

    #[test]
    fn library_errors_keep_code_reason_and_message() {
        let e = library_error(&LibraryError::InvalidArgument {
            reason: "BAD_NAME",
            message: "the name has 300 characters, the limit is 255".to_owned(),
        });
        assert_eq!(
            (e.code(), e.reason()),
            (ErrorCode::InvalidArgument, ErrorReason::BadName)
        );
        assert_eq!(e.message, "the name has 300 characters, the limit is 255");
        let e = library_error(&LibraryError::NotFound {
            what: "shape",
            name: "x".to_owned(),
            nearest: Some("xy".to_owned()),
        });
        assert_eq!(
            (e.code(), e.reason()),
            (ErrorCode::NotFound, ErrorReason::NoShape)
        );
        assert_eq!(e.message, "no shape named \"x\"; did you mean \"xy\"?");
    }

    #[test]
    fn failures_of_shapes_keep_their_names() {
        let e = failure(&Failure {
            code: "INVALID_ARGUMENT".to_owned(),
            reason: "NON_FINITE_VERTEX".to_owned(),
            message: "vertex 3 is NaN".to_owned(),
            subject: Some(crate::library::FailureSubject::Vertex(3)),
        });
        assert_eq!(
            (e.code(), e.reason()),
            (ErrorCode::InvalidArgument, ErrorReason::NonFiniteVertex)
        );
        assert_eq!(e.subject, Some(super::Subject::Vertex(3)));
    }
}
