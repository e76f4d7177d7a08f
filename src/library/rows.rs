//! Converts text in the catalog to domain values and back.

use super::error::{LibraryError, Result};
use super::types::LabelId;
use crate::fmap::{Confidence, Quality, confidence};
use crate::mesh::{CleanReport, Format};
use crate::operators::Operator;
use crate::store::{LabelRow, MapRow, StoreError};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

pub(super) fn to_json<T: Serialize>(value: &T) -> String {
    serde_json::to_string(value).expect("invariant: plain values serialise")
}

pub(super) fn from_json<'a, T: Deserialize<'a>>(text: &'a str, location: &str) -> Result<T> {
    serde_json::from_str(text).map_err(|e| damaged(location, &e.to_string()))
}

/// Makes the error for a row of the catalog with content that was never written.
pub(super) fn damaged(location: &str, message: &str) -> LibraryError {
    StoreError::Damaged {
        path: location.to_string(),
        message: message.to_string(),
    }
    .into()
}

/// Returns the label to which an id resolves after merges.
pub(super) fn resolved(rows: &[LabelRow], id: LabelId) -> LabelId {
    let into = |id: LabelId| rows.iter().find(|l| l.id == id).and_then(|l| l.merged_into);
    let mut id = id;
    // A chain has at most as many links as there are labels.
    for _ in 0..rows.len() {
        match into(id) {
            Some(next) => id = next,
            None => break,
        }
    }
    id
}

/// Converts a report of cleaning to JSON.
pub fn report_to_json(report: &CleanReport) -> Value {
    Value::Object(
        report
            .counts()
            .into_iter()
            .map(|(name, n)| (name.into(), json!(n)))
            .collect(),
    )
}

pub(super) fn report_from_json(text: &str, location: &str) -> Result<CleanReport> {
    let value: Value = from_json(text, location)?;
    let missing = |name: &str| damaged(location, &format!("no count {name:?}"));
    let count = |name: &str| match value.get(name) {
        None => Ok(None),
        Some(n) => n
            .as_u64()
            .map(|n| Some(n as usize))
            .ok_or_else(|| missing(name)),
    };
    CleanReport::from_counts(count, missing)
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

pub(super) fn quality_from_json(text: &str, location: &str) -> Result<Quality> {
    let value: Value = from_json(text, location)?;
    let number = |name: &str| -> Result<f64> {
        value
            .get(name)
            .and_then(Value::as_f64)
            .ok_or_else(|| damaged(location, &format!("no number {name:?}")))
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
        // Stored before these were computed: a typical return lets the residual and the other terms
        // decide.
        quality.descriptor_return = TYPICAL_RETURN;
        quality.confidence = confidence::of_map(&quality);
    }
    Ok(quality)
}

/// Typical mean squared difference of descriptors between a vertex and the match of its match.
const TYPICAL_RETURN: f64 = 0.5;

/// Returns the expected correctness of a stored map at each vertex.
pub(super) fn confidence_of_row(row: &MapRow) -> Result<Confidence> {
    if row.confidence.is_empty() {
        let location = format!("maps {} {}", row.from, row.to);
        let quality = quality_from_json(&row.quality_json, &location)?;
        return Ok(Confidence::uniform(quality.confidence, row.p2p_21.len()));
    }
    Ok(Confidence {
        of_vertex: row.confidence.clone(),
    })
}

/// Returns the stored name of an operator.
pub(super) fn operator_name(operator: Operator) -> &'static str {
    match operator {
        Operator::Tufted => "tufted",
        Operator::Cotan => "cotan",
        Operator::MeshLaplace => "mesh-laplace",
    }
}

pub(super) fn operator_from_name(name: &str, location: &str) -> Result<Operator> {
    let all = [Operator::Tufted, Operator::Cotan, Operator::MeshLaplace];
    let found = all.into_iter().find(|o| operator_name(*o) == name);
    found.ok_or_else(|| damaged(location, &format!("no operator is named {name:?}")))
}

/// Returns the format of a stored name.
pub(super) fn format_from_name(name: &str, location: &str) -> Result<Format> {
    let found = Format::ALL.into_iter().find(|f| f.name() == name);
    found.ok_or_else(|| damaged(location, &format!("no format is named {name:?}")))
}

/// Returns the colour of a label by its id: the eight colours of Okabe and Ito, which colour-blind
/// people can distinguish, then golden-angle hues.
pub fn label_colour(id: u32) -> [u8; 3] {
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
