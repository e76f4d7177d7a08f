//! Where a face lies in the shape: in its principal frame, or along a known up axis.

use super::local_pca::principal;
use super::smooth;
use crate::mesh::{DualGraph, FaceGeometry, TriMesh, add, dot, norm, scale, sub, unit};
use nalgebra::Matrix3;

/// Columns of `position`.
pub(super) const N_COLUMNS: usize = 7;
/// Rounds of smoothing of the columns along the up axis, as of all face descriptors.
const ROUNDS: usize = 2;
/// Extents below this are none.
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
/// (longest first), distance to the centroid, and absolute cosines of the normal with the axes. Signs
/// are dropped because those of the axes mean nothing.
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

/// For each face of a mesh whose `up` is known: height from 0 at the lowest to 1 at the highest face,
/// distance from the vertical through the centroid over the largest one, and the cosine of normal and
/// up; smoothed like the other face descriptors. `up` need not be of length 1; a flat or pole-like
/// shape has 0 where there is no extent.
pub fn up_columns(mesh: &TriMesh, up: [f64; 3]) -> Vec<[f32; 3]> {
    let geometry = FaceGeometry::new(mesh);
    let axis = unit(up);
    let center = centroid(&geometry);
    let heights: Vec<f64> = geometry.centroids.iter().map(|&c| dot(c, axis)).collect();
    let low = heights.iter().copied().fold(f64::INFINITY, f64::min);
    let high = heights.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let radii: Vec<f64> = geometry
        .centroids
        .iter()
        .map(|&c| {
            let d = sub(c, center);
            norm(sub(d, scale(axis, dot(d, axis))))
        })
        .collect();
    let widest = radii.iter().copied().fold(0.0, f64::max);
    let share = |x: f64, of: f64| if of > MIN_EXTENT { x / of } else { 0.0 };
    let mut values: Vec<f64> = (0..mesh.faces.len())
        .flat_map(|f| {
            let height = share(heights[f] - low, high - low);
            [
                height,
                share(radii[f], widest),
                dot(geometry.normals[f], axis),
            ]
        })
        .collect();
    // Smoothing does not cross bridges, so the graph does without them.
    smooth(&DualGraph::new(mesh, &[]), &mut values, 3, ROUNDS);
    let (rows, _) = values.as_chunks::<3>();
    rows.iter().map(|row| row.map(|x| x as f32)).collect()
}

#[cfg(test)]
mod tests {
    use super::{N_COLUMNS, position, up_columns};
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
            let [h, r, n] = upright[f].map(f64::from);
            assert!(
                (h - 0.5 * (c[0] / half_length + 1.0)).abs() < 0.05,
                "{h} at {c:?}"
            );
            assert!((0.0..=1.0).contains(&r) && n.abs() <= 1.0 + 1e-6);
            let [h2, r2, n2] = upside_down[f].map(f64::from);
            assert!((h + h2 - 1.0).abs() < 1e-5 && (r - r2).abs() < 1e-5 && (n + n2).abs() < 1e-5);
        }
    }

    #[test]
    fn without_extent_there_is_no_height() {
        let sheet = clean(&zoo::parsed(&zoo::grid(4, 4))).unwrap().mesh;
        for [h, _, n] in up_columns(&sheet, [0.0, 0.0, 1.0]) {
            assert_eq!((h, n), (0.0, 1.0));
        }
    }
}
