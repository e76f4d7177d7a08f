//! Computes one basis that all shapes of a collection share from the maps between them. It also
//! finds maps that do not fit the basis, and replaces them by maps through it.
//!
//! Wang, Huang and Guibas 2013, *Image Co-Segmentation via Consistent Functional Maps*; Huang et
//! al. 2019, *Limit Shapes*. Latent functions have coefficients `Y_i (k_i, r)` on every shape. A
//! map agrees with them if `C_ij Y_i = Y_j`, and `Y_j Y_i⁺` is the map between any two shapes on
//! which all others agree. A new shape joins by the weighted mean of its maps, and changes no other
//! shape.

use super::consistency::Link;
use crate::linalg::dense_eigen::{DenseEigenError, symmetric_eigen};
use nalgebra::{DMatrix, linalg::SVD};

/// Rounds in which departing maps lose weight, so that the mean approaches a median.
const ROUNDS: usize = 6;
/// Departures below this count as none.
const LEAST_DEPARTURE: f64 = 0.05;
/// Singular values of a block below this share of the largest are not inverted.
const LEAST_SINGULAR: f64 = 0.05;

/// Coefficients of latent functions on every shape of a collection.
#[derive(Debug, Clone, PartialEq)]
pub struct LatentBasis {
    r: usize,
    blocks: Vec<DMatrix<f64>>,
    energy: DMatrix<f64>,
}

