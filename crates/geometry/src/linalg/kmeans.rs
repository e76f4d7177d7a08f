//! Weighted k-means: Lloyd's iteration from k-means++ starts (Arthur and Vassilvitskii 2007).

use pulp::Arch;
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64;

/// Clusters the rows of `points (n, dim)`, row-major, into `k` clusters, and returns the cluster of
/// each row `(n,)`. Of `n_starts` seeded starts, the one with the least sum of squared distances,
/// each times its weight `(n,)`, wins. An empty cluster is restarted at the row farthest from its
/// centre. With `k >= n` every row is its own cluster. An iteration costs `O(n k dim)`.
///
/// ```
/// use coseg_geometry::linalg::kmeans::kmeans;
///
/// let points = [0.0, 0.1, 0.2, 9.0, 9.1]; // on a line
/// let found = kmeans(&points, 1, &[1.0; 5], 2, 7, 3);
/// assert_eq!([found[1], found[2], found[4]], [found[0], found[0], found[3]]);
/// assert_ne!(found[0], found[3]);
/// ```
///
/// # Panics
/// If `points` does not hold n rows of `dim` values.
pub fn kmeans(
    points: &[f64],
    dim: usize,
    weights: &[f64],
    k: usize,
    seed: u64,
    n_starts: usize,
) -> Vec<u32> {
    let n = weights.len();
    assert_eq!(points.len(), n * dim, "points are n x dim");
    if k >= n {
        return (0..n as u32).collect();
    }
    let points = Points::new(points, dim);
    let mut rng = Pcg64::seed_from_u64(seed);
    let mut best: Option<(f64, Vec<u32>)> = None;
    for _ in 0..n_starts.max(1) {
        let centres = plus_plus(&points, weights, k, &mut rng);
        let (cost, labels) = lloyd(&points, weights, centres);
        if best.as_ref().is_none_or(|(least, _)| cost < *least) {
            best = Some((cost, labels));
        }
    }
    best.map(|(_, labels)| labels).unwrap_or_default()
}

/// Rows whose distances to a centre are computed at the same time: the lanes of a few vector
/// registers. A block of rows of 250 values fits a first-level cache.
const LANES: usize = 16;

/// The rows, and once more with [`LANES`] rows side by side, so that vector units add up the
/// distances of that many rows. Each distance is still one sum in the order of its columns, hence
/// the same to the bit on every width of vector units.
struct Points<'a> {
    rows: &'a [f64],
    dim: usize,
    /// Value of each column of each row of a block, block after block; zeros fill the last.
    blocks: Vec<[f64; LANES]>,
}

impl<'a> Points<'a> {
    fn new(rows: &'a [f64], dim: usize) -> Self {
        let mut blocks = vec![[0.0; LANES]; (rows.len() / dim).div_ceil(LANES) * dim];
        for (i, row) in rows.chunks_exact(dim).enumerate() {
            let block = &mut blocks[i / LANES * dim..][..dim];
            for (column, x) in block.iter_mut().zip(row) {
                column[i % LANES] = *x;
            }
        }
        Self { rows, dim, blocks }
    }

    fn row(&self, i: usize) -> &[f64] {
        &self.rows[i * self.dim..(i + 1) * self.dim]
    }

    /// Squared distances of all rows to one point.
    fn squared_distances(&self, to: &[f64]) -> Vec<f64> {
        let mut out = Vec::with_capacity(self.blocks.len() / self.dim * LANES);
        Arch::new().dispatch(|| {
            for block in self.blocks.chunks_exact(self.dim) {
                out.extend_from_slice(&block_distances(block, to));
            }
        });
        out.truncate(self.rows.len() / self.dim);
        out
    }

    /// The nearest centre of each row, the lowest of equally near ones, and the squared distance.
    fn nearest(&self, centres: &[f64]) -> Vec<(f64, u32)> {
        let mut out = Vec::with_capacity(self.blocks.len() / self.dim * LANES);
        Arch::new().dispatch(|| {
            for block in self.blocks.chunks_exact(self.dim) {
                let mut nearest = [(f64::INFINITY, 0); LANES];
                for (c, centre) in centres.chunks_exact(self.dim).enumerate() {
                    let distances = block_distances(block, centre);
                    for (least, d) in nearest.iter_mut().zip(distances) {
                        if d < least.0 {
                            *least = (d, c as u32);
                        }
                    }
                }
                out.extend_from_slice(&nearest);
            }
        });
        out.truncate(self.rows.len() / self.dim);
        out
    }
}

/// Squared distances of the rows of a block to one point.
#[inline(always)]
fn block_distances(block: &[[f64; LANES]], to: &[f64]) -> [f64; LANES] {
    let mut sums = [0.0; LANES];
    for (column, y) in block.iter().zip(to) {
        for (sum, x) in sums.iter_mut().zip(column) {
            *sum += (x - y) * (x - y);
        }
    }
    sums
}

fn draw(chances: &[f64], rng: &mut Pcg64) -> usize {
    let total: f64 = chances.iter().sum();
    if total <= 0.0 {
        return rng.random_range(0..chances.len());
    }
    let mut left = rng.random::<f64>() * total;
    for (i, c) in chances.iter().enumerate() {
        left -= c;
        if left < 0.0 {
            return i;
        }
    }
    chances.len() - 1
}

