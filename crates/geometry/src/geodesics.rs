//! Computes distances along a surface by the heat method, on the tufted cover of the mesh.
//!
//! Crane, Weischedel and Wardetzky, *Geodesics in Heat*, 2013: heat flows from the source for a
//! short time, its gradient points away from the source everywhere, and the function whose gradient
//! has that direction and length 1 is the distance. All three steps are on the triangles of the
//! tufted cover (Sharp and Crane 2020), so any mesh that has a Laplacian has distances: with holes,
//! edges of three faces, slivers and faces without an orientation.
//!
//! Both systems are factorised once; a source then costs two solves.

use crate::linalg::ldlt::{Analysis, Factor, LdltError, SymmetricSparse};
use crate::linalg::panel::{Row, WIDTH, zero_panel};
use crate::mesh::TriMesh;
use crate::operators::{IntrinsicFace, LaplacianError, tufted_cover};

/// How many sources share the work of a solve.
pub const BATCH: usize = WIDTH;

/// Heat at the source. It falls by about e with every edge, so it starts as high as it can.
const HOTTEST: f64 = 1e300;
/// Below this a double has no longer all its digits, nor have the directions of gradients.
const COLDEST: f64 = 1e-300;

/// Why there are no distances.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum GeodesicError {
    /// The mesh has no Laplacian.
    #[error(transparent)]
    Laplacian(#[from] LaplacianError),
    /// A factorisation failed.
    #[error(transparent)]
    Factor(#[from] LdltError),
    /// The time is no positive number.
    #[error("the time is {time}, but must be positive and finite")]
    Time {
        /// The time that was given.
        time: f64,
    },
    /// A source is no vertex.
    #[error("source {vertex} does not exist: the mesh has {n_vertices} vertices")]
    Source {
        /// The source.
        vertex: u32,
        /// Vertices of the mesh.
        n_vertices: usize,
    },
    /// So little heat arrives that its direction is lost in rounding.
    #[error(
        "heat from vertex {source_vertex} does not reach vertex {vertex} in the time {time}: \
         the mesh is too many edges across; give a time of {} or more", 4.0 * .time
    )]
    OutOfReach {
        /// The source.
        source_vertex: u32,
        /// The coldest vertex.
        vertex: usize,
        /// The time that was given.
        time: f64,
    },
}

/// Distances along one mesh, from any of its vertices; what they have in common is factorised.
#[derive(Debug)]
pub struct HeatGeodesics {
    faces: Vec<IntrinsicFace>,
    /// The component of each vertex `(n,)`, named by its smallest vertex.
    component: Vec<u32>,
    mass: Vec<f64>,
    time: f64,
    /// Where each vertex is in the order of elimination `(n,)`.
    rank: Vec<u32>,
    /// Of `A + t W`.
    heat: Factor,
    /// Of W, with the first vertex of each component fixed.
    poisson: Factor,
}

impl HeatGeodesics {
    /// Prepares a mesh. Heat flows for `time`, in units of the square of the mean edge: 1 is what
    /// the paper recommends, more is smoother. O(n^1.5), once.
    ///
    /// ```
    /// use coseg_geometry::geodesics::HeatGeodesics;
    /// use coseg_geometry::mesh::icosphere;
    ///
    /// let distances = HeatGeodesics::new(&icosphere(4), 1.0)?.distances(&[0])?;
    /// // Vertex 3 is opposite: half a great circle away.
    /// assert!((distances[3] / std::f64::consts::PI - 1.0).abs() < 0.02);
    /// # Ok::<_, coseg_geometry::geodesics::GeodesicError>(())
    /// ```
    ///
    /// # Errors
    /// If the mesh has no Laplacian, or the time is not positive.
    pub fn new(mesh: &TriMesh, time: f64) -> Result<Self, GeodesicError> {
        if !(time.is_finite() && time > 0.0) {
            return Err(GeodesicError::Time { time });
        }
        let (faces, laplacian) = tufted_cover(mesh)?;
        let edge = mean_edge(&faces);
        let component = components(mesh);
        let (starts, columns, values) = laplacian.stiffness.into_raw_storage();
        let stiffness = SymmetricSparse {
            row_starts: starts,
            columns: columns.into_iter().map(|c| c as u32).collect(),
            values,
        };
        let analysis = Analysis::new(&stiffness)?;
        let stiffness = stiffness.permuted(&analysis.order);
        let mass: Vec<f64> = laplacian.mass.iter().map(|a| a / (edge * edge)).collect();
        let mut rank = vec![0; mass.len()];
        for (place, &vertex) in analysis.order.iter().enumerate() {
            rank[vertex as usize] = place as u32;
        }
        let heated = heated(&stiffness, &analysis.order, &mass, time);
        let is_fixed = |place: u32| {
            let vertex = analysis.order[place as usize];
            component[vertex as usize] == vertex
        };
        let fixed = with_fixed(stiffness, is_fixed);
        Ok(Self {
            heat: Factor::new(&analysis, &heated, 0.0)?,
            poisson: Factor::new(&analysis, &fixed, 0.0)?,
            faces,
            component,
            mass,
            time,
            rank,
        })
    }

