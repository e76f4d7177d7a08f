//! The state of a collection before a change by a person, as the catalog stores it to undo the
//! change.

use super::collection::{Collection, ModelState, State, StoredState};
use super::error::Result;
use super::rows::{damaged, from_json, to_json};
use super::types::LabelId;
use crate::store::{CorrectionRow, LabelRow, LinkEnd, LinkRow, Reader, ReviewRow, ShapeId};
use serde::{Deserialize, Serialize};

/// A collection as it was before a change by a person.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Before {
    labels: Vec<StoredLabel>,
    /// `None`: the change concerns names only.
    pub(super) rest: Option<Rest>,
    /// The up axis, if the change concerns it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) up: Option<String>,
    /// The links, if the change concerns them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    links: Option<Vec<StoredLink>>,
    /// The bytes of the model; empty without a model.
    #[serde(skip)]
    model: Vec<u8>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct StoredLabel {
    id: u32,
    name: Option<String>,
    colour: [u8; 3],
    merged_into: Option<u32>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct StoredLink {
    id: i64,
    kind: String,
    ends: [StoredEnd; 2],
    person: String,
    unix_ms: u64,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct StoredEnd {
    shape: i64,
    part: u32,
    /// The first polygon of each run of polygons, and the one after its last.
    runs: Vec<[u32; 2]>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Rest {
    state: StoredState,
    epoch: u64,
    /// Shapes with this ordinal and above were added later.
    pub(super) next_ordinal: u64,
    /// Shapes that were stale.
    pub(super) stale: Vec<i64>,
    /// Pinned faces of the shapes that the change touches.
    pub(super) pins: Vec<(i64, Option<Vec<i32>>)>,
    /// Verdicts on the shapes that the change concerns.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) reviews: Vec<(i64, Option<StoredReview>)>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct StoredReview {
    state: String,
    reviewer: String,
    unix_ms: u64,
}

impl Before {
    /// The labels, before a change of a name.
    pub(super) fn names(labels: Vec<LabelRow>) -> Self {
        Self {
            labels: labels.into_iter().map(StoredLabel::from).collect(),
            rest: None,
            up: None,
            links: None,
            model: Vec::new(),
        }
    }

    /// The state before a change of the up axis.
    pub(super) fn up(reader: &Reader<'_>, collection: &Collection) -> Result<Self> {
        Ok(Self {
            up: Some(collection.row().up.clone()),
            ..Self::labels(reader, collection, &[])?
        })
    }

    /// The state before a change of links between parts.
    pub(super) fn links(reader: &Reader<'_>, collection: &Collection) -> Result<Self> {
        let links = reader.links(collection.id())?;
        Ok(Self {
            links: Some(links.into_iter().map(StoredLink::from).collect()),
            ..Self::labels(reader, collection, &[])?
        })
    }

    /// The state before a change of the pinned faces or the verdicts of `shapes`.
    pub(super) fn labels(
        reader: &Reader<'_>,
        collection: &Collection,
        shapes: &[ShapeId],
    ) -> Result<Self> {
        let stale = reader.stale_shapes(collection.id())?;
        let pins = shapes.iter().map(|s| Ok((s.0, reader.pins(*s)?)));
        let reviews = shapes.iter().map(|s| {
            let review = reader.review(*s)?.map(StoredReview::from);
            Ok((s.0, review))
        });
        let rest = Rest {
            state: collection.state().clone().into(),
            epoch: collection.row().epoch,
            next_ordinal: collection.row().next_ordinal,
            stale: stale.into_iter().map(|s| s.0).collect(),
            pins: pins.collect::<Result<_>>()?,
            reviews: reviews.collect::<Result<_>>()?,
        };
        Ok(Self {
            rest: Some(rest),
            model: reader.model(collection.id())?.unwrap_or_default(),
            ..Self::names(reader.labels(collection.id())?)
        })
    }

    /// Encodes the state: length of the text (u32), the text, the model.
    pub(super) fn encode(&self) -> Vec<u8> {
        let text = to_json(self);
        let n = u32::try_from(text.len()).expect("invariant: the state is less than 4 GiB");
        [&n.to_le_bytes(), text.as_bytes(), &self.model].concat()
    }

    pub(super) fn decode(row: &CorrectionRow) -> Result<Self> {
        let location = format!("corrections {}", row.id);
        let bad = || damaged(&location, "before is cut");
        let (n, bytes) = row.before.split_first_chunk::<4>().ok_or_else(bad)?;
        let n = u32::from_le_bytes(*n) as usize;
        let (text, model) = bytes.split_at_checked(n).ok_or_else(bad)?;
        let text = std::str::from_utf8(text).map_err(|e| damaged(&location, &e.to_string()))?;
        let before: Self = from_json(text, &location)?;
        Ok(Self {
            model: model.to_vec(),
            ..before
        })
    }

    /// Returns the row of a label; `None` if the label did not exist.
    pub(super) fn label(&self, id: LabelId) -> Option<LabelRow> {
        let found = self.labels.iter().find(|l| l.id == id);
        found.cloned().map(LabelRow::from)
    }

    /// Returns the links; `None` if the change does not concern them.
    pub(super) fn stored_links(&self) -> Option<Vec<LinkRow>> {
        let links = self.links.as_ref()?.iter();
        Some(links.map(|l| l.clone().into()).collect())
    }

    /// Returns the model; `None` if there was none.
    pub(super) fn model(&self) -> Result<Option<ModelState>> {
        if self.model.is_empty() {
            return Ok(None);
        }
        let model = ModelState::decode(&self.model);
        model.map(Some).map_err(|e| damaged("corrections", &e))
    }
}

impl Rest {
    /// Returns the state.
    pub(super) fn state(&self) -> State {
        self.state.clone().into()
    }
}

impl From<LinkRow> for StoredLink {
    fn from(row: LinkRow) -> Self {
        Self {
            id: row.id,
            kind: row.kind,
            ends: row.ends.map(|end| StoredEnd {
                shape: end.shape.0,
                part: end.part,
                runs: runs(&end.polygons),
            }),
            person: row.person,
            unix_ms: row.unix_ms,
        }
    }
}

impl From<StoredLink> for LinkRow {
    fn from(stored: StoredLink) -> Self {
        Self {
            id: stored.id,
            kind: stored.kind,
            ends: stored.ends.map(|end| LinkEnd {
                shape: ShapeId(end.shape),
                part: end.part,
                polygons: end.runs.iter().flat_map(|[from, to]| *from..*to).collect(),
            }),
            person: stored.person,
            unix_ms: stored.unix_ms,
        }
    }
}

/// Returns the runs of consecutive numbers: the first of each, and the one after its last.
fn runs(ascending: &[u32]) -> Vec<[u32; 2]> {
    let mut runs: Vec<[u32; 2]> = Vec::new();
    for at in ascending {
        match runs.last_mut() {
            Some(run) if run[1] == *at => run[1] += 1,
            _ => runs.push([*at, at + 1]),
        }
    }
    runs
}

impl From<ReviewRow> for StoredReview {
    fn from(row: ReviewRow) -> Self {
        Self {
            state: row.state,
            reviewer: row.reviewer,
            unix_ms: row.unix_ms,
        }
    }
}

impl From<StoredReview> for ReviewRow {
    fn from(stored: StoredReview) -> Self {
        Self {
            state: stored.state,
            reviewer: stored.reviewer,
            unix_ms: stored.unix_ms,
        }
    }
}

impl From<LabelRow> for StoredLabel {
    fn from(row: LabelRow) -> Self {
        Self {
            id: row.id,
            name: row.name,
            colour: row.colour,
            merged_into: row.merged_into,
        }
    }
}

impl From<StoredLabel> for LabelRow {
    fn from(label: StoredLabel) -> Self {
        Self {
            id: label.id,
            name: label.name,
            colour: label.colour,
            merged_into: label.merged_into,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_state_before_a_change_reads_back() {
        let label = LabelRow {
            id: 3,
            name: Some("leg".into()),
            colour: [1, 2, 3],
            merged_into: None,
        };
        let rest = Rest {
            state: StoredState::default(),
            epoch: 4,
            next_ordinal: 9,
            stale: vec![7],
            pins: vec![(5, Some(vec![-1, 3])), (6, None)],
            reviews: vec![(
                5,
                Some(StoredReview {
                    state: "approved".into(),
                    reviewer: "ada".into(),
                    unix_ms: 12,
                }),
            )],
        };
        let link = LinkRow {
            id: 4,
            kind: "differ".into(),
            ends: [vec![1, 2, 3, 9], vec![]].map(|polygons| LinkEnd {
                shape: ShapeId(5),
                part: 1,
                polygons,
            }),
            person: "ada".into(),
            unix_ms: 12,
        };
        let before = Before {
            rest: Some(rest),
            links: Some(vec![link.clone().into()]),
            model: vec![1, 2, 3],
            ..Before::names(vec![label])
        };
        let mut row = CorrectionRow {
            id: 1,
            kind: "correct".into(),
            detail_json: "{}".into(),
            before: before.encode(),
        };
        let decoded = Before::decode(&row).expect("decodes");
        assert_eq!(decoded, before);
        assert_eq!(decoded.stored_links(), Some(vec![link]));
        row.before.truncate(20);
        assert!(Before::decode(&row).is_err());
    }
}
