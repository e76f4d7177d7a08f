//! Projects a symmetric operator on panels to a block tridiagonal matrix on a Krylov space; the
//! eigenpairs of the projection approximate those of largest magnitude.
//!
//! Block Lanczos with 8 columns and full re-orthogonalisation: no restart, no ghost copies, and
//! every inner loop is a matrix product (Golub and Underwood 1977; Grimes, Lewis and Simon, *A
//! Shifted Block Lanczos Algorithm*, 1994).

// Small matrices and register tiles read best with their indices.
#![allow(clippy::needless_range_loop)]

use super::basis::Basis;
use super::dense_eigen::{DenseEigenError, symmetric_eigen};
use super::panel::{
    Row, Tile, WIDTH, ZERO_TILE, add_product, gram, multiply_in_place, negated, tile_product,
    zero_panel,
};
use faer::Mat;
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64;

/// A column whose length after orthogonalisation is below this ratio of its length before counts as
/// lost: the Krylov space is exhausted in that direction, and a random direction replaces it.
const LOST: f64 = 1e-11;

/// A second orthogonalisation follows when a column shrank by more than this.
const SHRUNK: f64 = 1e-3;

/// The basis already spans the whole space, so no further direction exists.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a space of {n} dimensions has no direction beyond the {n_found} found")]
pub struct Exhausted {
    /// Dimension of the space.
    pub n: usize,
    /// Number of vectors in the basis.
    pub n_found: usize,
}

/// A Krylov space under construction.
pub struct BlockLanczos<'a> {
    n: usize,
    basis: Basis,
    /// Vectors to which the space stays orthogonal.
    locked: &'a Basis,
    /// Diagonal and subdiagonal tiles of the projection.
    diagonal: Vec<Tile>,
    subdiagonal: Vec<Tile>,
    /// The newest block, and whether it is orthogonal to all earlier blocks up to rounding.
    next: Vec<Row>,
    clean: bool,
    /// Memory for the image of the newest block.
    spare: Vec<Row>,
    random: Pcg64,
    parallel: bool,
}

/// Eigenpairs of the projection.
pub struct Projection {
    /// Ritz values `(m,)`, ascending.
    pub values: Vec<f64>,
    /// `(m, m)`.
    vectors: Mat<f64>,
    /// Length of the residual of each Ritz pair.
    pub residuals: Vec<f64>,
}

impl<'a> BlockLanczos<'a> {
    /// Starts from a random block orthogonal to `locked`.
    pub fn new(
        n: usize,
        locked: &'a Basis,
        capacity: usize,
        seed: u64,
        parallel: bool,
    ) -> Result<Self, Exhausted> {
        let mut this = Self {
            n,
            basis: Basis::new(n, capacity, parallel),
            locked,
            diagonal: Vec::new(),
            subdiagonal: Vec::new(),
            next: zero_panel(n),
            clean: true,
            spare: Vec::new(),
            random: Pcg64::seed_from_u64(seed),
            parallel,
        };
        for row in &mut this.next[..n] {
            for x in &mut row.0 {
                *x = this.random.random::<f64>() - 0.5;
            }
        }
        let scale = column_lengths(&this.next);
        let mut next = std::mem::take(&mut this.next);
        this.locked.remove(0, [&mut next]);
        this.orthonormalise(&mut next, &scale)?;
        this.next = next;
        Ok(this)
    }

    /// Vectors in the space.
    pub fn dimension(&self) -> usize {
        self.diagonal.len() * WIDTH
    }

    /// Adds one block: applies `operator` in place to a copy of the newest one.
    ///
    /// The three-term recurrence leaves rounding errors of the operator as components along the
    /// older blocks. Every second step removes them, from the newest block and from its image at
    /// once: one pass over the basis serves two blocks, and only clean blocks enter it.
    pub fn step(&mut self, operator: &dyn Fn(&mut [Row])) -> Result<(), Exhausted> {
        let mut q = std::mem::take(&mut self.next);
        let mut w = std::mem::take(&mut self.spare);
        w.clone_from(&q);
        operator(&mut w);
        let scale = column_lengths(&w);
        let before = self.basis.n_panels().saturating_sub(1);
        self.basis.remove(before, [&mut w]);
        let d = gram(&q, &w, self.parallel);
        add_product(&q, &negated(&d), &mut w, self.parallel);
        if self.clean {
            self.locked.remove(0, [&mut w]);
        } else {
            self.locked.remove(0, [&mut q, &mut w]);
            self.basis.remove(0, [&mut q, &mut w]);
            // The parts removed from both have this common component.
            let common = gram(&q, &w, self.parallel);
            add_product(&q, &negated(&common), &mut w, self.parallel);
        }
        self.clean = !self.clean;
        self.diagonal.push(symmetric_part(&d));
        self.basis.push(&q);
        self.spare = q;
        let r = self.orthonormalise(&mut w, &scale)?;
        self.subdiagonal.push(r);
        self.next = w;
        Ok(())
    }

