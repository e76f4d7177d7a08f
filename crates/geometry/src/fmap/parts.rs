//! Computes a functional map that is accurate for parts from the descriptors and spectra of two
//! shapes: ZoomOut with descriptors in the nearest-neighbour search.
//!
//! ZoomOut (Melzi et al. 2019, *ZoomOut: Spectral Upsampling for Efficient Shape Correspondence*)
//! alternates a pointwise map by nearest neighbours in the spectral embedding and a larger
//! functional map by projection. On shapes that are not isometric the spectral embedding alone
//! drifts; with concatenated descriptors, parts stay on parts. The start is the nearest neighbour
//! in descriptor space. Until the last round a few hundred vertices of each shape represent all of
//! them, and descriptors are searched by their principal components. Both shapes use the
//! eigenfunctions below the same eigenvalue, so that maps are rectangular where spectra differ.

use super::FunctionalMap;
use super::basis::{Basis, product, transposed_product};
use super::confidence::Confidence;
use super::convert::functional;
use super::quality::Quality;
use super::samples::SampledBasis;
use crate::linalg::dense_eigen::symmetric_eigen;
use crate::linalg::nearest::{nearest_both, nearest_rows};

/// The data of a shape from which maps are computed.
#[derive(Debug, Clone, Copy)]
pub struct MapShape<'a> {
    /// Eigenvalues, ascending, at least as many as eigenvectors.
    pub eigenvalues: &'a [f64],
    /// Mass-orthonormal eigenvectors `(n, n_eigenvectors)`, row-major, total mass 1.
    pub eigenvectors: &'a [f32],
    /// Columns of `eigenvectors`.
    pub n_eigenvectors: usize,
    /// Lumped mass `(n,)`.
    pub mass: &'a [f32],
    /// Faces `(m, 3)`.
    pub faces: &'a [[u32; 3]],
    /// Descriptors at the vertices `(n, dim)`, comparable between the shapes.
    pub descriptors: &'a [f32],
    /// Columns of `descriptors`.
    pub dim: usize,
}

/// Sizes and weights of [`descriptor_zoomout`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapOptions {
    /// Sizes of the maps, ascending; limited by the eigenpairs of the shapes. Small maps come first
    /// because they keep the global structure.
    pub sizes: &'static [usize],
    /// β: mean squared norm of the descriptor block relative to the spectral block.
    pub descriptor_weight: f32,
    /// Number of principal components of the descriptors that are searched.
    pub n_components: usize,
    /// Least number of vertices that represent shape 2 until the last round.
    pub n_queries: usize,
    /// Least number of vertices that represent shape 1 until the last round.
    pub n_targets: usize,
}

impl Default for MapOptions {
    fn default() -> Self {
        Self {
            sizes: &[5, 7, 10, 14, 20, 30, 40, 60],
            descriptor_weight: 2.0,
            n_components: 32,
            n_queries: 400,
            n_targets: 600,
        }
    }
}

impl<'a> MapShape<'a> {
    /// Its basis.
    pub fn basis(&self) -> Basis<'a> {
        Basis {
            eigenvalues: self.eigenvalues,
            eigenvectors: self.eigenvectors,
            n_eigenvectors: self.n_eigenvectors,
            mass: self.mass,
        }
    }

    /// Mass-weighted mean squared norm of the descriptors.
    fn mean_square(&self) -> f64 {
        let rows = self
            .descriptors
            .chunks_exact(self.dim.max(1))
            .zip(self.mass);
        let sum: f64 = rows
            .map(|(row, m)| f64::from(*m) * row.iter().map(|x| f64::from(x * x)).sum::<f64>())
            .sum();
        let total: f64 = self.mass.iter().map(|m| f64::from(*m)).sum();
        sum / total.max(1e-300)
    }
}

