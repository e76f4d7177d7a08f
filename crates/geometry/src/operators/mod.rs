//! Discrete Laplacians: `W φ = λ A φ` with stiffness W positive semidefinite and lumped mass A.

mod cotan;
mod mesh_laplace;
mod tufted;

use crate::mesh::{Bridge, TriMesh};
pub(crate) use tufted::IntrinsicFace;

/// The kinds of discrete Laplacians.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Operator {
    /// Intrinsic Delaunay on the tufted cover with mollification (Sharp and Crane 2020).
    #[default]
    Tufted,
    /// Plain cotangent stiffness with barycentric (1/3 area) lumped mass.
    Cotan,
    /// Mesh Laplacian of Belkin, Sun and Wang 2008, the source paper's eq. (6).
    MeshLaplace,
}

/// A discrete Laplacian: the operator is `A⁻¹ W`.
#[derive(Debug, Clone, PartialEq)]
pub struct Laplacian {
    /// W `(n, n)`: symmetric positive semidefinite, both triangles stored, rows sum to zero.
    pub stiffness: sprs::CsMat<f64>,
    /// Diagonal of A `(n,)`: positive; sums to the surface area.
    pub mass: Vec<f64>,
}

/// Why a mesh has no Laplacian.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum LaplacianError {
    /// The mesh has no face.
    #[error("the mesh has {n_vertices} vertices but no face")]
    Empty {
        /// Vertices of the mesh.
        n_vertices: usize,
    },
    /// A coordinate is not finite.
    #[error("coordinate {axis} of vertex {vertex} is {value}, but must be finite")]
    NonFinite {
        /// Index of the vertex.
        vertex: usize,
        /// 0, 1 or 2.
        axis: usize,
        /// The coordinate.
        value: f64,
    },
    /// A face names a vertex that does not exist.
    #[error("face {face} names vertex {vertex}, but the mesh has {n_vertices}")]
    OutOfRange {
        /// Index of the face.
        face: usize,
        /// The vertex that it names.
        vertex: u32,
        /// Vertices of the mesh.
        n_vertices: usize,
    },
    /// A face names a vertex twice.
    #[error("face {face} names vertex {vertex} more than once, but needs three different corners")]
    RepeatedCorner {
        /// Index of the face.
        face: usize,
        /// Index of the vertex.
        vertex: u32,
    },
    /// A vertex without a face would have no mass.
    #[error("vertex {vertex} belongs to no face, but each needs at least one")]
    Unreferenced {
        /// Index of the vertex.
        vertex: usize,
    },
    /// A face with zero area has no cotangents.
    #[error("face {face} has area {area}, but this operator needs a positive one; use tufted")]
    DegenerateFace {
        /// Index of the face.
        face: usize,
        /// Its area.
        area: f64,
    },
    /// A vertex whose mass is not a positive number.
    #[error("the mass of vertex {vertex} is {mass}, but must be positive and finite")]
    Mass {
        /// Index of the vertex.
        vertex: usize,
        /// Its mass.
        mass: f64,
    },
    /// A weight is not finite.
    #[error("the weight between vertices {vertices:?} is {weight}, but must be finite")]
    Weight {
        /// The vertices that it joins.
        vertices: [u32; 2],
        /// The weight.
        weight: f64,
    },
    /// A bridge names a vertex that does not exist.
    #[error("bridge {bridge} joins vertices {vertices:?}, but there are only {n_vertices}")]
    Bridge {
        /// Index of the bridge.
        bridge: usize,
        /// The vertices that it names.
        vertices: [u32; 2],
        /// Vertices of the mesh.
        n_vertices: usize,
    },
}

/// Weight of a bridge, in mean edge weights.
///
/// Two components of areas a and b joined by a bridge of weight w get one eigenvalue of about `w
/// (1/a + 1/b)` in place of a second 0: with unit total area a few hundredths, far below the first
/// eigenvalues of the components (10 and more) and far above rounding (1e-10). All other
/// eigenvalues move by about `w (φ(p) - φ(q))²`, a tenth of a percent.
const BRIDGE_WEIGHT: f64 = 0.01;

