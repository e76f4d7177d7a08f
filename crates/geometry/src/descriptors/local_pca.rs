//! Describes the surface within three radii of a face by its principal components: it resembles a
//! rod, a sheet or a lump.

use crate::mesh::{FaceGeometry, dot};
use nalgebra::Matrix3;
use pulp::{Arch, Simd, WithSimd};

/// Radii of the neighbourhoods, for a mesh of area 1; ascending.
const RADII: [f64; 3] = [0.05, 0.1, 0.2];
/// Columns for each radius.
const WIDTH: usize = 5;
/// Columns in all.
pub(super) const N_COLUMNS: usize = WIDTH * RADII.len();
/// Edge of the grid cells, each of which holds about five faces of a proxy. Most cells lie entirely
/// inside or entirely outside a ball and are counted as a whole.
const CELL: f64 = 0.05;
/// Variances below this are rounding.
const MIN_VARIANCE: f64 = 1e-12;

/// Moments of area about the origin: the area, the sums of the coordinates, and the sums of their
/// products xx, yy, zz, xy, yz, zx.
type Moments = [f64; 10];

fn moments(p: [f64; 3], area: f64) -> Moments {
    let [x, y, z] = p.map(|x| x * area);
    let [a, b, c] = p;
    [area, x, y, z, x * a, y * b, z * c, x * b, y * c, z * a]
}

#[inline(always)]
fn add(sum: &mut Moments, other: &Moments) {
    for (a, b) in sum.iter_mut().zip(other) {
        *a += b;
    }
}

/// Covariance of the area about its centroid. Products of coordinates up to 1 leave 1e-16 of
/// rounding, far below [`MIN_VARIANCE`].
fn covariance(sum: &Moments) -> Matrix3<f64> {
    let mean: [f64; 3] = std::array::from_fn(|i| sum[1 + i] / sum[0]);
    let c: [f64; 6] = std::array::from_fn(|i| {
        let (a, b) = if i < 3 { (i, i) } else { (i - 3, (i - 2) % 3) };
        sum[4 + i] / sum[0] - mean[a] * mean[b]
    });
    Matrix3::new(c[0], c[3], c[5], c[3], c[1], c[4], c[5], c[4], c[2])
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

/// Local principal components `(m, 15)`, row-major, of a mesh of area 1. For each of the radii
/// 0.05, 0.1 and 0.2, over the faces whose centroids are within it, with e₁ ≥ e₂ ≥ e₃ the
/// variances: `(e₁ − e₂)/e₁` (linear), `(e₂ − e₃)/e₁` (planar), `e₃/e₁` (scattered), area over that
/// of the disc, and |normal · axis of e₁|. O(m × faces in a ball).
///
/// ```
/// use coseg_geometry::descriptors::local_pca;
/// use coseg_geometry::mesh::{FaceGeometry, icosphere};
///
/// let mut sphere = icosphere(3);
/// let radius = 0.5 / std::f64::consts::PI.sqrt(); // of a sphere of area 1
/// sphere.vertices.iter_mut().flatten().for_each(|x| *x *= radius);
/// for row in local_pca(&FaceGeometry::new(&sphere)).chunks_exact(15) {
///     let [linear, planar, scattered] = [row[5], row[6], row[7]]; // within 0.1
///     assert!((linear + planar + scattered - 1.0).abs() < 1e-9);
///     assert!(planar > scattered); // a small piece of a sphere is nearly flat
/// }
/// ```
pub fn local_pca(geometry: &FaceGeometry) -> Vec<f64> {
    let mut result = vec![0.0; geometry.areas.len() * N_COLUMNS];
    let cells = Cells::new(geometry);
    Arch::new().dispatch(Balls {
        geometry,
        cells: &cells,
        result: &mut result,
    });
    result
}

/// Faces, sorted into the grid cells of their centroids.
struct Cells {
    cells: Vec<Cell>,
    /// The faces of the first cell, then of the second, …; `points` and `moments` alike.
    faces: Vec<u32>,
    points: Vec<[f64; 3]>,
    moments: Vec<Moments>,
}

struct Cell {
    /// Index along the first axis; cells ascend by it.
    index: i64,
    first: usize,
    end: usize,
    /// The bounding box of its centroids.
    low: [f64; 3],
    high: [f64; 3],
    sum: Moments,
}

impl Cells {
    fn new(geometry: &FaceGeometry) -> Self {
        let mut order: Vec<([i64; 3], u32)> = (0_u32..)
            .zip(&geometry.centroids)
            .map(|(f, c)| (c.map(|x| (x / CELL).floor() as i64), f))
            .collect();
        order.sort_unstable();
        let faces: Vec<u32> = order.iter().map(|o| o.1).collect();
        let points: Vec<[f64; 3]> = faces
            .iter()
            .map(|&f| geometry.centroids[f as usize])
            .collect();
        let moments: Vec<Moments> = faces
            .iter()
            .map(|&f| moments(geometry.centroids[f as usize], geometry.areas[f as usize]))
            .collect();
        let mut cells = Vec::new();
        let mut first = 0;
        for chunk in order.chunk_by(|a, b| a.0 == b.0) {
            let end = first + chunk.len();
            let mut cell = Cell {
                index: chunk[0].0[0],
                first,
                end,
                low: points[first],
                high: points[first],
                sum: [0.0; 10],
            };
            for (p, m) in points[first..end].iter().zip(&moments[first..end]) {
                cell.low = std::array::from_fn(|i| cell.low[i].min(p[i]));
                cell.high = std::array::from_fn(|i| cell.high[i].max(p[i]));
                add(&mut cell.sum, m);
            }
            cells.push(cell);
            first = end;
        }
        Self {
            cells,
            faces,
            points,
            moments,
        }
    }
}

struct Balls<'a> {
    geometry: &'a FaceGeometry,
    cells: &'a Cells,
    result: &'a mut [f64],
}

