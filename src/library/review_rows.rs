//! Converts verdicts on shapes to rows of the catalog and back.

use super::error::Result;
use super::names::check_name;
use super::once::unix_ms;
use super::rows::damaged;
use super::verdict::{Review, ReviewState};
use crate::store::ReviewRow;

/// Maximum number of bytes of a person's name.
const MAX_REVIEWER: usize = 128;

/// Converts a row to a review. Before reviews were stored, pins alone showed that a shape was
/// corrected.
pub(super) fn review_of_row(row: Option<ReviewRow>, pinned: bool) -> Result<Review> {
    let Some(row) = row else {
        return Ok(Review {
            state: match pinned {
                true => ReviewState::Corrected,
                false => ReviewState::Unseen,
            },
            by: String::new(),
            unix_ms: 0,
        });
    };
    let state = ReviewState::of_name(&row.state);
    let unknown = || damaged("reviews", &format!("{:?} is not a state", row.state));
    Ok(Review {
        state: state.ok_or_else(unknown)?,
        by: row.reviewer,
        unix_ms: row.unix_ms,
    })
}

/// Refuses a name that is not valid for a person. It may be empty.
pub(super) fn check_reviewer(by: &str) -> Result<()> {
    match by {
        "" => Ok(()),
        by => check_name("person", by, MAX_REVIEWER),
    }
}

/// Makes the row of a new verdict.
pub(super) fn review_row(state: ReviewState, by: &str) -> ReviewRow {
    ReviewRow {
        state: state.name().to_owned(),
        reviewer: by.to_owned(),
        unix_ms: unix_ms(),
    }
}
