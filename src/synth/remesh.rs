//! Remeshes a closed mesh of an implicit surface to even triangles and a given number of faces.
//!
//! Incremental remeshing (M. Botsch and L. Kobbelt, "A remeshing approach to multiresolution
//! modeling", 2004): long edges are split, short ones collapsed, edges flipped towards valence six,
//! and vertices moved tangentially to the middle of their neighbours and back onto the zero set.
//! Each step keeps the mesh a closed manifold of the same topology, so the result is as watertight
//! as the input.

use super::field::Scene;
use super::vector::{Vec3, along, cross, dot, mix, norm, sub, unit};
use crate::mesh::TriMesh;

/// Rounds of split, collapse, flip and smooth; the shape of triangles is stable after about four.
const N_ROUNDS: usize = 4;
/// Rounds after the number of faces is reached.
const N_FINAL_ROUNDS: usize = 3;
/// Least cosine between a face before and after a step.
const LEAST_COSINE: f64 = 0.3;

/// An edge follows the surface well enough if its middle is nearer to the surface than this share
/// of its length.
const LEAST_GAP: f64 = 0.02;
/// Aligning makes no angle smaller than the angle of this sine, 22°.
const LEAST_SINE: f64 = 0.375;

/// Step of difference quotients, in edge lengths.
const STEP: f64 = 1e-3;

struct Mesh<'a> {
    scene: &'a Scene,
    /// Target length of edges.
    target: f64,
    vertices: Vec<Vec3>,
    /// Corners; a dead face has three equal ones.
    faces: Vec<[u32; 3]>,
    /// Living faces at each vertex.
    around: Vec<Vec<u32>>,
    n_faces: usize,
}

/// Remeshes `mesh`, whose vertices are near the zero set of `scene`, to `n_faces` triangles (one
/// less if odd). More remain where thin parts cannot have fewer without a change of the topology.
pub(super) fn remesh(mesh: TriMesh, scene: &Scene, n_faces: usize) -> TriMesh {
    let area: f64 = mesh
        .faces
        .iter()
        .map(|f| norm(double_area(&mesh.vertices, f)) / 2.0)
        .sum();
    // Equilateral triangles of edge l have area l²·√3/4.
    let target = (area / n_faces as f64 * 4.0 / 3f64.sqrt()).sqrt();
    let mut around = vec![Vec::with_capacity(6); mesh.vertices.len()];
    for (f, face) in mesh.faces.iter().enumerate() {
        for &v in face {
            around[v as usize].push(f as u32);
        }
    }
    let n_living = mesh.faces.len();
    let (vertices, faces) = (mesh.vertices, mesh.faces);
    let mut m = Mesh {
        scene,
        target,
        vertices,
        faces,
        around,
        n_faces: n_living,
    };
    for _ in 0..N_ROUNDS {
        m.split_longer_than(4.0 / 3.0 * target);
        m.collapse_shorter_than(0.8 * target, 0);
        m.flip();
        m.smooth();
    }
    while m.n_faces + 1 < n_faces {
        m.split_longest(n_faces);
    }
    let mut longest = target;
    while m.n_faces > n_faces && longest < 4.0 * target {
        m.collapse_shorter_than(longest, n_faces);
        longest *= 1.25;
    }
    for _ in 0..N_FINAL_ROUNDS {
        m.flip();
        m.smooth();
    }
    for _ in 0..N_FINAL_ROUNDS {
        m.align();
    }
    m.compact()
}

/// Twice the area, along the normal.
fn double_area(vertices: &[Vec3], face: &[u32; 3]) -> Vec3 {
    let [a, b, c] = face.map(|v| vertices[v as usize]);
    cross(sub(b, a), sub(c, a))
}

