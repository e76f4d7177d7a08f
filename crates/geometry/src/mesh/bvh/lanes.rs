//! Provides the tests of the searches, on eight boxes or four triangles at a time.
//!
//! Each is written twice, with AVX instructions for processors that have them and without, because
//! compilers do not find the instructions by themselves. Both versions do the same operations in
//! the same order, so results are the same bits.

use super::wide::{Block, LANES, WIDTH, Wide};

/// Number of rays of a fan.
pub(super) const FAN: usize = 32;

/// Rays from one point, in single precision.
#[derive(Debug, Clone)]
pub(super) struct Fan {
    /// Reciprocals of the directions.
    pub(super) inverse: [[f32; 3]; FAN],
    /// The length to which each ray is followed, in units of its direction; negative if there is no
    /// ray.
    pub(super) limits: [f32; FAN],
}

impl Fan {
    /// Builds a fan of at most [`FAN`] directions.
    pub(super) fn new(directions: &[[f64; 3]]) -> Self {
        let mut fan = Self {
            inverse: [[1.0; 3]; FAN],
            limits: [-1.0; FAN],
        };
        for (i, direction) in directions.iter().enumerate() {
            fan.limits[i] = f32::INFINITY;
            // The reciprocal of a ray along an axis is huge but finite, so that 0 times it is 0 and
            // not NaN.
            fan.inverse[i] = direction.map(|x| {
                if x.abs() < 1e-30 {
                    1e30
                } else {
                    (1.0 / x) as f32
                }
            });
        }
        fan
    }
}

/// The tests. Each returns numbers, and a bit for each lane whose number is valid.
pub(super) trait Tests: Copy {
    /// The planes of a node as seen from a point.
    fn planes_from(self, point: [f32; 3], node: &Wide) -> [[f32; WIDTH]; 6];

    /// The boxes, of eight, that a ray enters before `limit`; `planes` are theirs, relative to its
    /// origin, and `inverse` has the reciprocals of its direction.
    fn enters(self, planes: &[[f32; WIDTH]; 6], inverse: [f32; 3], limit: f32) -> u32;

    /// The rays of a fan that are followed farther than `bound`.
    fn beyond(self, fan: &Fan, bound: f32) -> u32;

    /// Lower bounds of the squared distances from a point to eight boxes, and the boxes for which
    /// they are at most `limit`. Coordinates of the point are uncertain by `slack`.
    fn squares(
        self,
        point: [f32; 3],
        slack: [f32; 3],
        node: &Wide,
        limit: f32,
    ) -> ([f32; WIDTH], u32);

    /// Distances along a ray to four triangles, and the triangles that it meets, from either side
    /// (Möller and Trumbore 1997, *Fast, Minimum Storage Ray/Triangle Intersection*).
    fn hits(self, origin: [f64; 3], direction: [f64; 3], block: &Block) -> ([f64; LANES], u32);
}

/// The version for all processors.
#[derive(Debug, Clone, Copy)]
pub(super) struct Portable;

impl Tests for Portable {
    fn planes_from(self, point: [f32; 3], node: &Wide) -> [[f32; WIDTH]; 6] {
        std::array::from_fn(|p| node.planes[p].map(|x| x - point[p / 2]))
    }

    fn enters(self, planes: &[[f32; WIDTH]; 6], inverse: [f32; 3], limit: f32) -> u32 {
        // Comparisons rather than `min` and `max`, since no value is NaN here.
        let lesser = |a: f32, b: f32| if a < b { a } else { b };
        let greater = |a: f32, b: f32| if a > b { a } else { b };
        let enters = |i: usize| {
            let (mut enter, mut leave) = (0.0, limit);
            for axis in 0..3 {
                let a = planes[2 * axis][i] * inverse[axis];
                let b = planes[2 * axis + 1][i] * inverse[axis];
                enter = greater(enter, lesser(a, b));
                leave = lesser(leave, greater(a, b));
            }
            enter <= leave
        };
        (0..WIDTH).fold(0, |mask, i| mask | (u32::from(enters(i)) << i))
    }

    fn beyond(self, fan: &Fan, bound: f32) -> u32 {
        (0..FAN).fold(0, |m, i| m | (u32::from(fan.limits[i] > bound) << i))
    }

    fn squares(
        self,
        point: [f32; 3],
        slack: [f32; 3],
        node: &Wide,
        limit: f32,
    ) -> ([f32; WIDTH], u32) {
        let greater = |a: f32, b: f32| if a > b { a } else { b };
        let mut squares = [0.0_f32; WIDTH];
        for axis in 0..3 {
            let (above, below) = (point[axis] + slack[axis], point[axis] - slack[axis]);
            let (low, high) = (&node.planes[2 * axis], &node.planes[2 * axis + 1]);
            for i in 0..WIDTH {
                let d = greater(greater(low[i] - above, below - high[i]), 0.0);
                squares[i] += d * d;
            }
        }
        let mask = (0..WIDTH).fold(0, |m, i| m | (u32::from(squares[i] <= limit) << i));
        (squares, mask & node.children)
    }

