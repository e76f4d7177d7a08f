use super::{PolygonKind, Triangulator};
use crate::mesh::{add, cross, dot, norm, scale, sub, unit};
use proptest::prelude::{Strategy, any, prop, prop_assert, prop_assert_eq, proptest};
use std::collections::HashMap;

/// Rounding of sums of a few hundred areas in double precision.
const EXACT: f64 = 1e-9;

/// A C with its arms to the right; area 7.
const C: [[f64; 2]; 8] = [
    [0.0, 0.0],
    [3.0, 0.0],
    [3.0, 1.0],
    [1.0, 1.0],
    [1.0, 2.0],
    [3.0, 2.0],
    [3.0, 3.0],
    [0.0, 3.0],
];

/// Triangles of a polygon in the plane z = 0, from any of its corners, with its properties.
fn triangulated(polygon: &[[f64; 2]], start: usize) -> (Vec<[u32; 3]>, PolygonKind) {
    of_vertices(&lifted(polygon), start)
}

fn lifted(polygon: &[[f64; 2]]) -> Vec<[f64; 3]> {
    polygon.iter().map(|p| [p[0], p[1], 0.0]).collect()
}

fn of_vertices(vertices: &[[f64; 3]], start: usize) -> (Vec<[u32; 3]>, PolygonKind) {
    let mut corners: Vec<u32> = (0..vertices.len() as u32).collect();
    corners.rotate_left(start);
    let mut triangles = Vec::new();
    let kind = Triangulator::default().triangulate(vertices, &corners, |t| triangles.push(t));
    (triangles, kind)
}

fn area(vertices: &[[f64; 3]], triangles: &[[u32; 3]]) -> f64 {
    let of = |t: &[u32; 3]| {
        let [a, b, c] = t.map(|v| vertices[v as usize]);
        0.5 * norm(cross(sub(b, a), sub(c, a)))
    };
    triangles.iter().map(of).sum()
}

fn shoelace(polygon: &[[f64; 2]]) -> f64 {
    let n = polygon.len();
    let part = |i: usize| {
        let (a, b) = (polygon[i], polygon[(i + 1) % n]);
        0.5 * (a[0] * b[1] - a[1] * b[0])
    };
    (0..n).map(part).sum()
}

/// The triangles' edges, by positions, without those that two triangles pass in opposite
/// directions. In a correct triangulation exactly the polygon's edges remain.
fn border(edges: impl Iterator<Item = [[f64; 3]; 2]>) -> Vec<[[u64; 3]; 2]> {
    let mut passes: HashMap<[[u64; 3]; 2], i32> = HashMap::new();
    for [a, b] in edges {
        let [a, b] = [a, b].map(|p| p.map(|x| (x + 0.0).to_bits()));
        match passes.get_mut(&[b, a]).filter(|n| **n > 0) {
            Some(n) => *n -= 1,
            None => *passes.entry([a, b]).or_default() += 1,
        }
    }
    let mut left: Vec<_> = passes
        .into_iter()
        .filter(|(_, n)| *n > 0)
        .map(|(edge, _)| edge)
        .collect();
    left.sort_unstable();
    left
}

fn check(vertices: &[[f64; 3]], start: usize, wanted_area: f64) -> Result<(), String> {
    let n = vertices.len();
    let (triangles, kind) = of_vertices(vertices, start);
    let found = area(vertices, &triangles);
    let at = |v: u32| vertices[v as usize];
    let of_triangles = triangles
        .iter()
        .flat_map(|t| [[t[0], t[1]], [t[1], t[2]], [t[2], t[0]]])
        .map(|edge| edge.map(at));
    let of_polygon = (0..n).map(|i| [vertices[i], vertices[(i + 1) % n]]);
    let faults = [
        (
            (found - wanted_area).abs() > EXACT * wanted_area,
            "the area",
        ),
        (triangles.len() != n - 2, "the number of triangles"),
        (!kind.simple || !kind.planar, "the kind"),
        (border(of_triangles) != border(of_polygon), "the border"),
    ];
    match faults.iter().find(|(wrong, _)| *wrong) {
        None => Ok(()),
        Some((_, what)) => Err(format!(
            "from corner {start}, {what}: area {found} for {wanted_area}, {kind:?}, {triangles:?} \
             of {vertices:?}"
        )),
    }
}

