//! Computes the functional map that best transfers corresponding functions.
//!
//! It minimises `w_d/2 ‖C F − G‖² + w_l/2 Σ M_ij C_ij² + w_o/2 Σ_p ‖C X_p − Y_p C‖²` with
//! coefficients F `(k1, p)` and G `(k2, p)` of probe functions, a mask M that keeps C near the
//! diagonal (commuting with the Laplacians, or their resolvents: Ren et al. 2019, *Structured
//! Regularization of Functional Map Computations*), and pairs of operators with which C must
//! commute: multiplication by a function (Nogneng and Ovsjanikov 2017, *Informative Descriptor
//! Preservation via Commutativity*) or crossing with its gradient (Ren et al. 2018, *Continuous and
//! Orientation-preserving Correspondences*). The first column is given, because constants map to
//! constants. Without operators the rows are independent, k2 systems of k1 unknowns; with operators
//! conjugate gradients solve for all at once.

use nalgebra::{DMatrix, DVector};

/// The terms of the energy. Terms with weight 0 and empty lists have no effect.
#[derive(Debug, Clone)]
pub struct Energy {
    /// F `(k1, p)`.
    pub probes_1: DMatrix<f64>,
    /// G `(k2, p)`.
    pub probes_2: DMatrix<f64>,
    /// w_d.
    pub probe_weight: f64,
    /// M `(k2, k1)`.
    pub mask: DMatrix<f64>,
    /// w_l.
    pub mask_weight: f64,
    /// Pairs X `(k1, k1)`, Y `(k2, k2)`, each with its weight.
    pub operators: Vec<(DMatrix<f64>, DMatrix<f64>, f64)>,
}

/// The reason why no map was computed.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum SolveError {
    /// Neither probes nor mask determine an entry.
    #[error(
        "row {row} of the map is not determined: give more probe functions or a positive mask \
         weight"
    )]
    Undetermined {
        /// Row of C.
        row: usize,
    },
    /// Conjugate gradients stopped before the residual was small.
    #[error(
        "the residual is {residual:e} of the right side after {iterations} iterations, the limit \
         is {limit:e}"
    )]
    Slow {
        /// Relative residual.
        residual: f64,
        /// Number of iterations.
        iterations: usize,
        /// Largest allowed relative residual.
        limit: f64,
    },
}

/// Relative residual at which conjugate gradients stop, and which they must reach.
const TOLERANCE: f64 = 1e-12;
const LIMIT: f64 = 1e-8;

impl Energy {
    /// The value of the energy at C `(k2, k1)`; not negative.
    ///
    /// # Panics
    /// If sizes do not fit.
    pub fn value(&self, c: &DMatrix<f64>) -> f64 {
        let fit = (c * &self.probes_1 - &self.probes_2).norm_squared();
        let mask: f64 = c.iter().zip(&self.mask).map(|(x, m)| m * x * x).sum();
        let commute =
            |(x, y, w): &(DMatrix<f64>, DMatrix<f64>, f64)| w * (c * x - y * c).norm_squared();
        let operators: f64 = self.operators.iter().map(commute).sum();
        0.5 * (self.probe_weight * fit + self.mask_weight * mask + operators)
    }

    /// Gradient without its constant part: a linear function of C.
    fn apply(&self, c: &DMatrix<f64>, gram: &DMatrix<f64>) -> DMatrix<f64> {
        let mut out = c * gram * self.probe_weight + self.mask.component_mul(c) * self.mask_weight;
        for (x, y, w) in &self.operators {
            let difference = c * x - y * c;
            out += (&difference * x.transpose() - y.transpose() * &difference) * *w;
        }
        out
    }

    /// The minimiser `(k2, k1)` among maps with this first column `(k2,)`. O(k2 k1³), or with
    /// operators O(p k³) for each iteration.
    ///
    /// ```
    /// use coseg_geometry::fmap::solve::{Energy, laplacian_mask};
    /// use nalgebra::{DMatrix, DVector};
    ///
    /// // A function that is the second eigenfunction of shape 1, and minus that of shape 2.
    /// let spectrum = [0.0, 2.0, 6.0];
    /// let energy = Energy {
    ///     probes_1: DMatrix::from_column_slice(3, 1, &[0.0, 1.0, 0.0]),
    ///     probes_2: DMatrix::from_column_slice(3, 1, &[0.0, -1.0, 0.0]),
    ///     probe_weight: 1.0,
    ///     mask: laplacian_mask(&spectrum, &spectrum).add_scalar(1e-6),
    ///     mask_weight: 1e-3,
    ///     operators: Vec::new(),
    /// };
    /// let c = energy.minimiser(&DVector::from_column_slice(&[1.0, 0.0, 0.0]))?;
    /// assert!((c[(1, 1)] + 1.0).abs() < 1e-6 && c[(2, 2)].abs() < 1e-6);
    /// assert!(energy.value(&c) < energy.value(&DMatrix::identity(3, 3)));
    /// # Ok::<_, coseg_geometry::fmap::solve::SolveError>(())
    /// ```
    ///
    /// # Errors
    /// See [`SolveError`].
    ///
    /// # Panics
    /// If sizes do not fit.
    pub fn minimiser(&self, first_column: &DVector<f64>) -> Result<DMatrix<f64>, SolveError> {
        let (k2, k1) = self.mask.shape();
        assert_eq!(
            (
                self.probes_1.nrows(),
                self.probes_2.nrows(),
                first_column.len()
            ),
            (k1, k2, k2),
            "sizes of probes, mask and first column"
        );
        let gram = &self.probes_1 * self.probes_1.transpose();
        let mut fixed = DMatrix::zeros(k2, k1);
        fixed.set_column(0, first_column);
        let right = &self.probes_2 * self.probes_1.transpose() * self.probe_weight
            - self.apply(&fixed, &gram);
        let mut c = self.rows(&gram, &right)?;
        if !self.operators.is_empty() {
            c = self.conjugate_gradients(c, &gram, &right)?;
        }
        c.set_column(0, first_column);
        Ok(c)
    }

