//! Merges the patches of one shape into parts, and describes each part by its faces and its
//! boundaries.

use super::{PatchGraph, Surface};
use nalgebra::{Matrix3, SymmetricEigen};
use std::cmp::Ordering;
use std::collections::{BTreeMap, BinaryHeap};

/// Crease scale of the merging cost: a boundary of this mean crease costs e times a flat one.
const CREASE_SCALE: f64 = 0.05;

struct Merge {
    cost: f64,
    pair: [u32; 2],
    versions: [u32; 2],
}

impl Ord for Merge {
    fn cmp(&self, other: &Self) -> Ordering {
        // BinaryHeap is a max-heap, so the order is reversed: the cheapest merge, then the lowest
        // pair, comes first.
        other
            .cost
            .total_cmp(&self.cost)
            .then_with(|| other.pair.cmp(&self.pair))
    }
}
impl PartialOrd for Merge {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}
impl PartialEq for Merge {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}
impl Eq for Merge {}

/// Merges adjacent patches greedily until `n` regions are left, for each `n` in `sizes`. Returns
/// the region of each patch for each `n`, with regions numbered in the order of their first patch.
///
/// The cost of a merge is Ward's (descriptor difference of `means (n_patches, dim)` weighted by
/// area), times `exp(crease / 0.05)`, over the length of the common boundary relative to the
/// smaller side. Where patches do not touch, more than `n` regions are left.
///
/// ```
/// use coseg_geometry::segmentation::{PatchGraph, merge_patches};
///
/// // Four flat patches in a row, with one descriptor each.
/// let chain = PatchGraph {
///     patch_of_face: vec![0, 1, 2, 3],
///     area: vec![0.25; 4],
///     edges: (0..3).map(|i| ([i, i + 1], 1.0, 0.0)).collect(),
/// };
/// let found = merge_patches(&chain, &[0.0, 0.2, 5.0, 5.1], 1, &[3, 2]);
/// assert_eq!(found, [[0, 1, 2, 2], [0, 0, 1, 1]]);
/// ```
pub fn merge_patches(
    graph: &PatchGraph,
    means: &[f64],
    dim: usize,
    sizes: &[usize],
) -> Vec<Vec<u32>> {
    let n = graph.len();
    let mut area = graph.area.clone();
    let mut mean: Vec<Vec<f64>> = means.chunks_exact(dim).map(<[f64]>::to_vec).collect();
    let mut around: Vec<BTreeMap<u32, (f64, f64)>> = vec![BTreeMap::new(); n];
    for &([a, b], length, crease) in &graph.edges {
        around[a as usize].insert(b, (length, length * crease));
        around[b as usize].insert(a, (length, length * crease));
    }
    let mut region: Vec<u32> = (0..n as u32).collect();
    let mut version = vec![0u32; n];
    let cost =
        |area: &[f64], mean: &[Vec<f64>], i: usize, j: usize, (length, weighted): (f64, f64)| {
            let difference: f64 = mean[i]
                .iter()
                .zip(&mean[j])
                .map(|(a, b)| (a - b) * (a - b))
                .sum();
            let ward = area[i] * area[j] / (area[i] + area[j]).max(1e-300) * difference;
            let relative_length = length / area[i].min(area[j]).sqrt().max(1e-12);
            ward * (weighted / length.max(1e-300) / CREASE_SCALE).exp() / relative_length.max(1e-12)
        };
    let mut heap = BinaryHeap::new();
    for (i, neighbours) in around.iter().enumerate() {
        for (&j, &boundary) in neighbours.range(i as u32 + 1..) {
            let pair = [i as u32, j];
            heap.push(Merge {
                cost: cost(&area, &mean, i, j as usize, boundary),
                pair,
                versions: [0, 0],
            });
        }
    }
    let mut alive = n;
    let mut snapshots = BTreeMap::new();
    let least = sizes.iter().copied().min().unwrap_or(0);
    let mut dead = vec![false; n];
    loop {
        snapshots.insert(alive, numbered(&region));
        if alive <= least {
            break;
        }
        let Some(merge) = heap.pop() else { break };
        let [i, j] = merge.pair.map(|p| p as usize);
        if dead[i] || dead[j] || merge.versions != [version[i], version[j]] {
            continue;
        }
        let sum = area[i] + area[j];
        let merged = std::mem::take(&mut mean[j]);
        for (m, other) in mean[i].iter_mut().zip(&merged) {
            *m = (area[i] * *m + area[j] * other) / sum.max(1e-300);
        }
        area[i] = sum;
        version[i] += 1;
        dead[j] = true;
        alive -= 1;
        region
            .iter_mut()
            .filter(|r| **r == j as u32)
            .for_each(|r| *r = i as u32);
        around[i].remove(&(j as u32));
        for (q, (length, weighted)) in std::mem::take(&mut around[j]) {
            around[q as usize].remove(&(j as u32));
            if q as usize == i {
                continue;
            }
            let joined = around[i].entry(q).or_default();
            joined.0 += length;
            joined.1 += weighted;
            let joined = *joined;
            around[q as usize].insert(i as u32, joined);
        }
        for (&q, &boundary) in &around[i] {
            let pair = [(i as u32).min(q), (i as u32).max(q)];
            let [a, b] = pair.map(|p| p as usize);
            let cost = cost(&area, &mean, a, b, boundary);
            heap.push(Merge {
                cost,
                pair,
                versions: [version[a], version[b]],
            });
        }
    }
    sizes
        .iter()
        .map(|n| {
            // If no further merge is possible, the coarsest regions are used; if there are too few
            // patches, the patches themselves.
            let at_least = snapshots
                .range(n..)
                .next()
                .or_else(|| snapshots.iter().next_back());
            at_least.map(|(_, s)| s.clone()).unwrap_or_default()
        })
        .collect()
}

