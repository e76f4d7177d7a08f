//! A box tree over the faces of a mesh answers which face is nearest to a point or first on a ray.
//!
//! Built by binned surface-area splits (Wald 2007, *On fast Construction of SAH-based Bounding Volume
//! Hierarchies*). Rays meet four boxes at a time, in single precision.

mod rays;

use super::{TriMesh, dot, sub};
use rays::{Quad, quads};

/// Faces in a leaf below which a split cannot pay.
const LEAF_FACES: usize = 2;
/// Candidate split planes along the widest axis.
const N_BINS: usize = 12;
/// Depth of the traversal stack; at the depth it allows nodes stay leaves, whatever their size.
const STACK: usize = 64;

#[derive(Debug, Clone, Copy)]
struct Node {
    low: [f64; 3],
    high: [f64; 3],
    /// Leaf: first of its faces in `order`. Inner: left child; the right one follows it.
    first: u32,
    /// Faces of a leaf; 0 for an inner node.
    count: u32,
}

/// Box tree over the faces of one mesh.
#[derive(Debug, Clone)]
pub struct Bvh {
    nodes: Vec<Node>,
    quads: Vec<Quad>,
    /// Faces in leaf order.
    order: Vec<u32>,
    /// Corner and the two edges from it, of the faces in leaf order.
    triangles: Vec<[[f64; 3]; 3]>,
    /// Where each face is in `order`.
    place: Vec<u32>,
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
    /// Where to split `order[start..end]`, after reordering it; `None` for a leaf.
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
        // A flat box costs nothing wherever it is cut; then halve.
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
            // Below this depth a leaf of any size keeps the stack bounded.
            let at = if depth + 2 < STACK {
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
    /// The tree of a mesh's faces: O(m log m). A mesh without faces answers every query with `None`.
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
        let triangles = builder
            .order
            .iter()
            .map(|&f| {
                let [a, b, c] = mesh.corners(f as usize);
                [a, sub(b, a), sub(c, a)]
            })
            .collect();
        let mut place = vec![0; mesh.faces.len()];
        for (i, &f) in builder.order.iter().enumerate() {
            place[f as usize] = i as u32;
        }
        let quads = quads(&builder.nodes);
        Self {
            nodes: builder.nodes,
            quads,
            order: builder.order,
            triangles,
            place,
        }
    }

    /// Distance from a point to a face.
    pub fn distance_to(&self, face: u32, point: [f64; 3]) -> f64 {
        triangle_distance(&self.triangles[self.place[face as usize] as usize], point)
    }

    /// The face with the least `distance to point + extra(face)`, and that sum; `None` when no sum is
    /// below `limit`. `extra` is never negative. Of equal faces the first met, which is the same in
    /// every run.
    pub fn nearest(
        &self,
        point: [f64; 3],
        limit: f64,
        extra: impl Fn(u32) -> f64,
    ) -> Option<(u32, f64)> {
        let mut best = (None, limit);
        let mut stack = [0_u32; STACK];
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let node = &self.nodes[stack[depth] as usize];
            if box_distance(node, point) >= best.1 {
                continue;
            }
            if node.count > 0 || self.order.is_empty() {
                for i in node.first as usize..(node.first + node.count) as usize {
                    let sum = triangle_distance(&self.triangles[i], point) + extra(self.order[i]);
                    if sum < best.1 {
                        best = (Some(self.order[i]), sum);
                    }
                }
                continue;
            }
            let (left, right) = (node.first, node.first + 1);
            let nearer_left = box_distance(&self.nodes[left as usize], point)
                <= box_distance(&self.nodes[right as usize], point);
            let (near, far) = if nearer_left {
                (left, right)
            } else {
                (right, left)
            };
            stack[depth] = far;
            stack[depth + 1] = near;
            depth += 2;
        }
        best.0.map(|face| (face, best.1))
    }
}

