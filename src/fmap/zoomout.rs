//! Descriptors and spectra of two shapes become a functional map, by ZoomOut with descriptors kept in the
//! nearest-neighbour search.
//!
//! ZoomOut (Melzi et al. 2019, *ZoomOut: Spectral Upsampling for Efficient Shape Correspondence*) alternates a
//! pointwise map by nearest neighbours in the spectral embedding and a larger functional map by projection. On
//! shapes that are not isometric the spectral embedding alone drifts; with the descriptors concatenated to it
//! parts stay on parts. The start is the nearest neighbour in descriptor space.

use super::FunctionalMap;
use super::basis::{Basis, product};
use super::convert::{functional, pointwise};
use super::quality::Quality;
use super::samples::{SampledBasis, columns};
use crate::linalg::nearest::nearest_rows;

/// What a map needs of a shape.
#[derive(Debug, Clone, Copy)]
pub struct MapShape<'a> {
    /// Mass-orthonormal eigenvectors `(n, n_eigenvectors)`, row-major, total mass 1.
    pub eigenvectors: &'a [f32],
    /// Columns of `eigenvectors`.
    pub n_eigenvectors: usize,
    /// Lumped mass `(n,)`.
    pub mass: &'a [f32],
    /// Descriptors at the vertices `(n, dim)`, comparable between the shapes.
    pub descriptors: &'a [f32],
    /// Columns of `descriptors`.
    pub dim: usize,
}

/// Sizes and weights of [`descriptor_zoomout`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapOptions {
    /// Size of the first map.
    pub k_start: usize,
    /// Growth a round.
    pub k_step: usize,
    /// Size of the last map; cut to what the shapes have.
    pub k_end: usize,
    /// β: mean squared norm of the descriptor block relative to the spectral block.
    pub descriptor_weight: f32,
}

impl Default for MapOptions {
    fn default() -> Self {
        Self {
            k_start: 20,
            k_step: 10,
            k_end: 60,
            descriptor_weight: 1.0,
        }
    }
}

impl<'a> MapShape<'a> {
    /// Its basis. Eigenvalues play no part in these maps.
    fn basis(&self) -> Basis<'a> {
        Basis {
            eigenvalues: &[],
            eigenvectors: self.eigenvectors,
            n_eigenvectors: self.n_eigenvectors,
            mass: self.mass,
        }
    }
}

/// The map from shape 1 to shape 2 (functions), with `p2p_21` from the vertices of 2 to those of 1.
/// Costs about `2 n1 n2 (k + dim)` flops a round.
pub fn descriptor_zoomout(
    one: &MapShape<'_>,
    two: &MapShape<'_>,
    options: &MapOptions,
) -> FunctionalMap {
    let k_end = options
        .k_end
        .min(one.n_eigenvectors)
        .min(two.n_eigenvectors)
        .max(1);
    let (basis_1, basis_2) = (one.basis(), two.basis());
    let mut k = options.k_start.min(k_end);
    let mut p2p_21 = nearest_rows(two.descriptors, one.descriptors, one.dim);
    let mut c_12 = functional(&basis_1, &basis_2, &p2p_21, k, k);
    let mean_norm = mean_square(one);
    loop {
        let beta = (options.descriptor_weight * k as f32 / mean_norm.max(1e-12) as f32).sqrt();
        let targets = embedded(one, &basis_1.leading(k), k, beta);
        let carried = product(&basis_2.leading(k), &c_12, two.mass.len(), k, k);
        let queries = embedded(two, &carried, k, beta);
        p2p_21 = nearest_rows(&queries, &targets, k + one.dim);
        let next = (k + options.k_step).min(k_end);
        c_12 = functional(&basis_1, &basis_2, &p2p_21, next, next);
        if k == k_end {
            break;
        }
        k = next;
    }
    let quality = Quality::new(one, two, &c_12, k_end, &p2p_21);
    FunctionalMap {
        c_12,
        k1: k_end,
        k2: k_end,
        p2p_21,
        quality,
    }
}

/// ZoomOut as published, on all vertices: `rounds` times a pointwise map and a functional map that is larger by `step`;
/// then the pointwise map of the last. `c_12` is `(k, k)`, row-major. O(rounds n1 n2 k).
///
/// # Panics
/// If there are fewer than `k + rounds step` eigenvectors.
pub fn zoomout(
    one: &Basis<'_>,
    two: &Basis<'_>,
    c_12: &[f32],
    k: usize,
    step: usize,
    rounds: usize,
) -> (Vec<f32>, Vec<u32>) {
    let (mut c, mut k) = (c_12.to_vec(), k);
    for _ in 0..rounds {
        let p2p_21 = pointwise(one, two, &c, k);
        k += step;
        c = functional(one, two, &p2p_21, k, k);
    }
    let p2p_21 = pointwise(one, two, &c, k);
    (c, p2p_21)
}

/// ZoomOut on samples, through the sizes `ks`: of `c_12 (k, k)`, a map of the last size. Functional maps by weighted
/// least squares at the samples.
pub fn zoomout_sampled(
    one: &SampledBasis,
    two: &SampledBasis,
    c_12: &[f32],
    k: usize,
    ks: &[usize],
) -> Vec<f32> {
    let (mut c, mut k) = (c_12.to_vec(), k);
    for &next in ks {
        let targets = super::basis::product_transposed(&one.leading(k), &c, one.n, k, k);
        let p2p_21 = nearest_rows(&two.leading(k), &targets, k);
        let rows = columns(&one.rows, one.k, next);
        let pulled = super::transfer::pulled_back(&p2p_21, &rows, next);
        c = two.fit(&pulled, next, next);
        k = next;
    }
    c
}

