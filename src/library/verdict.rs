//! Defines a person's verdict on a shape: its labels were corrected, are right, or are doubtful.

use serde::{Deserialize, Serialize};

/// A person's verdict on the labels of a shape.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ReviewState {
    /// Nobody has given a verdict.
    Unseen,
    /// A person labelled some of its faces.
    Corrected,
    /// A person found all its labels right.
    Approved,
    /// A person found a fault that remains.
    Doubtful,
}

impl ReviewState {
    /// All verdicts, in the order in which work proceeds.
    pub const ALL: [Self; 4] = [
        Self::Unseen,
        Self::Corrected,
        Self::Approved,
        Self::Doubtful,
    ];

    /// Returns the stored name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Unseen => "unseen",
            Self::Corrected => "corrected",
            Self::Approved => "approved",
            Self::Doubtful => "doubtful",
        }
    }

    /// Returns the verdict of a name.
    pub fn of_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|s| s.name() == name)
    }
}

/// A verdict with who gave it and when.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Review {
    /// The verdict.
    pub state: ReviewState,
    /// The name that the person gave; may be empty.
    pub by: String,
    /// The time, in milliseconds since 1970; 0: unknown.
    pub unix_ms: u64,
}
