//! Descriptors and spectra of two shapes become a functional map, by ZoomOut with descriptors kept in the
//! nearest-neighbour search.
//!
//! ZoomOut (Melzi et al. 2019, *ZoomOut: Spectral Upsampling for Efficient Shape Correspondence*) alternates a
//! pointwise map by nearest neighbours in the spectral embedding and a larger functional map by projection. On
//! shapes that are not isometric the spectral embedding alone drifts; with the descriptors concatenated to it
//! parts stay on parts. The start is the nearest neighbour in descriptor space.

use super::{FunctionalMap, Quality};
use crate::linalg::nearest::nearest_rows;
use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, MatRef, Par};

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
    let mut k = options.k_start.min(k_end);
    let mut p2p_21 = nearest_rows(two.descriptors, one.descriptors, one.dim);
    let mut c_12 = project(one, two, &p2p_21, k);
    let mean_norm = weighted_mean(one.mass, |v| squared_norm(row(one.descriptors, one.dim, v)));
    loop {
        let beta = (options.descriptor_weight * k as f32 / mean_norm.max(1e-12) as f32).sqrt();
        let targets = embedded(one, &leading(one, k), k, beta);
        let mut carried = Mat::<f32>::zeros(two.mass.len(), k);
        matmul(
            carried.as_mut(),
            Accum::Replace,
            leading(two, k).as_ref(),
            c_12.as_ref(),
            1.0,
            Par::Seq,
        );
        let queries = embedded(two, &carried, k, beta);
        p2p_21 = nearest_rows(&queries, &targets, k + one.dim);
        c_12 = project(one, two, &p2p_21, (k + options.k_step).min(k_end));
        if k == k_end {
            break;
        }
        k = (k + options.k_step).min(k_end);
    }
    let quality = quality(one, two, &c_12, &p2p_21);
    let c = (0..k_end).flat_map(|i| (0..k_end).map(move |j| (i, j)));
    FunctionalMap {
        c_12: c.map(|(i, j)| c_12[(i, j)]).collect(),
        k1: k_end,
        k2: k_end,
        p2p_21,
        quality,
    }
}

fn row(values: &[f32], dim: usize, v: usize) -> &[f32] {
    &values[v * dim..(v + 1) * dim]
}

fn squared_norm(x: &[f32]) -> f64 {
    x.iter().map(|v| f64::from(v * v)).sum()
}

fn weighted_mean(mass: &[f32], value: impl Fn(usize) -> f64) -> f64 {
    let total: f64 = mass.iter().map(|m| f64::from(*m)).sum();
    let sum: f64 = mass
        .iter()
        .enumerate()
        .map(|(v, m)| f64::from(*m) * value(v))
        .sum();
    sum / total.max(1e-300)
}

/// The first `k` eigenvectors `(n, k)`.
fn leading(shape: &MapShape<'_>, k: usize) -> Mat<f32> {
    Mat::from_fn(shape.mass.len(), k, |v, j| {
        shape.eigenvectors[v * shape.n_eigenvectors + j]
    })
}

/// Rows `[spectral (k), β descriptors (dim)]`, row-major.
fn embedded(shape: &MapShape<'_>, spectral: &Mat<f32>, k: usize, beta: f32) -> Vec<f32> {
    let n = shape.mass.len();
    let mut out = Vec::with_capacity(n * (k + shape.dim));
    for v in 0..n {
        out.extend((0..k).map(|j| spectral[(v, j)]));
        out.extend(
            row(shape.descriptors, shape.dim, v)
                .iter()
                .map(|x| beta * x),
        );
    }
    out
}

/// `Φ₂⁺ Φ₁[p2p_21] (k, k)` with `Φ₂⁺ = Φ₂ᵀ A₂`.
fn project(one: &MapShape<'_>, two: &MapShape<'_>, p2p_21: &[u32], k: usize) -> Mat<f32> {
    let n = two.mass.len();
    let weighted: Vec<f32> = (0..n)
        .flat_map(|v| {
            let phi = &row(two.eigenvectors, two.n_eigenvectors, v)[..k];
            phi.iter().map(move |x| x * two.mass[v])
        })
        .collect();
    let pulled: Vec<f32> = p2p_21
        .iter()
        .flat_map(|t| {
            row(one.eigenvectors, one.n_eigenvectors, *t as usize)[..k]
                .iter()
                .copied()
        })
        .collect();
    let mut c = Mat::<f32>::zeros(k, k);
    matmul(
        c.as_mut(),
        Accum::Replace,
        MatRef::from_row_major_slice(&weighted, n, k).transpose(),
        MatRef::from_row_major_slice(&pulled, n, k),
        1.0,
        Par::Seq,
    );
    c
}

fn quality(one: &MapShape<'_>, two: &MapShape<'_>, c_12: &Mat<f32>, p2p_21: &[u32]) -> Quality {
    let descriptor_residual = weighted_mean(two.mass, |v| {
        let a = row(two.descriptors, two.dim, v);
        let b = row(one.descriptors, one.dim, p2p_21[v] as usize);
        a.iter()
            .zip(b)
            .map(|(x, y)| f64::from((x - y) * (x - y)))
            .sum()
    });
    let k = c_12.ncols();
    let gram = c_12.transpose() * c_12;
    let mut departure = 0.0;
    let mut small = 0usize;
    for i in 0..k {
        for j in 0..k {
            departure += f64::from(gram[(i, j)] - if i == j { 1.0 } else { 0.0 }).powi(2);
            small += usize::from(c_12[(i, j)].abs() < 0.1);
        }
    }
    let mut hit = vec![false; one.mass.len()];
    for t in p2p_21 {
        hit[*t as usize] = true;
    }
    Quality {
        descriptor_residual,
        orthogonality: (departure / k as f64).sqrt(),
        coverage: weighted_mean(one.mass, |v| f64::from(u8::from(hit[v]))),
        near_zero: small as f64 / (k * k) as f64,
    }
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
