//! Meshes: reading, triangulating, cleaning, components and distances.

use crate::arrays::{owned, rows, tri_mesh, triples};
use crate::failure::Failure;
use crate::work::interruptible;
use coseg_geometry::mesh::{
    self, EdgeGraph, Format, ParsedMesh, Triangulator, bridges, geodesic::Distances,
};
use numpy::{PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::{Bound, PyResult, Python, pyfunction};
use pyo3::types::{PyDict, PyDictMethods};

/// Vertices, triangles and the polygon of each triangle.
type Triangulated<'py> = (
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray2<u32>>,
    Bound<'py, PyArray1<u32>>,
    usize,
);

/// Bytes of a file become vertices `(n, 3)`, triangles `(m, 3)`, the polygon of each `(m,)`, and
/// the number of polygons.
#[pyfunction]
pub(crate) fn parse<'py>(
    py: Python<'py>,
    data: Vec<u8>,
    file_name: &str,
) -> PyResult<Triangulated<'py>> {
    let Some(format) = Format::from_name(file_name) else {
        let extensions = Format::EXTENSIONS;
        let message = format!("{file_name:?} has none of the extensions {extensions}");
        return Err(Failure::argument(message).raise(py));
    };
    let parsed = interruptible(py, None, move |_| Ok(mesh::parse(&data, format)?))?;
    Ok((
        triples(py, parsed.vertices)?,
        triples(py, parsed.triangles)?,
        PyArray1::from_vec(py, parsed.polygon_of_triangle),
        parsed.n_polygons,
    ))
}

/// Polygons, given by their `corners` one after the other and where each begins (`offsets`, with
/// the end), become triangles and the polygon of each.
#[pyfunction]
#[expect(
    clippy::type_complexity,
    reason = "one tuple that Python unpacks at once"
)]
pub(crate) fn triangulate<'py>(
    py: Python<'py>,
    vertices: PyReadonlyArray2<'py, f64>,
    corners: PyReadonlyArray1<'py, u32>,
    offsets: PyReadonlyArray1<'py, i64>,
) -> PyResult<(Bound<'py, PyArray2<u32>>, Bound<'py, PyArray1<u32>>)> {
    let (points, corners) = (rows(&vertices)?, corners.as_slice()?);
    let (mut triangles, mut polygon_of_triangle) = (Vec::new(), Vec::new());
    let mut triangulator = Triangulator::default();
    for (polygon, window) in offsets.as_slice()?.windows(2).enumerate() {
        let range = usize::try_from(window[0])
            .ok()
            .zip(usize::try_from(window[1]).ok());
        let own = range.and_then(|(from, to)| corners.get(from..to));
        let Some(own) = own.filter(|own| !own.is_empty()) else {
            let message = format!("polygon {polygon} has no corners, but at least 1 is needed");
            return Err(Failure::argument(message).raise(py));
        };
        if let Some(vertex) = own.iter().find(|v| **v as usize >= points.len()) {
            let n = points.len();
            let message = format!("polygon {polygon} names vertex {vertex}, but there are {n}");
            return Err(Failure::argument(message).raise(py));
        }
        triangulator.triangulate(points, own, |t| triangles.push(t));
        polygon_of_triangle.resize(triangles.len(), polygon as u32);
    }
    let polygon_of_triangle = PyArray1::from_vec(py, polygon_of_triangle);
    Ok((triples(py, triangles)?, polygon_of_triangle))
}

/// A triangle mesh as [`mesh::clean`] and the stages after it take it.
pub(crate) fn parsed(
    vertices: &PyReadonlyArray2<'_, f64>,
    faces: &PyReadonlyArray2<'_, u32>,
    polygon_of_face: &PyReadonlyArray1<'_, u32>,
    n_polygons: usize,
) -> PyResult<ParsedMesh> {
    let mesh = tri_mesh(vertices, faces)?;
    Ok(ParsedMesh {
        vertices: mesh.vertices,
        triangles: mesh.faces,
        polygon_of_triangle: owned(polygon_of_face)?,
        n_polygons,
        ..ParsedMesh::default()
    })
}