/// The Laplacian of a mesh: stiffness W `(n, n)` and lumped mass `(n,)`. O(n) (`mesh-laplace`:
/// about 50 neighbours a vertex).
///
/// W is positive semidefinite, so the operator `A⁻¹ W` is minus the Laplace–Beltrami operator. W
/// does not depend on the scale of the mesh; the mass has the unit of its area. Boundaries are
/// natural (Neumann). Each of `bridges` becomes an edge of a hundredth of the mean edge weight, so
/// that components are joined in W but keep their own spectra to about 0.1 %.
///
/// ```
/// use coseg_geometry::mesh::icosphere;
/// use coseg_geometry::operators::{Operator, laplacian};
///
/// let sphere = laplacian(&icosphere(3), &[], Operator::Tufted)?;
/// for row in sphere.stiffness.outer_iterator() {
///     assert!(row.iter().map(|(_, w)| w).sum::<f64>().abs() < 1e-9); // constants are harmonic
/// }
/// let area: f64 = sphere.mass.iter().sum();
/// assert!((area / (4.0 * std::f64::consts::PI) - 1.0).abs() < 0.01);
/// # Ok::<_, coseg_geometry::operators::LaplacianError>(())
/// ```
///
/// # Errors
/// If a vertex has no face or a coordinate is not finite. [`Operator::Cotan`] also rejects faces of
/// zero area, which the others accept.
pub fn laplacian(
    mesh: &TriMesh,
    bridges: &[Bridge],
    operator: Operator,
) -> Result<Laplacian, LaplacianError> {
    check(mesh, bridges)?;
    let (edges, mass) = match operator {
        Operator::Tufted => tufted::tufted(mesh).weights(mesh.vertices.len()),
        Operator::Cotan => cotan::cotan(mesh)?,
        Operator::MeshLaplace => mesh_laplace::mesh_laplace(mesh),
    };
    assembled(edges, mass, bridges)
}

/// The triangles of the tufted cover, with the Laplacian that is half of the sum of theirs.
pub(crate) fn tufted_cover(
    mesh: &TriMesh,
) -> Result<(Vec<IntrinsicFace>, Laplacian), LaplacianError> {
    check(mesh, &[])?;
    let cover = tufted::tufted(mesh);
    let (edges, mass) = cover.weights(mesh.vertices.len());
    Ok((cover.faces(), assembled(edges, mass, &[])?))
}

fn assembled(
    mut edges: Vec<Edge>,
    mass: Vec<f64>,
    bridges: &[Bridge],
) -> Result<Laplacian, LaplacianError> {
    if let Some((vertex, &mass)) = mass
        .iter()
        .enumerate()
        .find(|(_, m)| !(m.is_normal() && **m > 0.0))
    {
        return Err(LaplacianError::Mass { vertex, mass });
    }
    let mean = {
        let merged = merged(mass.len(), &edges);
        let total: f64 = merged.iter().map(|e| e.weight.abs()).sum();
        total / merged.len().max(1) as f64
    };
    // Components that share a vertex are joined by it already.
    let separate = bridges.iter().filter(|b| b.vertices[0] != b.vertices[1]);
    edges.extend(separate.map(|b| Edge {
        vertices: [
            b.vertices[0].min(b.vertices[1]),
            b.vertices[0].max(b.vertices[1]),
        ],
        weight: BRIDGE_WEIGHT * mean,
    }));
    let edges = merged(mass.len(), &edges);
    if let Some(edge) = edges.iter().find(|e| !e.weight.is_finite()) {
        return Err(LaplacianError::Weight {
            vertices: edge.vertices,
            weight: edge.weight,
        });
    }
    Ok(Laplacian {
        stiffness: stiffness(mass.len(), &edges),
        mass,
    })
}

/// A contribution `w` to the weight between two different vertices, the smaller one first.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Edge {
    vertices: [u32; 2],
    weight: f64,
}

impl Edge {
    /// `None` for a loop, which does not enter W.
    fn new(a: u32, b: u32, weight: f64) -> Option<Self> {
        (a != b).then(|| Self {
            vertices: [a.min(b), a.max(b)],
            weight,
        })
    }
}

