//! Converts arrays of descriptions, and maps between shapes.

use super::errors::{field_error, frame_error};
use crate::fmap::consistency::Standing;
use crate::fmap::{PointMap, Quality, Side};
use crate::ipc::frames::{FrameReader, FrameWriter};
use crate::ipc::wire::{self, ErrorReason};
use crate::library::{InputShape, MapInfo, PartMatch, PointRequest, PolygonValues, Resolution};
use crate::pipeline::DescriptionView;

/// Eigenvalues, optionally with eigenvectors and mass; `area` is in squared input units.
pub fn spectrum(
    d: &DescriptionView<'_>,
    area: f64,
    eigenvectors: bool,
    frames: &mut FrameWriter,
) -> wire::GetSpectrumReply {
    let n = d.vertices.len();
    wire::GetSpectrumReply {
        eigenvalues: Some(frames.f64_array(d.eigenvalues, &[d.eigenvalues.len()])),
        eigenvectors: eigenvectors
            .then(|| frames.f32_array(d.eigenvectors, &[n, d.n_eigenvectors])),
        mass: eigenvectors.then(|| frames.f32_array(d.mass, &[n])),
        area,
        resolution: wire::Resolution::Proxy.into(),
    }
}

/// The heat kernel signature.
pub fn hks(d: &DescriptionView<'_>, frames: &mut FrameWriter) -> wire::GetHksReply {
    let n = d.vertices.len();
    wire::GetHksReply {
        hks: Some(frames.f32_array(d.hks, &[n, d.hks.len() / n.max(1)])),
        resolution: wire::Resolution::Proxy.into(),
    }
}

/// Eigenvalues, with eigenvectors and mass at a resolution; `area` is in squared input units.
pub fn spectrum_at(
    shape: &InputShape,
    area: f64,
    resolution: Resolution,
    frames: &mut FrameWriter,
) -> wire::GetSpectrumReply {
    let (d, n) = (shape.view(), shape.n_rows(resolution));
    let eigenvectors = shape.interpolate(d.eigenvectors, d.n_eigenvectors, resolution);
    wire::GetSpectrumReply {
        eigenvalues: Some(frames.f64_array(d.eigenvalues, &[d.eigenvalues.len()])),
        eigenvectors: Some(frames.f32_array(&eigenvectors, &[n, d.n_eigenvectors])),
        mass: Some(frames.f32_array(shape.mass(resolution), &[n])),
        area,
        resolution: resolution_to_wire(resolution).into(),
    }
}

/// The heat kernel signature at a resolution.
pub fn hks_at(
    shape: &InputShape,
    resolution: Resolution,
    frames: &mut FrameWriter,
) -> wire::GetHksReply {
    let d = shape.view();
    let n_times = d.hks.len() / d.vertices.len().max(1);
    let hks = shape.interpolate(d.hks, n_times, resolution);
    wire::GetHksReply {
        hks: Some(frames.f32_array(&hks, &[shape.n_rows(resolution), n_times])),
        resolution: resolution_to_wire(resolution).into(),
    }
}

/// The rows that a request wants; without a resolution `default`.
pub fn resolution(wanted: wire::Resolution, default: Resolution) -> Resolution {
    match wanted {
        wire::Resolution::Unspecified => default,
        wire::Resolution::Proxy => Resolution::Proxy,
        wire::Resolution::Input => Resolution::Vertices,
        wire::Resolution::InputFaces => Resolution::Polygons,
    }
}

fn resolution_to_wire(resolution: Resolution) -> wire::Resolution {
    match resolution {
        Resolution::Proxy => wire::Resolution::Proxy,
        Resolution::Vertices => wire::Resolution::Input,
        Resolution::Polygons => wire::Resolution::InputFaces,
    }
}