impl WithSimd for Balls<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self {
            geometry,
            cells,
            result,
        } = self;
        let reach = (RADII[RADII.len() - 1] / CELL).ceil() as i64;
        for home in &cells.cells {
            // Cells inside the balls about all faces of this cell, and cells that may be partly
            // inside.
            let mut inside = [[0.0; 10]; RADII.len()];
            let mut crossed: [Vec<(usize, usize)>; RADII.len()] = Default::default();
            let from = cells
                .cells
                .partition_point(|c| c.index < home.index - reach);
            let to = cells
                .cells
                .partition_point(|c| c.index <= home.index + reach);
            for cell in &cells.cells[from..to] {
                let (least, most) = distances(home, cell);
                for (i, radius) in RADII.iter().enumerate() {
                    if most <= radius * radius {
                        add(&mut inside[i], &cell.sum);
                    } else if least <= radius * radius {
                        crossed[i].push((cell.first, cell.end));
                    }
                }
            }
            for at in home.first..home.end {
                let center = cells.points[at];
                let f = cells.faces[at] as usize;
                let row = &mut result[f * N_COLUMNS..(f + 1) * N_COLUMNS];
                for (i, columns) in row.chunks_exact_mut(WIDTH).enumerate() {
                    let square = RADII[i] * RADII[i];
                    let mut ball = inside[i];
                    for &(first, end) in &crossed[i] {
                        let members = cells.points[first..end].iter();
                        for (p, moments) in members.zip(&cells.moments[first..end]) {
                            let d = [p[0] - center[0], p[1] - center[1], p[2] - center[2]];
                            // The outcome of this comparison is unpredictable, so multiplying is
                            // faster than branching.
                            let within = d[0] * d[0] + d[1] * d[1] + d[2] * d[2] <= square;
                            let weight = f64::from(u8::from(within));
                            for (a, b) in ball.iter_mut().zip(moments) {
                                *a += weight * b;
                            }
                        }
                    }
                    describe(&ball, RADII[i], geometry.normals[f], columns);
                }
            }
        }
    }
}

/// Squares of the least and the largest distance between points of the bounding boxes of two cells.
#[inline(always)]
fn distances(a: &Cell, b: &Cell) -> (f64, f64) {
    let (mut least, mut most) = (0.0, 0.0);
    for i in 0..3 {
        let (up, down) = (b.high[i] - a.low[i], a.high[i] - b.low[i]);
        let (gap, span) = ((-up).max(-down).max(0.0), up.max(down));
        least += gap * gap;
        most += span * span;
    }
    (least, most)
}

fn describe(ball: &Moments, radius: f64, normal: [f64; 3], columns: &mut [f64]) {
    let (e, axes) = principal(covariance(ball));
    // A ball with a single face has no axis.
    let axis = if e[0] > MIN_VARIANCE {
        axes[0]
    } else {
        [0.0; 3]
    };
    columns.copy_from_slice(&[
        (e[0] - e[1]) / e[0],
        (e[1] - e[2]) / e[0],
        e[2] / e[0],
        ball[0] / (std::f64::consts::PI * radius * radius),
        dot(normal, axis).abs(),
    ]);
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
