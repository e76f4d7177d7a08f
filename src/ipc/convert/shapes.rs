//! Converts shapes, their labels and their bytes.

use super::jobs::mesh_format;
use super::questions::review;
use crate::ipc::frames::FrameWriter;
use crate::ipc::wire;
use crate::library::{Labels, ShapeInfo};
use crate::mesh::{CleanReport, Format};

/// The findings and actions of cleaning.
pub fn clean_report(r: &CleanReport) -> wire::CleanReport {
    wire::CleanReport {
        n_polygons: r.n_polygons as u64,
        n_triangles: r.n_triangles as u64,
        n_vertices: r.n_vertices as u64,
        n_welded_vertices: r.n_welded_vertices as u64,
        n_isolated_vertices: r.n_isolated_vertices as u64,
        n_degenerate_triangles: r.n_degenerate_triangles as u64,
        n_duplicate_triangles: r.n_duplicate_triangles as u64,
        n_nonmanifold_edges: r.n_nonmanifold_edges as u64,
        n_boundary_edges: r.n_boundary_edges as u64,
        n_components: r.n_components as u64,
        n_proxy_faces: r.n_proxy_faces as u64,
        n_proxy_vertices: r.n_proxy_vertices as u64,
        n_bridges: r.n_bridges as u64,
        n_flipped_triangles: r.n_flipped_triangles as u64,
        n_concave_polygons: r.n_concave_polygons as u64,
        n_nonplanar_polygons: r.n_nonplanar_polygons as u64,
        n_nonsimple_polygons: r.n_nonsimple_polygons as u64,
        n_tolerated_statements: r.n_tolerated_statements as u64,
        n_unread_statements: r.n_unread_statements as u64,
        n_inner_walls: r.n_inner_walls as u64,
        n_inner_triangles: r.n_inner_triangles as u64,
    }
}

/// A shape.
pub fn shape(s: &ShapeInfo) -> wire::Shape {
    let parts = s.parts.iter().map(|p| wire::Part {
        label: p.label,
        area_share: p.area_share,
        confidence: p.confidence,
    });
    let sources = s.sources.iter().map(|s| wire::Source {
        shape: s.shape.clone(),
        version: s.version,
        weight: s.weight,
    });
    wire::Shape {
        name: s.name.clone(),
        ordinal: s.ordinal,
        version: s.version,
        stale: s.stale,
        n_polygons: s.n_polygons,
        area: s.area,
        content_digest: s.content_digest.clone(),
        report: Some(clean_report(&s.report)),
        parts: parts.collect(),
        sources: sources.collect(),
        stored_bytes: s.stored_bytes,
        review: Some(review(&s.review)),
    }
}

/// Labels, optionally with confidence.
pub fn labels(l: &Labels, confidence: bool, frames: &mut FrameWriter) -> wire::GetLabelsReply {
    wire::GetLabelsReply {
        version: l.version,
        labels: Some(frames.i32_array(&l.labels, &[l.labels.len()])),
        confidence: confidence.then(|| frames.f32_array(&l.confidence, &[l.confidence.len()])),
    }
}

/// Labels of all shapes as of `sequence`.
pub fn labels_snapshot(
    sequence: u64,
    shapes: &[(String, Labels)],
    frames: &mut FrameWriter,
) -> wire::LabelsSnapshotReply {
    let shapes = shapes.iter().map(|(name, l)| wire::ShapeLabels {
        shape: name.clone(),
        version: l.version,
        labels: Some(frames.i32_array(&l.labels, &[l.labels.len()])),
    });
    wire::LabelsSnapshotReply {
        sequence,
        shapes: shapes.collect(),
    }
}

/// The bytes of a shape in their original form.
pub fn original(
    bytes: Vec<u8>,
    format: Format,
    frames: &mut FrameWriter,
) -> wire::GetOriginalReply {
    wire::GetOriginalReply {
        format: mesh_format(format).into(),
        bytes: Some(frames.file(bytes)),
    }
}