/// One edge per pair of vertices, in order; contributions are added in the order given.
fn merged(n: usize, edges: &[Edge]) -> Vec<Edge> {
    // A stable counting sort by the first vertex, then a stable sort of each short run.
    let mut starts = vec![0usize; n + 1];
    for edge in edges {
        starts[edge.vertices[0] as usize + 1] += 1;
    }
    for i in 0..n {
        starts[i + 1] += starts[i];
    }
    let mut place = starts.clone();
    let mut sorted = vec![
        Edge {
            vertices: [0, 0],
            weight: 0.0
        };
        edges.len()
    ];
    for edge in edges {
        let p = &mut place[edge.vertices[0] as usize];
        sorted[*p] = *edge;
        *p += 1;
    }
    let mut out: Vec<Edge> = Vec::with_capacity(edges.len());
    for window in starts.windows(2) {
        let run = &mut sorted[window[0]..window[1]];
        run.sort_by_key(|e| e.vertices[1]);
        for edge in run {
            match out.last_mut() {
                Some(last) if last.vertices == edge.vertices => last.weight += edge.weight,
                _ => out.push(*edge),
            }
        }
    }
    out
}

/// W from merged edges; the diagonal is minus the sum of the rest of its row.
fn stiffness(n: usize, edges: &[Edge]) -> sprs::CsMat<f64> {
    let mut row_starts = vec![0usize; n + 1];
    for edge in edges {
        for v in edge.vertices {
            row_starts[v as usize + 1] += 1;
        }
    }
    for i in 0..n {
        row_starts[i + 1] += row_starts[i] + 1;
    }
    let mut place = row_starts.clone();
    let n_entries = row_starts[n];
    let (mut columns, mut values) = (vec![0usize; n_entries], vec![0.0; n_entries]);
    let mut put = |row: usize, column: usize, value: f64| {
        columns[place[row]] = column;
        values[place[row]] = value;
        place[row] += 1;
    };
    // Edges are sorted by their smaller end, so each row first gets its columns below the diagonal.
    let mut next = 0;
    for v in 0..n {
        put(v, v, 0.0);
        while next < edges.len() && edges[next].vertices[0] as usize == v {
            let [a, b] = edges[next].vertices.map(|x| x as usize);
            put(a, b, -edges[next].weight);
            put(b, a, -edges[next].weight);
            next += 1;
        }
    }
    for v in 0..n {
        let range = row_starts[v]..row_starts[v + 1];
        let sum: f64 = values[range.clone()].iter().sum();
        let diagonal = columns[range.clone()].iter().position(|&c| c == v);
        values[range.start + diagonal.expect("invariant: every row holds its diagonal")] = -sum;
    }
    sprs::CsMat::new((n, n), row_starts, columns, values)
}

fn check(mesh: &TriMesh, bridges: &[Bridge]) -> Result<(), LaplacianError> {
    let n_vertices = mesh.vertices.len();
    if mesh.faces.is_empty() {
        return Err(LaplacianError::Empty { n_vertices });
    }
    for (vertex, p) in mesh.vertices.iter().enumerate() {
        if let Some(axis) = p.iter().position(|x| !x.is_finite()) {
            return Err(LaplacianError::NonFinite {
                vertex,
                axis,
                value: p[axis],
            });
        }
    }
    let mut seen = vec![false; n_vertices];
    for (face, &[a, b, c]) in mesh.faces.iter().enumerate() {
        for vertex in [a, b, c] {
            match seen.get_mut(vertex as usize) {
                Some(s) => *s = true,
                None => {
                    return Err(LaplacianError::OutOfRange {
                        face,
                        vertex,
                        n_vertices,
                    });
                }
            }
        }
        if a == b || a == c || b == c {
            let vertex = if b == c { b } else { a };
            return Err(LaplacianError::RepeatedCorner { face, vertex });
        }
    }
    if let Some(vertex) = seen.iter().position(|s| !s) {
        return Err(LaplacianError::Unreferenced { vertex });
    }
    for (bridge, b) in bridges.iter().enumerate() {
        let [p, q] = b.vertices;
        if p as usize >= n_vertices || q as usize >= n_vertices {
            return Err(LaplacianError::Bridge {
                bridge,
                vertices: b.vertices,
                n_vertices,
            });
        }
    }
    Ok(())
}

fn difference(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    let d = difference(a, b);
    dot(d, d).sqrt()
}

#[cfg(test)]
pub(crate) mod test_meshes;
#[cfg(test)]
mod tests;