/// The map from shape 1 to shape 2 (functions), with `p2p_21` from the vertices of 2 to those of 1.
/// Costs about `2 n1 n2 (k + n_components)` flops, and a third of that for the rounds before the
/// last.
///
/// ```
/// use coseg_geometry::fmap::{MapOptions, MapShape, descriptor_zoomout};
/// use coseg_geometry::{SpectralMesh, mesh::icosphere, operators::Operator, spectrum::Options};
///
/// let sphere = SpectralMesh::new(icosphere(2), Operator::Tufted, 16, &Options::default())?;
/// // Coordinates are descriptors that distinguish all points of a sphere.
/// let place: Vec<f32> = sphere.mesh.vertices.as_flattened().iter().map(|x| *x as f32).collect();
/// let (basis, faces) = (sphere.basis(), &sphere.mesh.faces);
/// let shape = MapShape {
///     eigenvalues: basis.eigenvalues,
///     eigenvectors: basis.eigenvectors,
///     n_eigenvectors: basis.n_eigenvectors,
///     mass: basis.mass,
///     faces,
///     descriptors: &place,
///     dim: 3,
/// };
/// let map = descriptor_zoomout(&shape, &shape, &MapOptions::default());
/// assert!(map.p2p_21.iter().zip(0..).all(|(image, vertex)| *image == vertex));
/// assert!(map.quality.orthogonality < 1e-3 && map.quality.coverage > 0.999);
/// # Ok::<_, coseg_geometry::SpectralMeshError>(())
/// ```
pub fn descriptor_zoomout(
    one: &MapShape<'_>,
    two: &MapShape<'_>,
    options: &MapOptions,
) -> FunctionalMap {
    refined(one, two, None, options)
}

/// Like [`descriptor_zoomout`], from a given map `c_12 (k, k1)`, row-major, in place of nearest
/// neighbours of descriptors.
///
/// ```
/// use coseg_geometry::fmap::{MapOptions, MapShape, descriptor_zoomout_from};
/// use coseg_geometry::{SpectralMesh, mesh::icosphere, operators::Operator, spectrum::Options};
///
/// let sphere = SpectralMesh::new(icosphere(2), Operator::Tufted, 16, &Options::default())?;
/// let (basis, faces) = (sphere.basis(), &sphere.mesh.faces);
/// // A constant descriptor: the map is grown from the start alone, a point reflection.
/// let shape = MapShape {
///     eigenvalues: basis.eigenvalues,
///     eigenvectors: basis.eigenvectors,
///     n_eigenvectors: basis.n_eigenvectors,
///     mass: basis.mass,
///     faces,
///     descriptors: &[1.0; 162],
///     dim: 1,
/// };
/// let start = [1.0, 0., 0., 0., 0., -1.0, 0., 0., 0., 0., -1.0, 0., 0., 0., 0., -1.0];
/// let options = MapOptions::default();
/// let map = descriptor_zoomout_from(&shape, &shape, (&start, 4), &options);
/// let points = &sphere.mesh.vertices;
/// for (p, image) in points.iter().zip(&map.p2p_21) {
///     assert!((0..3).all(|i| (p[i] + points[*image as usize][i]).abs() < 1e-6));
/// }
/// # Ok::<_, coseg_geometry::SpectralMeshError>(())
/// ```
///
/// # Panics
/// If a shape has fewer eigenvectors than the map.
pub fn descriptor_zoomout_from(
    one: &MapShape<'_>,
    two: &MapShape<'_>,
    (c_12, k1): (&[f32], usize),
    options: &MapOptions,
) -> FunctionalMap {
    refined(one, two, Some((c_12, k1)), options)
}

/// The baseline of a map: for each vertex of shape 2 `(n2,)` the vertex of shape 1 with the nearest
/// descriptors, and its confidence as if it were a map.
///
/// ```
/// use coseg_geometry::fmap::{MapShape, nearest_descriptors};
/// use coseg_geometry::{SpectralMesh, mesh::icosphere, operators::Operator, spectrum::Options};
///
/// let sphere = SpectralMesh::new(icosphere(2), Operator::Tufted, 16, &Options::default())?;
/// let (basis, faces) = (sphere.basis(), &sphere.mesh.faces);
/// let place: Vec<f32> = sphere.mesh.vertices.as_flattened().iter().map(|x| *x as f32).collect();
/// let shape = MapShape {
///     eigenvalues: basis.eigenvalues,
///     eigenvectors: basis.eigenvectors,
///     n_eigenvectors: basis.n_eigenvectors,
///     mass: basis.mass,
///     faces,
///     descriptors: &place,
///     dim: 3,
/// };
/// let (p2p_21, confidence) = nearest_descriptors(&shape, &shape);
/// assert!(p2p_21.iter().zip(0..).all(|(image, vertex)| *image == vertex));
/// assert!(confidence.matched_share(basis.mass) > 0.99);
/// # Ok::<_, coseg_geometry::SpectralMeshError>(())
/// ```
pub fn nearest_descriptors(one: &MapShape<'_>, two: &MapShape<'_>) -> (Vec<u32>, Confidence) {
    let (p2p_21, p2p_12) = nearest_both(two.descriptors, one.descriptors, one.dim);
    let k = 60.min(one.n_eigenvectors).min(two.n_eigenvectors).max(1);
    let c_12 = functional(&one.basis(), &two.basis(), &p2p_21, k, k);
    let (_, confidence) = assessed(one, two, &c_12, k, (&p2p_21, &p2p_12));
    (p2p_21, confidence)
}

