//! Turns the contents of a file into a mesh that can be measured: welded, without degenerate or
//! duplicate faces, coherently oriented, centred, of area 1; with a map back and a report.

use super::adjacency::{EdgeFaces, components};
use super::orient::orient;
use super::{
    Bvh, CleanReport, FaceGeometry, ParsedMesh, Search, TriMesh, add, cross, norm, scale, sub,
};

/// A triangle lower than this fraction of its longest edge counts as having no area: the fraction
/// is a few units in the last place of coordinates of the size of the edge.
const MIN_HEIGHT: f64 = 1e-12;
/// Spans within which squares of coordinates neither overflow nor vanish.
const MIN_SPAN: f64 = 1e-140;
const MAX_SPAN: f64 = 1e140;

/// The reason why the triangles of a file form no surface.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[allow(missing_docs)] // the fields are the values of the message
pub enum CleanError {
    #[error("none of the {n_triangles} triangles has any area, but at least 1 must")]
    AllDegenerate { n_triangles: usize },
    #[error(
        "the coordinates span {span}, but only spans from {MIN_SPAN} to {MAX_SPAN} can be measured"
    )]
    Span { span: f64 },
}

/// A mesh that can be measured, with the maps from the parsed mesh to it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Cleaned {
    /// Centred at its area centroid, total area 1, every vertex used, every face with an area.
    pub mesh: TriMesh,
    /// Total area of the kept faces, in squared input units.
    pub area: f64,
    /// Area centroid in input coordinates: `mesh = (input − centroid) · scale`.
    pub centroid: [f64; 3],
    /// `1 / sqrt(area)`.
    pub scale: f64,
    /// For each parsed vertex its vertex in `mesh`; `None` when no kept face uses it.
    pub vertex_of_vertex: Vec<Option<u32>>,
    /// For each parsed triangle its face in `mesh`, or the nearest one.
    pub face_of_triangle: Vec<u32>,
    /// For each polygon the face of its largest triangle, `(n_polygons,)`.
    pub face_of_polygon: Vec<u32>,
    /// For each polygon its share of the area of all polygons, `(n_polygons,)`; sums to 1.
    pub polygon_area: Vec<f64>,
    /// The findings of cleaning; counts of the proxy are 0.
    pub report: CleanReport,
}

