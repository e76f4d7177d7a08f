use super::{InputMesh, InputMeshError, SiteMap};
use crate::describe::describe_parsed;
use crate::description::{Description, Params};
use crate::mesh::{ParsedMesh, TriMesh, refine, zoo};

const WORKING_FACES: u32 = 500;

fn described(parsed: &ParsedMesh) -> (Description, InputMesh) {
    let params = Params {
        working_faces: WORKING_FACES,
        n_eigenpairs: 20,
        ..Params::default()
    };
    let description = describe_parsed(parsed, &params, &|_| true).unwrap();
    let input = InputMesh::new(parsed, &description.view(), WORKING_FACES).unwrap();
    (description, input)
}

/// An ellipsoid with three different axes, away from the origin.
fn ellipsoid(rounds: u32) -> ParsedMesh {
    let mut mesh = zoo::sphere(rounds);
    for p in &mut mesh.vertices {
        *p = [100.0 + 3.0 * p[0], 2.0 * p[1], p[2]];
    }
    zoo::parsed(&mesh)
}

fn identity(d: &Description) -> (Vec<u32>, Vec<bool>) {
    let n = d.vertices.len();
    ((0..n as u32).collect(), vec![true; n])
}

#[test]
fn constants_stay_and_linear_functions_nearly_do() {
    for rounds in [2, 4] {
        let parsed = ellipsoid(rounds);
        let (d, input) = described(&parsed);
        let x: Vec<f32> = d.vertices.iter().flat_map(|v| [1.0, v[0]]).collect();
        for sites in [&input.vertices, &input.polygons] {
            let found = sites.interpolate(&d.faces, &x, 2);
            assert_eq!(found.len(), 2 * sites.len());
            assert!(found.chunks(2).all(|row| (row[0] - 1.0).abs() < 1e-6));
        }
        let at = input.vertices.interpolate(&d.faces, &x, 2);
        let scale = 1.0 / d.area.sqrt();
        for (row, p) in at.chunks(2).zip(&parsed.vertices) {
            let exact = (p[0] - 100.0) * scale;
            assert!((f64::from(row[1]) - exact).abs() < 0.03, "{row:?} {exact}");
        }
        let total: f32 = input.vertex_mass.iter().sum();
        assert!((total - 1.0).abs() < 1e-4);
    }
}

#[test]
fn a_vertex_that_the_proxy_keeps_has_its_value() {
    let parsed = ellipsoid(4);
    let (d, input) = described(&parsed);
    assert!(d.vertices.len() < 300);
    let values: Vec<f32> = (0..d.vertices.len()).map(|v| (v as f32).sin()).collect();
    let found = input.vertices.interpolate(&d.faces, &values, 1);
    let points = input.vertices.points(&d.view());
    let mut kept = 0;
    for (proxy, value) in d.vertices.iter().zip(&values) {
        // Simplification keeps vertices where they are.
        let site = points.iter().position(|p| p == proxy).unwrap();
        assert_eq!(found[site], *value);
        kept += 1;
    }
    assert_eq!(kept, d.vertices.len());
}

#[test]
fn the_identity_of_proxies_is_that_of_the_vertices_and_polygons() {
    let (d, input) = described(&ellipsoid(4));
    let view = d.view();
    let (p2p, matched) = identity(&d);
    for sites in [&input.vertices, &input.polygons] {
        let map = SiteMap::new((sites, &view), (sites, &view), &p2p, &matched);
        let right = map
            .p2p_21
            .iter()
            .enumerate()
            .filter(|(i, s)| *i == **s as usize);
        // Others are located at the same point, on an edge of the proxy.
        assert!(right.count() as f64 > 0.98 * sites.len() as f64);
        assert!(map.matched.iter().all(|m| *m));
    }
    let map = SiteMap::new(
        (&input.vertices, &view),
        (&input.vertices, &view),
        &p2p,
        &matched,
    );
    let f: Vec<f32> = (0..input.vertices.len()).map(|v| v as f32).collect();
    let moved = map.interpolate(&input, &view, &f, 1);
    let exact = moved.iter().zip(&f).filter(|(a, b)| a == b);
    assert!(exact.count() as f64 > 0.98 * f.len() as f64);
}