fn refined(
    one: &MapShape<'_>,
    two: &MapShape<'_>,
    start: Option<(&[f32], usize)>,
    options: &MapOptions,
) -> FunctionalMap {
    let (basis_1, basis_2) = (one.basis(), two.basis());
    let (x1, x2, dim) = components(one, two, options.n_components);
    let mean_norm = one.mean_square().max(1e-12) as f32;
    let queries = spread(two.mass.len(), options.n_queries);
    let targets = spread(one.mass.len(), options.n_targets);
    let (q2, t1) = (at(&x2, dim, &queries), at(&x1, dim, &targets));
    let mass: Vec<f32> = queries.iter().map(|v| two.mass[*v as usize]).collect();
    let n_functions = one.n_eigenvectors.min(two.n_eigenvectors).max(1);
    let largest = options.sizes.last().map_or(1, |k| *k).min(n_functions);
    let sampled = SampledBasis::new(&basis_2, &queries, &mass, two.n_eigenvectors);
    let most = (one.n_eigenvectors, sampled.k);
    let embedding = |spectral: &[f32], k: usize, x: &[f32], beta: f32| -> Vec<f32> {
        let mut rows = Vec::with_capacity(spectral.len() + x.len());
        for (phi, x) in spectral.chunks_exact(k).zip(x.chunks_exact(dim)) {
            rows.extend_from_slice(phi);
            rows.extend(x.iter().map(|x| beta * x));
        }
        rows
    };
    let weight = |k: usize| (options.descriptor_weight * k as f32 / mean_norm).sqrt();
    // For each query, the matched vertex of shape 1.
    let mut matched: Vec<u32> = match start {
        None => nearest_rows(&q2, &t1, dim),
        Some((c_12, columns)) => {
            let rows = c_12.len() / columns.max(1);
            let beta = weight(rows);
            let transferred = product(
                &basis_2.rows(&queries, rows),
                c_12,
                queries.len(),
                rows,
                columns,
            );
            let known = basis_1.rows(&targets, columns);
            nearest_rows(
                &embedding(&transferred, columns, &q2, beta),
                &embedding(&known, columns, &t1, beta),
                columns + dim,
            )
        }
    };
    let fitted = |matched: &[u32], k1: usize, k2: usize| {
        let rows = matched
            .iter()
            .map(|t| basis_1.row(targets[*t as usize], k1));
        let pulled: Vec<f32> = rows.flat_map(|row| row.iter().copied()).collect();
        sampled.fit(&pulled, k1, k2)
    };
    let begin = start.map_or(0, |(c_12, columns)| c_12.len() / columns.max(1));
    let before_last = options
        .sizes
        .iter()
        .filter(|k| **k >= begin && **k < largest);
    for &k in before_last {
        let (k1, k2) = sizes(one, two, k, most);
        let (c_12, beta) = (fitted(&matched, k1, k2), weight(k));
        let transferred = product(&sampled.leading(k2), &c_12, queries.len(), k2, k1);
        let known = basis_1.rows(&targets, k1);
        matched = nearest_rows(
            &embedding(&transferred, k1, &q2, beta),
            &embedding(&known, k1, &t1, beta),
            k1 + dim,
        );
    }
    let (k1, k2) = sizes(one, two, largest, most);
    let (c_12, beta) = (fitted(&matched, k1, k2), weight(largest));
    let transferred = product(&basis_2.leading(k2), &c_12, two.mass.len(), k2, k1);
    let (p2p_21, p2p_12) = nearest_both(
        &embedding(&transferred, k1, &x2, beta),
        &embedding(&basis_1.leading(k1), k1, &x1, beta),
        k1 + dim,
    );
    let c_12 = functional(&basis_1, &basis_2, &p2p_21, k1, k2);
    let (quality, confidence) = assessed(one, two, &c_12, k1, (&p2p_21, &p2p_12));
    FunctionalMap {
        c_12,
        k1,
        k2,
        p2p_21,
        confidence,
        quality,
    }
}

