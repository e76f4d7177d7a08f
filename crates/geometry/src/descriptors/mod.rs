//! Computes descriptors of the points, the faces and the whole of a shape from its proxy mesh and
//! spectrum. Descriptors do not depend on pose, position or numbering.
//!
//! Vertex descriptors are [`hks`] (the source paper's eq. 8), [`wks`] and [`gps`]. Face descriptors
//! have 92 columns, in the [`GROUPS`]: thickness, position along geodesics, local shape, position
//! in the principal frame, and heat and wave kernels; the label model predicts labels from them.
//! [`signature`] summarises a shape. Lengths are in units of the square root of the area: the mesh
//! has area 1.

mod geodesic;
mod local_pca;
mod position;
mod shape_diameter;
mod signature;
mod spectral;

pub use geodesic::{GeodesicProfile, geodesic_profile};
pub use local_pca::local_pca;
pub use position::{N_UP_COLUMNS, position, up_columns};
pub use shape_diameter::shape_diameter;
pub use signature::{N_SHAPE_DNA, signature};
pub use spectral::{
    PointKernels, gps, gps_scales, hks, hks_times, null_space, shape_dna, wave_weights, wks,
};

use crate::mesh::{Bridge, DualGraph, FaceGeometry, TriMesh};

/// Names and widths of the groups of face descriptors, in column order.
///
/// - `sdf`: log shape diameter, 2 × its area rank
/// - `agd`: average geodesic distance between its 1st and 99th percentile, 3 × its area rank, and
///   over its minimum
/// - `gc`: share of the area within seven geodesic radii
/// - `q`: quantiles of the geodesic distance over the mean of the largest
/// - `pc`: local principal components at three radii
/// - `pos`: absolute position and direction in the principal frame
/// - `hks`: log heat kernel signature over the heat trace, 16 times
/// - `hksn`: the same less its mean over the area
/// - `wks`: log wave kernel signature, 20 energies
pub const GROUPS: &[(&str, usize)] = &[
    ("sdf", 2),
    ("agd", 3),
    ("gc", geodesic::N_RADII),
    ("q", geodesic::QUANTILES.len()),
    ("pc", local_pca::N_COLUMNS),
    ("pos", position::N_COLUMNS),
    ("hks", N_HEAT_TIMES),
    ("hksn", N_HEAT_TIMES),
    ("wks", N_WAVE_ENERGIES),
];

/// The number of eigenpairs that the heat and wave kernels of faces use, so that shapes with more
/// eigenpairs get comparable values.
const MAX_EIGENPAIRS: usize = 100;
const N_HEAT_TIMES: usize = 16;
const N_WAVE_ENERGIES: usize = 20;
/// Kernel values below this are noise of the truncated sum.
const MIN_KERNEL: f64 = 1e-6;
/// Thicknesses below this count as zero.
const MIN_DIAMETER: f64 = 1e-4;
/// Rounds of smoothing of the shape diameter, which rays make noisy, and of all columns at the end.
const DIAMETER_ROUNDS: usize = 3;
const ROUNDS: usize = 2;

/// Face descriptors of a shape.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FaceDescriptors {
    /// Values `(m, n)`, row-major, smoothed, not standardised; all finite.
    pub data: Vec<f32>,
    /// Columns.
    pub n: usize,
    /// The face of largest average geodesic distance: an extremity, the same in every run.
    pub farthest_start: u32,
}

/// The kernels that [`face_descriptors`] takes, for the `eigenvalues` of a proxy. They use at most
/// the first 100 eigenpairs, and so at most 100 columns of eigenvectors.
///
/// ```
/// use coseg_geometry::descriptors::face_kernels;
///
/// let eigenvalues: Vec<f64> = (0..300).map(f64::from).collect();
/// // 16 times of the heat kernel and 20 energies of the wave kernel.
/// assert_eq!(face_kernels(&eigenvalues).n_columns(), 36);
/// ```
pub fn face_kernels(eigenvalues: &[f64]) -> PointKernels {
    let k = eigenvalues.len().min(MAX_EIGENPAIRS);
    spectral::relative_kernels(&eigenvalues[..k], N_HEAT_TIMES, N_WAVE_ENERGIES)
}