/// Part of each face `(m,)`, numbered from 0 without gaps, when its `patches (m,)` are merged until
/// `n` parts are left (or more, see [`merge_patches`]), by standardised descriptors `(m, dim)`.
///
/// ```
/// use coseg_geometry::mesh::{DualGraph, FaceGeometry, icosphere};
/// use coseg_geometry::segmentation::{Surface, parts, patches};
///
/// let sphere = icosphere(3);
/// let patches = patches(&sphere, &DualGraph::new(&sphere, &[]), 0, 40);
/// // One descriptor, which tells north from south.
/// let centroids = FaceGeometry::new(&sphere).centroids;
/// let descriptors: Vec<f32> = centroids.iter().map(|c| c[2].signum() as f32).collect();
/// let found = parts(&Surface::new(&sphere), &patches, &descriptors, 1, 2);
/// assert_eq!(found.iter().max(), Some(&1));
/// let pole = |z: f64| centroids.iter().position(|c| c[2] * z > 0.95).unwrap();
/// assert_ne!(found[pole(1.0)], found[pole(-1.0)]);
/// ```
pub fn parts(
    surface: &Surface,
    patches: &[u32],
    descriptors: &[f32],
    dim: usize,
    n: usize,
) -> Vec<u32> {
    let graph = PatchGraph::new(surface, patches);
    let means = surface.patch_means(patches, graph.len(), descriptors, dim);
    let part_of_patch = merge_patches(&graph, &means, dim, &[n]).remove(0);
    patches.iter().map(|p| part_of_patch[*p as usize]).collect()
}

fn numbered(region: &[u32]) -> Vec<u32> {
    let mut number = BTreeMap::new();
    for r in region {
        let next = number.len() as u32;
        number.entry(*r).or_insert(next);
    }
    region.iter().map(|r| number[r]).collect()
}