/// The quality of a map, and its confidence at each vertex of shape 2.
fn assessed(
    one: &MapShape<'_>,
    two: &MapShape<'_>,
    c_12: &[f32],
    k1: usize,
    (p2p_21, p2p_12): (&[u32], &[u32]),
) -> (Quality, Confidence) {
    let row = |shape: &MapShape<'_>, v: usize| v * shape.dim..(v + 1) * shape.dim;
    let difference = |v: usize, other: &MapShape<'_>, w: usize| -> f32 {
        let (x, y) = (
            &two.descriptors[row(two, v)],
            &other.descriptors[row(other, w)],
        );
        x.iter().zip(y).map(|(x, y)| (x - y) * (x - y)).sum()
    };
    let matches = p2p_21.iter().enumerate();
    let residuals: Vec<f32> = matches
        .clone()
        .map(|(v, t)| difference(v, one, *t as usize))
        .collect();
    // The return compares the descriptors of a vertex with those of the match of its match, because
    // left and right have similar descriptors.
    let returns: Vec<f32> = matches
        .map(|(v, t)| difference(v, two, p2p_12[*t as usize] as usize))
        .collect();
    let mean = |values: &[f32]| {
        let sum: f64 = values
            .iter()
            .zip(two.mass)
            .map(|(x, m)| f64::from(x * m))
            .sum();
        sum / two
            .mass
            .iter()
            .map(|m| f64::from(*m))
            .sum::<f64>()
            .max(1e-300)
    };
    let mut quality = Quality {
        descriptor_residual: mean(&residuals),
        descriptor_return: mean(&returns),
        ..Quality::of_map(one.mass, c_12, k1, p2p_21)
    };
    quality.confidence = super::confidence::of_map(&quality);
    let confidence = Confidence::new(&quality, two.faces, &residuals, &returns);
    quality.matched = confidence.matched_share(two.mass);
    (quality, confidence)
}

/// Number of eigenfunctions of each shape below the eigenvalue between their k-th ones, limited by
/// `most`.
fn sizes(one: &MapShape<'_>, two: &MapShape<'_>, k: usize, most: (usize, usize)) -> (usize, usize) {
    let last = |s: &MapShape<'_>| s.eigenvalues.get(k - 1).copied().unwrap_or(f64::INFINITY);
    let limit = 0.5 * (last(one) + last(two));
    let below = |s: &MapShape<'_>, most: usize| {
        let n = s.eigenvalues.partition_point(|x| *x <= limit);
        n.clamp((k / 2).max(1), 2 * k).min(most).max(1)
    };
    (below(one, most.0), below(two, most.1))
}

/// At least `count` of `n` vertices (all, if there are no more), evenly spread over their numbers.
fn spread(n: usize, count: usize) -> Vec<u32> {
    let step = (n / count.max(1)).max(1);
    (0..n as u32).step_by(step).collect()
}

/// Rows of `x (n, dim)`.
fn at(x: &[f32], dim: usize, vertices: &[u32]) -> Vec<f32> {
    let rows = vertices.iter();
    rows.flat_map(|v| {
        x[*v as usize * dim..(*v as usize + 1) * dim]
            .iter()
            .copied()
    })
    .collect()
}