#[test]
fn functions_go_between_a_coarse_and_a_fine_mesh() {
    let (coarse, fine) = (ellipsoid(1), ellipsoid(4));
    let ((d1, one), (d2, two)) = (described(&coarse), described(&fine));
    let nearest = |v: &[f32; 3]| {
        let to = |w: &[f32; 3]| (0..3).map(|i| (v[i] - w[i]).powi(2)).sum::<f32>();
        (0..d1.vertices.len())
            .min_by(|&a, &b| to(&d1.vertices[a]).total_cmp(&to(&d1.vertices[b])))
            .unwrap() as u32
    };
    let p2p: Vec<u32> = d2.vertices.iter().map(nearest).collect();
    let mut matched = vec![true; p2p.len()];
    let views = (d1.view(), d2.view());
    let map = |matched: &[bool]| {
        SiteMap::new(
            (&one.vertices, &views.0),
            (&two.vertices, &views.1),
            &p2p,
            matched,
        )
    };
    let all = map(&matched);
    assert_eq!(all.p2p_21.len(), fine.vertices.len());
    assert!(
        all.p2p_21
            .iter()
            .all(|v| (*v as usize) < coarse.vertices.len())
    );
    let f: Vec<f32> = coarse
        .vertices
        .iter()
        .flat_map(|p| [1.0, p[0] as f32])
        .collect();
    let moved = all.interpolate(&one, &views.0, &f, 2);
    let mut error = 0.0;
    for (row, p) in moved.chunks(2).zip(&fine.vertices) {
        assert!((row[0] - 1.0).abs() < 1e-6);
        error += (f64::from(row[1]) - p[0]).abs() / fine.vertices.len() as f64;
    }
    // Of a length of 6; the coarse mesh has 42 vertices.
    assert!(error < 0.2, "{error}");
    matched.fill(false);
    let none = map(&matched);
    assert!(
        none.interpolate(&one, &views.0, &f, 2)
            .iter()
            .all(|x| x.is_nan())
    );
    assert!(none.pull(&f, -1.0).iter().all(|x| *x == -1.0));
}

#[test]
fn vertices_without_a_face_have_no_location() {
    let mut parsed = ellipsoid(2);
    parsed.vertices.push([0.0; 3]);
    let (d, input) = described(&parsed);
    let last = parsed.vertices.len() - 1;
    assert!(!input.vertices.has_location(last) && input.vertices.has_location(0));
    assert_eq!(input.vertices.proxy_vertex(&d.faces, last), None);
    let ones = vec![1.0; d.vertices.len()];
    assert!(input.vertices.interpolate(&d.faces, &ones, 1)[last].is_nan());
    let (view, (p2p, matched)) = (d.view(), identity(&d));
    let sites = (&input.vertices, &view);
    let map = SiteMap::new(sites, sites, &p2p, &matched);
    assert_eq!((map.p2p_21[last], map.matched[last]), (0, false));
}

#[test]
fn the_sides_of_a_thin_plate_stay_apart() {
    let mut plate = zoo::thin_plate();
    refine(&mut plate, |_, n| n < 6_000);
    let parsed = zoo::parsed(&plate);
    let (d, input) = described(&parsed);
    let up: Vec<f32> = d.vertices.iter().map(|v| v[2].signum()).collect();
    let found = input.polygons.interpolate(&d.faces, &up, 1);
    let bounds = |axis: usize| {
        let values = parsed.vertices.iter().map(|p| p[axis]);
        values.fold((f64::MAX, f64::MIN), |(a, b), x| (a.min(x), b.max(x)))
    };
    let (low, high) = bounds(2);
    // Around the rim the nearest proxy face may reach over it.
    let inside = |t: &[u32; 3], axis: usize| {
        let ((from, to), at) = (bounds(axis), parsed.vertices[t[0] as usize][axis]);
        (at - from).min(to - at) > 0.15 * (to - from)
    };
    let mut n_checked = 0;
    for (x, t) in found.iter().zip(&parsed.triangles) {
        let z = t.map(|v| parsed.vertices[v as usize][2]);
        if inside(t, 0) && inside(t, 1) && (z == [low; 3] || z == [high; 3]) {
            let side = if z[0] == low { -1.0 } else { 1.0 };
            assert!(x * side > 0.0, "{x} at {side}");
            n_checked += 1;
        }
    }
    assert!(n_checked > 1_000, "{n_checked}");
}

#[test]
fn triangles_without_common_vertices_are_interpolated_as_joined_ones() {
    let joined = ellipsoid(3);
    let soup = TriMesh {
        vertices: joined
            .triangles
            .iter()
            .flat_map(|t| t.map(|v| joined.vertices[v as usize]))
            .collect(),
        faces: (0..joined.triangles.len() as u32)
            .map(|t| [3 * t, 3 * t + 1, 3 * t + 2])
            .collect(),
    };
    let parsed = zoo::parsed(&soup);
    let (d, input) = described(&parsed);
    let (view, (p2p, matched)) = (d.view(), identity(&d));
    let sites = (&input.vertices, &view);
    let map = SiteMap::new(sites, sites, &p2p, &matched);
    let f: Vec<f32> = parsed.vertices.iter().map(|p| p[0] as f32).collect();
    for (found, exact) in map.interpolate(&input, &view, &f, 1).iter().zip(&f) {
        assert!((found - exact).abs() < 1e-3);
    }
}

#[test]
fn another_mesh_is_refused() {
    let (d, _) = described(&ellipsoid(3));
    let refused = |parsed: &ParsedMesh| InputMesh::new(parsed, &d.view(), WORKING_FACES);
    let other = refused(&ellipsoid(2));
    let Err(InputMeshError::Polygons {
        found: 320,
        described: 1_280,
    }) = other
    else {
        panic!("{other:?}");
    };
    let mut moved = ellipsoid(3);
    moved.vertices[5][0] += 0.5;
    assert!(matches!(refused(&moved), Err(InputMeshError::Proxy)));
}