    fn hits(self, origin: [f64; 3], direction: [f64; 3], block: &Block) -> ([f64; LANES], u32) {
        use crate::mesh::{cross, dot, sub};
        let mut mask = 0;
        let lengths = std::array::from_fn(|lane| {
            let [a, ab, ac] = block.triangle(lane);
            let s = sub(origin, a);
            let (p, q) = (cross(direction, ac), cross(s, ab));
            let det = dot(ab, p);
            let sign = 1.0_f64.copysign(det);
            let (u, v, t) = (dot(s, p) * sign, dot(direction, q) * sign, dot(ac, q) / det);
            let within = u >= 0.0 && v >= 0.0 && u + v <= det * sign && det != 0.0;
            mask |= u32::from(within && t > 0.0) << lane;
            t
        });
        (lengths, mask)
    }
}

#[cfg(target_arch = "x86_64")]
pub(super) use pulp::x86::V3;

#[cfg(target_arch = "x86_64")]
mod avx {
    use super::{Block, FAN, Fan, LANES, Tests, V3, WIDTH, Wide};
    use bytemuck::cast;
    use std::arch::x86_64::{__m256, __m256d, _CMP_GE_OQ, _CMP_GT_OQ, _CMP_LE_OQ, _CMP_NEQ_OQ};

    /// Eight of a fan's numbers; `from` is one of 0, 8, 16, 24.
    #[inline(always)]
    fn eight(numbers: &[f32; FAN], from: usize) -> __m256 {
        let (groups, _) = numbers.as_chunks::<WIDTH>();
        cast(groups[from / WIDTH])
    }

    #[derive(Clone, Copy)]
    struct Wide64(V3);

    impl Wide64 {
        #[inline(always)]
        fn dot(self, a: [__m256d; 3], b: [__m256d; 3]) -> __m256d {
            let (x, avx) = (self.0.avx, self.0.avx);
            let sum = avx._mm256_add_pd(x._mm256_mul_pd(a[0], b[0]), x._mm256_mul_pd(a[1], b[1]));
            avx._mm256_add_pd(sum, x._mm256_mul_pd(a[2], b[2]))
        }

        #[inline(always)]
        fn cross(self, a: [__m256d; 3], b: [__m256d; 3]) -> [__m256d; 3] {
            let avx = self.0.avx;
            let minor = |i: usize, j: usize| {
                avx._mm256_sub_pd(avx._mm256_mul_pd(a[i], b[j]), avx._mm256_mul_pd(a[j], b[i]))
            };
            [minor(1, 2), minor(2, 0), minor(0, 1)]
        }
    }

    impl Tests for V3 {
        #[inline(always)]
        fn planes_from(self, point: [f32; 3], node: &Wide) -> [[f32; WIDTH]; 6] {
            let avx = self.avx;
            let mut result = [[0.0; WIDTH]; 6];
            for (p, plane) in result.iter_mut().enumerate() {
                let from = avx._mm256_set1_ps(point[p / 2]);
                *plane = cast(avx._mm256_sub_ps(cast(node.planes[p]), from));
            }
            result
        }

        #[inline(always)]
        fn enters(self, planes: &[[f32; WIDTH]; 6], inverse: [f32; 3], limit: f32) -> u32 {
            let avx = self.avx;
            let (mut enter, mut leave) = (avx._mm256_setzero_ps(), avx._mm256_set1_ps(limit));
            for axis in 0..3 {
                let inverse = avx._mm256_set1_ps(inverse[axis]);
                let a = avx._mm256_mul_ps(cast(planes[2 * axis]), inverse);
                let b = avx._mm256_mul_ps(cast(planes[2 * axis + 1]), inverse);
                enter = avx._mm256_max_ps(enter, avx._mm256_min_ps(a, b));
                leave = avx._mm256_min_ps(leave, avx._mm256_max_ps(a, b));
            }
            let met = avx._mm256_cmp_ps::<_CMP_LE_OQ>(enter, leave);
            avx._mm256_movemask_ps(met) as u32
        }

        #[inline(always)]
        fn beyond(self, fan: &Fan, bound: f32) -> u32 {
            let avx = self.avx;
            let bound = avx._mm256_set1_ps(bound);
            (0..FAN).step_by(WIDTH).fold(0, |mask, group| {
                let far = avx._mm256_cmp_ps::<_CMP_GT_OQ>(eight(&fan.limits, group), bound);
                mask | (avx._mm256_movemask_ps(far) as u32) << group
            })
        }

        #[inline(always)]
        fn squares(
            self,
            point: [f32; 3],
            slack: [f32; 3],
            node: &Wide,
            limit: f32,
        ) -> ([f32; WIDTH], u32) {
            let avx = self.avx;
            let zero = avx._mm256_setzero_ps();
            let mut squares = zero;
            for axis in 0..3 {
                let above = avx._mm256_set1_ps(point[axis] + slack[axis]);
                let below = avx._mm256_set1_ps(point[axis] - slack[axis]);
                let low = avx._mm256_sub_ps(cast(node.planes[2 * axis]), above);
                let high = avx._mm256_sub_ps(below, cast(node.planes[2 * axis + 1]));
                let d = avx._mm256_max_ps(avx._mm256_max_ps(low, high), zero);
                squares = avx._mm256_add_ps(squares, avx._mm256_mul_ps(d, d));
            }
            let near = avx._mm256_cmp_ps::<_CMP_LE_OQ>(squares, avx._mm256_set1_ps(limit));
            let mask = avx._mm256_movemask_ps(near) as u32;
            (cast(squares), mask & node.children)
        }

