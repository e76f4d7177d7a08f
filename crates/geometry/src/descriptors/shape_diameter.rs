//! Measures the thickness of a shape at each face by rays that are cast inward.
//!
//! Shapira, Shamir and Cohen-Or 2008, *Consistent mesh partitioning and skeletonisation using the
//! shape diameter function*.

use super::quantile;
use crate::mesh::{Bvh, FaceGeometry, Search, TriMesh, add, cross, dot, scale, sub, unit};

/// Rays for each face.
const N_RAYS: usize = 30;
/// Half the opening of their cone, in degrees.
const HALF_ANGLE: f64 = 60.0;
/// Turn from one ray to the next about the axis, in radians: the golden angle spreads them evenly.
const TURN: f64 = 2.399_963;
/// Lengths farther than this many standard deviations from the median are outliers.
const OUTLIER: f64 = 1.5;
/// Softens the weight 1 / angle of rays near the axis.
const ANGLE_OFFSET: f64 = 0.2;
/// Rays begin this far below the face, so that they miss its neighbours at their common edges.
const DEPTH: f64 = 1e-4;

/// Shape diameter of each face `(m,)` of a mesh of area 1: the weighted mean length of rays within
/// 60° of the inward normal, without outliers. It has the unit of the mesh.
///
/// Rays that leave through an opening do not count. A face whose rays all miss gets the median of
/// the other faces; on a mesh where every ray misses (a sheet) all values are 0. O(m log m) with 30
/// m rays.
///
/// ```
/// use coseg_geometry::descriptors::shape_diameter;
/// use coseg_geometry::mesh::{FaceGeometry, icosphere};
///
/// let mut sphere = icosphere(3);
/// let radius = 0.5 / std::f64::consts::PI.sqrt(); // of a sphere of area 1
/// sphere.vertices.iter_mut().flatten().for_each(|x| *x *= radius);
/// let thickness = shape_diameter(&sphere, &FaceGeometry::new(&sphere));
/// // A chord is as long as the diameter, or at 60° half as long.
/// assert!(thickness.iter().all(|t| (radius..2.0 * radius).contains(t)));
/// ```
pub fn shape_diameter(mesh: &TriMesh, geometry: &FaceGeometry) -> Vec<f64> {
    let tree = Bvh::new(mesh);
    let rays = cone();
    let mut search = Search::default();
    let (mut found, mut lengths) = (Vec::new(), Vec::with_capacity(N_RAYS));
    let mut diameters: Vec<Option<f64>> = Vec::with_capacity(mesh.faces.len());
    for f in 0..mesh.faces.len() {
        let inward = scale(geometry.normals[f], -1.0);
        // The circle of rays begins at the longest edge of the face, so the rays turn with the
        // face.
        let x = unit(longest_edge(mesh.corners(f)));
        let y = cross(inward, x);
        let origin = add(geometry.centroids[f], scale(inward, DEPTH));
        let directions: [[f64; 3]; N_RAYS] = std::array::from_fn(|i| {
            let [a, b, c] = rays[i].0;
            add(add(scale(x, a), scale(y, b)), scale(inward, c))
        });
        tree.cast(&mut search, origin, &directions, f as u32, &mut found);
        let met = found.iter().zip(&rays).filter(|(x, _)| x.is_finite());
        lengths.clear();
        lengths.extend(met.map(|(length, (_, weight))| (*length, *weight)));
        diameters.push(robust_mean(&mut lengths));
    }
    let mut found: Vec<f64> = diameters.iter().flatten().copied().collect();
    found.sort_by(f64::total_cmp);
    let median = quantile(&found, 0.5);
    diameters.into_iter().map(|d| d.unwrap_or(median)).collect()
}

/// The direction of the longest edge; it does not depend on the numbering of the corners.
fn longest_edge([a, b, c]: [[f64; 3]; 3]) -> [f64; 3] {
    let edges = [sub(b, a), sub(c, b), sub(a, c)];
    edges
        .into_iter()
        .fold([0.0; 3], |x, y| if dot(y, y) > dot(x, x) { y } else { x })
}