/// The proxy and its descriptors.
pub fn descriptors(d: &DescriptionView<'_>, frames: &mut FrameWriter) -> wire::GetDescriptorsReply {
    let (n, m, polygons) = (d.vertices.len(), d.faces.len(), d.face_map.len());
    wire::GetDescriptorsReply {
        vertices: Some(frames.f32_array(d.vertices.as_flattened(), &[n, 3])),
        faces: Some(frames.u32_array(d.faces.as_flattened(), &[m, 3])),
        face_descriptors: Some(frames.f32_array(d.face_descriptors, &[m, d.n_descriptors])),
        patches: Some(frames.u32_array(d.patches, &[m])),
        face_map: Some(frames.u32_array(d.face_map, &[polygons])),
        polygon_area: Some(frames.f32_array(d.polygon_area, &[polygons])),
        signature: Some(frames.f32_array(d.signature, &[d.signature.len()])),
    }
}

fn quality(q: &Quality) -> wire::MapQuality {
    wire::MapQuality {
        descriptor_residual: q.descriptor_residual,
        orthogonality: q.orthogonality,
        coverage: q.coverage,
        near_zero: q.near_zero,
        matched: Some(q.matched),
        ..wire::MapQuality::default()
    }
}

fn point_quality(map: &PointMap) -> wire::MapQuality {
    wire::MapQuality {
        round_trip: Some(map.assessment.round_trip),
        smoothness: Some(map.assessment.smoothness),
        orientation: Some(map.orientation),
        expected_error: Some(map.expected_error),
        ..quality(&map.quality)
    }
}

fn part_quality(q: &Quality) -> wire::MapQuality {
    wire::MapQuality {
        descriptor_return: Some(q.descriptor_return),
        confidence: Some(q.confidence),
        ..quality(q)
    }
}

/// 1 for each vertex with a counterpart, else 0.
fn matched(matched: impl Iterator<Item = bool>, frames: &mut FrameWriter) -> wire::ArrayRef {
    let flags: Vec<u32> = matched.map(u32::from).collect();
    frames.u32_array(&flags, &[flags.len()])
}

/// The options of a request for a map between points.
pub fn point_request(options: &wire::PointMapOptions) -> PointRequest {
    PointRequest {
        landmarks: options.landmarks.iter().map(|l| [l.from, l.to]).collect(),
        side: match options.orientation() {
            wire::MapOrientation::Unspecified => Side::Preferred,
            wire::MapOrientation::Keep => Side::Keep,
            wire::MapOrientation::Reverse => Side::Reverse,
        },
        k: options.k as usize,
        alternative: options.alternative,
    }
}

/// A map between points, and its alternative if there is one.
pub fn point_maps(maps: &[PointMap], frames: &mut FrameWriter) -> wire::GetFunctionalMapReply {
    let mut reply = wire::GetFunctionalMapReply::default();
    if let Some(map) = maps.first() {
        reply.c_12 = Some(frames.f32_array(&map.c_12, &[map.k, map.k]));
        reply.p2p_21 = Some(frames.u32_array(&map.p2p_21, &[map.p2p_21.len()]));
        reply.quality = Some(point_quality(map));
        reply.matched = Some(matched(map.matched.iter().copied(), frames));
        if let Some(other) = maps.get(1) {
            reply.alternative_c_12 = Some(frames.f32_array(&other.c_12, &[other.k, other.k]));
            reply.alternative_p2p_21 = Some(frames.u32_array(&other.p2p_21, &[other.p2p_21.len()]));
            reply.alternative_quality = Some(point_quality(other));
            reply.alternative_matched = Some(matched(other.matched.iter().copied(), frames));
            reply.alternative_cost = Some(other.cost / map.cost.max(1e-300));
        }
    }
    reply
}

