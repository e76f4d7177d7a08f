//! Small meshes with one defect each, for testing every algorithm.

use super::{ParsedMesh, TriMesh, add, clean, scale};

pub(crate) use super::icosphere::icosphere as sphere;

/// Unit cube, two triangles for each side.
pub(crate) fn cube() -> TriMesh {
    let vertices = (0..8)
        .map(|i| [i & 1, i >> 1 & 1, i >> 2].map(f64::from))
        .collect();
    let quads = [
        [0, 2, 3, 1],
        [4, 5, 7, 6],
        [0, 1, 5, 4],
        [2, 6, 7, 3],
        [0, 4, 6, 2],
        [1, 3, 7, 5],
    ];
    let faces = quads
        .iter()
        .flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]])
        .collect();
    TriMesh { vertices, faces }
}

/// Flat sheet of `2 nx ny` triangles in the xy plane, normals up.
pub(crate) fn grid(nx: u32, ny: u32) -> TriMesh {
    let vertices = (0..=ny)
        .flat_map(|y| (0..=nx).map(move |x| [f64::from(x), f64::from(y), 0.0]))
        .collect();
    let at = |x: u32, y: u32| y * (nx + 1) + x;
    let faces = (0..ny)
        .flat_map(|y| (0..nx).map(move |x| (x, y)))
        .flat_map(|(x, y)| {
            let [a, b, c, d] = [at(x, y), at(x + 1, y), at(x + 1, y + 1), at(x, y + 1)];
            [[a, b, c], [a, c, d]]
        })
        .collect();
    TriMesh { vertices, faces }
}

/// Closed plate of size 1 × 1 × 0.001, finely divided.
pub(crate) fn thin_plate() -> TriMesh {
    let n = 12;
    let mut top = grid(n, n);
    for p in &mut top.vertices {
        *p = [p[0] / f64::from(n), p[1] / f64::from(n), 0.0005];
    }
    let mut bottom = inside_out(&top);
    for p in &mut bottom.vertices {
        p[2] = -0.0005;
    }
    let k = top.vertices.len() as u32;
    let mut plate = union(&[top, bottom]);
    let rim = |x: u32, y: u32| y * (n + 1) + x;
    let path: Vec<u32> = (0..n)
        .map(|i| rim(i, 0))
        .chain((0..n).map(|i| rim(n, i)))
        .chain((0..n).map(|i| rim(n - i, n)))
        .chain((0..n).map(|i| rim(0, n - i)))
        .collect();
    for (i, &a) in path.iter().enumerate() {
        let b = path[(i + 1) % path.len()];
        plate.faces.extend([[a, a + k, b + k], [a, b + k, b]]);
    }
    plate
}

/// One-sided strip of `2 n` triangles.
pub(crate) fn moebius(n: u32) -> TriMesh {
    let vertices = (0..n)
        .flat_map(|i| {
            let angle = std::f64::consts::TAU * f64::from(i) / f64::from(n);
            [-0.3, 0.3].map(|w| {
                let r = 1.0 + w * (angle / 2.0).cos();
                [r * angle.cos(), r * angle.sin(), w * (angle / 2.0).sin()]
            })
        })
        .collect();
    let faces = (0..n)
        .flat_map(|i| {
            let (a, b) = (2 * i, 2 * i + 1);
            // The last strip closes with a twist.
            let (c, d) = if i + 1 == n { (1, 0) } else { (a + 2, b + 2) };
            [[a, c, b], [b, c, d]]
        })
        .collect();
    TriMesh { vertices, faces }
}

/// Two spheres joined by a thin cylinder along x: a shape with parts. About `50 n` faces.
pub(crate) fn dumbbell(n: u32) -> TriMesh {
    let rings = 3 * n;
    let radius = |t: f64| -> f64 {
        let ball = |c: f64| (0.45_f64.powi(2) - (t - c).powi(2)).max(0.0).sqrt();
        ball(-1.05)
            .max(ball(1.05))
            .max(if t.abs() < 1.2 { 0.12 } else { 0.0 })
    };
    let mut mesh = TriMesh::default();
    mesh.vertices.push([-1.5, 0.0, 0.0]);
    for i in 1..rings {
        let x = -1.5 + 3.0 * f64::from(i) / f64::from(rings);
        for j in 0..n {
            let angle = std::f64::consts::TAU * f64::from(j) / f64::from(n);
            mesh.vertices
                .push([x, radius(x) * angle.cos(), radius(x) * angle.sin()]);
        }
    }
    let last = mesh.vertices.len() as u32;
    mesh.vertices.push([1.5, 0.0, 0.0]);
    let at = |i: u32, j: u32| 1 + (i - 1) * n + j % n;
    for j in 0..n {
        mesh.faces.push([0, at(1, j + 1), at(1, j)]);
        mesh.faces
            .push([last, at(rings - 1, j), at(rings - 1, j + 1)]);
        for i in 1..rings - 1 {
            mesh.faces.push([at(i, j), at(i, j + 1), at(i + 1, j)]);
            mesh.faces
                .push([at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)]);
        }
    }
    mesh
}