/// Checks a polygon from each of its corners, and in a hundred other planes and positions.
fn check_all(name: &str, polygon: &[[f64; 2]]) {
    let wanted = shoelace(polygon);
    assert!(wanted > 0.0, "{name}");
    for start in 0..polygon.len() {
        check(&lifted(polygon), start, wanted).unwrap_or_else(|e| panic!("{name} {e}"));
    }
    for i in 0..100 {
        let i = f64::from(i);
        let size = 10_f64.powf(i / 10.0 - 5.0);
        let placed = placed(polygon, [i.sin(), (2.0 * i).cos(), 0.3], size, [i, 3.0, -i]);
        let start = (7.0 * i) as usize % polygon.len();
        check(&placed, start, wanted * size * size).unwrap_or_else(|e| panic!("{name} {e}"));
    }
}

/// The polygon in the plane with a normal, scaled and then moved by a multiple of its size.
fn placed(polygon: &[[f64; 2]], normal: [f64; 3], size: f64, by: [f64; 3]) -> Vec<[f64; 3]> {
    let normal = unit(normal);
    let u = unit(cross(normal, [0.3, -0.7, 0.9]));
    let v = cross(normal, u);
    let place = |p: &[f64; 2]| scale(add(by, add(scale(u, p[0]), scale(v, p[1]))), size);
    polygon.iter().map(place).collect()
}

/// A comb with teeth upwards: every second corner is reflex or the tip of a tooth.
fn comb(n_teeth: usize) -> Vec<[f64; 2]> {
    let width = 2.0 * n_teeth as f64;
    let mut corners = vec![[0.0, -1.0], [width, -1.0]];
    for tooth in (0..n_teeth).rev() {
        let x = 2.0 * tooth as f64;
        corners.extend([[x + 2.0, 0.5], [x + 1.0, 9.0], [x + 0.5, 0.25]]);
    }
    corners
}

fn star(n_tips: usize) -> Vec<[f64; 2]> {
    let corner = |i: usize| {
        let angle = std::f64::consts::PI * i as f64 / n_tips as f64;
        let radius = if i.is_multiple_of(2) { 2.0 } else { 0.5 };
        [radius * angle.cos(), radius * angle.sin()]
    };
    (0..2 * n_tips).map(corner).collect()
}

/// A band that winds inwards.
fn spiral(n: usize) -> Vec<[f64; 2]> {
    let at = |i: usize, gap: f64| {
        let t = 2.0 * (9.0 + i as f64).sqrt();
        [(20.0 + t - gap) * t.cos(), (20.0 + t - gap) * t.sin()]
    };
    let outer = (0..n).map(|i| at(i, 0.0));
    outer.chain((0..n).rev().map(|i| at(i, 3.0))).collect()
}

/// A square with a square hole, joined by a bridge; a second hole hangs on the first.
fn keyhole() -> Vec<[f64; 2]> {
    vec![
        [0.0, 0.0],
        [1.0, 1.0],
        [1.0, 2.0],
        [3.0, 3.0],
        [3.0, 4.0],
        [4.0, 4.0],
        [4.0, 3.0],
        [3.0, 3.0],
        [2.0, 2.0],
        [2.0, 1.0],
        [1.0, 1.0],
        [0.0, 0.0],
        [6.0, 0.0],
        [6.0, 6.0],
        [0.0, 6.0],
    ]
}

