//! Computes weighted sums of squares of rows of numbers at the speed of a matrix product.

use super::panel::{AddCombination, CHUNK, Row, Tile, WIDTH, ZERO_TILE};
use pulp::Arch;

/// Weights below this times the largest one change no sum of squares in double precision, even
/// where the squares differ by ten orders of magnitude.
const NEGLIGIBLE: f64 = 1e-30;

/// A matrix `(n_in, n_out)` of weights: `y_j = Σ_i weight_ij x_i²`.
#[derive(Debug)]
pub struct SquareWeights {
    n_in: usize,
    n_out: usize,
    /// The weights of each 8 columns, 8 rows at a time; negligible ones at the end are left out.
    groups: Vec<Vec<Tile>>,
}

impl SquareWeights {
    /// The weights by row and column.
    ///
    /// ```
    /// use coseg_geometry::linalg::squares::SquareWeights;
    ///
    /// let weights = SquareWeights::new(2, 1, |i, _| [10.0, 1.0][i]);
    /// let mut out = [0.0];
    /// weights.apply(&[2.0, 3.0], 2, &mut out);
    /// assert_eq!(out, [10.0 * 4.0 + 9.0]);
    /// ```
    pub fn new(n_in: usize, n_out: usize, weight: impl Fn(usize, usize) -> f64) -> Self {
        let group = |g: usize| {
            let mut tiles = vec![ZERO_TILE; n_in.div_ceil(WIDTH)];
            for i in 0..n_in {
                for j in 0..WIDTH.min(n_out - g * WIDTH) {
                    tiles[i / WIDTH][i % WIDTH].0[j] = weight(i, g * WIDTH + j);
                }
            }
            // Each column has its own limit, since their scales differ.
            let mut most = [0.0f64; WIDTH];
            for row in tiles.iter().flatten() {
                for (m, x) in most.iter_mut().zip(&row.0) {
                    *m = m.max(x.abs());
                }
            }
            let counts = |tile: &Tile| {
                let mut entries = tile.iter().flat_map(|row| row.0.iter().zip(&most));
                entries.any(|(x, m)| x.is_nan() || x.abs() > NEGLIGIBLE * m)
            };
            let kept = tiles.iter().rposition(counts).map_or(0, |last| last + 1);
            tiles.truncate(kept);
            tiles
        };
        Self {
            n_in,
            n_out,
            groups: (0..n_out.div_ceil(WIDTH)).map(group).collect(),
        }
    }

    /// Number of values of a row that count.
    pub fn n_in(&self) -> usize {
        self.n_in
    }

    /// Number of sums of a row.
    pub fn n_out(&self) -> usize {
        self.n_out
    }

    /// Multiplications and additions for a row.
    pub fn flops(&self) -> usize {
        let tiles: usize = self.groups.iter().map(Vec::len).sum();
        2 * tiles * WIDTH * WIDTH
    }

    /// The sums `(m, n_out)` of `rows`: m rows, each `width` numbers after the previous one.
    ///
    /// # Panics
    /// If rows are shorter than the weights, or `out` has a different number of rows.
    pub fn apply(&self, rows: &[f64], width: usize, out: &mut [f64]) {
        assert!(self.n_in <= width || rows.is_empty());
        if self.n_out == 0 || rows.is_empty() {
            return;
        }
        assert_eq!(rows.len() / width, out.len() / self.n_out);
        let arch = Arch::new();
        let n_panels = self.n_in.div_ceil(WIDTH);
        let mut squares = vec![Row::ZERO; n_panels * CHUNK];
        let rows = rows.chunks(CHUNK * width);
        for (rows, out) in rows.zip(out.chunks_mut(CHUNK * self.n_out)) {
            for (b, row) in rows.chunks_exact(width).enumerate() {
                let (whole, rest) = row[..self.n_in].as_chunks::<WIDTH>();
                for (p, x) in whole.iter().enumerate() {
                    squares[p * CHUNK + b].0 = x.map(|x| x * x);
                }
                if !rest.is_empty() {
                    let last = &mut squares[whole.len() * CHUNK + b].0;
                    for (y, x) in last.iter_mut().zip(rest) {
                        *y = x * x;
                    }
                }
            }
            for (g, tiles) in self.groups.iter().enumerate() {
                let mut sums = [Row::ZERO; CHUNK];
                let v = &squares[..tiles.len() * CHUNK];
                let w = &mut sums;
                arch.dispatch(AddCombination { v, tiles, w });
                let n = WIDTH.min(self.n_out - g * WIDTH);
                for (sum, out) in sums.iter().zip(out.chunks_exact_mut(self.n_out)) {
                    out[g * WIDTH..g * WIDTH + n].copy_from_slice(&sum.0[..n]);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::SquareWeights;

    #[test]
    fn sums_of_squares_are_those_of_the_formula() {
        for (m, n_in, n_out, width) in [
            (1, 1, 1, 1),
            (6, 8, 8, 8),
            (17, 13, 21, 15),
            (50, 100, 3, 101),
        ] {
            let rows: Vec<f64> = (0..m * width).map(|i| (i as f64 * 0.7).sin()).collect();
            // The weights vanish quickly, as exponentials do.
            let weight = |i: usize, j: usize| (-((i * (j + 1)) as f64)).exp();
            let weights = SquareWeights::new(n_in, n_out, weight);
            let mut out = vec![f64::NAN; m * n_out];
            weights.apply(&rows, width, &mut out);
            for v in 0..m {
                for j in 0..n_out {
                    let sum = |i: usize| weight(i, j) * rows[v * width + i].powi(2);
                    let expected: f64 = (0..n_in).map(sum).sum();
                    let found = out[v * n_out + j];
                    assert!(
                        (found - expected).abs() <= 1e-15 * expected,
                        "{found} {expected}"
                    );
                }
            }
        }
        // Weights that vanish cost nothing.
        let dense = SquareWeights::new(100, 8, |_, _| 1.0);
        let sparse = SquareWeights::new(100, 8, |i, _| (-(i as f64) * 9.0).exp());
        assert!(dense.flops() >= 2 * 100 * 8 && sparse.flops() < dense.flops() / 5);
        SquareWeights::new(0, 4, |_, _| 1.0).apply(&[], 0, &mut []);
    }
}
