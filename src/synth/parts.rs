//! Labels the faces of a mesh by the primitives of its scene.

use super::face_area;
use super::field::Scene;
use super::vector::scale;
use crate::labels::score::pieces;
use crate::mesh::TriMesh;
use std::collections::BTreeMap;

/// Pieces of one label below this share of the area are artefacts of a seam, not parts.
const LEAST_PIECE: f64 = 0.002;

/// Rounds of straightening seams; teeth of one face vanish after two.
const N_ROUNDS: usize = 3;

/// The label of the primitive nearest to each face, without teeth and small pieces along the seams.
pub(super) fn labels(scene: &Scene, mesh: &TriMesh) -> Vec<u32> {
    let centre = |face: &[u32; 3]| {
        let [a, b, c] = face.map(|v| mesh.vertices[v as usize]);
        scale(
            [a[0] + b[0] + c[0], a[1] + b[1] + c[1], a[2] + b[2] + c[2]],
            1.0 / 3.0,
        )
    };
    let mut labels: Vec<i32> = mesh
        .faces
        .iter()
        .map(|f| scene.label(centre(f)) as i32)
        .collect();
    let across = across(mesh);
    for _ in 0..N_ROUNDS {
        labels = straightened(&labels, &across);
    }
    let areas: Vec<f64> = mesh.faces.iter().map(|f| face_area(mesh, f)).collect();
    let least = LEAST_PIECE * areas.iter().sum::<f64>();
    // The smallest piece is relabelled first, since it may join two pieces to a larger one.
    while let Some((faces, label)) = smallest_crumb(mesh, &labels, &areas, &across, least) {
        for f in faces {
            labels[f] = label;
        }
    }
    labels.into_iter().map(|l| l as u32).collect()
}

/// The faces across the three edges of each face.
fn across(mesh: &TriMesh) -> Vec<[usize; 3]> {
    let mut edges: Vec<([u32; 2], usize, usize)> = Vec::with_capacity(3 * mesh.faces.len());
    for (f, face) in mesh.faces.iter().enumerate() {
        for k in 0..3 {
            let (a, b) = (face[k], face[(k + 1) % 3]);
            edges.push(([a.min(b), a.max(b)], f, k));
        }
    }
    edges.sort_unstable();
    let mut across = vec![[0; 3]; mesh.faces.len()];
    // The mesh is closed and manifold, so every edge occurs twice, in adjacent entries.
    for pair in edges.chunks_exact(2) {
        let ((_, f, i), (_, g, j)) = (pair[0], pair[1]);
        across[f][i] = g;
        across[g][j] = f;
    }
    across
}

/// Each face takes a label that two of its neighbours share if its own differs.
fn straightened(labels: &[i32], across: &[[usize; 3]]) -> Vec<i32> {
    let vote = |(label, near): (&i32, &[usize; 3])| {
        let [a, b, c] = near.map(|f| labels[f]);
        match (a == b || a == c, b == c) {
            (true, _) => a,
            (_, true) => b,
            _ => *label,
        }
    };
    labels.iter().zip(across).map(vote).collect()
}

/// The faces of the smallest piece below `least` that has a neighbour, and the label with which it
/// shares most edges.
fn smallest_crumb(
    mesh: &TriMesh,
    labels: &[i32],
    areas: &[f64],
    across: &[[usize; 3]],
    least: f64,
) -> Option<(Vec<usize>, i32)> {
    let piece_of = pieces(&mesh.faces, labels);
    let mut area_of: BTreeMap<usize, f64> = BTreeMap::new();
    for (piece, area) in piece_of.iter().zip(areas) {
        *area_of.entry(*piece).or_default() += area;
    }
    let small = area_of.iter().filter(|(_, area)| **area < least);
    let (&crumb, _) = small.min_by(|a, b| a.1.total_cmp(b.1).then(a.0.cmp(b.0)))?;
    let faces: Vec<usize> = (0..labels.len())
        .filter(|&f| piece_of[f] == crumb)
        .collect();
    let mut shared: BTreeMap<i32, usize> = BTreeMap::new();
    for g in faces.iter().flat_map(|&f| across[f]) {
        if labels[g] != labels[crumb] {
            *shared.entry(labels[g]).or_default() += 1;
        }
    }
    let (&label, _) = shared
        .iter()
        .max_by_key(|&(label, n)| (n, std::cmp::Reverse(label)))?;
    Some((faces, label))
}

#[cfg(test)]
mod tests {
    use super::{across, straightened};
    use crate::mesh::TriMesh;

    #[test]
    fn neighbours_across_edges() {
        let tetrahedron = TriMesh {
            vertices: vec![[0.0; 3]; 4],
            faces: vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]],
        };
        let near = across(&tetrahedron);
        assert_eq!(near, [[3, 2, 1], [0, 2, 3], [0, 3, 1], [0, 1, 2]]);
        // Outvoted by all three neighbours; a face with two neighbours of its own label keeps it.
        assert_eq!(straightened(&[7, 1, 1, 1], &near), [1, 1, 1, 1]);
    }
}
