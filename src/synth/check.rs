//! Checks properties of generated meshes for tests.

use super::vector::{cross, dot, norm, sub};
use crate::mesh::TriMesh;
use std::collections::HashMap;

/// Checks that every directed edge occurs once, and its reverse once, and that every vertex is used
/// and its faces form one fan.
pub(super) fn closed_manifold(mesh: &TriMesh) {
    let mut next: HashMap<(u32, u32), u32> = HashMap::new();
    let mut degree = vec![0; mesh.vertices.len()];
    for &[a, b, c] in &mesh.faces {
        for (u, v, w) in [(a, b, c), (b, c, a), (c, a, b)] {
            assert!(u != v, "a face uses vertex {u} twice");
            assert!(
                next.insert((u, v), w).is_none(),
                "edge {u}-{v} has two faces on one side"
            );
            degree[u as usize] += 1;
        }
    }
    for &(u, v) in next.keys() {
        assert!(next.contains_key(&(v, u)), "edge {u}-{v} is a boundary");
    }
    let mut first: HashMap<u32, u32> = HashMap::new();
    for &(u, v) in next.keys() {
        first.insert(u, v);
    }
    for (u, &n) in degree.iter().enumerate() {
        let u = u as u32;
        assert!(n >= 3, "vertex {u} has {n} faces");
        let start = first[&u];
        let (mut v, mut steps) = (next[&(u, start)], 1);
        while v != start {
            v = next[&(u, v)];
            steps += 1;
        }
        assert_eq!(steps, n, "vertex {u} joins several fans");
    }
}

/// V - E + F of a closed mesh.
pub(super) fn euler_characteristic(mesh: &TriMesh) -> i64 {
    mesh.vertices.len() as i64 - mesh.faces.len() as i64 / 2
}

/// Positive when faces are counter-clockwise seen from outside.
pub(super) fn volume(mesh: &TriMesh) -> f64 {
    let corners = mesh
        .faces
        .iter()
        .map(|f| f.map(|v| mesh.vertices[v as usize]));
    corners.map(|[a, b, c]| dot(a, cross(b, c)) / 6.0).sum()
}

/// The least angle of any triangle, in degrees.
pub(super) fn least_angle(mesh: &TriMesh) -> f64 {
    angles(mesh).into_iter().fold(180.0, f64::min)
}

/// The least angle of each triangle, in degrees.
pub(super) fn angles(mesh: &TriMesh) -> Vec<f64> {
    let least = |f: &[u32; 3]| {
        let p = f.map(|v| mesh.vertices[v as usize]);
        let at = |k: usize| {
            let (u, v) = (sub(p[(k + 1) % 3], p[k]), sub(p[(k + 2) % 3], p[k]));
            norm(cross(u, v)).atan2(dot(u, v)).to_degrees()
        };
        at(0).min(at(1)).min(at(2))
    };
    mesh.faces.iter().map(least).collect()
}

/// Number of components, by faces across edges.
pub(super) fn n_components(mesh: &TriMesh) -> usize {
    let mut of = crate::labels::score::pieces(&mesh.faces, &vec![0; mesh.faces.len()]);
    of.sort_unstable();
    of.dedup();
    of.len()
}
