//! Computes the intrinsic Delaunay Laplacian of the tufted cover of any triangle mesh. It has no
//! negative weights, and needs no manifold edges, orientation or well-shaped triangles.
//!
//! Sharp and Crane, *A Laplacian for Nonmanifold Triangle Meshes*, 2020. Each face gets a front and
//! a back; around every edge neighbouring sides are glued, which closes boundaries and separates
//! the sheets of non-manifold edges. The cover's edge lengths are mollified (all are lengthened by
//! the same small amount that makes every triangle safely a triangle), its edges are flipped until
//! Delaunay, and half of its cotangent weights and areas are the result.

use super::{Edge, cross, difference, distance, dot};
use crate::mesh::TriMesh;

/// Slack of the triangle inequality, in mean edge lengths.
const MOLLIFICATION: f64 = 1e-6;

/// An edge is flipped if its cotangent weight is below minus this.
const DELAUNAY_SLACK: f64 = 1e-6;

/// Side `side` of cover face `face`: from corner `side` to corner `side + 1`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Side {
    face: u32,
    side: u8,
}

impl Side {
    fn next(self) -> Self {
        Self {
            face: self.face,
            side: (self.side + 1) % 3,
        }
    }

    fn slot(self) -> usize {
        3 * self.face as usize + usize::from(self.side)
    }

    fn from_slot(slot: usize) -> Self {
        Self {
            face: (slot / 3) as u32,
            side: (slot % 3) as u8,
        }
    }
}

/// A closed intrinsic triangulation. For each side (three for each face) it holds the start vertex,
/// the length, and the side on the other face. Glued sides run in opposite directions.
pub(super) struct Cover {
    tails: Vec<u32>,
    lengths: Vec<f64>,
    glued: Vec<Side>,
}

/// A triangle of the cover, which has no place in space: only lengths.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct IntrinsicFace {
    /// Its vertices; one may come more than once.
    pub(crate) corners: [u32; 3],
    /// Where the corners lie in a plane of their own: at (0, 0), (x₁, 0) and (x₂, y₂), y₂ > 0.
    pub(crate) x1: f64,
    pub(crate) x2: f64,
    pub(crate) y2: f64,
}

/// The flipped cover.
pub(super) fn tufted(mesh: &TriMesh) -> Cover {
    let mut cover = Cover::new(mesh);
    cover.flip_to_delaunay();
    cover
}

/// The three edge lengths of each face, in the order of its sides, mollified.
fn mollified_lengths(mesh: &TriMesh, n_edges: usize, edge_total: f64) -> Vec<[f64; 3]> {
    let mut lengths: Vec<[f64; 3]> = mesh
        .faces
        .iter()
        .map(|f| {
            let p = f.map(|v| mesh.vertices[v as usize]);
            [
                distance(p[0], p[1]),
                distance(p[1], p[2]),
                distance(p[2], p[0]),
            ]
        })
        .collect();
    let slack = MOLLIFICATION * edge_total / n_edges as f64;
    let mut added = 0.0f64;
    for l in &lengths {
        for i in 0..3 {
            added = added.max(l[i] + slack - l[(i + 1) % 3] - l[(i + 2) % 3]);
        }
    }
    for l in lengths.iter_mut().flatten() {
        *l += added;
    }
    lengths
}

impl Cover {
    /// Face f of the mesh becomes faces 2f (front) and 2f + 1 (back, reversed).
    fn new(mesh: &TriMesh) -> Self {
        // All sides of the mesh, sorted by the edge they lie on.
        let mut sides: Vec<([u32; 2], u32, u8)> = Vec::with_capacity(3 * mesh.faces.len());
        for (f, corners) in mesh.faces.iter().enumerate() {
            for s in 0..3 {
                let (a, b) = (corners[s], corners[(s + 1) % 3]);
                sides.push(([a.min(b), a.max(b)], f as u32, s as u8));
            }
        }
        sides.sort_unstable();
        let (mut n_edges, mut edge_total) = (0, 0.0);
        for group in sides.chunk_by(|a, b| a.0 == b.0) {
            let [a, b] = group[0].0.map(|v| mesh.vertices[v as usize]);
            n_edges += 1;
            edge_total += distance(a, b);
        }
        let lengths = mollified_lengths(mesh, n_edges, edge_total);
        let mut cover = Self {
            tails: Vec::with_capacity(6 * mesh.faces.len()),
            lengths: Vec::with_capacity(6 * mesh.faces.len()),
            glued: vec![Side { face: 0, side: 0 }; 6 * mesh.faces.len()],
        };
        for (corners, l) in mesh.faces.iter().zip(&lengths) {
            let [a, b, c] = *corners;
            cover.tails.extend([a, b, c, b, a, c]);
            // The back runs b → a → c → b: its sides lie on ab, ca, bc.
            cover.lengths.extend([l[0], l[1], l[2], l[0], l[2], l[1]]);
        }
        for group in sides.chunk_by(|a, b| a.0 == b.0) {
            cover.glue_around(mesh, group);
        }
        cover
    }