/// Makes a parsed mesh measurable: welded, coherently oriented, centred, of area 1. O(n log n).
///
/// Vertices at exactly equal positions become one. Degenerate triangles (two corners equal, or no
/// height) and repeated ones (the same three corners in any order: the first stays) are dropped;
/// each is mapped to the nearest face that stays. Neighbouring faces are reoriented until they
/// agree about the outside.
///
/// ```
/// use coseg_geometry::mesh::{Format, clean, parse};
///
/// // Vertex 4 lies where vertex 0 is, and the third face has no area.
/// let off = "OFF\n5 3 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n0 0 0\n3 0 1 2\n3 4 2 3\n3 1 1 2\n";
/// let cleaned = clean(&parse(off.as_bytes(), Format::Off)?)?;
/// assert_eq!((cleaned.mesh.vertices.len(), cleaned.mesh.faces.len()), (4, 2));
/// assert_eq!(cleaned.report.n_welded_vertices, 1);
/// assert_eq!(cleaned.report.n_degenerate_triangles, 1);
/// assert_eq!(cleaned.vertex_of_vertex[4], cleaned.vertex_of_vertex[0]);
/// assert!((cleaned.area - 1.0).abs() < 1e-12); // of the input, in its units
/// # Ok::<_, Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// If no triangle has any area, or coordinates are too large or too close for their squares to be
/// finite and positive.
pub fn clean(parsed: &ParsedMesh) -> Result<Cleaned, CleanError> {
    let used = used_vertices(parsed);
    let (low, high) = bounds(parsed, &used);
    let span = (0..3).fold(0.0, |s: f64, i| s.max(high[i] - low[i]));
    let n_triangles = parsed.triangles.len();
    if span == 0.0 || n_triangles == 0 {
        return Err(CleanError::AllDegenerate { n_triangles });
    }
    if !(MIN_SPAN..=MAX_SPAN).contains(&span) {
        return Err(CleanError::Span { span });
    }
    // The mesh is measured in the unit box about the origin: a mesh far away loses no digits, and
    // no product of coordinates overflows.
    let middle: [f64; 3] = std::array::from_fn(|i| low[i] + 0.5 * (high[i] - low[i]));
    let local: Vec<[f64; 3]> = parsed
        .vertices
        .iter()
        .map(|&p| scale(sub(p, middle), 1.0 / span))
        .collect();

    let (weld, n_distinct) = weld(parsed, &used);
    let n_used = used.iter().filter(|&&u| u).count();
    let mut report = CleanReport {
        n_polygons: parsed.n_polygons,
        n_triangles,
        n_vertices: parsed.vertices.len(),
        n_welded_vertices: n_used - n_distinct,
        n_isolated_vertices: used.len() - n_used,
        n_concave_polygons: parsed.not_fans.len(),
        n_nonplanar_polygons: parsed.findings.n_nonplanar_polygons,
        n_nonsimple_polygons: parsed.findings.n_nonsimple_polygons,
        n_tolerated_statements: parsed.findings.n_tolerated_statements,
        n_unread_statements: parsed.findings.n_unread_statements,
        ..CleanReport::default()
    };

    let areas: Vec<f64> = parsed.triangles.iter().map(|&t| area(&local, t)).collect();
    let (kept, kept_as) = keep(parsed, &local, &weld, &mut report);
    if kept.is_empty() {
        return Err(CleanError::AllDegenerate { n_triangles });
    }

    let mut vertex_of = vec![u32::MAX; local.len()];
    let mut mesh = TriMesh::default();
    for &t in &kept {
        let corners = parsed.triangles[t as usize].map(|v| weld[v as usize]);
        mesh.faces.push(corners.map(|v| {
            let new = &mut vertex_of[v as usize];
            if *new == u32::MAX {
                *new = mesh.vertices.len() as u32;
                mesh.vertices.push(local[v as usize]);
            }
            *new
        }));
    }

    let edges = EdgeFaces::new(&mesh.faces);
    report.n_flipped_triangles = orient(&mut mesh, &edges);
    report.n_boundary_edges = edges_with(&edges, |n| n == 1);
    report.n_nonmanifold_edges = edges_with(&edges, |n| n > 2);
    report.n_components = components(mesh.faces.len(), &edges).1;

    let (area, center, factor) = normalize(&mut mesh);
    let face_of_triangle = face_of_triangle(parsed, &local, &mesh, center, factor, kept_as);
    let (face_of_polygon, polygon_area) = polygons(parsed, &areas, &face_of_triangle);
    let vertex_of_vertex = used
        .iter()
        .zip(&weld)
        .map(|(&used, &v)| Some(vertex_of[v as usize]).filter(|&new| used && new != u32::MAX))
        .collect();
    Ok(Cleaned {
        mesh,
        area: area * span * span,
        centroid: add(middle, scale(center, span)),
        scale: factor / span,
        vertex_of_vertex,
        face_of_triangle,
        face_of_polygon,
        polygon_area,
        report,
    })
}

/// Moves a mesh to its area centroid and scales it to area 1; returns its original area, its
/// centroid and the factor. The area must not be 0.
pub(super) fn normalize(mesh: &mut TriMesh) -> (f64, [f64; 3], f64) {
    let geometry = FaceGeometry::new(mesh);
    let area: f64 = geometry.areas.iter().sum();
    let weighted = geometry.centroids.iter().zip(&geometry.areas);
    let center = scale(
        weighted.fold([0.0; 3], |sum, (&c, &a)| add(sum, scale(c, a))),
        1.0 / area,
    );
    let factor = 1.0 / area.sqrt();
    for p in &mut mesh.vertices {
        *p = scale(sub(*p, center), factor);
    }
    (area, center, factor)
}

