//! A mesh becomes the arrays that the daemon keeps of it, and parts of its own.

use crate::arrays::{matrix, owned, tri_mesh, triples};
use crate::mesh::parsed;
use crate::spectral::operator;
use crate::work::interruptible;
use coseg_geometry::describe::{N_HKS_TIMES, describe_parsed};
use coseg_geometry::description::Params;
use coseg_geometry::segmentation::{Surface, parts};
use numpy::{PyArray1, PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::{Bound, Py, PyAny, PyResult, Python, pyfunction};
use pyo3::types::{PyDict, PyDictMethods};

/// The description as a dictionary of arrays, of a proxy of about `working_faces` faces.
#[pyfunction]
#[expect(
    clippy::too_many_arguments,
    reason = "the arrays of a mesh, and the options"
)]
pub(crate) fn describe<'py>(
    py: Python<'py>,
    vertices: PyReadonlyArray2<'py, f64>,
    faces: PyReadonlyArray2<'py, u32>,
    polygon_of_face: PyReadonlyArray1<'py, u32>,
    n_polygons: usize,
    working_faces: u32,
    n_eigenpairs: u32,
    operator_name: &str,
    progress: Option<Py<PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let given = parsed(&vertices, &faces, &polygon_of_face, n_polygons)?;
    let params = Params {
        operator: operator(operator_name).map_err(|failure| failure.raise(py))?,
        working_faces,
        n_eigenpairs,
        ..Params::default()
    };
    let found = interruptible(py, progress, move |control| {
        let stage = |name: &str| control.enter(name, 0, 0);
        Ok(describe_parsed(&given, &params, &stage)?)
    })?;
    let report = PyDict::new(py);
    for (name, count) in found.report.counts() {
        report.set_item(name, count)?;
    }
    let fields = PyDict::new(py);
    fields.set_item("area", found.area)?;
    fields.set_item("report", report)?;
    fields.set_item("vertices", triples(py, found.vertices)?)?;
    fields.set_item("faces", triples(py, found.faces)?)?;
    fields.set_item("mass", PyArray1::from_vec(py, found.mass))?;
    fields.set_item("eigenvalues", PyArray1::from_vec(py, found.eigenvalues))?;
    let vectors = matrix(py, found.eigenvectors, found.n_eigenvectors)?;
    fields.set_item("eigenvectors", vectors)?;
    fields.set_item("hks", matrix(py, found.hks, N_HKS_TIMES)?)?;
    let descriptors = matrix(py, found.face_descriptors, found.n_descriptors)?;
    fields.set_item("face_descriptors", descriptors)?;
    fields.set_item("patches", PyArray1::from_vec(py, found.patches))?;
    fields.set_item("face_map", PyArray1::from_vec(py, found.face_map))?;
    fields.set_item("polygon_area", PyArray1::from_vec(py, found.polygon_area))?;
    fields.set_item("signature", PyArray1::from_vec(py, found.signature))?;
    Ok(fields)
}

/// The part `(m,)` of each face of a proxy, from its patches `(m,)` and face descriptors `(m, d)`.
#[pyfunction]
pub(crate) fn segment<'py>(
    py: Python<'py>,
    vertices: PyReadonlyArray2<'py, f64>,
    faces: PyReadonlyArray2<'py, u32>,
    patches: PyReadonlyArray1<'py, u32>,
    descriptors: PyReadonlyArray2<'py, f32>,
    n_parts: usize,
) -> PyResult<Bound<'py, PyArray1<u32>>> {
    let mesh = tri_mesh(&vertices, &faces)?;
    let (patches, dim) = (owned(&patches)?, descriptors.shape()[1]);
    let descriptors = descriptors.as_slice()?.to_vec();
    let found = interruptible(py, None, move |_| {
        Ok(parts(
            &Surface::new(&mesh),
            &patches,
            &descriptors,
            dim,
            n_parts,
        ))
    })?;
    Ok(PyArray1::from_vec(py, found))
}