    /// Makes the columns of `w` orthonormal among themselves (and again to the basis, if they
    /// shrank much); returns R of `w = Q R`. Columns lost to rounding become random directions,
    /// with a zero column on the diagonal of R.
    fn orthonormalise(&mut self, w: &mut [Row], scale: &[f64; WIDTH]) -> Result<Tile, Exhausted> {
        let mut total = identity();
        for pass in 0..3 {
            let g = gram(w, w, self.parallel);
            let Some((r, inverse)) = cholesky(&g) else {
                return self.orthonormalise_slowly(w, scale, &total);
            };
            if pass == 0 && (0..WIDTH).any(|j| r[j].0[j] < LOST * scale[j]) {
                return self.orthonormalise_slowly(w, scale, &total);
            }
            multiply_in_place(w, &inverse, self.parallel);
            total = tile_product(&r, &total);
            if pass == 0 && (0..WIDTH).any(|j| r[j].0[j] < SHRUNK * scale[j]) {
                self.locked.remove(0, [w]);
                self.basis.remove(0, [w]);
            } else if well_conditioned(&r) {
                break;
            }
        }
        Ok(total)
    }

    /// Orthonormalises column by column, for blocks of deficient rank.
    fn orthonormalise_slowly(
        &mut self,
        w: &mut [Row],
        scale: &[f64; WIDTH],
        before: &Tile,
    ) -> Result<Tile, Exhausted> {
        let mut r = ZERO_TILE;
        for j in 0..WIDTH {
            let mut lost = false;
            for attempt in 0..4 {
                for _ in 0..2 {
                    for i in 0..j {
                        let dot: f64 = w.iter().map(|row| row.0[i] * row.0[j]).sum();
                        for row in w.iter_mut() {
                            row.0[j] -= dot * row.0[i];
                        }
                        if !lost {
                            r[i].0[j] += dot;
                        }
                    }
                    if lost {
                        self.remove_from_column(w, j);
                    }
                }
                let length = w.iter().map(|row| row.0[j] * row.0[j]).sum::<f64>().sqrt();
                let enough = if lost {
                    1e-6
                } else {
                    LOST * scale[j].max(f64::MIN_POSITIVE)
                };
                if length > enough {
                    for row in w.iter_mut() {
                        row.0[j] /= length;
                    }
                    if !lost {
                        r[j].0[j] = length;
                    }
                    break;
                }
                if attempt == 3 {
                    let n_found = self.dimension() + j;
                    return Err(Exhausted { n: self.n, n_found });
                }
                lost = true;
                for row in &mut w[..self.n] {
                    row.0[j] = self.random.random::<f64>() - 0.5;
                }
                let length = w.iter().map(|row| row.0[j] * row.0[j]).sum::<f64>().sqrt();
                for row in w.iter_mut() {
                    row.0[j] /= length;
                }
                self.remove_from_column(w, j);
            }
        }
        // The last pass against all vectors is needed because small remainders were scaled up.
        self.locked.remove(0, [w]);
        self.basis.remove(0, [w]);
        let g = gram(w, w, self.parallel);
        let (again, inverse) = cholesky(&g).ok_or(Exhausted {
            n: self.n,
            n_found: self.dimension(),
        })?;
        multiply_in_place(w, &inverse, self.parallel);
        Ok(tile_product(&again, &tile_product(&r, before)))
    }

    fn remove_from_column(&self, w: &mut [Row], j: usize) {
        let mut single = vec![Row::ZERO; w.len()];
        for (s, row) in single.iter_mut().zip(w.iter()) {
            s.0[0] = row.0[j];
        }
        self.locked.remove(0, [&mut single]);
        self.basis.remove(0, [&mut single]);
        for (s, row) in single.iter().zip(w.iter_mut()) {
            row.0[j] = s.0[0];
        }
    }

    /// Eigenpairs of the block tridiagonal projection, O(m³).
    pub fn projection(&self) -> Result<Projection, DenseEigenError> {
        let (blocks, m) = (self.diagonal.len(), self.dimension());
        let mut t = vec![0.0; m * m];
        for b in 0..blocks {
            for j in 0..WIDTH {
                let column = (b * WIDTH + j) * m;
                for i in 0..WIDTH {
                    t[column + b * WIDTH + i] = self.diagonal[b][i].0[j];
                    if b + 1 < blocks {
                        t[column + (b + 1) * WIDTH + i] = self.subdiagonal[b][i].0[j];
                    }
                }
            }
        }
        let (values, vectors) = symmetric_eigen(&t, m)?;
        let residuals = (0..m)
            .map(|e| {
                self.coupled(&vectors, e)
                    .iter()
                    .map(|x| x * x)
                    .sum::<f64>()
                    .sqrt()
            })
            .collect();
        Ok(Projection {
            values,
            vectors,
            residuals,
        })
    }

