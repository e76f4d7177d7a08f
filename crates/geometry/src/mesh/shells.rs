//! Removes one of two walls at a small distance from the analysis; the other represents both.
//!
//! Scans and generated meshes often have a thin inner wall: a second surface, of its own component,
//! a little behind the outer one and flipped. Rays cast inward end at it, the spectrum contains
//! everything twice, and the best labelling would only separate the walls. Such a wall is removed
//! before anything is computed, and each of its triangles is mapped to the nearest face of the wall
//! that stays.
//!
//! Two surfaces are walls of one shell if either, seen from nearly everywhere on the other, is the
//! first surface behind it. Close surfaces need not be: a ray into a board that lies on another
//! leaves through its own far side first. A vessel whose walls meet at its rim is one component,
//! and stays unchanged.

use super::adjacency::{EdgeFaces, components};
use super::clean::{Cleaned, normalize};
use super::proxy::compact;
use super::{Bvh, FaceGeometry, Search, TriMesh, add, dot, scale, sub};

/// The largest distance between walls, as a fraction of the diagonal of the whole mesh: twice a
/// hundredth of its size.
const MAX_GAP: f64 = 0.02;
/// The largest distance as a fraction of the diagonal of the outer wall: small pieces have thinner
/// walls.
const MAX_OWN_GAP: f64 = 0.05;
/// The largest distance between copies that are not flipped, as a fraction of the diagonal of the
/// mesh: a component that fits closely into another is not its copy.
const MAX_COPY_GAP: f64 = 0.002;
/// Components with a smaller share of the area are ignored.
const MIN_SHARE: f64 = 1e-3;
/// Least ratio of the areas of the inner and the outer wall; walls of a hundredth reduce thin limbs
/// considerably.
const MIN_AREA_RATIO: f64 = 0.5;
const MAX_AREA_RATIO: f64 = 1.25;
/// Share of the inner wall that must have the outer one behind it, and vice versa.
const MIN_BACKED: f64 = 0.9;
const MIN_COVERED: f64 = 0.7;
/// Number of sample points of a wall.
const N_SAMPLES: usize = 400;
/// Distance in front of a surface at which rays to its copy begin, as a fraction of the gap.
const COPY_START: f64 = 1e-2;
/// Least cosine between the normals of walls.
const MIN_COSINE: f64 = 0.5;

/// A component of a mesh.
struct Wall {
    faces: Vec<u32>,
    area: f64,
    low: [f64; 3],
    high: [f64; 3],
}

/// A component as a mesh of its own, with a search tree.
struct Surface {
    mesh: TriMesh,
    geometry: FaceGeometry,
    tree: Bvh,
}

/// The orientation of a wall relative to the one behind it: flipped, or a copy.
#[derive(Clone, Copy, PartialEq)]
enum Turn {
    Opposite,
    Same,
}

/// The mesh without the walls that have another close by, with the map from triangles and polygons
/// to it. A mesh without such walls stays unchanged. O(m log m) for one with them, else O(m).
///
/// ```
/// use coseg_geometry::mesh::{Format, TriMesh, clean, icosphere, outer_shells, parse, write};
///
/// // A ball with a second wall a hundredth of its radius inside the first, turned inward.
/// let TriMesh { mut vertices, mut faces } = icosphere(3);
/// let n = vertices.len() as u32;
/// vertices.extend(icosphere(3).vertices.iter().map(|p| p.map(|x| 0.99 * x)));
/// faces.extend(icosphere(3).faces.iter().map(|&[a, b, c]| [a + n, c + n, b + n]));
/// let file = write::off(&TriMesh { vertices, faces });
/// let found = outer_shells(clean(&parse(file.as_bytes(), Format::Off)?)?);
/// assert_eq!((found.report.n_inner_walls, found.mesh.faces.len()), (1, 1_280));
/// // The inner triangles have faces of the outer wall.
/// assert!(found.face_of_triangle.iter().all(|f| (*f as usize) < found.mesh.faces.len()));
/// # Ok::<_, Box<dyn std::error::Error>>(())
/// ```
pub fn outer_shells(cleaned: Cleaned) -> Cleaned {
    if cleaned.report.n_components < 2 {
        return cleaned;
    }
    let mesh = &cleaned.mesh;
    let geometry = FaceGeometry::new(mesh);
    let walls = walls(mesh, &geometry);
    let pairs = candidates(&walls);
    if pairs.is_empty() {
        return cleaned;
    }
    let size = diagonal(&walls);
    // For each face the face that represents it.
    let mut stands: Vec<u32> = (0..mesh.faces.len() as u32).collect();
    let mut surfaces: Vec<Option<Surface>> = walls.iter().map(|_| None).collect();
    let mut dropped = vec![false; walls.len()];
    for (outer, inner) in pairs {
        if dropped[outer] || dropped[inner] {
            continue;
        }
        for w in [outer, inner] {
            surfaces[w].get_or_insert_with(|| Surface::new(mesh, &geometry, &walls[w]));
        }
        let (Some(o), Some(i)) = (&surfaces[outer], &surfaces[inner]) else {
            continue;
        };
        let gap = |turn| match turn {
            Turn::Opposite => max_gap(&walls[outer], size),
            Turn::Same => max_gap(&walls[outer], size).min(MAX_COPY_GAP * size),
        };
        let found = [Turn::Opposite, Turn::Same].into_iter().find(|&turn| {
            backed(i, o, gap(turn), turn) >= MIN_BACKED
                && backed(o, i, gap(turn), turn) >= MIN_COVERED
        });
        if let Some(turn) = found {
            dropped[inner] = true;
            let nearest = i.nearest_on(o, gap(turn), turn);
            for (&face, at) in walls[inner].faces.iter().zip(nearest) {
                stands[face as usize] = walls[outer].faces[at as usize];
            }
        }
    }
    if dropped.iter().any(|d| *d) {
        without(cleaned, &stands, &dropped)
    } else {
        cleaned
    }
}

