//! Computes the position of each face in the shape: in its principal frame, or along a known up
//! axis.

use super::local_pca::principal;
use super::smooth;
use crate::mesh::{DualGraph, FaceGeometry, TriMesh, add, dot, norm, scale, sub, unit};
use nalgebra::Matrix3;

/// Columns of `position`.
pub(super) const N_COLUMNS: usize = 7;
/// Columns of [`up_columns`].
pub const N_UP_COLUMNS: usize = 5;
/// Layers in which the area along the up axis is counted.
const N_LAYERS: usize = 256;
/// Rounds of smoothing of the columns along the up axis; all face descriptors have as many.
const ROUNDS: usize = 2;
/// Extents below this count as zero.
const MIN_EXTENT: f64 = 1e-9;

fn centroid(geometry: &FaceGeometry) -> [f64; 3] {
    let total: f64 = geometry.areas.iter().sum();
    let weighted = geometry.centroids.iter().zip(&geometry.areas);
    scale(
        weighted.fold([0.0; 3], |sum, (&c, &a)| add(sum, scale(c, a))),
        1.0 / total,
    )
}

/// Position of each face `(m, 7)`, row-major: absolute coordinates along the three principal axes
/// (longest first), distance to the centroid, and absolute cosines of the normal with the axes.
/// Signs are dropped because those of the axes mean nothing. Lengths are in units of the mesh.
///
/// ```
/// use coseg_geometry::descriptors::position;
/// use coseg_geometry::mesh::{FaceGeometry, icosphere};
///
/// let mut egg = icosphere(2);
/// egg.vertices.iter_mut().for_each(|[_, y, _]| *y *= 2.0);
/// let geometry = FaceGeometry::new(&egg);
/// for (row, centroid) in position(&geometry).chunks_exact(7).zip(&geometry.centroids) {
///     assert!((row[0] - centroid[1].abs()).abs() < 1e-6); // the longest axis is y
/// }
/// ```
pub fn position(geometry: &FaceGeometry) -> Vec<f64> {
    let center = centroid(geometry);
    let mut covariance = Matrix3::zeros();
    for (&c, &area) in geometry.centroids.iter().zip(&geometry.areas) {
        let d = nalgebra::Vector3::from(sub(c, center));
        covariance += area * d * d.transpose();
    }
    let (_, axes) = principal(covariance);
    let mut result = Vec::with_capacity(geometry.areas.len() * N_COLUMNS);
    for (&c, &normal) in geometry.centroids.iter().zip(&geometry.normals) {
        let d = sub(c, center);
        result.extend(axes.map(|axis| dot(axis, d).abs()));
        result.push(norm(d));
        result.extend(axes.map(|axis| dot(axis, normal).abs()));
    }
    result
}

/// For each face of a mesh whose `up` is known: height from 0 at the lowest to 1 at the highest
/// face, distance from the vertical through the centroid over the largest one, the cosine of normal
/// and up, its absolute value (a plate has the same above and below), and the share of the area
/// that is lower (a seat is the middle of a chair, however long the legs). The columns are smoothed
/// like the other face descriptors. `up` need not have length 1. A column is 0 where the shape has
/// no extent, as in a flat or pole-like shape.
///
/// ```
/// use coseg_geometry::descriptors::up_columns;
/// use coseg_geometry::mesh::{FaceGeometry, icosphere};
///
/// let sphere = icosphere(3);
/// let centroids = FaceGeometry::new(&sphere).centroids;
/// for (row, [_, _, z]) in up_columns(&sphere, [0.0, 0.0, 5.0]).iter().zip(&centroids) {
///     // On a sphere the normal is the position; a zone has the area of its height (Archimedes).
///     assert!((f64::from(row[2]) - z).abs() < 0.05);
///     assert!((row[0] - row[4]).abs() < 0.05);
/// }
/// ```
pub fn up_columns(mesh: &TriMesh, up: [f64; 3]) -> Vec<[f32; N_UP_COLUMNS]> {
    let geometry = FaceGeometry::new(mesh);
    let axis = unit(up);
    let center = centroid(&geometry);
    let share = |x: f64, of: f64| if of > MIN_EXTENT { x / of } else { 0.0 };
    let along: Vec<f64> = geometry.centroids.iter().map(|&c| dot(c, axis)).collect();
    let low = along.iter().copied().fold(f64::INFINITY, f64::min);
    let high = along.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let heights: Vec<f64> = along.iter().map(|x| share(x - low, high - low)).collect();
    let radii: Vec<f64> = geometry
        .centroids
        .iter()
        .map(|&c| {
            let d = sub(c, center);
            norm(sub(d, scale(axis, dot(d, axis))))
        })
        .collect();
    let widest = radii.iter().copied().fold(0.0, f64::max);
    let lower = lower_area(&heights, &geometry.areas);
    let mut values: Vec<f64> = (0..mesh.faces.len())
        .flat_map(|f| {
            let slope = dot(geometry.normals[f], axis);
            let radius = share(radii[f], widest);
            [heights[f], radius, slope, slope.abs(), lower[f]]
        })
        .collect();
    // Smoothing does not cross bridges, so this graph omits them.
    smooth(
        &DualGraph::new(mesh, &[]),
        &mut values,
        N_UP_COLUMNS,
        ROUNDS,
    );
    let (rows, _) = values.as_chunks::<N_UP_COLUMNS>();
    rows.iter().map(|row| row.map(|x| x as f32)).collect()
}

