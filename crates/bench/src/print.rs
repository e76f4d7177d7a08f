//! Prints figures as lines on stdout.

use crate::error::BenchError;

pub(crate) use coseg::text::table;

/// Prints a line of data.
pub(crate) fn print_line(text: &str) -> Result<(), BenchError> {
    coseg::text::print_line(text).map_err(BenchError::Output)
}
