//! Weighted k-means: Lloyd's iteration from k-means++ starts (Arthur and Vassilvitskii 2007).

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
    let mut rng = Pcg64::seed_from_u64(seed);
    let mut best: Option<(f64, Vec<u32>)> = None;
    for _ in 0..n_starts.max(1) {
        let centres = plus_plus(points, dim, weights, k, &mut rng);
        let (cost, labels) = lloyd(points, dim, weights, centres);
        if best.as_ref().is_none_or(|(least, _)| cost < *least) {
            best = Some((cost, labels));
        }
    }
    best.map(|(_, labels)| labels).unwrap_or_default()
}

fn squared_distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| (x - y) * (x - y)).sum()
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
fn plus_plus(points: &[f64], dim: usize, weights: &[f64], k: usize, rng: &mut Pcg64) -> Vec<f64> {
    let n = weights.len();
    let row = |i: usize| &points[i * dim..(i + 1) * dim];
    let first = draw(weights, rng);
    let mut centres = row(first).to_vec();
    let mut distance: Vec<f64> = (0..n)
        .map(|i| squared_distance(row(i), row(first)))
        .collect();
    let n_trials = 2 + (k as f64).ln() as usize;
    while centres.len() < k * dim {
        let chances: Vec<f64> = distance.iter().zip(weights).map(|(d, w)| d * w).collect();
        let mut best: Option<(f64, usize, Vec<f64>)> = None;
        for _ in 0..n_trials {
            let candidate = draw(&chances, rng);
            let closer: Vec<f64> = (0..n)
                .map(|i| distance[i].min(squared_distance(row(i), row(candidate))))
                .collect();
            let cost: f64 = closer.iter().zip(weights).map(|(d, w)| d * w).sum();
            if best.as_ref().is_none_or(|(least, ..)| cost < *least) {
                best = Some((cost, candidate, closer));
            }
        }
        let Some((_, chosen, closer)) = best else {
            unreachable!("at least two trials")
        };
        centres.extend_from_slice(row(chosen));
        distance = closer;
    }
    centres
}

fn lloyd(points: &[f64], dim: usize, weights: &[f64], mut centres: Vec<f64>) -> (f64, Vec<u32>) {
    const MAX_ITERATIONS: usize = 300;
    let n = weights.len();
    let k = centres.len() / dim;
    let mut labels = vec![u32::MAX; n];
    let mut cost = 0.0;
    for _ in 0..MAX_ITERATIONS {
        cost = 0.0;
        let mut changed = false;
        let mut farthest = (-1.0, 0);
        for i in 0..n {
            let x = &points[i * dim..(i + 1) * dim];
            let mut nearest = (f64::INFINITY, 0u32);
            for (c, centre) in centres.chunks_exact(dim).enumerate() {
                let d = squared_distance(x, centre);
                if d < nearest.0 {
                    nearest = (d, c as u32);
                }
            }
            changed |= labels[i] != nearest.1;
            labels[i] = nearest.1;
            cost += weights[i] * nearest.0;
            if nearest.0 > farthest.0 {
                farthest = (nearest.0, i);
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
                .zip(&points[i * dim..(i + 1) * dim])
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
                let i = farthest.1;
                centres[c * dim..(c + 1) * dim].copy_from_slice(&points[i * dim..(i + 1) * dim]);
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

    #[test]
    fn equal_points_do_not_hang() {
        assert_eq!(kmeans(&[1.0; 8], 1, &[1.0; 8], 3, 0, 2).len(), 8);
    }
}
