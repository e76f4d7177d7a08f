//! Connects the components of a mesh by a spanning tree of short virtual edges, so that they form
//! one domain.
//!
//! The tree is found by Borůvka's algorithm over a k-d tree, in which a subtree that lies within
//! one set is skipped (March, Ram and Gray 2010, *Fast Euclidean Minimum Spanning Tree*). The
//! largest set never searches, since every other set finds a neighbour in each round; hence a body
//! with a thousand crumbs costs a thousand short searches.

use super::adjacency::{EdgeFaces, components, join, root};
use super::{Bridge, TriMesh, add, distance, dot, scale, sub};

/// Bridges between a pair of joined components. A single bridge would force all heat between them
/// through one vertex.
const MAX_PER_PAIR: usize = 3;
/// Points in a leaf of the tree.
const LEAF: usize = 8;
const MIXED: u32 = u32::MAX;

/// A vertex as part of a component; a vertex that components share occurs once for each.
#[derive(Debug, Clone, Copy)]
struct Point {
    position: [f64; 3],
    vertex: u32,
    component: u32,
}

struct Node {
    low: [f64; 3],
    high: [f64; 3],
    start: usize,
    end: usize,
    /// Left child, which the right one follows; 0 for a leaf.
    left: usize,
}

/// Points in the order of a k-d tree, so that each node is a range.
struct Tree {
    points: Vec<Point>,
    nodes: Vec<Node>,
}

impl Tree {
    fn new(mut points: Vec<Point>) -> Self {
        let mut nodes: Vec<Node> = Vec::new();
        let mut todo = vec![(0, points.len(), None)];
        while let Some((start, end, parent)) = todo.pop() {
            let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
            for p in &points[start..end] {
                low = std::array::from_fn(|i| low[i].min(p.position[i]));
                high = std::array::from_fn(|i| high[i].max(p.position[i]));
            }
            let here = match parent {
                None => {
                    nodes.push(Node {
                        low,
                        high,
                        start,
                        end,
                        left: 0,
                    });
                    nodes.len() - 1
                }
                Some(slot) => {
                    nodes[slot] = Node {
                        low,
                        high,
                        start,
                        end,
                        left: 0,
                    };
                    slot
                }
            };
            if end - start <= LEAF {
                continue;
            }
            let extent = sub(high, low);
            let axis = (0..3).fold(0, |a, b| if extent[b] > extent[a] { b } else { a });
            let middle = (end - start) / 2;
            points[start..end].select_nth_unstable_by(middle, |a, b| {
                a.position[axis]
                    .total_cmp(&b.position[axis])
                    .then((a.vertex, a.component).cmp(&(b.vertex, b.component)))
            });
            let left = nodes.len();
            nodes[here].left = left;
            for _ in 0..2 {
                nodes.push(Node {
                    low,
                    high,
                    start,
                    end,
                    left: 0,
                });
            }
            todo.push((start, start + middle, Some(left)));
            todo.push((start + middle, end, Some(left + 1)));
        }
        Self { points, nodes }
    }

    /// For each node the set that contains all its points, or `MIXED`.
    fn sets_of_nodes(&self, set: &[u32]) -> Vec<u32> {
        let mut result = vec![MIXED; self.nodes.len()];
        // Children come after their parents.
        for (i, node) in self.nodes.iter().enumerate().rev() {
            result[i] = if node.left > 0 {
                let (a, b) = (result[node.left], result[node.left + 1]);
                if a == b { a } else { MIXED }
            } else {
                let first = set[node.start];
                let same = set[node.start..node.end].iter().all(|&s| s == first);
                if same { first } else { MIXED }
            };
        }
        result
    }

    /// The nearest point to `position` within `limit` for which `wanted(set)` holds; ties go to the
    /// lower index. `wanted` also decides on whole nodes whose points are in one set.
    fn nearest(
        &self,
        position: [f64; 3],
        limit: f64,
        set: &[u32],
        sets_of_nodes: &[u32],
        wanted: impl Fn(u32) -> bool,
    ) -> Option<(f64, usize)> {
        let mut best: Option<(f64, usize)> = None;
        let mut todo = vec![0];
        while let Some(at) = todo.pop() {
            let node = &self.nodes[at];
            let bound = best.map_or(limit, |b| b.0);
            if (sets_of_nodes[at] != MIXED && !wanted(sets_of_nodes[at]))
                || box_distance(node, position) > bound
            {
                continue;
            }
            if node.left == 0 {
                let points = self.points[node.start..node.end].iter();
                for (i, point) in (node.start..).zip(points) {
                    let d = distance(point.position, position);
                    if wanted(set[i]) && d <= limit && best.is_none_or(|b| (d, i) < b) {
                        best = Some((d, i));
                    }
                }
                continue;
            }
            let (a, b) = (node.left, node.left + 1);
            let left_first =
                box_distance(&self.nodes[a], position) <= box_distance(&self.nodes[b], position);
            todo.extend(if left_first { [b, a] } else { [a, b] });
        }
        best
    }
}

