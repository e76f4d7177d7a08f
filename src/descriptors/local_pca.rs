//! The surface within three radii of a face, by its principal components: a rod, a sheet or a lump.

use crate::mesh::{FaceGeometry, dot};
use nalgebra::Matrix3;
use std::collections::BTreeMap;

/// Radii of the neighbourhoods, for a mesh of area 1; ascending.
const RADII: [f64; 3] = [0.05, 0.1, 0.2];
/// Columns for each radius.
const WIDTH: usize = 5;
/// Columns in all.
pub(super) const N_COLUMNS: usize = WIDTH * RADII.len();
/// Cells of the search grid, in largest radii: smaller ones visit fewer faces outside the ball.
const CELL: f64 = 0.5;
/// Variances below this are rounding.
const MIN_VARIANCE: f64 = 1e-12;

/// Moments of area: its sum, of the coordinates and of their products.
#[derive(Clone, Copy, Default)]
struct Moments {
    area: f64,
    first: [f64; 3],
    /// xx, yy, zz, xy, yz, zx.
    second: [f64; 6],
}

impl Moments {
    fn add(&mut self, d: [f64; 3], area: f64) {
        let w = [d[0] * area, d[1] * area, d[2] * area];
        self.area += area;
        for i in 0..3 {
            self.first[i] += w[i];
            self.second[i] += w[i] * d[i];
            self.second[i + 3] += w[i] * d[(i + 1) % 3];
        }
    }

    fn join(&mut self, other: &Self) {
        self.area += other.area;
        for (a, b) in self.first.iter_mut().zip(&other.first) {
            *a += b;
        }
        for (a, b) in self.second.iter_mut().zip(&other.second) {
            *a += b;
        }
    }

    fn covariance(&self) -> Matrix3<f64> {
        let m = self.first.map(|x| x / self.area);
        let c: [f64; 6] = std::array::from_fn(|i| {
            let (a, b) = if i < 3 { (i, i) } else { (i - 3, (i - 2) % 3) };
            self.second[i] / self.area - m[a] * m[b]
        });
        Matrix3::new(c[0], c[3], c[5], c[3], c[1], c[4], c[5], c[4], c[2])
    }
}

/// Eigenvalues of a symmetric matrix in descending order, at least 1e-12, and unit eigenvectors.
pub(super) fn principal(matrix: Matrix3<f64>) -> ([f64; 3], [[f64; 3]; 3]) {
    let eigen = matrix.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let values = order.map(|i| eigen.eigenvalues[i].max(MIN_VARIANCE));
    let vectors = order.map(|i| eigen.eigenvectors.column(i).into_owned().into());
    (values, vectors)
}

/// Local principal components `(m, 15)`, row-major. For each of the radii 0.05, 0.1 and 0.2, over the
/// faces whose centroids are within it, with e₁ ≥ e₂ ≥ e₃ the variances: `(e₁ − e₂)/e₁` (linear),
/// `(e₂ − e₃)/e₁` (planar), `e₃/e₁` (scattered), area over that of the disc, and |normal · axis of e₁|.
/// O(m × faces in a ball).
pub fn local_pca(geometry: &FaceGeometry) -> Vec<f64> {
    let largest = RADII[RADII.len() - 1];
    let cell = |p: [f64; 3]| p.map(|x| (x / (CELL * largest)).floor() as i64);
    let reach = (1.0 / CELL).ceil() as i64;
    let mut grid: BTreeMap<[i64; 3], Vec<u32>> = BTreeMap::new();
    for (f, &c) in geometry.centroids.iter().enumerate() {
        grid.entry(cell(c)).or_default().push(f as u32);
    }
    let mut result = vec![0.0; geometry.areas.len() * N_COLUMNS];
    let mut near: Vec<([f64; 3], f64)> = Vec::new();
    for (&[x, y, z], faces) in &grid {
        near.clear();
        for i in x - reach..=x + reach {
            for j in y - reach..=y + reach {
                for (_, others) in grid.range([i, j, z - reach]..=[i, j, z + reach]) {
                    near.extend(
                        others
                            .iter()
                            .map(|&g| (geometry.centroids[g as usize], geometry.areas[g as usize])),
                    );
                }
            }
        }
        for &f in faces {
            let row = &mut result[f as usize * N_COLUMNS..(f as usize + 1) * N_COLUMNS];
            describe(geometry, f as usize, &near, row);
        }
    }
    result
}

