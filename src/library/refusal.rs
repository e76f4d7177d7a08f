//! Converts errors to the failure of one shape.

use super::error::LibraryError;
use super::reason::{Code, Reason};
use super::types::{Failure, FailureSubject};
use crate::mesh::{CleanError, ParseError};
use crate::pipeline::DescribeError;
use crate::spectrum::SpectrumError;

/// Converts an error of the library to the failure of an item. If something is not found, it was
/// removed after the item was accepted.
pub(super) fn failure(error: &LibraryError) -> Failure {
    let failure = Failure::from(error);
    match error {
        LibraryError::NotFound { .. } => Failure {
            reason: Reason::Gone,
            ..failure
        },
        _ => failure,
    }
}

/// Converts the error of a description to the failure of an item.
pub(super) fn refusal(error: &DescribeError) -> Failure {
    let (code, reason) = match error {
        DescribeError::Parse(e) => (Code::InvalidArgument, parse_reason(e)),
        DescribeError::Clean(CleanError::AllDegenerate { .. }) => {
            (Code::InvalidArgument, Reason::NoArea)
        }
        DescribeError::Clean(_) => (Code::InvalidArgument, Reason::Mesh),
        DescribeError::Laplacian(_) => (Code::InvalidArgument, Reason::Laplacian),
        DescribeError::Spectrum(SpectrumError::Cancelled { .. }) => {
            (Code::Cancelled, Reason::Cancelled)
        }
        DescribeError::Spectrum(_) => (Code::Internal, Reason::Spectrum),
        DescribeError::Cancelled(_) => (Code::Cancelled, Reason::Cancelled),
    };
    let subject = match error {
        DescribeError::Parse(e) => parse_subject(e),
        _ => None,
    };
    Failure {
        code,
        reason,
        message: error.to_string(),
        subject,
    }
}

fn parse_reason(error: &ParseError) -> Reason {
    match error {
        ParseError::VertexOutOfRange { .. } => Reason::VertexIndex,
        ParseError::NonFinite { .. } => Reason::NonFiniteVertex,
        ParseError::TooManyTriangles => Reason::MeshTooLarge,
        _ => Reason::Parse,
    }
}

/// Returns the location in the file, if there is one.
fn parse_subject(error: &ParseError) -> Option<FailureSubject> {
    match error {
        ParseError::NotANumber { line, .. }
        | ParseError::ShortVertex { line, .. }
        | ParseError::EmptyFace { line, .. }
        | ParseError::ShortFace { line, .. }
        | ParseError::BadLine { line, .. }
        | ParseError::ShortRow { line, .. }
        | ParseError::Trailing { line, .. } => Some(FailureSubject::Line(*line as u64)),
        ParseError::PolygonTooLarge { face, .. }
        | ParseError::EmptyPolygon { face }
        | ParseError::VertexOutOfRange { face, .. }
        | ParseError::NonFinite { face, .. } => Some(FailureSubject::Face(*face as u64)),
        _ => None,
    }
}