impl Mesh<'_> {
    fn at(&self, v: u32) -> Vec3 {
        self.vertices[v as usize]
    }

    fn length(&self, [a, b]: [u32; 2]) -> f64 {
        norm(sub(self.at(a), self.at(b)))
    }

    fn normal(&self, face: &[u32; 3]) -> Vec3 {
        unit(double_area(&self.vertices, face))
    }

    /// Every edge once, with its length; in order of length.
    fn edges_by_length(&self) -> Vec<(f64, [u32; 2])> {
        let mut edges: Vec<(f64, [u32; 2])> = Vec::with_capacity(self.n_faces * 3 / 2);
        for &[a, b, c] in &self.faces {
            // Each edge is found in both directions, since the mesh is closed and oriented.
            let ascending = [[a, b], [b, c], [c, a]].into_iter().filter(|[u, v]| u < v);
            edges.extend(ascending.map(|e| (self.length(e), e)));
        }
        edges.sort_unstable_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
        edges
    }

    /// The two faces at an edge, the one with a→b first, and their third corners; `None` for an
    /// edge that was removed.
    fn sides(&self, [a, b]: [u32; 2]) -> Option<([u32; 2], [u32; 2])> {
        let (mut faces, mut thirds) = ([u32::MAX; 2], [0; 2]);
        for &f in &self.around[a as usize] {
            let face = self.faces[f as usize];
            for k in 0..3 {
                let (u, v, w) = (face[k], face[(k + 1) % 3], face[(k + 2) % 3]);
                if (u, v) == (a, b) {
                    (faces[0], thirds[0]) = (f, w);
                } else if (u, v) == (b, a) {
                    (faces[1], thirds[1]) = (f, w);
                }
            }
        }
        (!faces.contains(&u32::MAX)).then_some((faces, thirds))
    }

    fn neighbours(&self, v: u32) -> Vec<u32> {
        // Around a vertex of a closed oriented manifold each neighbour follows v in exactly one
        // face.
        let faces = self.around[v as usize]
            .iter()
            .map(|&f| self.faces[f as usize]);
        let next = |face: [u32; 3]| (0..3).find(|&k| face[k] == v).map(|k| face[(k + 1) % 3]);
        faces.filter_map(next).collect()
    }

    fn split_longer_than(&mut self, limit: f64) {
        for (length, edge) in self.edges_by_length().into_iter().rev() {
            if length <= limit {
                break;
            }
            self.split(edge);
        }
    }

    fn split_longest(&mut self, n_faces: usize) {
        for (_, edge) in self.edges_by_length().into_iter().rev() {
            if self.n_faces + 1 >= n_faces {
                break;
            }
            self.split(edge);
        }
    }

    fn split(&mut self, [a, b]: [u32; 2]) {
        let Some((faces, thirds)) = self.sides([a, b]) else {
            return;
        };
        let m = self.vertices.len() as u32;
        // Smoothing follows, and moves it onto the surface.
        self.vertices.push(mix(self.at(a), self.at(b), 0.5));
        self.around.push(Vec::with_capacity(6));
        for ((f, c), (from, to)) in faces.into_iter().zip(thirds).zip([(a, b), (b, a)]) {
            let new = self.faces.len() as u32;
            self.faces[f as usize] = [from, m, c];
            self.faces.push([m, to, c]);
            self.around[to as usize].retain(|&g| g != f);
            self.around[to as usize].push(new);
            self.around[c as usize].push(new);
            self.around[m as usize].extend([f, new]);
        }
        self.n_faces += 2;
    }

    /// Collapses edges, shortest first, while more than `least` faces remain.
    fn collapse_shorter_than(&mut self, limit: f64, least: usize) {
        for (length, edge) in self.edges_by_length() {
            if length >= limit || self.n_faces <= least {
                break;
            }
            if self.length(edge) < limit {
                self.collapse(edge);
            }
        }
    }

    fn collapse(&mut self, [a, b]: [u32; 2]) {
        let Some((dead, thirds)) = self.sides([a, b]) else {
            return;
        };
        // The link condition: the topology is preserved if the two share only the neighbours across
        // the edge.
        let near_a = self.neighbours(a);
        let near_b = self.neighbours(b);
        let shared = near_a.iter().filter(|v| near_b.contains(v)).count();
        let too_small = thirds.iter().any(|&c| self.around[c as usize].len() <= 3);
        if shared != 2 || too_small {
            return;
        }
        let middle = mix(self.at(a), self.at(b), 0.5);
        let reach = 4.0 / 3.0 * self.target;
        let all_near = near_a.iter().chain(&near_b).filter(|&&v| v != a && v != b);
        if all_near
            .into_iter()
            .any(|&v| norm(sub(self.at(v), middle)) > reach)
        {
            return;
        }
        for v in [a, b] {
            for &f in self.around[v as usize].iter().filter(|f| !dead.contains(f)) {
                let face = self.faces[f as usize];
                let moved = face.map(|u| if u == v { middle } else { self.at(u) });
                let after = unit(cross(sub(moved[1], moved[0]), sub(moved[2], moved[0])));
                if dot(self.normal(&face), after) < LEAST_COSINE {
                    return;
                }
            }
        }
        self.vertices[a as usize] = middle;
        for f in dead {
            for v in self.faces[f as usize] {
                self.around[v as usize].retain(|&g| g != f);
            }
            self.faces[f as usize] = [0; 3];
        }
        for f in std::mem::take(&mut self.around[b as usize]) {
            let face = &mut self.faces[f as usize];
            *face = face.map(|v| if v == b { a } else { v });
            self.around[a as usize].push(f);
        }
        self.n_faces -= 2;
    }

    /// Flips edges where that brings valences nearer to six.
    fn flip(&mut self) {
        for (_, edge) in self.edges_by_length() {
            let Some(([f, g], [c, d])) = self.sides(edge) else {
                continue;
            };
            let [a, b] = edge;
            let valence = |v: u32| self.around[v as usize].len() as i64;
            let off = |v: i64| (v - 6) * (v - 6);
            let (va, vb, vc, vd) = (valence(a), valence(b), valence(c), valence(d));
            let before = off(va) + off(vb) + off(vc) + off(vd);
            let after = off(va - 1) + off(vb - 1) + off(vc + 1) + off(vd + 1);
            let wins = after < before || (after == before && self.is_longer_than([c, d], edge));
            if !wins || va <= 3 || vb <= 3 || self.neighbours(c).contains(&d) {
                continue;
            }
            let new = [[a, d, c], [d, b, c]];
            let old = [f, g].map(|f| self.normal(&self.faces[f as usize]));
            let turned = new.iter().any(|face| {
                let n = self.normal(face);
                old.iter().any(|&o| dot(n, o) < 2.0 * LEAST_COSINE)
            });
            if !turned {
                self.replace([f, g], new, edge, [c, d]);
            }
        }
    }

    /// Flips edges that cut through the solid, or bridge a hollow, to the other diagonal if that
    /// one is nearer to the surface. On rounded edges and thin tubes it is the lengthwise diagonal.
    fn align(&mut self) {
        for (_, edge) in self.edges_by_length() {
            let Some((faces, [c, d])) = self.sides(edge) else {
                continue;
            };
            let [a, b] = edge;
            let off = |u: u32, v: u32| self.scene.value(mix(self.at(u), self.at(v), 0.5)).abs();
            let old = off(a, b);
            if old < LEAST_GAP * self.target || off(c, d) > 0.6 * old {
                continue;
            }
            let few = [a, b].iter().any(|&v| self.around[v as usize].len() <= 4);
            if few || self.neighbours(c).contains(&d) {
                continue;
            }
            let new = [[a, d, c], [d, b, c]];
            let normals = new.map(|face| self.normal(&face));
            let sliver = new.iter().any(|face| self.least_sine(face) < LEAST_SINE);
            let outward = |n: Vec3, face: &[u32; 3]| {
                face.iter().all(|&v| {
                    let g = self.scene.gradient(self.at(v), STEP * self.target);
                    dot(n, g) > 0.0
                })
            };
            if sliver || !(outward(normals[0], &new[0]) && outward(normals[1], &new[1])) {
                continue;
            }
            self.replace(faces, new, edge, [c, d]);
        }
    }

    /// The sine of a face's smallest angle.
    fn least_sine(&self, face: &[u32; 3]) -> f64 {
        let [a, b, c] = face.map(|v| self.at(v));
        let mut sides = [norm(sub(b, a)), norm(sub(c, b)), norm(sub(a, c))];
        sides.sort_unstable_by(f64::total_cmp);
        norm(double_area(&self.vertices, face)) / (sides[1] * sides[2])
    }

    /// Replaces the two faces at the edge a-b by the two at the other diagonal c-d.
    fn replace(
        &mut self,
        [f, g]: [u32; 2],
        new: [[u32; 3]; 2],
        [a, b]: [u32; 2],
        [c, d]: [u32; 2],
    ) {
        (self.faces[f as usize], self.faces[g as usize]) = (new[0], new[1]);
        self.around[a as usize].retain(|&x| x != g);
        self.around[b as usize].retain(|&x| x != f);
        self.around[c as usize].push(g);
        self.around[d as usize].push(f);
    }

    /// Whether the second edge is the longer one by a margin, so that flips cannot oscillate.
    fn is_longer_than(&self, short: [u32; 2], long: [u32; 2]) -> bool {
        self.length(long) > 1.05 * self.length(short)
    }

    /// Moves every vertex towards the middle of its neighbours, within the surface.
    fn smooth(&mut self) {
        for v in 0..self.vertices.len() as u32 {
            if self.around[v as usize].is_empty() {
                continue;
            }
            let here = self.at(v);
            let near = self.neighbours(v);
            let sum = near
                .iter()
                .fold([0.0; 3], |s, &u| along(s, self.at(u), 1.0));
            let pull = sub(sum.map(|x| x / near.len() as f64), here);
            let gradient = self.scene.gradient(here, STEP * self.target);
            let normal = unit(gradient);
            let tangential = along(pull, normal, -dot(pull, normal));
            let there = self.onto_surface(along(here, tangential, 0.7), gradient);
            let facing = |m: &Self| {
                let faces = m.around[v as usize].iter().map(|&f| &m.faces[f as usize]);
                faces
                    .map(|f| dot(m.normal(f), normal))
                    .fold(f64::INFINITY, f64::min)
            };
            let before = facing(self);
            self.vertices[v as usize] = there;
            if facing(self) < before.min(LEAST_COSINE) {
                self.vertices[v as usize] = here;
            }
        }
    }

    /// The zero set near `p`, by Newton steps along the gradient, each at most half an edge long.
    /// `g` is a gradient from nearby, accurate enough for the first step.
    fn onto_surface(&self, mut p: Vec3, mut g: Vec3) -> Vec3 {
        for i in 0..4 {
            let value = self.scene.value(p);
            if value.abs() < 1e-3 * self.target {
                break;
            }
            if i > 0 {
                g = self.scene.gradient(p, STEP * self.target);
            }
            // Where the gradient almost vanishes (between two parts), its direction is meaningless.
            let slope2 = dot(g, g).max(0.1);
            let limit = 0.5 * self.target / slope2.sqrt();
            p = along(p, g, -(value / slope2).clamp(-limit, limit));
        }
        p
    }

    /// Removes dead faces; vertices keep their order.
    fn compact(self) -> TriMesh {
        let mut index = vec![u32::MAX; self.vertices.len()];
        let mut mesh = TriMesh::default();
        for (v, position) in self.vertices.iter().enumerate() {
            if !self.around[v].is_empty() {
                index[v] = mesh.vertices.len() as u32;
                mesh.vertices.push(*position);
            }
        }
        let living = self.faces.iter().filter(|f| f[0] != f[1]);
        mesh.faces = living.map(|f| f.map(|v| index[v as usize])).collect();
        mesh
    }
}

