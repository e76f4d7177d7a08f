//! Widens the binary tree to eight children for each node, with blocks of four triangles as leaves.

use super::{Bounds, Builder};
use crate::mesh::{TriMesh, sub};

/// Number of children of a node.
pub(super) const WIDTH: usize = 8;
/// Number of triangles of a block.
pub(super) const LANES: usize = 4;
/// Marks a lane without face in a block that is not full.
const NO_FACE: u32 = u32::MAX;
/// Padding of single-precision boxes, relative to the largest coordinate.
const PADDING: f64 = 1e-6;

/// Eight boxes side by side.
#[derive(Debug, Clone, Copy)]
pub(super) struct Wide {
    /// Low x, high x, low y, …, by child; padded, so that rounding to single precision never
    /// shrinks a box.
    pub(super) planes: [[f32; WIDTH]; 6],
    /// Leaf: its first block. Inner child: its node.
    pub(super) first: [u32; WIDTH],
    /// Blocks of a leaf; 0 for an inner child.
    pub(super) count: [u32; WIDTH],
    /// A bit for each child that exists.
    pub(super) children: u32,
}

/// Four triangles side by side.
#[derive(Debug, Clone, Copy)]
pub(super) struct Block {
    /// By coordinate and lane, like the edges; all zero in a lane without face.
    pub(super) corner: [[f64; LANES]; 3],
    /// From the corner to the next.
    pub(super) ab: [[f64; LANES]; 3],
    /// From the corner to the one after.
    pub(super) ac: [[f64; LANES]; 3],
    pub(super) faces: [u32; LANES],
}

impl Block {
    /// Corner and the two edges from it.
    #[inline(always)]
    pub(super) fn triangle(&self, lane: usize) -> [[f64; 3]; 3] {
        [&self.corner, &self.ab, &self.ac].map(|x| [x[0][lane], x[1][lane], x[2][lane]])
    }

    /// Whether there is a face in a lane.
    #[inline(always)]
    pub(super) fn has(&self, lane: usize) -> bool {
        self.faces[lane] != NO_FACE
    }
}

/// Nodes, the root first, and blocks.
pub(super) fn widen(binary: &Builder, mesh: &TriMesh) -> (Vec<Wide>, Vec<Block>) {
    let nodes = &binary.nodes;
    // Faces of each subtree are neighbours in `order`; children come after their parents.
    let mut ranges = vec![(0, 0); nodes.len()];
    for (i, node) in nodes.iter().enumerate().rev() {
        let first = node.first as usize;
        ranges[i] = if node.count > 0 || binary.order.is_empty() {
            (first, first + node.count as usize)
        } else {
            (ranges[first].0, ranges[first + 1].1)
        };
    }
    let len = |n: usize| ranges[n].1 - ranges[n].0;
    let leaf = |n: usize| nodes[n].count > 0 || len(n) <= LANES;
    let bounds = |n: usize| Bounds {
        low: nodes[n].low,
        high: nodes[n].high,
    };
    let largest = [nodes[0].low, nodes[0].high]
        .iter()
        .flatten()
        .fold(0.0, |m: f64, x| m.max(x.abs()));
    let padding = PADDING * largest;
    let empty = Wide {
        planes: [[0.0; WIDTH]; 6],
        first: [0; WIDTH],
        count: [0; WIDTH],
        children: 0,
    };
    let (mut result, mut blocks) = (vec![empty], Vec::new());
    if binary.order.is_empty() {
        return (result, blocks);
    }
    let mut todo = vec![(0, 0)];
    while let Some((node, at)) = todo.pop() {
        let mut members = vec![node];
        while members.len() < WIDTH {
            // The largest box is the one that rays meet most often, so it is opened.
            let open = (0..members.len()).filter(|&i| !leaf(members[i]));
            let area = |i: usize| bounds(members[i]).half_area();
            let Some(i) = open.reduce(|a, b| if area(b) > area(a) { b } else { a }) else {
                break;
            };
            let first = nodes[members[i]].first as usize;
            members.splice(i..=i, [first, first + 1]);
        }
        for (slot, &member) in members.iter().enumerate() {
            let (first, count) = if leaf(member) {
                let from = blocks.len();
                let faces = &binary.order[ranges[member].0..ranges[member].1];
                blocks.extend(faces.chunks(LANES).map(|faces| block(mesh, faces)));
                (from, blocks.len() - from)
            } else {
                result.push(empty);
                todo.push((member, result.len() - 1));
                (result.len() - 1, 0)
            };
            let wide = &mut result[at];
            for axis in 0..3 {
                wide.planes[2 * axis][slot] = (nodes[member].low[axis] - padding) as f32;
                wide.planes[2 * axis + 1][slot] = (nodes[member].high[axis] + padding) as f32;
            }
            wide.first[slot] = first as u32;
            wide.count[slot] = count as u32;
            wide.children |= 1 << slot;
        }
    }
    (result, blocks)
}

fn block(mesh: &TriMesh, faces: &[u32]) -> Block {
    let mut block = Block {
        corner: [[0.0; LANES]; 3],
        ab: [[0.0; LANES]; 3],
        ac: [[0.0; LANES]; 3],
        faces: [NO_FACE; LANES],
    };
    for (lane, &face) in faces.iter().enumerate() {
        let [a, b, c] = mesh.corners(face as usize);
        let (ab, ac) = (sub(b, a), sub(c, a));
        for axis in 0..3 {
            block.corner[axis][lane] = a[axis];
            block.ab[axis][lane] = ab[axis];
            block.ac[axis][lane] = ac[axis];
        }
        block.faces[lane] = face;
    }
    block
}