/// Face descriptors `(m, 92)` of a proxy mesh of area 1 with its bridges, dual graph and the heat
/// and wave `kernels` `(n, 36)` of its vertices (see [`face_kernels`]): the columns of all
/// [`GROUPS`].
///
/// Independent of rotation, reflection, translation and numbering up to rounding, with these
/// exceptions: where principal axes are not unique (a sphere) `pos` depends on the coordinates, and
/// the geodesic samples of a symmetric shape on the order of its vertices. About 50 ms for 2,500
/// faces, half of it for rays.
///
/// ```
/// use coseg_geometry::descriptors::{GROUPS, face_descriptors, face_kernels};
/// use coseg_geometry::mesh::{DualGraph, icosphere};
/// use coseg_geometry::{SpectralMesh, operators::Operator, spectrum::Options};
///
/// let sphere = SpectralMesh::new(icosphere(3), Operator::Tufted, 40, &Options::default())?;
/// let (mesh, bridges) = (&sphere.mesh, &sphere.bridges);
/// let kernels = face_kernels(&sphere.spectrum.eigenvalues);
/// let kernels = kernels.of_matrix(&sphere.spectrum.eigenvectors);
/// let found = face_descriptors(mesh, bridges, &DualGraph::new(mesh, bridges), &kernels);
/// let width: usize = GROUPS.iter().map(|(_, width)| width).sum();
/// assert_eq!(found.n, width);
/// assert_eq!(found.data.len(), mesh.faces.len() * found.n);
/// // A sphere is as thick everywhere: column 0 is the logarithm of the shape diameter.
/// let thickness = |f: usize| found.data[f * found.n];
/// assert!((0..mesh.faces.len()).all(|f| (thickness(f) - thickness(0)).abs() < 0.1));
/// # Ok::<_, coseg_geometry::SpectralMeshError>(())
/// ```
pub fn face_descriptors(
    mesh: &TriMesh,
    bridges: &[Bridge],
    dual: &DualGraph,
    kernels: &[f64],
) -> FaceDescriptors {
    let m = mesh.faces.len();
    let n = GROUPS.iter().map(|g| g.1).sum();
    let geometry = FaceGeometry::new(mesh);
    let areas = &geometry.areas;
    let mut columns = Columns {
        data: vec![0.0; m * n],
        n,
        next: 0,
    };

    let mut diameter = shape_diameter(mesh, &geometry);
    smooth(dual, &mut diameter, 1, DIAMETER_ROUNDS);
    let logs: Vec<f64> = diameter.iter().map(|d| d.max(MIN_DIAMETER).ln()).collect();
    let ranks = area_ranks(&logs, areas);
    columns.push(2, |f, row| row.copy_from_slice(&[logs[f], 2.0 * ranks[f]]));

    let profile = geodesic_profile(mesh, bridges, &geometry);
    let agd = to_faces(mesh, &profile.average, 1);
    let ranks = area_ranks(&agd, areas);
    let mut sorted = agd.clone();
    sorted.sort_by(f64::total_cmp);
    let (low, high) = (quantile(&sorted, 0.01), quantile(&sorted, 0.99));
    let least = sorted.first().map_or(1.0, |x| x.max(1e-9));
    columns.push(3, |f, row| {
        let between = (agd[f] - low) / (high - low + 1e-9);
        row.copy_from_slice(&[between, 3.0 * ranks[f], agd[f] / least - 1.0]);
    });

    let within = to_faces(mesh, &profile.area_within, geodesic::N_RADII);
    columns.push_all(geodesic::N_RADII, &within);

    let n_quantiles = geodesic::QUANTILES.len();
    let quantiles = to_faces(mesh, &profile.quantiles, n_quantiles);
    let mean = area_mean(&quantiles, n_quantiles, areas)[n_quantiles - 1].max(1e-9);
    columns.push(n_quantiles, |f, row| {
        for (x, q) in row.iter_mut().zip(&quantiles[f * n_quantiles..]) {
            *x = q / mean;
        }
    });

    columns.push_all(local_pca::N_COLUMNS, &local_pca(&geometry));
    columns.push_all(position::N_COLUMNS, &position(&geometry));

    let width = N_HEAT_TIMES + N_WAVE_ENERGIES;
    let mut kernels = to_faces(mesh, kernels, width);
    for x in &mut kernels {
        *x = x.max(MIN_KERNEL).ln();
    }
    let means = area_mean(&kernels, width, areas);
    columns.push(N_HEAT_TIMES, |f, row| {
        row.copy_from_slice(&kernels[f * width..f * width + N_HEAT_TIMES]);
    });
    columns.push(N_HEAT_TIMES, |f, row| {
        for (j, x) in row.iter_mut().enumerate() {
            *x = kernels[f * width + j] - means[j];
        }
    });
    columns.push(N_WAVE_ENERGIES, |f, row| {
        row.copy_from_slice(&kernels[f * width + N_HEAT_TIMES..(f + 1) * width]);
    });

    let mut data = columns.data;
    smooth(dual, &mut data, n, ROUNDS);
    let farthest = (0..m).fold(0, |a, b| if agd[b] > agd[a] { b } else { a });
    FaceDescriptors {
        data: data.iter().map(|&x| x as f32).collect(),
        n,
        farthest_start: farthest as u32,
    }
}