    /// Vertices of the mesh.
    pub fn n_vertices(&self) -> usize {
        self.component.len()
    }

    /// Distances `(s, n)`, row-major, from each of the sources `(s,)` to each vertex, in the unit
    /// of the coordinates: 0 at the source, never negative, infinite in other components. O(n log
    /// n) for each source; [`BATCH`] of them share a solve.
    ///
    /// # Errors
    /// If a source does not exist, or the mesh is so many edges across (about 1,000 at time 1) that
    /// heat does not arrive.
    pub fn distances(&self, sources: &[u32]) -> Result<Vec<f64>, GeodesicError> {
        let n_vertices = self.n_vertices();
        if let Some(&vertex) = sources.iter().find(|s| **s as usize >= n_vertices) {
            return Err(GeodesicError::Source { vertex, n_vertices });
        }
        let mut found = Vec::with_capacity(sources.len() * n_vertices);
        for batch in sources.chunks(BATCH) {
            let mut panel = zero_panel(n_vertices);
            for (column, &source) in batch.iter().enumerate() {
                let hot = HOTTEST * self.mass[source as usize];
                panel[self.rank[source as usize] as usize].0[column] = hot;
            }
            self.heat.solve(&mut panel, false);
            let mut divergence = zero_panel(n_vertices);
            for (column, &source) in batch.iter().enumerate() {
                self.check_reach(&panel, column, source)?;
                self.diverge(&panel, column, source, &mut divergence);
            }
            for (vertex, _) in self.fixed() {
                divergence[self.rank[vertex] as usize] = Row::ZERO;
            }
            self.poisson.solve(&mut divergence, false);
            for (column, &source) in batch.iter().enumerate() {
                let at = |vertex: usize| divergence[self.rank[vertex] as usize].0[column];
                let zero = at(source as usize);
                found.extend((0..n_vertices).map(|vertex| {
                    if self.is_joined(vertex, source) {
                        // Rounding may leave a neighbour of the source a little below it.
                        (at(vertex) - zero).max(0.0)
                    } else {
                        f64::INFINITY
                    }
                }));
            }
        }
        Ok(found)
    }

    fn fixed(&self) -> impl Iterator<Item = (usize, &u32)> {
        let named = self.component.iter().enumerate();
        named.filter(|(vertex, name)| **name as usize == *vertex)
    }

    fn is_joined(&self, vertex: usize, source: u32) -> bool {
        self.component[vertex] == self.component[source as usize]
    }

    fn check_reach(
        &self,
        heat: &[Row],
        column: usize,
        source_vertex: u32,
    ) -> Result<(), GeodesicError> {
        let at = |vertex: &usize| heat[self.rank[*vertex] as usize].0[column];
        let joined = (0..self.n_vertices()).filter(|v| self.is_joined(*v, source_vertex));
        let coldest = joined.min_by(|a, b| at(a).total_cmp(&at(b)));
        match coldest {
            Some(vertex) if at(&vertex) < COLDEST => Err(GeodesicError::OutOfReach {
                source_vertex,
                vertex,
                time: self.time,
            }),
            _ => Ok(()),
        }
    }

