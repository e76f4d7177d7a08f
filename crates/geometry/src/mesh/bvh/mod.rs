//! Finds the nearest face to a point and the first face on a ray by a box tree over the faces of a
//! mesh.
//!
//! The tree is built by binned surface-area splits (Wald 2007, *On fast Construction of SAH-based
//! Bounding Volume Hierarchies*), then widened to eight children for each node (Wald, Benthin and
//! Boulos 2008, *Getting Rid of Packets*): eight boxes are tested at once in single precision, four
//! triangles in double.

mod lanes;
mod nearest;
mod rays;
mod wide;

use super::{TriMesh, sub};
use rays::FanEntry;
use wide::{Block, LANES, Wide};

/// Faces in a leaf below which a split cannot pay.
const LEAF_FACES: usize = 2;
/// Candidate split planes along the widest axis.
const N_BINS: usize = 12;
/// At this depth nodes stay leaves, whatever their size: coincident faces cannot be separated.
const MAX_DEPTH: usize = 62;
/// An upper bound on the effect of single precision on a coordinate, and on a distance between such
/// points.
const ROUNDING: f32 = 1e-6;

#[derive(Debug, Clone, Copy)]
struct Node {
    low: [f64; 3],
    high: [f64; 3],
    /// Leaf: its first face in `order`. Inner node: its left child, which the right one follows.
    first: u32,
    /// Number of faces of a leaf; 0 for an inner node.
    count: u32,
}

/// Box tree over the faces of one mesh.
#[derive(Debug, Clone)]
pub struct Bvh {
    nodes: Vec<Wide>,
    /// Faces in leaf order, in blocks of four.
    blocks: Vec<Block>,
    /// For each face four times the index of its block, plus its lane in the block.
    slot: Vec<u32>,
}

/// The memory of a search, reusable for the next one.
#[derive(Debug, Clone, Default)]
pub struct Search {
    stack: Vec<Entry>,
    fans: Vec<FanEntry>,
}

/// An entry of the stack of nodes to visit.
#[derive(Debug, Clone, Copy)]
struct Entry {
    /// A node, or the first block of a leaf.
    first: u32,
    /// Blocks of a leaf; 0 for a node.
    count: u32,
    /// A lower bound of the distances inside it.
    bound: f32,
}

impl Entry {
    const ROOT: Self = Self {
        first: 0,
        count: 0,
        bound: 0.0,
    };
}

impl Search {
    /// Pushes the children of `node` that `mask` selects on the stack, the one with the least bound
    /// on top.
    #[inline(always)]
    fn push(&mut self, node: &Wide, bounds: &[f32; wide::WIDTH], mut mask: u32) {
        let base = self.stack.len();
        while mask != 0 {
            let child = mask.trailing_zeros() as usize;
            mask &= mask - 1;
            let entry = Entry {
                first: node.first[child],
                count: node.count[child],
                bound: bounds[child],
            };
            self.stack.push(entry);
            let mut at = self.stack.len() - 1;
            while at > base && self.stack[at - 1].bound < entry.bound {
                self.stack.swap(at, at - 1);
                at -= 1;
            }
        }
    }
}

#[derive(Clone, Copy)]
struct Bounds {
    low: [f64; 3],
    high: [f64; 3],
}

impl Bounds {
    const EMPTY: Self = Self {
        low: [f64::INFINITY; 3],
        high: [f64::NEG_INFINITY; 3],
    };

    fn grow(&mut self, other: &Self) {
        for i in 0..3 {
            self.low[i] = self.low[i].min(other.low[i]);
            self.high[i] = self.high[i].max(other.high[i]);
        }
    }

    fn half_area(&self) -> f64 {
        let d = sub(self.high, self.low);
        if d[0] < 0.0 {
            0.0
        } else {
            d[0] * d[1] + d[1] * d[2] + d[2] * d[0]
        }
    }
}

struct Builder {
    bounds: Vec<Bounds>,
    centers: Vec<[f64; 3]>,
    order: Vec<u32>,
    nodes: Vec<Node>,
}