/// Whether a triangle has less height than coordinates can express.
pub(super) fn is_degenerate([a, b, c]: [[f64; 3]; 3], min_height: f64) -> bool {
    let edges = [sub(b, a), sub(c, b), sub(a, c)];
    let longest = edges.iter().map(|&e| norm(e)).fold(0.0, f64::max);
    let doubled = norm(cross(edges[0], edges[1]));
    // An overflow or a NaN makes this condition true, so it counts as degenerate.
    !(doubled > min_height * longest * longest && doubled.is_finite())
}

fn used_vertices(parsed: &ParsedMesh) -> Vec<bool> {
    let mut used = vec![false; parsed.vertices.len()];
    for &v in parsed.triangles.iter().flatten() {
        used[v as usize] = true;
    }
    used
}

fn bounds(parsed: &ParsedMesh, used: &[bool]) -> ([f64; 3], [f64; 3]) {
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for (p, _) in parsed.vertices.iter().zip(used).filter(|(_, u)| **u) {
        low = std::array::from_fn(|i| low[i].min(p[i]));
        high = std::array::from_fn(|i| high[i].max(p[i]));
    }
    (low, high)
}

/// For each used vertex the first one at its position, and the number of positions.
fn weld(parsed: &ParsedMesh, used: &[bool]) -> (Vec<u32>, usize) {
    // Adding zero makes -0 and 0 equal.
    let key = |v: u32| parsed.vertices[v as usize].map(|x| (x + 0.0).to_bits());
    let mut weld: Vec<u32> = (0..used.len() as u32).collect();
    // These words sort fast: a hash of the position, then the vertex.
    let mut order: Vec<u128> = (0..used.len() as u32)
        .filter(|&v| used[v as usize])
        .map(|v| u128::from(mixed(key(v))) << 32 | u128::from(v))
        .collect();
    order.sort_unstable();
    let mut n_distinct = 0;
    for alike in order.chunk_by_mut(|a, b| a >> 32 == b >> 32) {
        let position = |word: u128| key(word as u32);
        let first = position(alike[0]);
        if alike.iter().any(|&word| position(word) != first) {
            alike.sort_unstable_by_key(|&word| (position(word), word));
        }
        for same in alike.chunk_by(|&a, &b| position(a) == position(b)) {
            n_distinct += 1;
            for &word in same {
                weld[word as u32 as usize] = same[0] as u32;
            }
        }
    }
    (weld, n_distinct)
}

/// A hash that is equal for equal positions, and hardly ever for different ones.
fn mixed(position: [u64; 3]) -> u64 {
    // An odd number with half of its bits set, near 2^64 over the golden ratio, as in Fibonacci
    // hashing.
    const FACTOR: u64 = 0x9e37_79b9_7f4a_7c15;
    position.iter().fold(0, |word: u64, x| {
        (word.rotate_left(29) ^ x)
            .wrapping_mul(FACTOR)
            .rotate_left(32)
    })
}

fn area(vertices: &[[f64; 3]], triangle: [u32; 3]) -> f64 {
    let [a, b, c] = triangle.map(|v| vertices[v as usize]);
    0.5 * norm(cross(sub(b, a), sub(c, a)))
}

/// Three corners in any order, packed into a word of 96 bits.
pub(super) fn corner_word(mut corners: [u32; 3]) -> u128 {
    corners.sort_unstable();
    corners
        .iter()
        .fold(0, |word, &v| word << 32 | u128::from(v))
}

