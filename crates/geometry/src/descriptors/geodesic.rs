//! Computes distances along the surface to sixty spread samples; they tell central points from
//! extremities.
//!
//! Average geodesic distance after Hilaga, Shinagawa, Kohmura and Kunii 2001, *Topology Matching
//! for Fully Automatic Similarity Estimation of 3D Shapes*, with farthest-point samples.

use super::quantile;
use crate::mesh::geodesic::Distances;
use crate::mesh::{Bridge, EdgeGraph, FaceGeometry, TriMesh, add, distance, scale};

/// Farthest-point samples; the first only finds an extremity to begin from.
const N_SAMPLES: usize = 60;
/// Radii of the geodesic balls: eighths of 1.5 times the median eccentricity.
pub(super) const N_RADII: usize = 7;
const LARGEST_RADIUS: f64 = 1.5;
/// Quantiles of the distances to the samples.
pub(super) const QUANTILES: [f64; 6] = [0.1, 0.25, 0.5, 0.75, 0.9, 1.0];

/// Geodesic distances from each vertex to the rest of the surface.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct GeodesicProfile {
    /// Area-weighted mean distance `(n,)`.
    pub average: Vec<f64>,
    /// Share of the area within seven radii `(n, 7)`, row-major.
    pub area_within: Vec<f64>,
    /// Quantiles .1 .25 .5 .75 .9 1 of the distances to the samples `(n, 6)`, row-major.
    pub quantiles: Vec<f64>,
}

/// The profile of a mesh, connected by its bridges: sixty shortest-path searches, O(n log n) each.
/// Distances are in units of the mesh.
///
/// ```
/// use coseg_geometry::descriptors::geodesic_profile;
/// use coseg_geometry::mesh::{FaceGeometry, icosphere};
///
/// let sphere = icosphere(3);
/// let profile = geodesic_profile(&sphere, &[], &FaceGeometry::new(&sphere));
/// // The mean distance on the unit sphere is π / 2; paths along edges are somewhat longer.
/// let quarter = std::f64::consts::FRAC_PI_2;
/// assert!(profile.average.iter().all(|d| (0.95 * quarter..1.2 * quarter).contains(d)));
/// // A larger ball has a larger share of the area.
/// assert!(profile.area_within.chunks_exact(7).all(|row| row.is_sorted()));
/// ```
pub fn geodesic_profile(
    mesh: &TriMesh,
    bridges: &[Bridge],
    geometry: &FaceGeometry,
) -> GeodesicProfile {
    let graph = EdgeGraph::new(mesh, bridges);
    let n = graph.n_vertices();
    let mut mass = vec![0.0; n];
    for (face, area) in mesh.faces.iter().zip(&geometry.areas) {
        for &v in face {
            mass[v as usize] += area / 3.0;
        }
    }
    let samples = samples(&graph, start(mesh, geometry));
    let s = samples.len() / n.max(1);

    // Each sample stands for the area nearest to it.
    let mut weights = vec![0.0; s];
    let mut farthest = Vec::with_capacity(n);
    for v in 0..n {
        let row = &samples[v * s..(v + 1) * s];
        let nearest = (0..s).fold(0, |a, b| if row[b] < row[a] { b } else { a });
        weights[nearest] += mass[v];
        farthest.push(row.iter().copied().fold(0.0, f64::max));
    }
    let total: f64 = weights.iter().sum();
    for w in &mut weights {
        *w /= total;
    }
    farthest.sort_by(f64::total_cmp);
    let scale = quantile(&farthest, 0.5).max(f64::MIN_POSITIVE);

    let mut profile = GeodesicProfile::default();
    let mut sorted = Vec::with_capacity(s);
    for row in samples.chunks_exact(s.max(1)) {
        profile
            .average
            .push(row.iter().zip(&weights).map(|(d, w)| d * w).sum());
        let mut within = [0.0; N_RADII];
        for (d, w) in row.iter().zip(&weights) {
            // The first radius, counted from 1, that reaches the sample.
            let eighth = d / scale * (N_RADII + 1) as f64 / LARGEST_RADIUS;
            for share in within.iter_mut().skip((eighth.ceil() as usize).max(1) - 1) {
                *share += w;
            }
        }
        profile.area_within.extend(within);
        sorted.clear();
        sorted.extend_from_slice(row);
        sorted.sort_unstable_by(f64::total_cmp);
        profile
            .quantiles
            .extend(QUANTILES.map(|q| quantile(&sorted, q)));
    }
    profile
}

