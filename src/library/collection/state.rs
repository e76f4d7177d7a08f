//! The state that decides how a collection is labelled next: its regime, and the changes of regime.

use super::up::{UpFound, UpState};
use crate::library::types::LabelId;

/// The state of a collection besides its model and its shapes.
#[derive(Debug, Clone, Default, PartialEq)]
pub(in crate::library) struct State {
    /// Number of shapes at which the parts are clustered again or the model is fitted again.
    pub(in crate::library) next_recluster: u64,
    /// The epoch of discovery: the one in force, or the last one before a person labelled faces.
    pub(in crate::library) epoch: Epoch,
    /// The regime, which decides where labels come from.
    pub(in crate::library) regime: Regime,
    /// The estimate, if the up axis is estimated.
    pub(in crate::library) up: Option<UpState>,
    /// If the up axis is given: another one along which shapes stand clearly better.
    pub(in crate::library) up_disagrees: Option<UpState>,
    /// The newest job that propagates a correction.
    pub(in crate::library) propagation: Option<Propagation>,
    /// The newest ordinal when clustering was last due, if the epoch did not begin then.
    pub(in crate::library) clustered: Option<u64>,
    /// Number of labels of the proposal that a person chose. Its labels stay until a person changes
    /// them: clustering makes new proposals only.
    pub(in crate::library) chosen: Option<u32>,
}

impl State {
    /// Returns the newest ordinal when clustering was last due; 0 before the first time.
    pub(in crate::library) fn clustered_ordinal(&self) -> u64 {
        self.clustered.unwrap_or(self.epoch.last_ordinal)
    }

    /// Returns the same state with the evidence of shapes about the up axis.
    pub(in crate::library) fn with_up(self, found: &UpFound) -> Self {
        Self {
            up: found.estimate,
            up_disagrees: found.disagrees,
            ..self
        }
    }
}

/// The time from one accepted re-clustering to the next.
#[derive(Debug, Clone, Default, PartialEq)]
pub(in crate::library) struct Epoch {
    /// Ordinals of the shapes that were clustered together at its beginning.
    pub(in crate::library) representatives: Vec<u64>,
    /// The newest ordinal at its beginning.
    pub(in crate::library) last_ordinal: u64,
    /// Ordinals of later shapes that are not part of the model, because a correction that was
    /// undone labelled them.
    pub(in crate::library) silent: Vec<u64>,
}

impl Epoch {
    /// Returns whether the labels of the shape with this ordinal are part of the model.
    pub(in crate::library) fn informs(&self, ordinal: u64) -> bool {
        let is_newer = ordinal > self.last_ordinal;
        is_newer && !self.silent.contains(&ordinal) || self.representatives.contains(&ordinal)
    }
}

/// The job in which a person's labels are propagated to the other shapes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::library) struct Propagation {
    /// Its id.
    pub(in crate::library) job: u64,
    /// Number of shapes that were stale when it began.
    pub(in crate::library) n_shapes: u64,
}

/// Where the labels of a collection come from.
#[derive(Debug, Clone, Default, PartialEq)]
pub(in crate::library) enum Regime {
    /// Parts are clustered, and the collection is clustered again as it grows.
    #[default]
    Discovering,
    /// A person changed labels. Labels follow from the training shapes, and nothing is clustered.
    Supervised(Supervision),
}

/// How the labels of a collection follow from what persons labelled.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::library) struct Supervision {
    vocabulary: Vocabulary,
    phase: Phase,
    trained: Vec<u64>,
    discovered: Discovered,
}

/// Which labels shapes can have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::library) enum Vocabulary {
    /// Labels that persons used, and every label that was discovered before.
    Open,
    /// Labels that persons used and, because a person labelled a whole shape, only those discovered
    /// labels that no labelled face shows.
    Covered,
    /// Labels that persons used, because a person said that there are no others.
    Closed,
}

/// Whether the model is up to date with the training shapes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::library) enum Phase {
    /// Descriptors must be standardised over the shapes of the next fit.
    Outdated,
    /// Descriptors are standardised; maps and the fit itself remain to be computed.
    Standardised,
    /// The model is fitted.
    Fitted,
}