/// Flips every face.
pub(crate) fn inside_out(mesh: &TriMesh) -> TriMesh {
    let faces = mesh.faces.iter().map(|&[a, b, c]| [a, c, b]).collect();
    TriMesh {
        vertices: mesh.vertices.clone(),
        faces,
    }
}

/// Multiplies coordinates by a factor.
pub(crate) fn scaled(mesh: &TriMesh, factor: f64) -> TriMesh {
    let vertices = mesh.vertices.iter().map(|&p| scale(p, factor)).collect();
    TriMesh {
        vertices,
        faces: mesh.faces.clone(),
    }
}

/// Adds an offset to coordinates.
pub(crate) fn moved(mesh: &TriMesh, offset: [f64; 3]) -> TriMesh {
    let vertices = mesh.vertices.iter().map(|&p| add(p, offset)).collect();
    TriMesh {
        vertices,
        faces: mesh.faces.clone(),
    }
}

/// Turns the mesh about an oblique axis.
pub(crate) fn rotated(mesh: &TriMesh) -> TriMesh {
    let (s, c) = 0.7_f64.sin_cos();
    let (t, d) = 1.9_f64.sin_cos();
    let vertices = mesh
        .vertices
        .iter()
        .map(|&[x, y, z]| {
            let (x, y) = (c * x - s * y, s * x + c * y);
            [x, d * y - t * z, t * y + d * z]
        })
        .collect();
    TriMesh {
        vertices,
        faces: mesh.faces.clone(),
    }
}

/// Reorders vertices, faces and corners; returns for each new face the old one.
pub(crate) fn renumbered(mesh: &TriMesh) -> (TriMesh, Vec<usize>) {
    // A step coprime to the count visits everything once.
    let shuffle = |n: usize| -> Vec<usize> {
        let step = (n / 3..).find(|&s| s > 0 && gcd(s, n) == 1).unwrap_or(1);
        (0..n).map(|i| (i * step + n / 2) % n).collect()
    };
    let (vertices, faces) = (shuffle(mesh.vertices.len()), shuffle(mesh.faces.len()));
    let mut new = vec![0; vertices.len()];
    for (i, &old) in vertices.iter().enumerate() {
        new[old] = i as u32;
    }
    let renamed = faces.iter().map(|&f| {
        let [a, b, c] = mesh.faces[f].map(|v| new[v as usize]);
        [b, c, a]
    });
    let mesh = TriMesh {
        vertices: vertices.iter().map(|&v| mesh.vertices[v]).collect(),
        faces: renamed.collect(),
    };
    (mesh, faces)
}

fn gcd(a: usize, b: usize) -> usize {
    if b == 0 { a } else { gcd(b, a % b) }
}

/// Meshes side by side in one list, unchanged.
pub(crate) fn union(meshes: &[TriMesh]) -> TriMesh {
    let mut all = TriMesh::default();
    for mesh in meshes {
        let k = all.vertices.len() as u32;
        all.vertices.extend_from_slice(&mesh.vertices);
        all.faces
            .extend(mesh.faces.iter().map(|f| f.map(|v| v + k)));
    }
    all
}

/// Triangles as polygons of a file.
pub(crate) fn parsed(mesh: &TriMesh) -> ParsedMesh {
    let n = mesh.faces.len();
    ParsedMesh {
        vertices: mesh.vertices.clone(),
        triangles: mesh.faces.clone(),
        polygon_of_triangle: (0..n as u32).collect(),
        n_polygons: n,
        ..ParsedMesh::default()
    }
}