/// A mesh that can be measured, in the units and the place of the input: vertices, faces, for each
/// vertex of the input its vertex (−1: none), for each face of the input its face, and counts.
#[pyfunction]
#[expect(
    clippy::type_complexity,
    reason = "one tuple that Python unpacks at once"
)]
pub(crate) fn clean<'py>(
    py: Python<'py>,
    vertices: PyReadonlyArray2<'py, f64>,
    faces: PyReadonlyArray2<'py, u32>,
) -> PyResult<(
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray2<u32>>,
    Bound<'py, PyArray1<i64>>,
    Bound<'py, PyArray1<u32>>,
    Bound<'py, PyDict>,
)> {
    let n_faces = faces.shape()[0];
    let numbers: Vec<u32> = (0..n_faces as u32).collect();
    let numbers = numpy::PyArrayMethods::readonly(&PyArray1::from_vec(py, numbers));
    let given = parsed(&vertices, &faces, &numbers, n_faces)?;
    let cleaned = interruptible(py, None, move |_| {
        let mut cleaned = mesh::clean(&given)?;
        // Where the input has them, to the bit.
        for (before, vertex) in given.vertices.iter().zip(&cleaned.vertex_of_vertex).rev() {
            if let Some(vertex) = vertex {
                cleaned.mesh.vertices[*vertex as usize] = *before;
            }
        }
        Ok(cleaned)
    })?;
    let counts = PyDict::new(py);
    for (name, count) in cleaned.report.counts() {
        counts.set_item(name, count)?;
    }
    let vertex_map = cleaned.vertex_of_vertex.iter();
    let vertex_map: Vec<i64> = vertex_map.map(|v| v.map_or(-1, i64::from)).collect();
    Ok((
        triples(py, cleaned.mesh.vertices)?,
        triples(py, cleaned.mesh.faces)?,
        PyArray1::from_vec(py, vertex_map),
        PyArray1::from_vec(py, cleaned.face_of_triangle),
        counts,
    ))
}

/// Components (connected through shared vertices), edges with one face, edges with more than two,
/// and vertices without a face.
#[pyfunction]
pub(crate) fn topology(
    py: Python<'_>,
    vertices: PyReadonlyArray2<'_, f64>,
    faces: PyReadonlyArray2<'_, u32>,
) -> PyResult<(usize, usize, usize, usize)> {
    let mesh = tri_mesh(&vertices, &faces)?;
    Ok(py.detach(|| {
        let mut root: Vec<u32> = (0..mesh.vertices.len() as u32).collect();
        let mut edges = Vec::with_capacity(3 * mesh.faces.len());
        let mut used = vec![false; mesh.vertices.len()];
        for &[a, b, c] in &mesh.faces {
            for [from, to] in [[a, b], [b, c], [c, a]] {
                edges.push([from.min(to), from.max(to)]);
                used[from as usize] = true;
                let (p, q) = (find(&mut root, from), find(&mut root, to));
                root[p.max(q) as usize] = p.min(q);
            }
        }
        edges.sort_unstable();
        let edges = || edges.chunk_by(|a, b| a == b).map(<[_]>::len);
        let is_root = |v: &usize| used[*v] && root[*v] as usize == *v;
        (
            (0..root.len()).filter(is_root).count(),
            edges().filter(|n| *n == 1).count(),
            edges().filter(|n| *n > 2).count(),
            used.iter().filter(|used| !**used).count(),
        )
    }))
}

/// The smallest vertex of the set, with the path to it halved.
fn find(root: &mut [u32], mut vertex: u32) -> u32 {
    while root[vertex as usize] != vertex {
        root[vertex as usize] = root[root[vertex as usize] as usize];
        vertex = root[vertex as usize];
    }
    vertex
}

/// Distances `(s, n)` along edges from each of the `sources (s,)`; infinite where there is no path.
#[pyfunction]
pub(crate) fn edge_distances<'py>(
    py: Python<'py>,
    vertices: PyReadonlyArray2<'py, f64>,
    faces: PyReadonlyArray2<'py, u32>,
    sources: PyReadonlyArray1<'py, u32>,
    join_components: bool,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let mesh = tri_mesh(&vertices, &faces)?;
    let (sources, n) = (owned(&sources)?, mesh.vertices.len());
    let found = interruptible(py, None, move |control| {
        let joins = if join_components {
            bridges(&mesh)
        } else {
            Vec::new()
        };
        let graph = EdgeGraph::new(&mesh, &joins);
        let mut distances = Distances::default();
        let mut found = Vec::with_capacity(sources.len() * n);
        for (i, &source) in sources.iter().enumerate() {
            if !control.enter("distances", i, sources.len()) {
                break;
            }
            graph.dijkstra_into(source, &mut distances);
            found.extend_from_slice(&distances.values);
        }
        Ok(found)
    })?;
    crate::arrays::matrix(py, found, n)
}