/// The components with a large enough share of the area, largest diagonal first.
fn walls(mesh: &TriMesh, geometry: &FaceGeometry) -> Vec<Wall> {
    let (component, count) = components(mesh.faces.len(), &EdgeFaces::new(&mesh.faces));
    let mut areas = vec![0.0; count];
    for (c, area) in component.iter().zip(&geometry.areas) {
        areas[*c as usize] += area;
    }
    let least = MIN_SHARE * areas.iter().sum::<f64>();
    let mut slot = vec![usize::MAX; count];
    let mut walls: Vec<Wall> = Vec::new();
    for (f, &c) in (0_u32..).zip(&component) {
        let c = c as usize;
        if areas[c] < least {
            continue;
        }
        if slot[c] == usize::MAX {
            slot[c] = walls.len();
            walls.push(Wall {
                faces: Vec::new(),
                area: areas[c],
                low: [f64::INFINITY; 3],
                high: [f64::NEG_INFINITY; 3],
            });
        }
        let wall = &mut walls[slot[c]];
        wall.faces.push(f);
        for p in mesh.corners(f as usize) {
            wall.low = std::array::from_fn(|i| wall.low[i].min(p[i]));
            wall.high = std::array::from_fn(|i| wall.high[i].max(p[i]));
        }
    }
    // The sort is stable: of two equally large walls the first in the file is the outer one.
    walls.sort_by(|a, b| b.diagonal().total_cmp(&a.diagonal()));
    walls
}

impl Wall {
    fn diagonal(&self) -> f64 {
        length(sub(self.high, self.low))
    }
}

fn length(v: [f64; 3]) -> f64 {
    dot(v, v).sqrt()
}

fn diagonal(walls: &[Wall]) -> f64 {
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for wall in walls {
        low = std::array::from_fn(|i| low[i].min(wall.low[i]));
        high = std::array::from_fn(|i| high[i].max(wall.high[i]));
    }
    length(sub(high, low))
}

fn max_gap(outer: &Wall, size: f64) -> f64 {
    (MAX_GAP * size).min(MAX_OWN_GAP * outer.diagonal())
}

/// Pairs of an outer and an inner wall of about the same area and extent.
fn candidates(walls: &[Wall]) -> Vec<(usize, usize)> {
    let size = diagonal(walls);
    let mut pairs = Vec::new();
    for (o, outer) in walls.iter().enumerate() {
        let gap = max_gap(outer, size);
        for (i, inner) in walls.iter().enumerate().skip(o + 1) {
            // They are ordered by their diagonals.
            if outer.diagonal() - inner.diagonal() > 4.0 * gap {
                break;
            }
            let ratio = inner.area / outer.area;
            let near = |a: f64, b: f64| (a - b).abs() <= 2.0 * gap;
            if (MIN_AREA_RATIO..=MAX_AREA_RATIO).contains(&ratio)
                && (0..3).all(|k| near(inner.low[k], outer.low[k]))
                && (0..3).all(|k| near(inner.high[k], outer.high[k]))
            {
                pairs.push((o, i));
            }
        }
    }
    pairs
}