/// Gives every triangle vertices of its own.
pub(crate) fn soup(mesh: &TriMesh) -> ParsedMesh {
    let vertices = (0..mesh.faces.len())
        .flat_map(|f| mesh.corners(f))
        .collect();
    let faces = (0..mesh.faces.len() as u32)
        .map(|f| [3 * f, 3 * f + 1, 3 * f + 2])
        .collect();
    parsed(&TriMesh { vertices, faces })
}

/// The zoo: names of defects, each with a mesh.
pub(crate) fn dirty_meshes() -> Vec<(&'static str, ParsedMesh)> {
    let ball = sphere(2);
    let with = |change: &dyn Fn(&mut TriMesh)| {
        let mut mesh = ball.clone();
        change(&mut mesh);
        parsed(&mesh)
    };
    let tetrahedron = TriMesh {
        vertices: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        faces: vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]],
    };
    let triangle = TriMesh {
        faces: vec![[0, 1, 2]],
        ..tetrahedron.clone()
    };
    let crumbs: Vec<TriMesh> = (0..40)
        .map(|i| moved(&scaled(&tetrahedron, 0.02), [2.0, 0.1 * f64::from(i), 0.0]))
        .collect();
    vec![
        ("one triangle", parsed(&triangle)),
        ("tetrahedron", parsed(&tetrahedron)),
        ("cube", parsed(&cube())),
        ("whole", parsed(&ball)),
        ("dumbbell", parsed(&dumbbell(14))),
        ("soup", soup(&ball)),
        ("flat sheet", parsed(&grid(9, 5))),
        ("thin plate", parsed(&thin_plate())),
        ("boundary", with(&|m| m.faces.truncate(319))),
        ("inside out", parsed(&inside_out(&ball))),
        ("one face turned over", with(&|m| m.faces[9].swap(0, 1))),
        ("moebius strip", parsed(&moebius(30))),
        (
            "degenerate faces",
            with(&|m| m.faces.extend([[0, 0, 1], [4, 4, 4], [9, 8, 9]])),
        ),
        (
            "duplicate faces",
            with(&|m| {
                m.faces
                    .extend([m.faces[3], [m.faces[5][1], m.faces[5][0], m.faces[5][2]]])
            }),
        ),
        (
            "isolated vertices",
            with(&|m| m.vertices.extend([[9.0; 3], [f64::NAN, 0.0, 0.0]])),
        ),
        (
            "three faces at an edge",
            with(&|m| {
                m.vertices.push([0.0, 0.0, 3.0]);
                let [a, b, _] = m.faces[0];
                m.faces.push([a, b, m.vertices.len() as u32 - 1]);
            }),
        ),
        (
            "sliver",
            with(&|m| {
                let [a, b, c] = m.faces[0];
                let close = scale(
                    add(
                        scale(m.vertices[a as usize], 1.0 - 1e-7),
                        scale(m.vertices[b as usize], 1e-7),
                    ),
                    1.0,
                );
                m.vertices.push(close);
                let v = m.vertices.len() as u32 - 1;
                m.faces[0] = [v, b, c];
                m.faces.push([a, v, c]);
            }),
        ),
        (
            "two components",
            parsed(&union(&[ball.clone(), moved(&ball, [3.0, 0.0, 0.0])])),
        ),
        (
            "coincident components",
            parsed(&union(&[ball.clone(), scaled(&ball, 1.0 + 1e-9)])),
        ),
        ("crumbs", parsed(&union(&[ball.clone(), union(&crumbs)]))),
        (
            "touching in a vertex",
            parsed(&union(&[tetrahedron.clone(), scaled(&tetrahedron, -1.0)])),
        ),
        ("far away", parsed(&moved(&ball, [1e7, -1e7, 0.0]))),
        ("huge", parsed(&scaled(&ball, 1e90))),
        ("tiny", parsed(&scaled(&ball, 1e-90))),
        (
            "uneven",
            parsed(&union(&[
                sphere(4),
                moved(&scaled(&cube(), 5.0), [1.0, 0.0, 0.0]),
            ])),
        ),
    ]
}

/// The zoo after cleaning.
pub(crate) fn clean_meshes() -> Vec<(&'static str, TriMesh)> {
    dirty_meshes()
        .into_iter()
        .map(|(name, parsed)| {
            (
                name,
                clean(&parsed)
                    .unwrap_or_else(|e| panic!("{name}: {e}"))
                    .mesh,
            )
        })
        .collect()
}
