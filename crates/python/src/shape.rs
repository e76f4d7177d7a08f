//! A mesh with its spectrum as functional maps take it: of area 1, in single precision.

use crate::arrays::{owned, tri_mesh};
use coseg_geometry::fmap::estimate::Frame;
use coseg_geometry::fmap::{Basis, EstimateOptions, PointShape};
use numpy::{PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::{PyResult, Python, pyclass, pymethods};
use std::sync::{Arc, OnceLock};

/// Kept by the Python object and by the threads that work on it.
#[derive(Debug)]
pub(crate) struct Kept {
    pub(crate) vertices: Vec<[f32; 3]>,
    pub(crate) faces: Vec<[u32; 3]>,
    pub(crate) eigenvalues: Vec<f64>,
    /// `(n, k)`, row-major.
    eigenvectors: Vec<f32>,
    pub(crate) mass: Vec<f32>,
    /// Computed for the first map.
    frame: OnceLock<Arc<Frame>>,
}

impl Kept {
    pub(crate) fn basis(&self) -> Basis<'_> {
        Basis {
            eigenvalues: &self.eigenvalues,
            eigenvectors: &self.eigenvectors,
            n_eigenvectors: self.eigenvalues.len(),
            mass: &self.mass,
        }
    }

    /// With samples, probe functions and the sense of orientation, which depend on the sizes in
    /// `options` alone: those are the default ones here.
    pub(crate) fn point_shape(&self, options: &EstimateOptions) -> PointShape<'_> {
        let frame = self.frame.get_or_init(|| {
            let shape = PointShape::new(&self.vertices, &self.faces, self.basis(), options);
            Arc::clone(shape.frame())
        });
        PointShape::with_frame(&self.vertices, &self.faces, self.basis(), Arc::clone(frame))
    }

    pub(crate) fn n_vertices(&self) -> usize {
        self.vertices.len()
    }
}

/// A mesh with its spectrum, scaled to area 1.
#[pyclass(frozen, module = "coseg._native")]
pub(crate) struct Shape {
    pub(crate) kept: Arc<Kept>,
}

#[pymethods]
impl Shape {
    /// Of a mesh `vertices (n, 3)`, `faces (m, 3)` with eigenvalues `(k,)`, eigenvectors `(n, k)`
    /// and mass `(n,)` in its own units.
    #[new]
    fn new(
        py: Python<'_>,
        vertices: PyReadonlyArray2<'_, f64>,
        faces: PyReadonlyArray2<'_, u32>,
        eigenvalues: PyReadonlyArray1<'_, f64>,
        eigenvectors: PyReadonlyArray2<'_, f64>,
        mass: PyReadonlyArray1<'_, f64>,
    ) -> PyResult<Self> {
        let mesh = tri_mesh(&vertices, &faces)?;
        let (n, shape) = (mesh.vertices.len(), eigenvectors.shape());
        if shape != [n, eigenvalues.len()] || mass.len() != n {
            return Err(PyValueError::new_err(format!(
                "{n} vertices have eigenvectors {shape:?}, {} eigenvalues and {} masses",
                eigenvalues.len(),
                mass.len(),
            )));
        }
        let rows = eigenvectors.as_slice()?;
        let (mass, mut eigenvalues) = (owned(&mass)?, owned(&eigenvalues)?);
        let kept = py.detach(move || {
            let area: f64 = mass.iter().sum();
            let root = area.sqrt();
            for value in &mut eigenvalues {
                *value *= area;
            }
            let total = |i: usize| mesh.vertices.iter().map(|p| p[i]).sum::<f64>();
            let middle: [f64; 3] = std::array::from_fn(|i| total(i) / n.max(1) as f64);
            let placed = |p: &[f64; 3]| std::array::from_fn(|i| ((p[i] - middle[i]) / root) as f32);
            Kept {
                vertices: mesh.vertices.iter().map(placed).collect(),
                faces: mesh.faces,
                eigenvalues,
                eigenvectors: rows.iter().map(|x| (x * root) as f32).collect(),
                mass: mass.iter().map(|m| (m / area) as f32).collect(),
                frame: OnceLock::new(),
            }
        });
        Ok(Self {
            kept: Arc::new(kept),
        })
    }
}