/// Values at polygons: int32 labels with one axis, or float32 functions with one or two.
pub fn polygon_values(
    values: Option<&wire::ArrayRef>,
    frames: FrameReader<'_>,
) -> Result<PolygonValues, wire::Error> {
    let field = "values";
    let axes = |n: usize, most: usize| {
        let text = format!("{field} has {n} axes, but may have 1 to {most}");
        field_error(ErrorReason::FieldRange, field, text)
    };
    if values.map(wire::ArrayRef::dtype) == Some(wire::DataType::Int32) {
        let read = frames.i32_array(values, field);
        let (labels, extents) = read.map_err(|e| frame_error(&e))?;
        return match extents[..] {
            [_] => Ok(PolygonValues::Labels(labels)),
            _ => Err(axes(extents.len(), 1)),
        };
    }
    let read = frames.f32_array(values, field);
    let (functions, extents) = read.map_err(|e| frame_error(&e))?;
    match extents[..] {
        [_] => Ok(PolygonValues::Functions(functions, 1)),
        [_, dim] if dim > 0 => Ok(PolygonValues::Functions(functions, dim)),
        _ => Err(axes(extents.len(), 2)),
    }
}

/// Transferred values.
pub fn transferred(
    values: &PolygonValues,
    map: &PointMap,
    resolution: Resolution,
    frames: &mut FrameWriter,
) -> wire::TransferFunctionReply {
    let values = match values {
        PolygonValues::Labels(labels) => frames.i32_array(labels, &[labels.len()]),
        PolygonValues::Functions(x, 1) => frames.f32_array(x, &[x.len()]),
        PolygonValues::Functions(x, dim) => frames.f32_array(x, &[x.len() / dim, *dim]),
    };
    wire::TransferFunctionReply {
        values: Some(values),
        quality: Some(point_quality(map)),
        resolution: resolution_to_wire(resolution).into(),
    }
}

/// A functional map.
pub fn functional_map(map: &MapInfo, frames: &mut FrameWriter) -> wire::GetFunctionalMapReply {
    let n = map.p2p_21.len();
    let at: Vec<Option<f64>> = (0..n).map(|v| map.confidence.at(v)).collect();
    let confidence: Vec<f32> = at.iter().map(|c| c.unwrap_or(0.0) as f32).collect();
    wire::GetFunctionalMapReply {
        c_12: Some(frames.f32_array(&map.c_12, &[map.k2, map.k1])),
        p2p_21: Some(frames.u32_array(&map.p2p_21, &[n])),
        quality: Some(part_quality(&map.quality)),
        matched: Some(matched(at.iter().map(Option::is_some), frames)),
        confidence: Some(frames.f32_array(&confidence, &[n])),
        ..wire::GetFunctionalMapReply::default()
    }
}

/// Adds to a map the number of rows of the source shape at the map's resolution.
pub fn from_rows(
    map: wire::GetFunctionalMapReply,
    n1: usize,
    resolution: Resolution,
) -> wire::GetFunctionalMapReply {
    wire::GetFunctionalMapReply {
        n1: u32::try_from(n1).unwrap_or(u32::MAX),
        resolution: resolution_to_wire(resolution).into(),
        ..map
    }
}

/// The agreement of a map with the others of its collection.
pub fn agreement(standing: Standing) -> wire::MapAgreement {
    wire::MapAgreement {
        n_triangles: u32::try_from(standing.n_triangles).unwrap_or(u32::MAX),
        departure: standing.departure,
        inconsistent: standing.inconsistent,
    }
}

/// Matching parts.
pub fn part_correspondence(matches: &[PartMatch], q: &Quality) -> wire::GetPartCorrespondenceReply {
    let matches = matches.iter().map(|m| wire::PartMatch {
        part_a: m.part_a,
        part_b: m.part_b,
        label_a: m.label_a,
        label_b: m.label_b,
        overlap: m.overlap,
    });
    wire::GetPartCorrespondenceReply {
        matches: matches.collect(),
        quality: Some(part_quality(q)),
    }
}

/// Neighbours with their distances.
pub fn nearest(neighbors: Vec<(String, f64)>) -> wire::NearestReply {
    let neighbors = neighbors
        .into_iter()
        .map(|(shape, distance)| wire::Neighbor { shape, distance });
    wire::NearestReply {
        neighbors: neighbors.collect(),
    }
}