/// The vertex farthest from the centroid: a start that does not depend on numbering.
fn start(mesh: &TriMesh, geometry: &FaceGeometry) -> u32 {
    let total: f64 = geometry.areas.iter().sum();
    let weighted = geometry.centroids.iter().zip(&geometry.areas);
    let sum = weighted.fold([0.0; 3], |sum, (&c, &a)| add(sum, scale(c, a)));
    let center = scale(sum, 1.0 / total);
    let far = |best: (f64, u32), (v, p): (u32, &[f64; 3])| {
        let d = distance(*p, center);
        if d > best.0 { (d, v) } else { best }
    };
    (0..).zip(&mesh.vertices).fold((-1.0, 0), far).1
}

/// Distances `(n, samples)`, row-major, to farthest-point samples. The start is left out unless it
/// is the only sample.
fn samples(graph: &EdgeGraph, start: u32) -> Vec<f64> {
    let n = graph.n_vertices();
    let n_samples = N_SAMPLES.min(n);
    let keep = n_samples.saturating_sub(1).max(1);
    let mut result = vec![0.0; n * keep];
    let mut nearest = vec![f64::INFINITY; n];
    let mut distances = Distances::default();
    let mut source = start;
    for i in 0..n_samples {
        graph.dijkstra_into(source, &mut distances);
        if i > 0 || n_samples == 1 {
            let column = i.saturating_sub(1);
            for (v, d) in distances.values.iter().enumerate() {
                result[v * keep + column] = *d;
            }
        }
        for (best, d) in nearest.iter_mut().zip(&distances.values) {
            *best = best.min(*d);
        }
        source = (0..n).fold(0, |a, b| if nearest[b] > nearest[a] { b } else { a }) as u32;
    }
    result
}

#[cfg(test)]
mod tests {
    use super::{N_RADII, QUANTILES, geodesic_profile};
    use crate::mesh::{FaceGeometry, TriMesh, bridges, clean, zoo};

    fn of(mesh: &TriMesh) -> (TriMesh, super::GeodesicProfile) {
        let mesh = clean(&zoo::parsed(mesh)).unwrap().mesh;
        let p = geodesic_profile(&mesh, &bridges(&mesh), &FaceGeometry::new(&mesh));
        (mesh, p)
    }

    #[test]
    fn on_a_sphere_all_points_are_alike() {
        let (_, p) = of(&zoo::sphere(4));
        let radius = (0.25 / std::f64::consts::PI).sqrt();
        // The mean over the sphere is a quarter turn; edge paths add up to a fifth.
        let quarter = std::f64::consts::FRAC_PI_2 * radius;
        for a in &p.average {
            assert!(
                *a > 0.98 * quarter && *a < 1.2 * quarter,
                "{a} against {quarter}"
            );
        }
        for q in p.quantiles.chunks(QUANTILES.len()) {
            assert!(q[5] < 1.2 * 2.0 * quarter && q[5] > 1.6 * quarter);
        }
    }

    #[test]
    fn the_middle_of_a_dumbbell_is_central_and_its_ends_are_not() {
        let (mesh, p) = of(&zoo::dumbbell(16));
        let at = |best: fn(f64, f64) -> bool| {
            (0..p.average.len()).fold(0, |a, b| {
                if best(p.average[b], p.average[a]) {
                    b
                } else {
                    a
                }
            })
        };
        assert!(mesh.vertices[at(|x, y| x < y)][0].abs() < 0.1);
        assert!(mesh.vertices[at(|x, y| x > y)][0].abs() > 0.4);
    }

    #[test]
    fn profiles_are_finite_and_monotone_on_the_zoo() {
        for (name, mesh) in zoo::clean_meshes() {
            let p = geodesic_profile(&mesh, &bridges(&mesh), &FaceGeometry::new(&mesh));
            let n = mesh.vertices.len();
            assert_eq!(p.average.len(), n, "{name}");
            assert!(
                p.average.iter().all(|a| a.is_finite() && *a >= 0.0),
                "{name}"
            );
            for row in p.area_within.chunks(N_RADII) {
                assert!(row.windows(2).all(|w| w[0] <= w[1]), "{name}: {row:?}");
                assert!(
                    row.iter().all(|x| (0.0..=1.0 + 1e-9).contains(x)),
                    "{name}: {row:?}"
                );
            }
            for row in p.quantiles.chunks(QUANTILES.len()) {
                assert!(row.windows(2).all(|w| w[0] <= w[1]), "{name}: {row:?}");
            }
        }
    }
}
