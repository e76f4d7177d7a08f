//! Distances along a mesh by the heat method.

use crate::arrays::{matrix, owned, tri_mesh};
use crate::failure::Failure;
use crate::work::interruptible;
use coseg_geometry::geodesics::{self, BATCH};
use numpy::{PyArray2, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::{Bound, Py, PyAny, PyResult, Python, pyclass, pymethods};
use std::sync::Arc;

/// A mesh whose two systems are factorised.
#[pyclass(frozen, module = "coseg._native")]
pub(crate) struct HeatGeodesics {
    kept: Arc<geodesics::HeatGeodesics>,
}

#[pymethods]
impl HeatGeodesics {
    /// Of a mesh `vertices (n, 3)`, `faces (m, 3)`; the time is in squared mean edges.
    #[new]
    fn new(
        py: Python<'_>,
        vertices: PyReadonlyArray2<'_, f64>,
        faces: PyReadonlyArray2<'_, u32>,
        time: f64,
    ) -> PyResult<Self> {
        let mesh = tri_mesh(&vertices, &faces)?;
        let kept = interruptible(py, None, move |_| {
            Ok(geodesics::HeatGeodesics::new(&mesh, time)?)
        })?;
        Ok(Self {
            kept: Arc::new(kept),
        })
    }

    /// Distances `(s, n)` from each of the `sources (s,)`; infinite in other components.
    fn distances<'py>(
        &self,
        py: Python<'py>,
        sources: PyReadonlyArray1<'py, u32>,
        progress: Option<Py<PyAny>>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let (kept, sources) = (Arc::clone(&self.kept), owned(&sources)?);
        let n = kept.n_vertices();
        let found = interruptible(py, progress, move |control| {
            let mut found = Vec::with_capacity(sources.len() * n);
            for (i, batch) in sources.chunks(BATCH).enumerate() {
                if !control.enter("distances", i * BATCH, sources.len()) {
                    break;
                }
                found.extend(kept.distances(batch).map_err(Failure::from)?);
            }
            Ok(found)
        })?;
        matrix(py, found, n)
    }
}