#[test]
fn a_polygon_is_covered_whatever_its_first_corner_and_its_plane() {
    check_all("a C", &C);
    check_all("a comb", &comb(5));
    check_all("a star", &star(5));
    check_all("a spiral", &spiral(20));
    check_all(
        "an arrow",
        &[[0.0, 0.0], [4.0, -1.0], [1.0, 0.0], [4.0, 1.0]],
    );
    // A window in a wall: its corners are shared by the bridge.
    let window = [
        [0.0, 0.0],
        [4.0, 0.0],
        [4.0, 4.0],
        [0.0, 4.0],
        [0.0, 0.0],
        [1.0, 1.0],
        [1.0, 2.0],
        [2.0, 2.0],
        [2.0, 1.0],
        [1.0, 1.0],
    ];
    check_all("a window", &window);
}

#[test]
fn corners_on_a_line_stay_corners() {
    // An L whose sides are divided, like those next to smaller faces.
    let mut l = Vec::new();
    for (from, to) in [
        ([0.0, 0.0], [4.0, 0.0]),
        ([4.0, 0.0], [4.0, 1.0]),
        ([4.0, 1.0], [1.0, 1.0]),
        ([1.0, 1.0], [1.0, 3.0]),
        ([1.0, 3.0], [0.0, 3.0]),
        ([0.0, 3.0], [0.0, 0.0]),
    ] {
        for i in 0..4 {
            let t = f64::from(i) / 4.0;
            let along = |k: usize| from[k] + t * (to[k] - from[k]);
            l.push([along(0), along(1)]);
        }
    }
    check_all("an L", &l);
    let (triangles, _) = triangulated(&l, 5);
    // None of the triangles is flat, so none is dropped and no edge of a neighbour stays open.
    for t in &triangles {
        assert!(area(&lifted(&l), &[*t]) > 1e-3, "{t:?}");
    }
}

#[test]
fn a_convex_polygon_has_its_fan() {
    for n in [3, 4, 5, 8, 100] {
        let corner = |i: usize| {
            let angle = std::f64::consts::TAU * i as f64 / n as f64;
            [angle.cos(), angle.sin()]
        };
        let polygon: Vec<[f64; 2]> = (0..n).map(corner).collect();
        let fan: Vec<[u32; 3]> = (1..n as u32 - 1).map(|i| [0, i, i + 1]).collect();
        let (triangles, kind) = triangulated(&polygon, 0);
        assert_eq!(triangles, fan);
        assert!(kind.fan && kind.simple && kind.planar);
        // From behind, the same corners are a polygon in the opposite order.
        let behind: Vec<[f64; 3]> = polygon.iter().map(|p| [p[1], p[0], 7.0]).collect();
        assert_eq!(of_vertices(&behind, 0).0, fan);
    }
    // Corners on a line, one of them twice, as cleaning expects.
    let bent = [
        [0.0, 0.0],
        [1.0, 0.0],
        [2.0, 0.0],
        [2.0, 0.0],
        [2.0, 2.0],
        [0.0, 1.0],
    ];
    let (triangles, kind) = triangulated(&bent, 0);
    assert_eq!(triangles, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]);
    assert!(kind.fan && kind.simple);
    // A star-shaped polygon whose first corner sees all of it.
    let arrow = [[1.0, 0.0], [4.0, -1.0], [4.0, 1.0], [0.0, 9.0]];
    assert!(triangulated(&arrow, 0).1.fan);
}

#[test]
fn a_concave_quad_has_its_other_diagonal() {
    let arrow = [[0.0, 0.0], [1.0, 0.0], [4.0, -1.0], [4.0, 1.0]];
    let arrow = [arrow[3], arrow[0], arrow[2], arrow[1]];
    let (triangles, kind) = triangulated(&arrow, 0);
    assert_eq!(triangles, [[1, 2, 3], [1, 3, 0]]);
    assert!(!kind.fan && kind.simple);
}

#[test]
fn one_and_two_corners_are_a_degenerate_triangle() {
    assert_eq!(triangulated(&[[0.0, 0.0]], 0).0, [[0, 0, 0]]);
    assert_eq!(triangulated(&[[0.0, 0.0], [1.0, 0.0]], 0).0, [[0, 1, 1]]);
}

