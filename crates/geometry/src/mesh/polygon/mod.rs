//! Triangulates a polygon: by its fan from the first corner if the fan covers it, else by a
//! constrained Delaunay triangulation of its projection onto its own plane.
//!
//! The fan comes first because it is right for a convex polygon, and costs one pass. The Delaunay
//! triangulation keeps every corner, also those on a straight line, which the neighbours of the
//! polygon may share, and makes no slivers there; its predicates are exact. A polygon with a hole,
//! which a bridge joins to the outer ring, is one polygon that passes the bridge twice: its inside
//! is where the winding number is 1. A polygon that crosses itself or has no area keeps its fan,
//! and the result says so.

use super::{cross, dot, norm, sub};
use spade::handles::FixedVertexHandle;
use spade::{ConstrainedDelaunayTriangulation, HasPosition, Point2, Triangulation};
use std::collections::HashMap;
use std::f64::consts::TAU;

/// A polygon whose corners leave its plane by more than this share of its size is not planar. Below
/// it, the choice of triangulation changes the area by less than a thousandth.
const PLANAR: f64 = 0.01;
/// A polygon with less area than this share of its size squared has no plane; cleaning uses the
/// same limit.
const MIN_AREA: f64 = 1e-12;
/// A fan may fold over itself by this share of the area: corners on a line, in files of six digits,
/// do so.
const FOLD: f64 = 1e-6;

/// A corner farther than this from an edge, in units of the polygon's size, does not lie on it.
const ASIDE: f64 = 1e-6;

type Plane = ConstrainedDelaunayTriangulation<Point>;

/// The properties of a polygon.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PolygonKind {
    /// Whether its corners lie in a plane.
    pub planar: bool,
    /// Whether it has an area and does not cross itself. Otherwise its triangles are its fan,
    /// however bad.
    pub simple: bool,
    /// Whether its triangles are its fan from the first corner.
    pub fan: bool,
}

/// Triangulates polygons; its memory is reused for the next polygon.
#[derive(Debug, Default)]
pub struct Triangulator {
    /// Corners relative to the first one, then in the plane of the polygon; in units of its size.
    local: Vec<[f64; 3]>,
    flat: Vec<[f64; 2]>,
}

impl Triangulator {
    /// Writes the triangles of a polygon to `out`: `corners.len() - 2` of them, or one degenerate
    /// triangle if there are fewer than three corners; in the polygon's orientation. The same
    /// positions always give the same triangles.
    ///
    /// O(n log n) for ordinary polygons.
    ///
    /// ```
    /// use coseg_geometry::mesh::Triangulator;
    ///
    /// // A dart: the fan from its first corner would leave it.
    /// let dart = [[2.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 0.0]];
    /// let mut triangles = Vec::new();
    /// let kind = Triangulator::default().triangulate(&dart, &[0, 1, 2, 3], |t| triangles.push(t));
    /// assert_eq!(triangles.len(), 2);
    /// assert!(kind.simple && kind.planar && !kind.fan);
    /// ```
    ///
    /// # Panics
    /// If there are no corners.
    pub fn triangulate(
        &mut self,
        vertices: &[[f64; 3]],
        corners: &[u32],
        mut out: impl FnMut([u32; 3]),
    ) -> PolygonKind {
        let mut kind = PolygonKind {
            planar: true,
            simple: true,
            fan: true,
        };
        if corners.len() > 3 {
            match self.flatten(vertices, corners) {
                None => kind.simple = false,
                Some(planar) => {
                    kind.planar = planar;
                    kind.fan = fan_covers(&self.flat);
                }
            }
        }
        if !kind.fan {
            let at = |t: [usize; 3]| t.map(|c| corners[c]);
            let found = match corners.len() {
                4 => other_diagonal(&self.flat),
                _ => delaunay(&self.flat, &self.local),
            };
            match found {
                Some(triangles) => triangles.into_iter().for_each(|t| out(at(t))),
                None => (kind.simple, kind.fan) = (false, true),
            }
        }
        if kind.fan {
            fan(corners).for_each(out);
        }
        kind
    }

