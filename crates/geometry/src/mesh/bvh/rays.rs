//! Finds the first face on each of many rays from one point: eight boxes at a time, in single
//! precision, then four triangles in double.
//!
//! Rays from one point mostly meet the same boxes at first. Followed together, they share the path
//! through the tree, and its branches, which no processor can predict.

use super::ROUNDING;
use super::lanes::{FAN, Fan, Portable, Tests};
use super::wide::{LANES, WIDTH};
use super::{Bvh, Search};
use pulp::NullaryFnOnce;

impl Bvh {
    /// For each of several rays from `origin`, the distance along its direction to the first face
    /// that it meets, from either side, other than face `except`; infinite when it meets none.
    /// Directions have length 1, or less; then distances are in units of that length. Rays are
    /// fastest in the order of their directions.
    ///
    /// ```
    /// use coseg_geometry::mesh::{Bvh, Search, icosphere};
    ///
    /// let tree = Bvh::new(&icosphere(3));
    /// let mut lengths = Vec::new();
    /// // From outside: towards the sphere, and away from it. No face is left out.
    /// let rays = [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]];
    /// tree.cast(&mut Search::default(), [0.01, 0.02, 3.0], &rays, u32::MAX, &mut lengths);
    /// assert!((lengths[0] - 2.0).abs() < 0.01);
    /// assert_eq!(lengths[1], f64::INFINITY);
    /// ```
    pub fn cast(
        &self,
        search: &mut Search,
        origin: [f64; 3],
        directions: &[[f64; 3]],
        except: u32,
        lengths: &mut Vec<f64>,
    ) {
        lengths.clear();
        let rays = Rays {
            tree: self,
            origin,
            directions,
            except,
        };
        #[cfg(target_arch = "x86_64")]
        if let Some(simd) = super::lanes::V3::try_new() {
            return simd.vectorize(Cast {
                rays,
                search,
                lengths,
                tests: simd,
            });
        }
        Cast {
            rays,
            search,
            lengths,
            tests: Portable,
        }
        .call();
    }
}

struct Rays<'a> {
    tree: &'a Bvh,
    origin: [f64; 3],
    directions: &'a [[f64; 3]],
    except: u32,
}

struct Cast<'a, T> {
    rays: Rays<'a>,
    search: &'a mut Search,
    lengths: &'a mut Vec<f64>,
    tests: T,
}

/// An entry of the stack of nodes that some rays must visit.
#[derive(Debug, Clone, Copy)]
pub(super) struct FanEntry {
    /// A node, or the first block of a leaf.
    first: u32,
    /// Blocks of a leaf; 0 for a node.
    count: u32,
    /// A lower bound of the distances of its points from the origin.
    bound: f32,
    active: u32,
}