#[test]
fn a_keyhole_polygon_is_one_piece() {
    // The first hole takes part of the second one's bridge; areas by hand: 36 - 1 - 1.5.
    let polygon = keyhole();
    let mut reversed = polygon.clone();
    reversed.reverse();
    let polygon = if shoelace(&polygon) > 0.0 {
        polygon
    } else {
        reversed
    };
    for start in 0..polygon.len() {
        let (triangles, kind) = triangulated(&polygon, start);
        assert!(kind.simple, "{start}");
        let found = area(&lifted(&polygon), &triangles);
        assert!(
            (found - shoelace(&polygon)).abs() < EXACT,
            "{start}: {found}"
        );
        // The triangles form one piece: every triangle is reached over edges.
        let mut reached = vec![false; triangles.len()];
        let place = |v: u32| polygon[v as usize].map(f64::to_bits);
        let shared = |a: [u32; 3], b: [u32; 3]| {
            a.iter()
                .filter(|v| b.iter().any(|w| place(**v) == place(*w)))
                .count()
                == 2
        };
        let mut todo = vec![0];
        while let Some(t) = todo.pop() {
            if !std::mem::replace(&mut reached[t], true) {
                todo.extend((0..triangles.len()).filter(|&o| shared(triangles[t], triangles[o])));
            }
        }
        assert!(reached.iter().all(|r| *r), "{start}: {triangles:?}");
    }
}