impl Surface {
    fn new(mesh: &TriMesh, geometry: &FaceGeometry, wall: &Wall) -> Self {
        let of = |f: &u32| *f as usize;
        let mut alone = TriMesh {
            vertices: mesh.vertices.clone(),
            faces: wall.faces.iter().map(|f| mesh.faces[of(f)]).collect(),
        };
        compact(&mut alone);
        Self {
            tree: Bvh::new(&alone),
            mesh: alone,
            geometry: FaceGeometry {
                areas: wall.faces.iter().map(|f| geometry.areas[of(f)]).collect(),
                normals: wall.faces.iter().map(|f| geometry.normals[of(f)]).collect(),
                centroids: wall
                    .faces
                    .iter()
                    .map(|f| geometry.centroids[of(f)])
                    .collect(),
            },
        }
    }

    /// Points spread evenly over the area, with their faces; the same in every run.
    fn samples(&self) -> Vec<(u32, [f64; 3])> {
        // Fractions of the powers of the golden ratio and of the plastic number: evenly spread in
        // one and in two dimensions.
        const PLASTIC: [f64; 2] = [0.754_877_666_246_692_7, 0.569_840_290_998_053_2];
        let total: f64 = self.geometry.areas.iter().sum();
        let step = total / N_SAMPLES as f64;
        let (mut samples, mut sum) = (Vec::with_capacity(N_SAMPLES), 0.0);
        for (f, area) in self.geometry.areas.iter().enumerate() {
            sum += area;
            while samples.len() < N_SAMPLES && (samples.len() as f64 + 0.5) * step < sum {
                let n = samples.len() as f64;
                let [mut u, mut v] = PLASTIC.map(|p| (0.5 + n * p).fract());
                if u + v > 1.0 {
                    (u, v) = (1.0 - u, 1.0 - v);
                }
                let [a, b, c] = self.mesh.corners(f);
                let point = add(a, add(scale(sub(b, a), u), scale(sub(c, a), v)));
                samples.push((f as u32, point));
            }
        }
        samples
    }

    /// For each face the nearest face of another surface, for this orientation.
    fn nearest_on(&self, other: &Self, gap: f64, turn: Turn) -> Vec<u32> {
        let mut search = Search::default();
        let faces = self.geometry.centroids.iter().zip(&self.geometry.normals);
        faces
            .map(|(&point, &normal)| {
                let extra =
                    |g: u32| gap * (1.0 - turn.cosine(normal, other.geometry.normals[g as usize]));
                let found = other.tree.nearest(&mut search, point, f64::INFINITY, extra);
                found.map_or(0, |(face, _)| face)
            })
            .collect()
    }
}

impl Turn {
    /// 1 if two normals have this orientation, −1 if they have the opposite one.
    fn cosine(self, a: [f64; 3], b: [f64; 3]) -> f64 {
        match self {
            Self::Opposite => -dot(a, b),
            Self::Same => dot(a, b),
        }
    }
}

/// Share of `from`'s area behind which `to` is the first surface within `gap`, facing the opposite
/// way; for copies the first surface on either side, facing the same way.
fn backed(from: &Surface, to: &Surface, gap: f64, turn: Turn) -> f64 {
    let (mut search, mut own, mut others) = (Search::default(), Vec::new(), Vec::new());
    // A copy may lie in exactly the same position, which a ray that begins there would miss.
    let before = if turn == Turn::Same {
        COPY_START * gap
    } else {
        0.0
    };
    let samples = from.samples();
    let mut is_backed = |&(face, point): &(u32, [f64; 3])| {
        let normal = from.geometry.normals[face as usize];
        let inward = scale(normal, -1.0);
        let directions = match turn {
            Turn::Opposite => &[inward][..],
            Turn::Same => &[inward, normal][..],
        };
        directions.iter().any(|direction| {
            let start = sub(point, scale(*direction, before));
            let ray = [*direction];
            from.tree.cast(&mut search, start, &ray, face, &mut own);
            to.tree
                .cast(&mut search, start, &ray, u32::MAX, &mut others);
            if others[0] >= own[0] || others[0] > gap + before {
                return false;
            }
            let there = add(start, scale(*direction, others[0]));
            let hit = to.tree.nearest(&mut search, there, f64::INFINITY, |_| 0.0);
            hit.is_some_and(|(g, _)| {
                turn.cosine(normal, to.geometry.normals[g as usize]) >= MIN_COSINE
            })
        })
    };
    let n_backed = samples.iter().filter(|sample| is_backed(sample)).count();
    n_backed as f64 / samples.len().max(1) as f64
}

