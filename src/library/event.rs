//! The events of a collection, as they are logged and published.

use super::linked::{LinkKind, PartName};
use super::types::LabelId;
use serde::{Deserialize, Serialize};

/// An event of a collection.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Event {
    /// Position in the collection's log, from 1, without gaps.
    pub sequence: u64,
    /// What happened.
    pub kind: EventKind,
}

/// The kinds of events of a collection.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum EventKind {
    /// The collection was created.
    CollectionCreated,
    /// The collection was deleted with its shapes.
    CollectionDeleted,
    /// A labelled shape was added.
    ShapeAdded {
        /// Its name.
        shape: String,
        /// Version of its labels.
        version: u64,
        /// Label and share of the shape's area.
        area_shares: Vec<(LabelId, f64)>,
    },
    /// A shape was removed.
    ShapeRemoved {
        /// Its name.
        shape: String,
    },
    /// A stored shape has a new version of its labels.
    LabelsChanged {
        /// Its name.
        shape: String,
        /// The new version.
        version: u64,
        /// The rule that allowed it: `reclustering`, `correction`, `carrying`, `merge`, `split`,
        /// `undo`, `choice`.
        cause: String,
        /// Share of the shape's area that moved, from label to label (-1: unlabelled).
        moves: Vec<LabelMove>,
    },
    /// A label was created.
    LabelCreated {
        /// Its id.
        label: LabelId,
    },
    /// A label was found to be part of another one; the old id resolves to it.
    LabelMerged {
        /// The retired id.
        from: LabelId,
        /// The id that stands for both.
        into: LabelId,
    },
    /// A label was found to be several; the old id keeps the largest share.
    LabelSplit {
        /// The id that was split.
        from: LabelId,
        /// The new ids.
        into: Vec<LabelId>,
    },
    /// A label was named.
    LabelNamed {
        /// Its id.
        label: LabelId,
        /// The name.
        name: String,
    },
    /// A label is no longer in use: no training shape has it.
    LabelRetired {
        /// Its id.
        label: LabelId,
    },
    /// A person labelled faces of a shape, which keep their labels until a person changes them.
    Corrected {
        /// The shape.
        shape: String,
        /// Version of its labels.
        version: u64,
        /// Number of its faces that a person labelled, now or before.
        n_faces: u64,
        /// Share of its area that these faces cover.
        area_share: f64,
    },
    /// The newest change by a person was undone.
    Undone {
        /// The kind of change, as in [`Undone::change`](super::Undone::change).
        change: String,
    },
    /// A person changed the up axis; labels are derived again along the new one.
    UpChanged {
        /// The old axis: `+y`, `unknown`, `auto`.
        from: String,
        /// The new axis.
        to: String,
    },
    /// A person chose a proposal, which became the labels.
    Chosen {
        /// Its number.
        proposal: u32,
        /// Number of its labels.
        n_labels: u32,
        /// Its value; see docs/methods.md.
        value: f64,
    },
    /// A person linked two parts: they must have the same label, or different ones.
    PartsLinked {
        /// Id of the link.
        link: u64,
        /// What it demands.
        kind: LinkKind,
        /// The parts.
        parts: [PartName; 2],
    },
    /// A person removed a link between two parts.
    PartsUnlinked {
        /// Id of the link.
        link: u64,
    },
    /// The parts of the collection were clustered again.
    Reclustered {
        /// Score of the old labelling; see docs/methods.md.
        score_before: Option<f64>,
        /// Score of the new labelling.
        score_after: f64,
        /// Whether the new labelling was accepted.
        accepted: bool,
    },
}

impl EventKind {
    /// Returns the name under which events of this kind are stored.
    pub(super) fn name(&self) -> &'static str {
        match self {
            Self::CollectionCreated => "collection_created",
            Self::CollectionDeleted => "collection_deleted",
            Self::ShapeAdded { .. } => "shape_added",
            Self::ShapeRemoved { .. } => "shape_removed",
            Self::LabelsChanged { .. } => "labels_changed",
            Self::LabelCreated { .. } => "label_created",
            Self::LabelMerged { .. } => "label_merged",
            Self::LabelSplit { .. } => "label_split",
            Self::LabelNamed { .. } => "label_named",
            Self::LabelRetired { .. } => "label_retired",
            Self::Corrected { .. } => "corrected",
            Self::Undone { .. } => "undone",
            Self::UpChanged { .. } => "up_changed",
            Self::Chosen { .. } => "chosen",
            Self::PartsLinked { .. } => "parts_linked",
            Self::PartsUnlinked { .. } => "parts_unlinked",
            Self::Reclustered { .. } => "reclustered",
        }
    }
}

/// Area that moved from one label to another.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LabelMove {
    /// Label before (-1: unlabelled).
    pub from: i64,
    /// Label after.
    pub to: i64,
    /// Share of the shape's area.
    pub area_share: f64,
}
