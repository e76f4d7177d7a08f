//! Builds the graph of the faces of a mesh: neighbours, and the length and angle of the edge
//! between them.

use super::{Bridge, TriMesh, add, cross, distance, dot, norm, scale, sub, unit};

/// Edges and the faces around them.
#[derive(Debug, Clone, Default)]
pub(crate) struct EdgeFaces {
    /// Vertices of each edge, the smaller index first; ascending.
    pub(crate) edges: Vec<[u32; 2]>,
    /// Where each edge's incidences begin; one more than edges.
    pub(crate) offsets: Vec<usize>,
    /// Face, and the corner (0..3) opposite the edge; ascending within an edge.
    pub(crate) incidences: Vec<(u32, u8)>,
}

impl EdgeFaces {
    /// Edges of a face list; the two ends of an edge differ. O(m), where no vertex has many edges.
    pub(crate) fn new(faces: &[[u32; 3]]) -> Self {
        let n = faces.iter().flatten().max().map_or(0, |&v| v as usize + 1);
        let sides = |face: &[u32; 3]| {
            let [a, b, c] = *face;
            [(b, c), (c, a), (a, b)].map(|(a, b)| [a.min(b), a.max(b)])
        };
        // A counting sort by the smaller vertex, then a sort by the larger one.
        let mut starts = vec![0_u32; n + 1];
        for [a, _] in faces.iter().flat_map(sides) {
            starts[a as usize + 1] += 1;
        }
        for i in 1..starts.len() {
            starts[i] += starts[i - 1];
        }
        // The larger vertex, and face and corner packed into one word; words compare like the
        // values they hold.
        let mut sorted = vec![(0_u32, 0_u64); 3 * faces.len()];
        let mut next = starts.clone();
        for (f, face) in (0_u64..).zip(faces) {
            for (corner, [a, b]) in (0_u64..).zip(sides(face)) {
                let slot = &mut next[a as usize];
                sorted[*slot as usize] = (b, f << 2 | corner);
                *slot += 1;
            }
        }
        let mut result = Self {
            edges: Vec::with_capacity(sorted.len() / 2),
            offsets: Vec::with_capacity(sorted.len() / 2 + 1),
            incidences: Vec::with_capacity(sorted.len()),
        };
        for (a, range) in (0_u32..).zip(starts.windows(2)) {
            let around = &mut sorted[range[0] as usize..range[1] as usize];
            around.sort_unstable();
            let mut before = None;
            for &mut (b, incidence) in around {
                if before != Some(b) {
                    result.edges.push([a, b]);
                    result.offsets.push(result.incidences.len());
                    before = Some(b);
                }
                let corner = (incidence & 3) as u8;
                result.incidences.push(((incidence >> 2) as u32, corner));
            }
        }
        result.offsets.push(sorted.len());
        result
    }

    /// Faces around an edge.
    pub(crate) fn around(&self, edge: usize) -> &[(u32, u8)] {
        &self.incidences[self.offsets[edge]..self.offsets[edge + 1]]
    }
}

/// Whether a face runs along its edge from the smaller to the larger vertex index.
pub(crate) fn ascends(face: [u32; 3], opposite: u8) -> bool {
    face[(opposite as usize + 1) % 3] < face[(opposite as usize + 2) % 3]
}

/// Component of each face (numbered by first face), faces connected through shared edges, and their
/// number.
pub(crate) fn components(n_faces: usize, edges: &EdgeFaces) -> (Vec<u32>, usize) {
    let mut parent: Vec<u32> = (0..n_faces as u32).collect();
    for e in 0..edges.edges.len() {
        for pair in edges.around(e).windows(2) {
            join(&mut parent, pair[0].0, pair[1].0);
        }
    }
    let mut number = vec![u32::MAX; n_faces];
    let mut count = 0;
    let labels = (0..n_faces as u32)
        .map(|f| {
            let root = root(&mut parent, f) as usize;
            if number[root] == u32::MAX {
                number[root] = count;
                count += 1;
            }
            number[root]
        })
        .collect();
    (labels, count as usize)
}

/// Representative of a set, with path halving.
pub(crate) fn root(parent: &mut [u32], mut i: u32) -> u32 {
    while parent[i as usize] != i {
        parent[i as usize] = parent[parent[i as usize] as usize];
        i = parent[i as usize];
    }
    i
}