    /// Coefficients of the residual of Ritz pair `e` in the next block.
    fn coupled(&self, vectors: &Mat<f64>, e: usize) -> [f64; WIDTH] {
        let m = self.dimension();
        let r = &self.subdiagonal[self.subdiagonal.len() - 1];
        std::array::from_fn(|i| {
            (0..WIDTH)
                .map(|j| r[i].0[j] * vectors[(m - WIDTH + j, e)])
                .sum()
        })
    }

    /// Ritz vectors after one more application of the operator, which comes free: the columns of
    /// `operator(V y) / θ = V y + Q c`, orthonormalised, and a column of zeros for each `None`.
    /// Consumes the space.
    pub fn vectors(mut self, projection: &Projection, selected: &[Option<usize>]) -> Basis {
        let m = self.dimension();
        let next = std::mem::take(&mut self.next);
        self.basis.push(&next);
        // The columns below those of Y have length (residual / θ), so far from 1 in the far pairs
        // that C Cᵀ counts.
        let chosen: Vec<usize> = selected.iter().flatten().copied().collect();
        let c = Mat::from_fn(WIDTH, chosen.len(), |i, e| {
            self.coupled(&projection.vectors, chosen[e])[i] / projection.values[chosen[e]]
        });
        let mut y = Mat::from_fn(m + WIDTH, chosen.len(), |i, e| match i < m {
            true => projection.vectors[(i, chosen[e])],
            false => c[(i - m, e)],
        });
        // (YᵀY + CᵀC)^(-1/2) = I - CᵀC / 2 + O(|C|⁴).
        let along = &y * c.transpose();
        y -= &along * c * faer::Scale(0.5);
        let mut columns = y.col_iter();
        let places: Vec<_> = selected
            .iter()
            .map(|e| e.and_then(|_| columns.next()))
            .collect();
        let coefficients: Vec<Vec<Tile>> = places
            .chunks(WIDTH)
            .map(|group| {
                let mut tiles = vec![ZERO_TILE; m / WIDTH + 1];
                for (to, column) in group.iter().enumerate() {
                    let Some(column) = column else { continue };
                    let rows = tiles.iter_mut().flatten();
                    for (row, &x) in rows.zip(column.iter()) {
                        row.0[to] = x;
                    }
                }
                tiles
            })
            .collect();
        self.basis.transform(&coefficients);
        self.basis
    }
}

/// Whether one Cholesky QR pass leaves columns orthogonal to about 1e-14.
fn well_conditioned(r: &Tile) -> bool {
    let diagonal = || (0..WIDTH).map(|j| r[j].0[j]);
    let largest = diagonal().fold(0.0, f64::max);
    diagonal().all(|d| d > 0.05 * largest)
}

/// `(D + Dᵀ) / 2`.
fn symmetric_part(d: &Tile) -> Tile {
    std::array::from_fn(|i| Row(std::array::from_fn(|j| 0.5 * (d[i].0[j] + d[j].0[i]))))
}

fn identity() -> Tile {
    let mut tile = ZERO_TILE;
    for (i, row) in tile.iter_mut().enumerate() {
        row.0[i] = 1.0;
    }
    tile
}

fn column_lengths(panel: &[Row]) -> [f64; WIDTH] {
    let mut sums = [0.0; WIDTH];
    for row in panel {
        for (s, x) in sums.iter_mut().zip(&row.0) {
            *s += x * x;
        }
    }
    sums.map(f64::sqrt)
}

/// Upper triangular R with `G = RᵀR`, and its inverse; `None` if G is not safely definite.
fn cholesky(g: &Tile) -> Option<(Tile, Tile)> {
    let mut r = ZERO_TILE;
    for j in 0..WIDTH {
        let mut d = g[j].0[j];
        for k in 0..j {
            d -= r[k].0[j] * r[k].0[j];
        }
        if !d.is_finite() || d <= 1e-13 * g[j].0[j] || g[j].0[j] <= 0.0 {
            return None;
        }
        let d = d.sqrt();
        r[j].0[j] = d;
        for i in j + 1..WIDTH {
            let mut x = g[j].0[i];
            for k in 0..j {
                x -= r[k].0[j] * r[k].0[i];
            }
            r[j].0[i] = x / d;
        }
    }
    let mut inverse = ZERO_TILE;
    for j in 0..WIDTH {
        inverse[j].0[j] = 1.0 / r[j].0[j];
        for i in (0..j).rev() {
            let x: f64 = (i + 1..=j).map(|k| r[i].0[k] * inverse[k].0[j]).sum();
            inverse[i].0[j] = -x / r[i].0[i];
        }
    }
    Some((r, inverse))
}
