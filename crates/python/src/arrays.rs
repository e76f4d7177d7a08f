//! Between NumPy arrays and the types of the geometry.

use coseg_geometry::mesh::TriMesh;
use numpy::{
    Element, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2,
    PyUntypedArrayMethods,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::{Bound, PyResult, Python};

/// An array `(n, width)` that owns the memory of `values`.
pub(crate) fn matrix<T: Element>(
    py: Python<'_>,
    values: Vec<T>,
    width: usize,
) -> PyResult<Bound<'_, PyArray2<T>>> {
    let n = values.len() / width.max(1);
    PyArray1::from_vec(py, values).reshape([n, width])
}

/// An array `(n, 3)`.
pub(crate) fn triples<T: Element>(
    py: Python<'_>,
    rows: Vec<[T; 3]>,
) -> PyResult<Bound<'_, PyArray2<T>>> {
    matrix(py, rows.into_flattened(), 3)
}

/// The rows of an array `(n, 3)`, where they are.
pub(crate) fn rows<'a, T: Element>(array: &'a PyReadonlyArray2<'_, T>) -> PyResult<&'a [[T; 3]]> {
    let width = array.shape()[1];
    if width != 3 {
        let shape = array.shape();
        return Err(PyValueError::new_err(format!(
            "the array has shape {shape:?}, but (n, 3) is needed"
        )));
    }
    Ok(array.as_slice()?.as_chunks().0)
}

/// A mesh of `vertices (n, 3)` and `faces (m, 3)`, all of whose corners exist.
pub(crate) fn tri_mesh(
    vertices: &PyReadonlyArray2<'_, f64>,
    faces: &PyReadonlyArray2<'_, u32>,
) -> PyResult<TriMesh> {
    let mesh = TriMesh {
        vertices: rows(vertices)?.to_vec(),
        faces: rows(faces)?.to_vec(),
    };
    let n = mesh.vertices.len();
    let outside = |face: &[u32; 3]| face.iter().any(|v| *v as usize >= n);
    match mesh.faces.iter().position(outside) {
        Some(face) => Err(PyValueError::new_err(format!(
            "face {face} is {:?}, but the mesh has {n} vertices",
            mesh.faces[face]
        ))),
        None => Ok(mesh),
    }
}

/// Values `(n,)` that are kept beyond the call.
pub(crate) fn owned<T: Element + Copy>(array: &PyReadonlyArray1<'_, T>) -> PyResult<Vec<T>> {
    Ok(array.as_slice()?.to_vec())
}

/// Values `(n, width)`, row-major, in single precision, with the width.
pub(crate) fn single(array: &PyReadonlyArray2<'_, f64>) -> PyResult<(Vec<f32>, usize)> {
    let values = array.as_slice()?.iter().map(|x| *x as f32).collect();
    Ok((values, array.shape()[1]))
}

/// A matrix in double precision from one in single.
pub(crate) fn double(values: &[f32]) -> Vec<f64> {
    values.iter().map(|x| f64::from(*x)).collect()
}