#[inline]
fn box_distance(node: &Node, p: [f64; 3]) -> f64 {
    let d: [f64; 3] =
        std::array::from_fn(|i| (node.low[i] - p[i]).max(p[i] - node.high[i]).max(0.0));
    dot(d, d).sqrt()
}

/// Distance from a point to a triangle (Ericson, *Real-Time Collision Detection*, 5.1.5).
fn triangle_distance([a, ab, ac]: &[[f64; 3]; 3], point: [f64; 3]) -> f64 {
    let ap = sub(point, *a);
    let (d1, d2) = (dot(*ab, ap), dot(*ac, ap));
    let to = |s: f64, t: f64| {
        let r: [f64; 3] = std::array::from_fn(|i| ap[i] - s * ab[i] - t * ac[i]);
        dot(r, r).sqrt()
    };
    if d1 <= 0.0 && d2 <= 0.0 {
        return to(0.0, 0.0);
    }
    let (bb, bc, cc) = (dot(*ab, *ab), dot(*ab, *ac), dot(*ac, *ac));
    let (d3, d4) = (d1 - bb, d2 - bc);
    if d3 >= 0.0 && d4 <= d3 {
        return to(1.0, 0.0);
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return to(d1 / (d1 - d3), 0.0);
    }
    let (d5, d6) = (d1 - bc, d2 - cc);
    if d6 >= 0.0 && d5 <= d6 {
        return to(0.0, 1.0);
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return to(0.0, d2 / (d2 - d6));
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0 {
        let t = (d4 - d3) / ((d4 - d3) + (d5 - d6));
        return to(1.0 - t, t);
    }
    let sum = va + vb + vc;
    to(vb / sum, vc / sum)
}

#[cfg(test)]
mod tests {
    use super::Bvh;
    use crate::mesh::{TriMesh, distance, scale, unit, zoo};

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
                .map(|b| b.nearest(p, f64::INFINITY, |_| 0.0).unwrap().1)
                .fold(f64::INFINITY, f64::min);
            assert_eq!(bvh.nearest(p, f64::INFINITY, |_| 0.0).unwrap().1, full);
            let d = unit([(2.1 * t).cos(), t.cos(), 0.2]);
            let full = single
                .iter()
                .filter_map(|b| b.cast(p, d, u32::MAX))
                .fold(f64::INFINITY, f64::min);
            assert_eq!(bvh.cast(p, d, u32::MAX).unwrap_or(f64::INFINITY), full);
        }
    }

    #[test]
    fn extra_cost_decides_between_the_sides_of_a_thin_wall() {
        let mesh = zoo::thin_plate();
        let bvh = Bvh::new(&mesh);
        let top = |f: u32| mesh.corners(f as usize)[0][2] > 0.0;
        let p = [0.4, 0.3, 0.0];
        for wanted in [true, false] {
            let (face, _) = bvh
                .nearest(
                    p,
                    f64::INFINITY,
                    |f| if top(f) == wanted { 0.0 } else { 1.0 },
                )
                .unwrap();
            assert_eq!(top(face), wanted);
        }
    }

    #[test]
    fn no_faces_no_answers() {
        let bvh = Bvh::new(&TriMesh::default());
        assert_eq!(bvh.nearest([0.0; 3], f64::INFINITY, |_| 0.0), None);
        assert_eq!(bvh.cast([0.0; 3], [0.0, 0.0, 1.0], u32::MAX), None);
    }

    #[test]
    fn coincident_faces_are_found() {
        let mut mesh = zoo::sphere(1);
        mesh.faces = vec![mesh.faces[0]; 500];
        let bvh = Bvh::new(&mesh);
        let corner = mesh.corners(0)[0];
        let p = scale(corner, 2.0);
        let (_, d) = bvh.nearest(p, f64::INFINITY, |_| 0.0).unwrap();
        assert!((d - distance(p, corner)).abs() < 1e-12);
    }
}
