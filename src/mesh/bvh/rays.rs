//! The first face on a ray: four boxes at a time, in single precision, then triangles in double.

use super::{Bvh, Node, STACK};
use crate::mesh::{cross, dot, sub};

/// Four boxes side by side, tested against a ray together: the binary tree with every second level
/// left out.
#[derive(Debug, Clone, Copy)]
pub(super) struct Quad {
    /// By axis and child; padded, so that rounding to single precision cannot lose a hit.
    low: [[f32; 4]; 3],
    high: [[f32; 4]; 3],
    /// Leaf: first face in `order`. Inner: its quad.
    first: [u32; 4],
    /// Faces of a leaf; 0 for an inner child; `NO_CHILD` for none.
    count: [u32; 4],
}

const NO_CHILD: u32 = u32::MAX;
/// Padding of single-precision boxes, relative to the largest coordinate.
const PADDING: f64 = 1e-6;

impl Bvh {
    /// Distance along `direction` (in its units) to the first face the ray from `origin` meets, from
    /// either side, other than face `except`; `None` when it meets none.
    pub fn cast(&self, origin: [f64; 3], direction: [f64; 3], except: u32) -> Option<f64> {
        if self.order.is_empty() {
            return None;
        }
        let o = origin.map(|x| x as f32);
        // A ray along an axis: a reciprocal that is huge, but 0 times it is 0 and not NaN.
        let inverse = direction.map(|x| {
            if x.abs() < 1e-30 {
                1e30
            } else {
                (1.0 / x) as f32
            }
        });
        let mut best = f64::INFINITY;
        // Each quad is two levels and leaves at most three entries behind.
        let mut stack = [(0_u32, 0_u32, 0.0_f32); 2 * STACK];
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let (first, count, entry) = stack[depth];
            if f64::from(entry) >= best {
                continue;
            }
            if count > 0 {
                for i in first as usize..(first + count) as usize {
                    if self.order[i] != except {
                        let t = hit(&self.triangles[i], origin, direction);
                        best = if t < best { t } else { best };
                    }
                }
                continue;
            }
            let quad = &self.quads[first as usize];
            let enter = quad_entries(quad, o, inverse, best as f32);
            let base = depth;
            for (child, &entry) in enter.iter().enumerate() {
                if quad.count[child] == NO_CHILD || entry.is_infinite() {
                    continue;
                }
                // Insertion: the nearest on top.
                let mut at = depth;
                while at > base && stack[at - 1].2 < entry {
                    stack[at] = stack[at - 1];
                    at -= 1;
                }
                stack[at] = (quad.first[child], quad.count[child], entry);
                depth += 1;
            }
        }
        best.is_finite().then_some(best)
    }
}

/// The binary tree, two levels at a time; quad 0 is the root.
pub(super) fn quads(nodes: &[Node]) -> Vec<Quad> {
    let corners = [&nodes[0].low, &nodes[0].high];
    let largest = corners
        .into_iter()
        .flatten()
        .fold(0.0, |m: f64, x| m.max(x.abs()));
    let padding = PADDING * largest;
    let empty = Quad {
        low: [[0.0; 4]; 3],
        high: [[0.0; 4]; 3],
        first: [0; 4],
        count: [NO_CHILD; 4],
    };
    let mut result = vec![empty];
    if nodes.len() == 1 && nodes[0].count == 0 {
        return result;
    }
    let mut todo = vec![(0_usize, 0_usize)];
    while let Some((node, at)) = todo.pop() {
        let children = |n: usize| [nodes[n].first as usize, nodes[n].first as usize + 1];
        let leaf = |n: usize| nodes[n].count > 0;
        let mut members = Vec::with_capacity(4);
        if leaf(node) {
            members.push(node);
        } else {
            for child in children(node) {
                if leaf(child) {
                    members.push(child)
                } else {
                    members.extend(children(child))
                }
            }
        }
        for (slot, &member) in members.iter().enumerate() {
            let (first, count) = if leaf(member) {
                (nodes[member].first, nodes[member].count)
            } else {
                result.push(empty);
                todo.push((member, result.len() - 1));
                (result.len() as u32 - 1, 0)
            };
            let quad = &mut result[at];
            for axis in 0..3 {
                quad.low[axis][slot] = (nodes[member].low[axis] - padding) as f32;
                quad.high[axis][slot] = (nodes[member].high[axis] + padding) as f32;
            }
            quad.first[slot] = first;
            quad.count[slot] = count;
        }
    }
    result
}

/// Where a ray enters each of four boxes; infinite when it misses it or enters beyond `limit`.
#[inline]
fn quad_entries(quad: &Quad, origin: [f32; 3], inverse: [f32; 3], limit: f32) -> [f32; 4] {
    // Comparisons rather than `min` and `max`: nothing is NaN here, and four of them are one instruction.
    let lesser = |a: f32, b: f32| if a < b { a } else { b };
    let greater = |a: f32, b: f32| if a > b { a } else { b };
    let (mut enter, mut leave) = ([0.0_f32; 4], [limit; 4]);
    for axis in 0..3 {
        for i in 0..4 {
            let a = (quad.low[axis][i] - origin[axis]) * inverse[axis];
            let b = (quad.high[axis][i] - origin[axis]) * inverse[axis];
            enter[i] = greater(enter[i], lesser(a, b));
            leave[i] = lesser(leave[i], greater(a, b));
        }
    }
    std::array::from_fn(|i| {
        if enter[i] <= leave[i] {
            enter[i]
        } else {
            f32::INFINITY
        }
    })
}

/// Distance along a ray to a triangle from either side, infinite for a miss (Möller and Trumbore 1997,
/// *Fast, Minimum Storage Ray/Triangle Intersection*).
#[inline]
fn hit([a, ab, ac]: &[[f64; 3]; 3], origin: [f64; 3], direction: [f64; 3]) -> f64 {
    let p = cross(direction, *ac);
    let det = dot(*ab, p);
    let sign = 1.0_f64.copysign(det);
    let size = det.abs();
    let s = sub(origin, *a);
    let u = dot(s, p) * sign;
    if u < 0.0 || u > size || size == 0.0 {
        return f64::INFINITY;
    }
    let q = cross(s, *ab);
    let v = dot(direction, q) * sign;
    if v < 0.0 || u + v > size {
        return f64::INFINITY;
    }
    let t = dot(*ac, q) / det;
    if t > 0.0 { t } else { f64::INFINITY }
}

#[cfg(test)]
mod tests {
    use super::Bvh;
    use crate::mesh::{norm, scale, unit, zoo};

    #[test]
    fn rays_from_the_middle_of_a_sphere_travel_its_radius() {
        let mesh = zoo::sphere(3);
        let bvh = Bvh::new(&mesh);
        let radius = norm(mesh.vertices[0]);
        for direction in [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.3, 0.4, 0.5]] {
            let t = bvh.cast([0.0; 3], unit(direction), u32::MAX).unwrap();
            assert!((t - radius).abs() < 0.02 * radius, "{t} against {radius}");
            // In the units of the direction.
            let half = bvh
                .cast([0.0; 3], scale(unit(direction), 2.0), u32::MAX)
                .unwrap();
            assert!((half - 0.5 * t).abs() < 1e-12);
        }
        assert_eq!(bvh.cast([9.0, 0.0, 0.0], [1.0, 0.0, 0.0], u32::MAX), None);
    }
}