    /// Adds to `out` what the function whose gradient is the direction of falling heat has as its
    /// Laplacian: `½ Σ ∫ ∇λᵢ · X` over the triangles of the cover.
    fn diverge(&self, heat: &[Row], column: usize, source: u32, out: &mut [Row]) {
        for face in &self.faces {
            if !self.is_joined(face.corners[0] as usize, source) {
                continue;
            }
            let places = face.corners.map(|v| self.rank[v as usize] as usize);
            let u = places.map(|place| heat[place].0[column]);
            let Some([x, y]) = direction(face, u) else {
                continue;
            };
            // 2A ∇λᵢ is the side opposite corner i, turned to the left.
            let turned = [
                [-face.y2, face.x2 - face.x1],
                [face.y2, -face.x2],
                [0.0, face.x1],
            ];
            for (place, [gx, gy]) in places.into_iter().zip(turned) {
                out[place].0[column] += 0.25 * (gx * x + gy * y);
            }
        }
    }
}

/// In which direction a function with these values at the corners falls, as a vector of length 1;
/// `None` if it is constant.
fn direction(face: &IntrinsicFace, values: [f64; 3]) -> Option<[f64; 2]> {
    // Squares of the numbers themselves would be outside of what a double holds.
    let largest = values.iter().fold(0.0, |m: f64, x| m.max(x.abs()));
    let values = values.map(|x| x / largest);
    let (along, across) = (values[1] - values[0], values[2] - values[0]);
    let x = along / face.x1;
    let y = (across - x * face.x2) / face.y2;
    let length = x.hypot(y);
    (length.is_normal()).then(|| [-x / length, -y / length])
}

/// Mean length of a side of the cover.
fn mean_edge(faces: &[IntrinsicFace]) -> f64 {
    let total: f64 = faces
        .iter()
        .map(|f| f.x1 + f.x2.hypot(f.y2) + (f.x2 - f.x1).hypot(f.y2))
        .sum();
    total / (3 * faces.len()) as f64
}

/// For each vertex the smallest one that is joined to it by faces.
fn components(mesh: &TriMesh) -> Vec<u32> {
    let mut root: Vec<u32> = (0..mesh.vertices.len() as u32).collect();
    fn find(root: &mut [u32], mut vertex: u32) -> u32 {
        while root[vertex as usize] != vertex {
            root[vertex as usize] = root[root[vertex as usize] as usize];
            vertex = root[vertex as usize];
        }
        vertex
    }
    for &[a, b, c] in &mesh.faces {
        for other in [b, c] {
            let (p, q) = (find(&mut root, a), find(&mut root, other));
            root[p.max(q) as usize] = p.min(q);
        }
    }
    (0..root.len() as u32).map(|v| find(&mut root, v)).collect()
}

/// `A + t W` in the order of elimination.
fn heated(stiffness: &SymmetricSparse, order: &[u32], mass: &[f64], time: f64) -> SymmetricSparse {
    let mut out = stiffness.clone();
    for (row, &vertex) in order.iter().enumerate() {
        for entry in out.row_starts[row]..out.row_starts[row + 1] {
            let own = if out.columns[entry] as usize == row {
                mass[vertex as usize]
            } else {
                0.0
            };
            out.values[entry] = own + time * out.values[entry];
        }
    }
    out
}

/// The same pattern, without what joins fixed rows to others: W has the constants of each component
/// as its null space, and is definite with one vertex of each fixed.
fn with_fixed(mut matrix: SymmetricSparse, is_fixed: impl Fn(u32) -> bool) -> SymmetricSparse {
    for row in 0..matrix.n() {
        for entry in matrix.row_starts[row]..matrix.row_starts[row + 1] {
            let column = matrix.columns[entry];
            if column as usize != row && (is_fixed(column) || is_fixed(row as u32)) {
                matrix.values[entry] = 0.0;
            }
        }
    }
    matrix
}

#[cfg(test)]
mod tests;