    /// Glues the sides around one edge: a face of each sheet to the facing side of the next sheet.
    fn glue_around(&mut self, mesh: &TriMesh, group: &[([u32; 2], u32, u8)]) {
        let [a, b] = group[0].0;
        let mut sheets: Vec<(f64, u32, u8)> = group.iter().map(|g| (0.0, g.1, g.2)).collect();
        if sheets.len() > 2 {
            let origin = mesh.vertices[a as usize];
            let axis = difference(mesh.vertices[b as usize], origin);
            let opposite = |f: u32, s: u8| {
                let v = mesh.faces[f as usize][(usize::from(s) + 2) % 3];
                difference(mesh.vertices[v as usize], origin)
            };
            let reference = opposite(sheets[0].1, sheets[0].2);
            let normal = cross(axis, reference);
            let tangent = cross(normal, axis);
            let scale = dot(axis, axis).sqrt();
            for sheet in &mut sheets {
                let p = opposite(sheet.1, sheet.2);
                let (x, y) = (dot(tangent, p), dot(normal, p) * scale);
                sheet.0 = y.atan2(x);
            }
            sheets.sort_by(|p, q| p.0.total_cmp(&q.0).then(p.1.cmp(&q.1)));
        }
        // Seen against the axis ab, a face that runs from a to b shows its front to the sheet that
        // follows counter-clockwise, and one that runs from b to a its back.
        let sides = |&(_, f, s): &(f64, u32, u8)| {
            let front = Side {
                face: 2 * f,
                side: s,
            };
            // Sides 0, 1, 2 of the front lie on the same edges as sides 0, 2, 1 of the back.
            let back = Side {
                face: 2 * f + 1,
                side: (3 - s) % 3,
            };
            let along = mesh.faces[f as usize][usize::from(s)] == a;
            if along { (front, back) } else { (back, front) }
        };
        for (i, sheet) in sheets.iter().enumerate() {
            let following = &sheets[(i + 1) % sheets.len()];
            let (towards, _) = sides(sheet);
            let (_, facing) = sides(following);
            self.glued[towards.slot()] = facing;
            self.glued[facing.slot()] = towards;
        }
    }

    /// Cotangent of the angle opposite `side`.
    fn cotangent(&self, side: Side) -> f64 {
        let (a, b, c) = self.face_lengths(side);
        (b * b + c * c - a * a) / (4.0 * area(a, b, c))
    }

    /// Lengths of `side` and the two that follow it.
    fn face_lengths(&self, side: Side) -> (f64, f64, f64) {
        let (second, third) = (side.next(), side.next().next());
        (
            self.lengths[side.slot()],
            self.lengths[second.slot()],
            self.lengths[third.slot()],
        )
    }

    fn weight(&self, side: Side) -> f64 {
        0.5 * (self.cotangent(side) + self.cotangent(self.glued[side.slot()]))
    }

    fn flip_to_delaunay(&mut self) {
        let mut queue: Vec<usize> = (0..self.tails.len()).rev().collect();
        let mut queued = vec![true; self.tails.len()];
        // Flips end, since each lowers the Dirichlet energy. Rounding could make a cycle of
        // cocircular ones, which the slack prevents. The bound guards against unknown cases only.
        let mut budget = 200 * self.tails.len();
        while let Some(slot) = queue.pop() {
            queued[slot] = false;
            let side = Side::from_slot(slot);
            let other = self.glued[slot];
            if other.face == side.face || self.weight(side) >= -DELAUNAY_SLACK || budget == 0 {
                continue;
            }
            budget -= 1;
            self.flip(side);
            for face in [side.face, other.face] {
                for s in 0..3 {
                    let slot = Side { face, side: s }.slot();
                    if !queued[slot] {
                        queued[slot] = true;
                        queue.push(slot);
                    }
                }
            }
        }
    }

