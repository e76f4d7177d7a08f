//! Finds the face nearest to a point.

use super::lanes::{Portable, Tests};
use super::wide::LANES;
use super::{Bvh, Entry, ROUNDING, Search};
use crate::mesh::{dot, sub};
use pulp::NullaryFnOnce;

impl Bvh {
    /// Euclidean distance from a point to a face.
    ///
    /// ```
    /// use coseg_geometry::mesh::{Bvh, TriMesh};
    ///
    /// let vertices = vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
    /// let tree = Bvh::new(&TriMesh { vertices, faces: vec![[0, 1, 2]] });
    /// assert_eq!(tree.distance_to(0, [0.0, 0.0, 2.0]), 2.0);
    /// ```
    ///
    /// # Panics
    /// If the face does not exist.
    pub fn distance_to(&self, face: u32, point: [f64; 3]) -> f64 {
        triangle_distance(&self.triangle(face), point)
    }

    /// The face with the least `distance to point + extra(face)`, and that sum; `None` when no sum
    /// is below `limit`. `extra` must not be negative. Of equal faces it returns the first in the
    /// order of the search, which is the same in every run.
    ///
    /// ```
    /// use coseg_geometry::mesh::{Bvh, FaceGeometry, Search, icosphere};
    ///
    /// let sphere = icosphere(2);
    /// let (tree, mut search) = (Bvh::new(&sphere), Search::default());
    /// let above = FaceGeometry::new(&sphere).centroids[40].map(|x| 1.5 * x);
    /// let found = tree.nearest(&mut search, above, f64::INFINITY, |_| 0.0);
    /// assert_eq!(found.map(|(face, _)| face), Some(40));
    /// // With a penalty on that face another one is nearest; within 0.1 there is none.
    /// let penalty = |face| if face == 40 { 1.0 } else { 0.0 };
    /// let other = tree.nearest(&mut search, above, f64::INFINITY, penalty);
    /// assert_ne!(other.map(|(face, _)| face), Some(40));
    /// assert_eq!(tree.nearest(&mut search, above, 0.1, |_| 0.0), None);
    /// ```
    pub fn nearest(
        &self,
        search: &mut Search,
        point: [f64; 3],
        limit: f64,
        extra: impl Fn(u32) -> f64,
    ) -> Option<(u32, f64)> {
        let query = Query {
            tree: self,
            point,
            limit,
            extra,
        };
        #[cfg(target_arch = "x86_64")]
        if let Some(simd) = super::lanes::V3::try_new() {
            return simd.vectorize(Nearest {
                query,
                search,
                tests: simd,
            });
        }
        let tests = Portable;
        Nearest {
            query,
            search,
            tests,
        }
        .call()
    }
}

struct Query<'a, F> {
    tree: &'a Bvh,
    point: [f64; 3],
    limit: f64,
    extra: F,
}

struct Nearest<'a, F, T> {
    query: Query<'a, F>,
    search: &'a mut Search,
    tests: T,
}

impl<F: Fn(u32) -> f64, T: Tests> NullaryFnOnce for Nearest<'_, F, T> {
    type Output = Option<(u32, f64)>;

    #[inline(always)]
    fn call(self) -> Self::Output {
        let (search, tests) = (self.search, self.tests);
        let Query {
            tree,
            point,
            limit,
            extra,
        } = self.query;
        let mut best = (None, limit);
        let mut square = to_square(limit);
        let single = point.map(|x| x as f32);
        let slack = single.map(|x| ROUNDING * x.abs());
        search.stack.clear();
        search.stack.push(Entry::ROOT);
        while let Some(entry) = search.stack.pop() {
            if entry.bound > square {
                continue;
            }
            if entry.count == 0 {
                let node = &tree.nodes[entry.first as usize];
                let (bounds, mask) = tests.squares(single, slack, node, square);
                search.push(node, &bounds, mask);
                continue;
            }
            let blocks = entry.first as usize..(entry.first + entry.count) as usize;
            for block in &tree.blocks[blocks] {
                for lane in (0..LANES).filter(|&lane| block.has(lane)) {
                    let added = extra(block.faces[lane]);
                    if added >= best.1 {
                        continue;
                    }
                    let sum = triangle_distance(&block.triangle(lane), point) + added;
                    if sum < best.1 {
                        best = (Some(block.faces[lane]), sum);
                        square = to_square(sum);
                    }
                }
            }
        }
        best.0.map(|face| (face, best.1))
    }
}

/// The limit that squared distances to boxes are compared with: rounded up.
#[inline(always)]
fn to_square(distance: f64) -> f32 {
    (distance * distance) as f32 * (1.0 + 4.0 * ROUNDING)
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