/// Unites two sets under the smaller representative; returns false if they are the same set.
pub(crate) fn join(parent: &mut [u32], a: u32, b: u32) -> bool {
    let (a, b) = (root(parent, a), root(parent, b));
    parent[a.max(b) as usize] = a.min(b);
    a != b
}

/// Area, unit normal and centroid of each face.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FaceGeometry {
    /// `(m,)`, in squared units of the mesh.
    pub areas: Vec<f64>,
    /// `(m, 3)`; zero for a face without area.
    pub normals: Vec<[f64; 3]>,
    /// `(m, 3)`.
    pub centroids: Vec<[f64; 3]>,
}

impl FaceGeometry {
    /// Geometry of all faces of a mesh; the normal follows the right-hand rule.
    ///
    /// ```
    /// use coseg_geometry::mesh::{FaceGeometry, TriMesh};
    ///
    /// let vertices = vec![[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 3.0, 0.0]];
    /// let geometry = FaceGeometry::new(&TriMesh { vertices, faces: vec![[0, 1, 2]] });
    /// assert_eq!(geometry.areas, [4.5]);
    /// assert_eq!(geometry.normals, [[0.0, 0.0, 1.0]]);
    /// assert_eq!(geometry.centroids, [[1.0, 1.0, 0.0]]);
    /// ```
    pub fn new(mesh: &TriMesh) -> Self {
        let mut result = Self::default();
        for f in 0..mesh.faces.len() {
            let [a, b, c] = mesh.corners(f);
            let normal = cross(sub(b, a), sub(c, a));
            result.areas.push(0.5 * norm(normal));
            result.normals.push(unit(normal));
            result.centroids.push(scale(add(add(a, b), c), 1.0 / 3.0));
        }
        result
    }
}

/// A border between two faces, or a bridge between two components.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DualEdge {
    /// The faces on either side; they differ.
    pub faces: [u32; 2],
    /// Length of the shared edge; 0 for a bridge.
    pub length: f64,
    /// Distance between the centroids.
    pub distance: f64,
    /// Angle between the normals, 0 (flat) to π (folded). Where two faces disagree on which side is
    /// outside, one normal is flipped first. 0 for a bridge.
    pub angle: f64,
    /// Whether the surface bends outward here (or not at all); true for a bridge.
    pub convex: bool,
    /// Whether this is a bridge.
    pub bridge: bool,
}

/// Graph of the faces. Around an edge with more than two faces each is linked to the next.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct DualGraph {
    /// Borders by shared edge in ascending order of its vertices, then bridges.
    pub edges: Vec<DualEdge>,
    /// Where each face's neighbours begin in `neighbors`; one more than faces.
    pub offsets: Vec<u32>,
    /// Neighbouring face and index of the edge to it.
    pub neighbors: Vec<(u32, u32)>,
}

/// Below this sine of the fold, in units of the neighbour's edge, two faces count as coplanar.
const FLAT: f64 = 1e-9;