/// Labels that were discovered before a person changed any.
#[derive(Debug, Clone, Default, PartialEq)]
pub(in crate::library) struct Discovered {
    /// Ordinals of representatives, each with the version of its labels.
    pub(in crate::library) versions: Vec<(u64, u64)>,
    /// Label of each class in the probabilities of those versions.
    pub(in crate::library) labels: Vec<LabelId>,
    /// Labels of these that shapes can still have, although a person labelled whole shapes.
    pub(in crate::library) kept: Vec<LabelId>,
}

impl Discovered {
    /// Returns the version in which the shape with this ordinal had discovered labels.
    pub(in crate::library) fn version_of(&self, ordinal: u64) -> Option<u64> {
        let found = self.versions.iter().find(|v| v.0 == ordinal);
        found.map(|v| v.1)
    }
}

impl Regime {
    /// Returns the supervision of the collection, if there is one.
    pub(in crate::library) fn supervision(&self) -> Option<&Supervision> {
        match self {
            Self::Discovering => None,
            Self::Supervised(supervision) => Some(supervision),
        }
    }
}

impl Supervision {
    /// Ends discovery by a change that keeps model and labels: the model counts as fitted to the
    /// representatives.
    pub(in crate::library) fn renamed(discovered: Discovered) -> Self {
        Self {
            vocabulary: Vocabulary::Open,
            phase: Phase::Fitted,
            trained: discovered.versions.iter().map(|v| v.0).collect(),
            discovered,
        }
    }

    /// Ends discovery because faces were labelled, to which a model must be fitted.
    pub(in crate::library) fn begun(vocabulary: Vocabulary, discovered: Discovered) -> Self {
        Self {
            vocabulary,
            phase: Phase::Outdated,
            trained: Vec::new(),
            discovered,
        }
    }

    /// Returns the supervision after a change of the training shapes.
    pub(in crate::library) fn outdated(self, vocabulary: Vocabulary) -> Self {
        Self {
            vocabulary,
            phase: Phase::Outdated,
            ..self
        }
    }

    /// Returns the supervision with other versions of the discovered labels, to which the model
    /// must be fitted.
    pub(in crate::library) fn rediscovered(self, discovered: Discovered) -> Self {
        Self {
            phase: Phase::Outdated,
            discovered,
            ..self
        }
    }

    /// Returns the supervision without the discovered labels, which are no evidence any more.
    pub(in crate::library) fn without_discovered(self) -> Self {
        Self {
            discovered: Discovered::default(),
            ..self
        }
    }

    /// Returns the supervision after descriptors were standardised.
    pub(in crate::library) fn standardised(self) -> Self {
        Self {
            phase: match self.phase {
                Phase::Outdated => Phase::Standardised,
                phase => phase,
            },
            ..self
        }
    }

    /// Returns the supervision with the discovered labels `kept` by a fit, and other ids of some of
    /// them: `renumbered` has indices and ids.
    pub(super) fn keeping(
        mut self,
        kept: &[LabelId],
        renumbered: impl Iterator<Item = (usize, LabelId)>,
    ) -> Self {
        self.discovered.kept = kept.to_vec();
        for (at, id) in renumbered {
            self.discovered.labels[at] = id;
        }
        self
    }

    /// Returns the supervision after the model was fitted to the shapes with these ordinals.
    pub(in crate::library) fn fitted(self, trained: Vec<u64>) -> Self {
        Self {
            phase: Phase::Fitted,
            trained,
            ..self
        }
    }

    /// Returns a supervision from its stored fields.
    pub(super) fn stored(
        vocabulary: Vocabulary,
        phase: Phase,
        trained: Vec<u64>,
        discovered: Discovered,
    ) -> Self {
        Self {
            vocabulary,
            phase,
            trained,
            discovered,
        }
    }

    pub(in crate::library) fn phase(&self) -> Phase {
        self.phase
    }

    /// Returns the ordinals of the shapes to which the model was fitted; their labels vote.
    pub(in crate::library) fn trained(&self) -> &[u64] {
        &self.trained
    }

    pub(in crate::library) fn discovered(&self) -> &Discovered {
        &self.discovered
    }

    pub(in crate::library) fn vocabulary(&self) -> Vocabulary {
        self.vocabulary
    }

    /// Returns whether shapes can have every discovered label.
    pub(in crate::library) fn is_open(&self) -> bool {
        self.vocabulary == Vocabulary::Open
    }
}
