//! Converts verdicts on shapes to rows of the catalog and back.

use super::error::Result;
use super::names::check_name;
use super::once::unix_ms;
use super::rows::damaged;
use super::verdict::{Review, ReviewState};
use crate::store::ReviewRow;

/// Most bytes of a person's name.
const MAX_REVIEWER: usize = 128;

/// The review that a row says, or its absence: before reviews were stored, pins alone said that a
/// shape was corrected.
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

/// Refuses what cannot be a person's name. It may be empty.
pub(super) fn check_reviewer(by: &str) -> Result<()> {
    match by {
        "" => Ok(()),
        by => check_name("person", by, MAX_REVIEWER),
    }
}

/// A verdict that is given now.
pub(super) fn review_row(state: ReviewState, by: &str) -> ReviewRow {
    ReviewRow {
        state: state.name().to_owned(),
        reviewer: by.to_owned(),
        unix_ms: unix_ms(),
    }
}