fn box_distance(node: &Node, p: [f64; 3]) -> f64 {
    let d: [f64; 3] =
        std::array::from_fn(|i| (node.low[i] - p[i]).max(p[i] - node.high[i]).max(0.0));
    dot(d, d).sqrt()
}

/// Virtual edges that connect all components (faces connected through shared edges); none for one
/// component. There are up to three for each pair that the tree joins: the closest vertices, then
/// others about as close but away from the first. Lengths are in units of the mesh. About O(n log
/// n).
///
/// ```
/// use coseg_geometry::mesh::{TriMesh, bridges, icosphere};
///
/// let mut pair = icosphere(1);
/// let n = pair.vertices.len() as u32;
/// pair.vertices.extend(icosphere(1).vertices.iter().map(|[x, y, z]| [x + 3.0, *y, *z]));
/// pair.faces.extend(icosphere(1).faces.iter().map(|face| face.map(|v| v + n)));
/// // Two spheres of radius 1 whose centres are 3 apart leave a gap of 1.
/// let found = bridges(&pair);
/// assert!((1..=3).contains(&found.len()));
/// assert!(found.iter().all(|b| b.length > 0.99 && b.vertices[0].min(b.vertices[1]) < n));
/// assert!(bridges(&icosphere(1)).is_empty());
/// ```
pub fn bridges(mesh: &TriMesh) -> Vec<Bridge> {
    let edges = EdgeFaces::new(&mesh.faces);
    let (component, count) = components(mesh.faces.len(), &edges);
    if count < 2 {
        return Vec::new();
    }
    let lengths = edges
        .edges
        .iter()
        .map(|&[a, b]| distance(mesh.vertices[a as usize], mesh.vertices[b as usize]));
    let mean_edge = lengths.sum::<f64>() / edges.edges.len() as f64;
    let mut corners: Vec<(u32, u32, u32)> = (0..mesh.faces.len())
        .flat_map(|f| mesh.faces[f].map(|v| (v, component[f], f as u32)))
        .collect();
    corners.sort_unstable();
    let mut points: Vec<Point> = corners
        .iter()
        .map(|&(v, c, _)| Point {
            position: mesh.vertices[v as usize],
            vertex: v,
            component: c,
        })
        .collect();
    points.dedup_by_key(|p| (p.vertex, p.component));
    let tree = Tree::new(points);
    let own: Vec<u32> = tree.points.iter().map(|p| p.component).collect();
    let own_of_nodes = tree.sets_of_nodes(&own);
    let mut points_of = vec![Vec::new(); count];
    for (i, &c) in own.iter().enumerate() {
        points_of[c as usize].push(i);
    }

    let mut result = Vec::new();
    for (i, j) in spanning_tree(&tree, &own, count) {
        let (a, b) = (own[i], own[j]);
        let smaller_first = points_of[a as usize].len() <= points_of[b as usize].len();
        let (near, far) = if smaller_first { (i, j) } else { (j, i) };
        let limit = distance(tree.points[i].position, tree.points[j].position) + mean_edge;
        let candidates: Vec<(usize, usize)> = points_of[own[near] as usize]
            .iter()
            .filter_map(|&p| {
                let position = tree.points[p].position;
                let hit = tree.nearest(position, limit, &own, &own_of_nodes, |s| s == own[far])?;
                Some((p, hit.1))
            })
            .collect();
        for (p, q) in spread(&tree, (near, far), &candidates, mean_edge) {
            result.push(bridge(mesh, &corners, &tree.points[p], &tree.points[q]));
        }
    }
    result
}

/// Pairs of points that join all components, closest first within each round.
fn spanning_tree(tree: &Tree, own: &[u32], count: usize) -> Vec<(usize, usize)> {
    let mut parent: Vec<u32> = (0..count as u32).collect();
    let mut pairs = Vec::with_capacity(count - 1);
    while pairs.len() + 1 < count {
        let set: Vec<u32> = own.iter().map(|&c| root(&mut parent, c)).collect();
        let of_nodes = tree.sets_of_nodes(&set);
        let mut sizes = vec![0_usize; count];
        for &s in &set {
            sizes[s as usize] += 1;
        }
        let largest = (0..count).fold(0, |a, b| if sizes[b] > sizes[a] { b } else { a }) as u32;
        let mut best: Vec<Option<(f64, usize, usize)>> = vec![None; count];
        for (i, &s) in set.iter().enumerate().filter(|(_, s)| **s != largest) {
            let limit = best[s as usize].map_or(f64::INFINITY, |b| b.0);
            let position = tree.points[i].position;
            if let Some((d, j)) = tree.nearest(position, limit, &set, &of_nodes, |t| t != s)
                && best[s as usize].is_none_or(|b| (d, i, j) < b)
            {
                best[s as usize] = Some((d, i, j));
            }
        }
        let mut found: Vec<(f64, usize, usize)> = best.into_iter().flatten().collect();
        found.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        for (_, i, j) in found {
            if join(&mut parent, own[i], own[j]) {
                pairs.push((i, j));
            }
        }
    }
    pairs
}

