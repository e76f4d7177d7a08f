//! Measures pairs of meshes of which one lacks a part, or has an additional component or handle.
//! They are derived from meshes with known correspondence.

use crate::error::BenchError;
use crate::maps::{Meshed, Score, load_mesh, meshed, numbers, scored};
use coseg::fmap::{EstimateOptions, PointMap};
use coseg::mesh::{EdgeGraph, FaceGeometry, TriMesh};
use std::path::PathBuf;

/// Share of the area that is cut off, and of the added component.
const SHARE: f64 = 0.1;

/// The change of one of the shapes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Change {
    /// An extremity of the first shape is cut off.
    Cut,
    /// A sphere is added beside the second shape.
    Component,
    /// A handle is added to the second shape.
    Handle,
}

impl Change {
    pub(crate) const ALL: [(Self, &'static str); 3] = [
        (Self::Cut, "a part of the first cut away"),
        (Self::Component, "a component more"),
        (Self::Handle, "a handle more"),
    ];
}

/// Numbers of vertices, over all maps: without counterpart, reported as such, and both; and all.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Masked {
    pub(crate) missing: usize,
    pub(crate) reported: usize,
    pub(crate) found: usize,
    pub(crate) all: usize,
}

impl Masked {
    /// Precision and recall of reporting vertices without counterpart, and the share of reported
    /// vertices.
    pub(crate) fn figures(&self) -> [f64; 3] {
        let share = |a: usize, b: usize| a as f64 / b.max(1) as f64;
        [
            share(self.found, self.reported),
            share(self.found, self.missing),
            share(self.reported, self.all),
        ]
    }
}

/// Errors on the common parts of both shapes, and the accuracy of reporting the other parts.
pub(crate) fn bench(
    files: &[PathBuf],
    change: Change,
    stride: usize,
    options: &EstimateOptions,
) -> Result<(Vec<Score>, Masked), BenchError> {
    let n = files.len();
    let (mut scores, mut masked) = (Vec::new(), Masked::default());
    let pairs = (0..n).flat_map(|i| (0..n).filter(move |j| *j != i).map(move |j| (i, j)));
    for (i, j) in pairs.step_by(stride) {
        let points = |at: usize| numbers(&files[at].with_extension("vts"), 1);
        let mirrored = |at: usize| {
            let path = files[at].with_extension("sym.vts");
            path.exists().then(|| numbers(&path, 1)).transpose()
        };
        let (mut at_1, mut at_2) = (points(i)?, points(j)?);
        let mut turned = mirrored(j)?.unwrap_or_default();
        let (whole_1, whole_2) = (load_mesh(&files[i])?, load_mesh(&files[j])?);
        // For each vertex of the second shape whether it lacks a counterpart, if that is known.
        let mut missing: Vec<Option<bool>> = vec![None; whole_2.vertices.len()];
        at_2.iter().for_each(|v| missing[*v as usize] = Some(false));
        let (one, two): (Meshed, Meshed) = match change {
            Change::Cut => {
                let (cut, kept) = cut(&whole_1);
                let left: Vec<bool> = at_1.iter().map(|v| kept[*v as usize].is_some()).collect();
                for (v, left) in at_2.iter().zip(&left) {
                    missing[*v as usize] = Some(!left);
                }
                at_1 = at_1.iter().filter_map(|v| kept[*v as usize]).collect();
                let only = |at: Vec<u32>| -> Vec<u32> {
                    let at = at.into_iter().zip(&left).filter(|x| *x.1);
                    at.map(|(v, _)| v).collect()
                };
                (at_2, turned) = (only(at_2), only(turned));
                (meshed(cut)?, meshed(whole_2)?)
            }
            Change::Component => {
                let more = with_sphere(&whole_2);
                missing.resize(more.vertices.len(), Some(true));
                (meshed(whole_1)?, meshed(more)?)
            }
            Change::Handle => (meshed(whole_1)?, meshed(with_handle(&whole_2))?),
        };
        let (a, b) = (one.shape(options), two.shape(options));
        let (known_1, known_2) = (one.known(at_1, Vec::new()), two.known(at_2, turned));
        let (score, map) = scored((&a, &known_1), (&b, &known_2), options);
        scores.push(score);
        count(&mut masked, &map, &missing);
    }
    Ok((scores, masked))
}

fn count(masked: &mut Masked, map: &PointMap, missing: &[Option<bool>]) {
    for (matched, missing) in map.matched.iter().zip(missing) {
        let Some(missing) = missing else { continue };
        masked.all += 1;
        masked.missing += usize::from(*missing);
        masked.reported += usize::from(!matched);
        masked.found += usize::from(*missing && !matched);
    }
}

