//! Converts failures of the library and of decoding to wire errors.

use crate::ipc::frames::FrameError;
use crate::ipc::wire::{Error, ErrorCode, ErrorReason, error::Subject};
use crate::library::{Code, Failure, FailureSubject, LibraryError, Reason};
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
fn reason(reason: Reason) -> ErrorReason {
    let name = format!("ERROR_REASON_{}", reason.name());
    ErrorReason::from_str_name(&name).unwrap_or(ErrorReason::Unspecified)
}

fn code(code: Code) -> ErrorCode {
    let name = format!("ERROR_CODE_{}", code.name());
    ErrorCode::from_str_name(&name).unwrap_or(ErrorCode::Internal)
}

/// The error for a failed operation of the library.
pub fn library_error(e: &LibraryError) -> Error {
    let error = failure(&Failure::from(e));
    match e {
        LibraryError::Store(StoreError::NoSpace { .. }) => Error {
            retry_after_ms: DISK_FULL_RETRY_MS,
            ..error
        },
        _ => error,
    }
}

/// The error for a failed shape of a job.
pub fn failure(f: &Failure) -> Error {
    Error {
        subject: f.subject.map(subject),
        ..error(code(f.code), reason(f.reason), f.message.clone())
    }
}

fn subject(location: FailureSubject) -> Subject {
    match location {
        FailureSubject::Face(i) => Subject::Face(i),
        FailureSubject::Vertex(i) => Subject::Vertex(i),
        FailureSubject::Line(i) => Subject::Line(i),
    }
}

#[cfg(test)]
mod tests {
    use super::{ErrorCode, ErrorReason, failure, library_error};
    use crate::library::{Code, Failure, LibraryError, Named, Reason};

    #[test]
    fn library_errors_keep_code_reason_and_message() {
        let e = library_error(&LibraryError::InvalidArgument {
            reason: Reason::BadName,
            message: "the name has 300 characters, the limit is 255".to_owned(),
        });
        assert_eq!(
            (e.code(), e.reason()),
            (ErrorCode::InvalidArgument, ErrorReason::BadName)
        );
        assert_eq!(e.message, "the name has 300 characters, the limit is 255");
        let e = library_error(&LibraryError::NotFound {
            what: Named::Shape,
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
    fn every_code_and_reason_is_on_the_wire() {
        for code in Code::ALL {
            let name = format!("ERROR_CODE_{}", code.name());
            assert_eq!(super::code(*code).as_str_name(), name);
        }
        for reason in Reason::ALL {
            let name = format!("ERROR_REASON_{}", reason.name());
            assert_eq!(super::reason(*reason).as_str_name(), name);
        }
    }

    #[test]
    fn failures_of_shapes_keep_their_names() {
        let e = failure(&Failure {
            code: Code::InvalidArgument,
            reason: Reason::NonFiniteVertex,
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