impl Builder {
    /// Chooses the split of `order[start..end]` and reorders it; `None` for a leaf.
    fn split(&mut self, start: usize, end: usize, all: &Bounds) -> Option<usize> {
        if end - start <= LEAF_FACES {
            return None;
        }
        let mut centers = Bounds::EMPTY;
        for &f in &self.order[start..end] {
            let c = self.centers[f as usize];
            centers.grow(&Bounds { low: c, high: c });
        }
        let extent = sub(centers.high, centers.low);
        let axis = (0..3).fold(0, |a, b| if extent[b] > extent[a] { b } else { a });
        let middle = start + (end - start) / 2;
        if extent[axis] <= 0.0 {
            return Some(middle);
        }
        let (low, scale) = (centers.low[axis], N_BINS as f64 / extent[axis]);
        let bin = |c: [f64; 3]| (((c[axis] - low) * scale) as usize).min(N_BINS - 1);
        let mut bins = [(Bounds::EMPTY, 0_usize); N_BINS];
        for &f in &self.order[start..end] {
            let b = &mut bins[bin(self.centers[f as usize])];
            b.0.grow(&self.bounds[f as usize]);
            b.1 += 1;
        }
        let mut after = [0.0; N_BINS];
        let (mut sum, mut n) = (Bounds::EMPTY, 0);
        for i in (1..N_BINS).rev() {
            sum.grow(&bins[i].0);
            n += bins[i].1;
            after[i] = sum.half_area() * n as f64;
        }
        let (mut sum, mut n) = (Bounds::EMPTY, 0);
        let mut best = (f64::INFINITY, 0);
        for i in 1..N_BINS {
            sum.grow(&bins[i - 1].0);
            n += bins[i - 1].1;
            let cost = sum.half_area() * n as f64 + after[i];
            if n > 0 && n < end - start && cost < best.0 {
                best = (cost, i);
            }
        }
        // A flat box has no area, so all cuts cost the same; it is halved.
        if !best.0.is_finite() || all.half_area() <= 0.0 {
            let c = &self.centers;
            self.order[start..end].select_nth_unstable_by(middle - start, |&a, &b| {
                c[a as usize][axis]
                    .total_cmp(&c[b as usize][axis])
                    .then(a.cmp(&b))
            });
            return Some(middle);
        }
        let (mut left, mut right) = (Vec::new(), Vec::new());
        for &f in &self.order[start..end] {
            if bin(self.centers[f as usize]) < best.1 {
                left.push(f)
            } else {
                right.push(f)
            }
        }
        let at = start + left.len();
        self.order[start..at].copy_from_slice(&left);
        self.order[at..end].copy_from_slice(&right);
        Some(at)
    }

    fn build(&mut self) {
        let mut todo = vec![(0_usize, 0_usize, self.order.len(), 0_usize)];
        self.nodes.push(Node {
            low: [0.0; 3],
            high: [0.0; 3],
            first: 0,
            count: 0,
        });
        while let Some((node, start, end, depth)) = todo.pop() {
            let mut all = Bounds::EMPTY;
            for &f in &self.order[start..end] {
                all.grow(&self.bounds[f as usize]);
            }
            let at = if depth < MAX_DEPTH {
                self.split(start, end, &all)
            } else {
                None
            };
            let (first, count) = match at {
                None => (start, end - start),
                Some(at) => {
                    let left = self.nodes.len();
                    let empty = Node {
                        low: [0.0; 3],
                        high: [0.0; 3],
                        first: 0,
                        count: 0,
                    };
                    self.nodes.extend([empty, empty]);
                    todo.push((left, start, at, depth + 1));
                    todo.push((left + 1, at, end, depth + 1));
                    (left, 0)
                }
            };
            self.nodes[node] = Node {
                low: all.low,
                high: all.high,
                first: first as u32,
                count: count as u32,
            };
        }
    }
}

