//! Meshes the zero set of a smooth function of space as a closed triangle mesh, at lattice
//! resolution.
//!
//! Marching tetrahedra on the Kuhn subdivision of a cubic lattice, followed from a seed cube to
//! cube across faces that the surface crosses (J. Bloomenthal, "An implicit surface polygonizer",
//! 1994). Tetrahedra leave no ambiguous case, so the mesh is closed, edge-manifold and
//! outward-oriented for any function. Following the surface costs in proportion to its area and
//! yields one component.

use super::vector::{Vec3, mix};
use crate::mesh::TriMesh;
use std::collections::hash_map::Entry;
use std::collections::{HashMap, HashSet, VecDeque};
use std::hash::{BuildHasherDefault, Hasher};

/// A lattice node, 20 bits for each axis.
type Node = [i32; 3];

/// Half the maximum number of nodes of an axis.
const REACH: i32 = 1 << 19;

/// Least distance of a crossing from a node, relative to its edge; nearer crossings would make
/// triangles without area.
const MARGIN: f64 = 0.05;

/// Hashes packed lattice nodes; they are internal, so no attacker chooses them.
#[derive(Default)]
struct NodeHasher(u64);

impl Hasher for NodeHasher {
    fn finish(&self) -> u64 {
        self.0
    }

    fn write(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            self.write_u64(u64::from(byte));
        }
    }

    fn write_u64(&mut self, key: u64) {
        let mixed = (self.0 ^ key).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        self.0 = mixed ^ (mixed >> 29);
    }
}

type Hashed = BuildHasherDefault<NodeHasher>;

fn pack(node: Node) -> u64 {
    node.iter()
        .fold(0, |key, &x| (key << 20) | (x + REACH) as u64)
}

/// The values at lattice nodes, each computed once.
struct Lattice<F> {
    origin: Vec3,
    cell: f64,
    value: F,
    known: HashMap<u64, f64, Hashed>,
}

impl<F: Fn(Vec3) -> f64> Lattice<F> {
    fn position(&self, node: Node) -> Vec3 {
        [0, 1, 2].map(|k| self.origin[k] + self.cell * f64::from(node[k]))
    }

    fn at(&mut self, node: Node) -> f64 {
        let position = self.position(node);
        match self.known.entry(pack(node)) {
            Entry::Occupied(entry) => *entry.get(),
            Entry::Vacant(entry) => *entry.insert((self.value)(position)),
        }
    }

    /// Values at the corners of a cube; bit k of the index is the step along axis k.
    fn corners(&mut self, cube: Node) -> [f64; 8] {
        std::array::from_fn(|i| self.at(corner(cube, i)))
    }
}

fn corner(cube: Node, i: usize) -> Node {
    [0, 1, 2].map(|k| cube[k] + (i >> k & 1) as i32)
}

/// Each path from corner 0 to corner 7 is a tetrahedron, in an order of positive volume.
const TETRAHEDRA: [[usize; 4]; 6] = [
    [0, 1, 3, 7],
    [0, 2, 6, 7],
    [0, 4, 5, 7],
    [0, 3, 2, 7],
    [0, 6, 4, 7],
    [0, 5, 1, 7],
];

