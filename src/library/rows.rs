//! What the catalog keeps as text becomes domain values and back.

use super::{LibraryError, Result, Up};
use crate::description::DescriptionView;
use crate::fmap::{Confidence, Quality, confidence};
use crate::labels::{UpVote, estimate_up};
use crate::mesh::{CleanReport, Format};
use crate::operators::Operator;
use crate::store::{CollectionRow, MapRow, StoreError};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

/// What a collection keeps besides its model.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct CollectionState {
    /// Number of shapes at which the parts are clustered anew.
    pub(super) next_recluster: u64,
    /// Ordinals of the shapes that were clustered together when the epoch began.
    pub(super) representatives: Vec<u64>,
    /// Newest ordinal when the epoch began.
    pub(super) epoch_ordinal: u64,
    /// Ordinals of shapes that came after that and yet inform the model not: an undone correction labelled them.
    #[serde(default)]
    pub(super) silent: Vec<u64>,
    /// From the first correction on: what labels are carried from, in the place of discovery.
    #[serde(default)]
    pub(super) teaching: Option<Teaching>,
    /// Where the up axis is estimated: what the shapes that the model was made of say.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) up: Option<UpState>,
    /// The newest job that carries a correction.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) carrying: Option<CarryingState>,
}

impl CollectionState {
    /// The state of a collection, as its row has it; as it begins, where there is none yet.
    pub(super) fn of(row: &CollectionRow) -> Result<Self> {
        let place = format!("collections {}", row.name);
        if row.state.is_empty() {
            return Ok(Self::default());
        }
        let text = std::str::from_utf8(&row.state).map_err(|e| damaged(&place, &e.to_string()))?;
        from_json(text, &place)
    }
}

/// The job in which a person's labels are carried to the other shapes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) struct CarryingState {
    /// Its id.
    pub(super) job: u64,
    /// Shapes that were stale when it began.
    pub(super) n_shapes: u64,
}

/// An estimated up axis.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) struct UpState {
    /// The axis, whether it is used or not.
    pub(super) axis: [f64; 3],
    /// Share of the shapes that agree.
    pub(super) agreement: f64,
}

impl UpState {
    /// What shapes say, and the axis that follows from it or from what is given.
    pub(super) fn of<'a>(
        given: Up,
        shapes: impl Iterator<Item = &'a DescriptionView<'a>>,
    ) -> (Option<Self>, Option<[f64; 3]>) {
        if given != Up::Auto {
            return (None, given.axis());
        }
        let vote = estimate_up(shapes);
        let said = vote.map(|v| Self {
            axis: v.axis,
            agreement: v.agreement,
        });
        (said, vote.and_then(|v| v.trusted()))
    }

    /// As a vote.
    pub(super) fn vote(&self) -> UpVote {
        UpVote {
            axis: self.axis,
            agreement: self.agreement,
        }
    }
}

/// How the labels of a collection follow from what a person said.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Teaching {
    /// What a person said has not been learnt yet.
    pub(super) pending: bool,
    /// Descriptors are standardised over the representatives that learn.
    pub(super) normalised: bool,
    /// Only labels that a person used are given; otherwise discovered ones count as well.
    pub(super) closed: bool,
    /// Ordinals of the representatives that learnt; their labels vote.
    pub(super) taught: Vec<u64>,
    /// Ordinals of the representatives whose discovered labels count, and the versions in which they had them.
    pub(super) discovered: Vec<(u64, u64)>,
    /// Label of each class in the probabilities of those versions.
    pub(super) discovered_labels: Vec<u32>,
}

pub(super) fn to_json<T: Serialize>(value: &T) -> String {
    serde_json::to_string(value).expect("invariant: plain values serialise")
}

pub(super) fn from_json<'a, T: Deserialize<'a>>(text: &'a str, place: &str) -> Result<T> {
    serde_json::from_str(text).map_err(|e| damaged(place, &e.to_string()))
}

/// A row of the catalog that does not hold what was written.
pub(super) fn damaged(place: &str, message: &str) -> LibraryError {
    StoreError::Damaged {
        path: place.to_string(),
        message: message.to_string(),
    }
    .into()
}

/// A clean report as JSON.
pub fn report_to_json(report: &CleanReport) -> Value {
    Value::Object(
        report
            .counts()
            .into_iter()
            .map(|(name, n)| (name.into(), json!(n)))
            .collect(),
    )
}