fn describe(geometry: &FaceGeometry, f: usize, near: &[([f64; 3], f64)], row: &mut [f64]) {
    let center = geometry.centroids[f];
    let mut shells = [Moments::default(); RADII.len()];
    let squares = RADII.map(|r| r * r);
    for &(p, area) in near {
        let d = [p[0] - center[0], p[1] - center[1], p[2] - center[2]];
        let square = dot(d, d);
        if square <= squares[2] {
            // Adding up comparisons is quicker than branching on them.
            let shell = usize::from(square > squares[0]) + usize::from(square > squares[1]);
            shells[shell].add(d, area);
        }
    }
    let mut ball = Moments::default();
    for ((shell, radius), columns) in shells.iter().zip(RADII).zip(row.chunks_exact_mut(WIDTH)) {
        ball.join(shell);
        let (e, axes) = principal(ball.covariance());
        // A face alone in its ball has no axis.
        let axis = if e[0] > MIN_VARIANCE {
            axes[0]
        } else {
            [0.0; 3]
        };
        columns.copy_from_slice(&[
            (e[0] - e[1]) / e[0],
            (e[1] - e[2]) / e[0],
            e[2] / e[0],
            ball.area / (std::f64::consts::PI * radius * radius),
            dot(geometry.normals[f], axis).abs(),
        ]);
    }
}

#[cfg(test)]
mod tests {
    use super::{N_COLUMNS, WIDTH, local_pca};
    use crate::mesh::{FaceGeometry, TriMesh, clean, zoo};

    fn of(mesh: &TriMesh) -> (TriMesh, Vec<f64>) {
        let mesh = clean(&zoo::parsed(mesh)).unwrap().mesh;
        let x = local_pca(&FaceGeometry::new(&mesh));
        (mesh, x)
    }

    #[test]
    fn within_a_sheet_all_is_planar_and_as_large_as_the_disc() {
        let (mesh, x) = of(&zoo::grid(60, 60));
        let g = FaceGeometry::new(&mesh);
        for (f, row) in x.chunks(N_COLUMNS).enumerate() {
            let inner = g.centroids[f].iter().all(|c| c.abs() < 0.3);
            for c in row.chunks(WIDTH).filter(|_| inner) {
                // The smallest ball holds only some fifty faces.
                assert!(c[0] < 0.15 && c[1] > 0.85 && c[2] < 1e-6, "{c:?}");
                assert!((c[3] - 1.0).abs() < 0.12, "{c:?}");
                assert!(c[4] < 1e-6, "{c:?}");
            }
        }
    }

    #[test]
    fn a_rod_is_linear_and_a_ball_is_not() {
        let mut rod = zoo::dumbbell(24);
        for p in &mut rod.vertices {
            let r = (p[1] * p[1] + p[2] * p[2]).sqrt().max(1e-9);
            let wanted = if r > 1e-6 { 0.05 } else { 0.0 };
            p[1] *= wanted / r;
            p[2] *= wanted / r;
        }
        let (mesh, x) = of(&rod);
        let g = FaceGeometry::new(&mesh);
        for (f, row) in x.chunks(N_COLUMNS).enumerate() {
            if g.centroids[f][0].abs() < 0.5 {
                assert!(row[2 * WIDTH] > 0.6, "{row:?}");
                assert!(row[2 * WIDTH + 4] < 0.2, "{row:?}");
            }
        }
        let (_, x) = of(&zoo::sphere(4));
        assert!(x.chunks(N_COLUMNS).all(|row| row[2 * WIDTH] < 0.2));
    }

    #[test]
    fn all_is_finite_and_in_range_on_the_zoo() {
        for (name, mesh) in zoo::clean_meshes() {
            for c in local_pca(&FaceGeometry::new(&mesh)).chunks(WIDTH) {
                assert!(
                    c.iter().all(|x| x.is_finite() && *x >= -1e-9),
                    "{name}: {c:?}"
                );
                assert!((c[0] + c[1] + c[2] - 1.0).abs() < 1e-9, "{name}: {c:?}");
                assert!(c[4] <= 1.0 + 1e-9, "{name}: {c:?}");
            }
        }
    }
}