/// The component of `value = 0` that is first on the way from `seed` along the first axis, with
/// cubes of side `cell`. `None` if there is no surface within `reach`.
///
/// `value` must be negative inside a bounded region. Features thinner than a cell may be lost.
pub(super) fn surface(
    value: impl Fn(Vec3) -> f64,
    seed: Vec3,
    cell: f64,
    reach: f64,
) -> Option<TriMesh> {
    let mut lattice = Lattice {
        origin: seed,
        cell,
        value,
        known: HashMap::default(),
    };
    let limit = ((reach / cell) as i32).min(REACH - 2);
    let start = (0..limit)
        .map(|i| [i, 0, 0])
        .find(|&c| crossed(&lattice.corners(c), 0xff))?;

    let mut mesh = TriMesh::default();
    let mut crossing: HashMap<u64, u32, Hashed> = HashMap::default();
    let mut seen: HashSet<u64, Hashed> = HashSet::default();
    let mut queue = VecDeque::from([start]);
    seen.insert(pack(start));
    while let Some(cube) = queue.pop_front() {
        let values = lattice.corners(cube);
        for (k, side) in [(0, 0), (0, 1), (1, 0), (1, 1), (2, 0), (2, 1)] {
            let mask = (0..8)
                .filter(|i| i >> k & 1 == side)
                .fold(0, |m, i| m | 1 << i);
            let mut next = cube;
            next[k] += 2 * side - 1;
            if crossed(&values, mask) && next[k].abs() < limit && seen.insert(pack(next)) {
                queue.push_back(next);
            }
        }
        let mut vertex = |a: usize, b: usize| {
            let (a, b) = (a.min(b), a.max(b));
            // Along a Kuhn edge the steps only increase, so its lower node and its steps identify
            // it.
            let key = pack(corner(cube, a)) << 3 | (b ^ a) as u64;
            *crossing.entry(key).or_insert_with(|| {
                let t = (values[a] / (values[a] - values[b])).clamp(MARGIN, 1.0 - MARGIN);
                let (p, q) = (corner(cube, a), corner(cube, b));
                mesh.vertices
                    .push(mix(lattice.position(p), lattice.position(q), t));
                (mesh.vertices.len() - 1) as u32
            })
        };
        for tetrahedron in TETRAHEDRA {
            let (n_inside, [a, b, c, d]) = inside_first(tetrahedron, &values);
            match n_inside {
                1 => mesh.faces.push([vertex(a, b), vertex(a, c), vertex(a, d)]),
                2 => {
                    let quad = [vertex(a, c), vertex(a, d), vertex(b, d), vertex(b, c)];
                    mesh.faces.push([quad[0], quad[1], quad[2]]);
                    mesh.faces.push([quad[0], quad[2], quad[3]]);
                }
                3 => mesh.faces.push([vertex(a, d), vertex(b, d), vertex(c, d)]),
                _ => {}
            }
        }
    }
    Some(mesh)
}

/// Whether the corners in `mask` lie on both sides.
fn crossed(values: &[f64; 8], mask: u32) -> bool {
    let inside = (0..8)
        .filter(|&i| values[i] < 0.0)
        .fold(0, |m, i| m | 1 << i)
        & mask;
    inside != 0 && inside != mask
}

/// The number of corners inside, and the corners in an order of positive volume with those first.
fn inside_first(mut t: [usize; 4], values: &[f64; 8]) -> (usize, [usize; 4]) {
    let mut n_inside = 0;
    let mut odd = false;
    for i in 0..4 {
        if values[t[i]] < 0.0 {
            odd ^= i != n_inside;
            t.swap(i, n_inside);
            n_inside += 1;
        }
    }
    if odd {
        // Swapping two corners on the same side keeps them sorted; with 1 or 2 inside the last two
        // are outside.
        if n_inside <= 2 {
            t.swap(2, 3)
        } else {
            t.swap(0, 1)
        }
    }
    (n_inside, t)
}

#[cfg(test)]
mod tests {
    use super::surface;
    use crate::synth::check;
    use crate::synth::vector::norm;

    #[test]
    fn a_ball_is_closed_and_has_its_volume() {
        let mesh = surface(|p| norm(p) - 1.0, [0.0; 3], 0.1, 5.0).unwrap();
        check::closed_manifold(&mesh);
        assert_eq!(check::euler_characteristic(&mesh), 2);
        let volume = check::volume(&mesh);
        // A lattice of 0.1 cuts off about curvature·cell²/8 of depth; MARGIN adds noise of this
        // size.
        assert!((volume - 4.18879).abs() < 0.06, "{volume}");
    }

    #[test]
    fn a_torus_has_one_hole() {
        let tube = |p: [f64; 3]| norm([norm([p[0], p[1], 0.0]) - 1.0, p[2], 0.0]) - 0.3;
        let mesh = surface(tube, [1.0, 0.0, 0.0], 0.09, 5.0).unwrap();
        check::closed_manifold(&mesh);
        assert_eq!(check::euler_characteristic(&mesh), 0);
    }

    #[test]
    fn noise_still_gives_a_manifold() {
        // These values are not smooth, so every case of every tetrahedron occurs.
        let noise = |p: [f64; 3]| {
            let key = p.iter().fold(1u64, |k, x| {
                (k ^ ((x * 16.0).round() as i64 as u64)).wrapping_mul(0x9e37_79b9_7f4a_7c15)
                    ^ k >> 31
            });
            if norm(p) > 1.0 {
                1.0
            } else {
                (key >> 40) as f64 / (1 << 24) as f64 - 0.6
            }
        };
        let mesh = surface(noise, [0.0; 3], 0.0625, 5.0).unwrap();
        assert!(mesh.faces.len() > 1000);
        check::closed_manifold(&mesh);
    }

    #[test]
    fn nothing_to_find_is_said() {
        assert_eq!(surface(|_| 1.0, [0.0; 3], 0.1, 5.0), None);
    }
}