/// Unit directions about the z axis, and their weights.
fn cone() -> [([f64; 3], f64); N_RAYS] {
    let opening = 1.0 - HALF_ANGLE.to_radians().cos();
    let mut rays: [_; N_RAYS] = std::array::from_fn(|i| {
        let share = (i as f64 + 0.5) / N_RAYS as f64;
        let angle = (1.0 - share * opening).acos();
        let turn = TURN * i as f64;
        let direction = [
            angle.sin() * turn.cos(),
            angle.sin() * turn.sin(),
            angle.cos(),
        ];
        (direction, 1.0 / (angle + ANGLE_OFFSET))
    });
    // Sorted around the axis: rays that are neighbours mostly cross the same boxes.
    rays.sort_by(|(a, _), (b, _)| a[1].atan2(a[0]).total_cmp(&b[1].atan2(b[0])));
    rays
}

/// Weighted mean of the lengths near the median; `None` for no lengths.
fn robust_mean(lengths: &mut [(f64, f64)]) -> Option<f64> {
    lengths.sort_by(|a, b| a.0.total_cmp(&b.0));
    let sorted: Vec<f64> = lengths.iter().map(|l| l.0).collect();
    let n = sorted.len() as f64;
    let median = quantile(&sorted, 0.5);
    let mean = sorted.iter().sum::<f64>() / n;
    let deviation = (sorted.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt();
    let near = lengths
        .iter()
        .filter(|(x, _)| (x - median).abs() <= OUTLIER * deviation + 1e-9);
    let (sum, weight) = near.fold((0.0, 0.0), |(s, w), &(x, v)| (s + v * x, w + v));
    (weight > 0.0).then(|| sum / weight)
}

#[cfg(test)]
mod tests {
    use super::{cone, robust_mean, shape_diameter};
    use crate::mesh::{FaceGeometry, TriMesh, clean, zoo};

    fn of(mesh: &TriMesh) -> (TriMesh, Vec<f64>) {
        let mesh = clean(&zoo::parsed(mesh)).unwrap().mesh;
        let d = shape_diameter(&mesh, &FaceGeometry::new(&mesh));
        (mesh, d)
    }

    #[test]
    fn on_a_sphere_it_is_the_mean_chord_everywhere() {
        let (_, d) = of(&zoo::sphere(4));
        let radius = (0.25 / std::f64::consts::PI).sqrt();
        // A chord at angle θ to the diameter has length 2 r cos θ.
        let mut chords: Vec<(f64, f64)> = cone()
            .iter()
            .map(|([_, _, c], weight)| (2.0 * radius * c, *weight))
            .collect();
        let chord = robust_mean(&mut chords).unwrap();
        assert!(chord > 1.4 * radius && chord < 2.0 * radius);
        for x in d {
            // The tolerance allows for the facets of the mesh.
            assert!((x / chord - 1.0).abs() < 0.02, "{x} against {chord}");
        }
    }

    #[test]
    fn thick_and_thin_are_told_apart() {
        let (mesh, d) = of(&zoo::dumbbell(16));
        let g = FaceGeometry::new(&mesh);
        let mean = |inner: bool| {
            let (s, w) = (0..d.len())
                .filter(|&f| (g.centroids[f][0].abs() < 0.15) == inner)
                .fold((0.0, 0.0), |(s, w), f| {
                    (s + d[f] * g.areas[f], w + g.areas[f])
                });
            s / w
        };
        assert!(
            mean(false) > 2.0 * mean(true),
            "{} {}",
            mean(false),
            mean(true)
        );
    }

    #[test]
    fn a_hole_does_not_matter_much_and_a_sheet_has_no_thickness() {
        let whole = zoo::sphere(3);
        let mut holed = whole.clone();
        holed.faces.truncate(holed.faces.len() - 20);
        let (mesh, d) = of(&holed);
        let radius = crate::mesh::norm(mesh.vertices[0]);
        assert!(d.iter().all(|&x| x > 1.2 * radius && x < 2.2 * radius));
        assert!(of(&zoo::grid(8, 8)).1.iter().all(|&x| x == 0.0));
    }

    #[test]
    fn stray_rays_are_dropped() {
        let mut lengths: Vec<(f64, f64)> =
            (0..20).map(|i| (1.0 + 0.01 * f64::from(i), 1.0)).collect();
        lengths.push((50.0, 1.0));
        assert!((robust_mean(&mut lengths).unwrap() - 1.095).abs() < 1e-9);
        assert_eq!(robust_mean(&mut []), None);
    }
}
