//! Refines coarse triangles by halving the longest edge repeatedly.
//!
//! The globally longest edge is the longest of each face it borders, so angles stay bounded (Rivara
//! 1984, *Algorithms for refining triangular grids suitable for adaptive and multigrid
//! techniques*), and all faces around it are cut together, so no cracks open.

use super::{TriMesh, add, distance, scale};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

/// Halves edges, longest first, while `go_on(length of the longest edge, number of faces)`. The
/// surface does not change. O(log n) for each cut.
pub(crate) fn refine(mesh: &mut TriMesh, go_on: impl Fn(f64, usize) -> bool) {
    let mut faces_of: BTreeMap<[u32; 2], Vec<u32>> = BTreeMap::new();
    let mut queue = BinaryHeap::new();
    let key = |a: u32, b: u32| [a.min(b), a.max(b)];
    let entry = |mesh: &TriMesh, edge: [u32; 2]| {
        let [p, q] = edge.map(|v| mesh.vertices[v as usize]);
        // Non-negative doubles have the same order as their bits.
        (distance(p, q).to_bits(), Reverse(edge))
    };
    for (f, &[a, b, c]) in mesh.faces.iter().enumerate() {
        for edge in [key(a, b), key(b, c), key(c, a)] {
            let faces = faces_of.entry(edge).or_default();
            if faces.is_empty() {
                queue.push(entry(mesh, edge));
            }
            faces.push(f as u32);
        }
    }
    while let Some((bits, Reverse(edge))) = queue.pop() {
        if !go_on(f64::from_bits(bits), mesh.faces.len()) {
            break;
        }
        let [p, q] = edge.map(|v| mesh.vertices[v as usize]);
        let middle = mesh.vertices.len() as u32;
        mesh.vertices.push(scale(add(p, q), 0.5));
        let around = faces_of.remove(&edge).unwrap_or_default();
        let mut touched = Vec::new();
        for &f in &around {
            let face = mesh.faces[f as usize];
            let other = face.iter().position(|v| !edge.contains(v));
            let at = other.expect("invariant: a face has three different corners");
            let [c, a, b] = [face[at], face[(at + 1) % 3], face[(at + 2) % 3]];
            let new = mesh.faces.len() as u32;
            mesh.faces[f as usize] = [a, middle, c];
            mesh.faces.push([middle, b, c]);
            for face in faces_of.get_mut(&key(b, c)).into_iter().flatten() {
                if *face == f {
                    *face = new;
                }
            }
            for (end, half) in [(a, f), (b, new)] {
                faces_of.entry(key(end, middle)).or_default().push(half);
                touched.push(key(end, middle));
            }
            faces_of.entry(key(c, middle)).or_default().extend([f, new]);
            touched.push(key(c, middle));
        }
        touched.sort_unstable();
        touched.dedup();
        for edge in touched {
            queue.push(entry(mesh, edge));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::refine;
    use crate::mesh::adjacency::EdgeFaces;
    use crate::mesh::{FaceGeometry, zoo};

    #[test]
    fn the_surface_stays_and_no_crack_opens() {
        for (name, mesh) in zoo::clean_meshes() {
            let boundary = |m: &crate::mesh::TriMesh| {
                let edges = EdgeFaces::new(&m.faces);
                (0..edges.edges.len())
                    .filter(|&e| edges.around(e).len() == 1)
                    .map(|e| {
                        let [a, b] = edges.edges[e].map(|v| m.vertices[v as usize]);
                        crate::mesh::distance(a, b)
                    })
                    .sum::<f64>()
            };
            let mut fine = mesh.clone();
            let target = mesh.faces.len() + 300;
            refine(&mut fine, |_, n| n < target);
            assert!(fine.faces.len() >= target, "{name}");
            let area: f64 = FaceGeometry::new(&fine).areas.iter().sum();
            assert!((area - 1.0).abs() < 1e-9, "{name}: {area}");
            assert!((boundary(&fine) - boundary(&mesh)).abs() < 1e-9, "{name}");
        }
    }

    #[test]
    fn long_edges_are_halved_and_short_ones_left() {
        let mut mesh = zoo::grid(1, 1);
        for p in &mut mesh.vertices {
            p[0] *= 16.0;
        }
        refine(&mut mesh, |longest, _| longest > 2.0);
        for f in 0..mesh.faces.len() {
            let [a, b, c] = mesh.corners(f);
            let lengths = [(a, b), (b, c), (c, a)].map(|(p, q)| crate::mesh::distance(p, q));
            let longest = lengths.into_iter().fold(0.0, f64::max);
            // A cut leaves half of an edge longer than 2 in each piece.
            assert!(longest > 1.0 && longest <= 2.0, "face {f}: {longest}");
        }
    }
}