impl LatentBasis {
    /// The `r` latent functions on which these maps agree best: `Σ w ‖C_ij Y_i − Y_j‖²` is least
    /// where `Σ Y_iᵀ Y_i = n I`, and departing maps lose weight. `eigenvalues` has for each shape
    /// those of its eigenfunctions. O((Σ k)³).
    ///
    /// ```
    /// use coseg_geometry::fmap::consistency::links;
    /// use coseg_geometry::fmap::latent::LatentBasis;
    ///
    /// // Two shapes of two eigenfunctions each; the second has another sign on the second shape.
    /// let (values, there) = ([0.0, 2.0], vec![1.0, 0.0, 0.0, -1.0]);
    /// let maps = [(0, 1, there.clone()), (1, 0, there.clone())];
    /// let basis = LatentBasis::solve(&[&values, &values], &links(&maps), 2)?;
    /// assert_eq!((basis.n_shapes(), basis.n_functions()), (2, 2));
    /// // The way by the latent functions is the map itself.
    /// let through = basis.through(0, 1);
    /// assert!(through.iter().zip(&there).all(|(x, y)| (x - y).abs() < 1e-5));
    /// # Ok::<_, coseg_geometry::linalg::dense_eigen::DenseEigenError>(())
    /// ```
    ///
    /// # Errors
    /// If the dense eigensolver does not converge.
    ///
    /// # Panics
    /// If a map names a shape that does not exist, or its number of entries does not fit its
    /// shapes.
    pub fn solve(
        eigenvalues: &[&[f64]],
        links: &[Link<'_>],
        r: usize,
    ) -> Result<Self, DenseEigenError> {
        let mut offsets = vec![0];
        for values in eigenvalues {
            offsets.push(offsets[offsets.len() - 1] + values.len());
        }
        let n = offsets[eigenvalues.len()];
        let r = r.min(n);
        let sizes: Vec<usize> = eigenvalues.iter().map(|e| e.len()).collect();
        let maps: Vec<DMatrix<f64>> = links.iter().map(|l| l.matrix(&sizes)).collect();
        let mut weights: Vec<f64> = links.iter().map(|l| l.weight).collect();
        let mut blocks = Vec::new();
        for round in 0..ROUNDS {
            let mut w = DMatrix::<f64>::zeros(n, n);
            for ((link, c), weight) in links.iter().zip(&maps).zip(&weights) {
                let (i, j) = (offsets[link.from], offsets[link.to]);
                let (k1, k2) = (c.ncols(), c.nrows());
                let mut own = w.view_mut((i, i), (k1, k1));
                own += c.transpose() * c * *weight;
                let mut other = w.view_mut((j, j), (k2, k2));
                other += DMatrix::<f64>::identity(k2, k2) * *weight;
                let mut across = w.view_mut((j, i), (k2, k1));
                across -= c * *weight;
                let mut back = w.view_mut((i, j), (k1, k2));
                back -= c.transpose() * *weight;
            }
            let (_, vectors) = symmetric_eigen(w.as_slice(), n)?;
            let scale = (eigenvalues.len() as f64).sqrt();
            blocks = (0..eigenvalues.len())
                .map(|s| DMatrix::from_fn(sizes[s], r, |a, b| scale * vectors[(offsets[s] + a, b)]))
                .collect();
            if round + 1 < ROUNDS {
                for ((link, c), weight) in links.iter().zip(&maps).zip(&mut weights) {
                    let departure = departure(c, &blocks[link.from], &blocks[link.to]);
                    *weight = link.weight / departure.max(LEAST_DEPARTURE);
                }
            }
        }
        let mut energy = DMatrix::zeros(r, r);
        for (block, values) in blocks.iter().zip(eigenvalues) {
            energy += weighted_gram(block, values);
        }
        Ok(Self { r, blocks, energy })
    }

    /// Adds a shape by its maps from the shapes of the basis: `Y = Σ w_i C_i Y_i / Σ w_i`, in which
    /// departing maps lose weight. The other shapes keep their coefficients. Returns its number.
    /// O(maps k² r).
    ///
    /// # Panics
    /// Like [`Self::solve`]; `to` of the links is ignored.
    pub fn insert(&mut self, eigenvalues: &[f64], links: &[Link<'_>]) -> usize {
        let k = eigenvalues.len();
        let mut sizes: Vec<usize> = self.blocks.iter().map(DMatrix::nrows).collect();
        sizes.push(k);
        let new = self.blocks.len();
        let estimates: Vec<DMatrix<f64>> = links
            .iter()
            .map(|l| Link { to: new, ..*l }.matrix(&sizes) * &self.blocks[l.from])
            .collect();
        let mut weights: Vec<f64> = links.iter().map(|l| l.weight).collect();
        let mut block = DMatrix::zeros(k, self.r);
        for _ in 0..ROUNDS {
            let total: f64 = weights.iter().sum();
            block = DMatrix::zeros(k, self.r);
            for (y, weight) in estimates.iter().zip(&weights) {
                block += y * (*weight / total.max(1e-300));
            }
            for ((y, link), weight) in estimates.iter().zip(links).zip(&mut weights) {
                let departure = (y - &block).norm() / block.norm().max(1e-300);
                *weight = link.weight / departure.max(LEAST_DEPARTURE);
            }
        }
        self.energy += weighted_gram(&block, eigenvalues);
        self.blocks.push(block);
        new
    }

    /// Number of latent functions.
    pub fn n_functions(&self) -> usize {
        self.r
    }

    /// Number of shapes.
    pub fn n_shapes(&self) -> usize {
        self.blocks.len()
    }

    /// Coefficients `(k, r)` of the latent functions on a shape.
    pub fn block(&self, shape: usize) -> &DMatrix<f64> {
        &self.blocks[shape]
    }

    /// The departure of a map from the latent functions: it compares the transferred functions of
    /// its source with those of its target. 0 means equal, 1 a difference as large as the
    /// functions.
    ///
    /// # Panics
    /// Like [`Self::solve`].
    pub fn departure(&self, link: &Link<'_>) -> f64 {
        let sizes: Vec<usize> = self.blocks.iter().map(DMatrix::nrows).collect();
        departure(
            &link.matrix(&sizes),
            &self.blocks[link.from],
            &self.blocks[link.to],
        )
    }

    /// The map `Y_to Y_from⁺ (k_to, k_from)`, row-major, by way of the latent functions.
    pub fn through(&self, from: usize, to: usize) -> Vec<f32> {
        let y = &self.blocks[from];
        let svd = SVD::new(y.clone(), true, true);
        let least = LEAST_SINGULAR * svd.singular_values.max();
        let inverse = svd
            .pseudo_inverse(least.max(1e-12))
            .unwrap_or_else(|_| DMatrix::zeros(y.ncols(), y.nrows()));
        let c = &self.blocks[to] * inverse;
        c.transpose().iter().map(|x| *x as f32).collect()
    }

    /// The rotation `(r, r)` that makes the latent functions canonical: with it, `Σ Y_iᵀ Λ_i Y_i`
    /// is diagonal and ascending; the diagonal is the mean eigenvalues times the number of shapes.
    /// Coefficients become `Y_i U`.
    ///
    /// # Errors
    /// If the dense eigensolver does not converge.
    pub fn canonical(&self) -> Result<(Vec<f64>, DMatrix<f64>), DenseEigenError> {
        let (values, vectors) = symmetric_eigen(self.energy.as_slice(), self.r)?;
        let u = DMatrix::from_fn(self.r, self.r, |i, j| vectors[(i, j)]);
        Ok((values, u))
    }
}

fn departure(c: &DMatrix<f64>, from: &DMatrix<f64>, to: &DMatrix<f64>) -> f64 {
    (c * from - to).norm() / to.norm().max(1e-300)
}

/// `Yᵀ Λ Y`.
fn weighted_gram(block: &DMatrix<f64>, eigenvalues: &[f64]) -> DMatrix<f64> {
    let scaled = DMatrix::from_fn(block.nrows(), block.ncols(), |i, j| {
        eigenvalues[i] * block[(i, j)]
    });
    block.transpose() * scaled
}

#[cfg(test)]
mod tests {
    use super::super::consistency::tests::{K, spoil, turned};
    use super::super::consistency::{Link, links};
    use super::super::convert::{functional, pointwise};
    use super::LatentBasis;

    fn difference(a: &[f32], b: &[f32]) -> f64 {
        let d = a.iter().zip(b).map(|(x, y)| f64::from(x - y).powi(2));
        (d.sum::<f64>() / K as f64).sqrt()
    }

    #[test]
    fn what_is_right_is_found_among_wrong_maps_and_by_new_shapes() {
        let (shapes, right) = turned(14);
        let mut maps = right.clone();
        let wrong = spoil(&shapes, &mut maps);
        let values: Vec<&[f64]> = shapes.iter().map(|s| s.eigenvalues.as_slice()).collect();
        let all = links(&maps);
        // Eight shapes join together, the others one after the other.
        let first: Vec<Link<'_>> = all.iter().filter(|l| l.to < 8).copied().collect();
        let mut latent = LatentBasis::solve(&values[..8], &first, K).unwrap();
        let before: Vec<_> = (0..8).map(|s| latent.block(s).clone()).collect();
        for (s, values) in values.iter().enumerate().skip(8) {
            let into: Vec<Link<'_>> = all.iter().filter(|l| l.to == s).copied().collect();
            assert_eq!(latent.insert(values, &into), s);
        }
        assert!((0..8).all(|s| *latent.block(s) == before[s]));
        for (at, (i, j, c)) in right.iter().enumerate() {
            let through = latent.through(*i, *j);
            let error = difference(&through, c);
            assert!(error < 0.15, "map {at}: {error}");
            if wrong.contains(&at) {
                assert!(difference(&maps[at].2, c) > 0.8);
                // As a start of a refinement it leads to the right vertices.
                let (a, b) = (shapes[*i].basis(), shapes[*j].basis());
                let p2p = pointwise(&a, &b, &through, K);
                assert!(difference(&functional(&a, &b, &p2p, K, K), c) < 0.15);
                assert!(latent.departure(&all[at]) > 3.0 * latent.departure(&links(&right)[at]));
            }
        }
        // Canonical coordinates have the mean eigenvalues.
        let (values, u) = latent.canonical().unwrap();
        assert!((u.transpose() * &u - nalgebra::DMatrix::identity(K, K)).norm() < 1e-9);
        assert!(values.windows(2).all(|w| w[0] <= w[1]));
    }
}