/// The descriptors of the parts of one shape, and the boundaries between them.
#[derive(Debug, Clone, PartialEq)]
pub struct PartGraph {
    /// Area share of each part.
    pub area: Vec<f64>,
    /// Area-weighted mean of the face descriptors `(p, dim)`.
    pub mean: Vec<f64>,
    /// Their area-weighted standard deviation `(p, dim)`.
    pub spread: Vec<f64>,
    /// Boundary-weighted mean of the neighbouring parts' means `(p, dim)`.
    pub context: Vec<f64>,
    /// Size, proportions and boundary: [`PartGraph::N_SHAPE`] values for each part.
    pub shape: Vec<f64>,
    /// Boundary length between parts `(p, p)`.
    pub boundary: Vec<f64>,
    /// Boundary length times crease `(p, p)`.
    pub creased: Vec<f64>,
}

impl PartGraph {
    /// Number of values for each part in `shape`.
    pub const N_SHAPE: usize = 11;

    /// Describes the parts of a shape, given the part of each patch and face descriptors `(m,
    /// dim)`.
    ///
    /// ```
    /// use coseg_geometry::mesh::{DualGraph, icosphere};
    /// use coseg_geometry::segmentation::{PartGraph, PatchGraph, Surface, patches};
    ///
    /// let sphere = icosphere(2);
    /// let surface = Surface::new(&sphere);
    /// let patches = patches(&sphere, &DualGraph::new(&sphere, &[]), 0, 4);
    /// let graph = PatchGraph::new(&surface, &patches);
    /// let found = PartGraph::new(&surface, &graph, &[0, 0, 1, 1], &vec![1.0; 320], 1);
    /// assert_eq!(found.len(), 2);
    /// assert!((found.area.iter().sum::<f64>() - 1.0).abs() < 1e-9);
    /// assert!(found.boundary[1] > 0.0); // the two parts touch
    /// ```
    pub fn new(
        surface: &Surface,
        patches: &PatchGraph,
        part_of_patch: &[u32],
        descriptors: &[f32],
        dim: usize,
    ) -> Self {
        let n = part_of_patch.iter().max().map_or(0, |p| *p as usize + 1);
        let part_of_face: Vec<u32> = patches
            .patch_of_face
            .iter()
            .map(|p| part_of_patch[*p as usize])
            .collect();
        let mut area = vec![0.0; n];
        for (p, a) in part_of_patch.iter().zip(&patches.area) {
            area[*p as usize] += a;
        }
        let mean = surface.patch_means(&part_of_face, n, descriptors, dim);
        let squares: Vec<f32> = descriptors.iter().map(|x| x * x).collect();
        let mut spread = surface.patch_means(&part_of_face, n, &squares, dim);
        for (s, m) in spread.iter_mut().zip(&mean) {
            *s = (*s - m * m).max(0.0).sqrt();
        }
        let mut boundary = vec![0.0; n * n];
        let mut creased = vec![0.0; n * n];
        for &([a, b], length, crease) in &patches.edges {
            let (p, q) = (
                part_of_patch[a as usize] as usize,
                part_of_patch[b as usize] as usize,
            );
            if p != q {
                for at in [p * n + q, q * n + p] {
                    boundary[at] += length;
                    creased[at] += length * crease;
                }
            }
        }
        let extents = extents(surface, &part_of_face, &area);
        let mut context = vec![0.0; n * dim];
        let mut shape = Vec::with_capacity(n * Self::N_SHAPE);
        for p in 0..n {
            let row = &boundary[p * n..(p + 1) * n];
            let around: f64 = row.iter().sum();
            let mut log_area_around = 0.0;
            let mut n_neighbours = 0;
            for q in 0..n {
                let share = row[q] / around.max(1e-9);
                n_neighbours += usize::from(row[q] > 0.02);
                log_area_around += share * area[q].max(1e-12).ln();
                for c in 0..dim {
                    context[p * dim + c] += share * mean[q * dim + c];
                }
            }
            let crease: f64 = creased[p * n..(p + 1) * n].iter().sum::<f64>() / around.max(1e-9);
            let a = area[p].max(1e-12);
            let [e1, e2, e3] = extents[p].map(f64::ln);
            shape.extend([
                a.ln(),
                0.5 * a.ln() - e1,
                e1,
                e2,
                e3,
                e2 - e1,
                e3 - e1,
                around / a.sqrt(),
                n_neighbours.min(6) as f64,
                crease,
                log_area_around,
            ]);
        }
        Self {
            area,
            mean,
            spread,
            context,
            shape,
            boundary,
            creased,
        }
    }

