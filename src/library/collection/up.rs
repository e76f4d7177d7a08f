//! The evidence of shapes about the up axis of their collection.

use crate::description::DescriptionView;
use crate::labels::{UpVote, contradicting_up, estimate_up};
use crate::library::types::Up;
use serde::{Deserialize, Serialize};

/// An estimated up axis.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(in crate::library) struct UpState {
    /// The axis, whether it is used or not.
    pub(in crate::library) axis: [f64; 3],
    /// Share of the shapes that agree.
    pub(in crate::library) agreement: f64,
}

/// The evidence of shapes about the up axis of their collection, and the axis that follows.
#[derive(Debug, Clone, Copy, Default)]
pub(in crate::library) struct UpFound {
    /// The axis that is used, if any.
    pub(in crate::library) axis: Option<[f64; 3]>,
    /// As `State::up`.
    pub(in crate::library) estimate: Option<UpState>,
    /// As `State::up_disagrees`.
    pub(in crate::library) disagrees: Option<UpState>,
}

impl UpFound {
    /// Returns the evidence of shapes, if the collection's up axis is `given`.
    pub(in crate::library) fn of<'a>(given: Up, shapes: &[&'a DescriptionView<'a>]) -> Self {
        if given == Up::Auto {
            let vote = estimate_up(shapes.iter().copied());
            return Self {
                axis: vote.and_then(|v| v.trusted()),
                estimate: vote.map(UpState::from),
                disagrees: None,
            };
        }
        let axis = given.axis();
        let vote = axis.and_then(|axis| contradicting_up(axis, shapes));
        Self {
            axis,
            estimate: None,
            disagrees: vote.map(UpState::from),
        }
    }
}

impl From<UpVote> for UpState {
    fn from(vote: UpVote) -> Self {
        Self {
            axis: vote.axis,
            agreement: vote.agreement,
        }
    }
}

impl UpState {
    /// Returns the estimate as a vote.
    pub(in crate::library) fn vote(&self) -> UpVote {
        UpVote {
            axis: self.axis,
            agreement: self.agreement,
        }
    }
}