pub(super) fn report_from_json(text: &str, place: &str) -> Result<CleanReport> {
    let value: Value = from_json(text, place)?;
    let count = |name| {
        let n = value.get(name).and_then(Value::as_u64);
        n.map(|n| n as usize)
            .ok_or_else(|| damaged(place, &format!("no count {name:?}")))
    };
    CleanReport::from_counts(count, |name| value.get(name).is_none())
}

pub(super) fn quality_to_json(q: &Quality) -> String {
    json!({
        "descriptor_residual": q.descriptor_residual,
        "orthogonality": q.orthogonality,
        "coverage": q.coverage,
        "near_zero": q.near_zero,
        "descriptor_return": q.descriptor_return,
        "confidence": q.confidence,
        "matched": q.matched,
    })
    .to_string()
}

pub(super) fn quality_from_json(text: &str, place: &str) -> Result<Quality> {
    let value: Value = from_json(text, place)?;
    let number = |name: &str| -> Result<f64> {
        value
            .get(name)
            .and_then(Value::as_f64)
            .ok_or_else(|| damaged(place, &format!("no number {name:?}")))
    };
    let mut quality = Quality {
        descriptor_residual: number("descriptor_residual")?,
        orthogonality: number("orthogonality")?,
        coverage: number("coverage")?,
        near_zero: number("near_zero")?,
        matched: 1.0,
        ..Quality::default()
    };
    if value.get("confidence").is_some() {
        quality.descriptor_return = number("descriptor_return")?;
        quality.confidence = number("confidence")?;
        quality.matched = number("matched")?;
    } else {
        // Kept before these were known: a typical return, so that the residual and the rest decide.
        quality.descriptor_return = TYPICAL_RETURN;
        quality.confidence = confidence::of_map(&quality);
    }
    Ok(quality)
}

/// Mean squared difference of descriptors between a vertex and what its match is matched with, of an ordinary map.
const TYPICAL_RETURN: f64 = 0.5;

/// What to expect of a kept map at each vertex.
pub(super) fn confidence_of_row(row: &MapRow) -> Result<Confidence> {
    if row.confidence.is_empty() {
        let place = format!("maps {} {}", row.from, row.to);
        let quality = quality_from_json(&row.quality_json, &place)?;
        return Ok(Confidence::uniform(quality.confidence, row.p2p_21.len()));
    }
    Ok(Confidence {
        of_vertex: row.confidence.clone(),
    })
}

/// The stored word of an operator.
pub(super) fn operator_name(operator: Operator) -> &'static str {
    match operator {
        Operator::Tufted => "tufted",
        Operator::Cotan => "cotan",
        Operator::MeshLaplace => "mesh-laplace",
    }
}

pub(super) fn operator_from_name(name: &str, place: &str) -> Result<Operator> {
    let all = [Operator::Tufted, Operator::Cotan, Operator::MeshLaplace];
    let found = all.into_iter().find(|o| operator_name(*o) == name);
    found.ok_or_else(|| damaged(place, &format!("no operator is named {name:?}")))
}

/// The format of that stored word.
pub(super) fn format_from_name(name: &str, place: &str) -> Result<Format> {
    let found = Format::ALL.into_iter().find(|f| f.name() == name);
    found.ok_or_else(|| damaged(place, &format!("no format is named {name:?}")))
}

/// Colours of labels, by id: Okabe and Ito's eight, which colour-blind people can tell apart, then golden-angle
/// hues.
pub(super) fn label_colour(id: u32) -> [u8; 3] {
    const OKABE_ITO: [[u8; 3]; 8] = [
        [230, 159, 0],
        [86, 180, 233],
        [0, 158, 115],
        [240, 228, 66],
        [0, 114, 178],
        [213, 94, 0],
        [204, 121, 167],
        [128, 128, 128],
    ];
    if let Some(colour) = OKABE_ITO.get(id as usize) {
        return *colour;
    }
    let hue = f64::from(id) * 137.507_764 % 360.0 / 60.0;
    let x = 1.0 - (hue % 2.0 - 1.0).abs();
    let (r, g, b) = match hue as u32 {
        0 => (1.0, x, 0.0),
        1 => (x, 1.0, 0.0),
        2 => (0.0, 1.0, x),
        3 => (0.0, x, 1.0),
        4 => (x, 0.0, 1.0),
        _ => (1.0, 0.0, x),
    };
    [r, g, b].map(|c| (60.0 + 170.0 * c) as u8)
}
