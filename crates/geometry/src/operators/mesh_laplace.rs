//! Computes the mesh Laplacian of Belkin, Sun and Wang, *Discrete Laplace Operator on Meshed
//! Surfaces*, 2008, in symmetric form: it has heat-kernel weights between all vertices that are
//! near each other in space.
//!
//! `K_ij = a_i a_j exp(-d_ij² / 4h) / (4π h²)`, `W = diag(K 1) - K`, `A = diag(a)`, with vertex
//! areas a (a third of the faces around) and `h = ē² / 4` for the mean edge length ē. Its spectrum
//! is bounded by about 1/h: only eigenvalues far below that approximate those of the surface.

use super::{Edge, cross, difference, distance, dot};
use crate::mesh::TriMesh;
use std::collections::HashMap;

/// Weights below this share of the largest possible one are omitted.
const TRUNCATION: f64 = 1e-6;

/// Edge weights and vertex masses.
pub(super) fn mesh_laplace(mesh: &TriMesh) -> (Vec<Edge>, Vec<f64>) {
    let mut mass = vec![0.0; mesh.vertices.len()];
    let mut mesh_edges: Vec<[u32; 2]> = Vec::with_capacity(3 * mesh.faces.len());
    for corners in &mesh.faces {
        let p = corners.map(|v| mesh.vertices[v as usize]);
        let normal = cross(difference(p[1], p[0]), difference(p[2], p[0]));
        let third = dot(normal, normal).sqrt() / 6.0;
        for i in 0..3 {
            mass[corners[i] as usize] += third;
            let (a, b) = (corners[i], corners[(i + 1) % 3]);
            mesh_edges.push([a.min(b), a.max(b)]);
        }
    }
    mesh_edges.sort_unstable();
    mesh_edges.dedup();
    let total: f64 = mesh_edges
        .iter()
        .map(|&[a, b]| distance(mesh.vertices[a as usize], mesh.vertices[b as usize]))
        .sum();
    let mean = total / mesh_edges.len() as f64;
    if !(mean > 0.0 && mean.is_finite()) {
        // All vertices coincide: the masses are zero, which the caller rejects.
        return (Vec::new(), mass);
    }
    let h = 0.25 * mean * mean;
    let radius = (-4.0 * h * TRUNCATION.ln()).sqrt();
    let scale = 1.0 / (4.0 * std::f64::consts::PI * h * h);
    let mut edges = Vec::new();
    for_near_pairs(&mesh.vertices, radius, |i, j, squared| {
        let kernel = scale * (-squared / (4.0 * h)).exp();
        edges.extend(Edge::new(
            i,
            j,
            mass[i as usize] * mass[j as usize] * kernel,
        ));
    });
    (edges, mass)
}

/// Calls `f(i, j, d²)` once for each pair of points nearer than `radius`, in a fixed order, by a
/// grid of cells of that size.
fn for_near_pairs(points: &[[f64; 3]], radius: f64, mut f: impl FnMut(u32, u32, f64)) {
    let origin: [f64; 3] =
        std::array::from_fn(|d| points.iter().map(|p| p[d]).fold(f64::INFINITY, f64::min));
    // Cells are numbered up to 2⁵³ along an axis, far beyond any mesh that fits into memory: the
    // radius is a few mean edge lengths.
    let cell_of = |p: &[f64; 3]| -> [i64; 3] {
        std::array::from_fn(|d| ((p[d] - origin[d]) / radius) as i64)
    };
    let mut cells: HashMap<[i64; 3], Vec<u32>> = HashMap::with_capacity(points.len() / 8);
    for (i, p) in points.iter().enumerate() {
        cells.entry(cell_of(p)).or_default().push(i as u32);
    }
    let squared_radius = radius * radius;
    for (i, p) in points.iter().enumerate() {
        let [x, y, z] = cell_of(p);
        for dx in -1..=1 {
            for dy in -1..=1 {
                for dz in -1..=1 {
                    let Some(cell) = cells.get(&[x + dx, y + dy, z + dz]) else {
                        continue;
                    };
                    for &j in cell.iter().filter(|&&j| j as usize > i) {
                        let d = difference(*p, points[j as usize]);
                        let squared = dot(d, d);
                        if squared < squared_radius {
                            f(i as u32, j, squared);
                        }
                    }
                }
            }
        }
    }
}