fn mean_square(shape: &MapShape<'_>) -> f64 {
    let rows = shape
        .descriptors
        .chunks_exact(shape.dim.max(1))
        .zip(shape.mass);
    let sum: f64 = rows
        .map(|(row, m)| f64::from(*m) * row.iter().map(|x| f64::from(x * x)).sum::<f64>())
        .sum();
    let total: f64 = shape.mass.iter().map(|m| f64::from(*m)).sum();
    sum / total.max(1e-300)
}

/// Rows `[spectral (k), β descriptors (dim)]`, row-major.
fn embedded(shape: &MapShape<'_>, spectral: &[f32], k: usize, beta: f32) -> Vec<f32> {
    let mut out = Vec::with_capacity(shape.mass.len() * (k + shape.dim));
    let descriptors = shape.descriptors.chunks_exact(shape.dim);
    for (phi, x) in spectral.chunks_exact(k).zip(descriptors) {
        out.extend_from_slice(phi);
        out.extend(x.iter().map(|x| beta * x));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::seq::SliceRandom;
    use rand::{Rng, SeedableRng};

    /// A cycle of `n` equal vertices with its Fourier basis and a descriptor that tells vertices apart.
    fn cycle(n: usize, order: &[usize]) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
        let k = 21;
        let angle = |v: usize| 2.0 * std::f32::consts::PI * order[v] as f32 / n as f32;
        let phi = (0..n)
            .flat_map(|v| {
                (0..k).map(move |j: usize| match j {
                    0 => 1.0,
                    j if j % 2 == 1 => 2f32.sqrt() * (angle(v) * j.div_ceil(2) as f32).cos(),
                    j => 2f32.sqrt() * (angle(v) * (j / 2) as f32).sin(),
                })
            })
            .collect();
        let descriptors = (0..n)
            .flat_map(|v| [angle(v).cos(), 0.5 * (2.0 * angle(v)).sin()])
            .collect();
        (phi, vec![1.0 / n as f32; n], descriptors)
    }

    #[test]
    fn renumbered_shapes_are_matched_exactly() {
        let n = 240;
        let identity: Vec<usize> = (0..n).collect();
        let mut shuffled = identity.clone();
        shuffled.shuffle(&mut rand_pcg::Pcg64::seed_from_u64(4));
        let (phi1, mass, x1) = cycle(n, &identity);
        let (phi2, _, x2) = cycle(n, &shuffled);
        let shape = |eigenvectors, descriptors| MapShape {
            eigenvectors,
            n_eigenvectors: 21,
            mass: &mass,
            descriptors,
            dim: 2,
        };
        let options = MapOptions {
            k_start: 5,
            k_step: 4,
            k_end: 21,
            descriptor_weight: 1.0,
        };
        let map = descriptor_zoomout(&shape(&phi1, &x1), &shape(&phi2, &x2), &options);
        let expected: Vec<u32> = shuffled.iter().map(|v| *v as u32).collect();
        assert_eq!(map.p2p_21, expected);
        assert!(map.quality.orthogonality < 1e-3 && map.quality.coverage > 0.999);
        assert!(map.quality.descriptor_residual < 1e-9);
    }

    #[test]
    fn a_small_exact_map_grows_to_a_large_one() {
        use super::super::test_shapes::cycle as curve;
        let (a, b) = (curve(150, 0), curve(150, 23));
        let p2p: Vec<u32> = (0..150).map(|v| (v + 23) % 150).collect();
        let c = functional(&a.basis(), &b.basis(), &p2p, 3, 3);
        let (large, found) = zoomout(&a.basis(), &b.basis(), &c, 3, 2, 4);
        assert_eq!((large.len(), found), (121, p2p.clone()));
        // Samples that correspond: each third vertex of the one, and what it is matched with on the other.
        let ids = |turn: u32| (0..50).map(|i| (3 * i + turn) % 150).collect::<Vec<u32>>();
        let mass = vec![1.0 / 50.0; 50];
        let one = SampledBasis::new(&a.basis(), &ids(23), &mass, 11);
        let two = SampledBasis::new(&b.basis(), &ids(0), &mass, 11);
        let sampled = zoomout_sampled(&one, &two, &c, 3, &[5, 7, 9, 11]);
        let error: f32 = sampled
            .iter()
            .zip(&large)
            .map(|(x, y)| (x - y).powi(2))
            .sum();
        assert!(error < 1e-4, "{error}");
    }

    #[test]
    fn too_few_eigenvectors_give_a_smaller_map() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(9);
        let phi: Vec<f32> = (0..40 * 3).map(|_| rng.random_range(-1.0..1.0)).collect();
        let x: Vec<f32> = (0..40 * 2).map(|_| rng.random_range(-1.0..1.0)).collect();
        let mass = vec![1.0 / 40.0; 40];
        let s = MapShape {
            eigenvectors: &phi,
            n_eigenvectors: 3,
            mass: &mass,
            descriptors: &x,
            dim: 2,
        };
        let map = descriptor_zoomout(&s, &s, &MapOptions::default());
        assert_eq!(
            (map.k1, map.k2, map.c_12.len(), map.p2p_21.len()),
            (3, 3, 9, 40)
        );
    }
}