    /// Solves each row separately, which is exact without operators. Column 0 stays 0.
    fn rows(&self, gram: &DMatrix<f64>, right: &DMatrix<f64>) -> Result<DMatrix<f64>, SolveError> {
        let (k2, k1) = self.mask.shape();
        let mut c = DMatrix::zeros(k2, k1);
        if k1 < 2 {
            return Ok(c);
        }
        let inner = gram.view((1, 1), (k1 - 1, k1 - 1)) * self.probe_weight;
        for row in 0..k2 {
            let mut system = inner.clone();
            for j in 1..k1 {
                system[(j - 1, j - 1)] += self.mask_weight * self.mask[(row, j)];
            }
            let b = DVector::from_fn(k1 - 1, |j, _| right[(row, j + 1)]);
            let found = system.cholesky().map(|f| f.solve(&b));
            // With operators this is a start only, and they may determine entries that the probes
            // leave open.
            let Some(x) = found.or_else(|| (!self.operators.is_empty()).then(|| b * 0.0)) else {
                return Err(SolveError::Undetermined { row });
            };
            for j in 1..k1 {
                c[(row, j)] = x[j - 1];
            }
        }
        Ok(c)
    }

    fn conjugate_gradients(
        &self,
        mut c: DMatrix<f64>,
        gram: &DMatrix<f64>,
        right: &DMatrix<f64>,
    ) -> Result<DMatrix<f64>, SolveError> {
        let (k2, k1) = self.mask.shape();
        let held = |mut m: DMatrix<f64>| {
            m.column_mut(0).fill(0.0);
            m
        };
        // The preconditioner is the diagonal of the quadratic form.
        let mut diagonal = DMatrix::from_fn(k2, k1, |i, j| {
            self.probe_weight * gram[(j, j)] + self.mask_weight * self.mask[(i, j)]
        });
        for (x, y, w) in &self.operators {
            for j in 0..k1 {
                let row = x.row(j).norm_squared();
                for i in 0..k2 {
                    diagonal[(i, j)] +=
                        w * (row + y.column(i).norm_squared() - 2.0 * x[(j, j)] * y[(i, i)]);
                }
            }
        }
        let most = diagonal.max();
        let inverse = diagonal.map(|d| 1.0 / d.max(1e-12 * most).max(f64::MIN_POSITIVE));
        let goal = held(right.clone()).norm().max(f64::MIN_POSITIVE);
        let mut r = held(right - self.apply(&c, gram));
        let mut z = inverse.component_mul(&r);
        let mut p = z.clone();
        let mut rz = r.dot(&z);
        let iterations = 20 * k1.max(k2) + 200;
        for _ in 0..iterations {
            if r.norm() <= TOLERANCE * goal {
                return Ok(c);
            }
            let q = held(self.apply(&p, gram));
            let curvature = p.dot(&q);
            if curvature <= 0.0 {
                break;
            }
            let step = rz / curvature;
            c += &p * step;
            r -= &q * step;
            z = inverse.component_mul(&r);
            let next = r.dot(&z);
            p = &z + &p * (next / rz);
            rz = next;
        }
        let residual = r.norm() / goal;
        if residual > LIMIT {
            return Err(SolveError::Slow {
                residual,
                iterations,
                limit: LIMIT,
            });
        }
        Ok(c)
    }
}

/// `(λ_1j − λ_2i)²`, scaled to sum 1: `(k2, k1)`. It is 0 where the spectra agree, so that mixing
/// frequencies costs. All 0 if all eigenvalues are equal.
///
/// ```
/// let mask = coseg_geometry::fmap::solve::laplacian_mask(&[0.0, 1.0], &[0.0, 1.0, 1.0]);
/// assert_eq!(mask.shape(), (3, 2));
/// assert_eq!((mask[(1, 1)], mask[(1, 0)]), (0.0, 1.0 / 3.0));
/// ```
pub fn laplacian_mask(values_1: &[f64], values_2: &[f64]) -> DMatrix<f64> {
    let mask = DMatrix::from_fn(values_2.len(), values_1.len(), |i, j| {
        (values_1[j] - values_2[i]).powi(2)
    });
    let sum = mask.sum();
    if sum > 0.0 { mask / sum } else { mask }
}