/// Removes the faces that another one represents.
fn without(cleaned: Cleaned, stands: &[u32], dropped: &[bool]) -> Cleaned {
    let stays = |f: &usize| stands[*f] as usize == *f;
    let mut new = vec![u32::MAX; stands.len()];
    let mut mesh = TriMesh {
        vertices: cleaned.mesh.vertices.clone(),
        faces: Vec::new(),
    };
    for f in (0..stands.len()).filter(stays) {
        new[f] = mesh.faces.len() as u32;
        mesh.faces.push(cleaned.mesh.faces[f]);
    }
    let vertices = compact(&mut mesh);
    let (area, center, factor) = normalize(&mut mesh);
    let face = |f: u32| new[stands[f as usize] as usize];
    let mut report = cleaned.report;
    report.n_inner_walls = dropped.iter().filter(|d| **d).count();
    report.n_inner_triangles = stands.len() - mesh.faces.len();
    let on_mesh = |v: u32| Some(vertices[v as usize]).filter(|v| *v != u32::MAX);
    Cleaned {
        mesh,
        area: cleaned.area * area,
        centroid: add(cleaned.centroid, scale(center, 1.0 / cleaned.scale)),
        scale: cleaned.scale * factor,
        vertex_of_vertex: cleaned
            .vertex_of_vertex
            .into_iter()
            .map(|v| v.and_then(on_mesh))
            .collect(),
        face_of_triangle: cleaned.face_of_triangle.into_iter().map(face).collect(),
        face_of_polygon: cleaned.face_of_polygon.into_iter().map(face).collect(),
        polygon_area: cleaned.polygon_area,
        report,
    }
}

#[cfg(test)]
mod tests {
    use super::outer_shells;
    use crate::mesh::refine::refine;
    use crate::mesh::{Cleaned, FaceGeometry, TriMesh, clean, distance, zoo};

    fn cleaned(mesh: &TriMesh) -> Cleaned {
        clean(&zoo::parsed(mesh)).unwrap()
    }

    fn ball(radius: f64) -> TriMesh {
        zoo::scaled(&zoo::sphere(3), radius)
    }

    /// A box of about 1,500 faces.
    fn board(low: [f64; 3], high: [f64; 3]) -> TriMesh {
        let mut mesh = zoo::cube();
        for p in &mut mesh.vertices {
            *p = std::array::from_fn(|k| if p[k] > 0.5 { high[k] } else { low[k] });
        }
        refine(&mut mesh, |_, n| n < 1_500);
        mesh
    }

    /// A vessel, open above, whose walls meet at its rim.
    fn vessel(radius: f64, wall: f64) -> TriMesh {
        let n = 48;
        let profile = [
            [0.0, 0.0],
            [radius, 0.0],
            [radius, 2.0],
            [radius - wall, 2.0],
            [radius - wall, wall],
            [0.0, wall],
        ];
        let mut mesh = TriMesh::default();
        for [r, z] in profile {
            for i in 0..n {
                let (s, c) = (f64::from(i) * std::f64::consts::TAU / f64::from(n)).sin_cos();
                mesh.vertices.push([r * c, r * s, z]);
            }
        }
        for ring in 0..profile.len() as u32 - 1 {
            for i in 0..n {
                let [a, b] = [i, (i + 1) % n].map(|i| ring * n + i);
                mesh.faces.extend([[a, b, b + n], [a, b + n, a + n]]);
            }
        }
        mesh
    }