/// Triangles that stay, and for each triangle its face or the face that it repeats.
fn keep(
    parsed: &ParsedMesh,
    local: &[[f64; 3]],
    weld: &[u32],
    report: &mut CleanReport,
) -> (Vec<u32>, Vec<Option<u32>>) {
    let n = parsed.triangles.len();
    // Three corners and the triangle packed into one word, which sorts faster than a tuple.
    let mut sound: Vec<u128> = Vec::with_capacity(n);
    for (t, triangle) in parsed.triangles.iter().enumerate() {
        let corners = triangle.map(|v| weld[v as usize]);
        let [a, b, c] = corners;
        let points = corners.map(|v| local[v as usize]);
        if a == b || b == c || c == a || is_degenerate(points, MIN_HEIGHT) {
            report.n_degenerate_triangles += 1;
            continue;
        }
        sound.push(corner_word(corners) << 32 | t as u128);
    }
    sound.sort_unstable();
    let mut first_of: Vec<Option<u32>> = vec![None; n];
    for same in sound.chunk_by(|a, b| a >> 32 == b >> 32) {
        report.n_duplicate_triangles += same.len() - 1;
        for &word in same {
            first_of[word as u32 as usize] = Some(same[0] as u32);
        }
    }
    let mut kept = Vec::new();
    let mut face_of = vec![u32::MAX; n];
    for (t, &first) in first_of.iter().enumerate() {
        if first == Some(t as u32) {
            face_of[t] = kept.len() as u32;
            kept.push(t as u32);
        }
    }
    let kept_as = first_of
        .iter()
        .map(|f| f.map(|t| face_of[t as usize]))
        .collect();
    (kept, kept_as)
}

fn edges_with(edges: &EdgeFaces, wanted: impl Fn(usize) -> bool) -> usize {
    (0..edges.edges.len())
        .filter(|&e| wanted(edges.around(e).len()))
        .count()
}

fn face_of_triangle(
    parsed: &ParsedMesh,
    local: &[[f64; 3]],
    mesh: &TriMesh,
    center: [f64; 3],
    factor: f64,
    kept_as: Vec<Option<u32>>,
) -> Vec<u32> {
    let mut tree = None;
    let mut search = Search::default();
    let mut nearest = |(t, kept): (usize, Option<u32>)| {
        kept.unwrap_or_else(|| {
            let tree = tree.get_or_insert_with(|| Bvh::new(mesh));
            let [a, b, c] = parsed.triangles[t].map(|v| local[v as usize]);
            let middle = scale(add(add(a, b), c), 1.0 / 3.0);
            let point = scale(sub(middle, center), factor);
            tree.nearest(&mut search, point, f64::INFINITY, |_| 0.0)
                .map_or(0, |(face, _)| face)
        })
    };
    kept_as.into_iter().enumerate().map(&mut nearest).collect()
}

/// Face and share of the area of each polygon.
fn polygons(parsed: &ParsedMesh, areas: &[f64], face_of: &[u32]) -> (Vec<u32>, Vec<f64>) {
    let mut faces = vec![0; parsed.n_polygons];
    let mut largest = vec![-1.0; parsed.n_polygons];
    let mut shares = vec![0.0; parsed.n_polygons];
    for (t, &polygon) in parsed.polygon_of_triangle.iter().enumerate() {
        let p = polygon as usize;
        shares[p] += areas[t];
        if areas[t] > largest[p] {
            largest[p] = areas[t];
            faces[p] = face_of[t];
        }
    }
    let total: f64 = shares.iter().sum();
    for share in &mut shares {
        *share /= total;
    }
    (faces, shares)
}

#[cfg(test)]
mod tests {
    use super::{CleanError, clean};
    use crate::mesh::{FaceGeometry, ParsedMesh, TriMesh, distance, norm, zoo};

    const EXACT: f64 = 1e-12;