/// A row-major matrix that is filled group by group.
struct Columns {
    data: Vec<f64>,
    n: usize,
    next: usize,
}

impl Columns {
    /// The next `width` columns; `fill` writes those of one face.
    fn push(&mut self, width: usize, mut fill: impl FnMut(usize, &mut [f64])) {
        for (f, row) in self.data.chunks_exact_mut(self.n).enumerate() {
            fill(f, &mut row[self.next..self.next + width]);
        }
        self.next += width;
    }

    /// The next `width` columns from a row-major matrix of that width.
    fn push_all(&mut self, width: usize, values: &[f64]) {
        self.push(width, |f, row| {
            row.copy_from_slice(&values[f * width..(f + 1) * width])
        });
    }
}

/// Means over the corners of each face `(m, dim)` of values at vertices `(n, dim)`, row-major.
fn to_faces(mesh: &TriMesh, values: &[f64], dim: usize) -> Vec<f64> {
    let mut result = Vec::with_capacity(mesh.faces.len() * dim);
    for face in &mesh.faces {
        let [a, b, c] = face.map(|v| &values[v as usize * dim..(v as usize + 1) * dim]);
        result.extend(a.iter().zip(b).zip(c).map(|((a, b), c)| (a + b + c) / 3.0));
    }
    result
}

/// Area-weighted mean of each column `(dim,)` of values at faces `(m, dim)`.
fn area_mean(values: &[f64], dim: usize, areas: &[f64]) -> Vec<f64> {
    let mut mean = vec![0.0; dim];
    for (row, &area) in values.chunks_exact(dim).zip(areas) {
        for (sum, x) in mean.iter_mut().zip(row) {
            *sum += area * x;
        }
    }
    let total: f64 = areas.iter().sum();
    mean.iter().map(|sum| sum / total).collect()
}

/// Share of the area on which the value is smaller, half of the own area included; 0 to 1.
fn area_ranks(values: &[f64], areas: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by(|&a, &b| values[a].total_cmp(&values[b]).then(a.cmp(&b)));
    let total: f64 = areas.iter().sum();
    let mut ranks = vec![0.0; values.len()];
    let mut below = 0.0;
    for f in order {
        ranks[f] = (below + 0.5 * areas[f]) / total;
        below += areas[f];
    }
    ranks
}

/// Quantile of ascending values, linear between them; 0 of none.
fn quantile(sorted: &[f64], q: f64) -> f64 {
    let Some(last) = sorted.len().checked_sub(1) else {
        return 0.0;
    };
    let at = q * last as f64;
    let below = at.floor() as usize;
    let above = (below + 1).min(last);
    sorted[below] + (at - below as f64) * (sorted[above] - sorted[below])
}

/// Replaces values at faces `(m, dim)` by the mean of themselves and the mean of their neighbours,
/// `rounds` times. Bridges do not count, so components do not mix.
fn smooth(dual: &DualGraph, values: &mut [f64], dim: usize, rounds: usize) {
    let mut sum = vec![0.0; dim];
    for _ in 0..rounds {
        let before = values.to_vec();
        for f in 0..dual.n_faces() {
            sum.fill(0.0);
            let mut count = 0;
            for &(g, edge) in dual.neighbors(f) {
                if dual.edges[edge as usize].bridge {
                    continue;
                }
                let row = &before[g as usize * dim..(g as usize + 1) * dim];
                for (s, x) in sum.iter_mut().zip(row) {
                    *s += x;
                }
                count += 1;
            }
            if count > 0 {
                let share = 0.5 / f64::from(count);
                for (x, s) in values[f * dim..(f + 1) * dim].iter_mut().zip(&sum) {
                    *x = 0.5 * *x + share * s;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
