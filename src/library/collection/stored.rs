//! Encodes the state of a collection for the catalog, and decodes it. The names and their order are
//! those of the first release, so that every library reads and writes the same text.

use super::state::{Discovered, Epoch, Phase, Propagation, Regime, State, Supervision, Vocabulary};
use super::up::UpState;
use crate::library::error::Result;
use crate::library::rows::{damaged, from_json, to_json};
use crate::store::CollectionRow;
use serde::{Deserialize, Serialize};

/// A [`State`] as JSON.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(in crate::library) struct StoredState {
    next_recluster: u64,
    representatives: Vec<u64>,
    epoch_ordinal: u64,
    #[serde(default)]
    silent: Vec<u64>,
    #[serde(default)]
    teaching: Option<StoredSupervision>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    up: Option<UpState>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    up_disagrees: Option<UpState>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    carrying: Option<StoredPropagation>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    clustered: Option<u64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    chosen: Option<u32>,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct StoredPropagation {
    job: u64,
    n_shapes: u64,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct StoredSupervision {
    pending: bool,
    normalised: bool,
    /// Whether the discovered labels that labelled faces show are no labels of their own any more.
    closed: bool,
    /// Whether a person said that there are no labels but those that persons used.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    complete: bool,
    taught: Vec<u64>,
    discovered: Vec<(u64, u64)>,
    discovered_labels: Vec<u32>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    kept: Vec<u32>,
}

impl State {
    /// Returns the state in a collection's row, or that of a new collection if there is none yet.
    pub(in crate::library) fn of(row: &CollectionRow) -> Result<Self> {
        let location = format!("collections {}", row.name);
        if row.state.is_empty() {
            return Ok(Self::default());
        }
        let text = std::str::from_utf8(&row.state);
        let text = text.map_err(|e| damaged(&location, &e.to_string()))?;
        Ok(from_json::<StoredState>(text, &location)?.into())
    }

    /// Encodes the state for a collection's row.
    pub(in crate::library) fn encode(&self) -> Vec<u8> {
        to_json(&StoredState::from(self.clone())).into_bytes()
    }
}

impl From<StoredState> for State {
    fn from(stored: StoredState) -> Self {
        Self {
            next_recluster: stored.next_recluster,
            epoch: Epoch {
                representatives: stored.representatives,
                last_ordinal: stored.epoch_ordinal,
                silent: stored.silent,
            },
            regime: stored.teaching.map_or(Regime::Discovering, |teaching| {
                Regime::Supervised(teaching.into())
            }),
            up: stored.up,
            up_disagrees: stored.up_disagrees,
            propagation: stored.carrying.map(|c| Propagation {
                job: c.job,
                n_shapes: c.n_shapes,
            }),
            clustered: stored.clustered,
            chosen: stored.chosen,
        }
    }
}

impl From<State> for StoredState {
    fn from(state: State) -> Self {
        Self {
            next_recluster: state.next_recluster,
            representatives: state.epoch.representatives,
            epoch_ordinal: state.epoch.last_ordinal,
            silent: state.epoch.silent,
            teaching: state.regime.supervision().map(StoredSupervision::from),
            up: state.up,
            up_disagrees: state.up_disagrees,
            carrying: state.propagation.map(|p| StoredPropagation {
                job: p.job,
                n_shapes: p.n_shapes,
            }),
            clustered: state.clustered,
            chosen: state.chosen,
        }
    }
}

impl From<StoredSupervision> for Supervision {
    fn from(stored: StoredSupervision) -> Self {
        let vocabulary = match (stored.closed, stored.complete) {
            (_, true) => Vocabulary::Closed,
            (true, false) => Vocabulary::Covered,
            (false, false) => Vocabulary::Open,
        };
        let phase = match (stored.pending, stored.normalised) {
            (false, _) => Phase::Fitted,
            (true, false) => Phase::Outdated,
            (true, true) => Phase::Standardised,
        };
        let discovered = Discovered {
            versions: stored.discovered,
            labels: stored.discovered_labels,
            kept: stored.kept,
        };
        Self::stored(vocabulary, phase, stored.taught, discovered)
    }
}

impl From<&Supervision> for StoredSupervision {
    fn from(supervision: &Supervision) -> Self {
        Self {
            pending: supervision.phase() != Phase::Fitted,
            normalised: supervision.phase() != Phase::Outdated,
            closed: !supervision.is_open(),
            complete: supervision.vocabulary() == Vocabulary::Closed,
            taught: supervision.trained().to_vec(),
            discovered: supervision.discovered().versions.clone(),
            discovered_labels: supervision.discovered().labels.clone(),
            kept: supervision.discovered().kept.clone(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{State, StoredState};
    use crate::library::rows::{from_json, to_json};

    /// Texts of earlier releases; the last two lack later fields.
    #[test]
    fn states_are_written_as_they_were_read() {
        for (text, is_old) in [
            (
                concat!(
                    r#"{"next_recluster":5,"representatives":[1,2,4],"epoch_ordinal":4,"#,
                    r#""silent":[3],"teaching":null,"up":{"axis":[0.0,1.0,0.0],"agreement":0.75}}"#,
                ),
                false,
            ),
            (
                concat!(
                    r#"{"next_recluster":7,"representatives":[1],"epoch_ordinal":1,"silent":[],"#,
                    r#""teaching":{"pending":true,"normalised":false,"closed":true,"#,
                    r#""taught":[1,2],"discovered":[[1,3]],"discovered_labels":[0,2]},"#,
                    r#""carrying":{"job":9,"n_shapes":4},"clustered":6,"chosen":3}"#,
                ),
                false,
            ),
            (
                concat!(
                    r#"{"next_recluster":7,"representatives":[1],"epoch_ordinal":1,"silent":[],"#,
                    r#""teaching":{"pending":true,"normalised":true,"closed":false,"taught":[],"#,
                    r#""discovered":[],"discovered_labels":[]}}"#,
                ),
                false,
            ),
            (
                concat!(
                    r#"{"next_recluster":7,"representatives":[1],"epoch_ordinal":1,"silent":[],"#,
                    r#""teaching":{"pending":false,"normalised":true,"closed":false,"taught":[],"#,
                    r#""discovered":[],"discovered_labels":[]}}"#,
                ),
                false,
            ),
            (
                r#"{"next_recluster":2,"representatives":[1],"epoch_ordinal":1}"#,
                true,
            ),
        ] {
            let stored: StoredState = from_json(text, "a test").expect("reads");
            let again = StoredState::from(State::from(stored.clone()));
            assert_eq!(again, stored);
            assert_eq!(to_json(&again) == text, !is_old, "{}", to_json(&again));
        }
    }
}
