use super::{BATCH, GeodesicError, HeatGeodesics};
use crate::mesh::{EdgeGraph, TriMesh, icosphere, zoo};
use crate::operators::LaplacianError;

fn from(mesh: &TriMesh, source: u32) -> Vec<f64> {
    let solver = HeatGeodesics::new(mesh, 1.0).expect("the mesh has a Laplacian");
    solver.distances(&[source]).expect("heat arrives")
}

/// Mean and greatest difference, in units of the greatest distance.
fn differences(found: &[f64], exact: &[f64]) -> (f64, f64) {
    let far = exact.iter().fold(0.0, |m: f64, d| m.max(*d));
    let off = found.iter().zip(exact).map(|(f, e)| (f - e).abs() / far);
    let (total, worst) = off.fold((0.0, 0.0), |(t, w): (f64, f64), d| (t + d, w.max(d)));
    (total / exact.len() as f64, worst)
}

fn around_sphere(mesh: &TriMesh, source: usize) -> Vec<f64> {
    let p = mesh.vertices[source];
    let angle = |q: &[f64; 3]| {
        (p[0] * q[0] + p[1] * q[1] + p[2] * q[2])
            .clamp(-1.0, 1.0)
            .acos()
    };
    mesh.vertices.iter().map(angle).collect()
}

/// What the paper reports for its meshes is around 1 % at this resolution.
const MEAN: f64 = 0.01;

#[test]
fn on_a_sphere_they_are_angles_and_finer_meshes_are_closer() {
    let mut before = f64::INFINITY;
    for levels in [2, 3, 4, 5] {
        let mesh = icosphere(levels);
        let (mean, worst) = differences(&from(&mesh, 7), &around_sphere(&mesh, 7));
        assert!(mean < before, "{levels}: {mean}");
        before = mean;
        if levels >= 4 {
            assert!(
                mean < MEAN && worst < 3.0 * MEAN,
                "{levels}: {mean}, {worst}"
            );
        }
    }
}

#[test]
fn on_a_plane_they_are_lengths_of_straight_lines() {
    let n = 60;
    let mesh = zoo::grid(n, n);
    for source in [0, n / 2 * (n + 1) + n / 2] {
        let [x, y, _] = mesh.vertices[source as usize];
        let straight = |q: &[f64; 3]| (q[0] - x).hypot(q[1] - y);
        let exact: Vec<f64> = mesh.vertices.iter().map(straight).collect();
        let (mean, worst) = differences(&from(&mesh, source), &exact);
        assert!(
            mean < MEAN && worst < 3.0 * MEAN,
            "{source}: {mean}, {worst}"
        );
        // Paths along edges are not that straight.
        let (along, _) = differences(&EdgeGraph::new(&mesh, &[]).dijkstra(source), &exact);
        assert!(mean < 0.5 * along, "{source}: {mean}, along edges {along}");
    }
}

#[test]
fn on_the_zoo_they_are_near_the_paths_along_edges() {
    for (name, mesh) in zoo::clean_meshes() {
        let graph = EdgeGraph::new(&mesh, &[]);
        for source in [0, mesh.vertices.len() as u32 / 2] {
            let along = graph.dijkstra(source);
            let found = from(&mesh, source);
            assert_eq!(found[source as usize], 0.0, "{name}");
            let far = along
                .iter()
                .filter(|d| d.is_finite())
                .fold(0.0, |m: f64, d| m.max(*d));
            for (v, (f, e)) in found.iter().zip(&along).enumerate() {
                assert_eq!(f.is_finite(), e.is_finite(), "{name}: {v}");
                // No shortcut through space, and no detour; both are coarse on small meshes.
                let is_near =
                    !f.is_finite() || (*f <= e + 0.25 * far && *f >= 0.5 * e - 0.25 * far);
                assert!(
                    is_near,
                    "{name}: vertex {v} is {f} from {source}, along edges {e}"
                );
            }
        }
    }
}

#[test]
fn sources_do_not_depend_on_their_company() {
    let mesh = icosphere(2);
    let solver = HeatGeodesics::new(&mesh, 1.0).expect("a sphere has a Laplacian");
    let sources: Vec<u32> = (0..2 * BATCH as u32 + 3).map(|i| 5 * i).collect();
    let all = solver.distances(&sources).expect("heat arrives");
    let n = mesh.vertices.len();
    assert_eq!(all.len(), sources.len() * n);
    for (row, &source) in all.chunks_exact(n).zip(&sources) {
        assert_eq!(row, solver.distances(&[source]).expect("heat arrives"));
    }
    assert!(
        solver
            .distances(&[])
            .expect("nothing is no error")
            .is_empty()
    );
}

#[test]
fn other_components_are_out_of_reach() {
    let mesh = zoo::union(&[zoo::sphere(1), zoo::moved(&zoo::sphere(1), [4.0, 0.0, 0.0])]);
    let solver = HeatGeodesics::new(&mesh, 1.0).expect("two spheres have a Laplacian");
    let found = solver.distances(&[0, 50]).expect("heat arrives");
    let (first, second) = found.split_at(84);
    assert!(
        first[..42].iter().all(|d| d.is_finite())
            && first[42..].iter().all(|d| *d == f64::INFINITY)
    );
    assert!(
        second[..42].iter().all(|d| *d == f64::INFINITY)
            && second[42..].iter().all(|d| d.is_finite())
    );
    let alone = from(&zoo::sphere(1), 0);
    for (a, b) in first.iter().zip(&alone) {
        assert!((a - b).abs() < 1e-9);
    }
}

#[test]
fn a_mesh_that_is_too_long_is_refused_and_more_time_helps() {
    // Far more edges than e^n fits into a double.
    let mesh = zoo::grid(3000, 1);
    let error = HeatGeodesics::new(&mesh, 1.0)
        .expect("a strip has a Laplacian")
        .distances(&[0])
        .expect_err("no heat arrives at the far end");
    assert!(
        matches!(
            error,
            GeodesicError::OutOfReach {
                source_vertex: 0,
                time: 1.0,
                ..
            }
        ),
        "{error}"
    );
    assert!(
        error.to_string().ends_with("give a time of 4 or more"),
        "{error}"
    );
    let found = HeatGeodesics::new(&mesh, 16.0)
        .expect("a strip has a Laplacian")
        .distances(&[0])
        .expect("heat arrives");
    assert!((found[3000] / 3000.0 - 1.0).abs() < MEAN, "{}", found[3000]);
}

#[test]
fn what_has_no_distances_says_why() {
    let mesh = icosphere(1);
    for time in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let error = HeatGeodesics::new(&mesh, time).expect_err("not a time");
        assert!(matches!(error, GeodesicError::Time { .. }), "{error}");
    }
    let solver = HeatGeodesics::new(&mesh, 1.0).expect("a sphere has a Laplacian");
    let error = solver
        .distances(&[0, 42])
        .expect_err("there are 42 vertices");
    assert_eq!(
        error,
        GeodesicError::Source {
            vertex: 42,
            n_vertices: 42
        }
    );
    let mut open = mesh;
    open.vertices.push([9.0, 0.0, 0.0]);
    let error = HeatGeodesics::new(&open, 1.0).expect_err("a vertex has no face");
    let wanted = LaplacianError::Unreferenced { vertex: 42 };
    assert_eq!(error, GeodesicError::Laplacian(wanted));
}