#[test]
fn what_is_no_simple_polygon_keeps_its_fan_and_is_reported() {
    let square = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
    let around_twice: Vec<[f64; 2]> = square.iter().chain(&square).copied().collect();
    let pentagram: Vec<[f64; 2]> = (0..5)
        .map(|i| f64::from(2 * i) * std::f64::consts::TAU / 5.0)
        .map(|a| [a.cos(), a.sin()])
        .collect();
    for (name, polygon) in [
        (
            "a bow-tie",
            vec![[0.0, 0.0], [2.0, 2.0], [2.0, 0.0], [0.0, 1.0]],
        ),
        (
            "an even bow-tie",
            vec![[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]],
        ),
        (
            "on a line",
            vec![[0.0, 0.0], [1.0, 1.0], [2.0, 2.0], [3.0, 3.0]],
        ),
        ("in a point", vec![[5.0, 5.0]; 6]),
        ("twice around", around_twice),
        ("a pentagram", pentagram),
        (
            "there and back",
            vec![[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [1.0, 0.0]],
        ),
    ] {
        let fan: Vec<[u32; 3]> = (2..polygon.len() as u32).map(|i| [0, i - 1, i]).collect();
        let (triangles, kind) = triangulated(&polygon, 0);
        assert!(!kind.simple && kind.fan, "{name}: {kind:?}");
        assert_eq!(triangles, fan, "{name}");
    }
    // The squares of these numbers overflow.
    let huge = [[-1e308, 0.0], [1e308, 0.0], [1e308, 1e308], [0.0, 1e307]];
    assert!(!triangulated(&huge, 0).1.simple);
    let tiny: Vec<[f64; 2]> = C.iter().map(|p| p.map(|x| x * 1e-310)).collect();
    assert!(triangulated(&tiny, 0).1.simple);
}

#[test]
fn a_polygon_that_leaves_its_plane_is_reported() {
    let bent = |height: f64| {
        let mut vertices = lifted(&C);
        vertices[2][2] = height;
        of_vertices(&vertices, 1)
    };
    assert!(bent(0.01).1.planar);
    let (triangles, kind) = bent(0.5);
    assert!(!kind.planar && kind.simple);
    assert_eq!(triangles.len(), 6);
    // A polygon perpendicular to its own plane has corners above each other.
    let mut step = lifted(&C);
    step[3] = [3.0, 1.0, 5.0];
    assert!(!of_vertices(&step, 0).1.simple);
}

/// Polygons with the largest accepted number of corners are triangulated quickly, whatever their
/// form.
#[test]
fn large_polygons_take_no_long() {
    let n = crate::mesh::MAX_CORNERS;
    let knot: Vec<[f64; 2]> = (0..n)
        .map(|i| (i * 7919 % n) as f64 * std::f64::consts::TAU / n as f64)
        .map(|a| [a.cos(), a.sin()])
        .collect();
    for (name, polygon, simple) in [
        ("comb", comb((n - 2) / 3), true),
        ("star", star(n / 2), true),
        ("spiral", spiral(n / 2), true),
        ("knot", knot, false),
    ] {
        // A method of cubic time would take minutes.
        let (triangles, kind) = triangulated(&polygon, 1);
        assert_eq!(kind.simple, simple, "{name}");
        assert_eq!(triangles.len(), polygon.len() - 2, "{name}");
    }
}

/// Whether two edges of a polygon that have no corner in common meet.
fn cross_each_other(polygon: &[[f64; 2]]) -> bool {
    let n = polygon.len();
    let side = |a: [f64; 2], b: [f64; 2], c: [f64; 2]| {
        (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    };
    let meet = |i: usize, j: usize| {
        let (a, b, c, d) = (
            polygon[i],
            polygon[(i + 1) % n],
            polygon[j],
            polygon[(j + 1) % n],
        );
        side(a, b, c) * side(a, b, d) <= 0.0 && side(c, d, a) * side(c, d, b) <= 0.0
    };
    (0..n).any(|i| (i + 2..n).any(|j| (j + 1) % n != i && meet(i, j)))
}

/// Simple polygons of any form: a triangle whose edges are broken at random points as long as no
/// edges cross.
fn simple_polygon() -> impl Strategy<Value = Vec<[f64; 2]>> {
    let points = prop::collection::vec((0..1000_i32, 0..1000_i32, any::<u16>()), 3..24);
    points.prop_map(|points| {
        let mut polygon: Vec<[f64; 2]> = vec![[-100.0, -200.0], [1400.0, 30.0], [200.0, 1300.0]];
        for (x, y, edge) in points {
            let mut longer = polygon.clone();
            longer.insert(
                1 + usize::from(edge) % polygon.len(),
                [f64::from(x), f64::from(y)],
            );
            if !cross_each_other(&longer) && shoelace(&longer) > 1.0 {
                polygon = longer;
            }
        }
        polygon
    })
}

proptest! {
    #[test]
    fn any_simple_polygon_is_covered(
        polygon in simple_polygon(),
        start in any::<u16>(),
        normal in prop::array::uniform3(-1.0..1.0),
        backwards in any::<bool>(),
    ) {
        let wanted = shoelace(&polygon);
        let start = usize::from(start) % polygon.len();
        let mut flat = lifted(&polygon);
        if backwards {
            flat.reverse();
        }
        prop_assert_eq!(check(&flat, start, wanted), Ok(()));
        if norm(normal) > 0.1 {
            let placed = placed(&polygon, normal, 0.37, [5.0, -700.0, 90.0]);
            prop_assert_eq!(check(&placed, start, wanted * 0.37 * 0.37), Ok(()));
        }
    }

    #[test]
    fn anything_gives_as_many_triangles_as_its_fan(
        vertices in prop::collection::vec(
            prop::array::uniform3((-3..3_i32).prop_map(f64::from)),
            1..12,
        ),
    ) {
        let (triangles, kind) = of_vertices(&vertices, 0);
        let n = vertices.len() as u32;
        prop_assert!(!triangles.is_empty());
        prop_assert!(triangles.iter().flatten().all(|v| *v < n));
        if kind.fan {
            prop_assert_eq!(triangles.len(), vertices.len().saturating_sub(2).max(1));
        }
        // Triangles have the orientation of the polygon: the sum of their normals is its own.
        let sum = |triangles: &[[u32; 3]]| {
            triangles.iter().fold([0.0; 3], |sum, t| {
                let [a, b, c] = t.map(|v| vertices[v as usize]);
                add(sum, cross(sub(b, a), sub(c, a)))
            })
        };
        let fan: Vec<[u32; 3]> = (2..n).map(|i| [0, i - 1, i]).collect();
        let off = sub(sum(&triangles), sum(&fan));
        prop_assert!(dot(off, off) < 1e-12, "{off:?}");
    }
}