/// The first pair, and those candidates that are farthest from all chosen so far.
fn spread(
    tree: &Tree,
    first: (usize, usize),
    candidates: &[(usize, usize)],
    min_apart: f64,
) -> Vec<(usize, usize)> {
    let at = |i: usize| tree.points[i].position;
    let mut chosen = vec![first];
    while chosen.len() < MAX_PER_PAIR {
        let from_chosen = |&(p, _): &(usize, usize)| {
            chosen
                .iter()
                .map(|c| distance(at(c.0), at(p)))
                .fold(f64::INFINITY, f64::min)
        };
        let farthest = candidates
            .iter()
            .map(|c| (from_chosen(c), *c))
            .fold((0.0, first), |a, b| if b.0 > a.0 { b } else { a });
        if farthest.0 <= min_apart {
            break;
        }
        chosen.push(farthest.1);
    }
    chosen
}

fn bridge(mesh: &TriMesh, corners: &[(u32, u32, u32)], p: &Point, q: &Point) -> Bridge {
    let face = |from: &Point, to: &Point| {
        let begin = corners.partition_point(|&(v, c, _)| (v, c) < (from.vertex, from.component));
        let faces = corners[begin..]
            .iter()
            .take_while(|&&(v, c, _)| (v, c) == (from.vertex, from.component))
            .map(|&(_, _, f)| {
                let [a, b, c] = mesh.corners(f as usize);
                (
                    distance(scale(add(add(a, b), c), 1.0 / 3.0), to.position),
                    f,
                )
            });
        faces
            .fold((f64::INFINITY, 0), |a, b| if b.0 < a.0 { b } else { a })
            .1
    };
    Bridge {
        vertices: [p.vertex, q.vertex],
        faces: [face(p, q), face(q, p)],
        length: distance(p.position, q.position),
    }
}

#[cfg(test)]
mod tests {
    use super::bridges;
    use crate::mesh::adjacency::{EdgeFaces, components, join};
    use crate::mesh::{TriMesh, distance, zoo};

    fn connects(mesh: &TriMesh) -> bool {
        let (component, count) = components(mesh.faces.len(), &EdgeFaces::new(&mesh.faces));
        let mut parent: Vec<u32> = (0..count as u32).collect();
        let mut joined = 1;
        for b in bridges(mesh) {
            let [f, g] = b.faces.map(|f| component[f as usize]);
            joined += usize::from(join(&mut parent, f, g));
        }
        joined == count
    }

    #[test]
    fn on_the_zoo_they_connect_everything_and_lie_on_their_faces() {
        for (name, mesh) in zoo::clean_meshes() {
            assert!(connects(&mesh), "{name}");
            for b in bridges(&mesh) {
                for side in 0..2 {
                    assert!(
                        mesh.faces[b.faces[side] as usize].contains(&b.vertices[side]),
                        "{name}"
                    );
                }
                let [p, q] = b.vertices.map(|v| mesh.vertices[v as usize]);
                assert_eq!(b.length, distance(p, q), "{name}");
            }
        }
    }

    #[test]
    fn one_component_needs_none() {
        assert_eq!(bridges(&zoo::sphere(2)), []);
    }

    #[test]
    fn they_are_the_shortest_and_apart() {
        // Two sheets face each other at distance 0.5, so every point is closest.
        let mesh = zoo::union(&[
            zoo::grid(6, 6),
            zoo::moved(&zoo::grid(6, 6), [0.0, 0.0, 0.5]),
        ]);
        let found = bridges(&mesh);
        assert_eq!(found.len(), 3);
        for (i, a) in found.iter().enumerate() {
            assert_eq!(a.length, 0.5);
            for b in &found[..i] {
                let [p, q] = [a, b].map(|x| mesh.vertices[x.vertices[0] as usize]);
                assert!(distance(p, q) > 3.0);
            }
        }
    }

    #[test]
    fn touching_components_are_bridged_in_their_common_vertex() {
        let named = zoo::clean_meshes();
        let (_, mesh) = named
            .iter()
            .find(|(n, _)| *n == "touching in a vertex")
            .unwrap();
        let found = bridges(mesh);
        assert_eq!(found[0].length, 0.0);
        assert_eq!(found[0].vertices[0], found[0].vertices[1]);
        assert_ne!(found[0].faces[0], found[0].faces[1]);
    }

    #[test]
    fn a_chain_is_joined_link_by_link() {
        let balls: Vec<TriMesh> = (0..30)
            .map(|i| zoo::moved(&zoo::sphere(1), [3.0 * f64::from(i), 0.0, 0.0]))
            .collect();
        let mesh = zoo::union(&balls);
        assert!(connects(&mesh));
        assert!(
            bridges(&mesh).iter().all(|b| b.length < 2.0),
            "no link is skipped"
        );
    }
}
