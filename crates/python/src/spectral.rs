//! Laplacians, their spectra, and kernels of points.

use crate::arrays::{matrix, owned, tri_mesh};
use crate::failure::Failure;
use crate::work::{interruptible, with_threads};
use coseg_geometry::descriptors::{self, PointKernels};
use coseg_geometry::mesh::bridges;
use coseg_geometry::operators::{self, Operator};
use coseg_geometry::spectrum::{Certificate, Eigenpairs, Options};
use numpy::{PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::{Bound, Py, PyAny, PyResult, Python, pyfunction};
use pyo3::types::{PyDict, PyDictMethods};

/// The operator of that name.
pub(crate) fn operator(name: &str) -> Result<Operator, Failure> {
    match name {
        "tufted" => Ok(Operator::Tufted),
        "cotan" => Ok(Operator::Cotan),
        "mesh-laplace" => Ok(Operator::MeshLaplace),
        _ => Err(Failure::argument(format!(
            "the operator is {name:?}, but must be \"tufted\", \"cotan\" or \"mesh-laplace\""
        ))),
    }
}

/// Stiffness as the arrays of a CSR matrix (row starts, columns, values), mass `(n,)`, and the
/// number of bridges.
#[pyfunction]
#[expect(
    clippy::type_complexity,
    reason = "one tuple that Python unpacks at once"
)]
pub(crate) fn laplacian<'py>(
    py: Python<'py>,
    vertices: PyReadonlyArray2<'py, f64>,
    faces: PyReadonlyArray2<'py, u32>,
    operator_name: &str,
    join_components: bool,
) -> PyResult<(
    Bound<'py, PyArray1<i64>>,
    Bound<'py, PyArray1<i64>>,
    Bound<'py, PyArray1<f64>>,
    Bound<'py, PyArray1<f64>>,
    usize,
)> {
    let mesh = tri_mesh(&vertices, &faces)?;
    let operator = operator(operator_name).map_err(|failure| failure.raise(py))?;
    let (found, n_bridges) = interruptible(py, None, move |_| {
        let joins = if join_components {
            bridges(&mesh)
        } else {
            Vec::new()
        };
        let found = operators::laplacian(&mesh, &joins, operator)?;
        Ok((found, joins.len()))
    })?;
    let (row_starts, columns, values) = found.stiffness.into_raw_storage();
    let wide = |indices: Vec<usize>| {
        let indices = indices.into_iter().map(|i| i as i64);
        PyArray1::from_vec(py, indices.collect())
    };
    Ok((
        wide(row_starts),
        wide(columns),
        PyArray1::from_vec(py, values),
        PyArray1::from_vec(py, found.mass),
        n_bridges,
    ))
}

/// Eigenvalues `(k,)`, eigenvectors `(n, k)`, residuals `(k,)` and the certificate.
#[pyfunction]
#[expect(
    clippy::type_complexity,
    reason = "one tuple that Python unpacks at once"
)]
#[expect(
    clippy::too_many_arguments,
    reason = "the arrays of a matrix, and the options"
)]
pub(crate) fn spectrum<'py>(
    py: Python<'py>,
    row_starts: PyReadonlyArray1<'py, i64>,
    columns: PyReadonlyArray1<'py, i64>,
    values: PyReadonlyArray1<'py, f64>,
    mass: PyReadonlyArray1<'py, f64>,
    k: usize,
    tolerance: f64,
    seed: u64,
    threads: usize,
    progress: Option<Py<PyAny>>,
) -> PyResult<(
    Bound<'py, PyArray1<f64>>,
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray1<f64>>,
    Bound<'py, PyDict>,
)> {
    let narrow = |indices: &PyReadonlyArray1<'py, i64>| -> PyResult<Vec<usize>> {
        Ok(indices.as_slice()?.iter().map(|i| *i as usize).collect())
    };
    let (row_starts, columns) = (narrow(&row_starts)?, narrow(&columns)?);
    let (values, mass) = (owned(&values)?, owned(&mass)?);
    let (pairs, rows) = interruptible(py, progress, move |control| {
        let n = mass.len();
        let stiffness = sprs::CsMat::try_new((n, n), row_starts, columns, values);
        let stiffness = stiffness.map_err(|(.., error)| {
            Failure::argument(format!("the stiffness is no CSR: {error}"))
        })?;
        with_threads(threads, |threads| {
            let hook = |progress: &_| control.at(progress);
            let options = Options {
                seed,
                tolerance,
                threads,
                progress: Some(&hook),
            };
            let pairs = Eigenpairs::smallest(&stiffness, &mass, k, &options)?;
            let rows = pairs.all_rows();
            Ok((pairs, rows))
        })?
    })?;
    Ok((
        PyArray1::from_vec(py, pairs.eigenvalues),
        matrix(py, rows, k)?,
        PyArray1::from_vec(py, pairs.residuals),
        certificate(py, &pairs.certificate)?,
    ))
}

fn certificate<'py>(py: Python<'py>, found: &Certificate) -> PyResult<Bound<'py, PyDict>> {
    let fields = PyDict::new(py);
    fields.set_item("is_proved", found.proved())?;
    fields.set_item("tau", found.tau)?;
    fields.set_item("count", found.count)?;
    fields.set_item("margin", found.margin)?;
    fields.set_item("perturbation", found.perturbation)?;
    fields.set_item("growth", found.growth)?;
    fields.set_item("n_components", found.n_components)?;
    fields.set_item("n_krylov", found.n_krylov)?;
    fields.set_item("n_polish", found.n_polish)?;
    fields.set_item("n_repair", found.n_repair)?;
    Ok(fields)
}

/// Heat kernel signatures at the `times`, then wave kernel signatures at so many energies:
/// `(n, times + energies)`.
#[pyfunction]
pub(crate) fn point_kernels<'py>(
    py: Python<'py>,
    eigenvalues: PyReadonlyArray1<'py, f64>,
    eigenvectors: PyReadonlyArray2<'py, f64>,
    times: PyReadonlyArray1<'py, f64>,
    n_energies: usize,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let (values, times) = (eigenvalues.as_slice()?, times.as_slice()?);
    let (rows, [n, k]) = (
        eigenvectors.as_slice()?,
        [eigenvectors.shape()[0], eigenvectors.shape()[1]],
    );
    let (out, width) = py.detach(|| {
        let kernels = PointKernels::new(&values[..k.min(values.len())], times, n_energies);
        let mut out = vec![0.0; n * kernels.n_columns()];
        if !out.is_empty() {
            kernels.of_rows(rows, k, &mut out);
        }
        (out, kernels.n_columns())
    });
    matrix(py, out, width)
}

/// The source paper's times `(n_times,)` for a heat kernel signature.
#[pyfunction]
pub(crate) fn hks_times<'py>(
    py: Python<'py>,
    eigenvalues: PyReadonlyArray1<'py, f64>,
    n_times: usize,
) -> PyResult<Bound<'py, PyArray1<f64>>> {
    let times = descriptors::hks_times(eigenvalues.as_slice()?, n_times);
    Ok(PyArray1::from_vec(py, times))
}

/// How many eigenvalues are zero.
#[pyfunction]
pub(crate) fn null_space(eigenvalues: PyReadonlyArray1<'_, f64>) -> PyResult<usize> {
    Ok(descriptors::null_space(eigenvalues.as_slice()?))
}