impl DualGraph {
    /// Graph of a mesh's faces, with the bridges between its components. O(m log m).
    ///
    /// ```
    /// use coseg_geometry::mesh::{DualGraph, icosphere};
    ///
    /// let dual = DualGraph::new(&icosphere(1), &[]);
    /// assert_eq!((dual.n_faces(), dual.edges.len()), (80, 120));
    /// assert_eq!(dual.neighbors(0).len(), 3);
    /// // A sphere bends outward at every edge.
    /// assert!(dual.edges.iter().all(|e| e.convex && e.angle > 0.0));
    /// ```
    pub fn new(mesh: &TriMesh, bridges: &[Bridge]) -> Self {
        let geometry = FaceGeometry::new(mesh);
        let around = EdgeFaces::new(&mesh.faces);
        let mut edges = Vec::with_capacity(3 * mesh.faces.len() / 2 + bridges.len());
        for (e, &[a, b]) in around.edges.iter().enumerate() {
            let ends = [mesh.vertices[a as usize], mesh.vertices[b as usize]];
            let mut push = |f, g| edges.push(border(mesh, &geometry, ends, f, g));
            match around.around(e) {
                [_] => {}
                &[f, g] => push(f, g),
                faces => {
                    let ring = by_angle(mesh, ends, faces);
                    for i in 0..ring.len() {
                        push(ring[i], ring[(i + 1) % ring.len()]);
                    }
                }
            }
        }
        for bridge in bridges {
            let [f, g] = bridge.faces;
            edges.push(DualEdge {
                faces: bridge.faces,
                length: 0.0,
                distance: distance(
                    geometry.centroids[f as usize],
                    geometry.centroids[g as usize],
                ),
                angle: 0.0,
                convex: true,
                bridge: true,
            });
        }
        let mut offsets = vec![0_u32; mesh.faces.len() + 1];
        for edge in &edges {
            for f in edge.faces {
                offsets[f as usize + 1] += 1;
            }
        }
        for i in 1..offsets.len() {
            offsets[i] += offsets[i - 1];
        }
        let mut next = offsets.clone();
        let mut neighbors = vec![(0, 0); 2 * edges.len()];
        for (i, edge) in edges.iter().enumerate() {
            let [f, g] = edge.faces;
            for (from, to) in [(f, g), (g, f)] {
                neighbors[next[from as usize] as usize] = (to, i as u32);
                next[from as usize] += 1;
            }
        }
        Self {
            edges,
            offsets,
            neighbors,
        }
    }

    /// Number of faces.
    pub fn n_faces(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }

    /// Neighbours of a face, each with the index of the edge to it.
    pub fn neighbors(&self, face: usize) -> &[(u32, u32)] {
        &self.neighbors[self.offsets[face] as usize..self.offsets[face + 1] as usize]
    }
}

/// Faces around an edge, in cyclic order.
fn by_angle(mesh: &TriMesh, ends: [[f64; 3]; 2], faces: &[(u32, u8)]) -> Vec<(u32, u8)> {
    let axis = unit(sub(ends[1], ends[0]));
    let away = |&(f, corner): &(u32, u8)| {
        let d = sub(mesh.corners(f as usize)[corner as usize], ends[0]);
        sub(d, scale(axis, dot(d, axis)))
    };
    let x = unit(away(&faces[0]));
    let y = cross(axis, x);
    let mut ring: Vec<(f64, (u32, u8))> = faces
        .iter()
        .map(|face| {
            let d = away(face);
            // The first face has angle zero exactly, regardless of rounding.
            let angle = if face == &faces[0] {
                0.0
            } else {
                dot(d, y).atan2(dot(d, x))
            };
            (
                if angle < 0.0 {
                    angle + std::f64::consts::TAU
                } else {
                    angle
                },
                *face,
            )
        })
        .collect();
    ring.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    ring.into_iter().map(|(_, face)| face).collect()
}

fn border(
    mesh: &TriMesh,
    geometry: &FaceGeometry,
    ends: [[f64; 3]; 2],
    (f, f_corner): (u32, u8),
    (g, g_corner): (u32, u8),
) -> DualEdge {
    let (fi, gi) = (f as usize, g as usize);
    let coherent = ascends(mesh.faces[fi], f_corner) != ascends(mesh.faces[gi], g_corner);
    let n = geometry.normals[fi];
    let m = if coherent {
        geometry.normals[gi]
    } else {
        scale(geometry.normals[gi], -1.0)
    };
    let beyond = sub(mesh.corners(gi)[g_corner as usize], ends[0]);
    DualEdge {
        faces: [f, g],
        length: distance(ends[0], ends[1]),
        distance: distance(geometry.centroids[fi], geometry.centroids[gi]),
        // More accurate than the arc cosine near flat and folded.
        angle: norm(cross(n, m)).atan2(dot(n, m)),
        convex: dot(n, beyond) <= FLAT * norm(beyond),
        bridge: false,
    }
}

#[cfg(test)]
mod tests {
    use super::{DualGraph, FaceGeometry};
    use crate::mesh::{TriMesh, bridges, zoo};
    use std::f64::consts::{FRAC_PI_2, PI};