    fn check(name: &str, parsed: &ParsedMesh) {
        let cleaned = clean(parsed).unwrap_or_else(|e| panic!("{name}: {e}"));
        let mesh = &cleaned.mesh;
        let geometry = FaceGeometry::new(mesh);
        let total: f64 = geometry.areas.iter().sum();
        assert!((total - 1.0).abs() < 1e-9, "{name}: area {total}");
        assert!(geometry.areas.iter().all(|&a| a > 0.0), "{name}");
        for i in 0..3 {
            let c: f64 = geometry
                .centroids
                .iter()
                .zip(&geometry.areas)
                .map(|(c, a)| c[i] * a)
                .sum();
            assert!(c.abs() < 1e-9, "{name}: centre {c}");
        }
        let mut used = vec![false; mesh.vertices.len()];
        for &v in mesh.faces.iter().flatten() {
            used[v as usize] = true;
        }
        assert!(used.iter().all(|&u| u), "{name}: unused vertices");
        let m = mesh.faces.len() as u32;
        assert_eq!(cleaned.face_of_triangle.len(), parsed.triangles.len());
        assert!(cleaned.face_of_triangle.iter().all(|&f| f < m), "{name}");
        assert_eq!(cleaned.face_of_polygon.len(), parsed.n_polygons);
        assert!(
            (cleaned.polygon_area.iter().sum::<f64>() - 1.0).abs() < 1e-9,
            "{name}"
        );
        let r = &cleaned.report;
        assert_eq!(
            r.n_triangles,
            mesh.faces.len() + r.n_degenerate_triangles + r.n_duplicate_triangles,
            "{name}"
        );
        for (v, new) in cleaned.vertex_of_vertex.iter().enumerate() {
            let Some(new) = new else { continue };
            let p = parsed.vertices[v];
            let moved: [f64; 3] =
                std::array::from_fn(|i| (p[i] - cleaned.centroid[i]) * cleaned.scale);
            let far = 1.0 + norm(p) * cleaned.scale;
            assert!(
                distance(moved, mesh.vertices[*new as usize]) < EXACT * far,
                "{name}"
            );
        }
    }

    #[test]
    fn every_mesh_of_the_zoo_becomes_measurable() {
        for (name, parsed) in zoo::dirty_meshes() {
            check(name, &parsed);
        }
    }

    #[test]
    fn each_defect_is_reported_and_no_other() {
        let report = |mesh: &ParsedMesh| clean(mesh).unwrap().report;
        let whole = report(&zoo::parsed(&zoo::sphere(1)));
        assert_eq!(
            (whole.n_triangles, whole.n_vertices, whole.n_components),
            (80, 42, 1)
        );
        assert_eq!(whole.n_boundary_edges + whole.n_nonmanifold_edges, 0);
        assert_eq!(whole.n_welded_vertices + whole.n_isolated_vertices, 0);

        let soup = report(&zoo::soup(&zoo::sphere(1)));
        assert_eq!((soup.n_welded_vertices, soup.n_vertices), (240 - 42, 240));
        assert_eq!((soup.n_boundary_edges, soup.n_components), (0, 1));

        let named = zoo::dirty_meshes();
        let of = |name: &str| {
            report(
                &named
                    .iter()
                    .find(|(n, _)| *n == name)
                    .unwrap_or_else(|| panic!("{name}"))
                    .1,
            )
        };
        assert_eq!(of("degenerate faces").n_degenerate_triangles, 3);
        assert_eq!(of("duplicate faces").n_duplicate_triangles, 2);
        assert_eq!(of("isolated vertices").n_isolated_vertices, 2);
        assert_eq!(of("boundary").n_boundary_edges, 3);
        assert!(of("three faces at an edge").n_nonmanifold_edges > 0);
        assert_eq!(of("two components").n_components, 2);
        assert_eq!(of("touching in a vertex").n_components, 2);
        assert_eq!(of("one face turned over").n_flipped_triangles, 1);
    }