#[cfg(test)]
mod tests {
    use super::remesh;
    use crate::synth::check;
    use crate::synth::field::Scene;
    use crate::synth::surface::surface;

    #[test]
    fn reaches_the_number_of_faces_with_even_triangles() {
        let mut scene = Scene::default();
        scene
            .limb(0.0, 0.0)
            .cone(0, [0.0; 3], [1.0, 0.0, 0.0], 0.5, 0.3);
        scene
            .limb(0.1, 0.0)
            .cone(0, [0.0; 3], [0.0, 1.0, 0.0], 0.2, 0.1);
        let fine = surface(|p| scene.value(p), scene.seed(), 0.05, 5.0).unwrap();
        for n_faces in [600, 2000, 3001] {
            let mesh = remesh(fine.clone(), &scene, n_faces);
            check::closed_manifold(&mesh);
            assert_eq!(check::euler_characteristic(&mesh), 2);
            assert_eq!(mesh.faces.len(), n_faces / 2 * 2);
            let angle = check::least_angle(&mesh);
            assert!(angle > 15.0, "least angle {angle}");
            for v in &mesh.vertices {
                assert!(
                    scene.value(*v).abs() < 1e-3,
                    "off the surface by {}",
                    scene.value(*v)
                );
            }
        }
    }
}