    #[test]
    fn a_cube_has_flat_diagonals_and_convex_right_angles() {
        let cube = zoo::cube();
        let dual = DualGraph::new(&cube, &[]);
        assert_eq!(dual.edges.len(), 18);
        let flat = dual.edges.iter().filter(|e| e.angle < 1e-12).count();
        let right = dual
            .edges
            .iter()
            .filter(|e| (e.angle - FRAC_PI_2).abs() < 1e-12)
            .count();
        assert_eq!((flat, right), (6, 12));
        assert!(dual.edges.iter().all(|e| e.convex && !e.bridge));
        assert!((0..12).all(|f| dual.neighbors(f).len() == 3));
        let geometry = FaceGeometry::new(&cube);
        assert!((geometry.areas.iter().sum::<f64>() - 6.0).abs() < 1e-12);
    }

    #[test]
    fn an_inner_edge_is_concave_and_an_inside_out_mesh_has_it_the_other_way() {
        let mut valley = TriMesh {
            vertices: vec![
                [0.0, 0.0, 0.0],
                [0.0, 1.0, 0.0],
                [1.0, 0.5, 0.3],
                [-1.0, 0.5, 0.3],
            ],
            faces: vec![[0, 2, 1], [0, 1, 3]],
        };
        let angle = 2.0 * 0.3_f64.atan();
        for convex in [false, true] {
            let edge = DualGraph::new(&valley, &[]).edges[0];
            assert!((edge.angle - angle).abs() < 1e-12);
            assert_eq!(edge.convex, convex);
            assert!((edge.length - 1.0).abs() < 1e-12);
            for face in &mut valley.faces {
                face.swap(0, 1);
            }
        }
    }

    #[test]
    fn faces_that_disagree_on_outside_are_not_taken_for_a_fold() {
        let flat = TriMesh {
            vertices: vec![
                [0.0, 0.0, 0.0],
                [0.0, 1.0, 0.0],
                [1.0, 0.5, 0.0],
                [-1.0, 0.5, 0.0],
            ],
            faces: vec![[0, 2, 1], [1, 0, 3]],
        };
        assert!(DualGraph::new(&flat, &[]).edges[0].angle < 1e-12);
    }

    #[test]
    fn around_a_crossing_each_face_is_linked_to_the_next() {
        // Four half planes through the z axis, given in mixed order: +x, -x, +y, -y.
        let mesh = TriMesh {
            vertices: vec![
                [0.0, 0.0, 0.0],
                [0.0, 0.0, 1.0],
                [1.0, 0.0, 0.5],
                [-1.0, 0.0, 0.5],
                [0.0, 1.0, 0.5],
                [0.0, -1.0, 0.5],
            ],
            faces: vec![[0, 1, 2], [0, 1, 3], [0, 1, 4], [0, 1, 5]],
        };
        let dual = DualGraph::new(&mesh, &[]);
        let mut pairs: Vec<[u32; 2]> = dual
            .edges
            .iter()
            .map(|e| [e.faces[0].min(e.faces[1]), e.faces[0].max(e.faces[1])])
            .collect();
        pairs.sort_unstable();
        assert_eq!(pairs, [[0, 2], [0, 3], [1, 2], [1, 3]]);
    }

    #[test]
    fn every_mesh_of_the_zoo_has_a_finite_symmetric_connected_graph() {
        for (name, mesh) in zoo::clean_meshes() {
            let dual = DualGraph::new(&mesh, &bridges(&mesh));
            assert_eq!(dual.n_faces(), mesh.faces.len(), "{name}");
            for edge in &dual.edges {
                assert_ne!(edge.faces[0], edge.faces[1], "{name}");
                assert!((0.0..=PI).contains(&edge.angle), "{name}: {edge:?}");
                assert!(
                    edge.length.is_finite() && edge.distance.is_finite(),
                    "{name}"
                );
            }
            let mut seen = vec![false; mesh.faces.len()];
            let mut todo = vec![0_usize];
            seen[0] = true;
            while let Some(f) = todo.pop() {
                for &(g, e) in dual.neighbors(f) {
                    let edge = &dual.edges[e as usize];
                    assert!(edge.faces.contains(&g) && edge.faces.contains(&(f as u32)));
                    if !std::mem::replace(&mut seen[g as usize], true) {
                        todo.push(g as usize);
                    }
                }
            }
            assert!(seen.iter().all(|&s| s), "{name} is not connected");
        }
    }
}
