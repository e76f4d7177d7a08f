//! Computes shortest paths along the edges of a mesh by Dijkstra's algorithm.
//!
//! Edge paths overestimate true geodesics by up to a fifth on regular meshes. The descriptors
//! compare distances with each other within one mesh, where that cancels.

use super::adjacency::EdgeFaces;
use super::{Bridge, TriMesh, distance};
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Width of a bucket, in mean edges.
const BUCKET: f64 = 0.5;
/// The largest number of buckets: one edge may be much longer than the mean.
const MAX_BUCKETS: f64 = 1000.0;

/// Vertices and edges of a mesh with their lengths, and the bridges between its components.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct EdgeGraph {
    offsets: Vec<u32>,
    neighbors: Vec<(u32, f64)>,
    /// Width of the buckets by which a search from one vertex advances.
    width: f64,
    n_buckets: usize,
}

/// Distances from one source, with the memory of the search; reusable for the next source.
#[derive(Debug, Clone, Default)]
pub struct Distances {
    /// Distance of each node; infinite where there is no path.
    pub values: Vec<f64>,
    /// Non-negative doubles have the same order as their bits.
    heap: BinaryHeap<Reverse<(u64, u32)>>,
    /// Nodes to be visited, by distance.
    buckets: Vec<Vec<u32>>,
    /// The distance at which each node was last visited.
    visited: Vec<f64>,
}

impl Distances {
    /// Sets the distances of all nodes to infinity.
    pub fn reset(&mut self, n_nodes: usize) {
        self.values.clear();
        self.values.resize(n_nodes, f64::INFINITY);
        self.heap.clear();
    }

    /// Lowers `values` by paths from `source`, over edges that `neighbors` lists with their
    /// non-negative costs; calls `reached` for each node whose distance falls. Nodes that already
    /// have a shorter distance keep it, and the search stops at them.
    ///
    /// ```
    /// use coseg_geometry::mesh::geodesic::Distances;
    ///
    /// // A path of five nodes, unit edges; distances to the nearer end.
    /// let neighbors = |v: u32| {
    ///     [v.wrapping_sub(1), v + 1].into_iter().filter(|w| *w < 5).map(|w| (w, 1.0))
    /// };
    /// let mut distances = Distances::default();
    /// distances.reset(5);
    /// for end in [0, 4] {
    ///     distances.spread(end, neighbors, |_| {});
    /// }
    /// assert_eq!(distances.values, [0.0, 1.0, 2.0, 1.0, 0.0]);
    /// ```
    pub fn spread<I: Iterator<Item = (u32, f64)>>(
        &mut self,
        source: u32,
        neighbors: impl Fn(u32) -> I,
        mut reached: impl FnMut(u32),
    ) {
        if self.values[source as usize] <= 0.0 {
            return;
        }
        self.values[source as usize] = 0.0;
        self.heap.push(Reverse((0, source)));
        while let Some(Reverse((bits, node))) = self.heap.pop() {
            let so_far = f64::from_bits(bits);
            if so_far > self.values[node as usize] {
                continue;
            }
            reached(node);
            for (next, cost) in neighbors(node) {
                let sum = so_far + cost;
                if sum < self.values[next as usize] {
                    self.values[next as usize] = sum;
                    self.heap.push(Reverse((sum.to_bits(), next)));
                }
            }
        }
    }
}

