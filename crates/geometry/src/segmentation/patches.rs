//! Divides a surface into about eighty patches that are equally spread and end at creases.
//!
//! Farthest-point seeds on the dual graph, where crossing a crease costs extra, then two Lloyd
//! steps. Patches are the unit in which parts are found: their boundaries contain those of the
//! parts.

use crate::mesh::geodesic::Distances;
use crate::mesh::{DualEdge, DualGraph, FaceGeometry, TriMesh, add, distance, scale};

/// Cost of crossing an edge for each radian of its angle, in lengths, where it is concave; people
/// see parts end in concave creases (Hoffman and Richards 1984, *Parts of recognition*).
const CREASE: f64 = 4.0;
/// The weight of a convex angle relative to a concave one.
const CONVEX: f64 = 0.15;
/// Crossing a bridge costs 1 + 3 × its length, more than any path within a component.
const BRIDGE: f64 = 1.0;
const BRIDGE_FACTOR: f64 = 3.0;
/// Keeps the cost of crossing an edge positive.
const MIN_LENGTH: f64 = 1e-6;
/// Steps in which each seed moves to the middle of its patch.
const LLOYD_STEPS: usize = 2;

fn cost(edge: &DualEdge) -> f64 {
    if edge.bridge {
        return BRIDGE + BRIDGE_FACTOR * edge.distance;
    }
    let weight = if edge.convex { CONVEX } else { 1.0 };
    (edge.distance + MIN_LENGTH) * (1.0 + CREASE * weight * edge.angle)
}

/// Patch of each face `(m,)` of a mesh of area 1: at most `n_patches` (at least 1), numbered
/// without gaps by first face; fewer when there are fewer faces, and empty without faces.
///
/// The first seed is the face farthest from `start`, which is best an extremity
/// ([`FaceDescriptors::farthest_start`](crate::descriptors::FaceDescriptors::farthest_start)).
/// Bridges are crossed last, and components no bridge reaches get patches of their own, beyond
/// `n_patches` if need be. O(m log m), a little more than one search.
///
/// ```
/// use coseg_geometry::mesh::{DualGraph, icosphere};
/// use coseg_geometry::segmentation::patches;
///
/// let sphere = icosphere(3);
/// let found = patches(&sphere, &DualGraph::new(&sphere, &[]), 0, 20);
/// assert_eq!((found.len(), found[0]), (sphere.faces.len(), 0));
/// assert_eq!(found.iter().max(), Some(&19));
/// ```
pub fn patches(mesh: &TriMesh, dual: &DualGraph, start: u32, n_patches: usize) -> Vec<u32> {
    let m = mesh.faces.len();
    if m == 0 {
        return Vec::new();
    }
    let costs: Vec<f64> = dual.edges.iter().map(cost).collect();
    let geometry = FaceGeometry::new(mesh);
    let neighbors = |f: u32| {
        dual.neighbors(f as usize)
            .iter()
            .map(|&(g, edge)| (g, costs[edge as usize]))
    };
    let farthest = |distances: &Distances| {
        let d = &distances.values;
        (0..m).fold(0, |a, b| if d[b] > d[a] { b } else { a }) as u32
    };

    let mut distances = Distances::default();
    distances.reset(m);
    distances.spread(start, neighbors, |_| {});
    let mut seeds = vec![farthest(&distances)];
    let mut owner = vec![0_u32; m];
    distances.reset(m);
    loop {
        let patch = seeds.len() as u32 - 1;
        distances.spread(seeds[patch as usize], neighbors, |f| {
            owner[f as usize] = patch
        });
        let next = farthest(&distances);
        let reached = distances.values[next as usize].is_finite();
        // If the farthest face is already a seed, all faces are seeds.
        if distances.values[next as usize] <= 0.0 || (reached && seeds.len() >= n_patches.max(1)) {
            break;
        }
        seeds.push(next);
    }
    for _ in 0..LLOYD_STEPS {
        let middles = middles(&geometry, &owner, seeds.len());
        for (seed, middle) in seeds.iter_mut().zip(middles) {
            *seed = middle.unwrap_or(*seed);
        }
        distances.reset(m);
        for (patch, &seed) in (0..).zip(&seeds) {
            distances.spread(seed, neighbors, |f| owner[f as usize] = patch);
        }
    }
    without_gaps(&owner, seeds.len())
}