/// Greedy k-means++: of `2 + ln k` candidates drawn by distance, the one that lowers the cost most.
fn plus_plus(points: &Points<'_>, weights: &[f64], k: usize, rng: &mut Pcg64) -> Vec<f64> {
    let first = draw(weights, rng);
    let mut centres = points.row(first).to_vec();
    let mut distance = points.squared_distances(points.row(first));
    let n_trials = 2 + (k as f64).ln() as usize;
    while centres.len() < k * points.dim {
        let chances: Vec<f64> = distance.iter().zip(weights).map(|(d, w)| d * w).collect();
        let mut best: Option<(f64, usize, Vec<f64>)> = None;
        for _ in 0..n_trials {
            let candidate = draw(&chances, rng);
            let mut closer = points.squared_distances(points.row(candidate));
            for (d, before) in closer.iter_mut().zip(&distance) {
                *d = before.min(*d);
            }
            let cost: f64 = closer.iter().zip(weights).map(|(d, w)| d * w).sum();
            if best.as_ref().is_none_or(|(least, ..)| cost < *least) {
                best = Some((cost, candidate, closer));
            }
        }
        let Some((_, chosen, closer)) = best else {
            unreachable!("at least two trials")
        };
        centres.extend_from_slice(points.row(chosen));
        distance = closer;
    }
    centres
}

fn lloyd(points: &Points<'_>, weights: &[f64], mut centres: Vec<f64>) -> (f64, Vec<u32>) {
    const MAX_ITERATIONS: usize = 300;
    let (n, dim) = (weights.len(), points.dim);
    let k = centres.len() / dim;
    let mut labels = vec![u32::MAX; n];
    let mut cost = 0.0;
    for _ in 0..MAX_ITERATIONS {
        cost = 0.0;
        let mut changed = false;
        let mut farthest = (-1.0, 0);
        for (i, (distance, label)) in points.nearest(&centres).into_iter().enumerate() {
            changed |= labels[i] != label;
            labels[i] = label;
            cost += weights[i] * distance;
            if distance > farthest.0 {
                farthest = (distance, i);
            }
        }
        if !changed {
            break;
        }
        let mut mass = vec![0.0; k];
        centres.fill(0.0);
        for i in 0..n {
            let c = labels[i] as usize;
            mass[c] += weights[i];
            for (s, x) in centres[c * dim..(c + 1) * dim]
                .iter_mut()
                .zip(points.row(i))
            {
                *s += weights[i] * x;
            }
        }
        for c in 0..k {
            if mass[c] > 0.0 {
                centres[c * dim..(c + 1) * dim]
                    .iter_mut()
                    .for_each(|s| *s /= mass[c]);
            } else {
                centres[c * dim..(c + 1) * dim].copy_from_slice(points.row(farthest.1));
            }
        }
    }
    (cost, labels)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn separated_groups_are_found_whatever_the_seed() {
        let mut points = Vec::new();
        for i in 0..90 {
            let group = f64::from(i / 30);
            points.extend([10.0 * group + f64::from(i % 5) * 0.1, -5.0 * group]);
        }
        for seed in 0..20 {
            let labels = kmeans(&points, 2, &[1.0; 90], 3, seed, 3);
            for group in labels.chunks(30) {
                assert!(group.iter().all(|l| *l == group[0]), "seed {seed}");
            }
            assert_ne!(labels[0], labels[30]);
            assert_ne!(labels[30], labels[60]);
        }
    }

    #[test]
    fn weights_move_the_boundary() {
        // Four points on a line; two clusters. The heavy middle point gets a cluster of its own.
        let labels = kmeans(&[0.0, 1.0, 1.4, 2.4], 1, &[1.0, 100.0, 0.01, 0.01], 2, 0, 5);
        assert_eq!(labels[1], labels[2]);
        assert_eq!(kmeans(&[0.0, 1.0], 1, &[1.0, 1.0], 5, 0, 1), vec![0, 1]);
    }

    /// The last bits of distances decide the labels of points between centres.
    #[test]
    fn distances_are_the_plain_sums_to_the_bit() {
        let mut rng = Pcg64::seed_from_u64(3);
        for (n, dim) in [(1, 1), (16, 3), (37, 230)] {
            let rows: Vec<f64> = (0..n * dim).map(|_| rng.random_range(-3.0..3.0)).collect();
            let plain = |i: usize, c: usize| -> f64 {
                let (a, b) = (&rows[i * dim..][..dim], &rows[c * dim..][..dim]);
                a.iter().zip(b).map(|(x, y)| (x - y) * (x - y)).sum()
            };
            let points = Points::new(&rows, dim);
            let to_last = points.squared_distances(points.row(n - 1));
            assert!(
                to_last
                    .iter()
                    .enumerate()
                    .all(|(i, d)| *d == plain(i, n - 1))
            );
            let n_centres = n.min(3);
            let nearest = points.nearest(&rows[..n_centres * dim]);
            for (i, found) in nearest.into_iter().enumerate() {
                let all = (0..n_centres).map(|c| (plain(i, c), c as u32));
                assert_eq!(
                    Some(found),
                    all.reduce(|a, b| if b.0 < a.0 { b } else { a })
                );
            }
        }
    }

    #[test]
    fn equal_points_do_not_hang() {
        assert_eq!(kmeans(&[1.0; 8], 1, &[1.0; 8], 3, 0, 2).len(), 8);
    }
}