/// The descriptors of both shapes by their common principal components, `(n1, d)`, `(n2, d)` and d;
/// distances change little. If there are at most as many columns, they stay unchanged.
fn components(one: &MapShape<'_>, two: &MapShape<'_>, count: usize) -> (Vec<f32>, Vec<f32>, usize) {
    let dim = one.dim;
    let whole = || (one.descriptors.to_vec(), two.descriptors.to_vec(), dim);
    if dim <= count {
        return whole();
    }
    let mut mean = vec![0.0f64; dim];
    let n = one.mass.len() + two.mass.len();
    for row in one
        .descriptors
        .chunks_exact(dim)
        .chain(two.descriptors.chunks_exact(dim))
    {
        mean.iter_mut()
            .zip(row)
            .for_each(|(m, x)| *m += f64::from(*x) / n as f64);
    }
    let centred = |x: &[f32]| -> Vec<f32> {
        x.iter()
            .enumerate()
            .map(|(i, x)| x - mean[i % dim] as f32)
            .collect()
    };
    let (a, b) = (centred(one.descriptors), centred(two.descriptors));
    let gram = |x: &[f32]| transposed_product(x, x, x.len() / dim, dim, dim);
    let covariance: Vec<f64> = gram(&a)
        .iter()
        .zip(gram(&b))
        .map(|(x, y)| f64::from(x + y))
        .collect();
    // All columns give the same map as their components, only more slowly.
    let Ok((_, vectors)) = symmetric_eigen(&covariance, dim) else {
        return whole();
    };
    let largest: Vec<f32> = (0..dim)
        .flat_map(|c| (0..count).map(move |j| (c, j)))
        .map(|(c, j)| vectors[(c, dim - 1 - j)] as f32)
        .collect();
    (
        product(&a, &largest, one.mass.len(), dim, count),
        product(&b, &largest, two.mass.len(), dim, count),
        count,
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::seq::SliceRandom;
    use rand::{Rng, SeedableRng};

    /// A cycle of `n` equal vertices with its Fourier basis and a descriptor that distinguishes
    /// vertices.
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

    fn waves() -> Vec<f64> {
        (0..21usize)
            .map(|j| (j.div_ceil(2) as f64).powi(2))
            .collect()
    }

    #[test]
    fn renumbered_shapes_are_matched_exactly() {
        let n = 240;
        let identity: Vec<usize> = (0..n).collect();
        let mut shuffled = identity.clone();
        shuffled.shuffle(&mut rand_pcg::Pcg64::seed_from_u64(4));
        let (phi1, mass, x1) = cycle(n, &identity);
        let (phi2, _, x2) = cycle(n, &shuffled);
        let values = waves();
        let shape = |eigenvectors, descriptors| MapShape {
            eigenvalues: &values,
            eigenvectors,
            n_eigenvectors: 21,
            mass: &mass,
            faces: &[],
            descriptors,
            dim: 2,
        };
        let (one, two) = (shape(&phi1, &x1), shape(&phi2, &x2));
        let all = MapOptions {
            sizes: &[5, 9, 13, 17, 21],
            descriptor_weight: 1.0,
            n_queries: n,
            n_targets: n,
            ..MapOptions::default()
        };
        let map = descriptor_zoomout(&one, &two, &all);
        let expected: Vec<u32> = shuffled.iter().map(|v| *v as u32).collect();
        assert_eq!(map.p2p_21, expected);
        assert!(map.quality.orthogonality < 1e-3 && map.quality.coverage > 0.999);
        assert!(map.quality.descriptor_residual < 1e-9 && map.quality.confidence > 0.9);
        assert_eq!(map.quality.matched, 1.0);
        let c = super::super::consistency::leading(&map.c_12, 21, 5, 5);
        let again = descriptor_zoomout_from(&one, &two, (&c, 5), &all);
        assert_eq!(again.p2p_21, expected);
        // Where some vertices represent all until the last round, neighbours on the circle are
        // nearly ties.
        let some = MapOptions {
            n_queries: 80,
            n_targets: 120,
            ..all
        };
        for map in [
            descriptor_zoomout(&one, &two, &some),
            descriptor_zoomout_from(&one, &two, (&c, 5), &some),
        ] {
            let steps = map.p2p_21.iter().zip(&shuffled).map(|(found, wanted)| {
                let steps = wanted.abs_diff(*found as usize);
                steps.min(n - steps)
            });
            assert!(steps.clone().all(|steps| steps <= 1), "{:?}", map.p2p_21);
            assert!(steps.filter(|steps| *steps == 0).count() >= n / 2);
        }
    }

    #[test]
    fn too_few_eigenvectors_give_a_smaller_map() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(9);
        let phi: Vec<f32> = (0..40 * 3).map(|_| rng.random_range(-1.0..1.0)).collect();
        let x: Vec<f32> = (0..40 * 2).map(|_| rng.random_range(-1.0..1.0)).collect();
        let mass = vec![1.0 / 40.0; 40];
        let s = MapShape {
            eigenvalues: &[0.0, 1.0, 2.0],
            eigenvectors: &phi,
            n_eigenvectors: 3,
            mass: &mass,
            faces: &[],
            descriptors: &x,
            dim: 2,
        };
        let map = descriptor_zoomout(&s, &s, &MapOptions::default());
        assert_eq!(
            (map.k1, map.k2, map.c_12.len(), map.p2p_21.len()),
            (3, 3, 9, 40)
        );
    }

    #[test]
    fn a_slower_spectrum_gives_a_tall_map() {
        let n = 240;
        let identity: Vec<usize> = (0..n).collect();
        let (phi, mass, x) = cycle(n, &identity);
        let values = waves();
        let low: Vec<f64> = values.iter().map(|x| 0.6 * x).collect();
        let shape = |eigenvalues| MapShape {
            eigenvalues,
            eigenvectors: &phi,
            n_eigenvectors: 21,
            mass: &mass,
            faces: &[],
            descriptors: &x,
            dim: 2,
        };
        let options = MapOptions {
            sizes: &[5, 9, 13],
            ..MapOptions::default()
        };
        let map = descriptor_zoomout(&shape(&values), &shape(&low), &options);
        assert!(map.k2 > map.k1, "{} by {}", map.k2, map.k1);
        assert_eq!(map.c_12.len(), map.k1 * map.k2);
    }
}
