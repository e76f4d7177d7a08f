//! Small meshes with known properties.

use crate::mesh::TriMesh;
use std::collections::HashMap;

/// A sphere of radius 1 with `10 · 4^level + 2` vertices.
pub(crate) fn icosphere(level: u32) -> TriMesh {
    let t = (1.0 + 5.0f64.sqrt()) / 2.0;
    let mut vertices: Vec<[f64; 3]> = vec![
        [-1.0, t, 0.0],
        [1.0, t, 0.0],
        [-1.0, -t, 0.0],
        [1.0, -t, 0.0],
        [0.0, -1.0, t],
        [0.0, 1.0, t],
        [0.0, -1.0, -t],
        [0.0, 1.0, -t],
        [t, 0.0, -1.0],
        [t, 0.0, 1.0],
        [-t, 0.0, -1.0],
        [-t, 0.0, 1.0],
    ];
    let mut faces: Vec<[u32; 3]> = vec![
        [0, 11, 5],
        [0, 5, 1],
        [0, 1, 7],
        [0, 7, 10],
        [0, 10, 11],
        [1, 5, 9],
        [5, 11, 4],
        [11, 10, 2],
        [10, 7, 6],
        [7, 1, 8],
        [3, 9, 4],
        [3, 4, 2],
        [3, 2, 6],
        [3, 6, 8],
        [3, 8, 9],
        [4, 9, 5],
        [2, 4, 11],
        [6, 2, 10],
        [8, 6, 7],
        [9, 8, 1],
    ];
    for _ in 0..level {
        let mut middles: HashMap<[u32; 2], u32> = HashMap::new();
        let mut middle = |a: u32, b: u32| {
            *middles.entry([a.min(b), a.max(b)]).or_insert_with(|| {
                let (p, q) = (vertices[a as usize], vertices[b as usize]);
                vertices.push(std::array::from_fn(|d| 0.5 * (p[d] + q[d])));
                vertices.len() as u32 - 1
            })
        };
        let mut finer = Vec::with_capacity(4 * faces.len());
        for [a, b, c] in faces {
            let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
            finer.extend([[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]);
        }
        faces = finer;
    }
    for p in &mut vertices {
        let r = (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt();
        *p = p.map(|x| x / r);
    }
    TriMesh { vertices, faces }
}

/// A `width × height` rectangle of `(nx + 1) (ny + 1)` vertices; the diagonals alternate.
pub(crate) fn rectangle(width: f64, height: f64, nx: u32, ny: u32) -> TriMesh {
    let mut mesh = TriMesh::default();
    for y in 0..=ny {
        for x in 0..=nx {
            let p = [
                width * f64::from(x) / f64::from(nx),
                height * f64::from(y) / f64::from(ny),
            ];
            mesh.vertices.push([p[0], p[1], 0.0]);
        }
    }
    for y in 0..ny {
        for x in 0..nx {
            let a = y * (nx + 1) + x;
            let (b, c, d) = (a + 1, a + nx + 2, a + nx + 1);
            let split = if (x + y) % 2 == 0 {
                [[a, b, c], [a, c, d]]
            } else {
                [[a, b, d], [b, c, d]]
            };
            mesh.faces.extend(split);
        }
    }
    mesh
}

/// The surface of a unit cube, each side divided into `m × m` squares.
pub(crate) fn cube(m: u32) -> TriMesh {
    let mut mesh = TriMesh::default();
    let mut index: HashMap<[u32; 3], u32> = HashMap::new();
    for axis in 0..3 {
        for end in [0, m] {
            for u in 0..m {
                for v in 0..m {
                    let corners = [[u, v], [u + 1, v], [u + 1, v + 1], [u, v + 1]].map(|[u, v]| {
                        let mut p = [0; 3];
                        p[axis] = end;
                        p[(axis + 1) % 3] = u;
                        p[(axis + 2) % 3] = v;
                        *index.entry(p).or_insert_with(|| {
                            mesh.vertices.push(p.map(|x| f64::from(x) / f64::from(m)));
                            mesh.vertices.len() as u32 - 1
                        })
                    });
                    let [a, b, c, d] = corners;
                    let (front, back) = ([[a, b, c], [a, c, d]], [[a, c, b], [a, d, c]]);
                    mesh.faces.extend(if end == m { front } else { back });
                }
            }
        }
    }
    mesh
}

/// Copies of `mesh` side by side, not connected.
pub(crate) fn copies(mesh: &TriMesh, count: u32) -> TriMesh {
    let mut out = TriMesh::default();
    let n = mesh.vertices.len() as u32;
    for i in 0..count {
        out.vertices.extend(
            mesh.vertices
                .iter()
                .map(|p| [p[0] + 3.0 * f64::from(i), p[1], p[2]]),
        );
        out.faces
            .extend(mesh.faces.iter().map(|f| f.map(|v| v + i * n)));
    }
    out
}

/// A torus with radii 1 and 0.4 whose vertices are displaced along a wave, so that nothing is
/// symmetric.
pub(crate) fn bumpy_torus(n: u32, m: u32) -> TriMesh {
    let mut mesh = TriMesh::default();
    let turn = std::f64::consts::TAU;
    for i in 0..n {
        for j in 0..m {
            let (u, v) = (
                turn * f64::from(i) / f64::from(n),
                turn * f64::from(j) / f64::from(m),
            );
            let r = 0.4 + 0.07 * (3.0 * u + 1.0).sin() * (2.0 * v + 0.3).cos();
            let ring = 1.0 + r * v.cos() + 0.1 * (2.0 * u).sin();
            mesh.vertices
                .push([ring * u.cos(), 0.7 * ring * u.sin(), r * v.sin()]);
            let (i1, j1) = ((i + 1) % n, (j + 1) % m);
            let (a, b, c, d) = (i * m + j, i1 * m + j, i1 * m + j1, i * m + j1);
            mesh.faces.extend([[a, b, c], [a, c, d]]);
        }
    }
    mesh
}
