//! Defines the changes by persons that can be undone, as the catalog names them.

use crate::library::linked::LinkKind;
use crate::library::rows::to_json;
use crate::library::types::LabelId;
use crate::store::catalog::KIND_NAME;

/// A change by a person that can be undone.
#[derive(Debug)]
pub(in crate::library) enum Undoable {
    Correct { shape: String },
    Answer { shape: String },
    Approve { shape: String },
    Doubt { shape: String },
    Name,
    Merge { label: LabelId, into: LabelId },
    Split { label: LabelId, new: LabelId },
    Up { from: String, to: String },
    Choose { proposal: u32 },
    Link { kind: LinkKind, parts: String },
    Unlink { parts: String },
}

impl Undoable {
    /// Returns the stored name.
    pub(in crate::library) fn kind(&self) -> &'static str {
        match self {
            Self::Correct { .. } => "correct",
            Self::Answer { .. } => "answer",
            Self::Approve { .. } => "approve",
            Self::Doubt { .. } => "doubt",
            Self::Name => KIND_NAME,
            Self::Merge { .. } => "merge",
            Self::Split { .. } => "split",
            Self::Up { .. } => "up",
            Self::Choose { .. } => "choose",
            Self::Link { kind, .. } => kind.name(),
            Self::Unlink { .. } => "unlink",
        }
    }

    /// Returns the stored details.
    pub(super) fn detail(&self) -> String {
        let detail = match self {
            Self::Correct { shape }
            | Self::Answer { shape }
            | Self::Approve { shape }
            | Self::Doubt { shape } => serde_json::json!({ "shape": shape }),
            Self::Name => serde_json::json!({}),
            Self::Merge { label, into } => serde_json::json!({ "label": label, "into": into }),
            Self::Split { label, new } => serde_json::json!({ "label": label, "new": new }),
            Self::Link { parts, .. } | Self::Unlink { parts } => {
                serde_json::json!({ "parts": parts })
            }
            Self::Up { from, to } => serde_json::json!({ "from": from, "to": to }),
            Self::Choose { proposal } => serde_json::json!({ "proposal": proposal }),
        };
        to_json(&detail)
    }
}
