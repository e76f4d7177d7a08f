//! The bytes of a mesh and a bundle become labels.

use super::content::{Arriving, Bundle};
use crate::library::collection::discovered::NewShape;
use crate::library::event::EventKind;
use crate::library::isolate::DescribeJob;
use crate::library::placement::placement;
use crate::library::reason::{Code, Reason};
use crate::library::refusal::failure;
use crate::library::rows::from_json;
use crate::library::sources::FileView;
use crate::library::submit::algorithm;
use crate::library::types::{Failure, LabelId, PartInfo, Source};
use crate::mesh::{CleanReport, Format};
use crate::store::Digest;
use crate::store::rows::confidence_from_u8;
use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// The labels of a mesh, as the library would give them to it when the bundle was made.
#[derive(Debug, Clone, PartialEq)]
pub struct LabelledMesh {
    /// Label of each polygon of the bytes `(n_polygons,)`, in their order.
    pub labels: Vec<i32>,
    /// Probability of the label of each polygon `(n_polygons,)`, 0 to 1.
    pub confidence: Vec<f32>,
    /// Its parts: connected pieces of one label, largest first.
    pub parts: Vec<PartInfo>,
    /// Labels in use in the collection that no polygon has, in ascending order.
    pub missing: Vec<LabelId>,
    /// The shapes that voted for its labels.
    pub sources: Vec<Source>,
    /// What cleaning found and did.
    pub report: CleanReport,
    /// Area in squared input units.
    pub area: f64,
    /// BLAKE3 of the bytes.
    pub content_digest: Digest,
    /// Number of functional maps that were computed.
    pub n_maps: u32,
    /// If the shape clustered the collection again: whether the labels that were found are new
    /// ones.
    pub reclustered: Option<bool>,
}

/// Labels a mesh as the library would when the bundle was made, bit for bit on the same kind of
/// processor. Depends on nothing else: neither on other meshes nor on the number of threads. Writes
/// nothing.
///
/// # Errors
/// The mesh is refused, for the same reasons and with the same message as by the library; or the
/// work on it panicked.
pub fn label(
    bytes: &[u8],
    format: Format,
    bundle: &Bundle,
) -> std::result::Result<LabelledMesh, Failure> {
    // Everything that a panic could leave half done is dropped with it, but the prepared shapes,
    // each of which is whole.
    let labelled = AssertUnwindSafe(|| labelled(bytes, format, bundle));
    catch_unwind(labelled).unwrap_or_else(|panic| Err(panicked(&*panic)))
}

fn labelled(
    bytes: &[u8],
    format: Format,
    bundle: &Bundle,
) -> std::result::Result<LabelledMesh, Failure> {
    let (params, params_json) = &bundle.params;
    let job = DescribeJob {
        bytes,
        format,
        params: params.clone(),
    };
    let description = job.run(&|_| true)?;
    let digest = Digest::of(bytes);
    let algorithm = algorithm(&description.report);
    let new = NewShape {
        arrays: FileView {
            view: description.view(),
            file: Digest::of_description(&digest, params_json, &algorithm),
        },
        digest,
    };
    let sources = Arriving {
        bundle,
        digest,
        bytes,
    };
    let found = placement(&bundle.collection, &sources, &new, format.name());
    let found = found.map_err(|e| failure(&e))?;
    let row = found.labels.row;
    let parts = from_json(&found.labels.summary.parts_json, "parts");
    let voters = from_json(&row.sources_json, "sources");
    let is_missing = |l: &LabelId| !row.polygon_labels.contains(&(*l as i32));
    let mut missing = found.plan.model.model.labels.clone();
    missing.retain(is_missing);
    missing.sort_unstable();
    missing.dedup();
    let confidence = row.polygon_confidence.into_iter().map(confidence_from_u8);
    Ok(LabelledMesh {
        labels: row.polygon_labels,
        confidence: confidence.collect(),
        parts: parts.map_err(|e| failure(&e))?,
        missing,
        sources: voters.map_err(|e| failure(&e))?,
        report: description.report,
        area: description.area,
        content_digest: digest,
        n_maps: found.n_maps as u32,
        reclustered: match found.plan.reclustered {
            Some(EventKind::Reclustered { accepted, .. }) => Some(accepted),
            _ => None,
        },
    })
}

fn panicked(panic: &(dyn Any + Send)) -> Failure {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    let text = text.or_else(|| panic.downcast_ref::<&str>().copied());
    Failure {
        code: Code::Internal,
        reason: Reason::Panic,
        message: format!(
            "the work on this shape panicked: {}",
            text.unwrap_or("no message")
        ),
        subject: None,
    }
}
