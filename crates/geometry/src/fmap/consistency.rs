//! Judges each of the maps between many shapes by its agreement with the others.
//!
//! The direct map between two shapes is compared with the map by way of a third (Zach, Klopschitz
//! and Pollefeys 2010, *Disambiguating Visual Relations Using Loop Constraints*; Huang and Guibas
//! 2013, *Consistent Shape Maps via Semidefinite Programming*). A wrong map spoils all its
//! triangles, a right map only those that it shares with a wrong one, so the median over its
//! triangles separates them.

use super::basis::product;
use super::samples::columns;
use nalgebra::DMatrix;

/// The least number of triangles by which a map is judged.
const MIN_TRIANGLES: usize = 2;
/// Median departures that exceed that of all maps by this many deviations are significant.
const DEVIATIONS: f64 = 3.0;
/// The median deviation of normally distributed values times this is their standard deviation.
const OF_NORMAL: f64 = 1.4826;
/// The least spread of departures: those of a small collection may happen to be nearly equal.
const LEAST_SPREAD: f64 = 0.03;

/// A functional map between two shapes of a collection, by their numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Link<'a> {
    /// The shape whose functions are transferred
    pub from: usize,
    /// and the shape that they are transferred to.
    pub to: usize,
    /// `(k_to, k_from)`, row-major.
    pub c_12: &'a [f32],
    /// The weight of this map.
    pub weight: f64,
}

/// A map with the numbers of its source and its target shape: `c_12 (k_to, k_from)`, row-major.
pub type Numbered = (usize, usize, Vec<f32>);

/// The maps as links of equal weight 1.
///
/// ```
/// use coseg_geometry::fmap::consistency::links;
///
/// let maps = [(0, 1, vec![1.0]), (1, 2, vec![-1.0])];
/// let links = links(&maps);
/// assert_eq!((links[1].from, links[1].to, links[1].weight), (1, 2, 1.0));
/// ```
pub fn links(maps: &[Numbered]) -> Vec<Link<'_>> {
    maps.iter()
        .map(|(from, to, c_12)| Link {
            from: *from,
            to: *to,
            c_12,
            weight: 1.0,
        })
        .collect()
}

impl Link<'_> {
    /// The map as a matrix, given the sizes of all shapes.
    pub(super) fn matrix(&self, sizes: &[usize]) -> DMatrix<f64> {
        let (rows, columns) = (sizes[self.to], sizes[self.from]);
        let n = self.c_12.len();
        assert_eq!(
            n,
            rows * columns,
            "a map of {n} entries, but {rows} by {columns}"
        );
        DMatrix::from_fn(rows, columns, |i, j| f64::from(self.c_12[i * columns + j]))
    }
}

/// The agreement of a map with the others.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Standing {
    /// Number of triangles of maps that contain it.
    pub n_triangles: usize,
    /// Median over these triangles of the departure of the map by way of the third shape from the
    /// direct one: `‖C_bc C_ab − C_ac‖` over the mean of both norms. 0 means equal; unrelated maps
    /// have about 1.4. It is also 0 without triangles.
    pub departure: f64,
    /// Whether the departure is larger than maps of this collection explain.
    pub inconsistent: bool,
}