impl Bvh {
    /// The tree of a mesh's faces: O(m log m). A mesh without faces answers every query with
    /// `None`.
    ///
    /// ```
    /// use coseg_geometry::mesh::{Bvh, Search, icosphere};
    ///
    /// let tree = Bvh::new(&icosphere(3));
    /// let nearest = tree.nearest(&mut Search::default(), [0.0, 0.0, 3.0], 10.0, |_| 0.0);
    /// assert!(nearest.is_some_and(|(_, distance)| (distance - 2.0).abs() < 0.01));
    /// ```
    pub fn new(mesh: &TriMesh) -> Self {
        let bounds: Vec<Bounds> = (0..mesh.faces.len())
            .map(|f| {
                mesh.corners(f).iter().fold(Bounds::EMPTY, |mut b, &p| {
                    b.grow(&Bounds { low: p, high: p });
                    b
                })
            })
            .collect();
        let centers = bounds
            .iter()
            .map(|b| std::array::from_fn(|i| 0.5 * b.low[i] + 0.5 * b.high[i]))
            .collect();
        let order = (0..mesh.faces.len() as u32).collect();
        let mut builder = Builder {
            bounds,
            centers,
            order,
            nodes: Vec::new(),
        };
        builder.build();
        let mut slot = vec![0; mesh.faces.len()];
        let (nodes, blocks) = wide::widen(&builder, mesh);
        for (at, &face) in (0_u32..).zip(blocks.iter().flat_map(|b| &b.faces)) {
            if let Some(slot) = slot.get_mut(face as usize) {
                *slot = at;
            }
        }
        Self {
            nodes,
            blocks,
            slot,
        }
    }

    /// Corner of a face and the two edges from it.
    fn triangle(&self, face: u32) -> [[f64; 3]; 3] {
        let slot = self.slot[face as usize] as usize;
        self.blocks[slot / LANES].triangle(slot % LANES)
    }
}

#[cfg(test)]
mod tests {
    use super::{Bvh, Search};
    use crate::mesh::{TriMesh, distance, scale, unit, zoo};

    fn nearest(bvh: &Bvh, point: [f64; 3], extra: impl Fn(u32) -> f64) -> Option<(u32, f64)> {
        bvh.nearest(&mut Search::default(), point, f64::INFINITY, extra)
    }

    #[test]
    fn nearest_and_first_hit_are_those_of_a_full_search() {
        let mesh = zoo::sphere(3);
        let bvh = Bvh::new(&mesh);
        let single: Vec<Bvh> = (0..mesh.faces.len())
            .map(|f| {
                Bvh::new(&TriMesh {
                    faces: vec![mesh.faces[f]],
                    ..mesh.clone()
                })
            })
            .collect();
        for i in 0..60 {
            let t = i as f64;
            let p = [t.sin() * 0.7, (1.7 * t).cos(), (0.3 * t).sin() * 0.4];
            let full = single
                .iter()
                .map(|b| nearest(b, p, |_| 0.0).unwrap().1)
                .fold(f64::INFINITY, f64::min);
            assert_eq!(nearest(&bvh, p, |_| 0.0).unwrap().1, full);
            let d = unit([(2.1 * t).cos(), t.cos(), 0.2]);
            let cast = |b: &Bvh| {
                let mut lengths = Vec::new();
                b.cast(&mut Search::default(), p, &[d], u32::MAX, &mut lengths);
                lengths[0]
            };
            let full = single.iter().map(cast).fold(f64::INFINITY, f64::min);
            assert_eq!(cast(&bvh), full);
        }
    }

    #[test]
    fn extra_cost_decides_between_the_sides_of_a_thin_wall() {
        let mesh = zoo::thin_plate();
        let bvh = Bvh::new(&mesh);
        let top = |f: u32| mesh.corners(f as usize)[0][2] > 0.0;
        let p = [0.4, 0.3, 0.0];
        for wanted in [true, false] {
            let (face, _) = nearest(&bvh, p, |f| if top(f) == wanted { 0.0 } else { 1.0 }).unwrap();
            assert_eq!(top(face), wanted);
        }
    }

    #[test]
    fn no_faces_no_answers() {
        let bvh = Bvh::new(&TriMesh::default());
        assert_eq!(nearest(&bvh, [0.0; 3], |_| 0.0), None);
        let mut lengths = Vec::new();
        bvh.cast(
            &mut Search::default(),
            [0.0; 3],
            &[[0.0, 0.0, 1.0]],
            0,
            &mut lengths,
        );
        assert_eq!(lengths, [f64::INFINITY]);
    }

    #[test]
    fn coincident_faces_are_found() {
        let mut mesh = zoo::sphere(1);
        mesh.faces = vec![mesh.faces[0]; 500];
        let bvh = Bvh::new(&mesh);
        let corner = mesh.corners(0)[0];
        let p = scale(corner, 2.0);
        let (_, d) = nearest(&bvh, p, |_| 0.0).unwrap();
        assert!((d - distance(p, corner)).abs() < 1e-12);
    }
}