/// The mesh without the vertices around the one that is farthest from the rest, and the new number
/// of each vertex.
fn cut(mesh: &TriMesh) -> (TriMesh, Vec<Option<u32>>) {
    let graph = EdgeGraph::new(mesh, &[]);
    let farthest = |from: u32| {
        let d = graph.dijkstra(from);
        (0..d.len())
            .max_by(|&a, &b| d[a].total_cmp(&d[b]))
            .unwrap_or(0) as u32
    };
    let distance = graph.dijkstra(farthest(0));
    let mut order: Vec<usize> = (0..distance.len()).collect();
    order.sort_by(|&a, &b| distance[a].total_cmp(&distance[b]));
    let mut area = vec![0.0; distance.len()];
    for (face, share) in mesh.faces.iter().zip(FaceGeometry::new(mesh).areas) {
        face.iter().for_each(|v| area[*v as usize] += share / 3.0);
    }
    let limit = SHARE * area.iter().sum::<f64>();
    let mut gone = vec![false; distance.len()];
    let mut sum = 0.0;
    for v in order {
        sum += area[v];
        if sum > limit {
            break;
        }
        gone[v] = true;
    }
    let faces = mesh
        .faces
        .iter()
        .filter(|f| f.iter().all(|v| !gone[*v as usize]));
    let faces: Vec<[u32; 3]> = faces.copied().collect();
    let mut number = vec![None; gone.len()];
    let mut vertices = Vec::new();
    for v in faces.iter().flatten() {
        let number = &mut number[*v as usize];
        if number.is_none() {
            *number = Some(vertices.len() as u32);
            vertices.push(mesh.vertices[*v as usize]);
        }
    }
    let renumbered = |v: u32| number[v as usize].unwrap_or_default();
    let cut = TriMesh {
        faces: faces.iter().map(|f| f.map(renumbered)).collect(),
        vertices,
    };
    (cut, number)
}

/// The mesh with a sphere beside it.
fn with_sphere(mesh: &TriMesh) -> TriMesh {
    const RINGS: usize = 12;
    let total: f64 = FaceGeometry::new(mesh).areas.iter().sum();
    let radius = (SHARE * total / (4.0 * std::f64::consts::PI)).sqrt();
    let top = mesh
        .vertices
        .iter()
        .map(|v| v[0])
        .fold(f64::NEG_INFINITY, f64::max);
    let centre = [top + 1.2 * radius, 0.0, 0.0];
    let mut more = mesh.clone();
    let first = more.vertices.len() as u32;
    let around = 2 * RINGS;
    let mut place = |polar: f64, turn: f64| {
        let p = [
            polar.sin() * turn.cos(),
            polar.sin() * turn.sin(),
            polar.cos(),
        ];
        more.vertices
            .push(std::array::from_fn(|i| centre[i] + radius * p[i]));
    };
    place(0.0, 0.0);
    place(std::f64::consts::PI, 0.0);
    for i in 1..RINGS {
        for j in 0..around {
            let angle = std::f64::consts::PI / RINGS as f64;
            place(i as f64 * angle, j as f64 * angle);
        }
    }
    let at = |i: usize, j: usize| first + (2 + (i - 1) * around + j % around) as u32;
    for j in 0..around {
        more.faces.push([first, at(1, j), at(1, j + 1)]);
        more.faces
            .push([first + 1, at(RINGS - 1, j + 1), at(RINGS - 1, j)]);
        for i in 1..RINGS - 1 {
            more.faces.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
            more.faces.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
        }
    }
    more
}

/// The mesh with a tube, three faces wide, between two distant triangles.
fn with_handle(mesh: &TriMesh) -> TriMesh {
    let graph = EdgeGraph::new(mesh, &[]);
    let distance = graph.dijkstra(0);
    let far = (0..distance.len()).max_by(|&a, &b| distance[a].total_cmp(&distance[b]));
    let near = |v: u32| mesh.faces.iter().position(|f| f.contains(&v)).unwrap_or(0);
    let (a, b) = (near(0), near(far.unwrap_or(0) as u32));
    let ([p, q, r], [s, t, u]) = (mesh.faces[a], mesh.faces[b]);
    let faces = mesh.faces.iter().enumerate();
    let mut faces: Vec<[u32; 3]> = faces
        .filter(|(f, _)| *f != a && *f != b)
        .map(|x| *x.1)
        .collect();
    // Seen along the tube, the second triangle has the opposite orientation.
    for [(x, y), (z, w)] in [[(p, q), (s, u)], [(q, r), (u, t)], [(r, p), (t, s)]] {
        faces.push([x, y, z]);
        faces.push([y, w, z]);
    }
    TriMesh {
        vertices: mesh.vertices.clone(),
        faces,
    }
}