impl EdgeGraph {
    /// Graph of a mesh's edges and of bridges; lengths are in units of the mesh. O(m log m).
    ///
    /// ```
    /// use coseg_geometry::mesh::{EdgeGraph, icosphere};
    ///
    /// let graph = EdgeGraph::new(&icosphere(2), &[]);
    /// assert_eq!(graph.n_vertices(), 162);
    /// // A corner of the icosahedron keeps its five neighbours; all other vertices have six.
    /// assert_eq!((graph.neighbors(0).len(), graph.neighbors(100).len()), (5, 6));
    /// ```
    pub fn new(mesh: &TriMesh, bridges: &[Bridge]) -> Self {
        let p = &mesh.vertices;
        let mut edges: Vec<([u32; 2], f64)> = EdgeFaces::new(&mesh.faces)
            .edges
            .into_iter()
            .map(|[a, b]| ([a, b], distance(p[a as usize], p[b as usize])))
            .collect();
        let between = bridges.iter().filter(|b| b.vertices[0] != b.vertices[1]);
        edges.extend(between.map(|b| (b.vertices, b.length)));
        let mut offsets = vec![0_u32; p.len() + 1];
        for ([a, b], _) in &edges {
            offsets[*a as usize + 1] += 1;
            offsets[*b as usize + 1] += 1;
        }
        for i in 1..offsets.len() {
            offsets[i] += offsets[i - 1];
        }
        let mut next = offsets.clone();
        let mut neighbors = vec![(0, 0.0); 2 * edges.len()];
        for &([a, b], length) in &edges {
            for (from, to) in [(a, b), (b, a)] {
                neighbors[next[from as usize] as usize] = (to, length);
                next[from as usize] += 1;
            }
        }
        let longest = edges.iter().fold(0.0, |m: f64, e| m.max(e.1));
        let mean = edges.iter().map(|e| e.1).sum::<f64>() / edges.len().max(1) as f64;
        let width = (BUCKET * mean).max(longest / MAX_BUCKETS);
        let width = if width > 0.0 { width } else { 1.0 };
        Self {
            offsets,
            neighbors,
            width,
            // Waiting nodes are within the longest edge of the visited ones; the other buckets
            // allow for rounding.
            n_buckets: ((longest / width) as usize + 3).next_power_of_two(),
        }
    }

    /// Number of vertices.
    pub fn n_vertices(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }

    /// Neighbours of a vertex, each with the length of the edge to it.
    pub fn neighbors(&self, vertex: u32) -> &[(u32, f64)] {
        let v = vertex as usize;
        &self.neighbors[self.offsets[v] as usize..self.offsets[v + 1] as usize]
    }

    /// Distances `(n,)` from a vertex along edges; infinite where there is no path. O(n log n).
    ///
    /// ```
    /// use coseg_geometry::mesh::{EdgeGraph, icosphere};
    ///
    /// let distances = EdgeGraph::new(&icosphere(3), &[]).dijkstra(0);
    /// assert_eq!(distances[0], 0.0);
    /// // Vertex 3 is opposite: half a great circle away.
    /// assert!((distances[3] / std::f64::consts::PI - 1.0).abs() < 0.2);
    /// ```
    ///
    /// # Panics
    /// If the vertex does not exist.
    pub fn dijkstra(&self, source: u32) -> Vec<f64> {
        let mut distances = Distances::default();
        self.dijkstra_into(source, &mut distances);
        distances.values
    }