    #[test]
    fn negative_zero_is_zero() {
        let parsed = ParsedMesh {
            vertices: vec![
                [0.0; 3],
                [1.0, 0.0, 0.0],
                [0.0, 1.0, 0.0],
                [-0.0; 3],
                [0.0, -1.0, 0.0],
            ],
            triangles: vec![[0, 1, 2], [1, 3, 4]],
            polygon_of_triangle: vec![0, 1],
            n_polygons: 2,
            ..ParsedMesh::default()
        };
        assert_eq!(clean(&parsed).unwrap().report.n_welded_vertices, 1);
    }

    #[test]
    fn dropped_triangles_map_to_a_face_nearby_and_repeated_ones_to_the_first() {
        let mut parsed = zoo::parsed(&zoo::grid(4, 4));
        let corner = parsed.triangles[20];
        parsed.triangles.push([corner[2], corner[0], corner[1]]);
        parsed.triangles.push([corner[0], corner[0], corner[0]]);
        parsed.polygon_of_triangle.extend([32, 33]);
        parsed.n_polygons = 34;
        let cleaned = clean(&parsed).unwrap();
        assert_eq!(cleaned.face_of_triangle[32], 20);
        let near = cleaned.mesh.faces[cleaned.face_of_triangle[33] as usize];
        let v = cleaned.vertex_of_vertex[corner[0] as usize].unwrap();
        assert!(near.contains(&v));
        assert_eq!(cleaned.polygon_area[33], 0.0);
        assert!((cleaned.polygon_area[32] - 1.0 / 33.0).abs() < EXACT);
    }

    #[test]
    fn scale_and_place_of_the_input_do_not_matter() {
        let sphere = zoo::sphere(2);
        let one = clean(&zoo::parsed(&sphere)).unwrap();
        for (factor, offset) in [(1e100, 0.0), (1e-100, 0.0), (3.0, 1e6)] {
            let moved = TriMesh {
                vertices: sphere
                    .vertices
                    .iter()
                    .map(|p| {
                        [
                            p[0] * factor + offset,
                            p[1] * factor,
                            p[2] * factor - offset,
                        ]
                    })
                    .collect(),
                faces: sphere.faces.clone(),
            };
            let cleaned = clean(&zoo::parsed(&moved)).unwrap();
            assert!((cleaned.area / (one.area * factor * factor) - 1.0).abs() < 1e-8);
            for (a, b) in cleaned.mesh.vertices.iter().zip(&one.mesh.vertices) {
                // At a distance of a million times the size, doubles leave nine digits.
                assert!(distance(*a, *b) < 1e-8, "{a:?} {b:?}");
            }
        }
    }

    #[test]
    fn what_is_no_surface_is_refused_with_its_numbers() {
        let line = ParsedMesh {
            vertices: vec![[0.0; 3], [1.0, 1.0, 1.0], [2.0, 2.0, 2.0]],
            triangles: vec![[0, 1, 2], [0, 0, 1]],
            polygon_of_triangle: vec![0, 1],
            n_polygons: 2,
            ..ParsedMesh::default()
        };
        assert_eq!(
            clean(&line).unwrap_err(),
            CleanError::AllDegenerate { n_triangles: 2 }
        );
        let point = ParsedMesh {
            vertices: vec![[7.0; 3]; 3],
            ..line.clone()
        };
        assert_eq!(
            clean(&point).unwrap_err(),
            CleanError::AllDegenerate { n_triangles: 2 }
        );
        assert!(matches!(
            clean(&zoo::parsed(&zoo::scaled(&zoo::sphere(1), 1e200))),
            Err(CleanError::Span { .. })
        ));
        let huge = ParsedMesh {
            vertices: vec![
                [f64::MAX, 0.0, 0.0],
                [-f64::MAX, 0.0, 0.0],
                [0.0, f64::MAX, 0.0],
            ],
            ..line
        };
        assert!(matches!(clean(&huge), Err(CleanError::Span { .. })));
    }
}