/// Share of the area below each of `heights` (0 to 1), interpolated linearly within each layer.
/// Faces of equal height have equal values, however many there are.
fn lower_area(heights: &[f64], areas: &[f64]) -> Vec<f64> {
    let mut layers = [0.0; N_LAYERS];
    let layer = |h: f64| ((h * N_LAYERS as f64) as usize).min(N_LAYERS - 1);
    for (&h, &area) in heights.iter().zip(areas) {
        layers[layer(h)] += area;
    }
    let total: f64 = areas.iter().sum();
    let mut below = [0.0; N_LAYERS];
    for i in 1..N_LAYERS {
        below[i] = below[i - 1] + layers[i - 1];
    }
    let at = |h: f64| {
        let i = layer(h);
        (below[i] + layers[i] * (h * N_LAYERS as f64 - i as f64)) / total
    };
    heights.iter().map(|&h| at(h)).collect()
}

#[cfg(test)]
mod tests {
    use super::{N_COLUMNS, lower_area, position, up_columns};
    use crate::mesh::{FaceGeometry, TriMesh, clean, norm, zoo};

    fn dumbbell() -> TriMesh {
        clean(&zoo::parsed(&zoo::dumbbell(14))).unwrap().mesh
    }

    #[test]
    fn along_the_longest_axis_both_ends_are_far() {
        let mesh = dumbbell();
        let g = FaceGeometry::new(&mesh);
        for (row, c) in position(&g).chunks(N_COLUMNS).zip(&g.centroids) {
            assert!((row[0] - c[0].abs()).abs() < 1e-3, "{row:?} {c:?}");
            assert!((row[3] - norm(*c)).abs() < 1e-9);
            assert!((row[4..].iter().map(|x| x * x).sum::<f64>() - 1.0).abs() < 1e-9);
        }
    }

    #[test]
    fn height_radius_and_slope_are_what_they_say() {
        let mesh = dumbbell();
        let g = FaceGeometry::new(&mesh);
        let upright = up_columns(&mesh, [5.0, 0.0, 0.0]);
        let upside_down = up_columns(&mesh, [-1.0, 0.0, 0.0]);
        let half_length = g.centroids.iter().map(|c| c[0]).fold(0.0, f64::max);
        for (f, c) in g.centroids.iter().enumerate() {
            let [h, r, n, steep, lower] = upright[f].map(f64::from);
            assert!(
                (h - 0.5 * (c[0] / half_length + 1.0)).abs() < 0.05,
                "{h} at {c:?}"
            );
            assert!((0.0..=1.0).contains(&r) && n.abs() <= 1.0 + 1e-6);
            let [h2, r2, n2, steep2, lower2] = upside_down[f].map(f64::from);
            assert!((h + h2 - 1.0).abs() < 1e-5 && (r - r2).abs() < 1e-5 && (n + n2).abs() < 1e-5);
            assert!(
                (steep - steep2).abs() < 1e-5 && steep >= n.abs() - 1e-5 && steep <= 1.0 + 1e-6
            );
            assert!((lower + lower2 - 1.0).abs() < 0.02, "{lower} and {lower2}");
        }
    }

    #[test]
    fn without_extent_there_is_no_height() {
        let sheet = clean(&zoo::parsed(&zoo::grid(4, 4))).unwrap().mesh;
        for [h, _, n, steep, _] in up_columns(&sheet, [0.0, 0.0, 1.0]) {
            assert_eq!((h, n, steep), (0.0, 1.0, 1.0));
        }
    }

    #[test]
    fn lower_area_depends_on_the_height_alone() {
        // A tenth at the bottom, a plate of six tenths halfway up, the rest at the top.
        let heights = [0.0, 0.5, 0.5, 0.5, 1.0];
        let areas = [0.1, 0.2, 0.2, 0.2, 0.3];
        let lower = lower_area(&heights, &areas);
        assert_eq!(lower[1], lower[3]);
        for (found, right) in lower.iter().zip([0.0, 0.1, 0.1, 0.1, 1.0]) {
            assert!((found - right).abs() < 1e-12, "{lower:?}");
        }
    }
}