    /// Number of parts.
    pub fn len(&self) -> usize {
        self.area.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.area.is_empty()
    }
}

/// Roots of the principal variances of the face centroids of each part, descending.
fn extents(surface: &Surface, part_of_face: &[u32], area: &[f64]) -> Vec<[f64; 3]> {
    let mut centre = vec![[0.0; 3]; area.len()];
    for (f, &p) in part_of_face.iter().enumerate() {
        for (sum, x) in centre[p as usize].iter_mut().zip(surface.centroids[f]) {
            *sum += surface.area[f] * x;
        }
    }
    for (c, a) in centre.iter_mut().zip(area) {
        c.iter_mut().for_each(|x| *x /= a.max(1e-300));
    }
    let mut covariance = vec![Matrix3::zeros(); area.len()];
    for (f, &p) in part_of_face.iter().enumerate() {
        let x = nalgebra::Vector3::from_fn(|c, _| surface.centroids[f][c] - centre[p as usize][c]);
        covariance[p as usize] += surface.area[f] * x * x.transpose();
    }
    covariance
        .into_iter()
        .zip(area)
        .map(|(m, a)| {
            let values = SymmetricEigen::new(m / a.max(1e-300)).eigenvalues;
            let mut e = [values[0], values[1], values[2]].map(|v: f64| v.max(1e-8).sqrt());
            e.sort_by(|x, y| y.total_cmp(x));
            e
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::{DualGraph, bridges, clean, zoo};
    use crate::segmentation::patches;

    /// A valley of two sheets, its patches, and a descriptor that is nearly constant.
    fn valley() -> (Surface, Vec<u32>, Vec<f32>) {
        let mut mesh = zoo::grid(40, 20);
        for p in &mut mesh.vertices {
            p[2] = 2.0 * (p[0] - 20.0).abs();
        }
        let mesh = clean(&zoo::parsed(&mesh)).unwrap().mesh;
        let surface = Surface::new(&mesh);
        let patch = patches(&mesh, &DualGraph::new(&mesh, &bridges(&mesh)), 0, 20);
        let along = surface.centroids.iter().map(|c| 0.01 * c[1] as f32);
        let descriptors = along.collect();
        (surface, patch, descriptors)
    }

    #[test]
    fn the_sheets_of_a_valley_are_two_parts() {
        let (surface, patch, descriptors) = valley();
        let part = parts(&surface, &patch, &descriptors, 1, 2);
        assert_eq!(part.iter().max(), Some(&1));
        let side = |f: usize| surface.centroids[f][0] > 20.0;
        let mut sides = [[0.0; 2]; 2];
        for (f, p) in part.iter().enumerate() {
            sides[*p as usize][usize::from(side(f))] += surface.area[f];
        }
        let astray: f64 = sides.iter().map(|s| s[0].min(s[1])).sum();
        assert!(astray < 0.02, "{sides:?}");
    }

    #[test]
    fn parts_nest_and_are_the_patches_at_most() {
        let (surface, patch, descriptors) = valley();
        let of = |n| parts(&surface, &patch, &descriptors, 1, n);
        assert_eq!(of(1_000), patch);
        for n in 1..10 {
            let (coarse, fine) = (of(n), of(n + 1));
            assert_eq!(coarse.iter().max(), Some(&(n as u32 - 1)));
            let mut within = vec![None; n + 1];
            for (c, f) in coarse.iter().zip(&fine) {
                assert_eq!(within[*f as usize].replace(c).unwrap_or(c), c, "{n}");
            }
        }
    }
}