impl<T: Tests> NullaryFnOnce for Cast<'_, T> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let (search, tests) = (self.search, self.tests);
        let Rays {
            tree,
            origin,
            directions,
            except,
        } = self.rays;
        let single = origin.map(|x| x as f32);
        let slack = single.map(|x| ROUNDING * x.abs());
        for directions in directions.chunks(FAN) {
            let mut fan = Fan::new(directions);
            let mut best = [f64::INFINITY; FAN];
            search.fans.clear();
            search.fans.push(FanEntry {
                first: 0,
                count: 0,
                bound: -1.0,
                active: u32::MAX,
            });
            while let Some(entry) = search.fans.pop() {
                let mut active = entry.active & tests.beyond(&fan, entry.bound);
                if active == 0 {
                    continue;
                }
                if entry.count > 0 {
                    let blocks = entry.first as usize..(entry.first + entry.count) as usize;
                    while active != 0 {
                        let ray = active.trailing_zeros() as usize;
                        active &= active - 1;
                        for block in &tree.blocks[blocks.clone()] {
                            let (lengths, mut met) = tests.hits(origin, directions[ray], block);
                            while met != 0 {
                                let lane = met.trailing_zeros() as usize % LANES;
                                met &= met - 1;
                                if lengths[lane] < best[ray] && block.faces[lane] != except {
                                    best[ray] = lengths[lane];
                                    fan.limits[ray] = lengths[lane] as f32;
                                }
                            }
                        }
                    }
                    continue;
                }
                let node = &tree.nodes[entry.first as usize];
                // Beyond the first nodes few rays are together, so each is tested against all
                // children at once.
                let planes = tests.planes_from(single, node);
                let mut going = [0_u32; WIDTH];
                let mut children = 0;
                while active != 0 {
                    let ray = active.trailing_zeros() as usize % FAN;
                    active &= active - 1;
                    let mut met = tests.enters(&planes, fan.inverse[ray], fan.limits[ray]);
                    met &= node.children;
                    children |= met;
                    while met != 0 {
                        going[met.trailing_zeros() as usize % WIDTH] |= 1 << ray;
                        met &= met - 1;
                    }
                }
                if children == 0 {
                    continue;
                }
                let (squares, _) = tests.squares(single, slack, node, f32::INFINITY);
                let base = search.fans.len();
                while children != 0 {
                    let child = children.trailing_zeros() as usize % WIDTH;
                    children &= children - 1;
                    let bound = squares[child].sqrt() * (1.0 - ROUNDING) - f32::MIN_POSITIVE;
                    search.fans.push(FanEntry {
                        first: node.first[child],
                        count: node.count[child],
                        bound,
                        active: going[child],
                    });
                    // Inserted in order, with the nearest on top.
                    let mut at = search.fans.len() - 1;
                    while at > base && search.fans[at - 1].bound < bound {
                        search.fans.swap(at, at - 1);
                        at -= 1;
                    }
                }
            }
            self.lengths.extend(&best[..directions.len()]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Bvh, Search};
    use crate::mesh::{norm, scale, unit, zoo};

    #[test]
    fn rays_from_the_middle_of_a_sphere_travel_its_radius() {
        let mesh = zoo::sphere(3);
        let bvh = Bvh::new(&mesh);
        let (mut search, mut lengths) = (Search::default(), Vec::new());
        let radius = norm(mesh.vertices[0]);
        let directions = [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.3, 0.4, 0.5]].map(unit);
        bvh.cast(&mut search, [0.0; 3], &directions, u32::MAX, &mut lengths);
        assert_eq!(lengths.len(), 3);
        for t in &lengths {
            assert!((t - radius).abs() < 0.02 * radius, "{t} against {radius}");
        }
        // Distances are in units of the direction.
        let shorter = directions.map(|d| scale(d, 0.5));
        let whole = lengths.clone();
        bvh.cast(&mut search, [0.0; 3], &shorter, u32::MAX, &mut lengths);
        for (twice, whole) in lengths.iter().zip(whole) {
            assert!((twice - 2.0 * whole).abs() < 1e-12);
        }
        let away = [[1.0, 0.0, 0.0]];
        bvh.cast(&mut search, [9.0, 0.0, 0.0], &away, u32::MAX, &mut lengths);
        assert_eq!(lengths, [f64::INFINITY]);
    }

    #[test]
    fn the_face_a_ray_starts_from_does_not_stop_it() {
        let mesh = zoo::sphere(2);
        let bvh = Bvh::new(&mesh);
        let (mut search, mut lengths) = (Search::default(), Vec::new());
        let corners = mesh.corners(7);
        let middle = std::array::from_fn(|i| corners.iter().map(|c| c[i]).sum::<f64>() / 3.0);
        let inward = [scale(unit(middle), -1.0)];
        let origin = scale(middle, 1.0 + 1e-3);
        bvh.cast(&mut search, origin, &inward, u32::MAX, &mut lengths);
        assert!(lengths[0] < 2e-3);
        bvh.cast(&mut search, origin, &inward, 7, &mut lengths);
        assert!(lengths[0] > 1.8);
    }
}
