//! Computes the classical cotangent Laplacian of a mesh (Pinkall and Polthier 1993) with
//! barycentric lumped mass. Obtuse triangles give negative weights; W stays positive semidefinite.

use super::{Edge, LaplacianError, cross, difference, dot};
use crate::mesh::TriMesh;

/// Edge weights `(cot α + cot β) / 2` and vertex masses, a third of the area of the adjacent faces.
pub(super) fn cotan(mesh: &TriMesh) -> Result<(Vec<Edge>, Vec<f64>), LaplacianError> {
    let mut edges = Vec::with_capacity(3 * mesh.faces.len());
    let mut mass = vec![0.0; mesh.vertices.len()];
    for (face, corners) in mesh.faces.iter().enumerate() {
        let p = corners.map(|v| mesh.vertices[v as usize]);
        let normal = cross(difference(p[1], p[0]), difference(p[2], p[0]));
        let double_area = dot(normal, normal).sqrt();
        if !(double_area.is_normal()) {
            return Err(LaplacianError::DegenerateFace {
                face,
                area: 0.5 * double_area,
            });
        }
        for i in 0..3 {
            let (j, k) = ((i + 1) % 3, (i + 2) % 3);
            let cotangent = dot(difference(p[j], p[i]), difference(p[k], p[i])) / double_area;
            edges.extend(Edge::new(corners[j], corners[k], 0.5 * cotangent));
            mass[corners[i] as usize] += double_area / 6.0;
        }
    }
    Ok((edges, mass))
}