    /// Projects a polygon onto the plane of its Newell normal. Returns whether the polygon lies in
    /// the plane, or `None` if it has no normal.
    fn flatten(&mut self, vertices: &[[f64; 3]], corners: &[u32]) -> Option<bool> {
        let position = |v: u32| vertices[v as usize];
        let first = position(corners[0]);
        self.local.clear();
        self.local
            .extend(corners.iter().map(|&v| sub(position(v), first)));
        let span = self
            .local
            .iter()
            .flatten()
            .fold(0.0, |s: f64, x| s.max(x.abs()));
        if span == 0.0 || !span.is_finite() {
            return None;
        }
        for p in &mut self.local {
            *p = p.map(|x| x / span);
        }
        let mut normal = [0.0; 3];
        for (i, &p) in self.local.iter().enumerate() {
            let next = self.local[(i + 1) % self.local.len()];
            let part = cross(p, next);
            normal = std::array::from_fn(|i| normal[i] + part[i]);
        }
        let doubled = norm(normal);
        if doubled.is_nan() || doubled <= MIN_AREA {
            return None;
        }
        let normal = normal.map(|x| x / doubled);
        // The axis that is farthest from the normal is chosen, so that planes along axes are
        // projected exactly.
        let least = (0..3).fold(0, |l, i| {
            if normal[i].abs() < normal[l].abs() {
                i
            } else {
                l
            }
        });
        let mut axis = [0.0; 3];
        axis[least] = 1.0;
        let v = cross(normal, axis);
        let length = norm(v);
        let v = v.map(|x| x / length);
        let u = cross(v, normal);
        self.flat.clear();
        // Adding zero makes -0 and 0 equal.
        self.flat.extend(
            self.local
                .iter()
                .map(|&p| [dot(p, u) + 0.0, dot(p, v) + 0.0]),
        );
        let extent = |values: &mut dyn Iterator<Item = f64>| {
            let ends = |(low, high): (f64, f64), x: f64| (low.min(x), high.max(x));
            let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), ends);
            high - low
        };
        let height = extent(&mut self.local.iter().map(|&p| dot(p, normal)));
        let width = extent(&mut self.flat.iter().map(|p| p[0]));
        let depth = extent(&mut self.flat.iter().map(|p| p[1]));
        Some(height <= PLANAR * width.hypot(depth))
    }
}

/// The fan of a polygon from its first corner; one degenerate triangle for one or two corners.
fn fan(corners: &[u32]) -> impl Iterator<Item = [u32; 3]> {
    let last = corners.len() - 1;
    (1..=corners.len().saturating_sub(2).max(1))
        .map(move |i| [corners[0], corners[i.min(last)], corners[(i + 1).min(last)]])
}

fn cross_2(a: [f64; 2], b: [f64; 2]) -> f64 {
    a[0] * b[1] - a[1] * b[0]
}

/// Whether the fan from the first corner, at the origin, covers a polygon once: all its triangles
/// have the same orientation, and go around at most once.
fn fan_covers(flat: &[[f64; 2]]) -> bool {
    let away = |p: &&[f64; 2]| **p != [0.0, 0.0];
    let spokes: Vec<&[f64; 2]> = match flat[1..].iter().position(|p| away(&p)) {
        None => return false,
        Some(begin) => {
            let end = flat.iter().rposition(|p| away(&p)).unwrap_or(begin);
            flat[begin + 1..=end].iter().collect()
        }
    };
    // The polygon returns to its first corner: a hole or another lobe begins there.
    if !spokes.iter().all(away) {
        return false;
    }
    let (mut area, mut folded, mut angle) = (0.0, 0.0, 0.0);
    for pair in spokes.windows(2) {
        let (a, b) = (*pair[0], *pair[1]);
        let turned = cross_2(a, b);
        area += turned;
        folded -= turned.min(0.0);
        angle += turned.max(0.0).atan2(a[0] * b[0] + a[1] * b[1]);
    }
    folded <= FOLD * area && angle <= TAU
}

/// The triangles of a quad whose reflex corner faces the diagonal of its fan.
fn other_diagonal(flat: &[[f64; 2]]) -> Option<Vec<[usize; 3]>> {
    let triangles = [[1, 2, 3], [1, 3, 0]];
    let positive = |t: &[usize; 3]| {
        let [a, b, c] = t.map(|i| flat[i]);
        cross_2([b[0] - a[0], b[1] - a[1]], [c[0] - a[0], c[1] - a[1]]) >= 0.0
    };
    triangles.iter().all(positive).then(|| triangles.to_vec())
}

