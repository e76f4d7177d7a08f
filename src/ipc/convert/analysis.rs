//! Arrays of descriptions, maps between shapes.

use crate::fmap::Quality;
use crate::ipc::frames::FrameWriter;
use crate::ipc::wire;
use crate::library::{MapInfo, PartMatch};
use crate::pipeline::DescriptionView;

/// Eigenvalues, and eigenvectors with the mass if they are wanted; `area` in squared input units.
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
    }
}

/// The heat kernel signature.
pub fn hks(d: &DescriptionView<'_>, frames: &mut FrameWriter) -> wire::GetHksReply {
    let n = d.vertices.len();
    wire::GetHksReply {
        hks: Some(frames.f32_array(d.hks, &[n, d.hks.len() / n.max(1)])),
    }
}

/// The proxy and what was computed on it.
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
    }
}

/// A functional map.
pub fn functional_map(map: &MapInfo, frames: &mut FrameWriter) -> wire::GetFunctionalMapReply {
    wire::GetFunctionalMapReply {
        c_12: Some(frames.f32_array(&map.c_12, &[map.k2, map.k1])),
        p2p_21: Some(frames.u32_array(&map.p2p_21, &[map.p2p_21.len()])),
        quality: Some(quality(&map.quality)),
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
        quality: Some(quality(q)),
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