    #[test]
    fn an_inner_wall_is_left_to_the_outer_one() {
        for gap in [0.001, 0.01, 0.03] {
            for inner_first in [false, true] {
                let outer = ball(1.0);
                let inner = zoo::inside_out(&ball(1.0 - gap));
                let mut parts = [outer.clone(), inner];
                if inner_first {
                    parts.reverse();
                }
                let parsed = zoo::parsed(&zoo::union(&parts));
                let before = clean(&parsed).unwrap();
                let after = outer_shells(before.clone());
                let m = outer.faces.len();
                assert_eq!(
                    (after.report.n_inner_walls, after.report.n_inner_triangles),
                    (1, m)
                );
                assert_eq!(after.report.n_components, 2, "what was found stays");
                assert_eq!(after.mesh.faces.len(), m);
                let single = cleaned(&outer);
                assert!(
                    (after.area / single.area - 1.0).abs() < 1e-9,
                    "{} {}",
                    after.area,
                    single.area
                );
                let total: f64 = FaceGeometry::new(&after.mesh).areas.iter().sum();
                assert!((total - 1.0).abs() < 1e-9);
                // Each polygon maps to the one outside of it; each vertex stays or vanishes.
                for i in 0..m {
                    let [a, b] = [i, i + m].map(|p| after.face_of_polygon[p]);
                    assert_eq!(a, b, "polygon {i}, gap {gap}");
                }
                let kept = after.vertex_of_vertex.iter().flatten().count();
                assert_eq!(kept, outer.vertices.len());
                for (v, new) in after.vertex_of_vertex.iter().enumerate() {
                    let Some(new) = new else { continue };
                    let p = parsed.vertices[v];
                    let moved = std::array::from_fn(|k| (p[k] - after.centroid[k]) * after.scale);
                    assert!(distance(moved, after.mesh.vertices[*new as usize]) < 1e-9);
                }
                let shares: f64 = after.polygon_area.iter().sum();
                assert!((shares - 1.0).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn open_sheets_and_copies_are_walls_too() {
        let sheet = zoo::scaled(&zoo::grid(20, 20), 0.05);
        let below = zoo::moved(&zoo::inside_out(&sheet), [0.0, 0.0, -0.01]);
        let copy = zoo::moved(&sheet, [0.0, 0.0, -0.001]);
        for other in [below, copy, zoo::scaled(&sheet, 1.000_01)] {
            let after = outer_shells(cleaned(&zoo::union(&[sheet.clone(), other])));
            assert_eq!(after.report.n_inner_walls, 1);
            assert_eq!(after.mesh.faces.len(), sheet.faces.len());
        }
        let skins = [ball(1.0), ball(0.999)];
        assert_eq!(
            outer_shells(cleaned(&zoo::union(&skins)))
                .report
                .n_inner_walls,
            1
        );
        // Each piece has a wall of its own.
        let at = |mesh: TriMesh| zoo::moved(&mesh, [3.0, 0.0, 0.0]);
        let walls = [
            ball(1.0),
            at(ball(1.0)),
            zoo::inside_out(&ball(0.99)),
            at(zoo::inside_out(&ball(0.99))),
        ];
        assert_eq!(
            outer_shells(cleaned(&zoo::union(&walls)))
                .report
                .n_inner_walls,
            2
        );
    }

    #[test]
    fn what_is_merely_close_stays() {
        let thin = [
            board([0.0; 3], [1.0, 1.0, 0.005]),
            board([0.0, 0.0, 0.005], [1.0, 1.0, 0.01]),
        ];
        let gap_boards = [
            board([0.0; 3], [1.0, 1.0, 0.02]),
            board([0.0, 0.0, 0.021], [1.0, 1.0, 0.04]),
        ];
        let within = [board([0.0; 3], [1.0; 3]), board([0.005; 3], [0.995; 3])];
        let sheet = zoo::scaled(&zoo::grid(20, 20), 0.05);
        let beside = [
            sheet.clone(),
            zoo::moved(&zoo::inside_out(&sheet), [0.5, 0.0, -0.005]),
        ];
        // Sheets that turn their backs to each other have nothing between them.
        let facing = [
            sheet.clone(),
            zoo::moved(&zoo::inside_out(&sheet), [0.0, 0.0, 0.01]),
        ];
        for (name, parts) in [
            ("a board on another", thin.to_vec()),
            ("two boards with a gap", gap_boards.to_vec()),
            ("a block within a box", within.to_vec()),
            ("a drinking vessel", vec![vessel(1.0, 0.01)]),
            (
                "a vessel within another",
                vec![vessel(1.0, 0.01), vessel(0.985, 0.01)],
            ),
            ("a thick wall", vec![ball(1.0), zoo::inside_out(&ball(0.9))]),
            (
                "a ball in a thick wall",
                vec![ball(1.0), zoo::inside_out(&ball(0.9)), ball(0.89)],
            ),
            (
                "a ball that fits closely into another",
                vec![ball(1.0), ball(0.98)],
            ),
            ("half beside", beside.to_vec()),
            ("sheets that face each other", facing.to_vec()),
        ] {
            let before = cleaned(&zoo::union(&parts));
            let after = outer_shells(before.clone());
            assert_eq!(after, before, "{name}");
        }
        for (name, parsed) in zoo::dirty_meshes() {
            let before = clean(&parsed).unwrap();
            let after = outer_shells(before.clone());
            if name == "coincident components" {
                assert_eq!(after.report.n_inner_walls, 1);
            } else {
                assert_eq!(after, before, "{name}");
            }
        }
    }
}