/// Squared distance of the resolvents `(Δ^γ − i)⁻¹`, both spectra divided by the largest
/// eigenvalue: bounded, and so independent of k in scale (Ren et al. 2019); `(k2, k1)`.
///
/// ```
/// let mask = coseg_geometry::fmap::solve::resolvent_mask(&[0.0, 9.0], &[0.0, 9.0], 0.5);
/// // Frequencies that agree cost nothing, others at most 1.
/// assert_eq!((mask[(0, 0)], mask[(1, 1)]), (0.0, 0.0));
/// assert!((mask[(0, 1)] - 0.5).abs() < 1e-12);
/// ```
pub fn resolvent_mask(values_1: &[f64], values_2: &[f64], gamma: f64) -> DMatrix<f64> {
    let all = values_1.iter().chain(values_2);
    let largest = all.fold(f64::MIN_POSITIVE, |m, x| m.max(x.abs()));
    let resolvent = |x: f64| {
        let g = (x.abs() / largest).powf(gamma);
        (g / (g * g + 1.0), 1.0 / (g * g + 1.0))
    };
    DMatrix::from_fn(values_2.len(), values_1.len(), |i, j| {
        let ((a, b), (c, d)) = (resolvent(values_1[j]), resolvent(values_2[i]));
        (a - c).powi(2) + (b - d).powi(2)
    })
}

#[cfg(test)]
mod tests {
    use super::{Energy, SolveError, laplacian_mask, resolvent_mask};
    use nalgebra::{DMatrix, DVector};
    use rand::{Rng, SeedableRng};

    fn random(rows: usize, columns: usize, seed: u64) -> DMatrix<f64> {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
        DMatrix::from_fn(rows, columns, |_, _| rng.random_range(-1.0..1.0))
    }

    fn energy(operators: usize) -> Energy {
        let (k1, k2) = (7, 9);
        let values: Vec<f64> = (0..9).map(|i| f64::from(i * i)).collect();
        Energy {
            probes_1: random(k1, 12, 1),
            probes_2: random(k2, 12, 2),
            probe_weight: 0.7,
            mask: laplacian_mask(&values[..k1], &values),
            mask_weight: 3.0,
            operators: (0..operators as u64)
                .map(|o| (random(k1, k1, 10 + o), random(k2, k2, 20 + o), 0.4))
                .collect(),
        }
    }

    #[test]
    fn no_map_with_the_same_first_column_has_less_energy() {
        for operators in [0, 3] {
            let energy = energy(operators);
            let first = DVector::from_fn(9, |i, _| if i == 0 { 1.5 } else { 0.0 });
            let c = energy.minimiser(&first).unwrap();
            assert_eq!(c.column(0), first);
            let least = energy.value(&c);
            for seed in 30..60 {
                let mut step = random(9, 7, seed) * 1e-3;
                step.column_mut(0).fill(0.0);
                let (up, down) = (energy.value(&(&c + &step)), energy.value(&(&c - &step)));
                assert!(up > least && down > least);
                // At a minimum the slope is zero.
                assert!((up - down).abs() < 1e-7 * least, "{operators} operators");
            }
        }
    }

    #[test]
    fn a_map_that_explains_everything_is_found() {
        let truth = random(6, 6, 3);
        let probes_1 = random(6, 10, 4);
        let x = random(6, 6, 5);
        let inverse = truth.clone().try_inverse().unwrap();
        let energy = Energy {
            probes_2: &truth * &probes_1,
            probes_1,
            probe_weight: 1.0,
            mask: DMatrix::zeros(6, 6),
            mask_weight: 0.0,
            operators: vec![(x.clone(), &truth * x * inverse, 1.0)],
        };
        let c = energy.minimiser(&truth.column(0).into_owned()).unwrap();
        assert!((c - truth).norm() < 1e-6);
    }

    #[test]
    fn too_few_probes_are_refused() {
        let mut energy = energy(0);
        energy.probes_1 = random(7, 2, 6);
        energy.probes_2 = random(9, 2, 7);
        energy.mask_weight = 0.0;
        let refused = energy.minimiser(&DVector::zeros(9)).unwrap_err();
        assert_eq!(refused, SolveError::Undetermined { row: 0 });
    }

    #[test]
    fn masks_are_zero_where_eigenvalues_agree() {
        let values = [0.0, 1.0, 4.0];
        for mask in [
            laplacian_mask(&values, &values),
            resolvent_mask(&values, &values, 0.5),
        ] {
            for i in 0..3 {
                for j in 0..3 {
                    assert_eq!(mask[(i, j)] == 0.0, i == j);
                    assert!(mask[(i, j)] <= 1.0);
                }
            }
        }
    }
}