        #[inline(always)]
        fn hits(self, origin: [f64; 3], direction: [f64; 3], block: &Block) -> ([f64; LANES], u32) {
            let (avx, wide) = (self.avx, Wide64(self));
            // Spelt out: mapping over an array would not be inlined here.
            let splat = |x: f64| avx._mm256_set1_pd(x);
            let load =
                |x: &[[f64; LANES]; 3]| -> [__m256d; 3] { [cast(x[0]), cast(x[1]), cast(x[2])] };
            let from = |x: f64, corner: [f64; LANES]| avx._mm256_sub_pd(splat(x), cast(corner));
            let d = [
                splat(direction[0]),
                splat(direction[1]),
                splat(direction[2]),
            ];
            let (ab, ac, a) = (load(&block.ab), load(&block.ac), &block.corner);
            let s = [
                from(origin[0], a[0]),
                from(origin[1], a[1]),
                from(origin[2], a[2]),
            ];
            let (p, q) = (wide.cross(d, ac), wide.cross(s, ab));
            let (det, zero) = (wide.dot(ab, p), avx._mm256_setzero_pd());
            // 1 with the sign of the determinant.
            let bit = avx._mm256_and_pd(det, avx._mm256_set1_pd(-0.0));
            let sign = avx._mm256_or_pd(bit, avx._mm256_set1_pd(1.0));
            let u = avx._mm256_mul_pd(wide.dot(s, p), sign);
            let v = avx._mm256_mul_pd(wide.dot(d, q), sign);
            let t = avx._mm256_div_pd(wide.dot(ac, q), det);
            let size = avx._mm256_mul_pd(det, sign);
            let tests = [
                avx._mm256_cmp_pd::<_CMP_GE_OQ>(u, zero),
                avx._mm256_cmp_pd::<_CMP_GE_OQ>(v, zero),
                avx._mm256_cmp_pd::<_CMP_LE_OQ>(avx._mm256_add_pd(u, v), size),
                avx._mm256_cmp_pd::<_CMP_NEQ_OQ>(det, zero),
                avx._mm256_cmp_pd::<_CMP_GT_OQ>(t, zero),
            ];
            let met = tests[1..]
                .iter()
                .fold(tests[0], |m, x| avx._mm256_and_pd(m, *x));
            (cast(t), avx._mm256_movemask_pd(met) as u32)
        }
    }
}

#[cfg(all(test, target_arch = "x86_64"))]
mod tests {
    use super::{FAN, Fan, Portable, Tests, V3};
    use crate::mesh::{Bvh, zoo};

    #[test]
    fn both_ways_give_the_same_bits() {
        let Some(simd) = V3::try_new() else {
            return;
        };
        let tree = Bvh::new(&zoo::dumbbell(12));
        let mut met = [0_u32; 4];
        for i in 0..40 {
            let t = f64::from(i);
            let point = [0.4 * t.sin(), 0.1 * (3.0 * t).cos(), 0.05 * (5.0 * t).sin()];
            let single = point.map(|x| x as f32);
            let directions: [[f64; 3]; FAN - 3] = std::array::from_fn(|j| {
                let u = t + j as f64;
                [(2.0 * u).cos(), if j % 5 == 0 { 0.0 } else { u.sin() }, 0.3]
            });
            let mut fan = Fan::new(&directions);
            fan.limits[i as usize % 20] = 0.1;
            for bound in [0.0, 0.1, 2.0] {
                let mask = Portable.beyond(&fan, bound);
                assert_eq!(mask, simd.beyond(&fan, bound));
                assert_eq!(mask >> directions.len(), 0);
                met[0] += mask.count_ones();
            }
            for node in &tree.nodes {
                let planes = Portable.planes_from(single, node);
                assert_eq!(planes, simd.planes_from(single, node));
                for (inverse, limit) in fan.inverse.into_iter().zip(fan.limits) {
                    let mask = Portable.enters(&planes, inverse, limit);
                    assert_eq!(mask, simd.enters(&planes, inverse, limit));
                    met[1] += mask.count_ones();
                }
                for limit in [f32::INFINITY, 0.2] {
                    let a = Portable.squares(single, [1e-6; 3], node, limit);
                    assert_eq!(a, simd.squares(single, [1e-6; 3], node, limit));
                    met[2] += a.1.count_ones();
                }
            }
            for block in &tree.blocks {
                let (a, mask) = Portable.hits(point, directions[1], block);
                let (b, other) = simd.hits(point, directions[1], block);
                assert_eq!((a.map(f64::to_bits), mask), (b.map(f64::to_bits), other));
                met[3] += mask.count_ones();
            }
        }
        assert!(met.iter().all(|n| *n > 40), "{met:?}");
    }
}