/// The face of each patch nearest to the patch's centroid; `None` for an empty patch.
fn middles(geometry: &FaceGeometry, owner: &[u32], n_patches: usize) -> Vec<Option<u32>> {
    let mut sums = vec![([0.0; 3], 0.0); n_patches];
    for (f, &patch) in owner.iter().enumerate() {
        let (sum, area) = &mut sums[patch as usize];
        *sum = add(*sum, scale(geometry.centroids[f], geometry.areas[f]));
        *area += geometry.areas[f];
    }
    let mut best: Vec<(f64, Option<u32>)> = vec![(f64::INFINITY, None); n_patches];
    for (f, &patch) in (0..).zip(owner) {
        let (sum, area) = sums[patch as usize];
        let d = distance(geometry.centroids[f as usize], scale(sum, 1.0 / area));
        if d < best[patch as usize].0 {
            best[patch as usize] = (d, Some(f));
        }
    }
    best.into_iter().map(|(_, face)| face).collect()
}

/// The same patches, numbered without gaps by first face.
fn without_gaps(owner: &[u32], n_patches: usize) -> Vec<u32> {
    let mut number = vec![u32::MAX; n_patches];
    let mut next = 0;
    owner
        .iter()
        .map(|&patch| {
            let slot = &mut number[patch as usize];
            if *slot == u32::MAX {
                *slot = next;
                next += 1;
            }
            *slot
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::patches;
    use crate::mesh::{DualGraph, FaceGeometry, TriMesh, bridges, clean, zoo};

    fn of(mesh: &TriMesh, n: usize) -> Vec<u32> {
        patches(mesh, &DualGraph::new(mesh, &bridges(mesh)), 0, n)
    }

    fn areas(mesh: &TriMesh, patch: &[u32]) -> Vec<f64> {
        let mut sums = vec![0.0; *patch.iter().max().unwrap() as usize + 1];
        for (&p, a) in patch.iter().zip(FaceGeometry::new(mesh).areas) {
            sums[p as usize] += a;
        }
        sums
    }

    #[test]
    fn a_sphere_is_divided_evenly() {
        let mesh = clean(&zoo::parsed(&zoo::sphere(4))).unwrap().mesh;
        let sums = areas(&mesh, &of(&mesh, 80));
        assert_eq!(sums.len(), 80);
        assert!(
            sums.iter().all(|&a| a > 0.2 / 80.0 && a < 2.5 / 80.0),
            "{sums:?}"
        );
    }

    #[test]
    fn patches_do_not_reach_over_a_concave_crease() {
        // A valley of two sheets, finely divided.
        let mut mesh = zoo::grid(40, 20);
        for p in &mut mesh.vertices {
            p[2] = 2.0 * (p[0] - 20.0).abs();
        }
        let mesh = clean(&zoo::parsed(&mesh)).unwrap().mesh;
        let g = FaceGeometry::new(&mesh);
        let patch = of(&mesh, 20);
        let n = areas(&mesh, &patch).len();
        let mut sides = vec![[0.0; 2]; n];
        for f in 0..patch.len() {
            sides[patch[f] as usize][usize::from(g.centroids[f][0] > 0.0)] += g.areas[f];
        }
        let astray: f64 = sides.iter().map(|s| s[0].min(s[1])).sum();
        assert!(astray < 0.02, "{astray}");
    }

    #[test]
    fn on_the_zoo_patches_are_numbered_without_gaps_and_stay_in_their_component() {
        for (name, mesh) in zoo::clean_meshes() {
            for n in [1, 7, 80, 100_000] {
                let patch = of(&mesh, n);
                let sums = areas(&mesh, &patch);
                assert!(sums.len() <= n.min(mesh.faces.len()), "{name}");
                assert!(sums.iter().all(|&a| a > 0.0), "{name}");
                assert_eq!(patch[0], 0, "{name}");
                assert_eq!(patch, of(&mesh, n));
            }
        }
    }

    #[test]
    fn components_without_bridges_get_patches_of_their_own() {
        let two = zoo::union(&[zoo::sphere(1), zoo::moved(&zoo::sphere(1), [3.0, 0.0, 0.0])]);
        let mesh = clean(&zoo::parsed(&two)).unwrap().mesh;
        let patch = patches(&mesh, &DualGraph::new(&mesh, &[]), 0, 1);
        assert_ne!(patch[0], patch[100]);
        assert_eq!(areas(&mesh, &patch).len(), 2);
    }
}