/// Departures of all triangles `a → b → c` with `a → c`: the numbers of the three maps, and the
/// departure. `sizes` has for each shape the number of rows of maps to it. O(triangles k³).
///
/// # Panics
/// If a map names a shape that does not exist, or its number of entries does not fit its shapes.
pub fn triangles(sizes: &[usize], links: &[Link<'_>]) -> Vec<([usize; 3], f64)> {
    let mut out_of: Vec<Vec<usize>> = vec![Vec::new(); sizes.len()];
    for (l, link) in links.iter().enumerate() {
        out_of[link.from].push(l);
    }
    let mut found = Vec::new();
    for (ab, first) in links.iter().enumerate() {
        for &bc in &out_of[first.to] {
            let second = &links[bc];
            for &ac in &out_of[first.from] {
                if links[ac].to != second.to {
                    continue;
                }
                let (ka, kb, kc) = (sizes[first.from], sizes[first.to], sizes[second.to]);
                let round = product(second.c_12, first.c_12, kc, kb, ka);
                let direct = links[ac].c_12;
                let norm = |x: &mut dyn Iterator<Item = f32>| {
                    x.map(|x| f64::from(x * x)).sum::<f64>().sqrt()
                };
                let departure = norm(&mut round.iter().zip(direct).map(|(x, y)| x - y));
                let size = norm(&mut round.iter().copied()) + norm(&mut direct.iter().copied());
                found.push(([ab, bc, ac], departure / (0.5 * size).max(1e-300)));
            }
        }
    }
    found
}

/// The agreement of each map with the others.
///
/// # Panics
/// As [`triangles`].
pub fn standings(sizes: &[usize], links: &[Link<'_>]) -> Vec<Standing> {
    let mut departures: Vec<Vec<f64>> = vec![Vec::new(); links.len()];
    for (three, departure) in triangles(sizes, links) {
        three.iter().for_each(|l| departures[*l].push(departure));
    }
    let mut standings: Vec<Standing> = departures
        .iter_mut()
        .map(|of| Standing {
            n_triangles: of.len(),
            departure: median(of),
            inconsistent: false,
        })
        .collect();
    let judged = |s: &&Standing| s.n_triangles >= MIN_TRIANGLES;
    let mut values: Vec<f64> = standings
        .iter()
        .filter(judged)
        .map(|s| s.departure)
        .collect();
    let centre = median(&mut values);
    let mut deviations: Vec<f64> = values.iter().map(|x| (x - centre).abs()).collect();
    let spread = (OF_NORMAL * median(&mut deviations)).max(LEAST_SPREAD);
    for s in &mut standings {
        let enough = s.n_triangles >= MIN_TRIANGLES;
        s.inconsistent = enough && s.departure > centre + DEVIATIONS * spread;
    }
    standings
}

/// The leading `(rows, columns)` of a map with `stride` columns.
pub fn leading(c_12: &[f32], stride: usize, rows: usize, columns_wanted: usize) -> Vec<f32> {
    columns(&c_12[..rows * stride], stride, columns_wanted)
}

/// The median; 0 for no values.
fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    match values.len() {
        0 => 0.0,
        n if n % 2 == 1 => values[n / 2],
        n => 0.5 * (values[n / 2 - 1] + values[n / 2]),
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::convert::functional;
    use super::super::test_shapes::{Curve, cycle};
    use super::{Numbered, links, standings, triangles};
    use rand::seq::SliceRandom;
    use rand::{Rng, SeedableRng};

    /// Eigenfunctions of each shape.
    pub(in super::super) const K: usize = 11;
    const N: usize = 120;

    /// Closed curves that are turned against each other, with maps from each to the next few that
    /// send every vertex to a vertex near the right one.
    pub(in super::super) fn turned(n: usize) -> (Vec<Curve>, Vec<Numbered>) {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(7);
        let turns: Vec<usize> = (0..n).map(|_| rng.random_range(0..N)).collect();
        let shapes: Vec<Curve> = turns.iter().map(|t| cycle(N, *t)).collect();
        let mut maps = Vec::new();
        for j in 1..n {
            for i in j.saturating_sub(4)..j {
                let mut right = |v: usize| {
                    let near = rng.random_range(0..5);
                    (v + turns[j] + 2 * N - turns[i] + near - 2) % N
                };
                let p2p: Vec<u32> = (0..N).map(|v| right(v) as u32).collect();
                let c = functional(&shapes[i].basis(), &shapes[j].basis(), &p2p, K, K);
                maps.push((i, j, c));
            }
        }
        (shapes, maps)
    }

    /// Makes maps wrong: every eighth map is replaced by one between vertices in random order, or
    /// turned by a third.
    pub(in super::super) fn spoil(shapes: &[Curve], maps: &mut [Numbered]) -> Vec<usize> {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(8);
        let wrong: Vec<usize> = (5..maps.len() - 5).step_by(8).collect();
        for (n, at) in wrong.iter().enumerate() {
            let (i, j, _) = maps[*at];
            let mut p2p: Vec<u32> = (0..N as u32).collect();
            match n % 2 {
                0 => p2p.shuffle(&mut rng),
                _ => {
                    let c = &maps[*at].2;
                    let right = super::super::convert::pointwise(
                        &shapes[i].basis(),
                        &shapes[j].basis(),
                        c,
                        K,
                    );
                    p2p = right
                        .iter()
                        .map(|v| (v + N as u32 / 3) % N as u32)
                        .collect();
                }
            }
            maps[*at].2 = functional(&shapes[i].basis(), &shapes[j].basis(), &p2p, K, K);
        }
        wrong
    }

    #[test]
    fn wrong_maps_do_not_agree_and_right_ones_do_unless_most_of_their_triangles_are_spoilt() {
        let (shapes, mut maps) = turned(14);
        let sizes = vec![K; shapes.len()];
        let before = standings(&sizes, &links(&maps));
        assert!(before.iter().all(|s| !s.inconsistent));
        let wrong = spoil(&shapes, &mut maps);
        assert!(wrong.len() >= 5);
        let after = standings(&sizes, &links(&maps));
        let found: Vec<usize> = (0..maps.len()).filter(|m| after[*m].inconsistent).collect();
        assert!(
            wrong.iter().all(|m| found.contains(m)),
            "{wrong:?} {found:?}"
        );
        // A right map at least half of whose triangles have a wrong side also looks wrong.
        let spoilt = |m: usize| {
            let of: Vec<bool> = triangles(&sizes, &links(&maps))
                .iter()
                .filter(|(three, _)| three.contains(&m))
                .map(|(three, _)| three.iter().any(|l| wrong.contains(l)))
                .collect();
            2 * of.iter().filter(|s| **s).count() >= of.len()
        };
        assert!(found.iter().all(|m| spoilt(*m)), "{wrong:?} {found:?}");
    }

    #[test]
    fn two_shapes_say_nothing() {
        let (shapes, maps) = turned(2);
        let found = standings(&vec![K; shapes.len()], &links(&maps));
        assert_eq!((found.len(), found[0].n_triangles), (1, 0));
        assert!(!found[0].inconsistent);
    }
}
