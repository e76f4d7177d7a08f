//! Small meshes with known properties.

use crate::mesh::TriMesh;
pub(crate) use crate::mesh::icosphere;
use std::collections::HashMap;

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