    /// Replaces the diagonal `side` of the quadrilateral of its two faces by the other one.
    fn flip(&mut self, side: Side) {
        let other = self.glued[side.slot()];
        // Face 1: i j k with side ij; face 2: j i l with side ji.
        let (jk, ki) = (side.next(), side.next().next());
        let (il, lj) = (other.next(), other.next().next());
        let (i, j) = (self.tails[side.slot()], self.tails[other.slot()]);
        let (k, l) = (self.tails[ki.slot()], self.tails[lj.slot()]);
        let lengths = [jk, ki, il, lj].map(|s| self.lengths[s.slot()]);
        let diagonal = {
            let base = self.lengths[side.slot()];
            let apex = |to_i: f64, to_j: f64| {
                let x = (base * base + to_i * to_i - to_j * to_j) / (2.0 * base);
                (x, 2.0 * area(base, to_i, to_j) / base)
            };
            let (kx, ky) = apex(lengths[1], lengths[0]);
            let (lx, ly) = apex(lengths[2], lengths[3]);
            (kx - lx).hypot(ky + ly)
        };
        // Neighbours may be sides of these two faces themselves, so their indices are kept.
        let old = [jk, ki, il, lj];
        let across = old.map(|s| self.glued[s.slot()]);
        // New face 1: k i l (sides ki, il, lk); new face 2: l j k (sides lj, jk, kl).
        let new_side = |face: u32, s: u8| Side { face, side: s };
        let (f1, f2) = (side.face, other.face);
        let new = [
            new_side(f2, 1),
            new_side(f1, 0),
            new_side(f1, 1),
            new_side(f2, 0),
        ];
        for (s, tail) in [
            (new_side(f1, 0), k),
            (new_side(f1, 1), i),
            (new_side(f1, 2), l),
            (new_side(f2, 0), l),
            (new_side(f2, 1), j),
            (new_side(f2, 2), k),
        ] {
            self.tails[s.slot()] = tail;
        }
        for (s, length) in new.iter().zip(lengths) {
            self.lengths[s.slot()] = length;
        }
        let renamed = |s: Side| match old.iter().position(|&o| o == s) {
            Some(p) => new[p],
            None => s,
        };
        for (s, neighbour) in new.iter().zip(across) {
            let neighbour = renamed(neighbour);
            self.glued[s.slot()] = neighbour;
            self.glued[neighbour.slot()] = *s;
        }
        let (one, two) = (new_side(f1, 2), new_side(f2, 2));
        for (s, opposite) in [(one, two), (two, one)] {
            self.lengths[s.slot()] = diagonal;
            self.glued[s.slot()] = opposite;
        }
    }

    /// The triangles; the Laplacian is half of the sum of theirs.
    pub(super) fn faces(&self) -> Vec<IntrinsicFace> {
        let face = |face: u32| {
            let side = Side { face, side: 0 };
            let (a, b, c) = self.face_lengths(side);
            IntrinsicFace {
                corners: std::array::from_fn(|s| self.tails[side.slot() + s]),
                x1: a,
                x2: (a * a + c * c - b * b) / (2.0 * a),
                y2: 2.0 * area(a, b, c) / a,
            }
        };
        (0..self.tails.len() as u32 / 3).map(face).collect()
    }

    /// Edge weights (all ≥ -1e-6) and vertex masses.
    pub(super) fn weights(&self, n_vertices: usize) -> (Vec<Edge>, Vec<f64>) {
        let mut edges = Vec::with_capacity(self.tails.len());
        let mut mass = vec![0.0; n_vertices];
        for face in 0..self.tails.len() as u32 / 3 {
            let first = Side { face, side: 0 };
            let (a, b, c) = self.face_lengths(first);
            let sixth = area(a, b, c) / 6.0;
            for s in 0..3 {
                let side = Side { face, side: s };
                let (p, q) = (self.tails[side.slot()], self.tails[side.next().slot()]);
                edges.extend(Edge::new(p, q, 0.25 * self.cotangent(side)));
                mass[p as usize] += sixth;
            }
        }
        (edges, mass)
    }
}

/// Area from edge lengths (Kahan's form of Heron's formula, accurate for slivers).
fn area(a: f64, b: f64, c: f64) -> f64 {
    let (mut x, mut y, mut z) = (a, b, c);
    if x < y {
        std::mem::swap(&mut x, &mut y);
    }
    if y < z {
        std::mem::swap(&mut y, &mut z);
    }
    if x < y {
        std::mem::swap(&mut x, &mut y);
    }
    let product = (x + (y + z)) * (z - (x - y)) * (z + (x - y)) * (x + (y - z));
    0.25 * product.max(0.0).sqrt()
}