/// The triangles of a polygon that does not cross itself, as indices of its corners.
fn delaunay(flat: &[[f64; 2]], local: &[[f64; 3]]) -> Option<Vec<[usize; 3]>> {
    let (plane, ring) = points(flat, local)?;
    let (plane, passes) = edges(plane, &ring, local)?;
    let passes_of = |from: usize, to: usize| passes.get(&(from, to)).copied().unwrap_or(0);
    // The winding number of each face, computed from the outside inwards.
    let mut winding: Vec<Option<i32>> = vec![None; plane.num_all_faces()];
    winding[plane.outer_face().index()] = Some(0);
    let mut todo: Vec<_> = plane.convex_hull().collect();
    while let Some(edge) = todo.pop() {
        let (Some(here), inner) = (winding[edge.face().index()], edge.rev().face()) else {
            continue;
        };
        if winding[inner.index()].is_some() {
            continue;
        }
        let (from, to) = (edge.from().index(), edge.to().index());
        let there = here + passes_of(to, from) - passes_of(from, to);
        if !(0..=1).contains(&there) {
            return None;
        }
        winding[inner.index()] = Some(there);
        todo.extend(inner.as_inner()?.adjacent_edges());
    }
    let inside = plane
        .inner_faces()
        .filter(|face| winding[face.index()] == Some(1));
    let triangles: Vec<[usize; 3]> = inside
        .map(|face| face.vertices().map(|v| v.data().corner))
        .collect();
    (!triangles.is_empty()).then_some(triangles)
}

/// Corners at the same position in the plane.
struct Point {
    position: Point2<f64>,
    /// The first of these corners.
    corner: usize,
}

impl HasPosition for Point {
    type Scalar = f64;

    fn position(&self) -> Point2<f64> {
        self.position
    }
}

/// The points of a polygon in the plane, and the point of each corner. `None` if corners at
/// different positions fall on one point, as in a polygon that is perpendicular to its own plane.
fn points(flat: &[[f64; 2]], local: &[[f64; 3]]) -> Option<(Plane, Vec<FixedVertexHandle>)> {
    // Coordinates below this have no digits left in predicates; the unit is the size of the
    // polygon.
    let kept = |x: f64| match x.abs() < spade::MIN_ALLOWED_VALUE {
        true => 0.0,
        false => x,
    };
    let place = |corner: usize| flat[corner].map(kept);
    let order = |&a: &usize, &b: &usize| {
        let ([ax, ay], [bx, by]) = (place(a), place(b));
        ax.total_cmp(&bx).then(ay.total_cmp(&by)).then(a.cmp(&b))
    };
    let mut sorted: Vec<usize> = (0..flat.len()).collect();
    sorted.sort_unstable_by(order);
    let mut first_of = vec![0; flat.len()];
    let mut all = Vec::with_capacity(flat.len());
    for same in sorted.chunk_by(|&a, &b| place(a) == place(b)) {
        let corner = same[0];
        for &other in same {
            if local[other] != local[corner] {
                return None;
            }
            first_of[other] = corner;
        }
        let [x, y] = place(corner);
        let position = Point2::new(x, y);
        all.push(Point { position, corner });
    }
    // Loaded in bulk, because inserting them one after the other may take time quadratic in their
    // number.
    let plane = Plane::bulk_load(all).ok()?;
    let mut at = vec![None; flat.len()];
    for vertex in plane.vertices() {
        at[vertex.data().corner] = Some(vertex.fix());
    }
    let ring: Option<Vec<FixedVertexHandle>> = first_of.into_iter().map(|c| at[c]).collect();
    Some((plane, ring?))
}

/// How often the polygon passes along each pair of points. Edges with other corners on them are
/// divided into pieces.
type Passes = HashMap<(usize, usize), i32>;

/// Inserts the polygon's edges into the plane and counts how often each is passed. `None` if two of
/// them cross, or if a corner lies on an edge in the plane but not in space, according to `local`.
fn edges(
    mut plane: Plane,
    ring: &[FixedVertexHandle],
    local: &[[f64; 3]],
) -> Option<(Plane, Passes)> {
    let mut passes = Passes::with_capacity(ring.len());
    for (i, &from) in ring.iter().enumerate() {
        let to = ring[(i + 1) % ring.len()];
        if from == to {
            continue;
        }
        let pieces = plane.try_add_constraint(from, to);
        if pieces.is_empty() {
            return None;
        }
        let place = |vertex: FixedVertexHandle| local[plane.vertex(vertex).data().corner];
        let begin = place(from);
        let along = sub(place(to), begin);
        for piece in pieces {
            let edge = plane.directed_edge(piece);
            let pair = (edge.from().index(), edge.to().index());
            let aside = norm(cross(sub(place(edge.to().fix()), begin), along));
            if aside > ASIDE * norm(along) {
                return None;
            }
            *passes.entry(pair).or_default() += 1;
        }
    }
    Some((plane, passes))
}

#[cfg(test)]
mod tests;