    /// Like [`Self::dijkstra`], into memory that is reused.
    ///
    /// It uses buckets in place of a heap (Meyer and Sanders 2003, *Δ-stepping*): visiting a few
    /// vertices twice costs less than maintaining an order. The distances are the same bits,
    /// because sums along a path do not depend on the order of visits.
    ///
    /// ```
    /// use coseg_geometry::mesh::{EdgeGraph, geodesic::Distances, icosphere};
    ///
    /// let graph = EdgeGraph::new(&icosphere(2), &[]);
    /// let mut distances = Distances::default();
    /// for source in [0, 50] {
    ///     graph.dijkstra_into(source, &mut distances);
    ///     assert_eq!(distances.values, graph.dijkstra(source));
    /// }
    /// ```
    ///
    /// # Panics
    /// If the vertex does not exist.
    pub fn dijkstra_into(&self, source: u32, distances: &mut Distances) {
        distances.reset(self.n_vertices());
        let Distances {
            values,
            buckets,
            visited,
            ..
        } = distances;
        visited.clear();
        visited.resize(values.len(), f64::INFINITY);
        buckets.resize(self.n_buckets, Vec::new());
        let mask = self.n_buckets - 1;
        let scale = 1.0 / self.width;
        values[source as usize] = 0.0;
        buckets[0].push(source);
        let (mut n_waiting, mut current) = (1, 0);
        while n_waiting > 0 {
            let Some(node) = buckets[current & mask].pop() else {
                current += 1;
                continue;
            };
            n_waiting -= 1;
            let so_far = values[node as usize];
            if so_far >= visited[node as usize] {
                continue;
            }
            visited[node as usize] = so_far;
            for &(next, cost) in self.neighbors(node) {
                let sum = so_far + cost;
                if sum < values[next as usize] {
                    values[next as usize] = sum;
                    buckets[(sum * scale) as usize & mask].push(next);
                    n_waiting += 1;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Distances, EdgeGraph};
    use crate::mesh::{bridges, zoo};

    #[test]
    fn on_a_grid_paths_follow_sides_and_diagonals() {
        let mesh = zoo::grid(6, 4);
        let d = EdgeGraph::new(&mesh, &[]).dijkstra(0);
        assert_eq!(d[6], 6.0);
        // Diagonals run from (0, 0) towards (1, 1).
        assert!((d[4 * 7 + 6] - (4.0 * 2.0_f64.sqrt() + 2.0)).abs() < 1e-12);
    }

    #[test]
    fn without_bridges_other_components_are_out_of_reach() {
        let mesh = zoo::union(&[zoo::sphere(1), zoo::moved(&zoo::sphere(1), [4.0, 0.0, 0.0])]);
        let alone = EdgeGraph::new(&mesh, &[]).dijkstra(0);
        assert_eq!(alone.iter().filter(|d| d.is_infinite()).count(), 42);
        let joined = EdgeGraph::new(&mesh, &bridges(&mesh)).dijkstra(0);
        assert!(joined.iter().all(|d| d.is_finite()));
    }

    #[test]
    fn on_the_zoo_all_is_finite_and_the_triangle_inequality_holds() {
        for (name, mesh) in zoo::clean_meshes() {
            let graph = EdgeGraph::new(&mesh, &bridges(&mesh));
            let mut d = Distances::default();
            graph.dijkstra_into(0, &mut d);
            for v in 0..graph.n_vertices() as u32 {
                assert!(d.values[v as usize].is_finite(), "{name}");
                for &(w, length) in graph.neighbors(v) {
                    assert!(
                        d.values[w as usize] <= d.values[v as usize] + length,
                        "{name}"
                    );
                }
            }
            let again = graph.dijkstra(0);
            assert_eq!(again, d.values);
        }
    }

    #[test]
    fn buckets_give_the_distances_of_a_heap() {
        for (name, mesh) in zoo::clean_meshes() {
            let graph = EdgeGraph::new(&mesh, &bridges(&mesh));
            let (mut heap, mut buckets) = (Distances::default(), Distances::default());
            for source in (0..graph.n_vertices() as u32).step_by(17) {
                heap.reset(graph.n_vertices());
                heap.spread(source, |v| graph.neighbors(v).iter().copied(), |_| {});
                graph.dijkstra_into(source, &mut buckets);
                assert_eq!(heap.values, buckets.values, "{name}");
            }
        }
    }

    #[test]
    fn spreading_from_several_sources_gives_the_least() {
        let mesh = zoo::sphere(2);
        let graph = EdgeGraph::new(&mesh, &[]);
        let (a, b) = (graph.dijkstra(3), graph.dijkstra(77));
        let mut d = Distances::default();
        d.reset(graph.n_vertices());
        let mut owner = vec![0; graph.n_vertices()];
        for source in [3, 77] {
            d.spread(
                source,
                |v| graph.neighbors(v).iter().copied(),
                |v| owner[v as usize] = source,
            );
        }
        for v in 0..graph.n_vertices() {
            assert_eq!(d.values[v], a[v].min(b[v]));
            assert_eq!(owner[v], if b[v] < a[v] { 77 } else { 3 });
        }
    }
}
