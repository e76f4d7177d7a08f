//! The geometry of coseg for Python, as `coseg._native`: NumPy arrays in, NumPy arrays out.

mod arrays;
mod describe;
mod failure;
mod geodesics;
mod maps;
mod mesh;
mod picture;
mod shape;
mod spectral;
mod work;

use pyo3::prelude::{Bound, PyModule, PyModuleMethods, PyResult, pymodule};
use pyo3::wrap_pyfunction;

#[pymodule]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add_class::<shape::Shape>()?;
    module.add_class::<geodesics::HeatGeodesics>()?;
    module.add_function(wrap_pyfunction!(mesh::parse, module)?)?;
    module.add_function(wrap_pyfunction!(mesh::triangulate, module)?)?;
    module.add_function(wrap_pyfunction!(mesh::clean, module)?)?;
    module.add_function(wrap_pyfunction!(mesh::topology, module)?)?;
    module.add_function(wrap_pyfunction!(mesh::edge_distances, module)?)?;
    module.add_function(wrap_pyfunction!(spectral::laplacian, module)?)?;
    module.add_function(wrap_pyfunction!(spectral::spectrum, module)?)?;
    module.add_function(wrap_pyfunction!(spectral::point_kernels, module)?)?;
    module.add_function(wrap_pyfunction!(spectral::hks_times, module)?)?;
    module.add_function(wrap_pyfunction!(spectral::null_space, module)?)?;
    module.add_function(wrap_pyfunction!(maps::point_maps, module)?)?;
    module.add_function(wrap_pyfunction!(maps::point_map_back, module)?)?;
    module.add_function(wrap_pyfunction!(maps::pointwise, module)?)?;
    module.add_function(wrap_pyfunction!(maps::functional, module)?)?;
    module.add_function(wrap_pyfunction!(maps::icp, module)?)?;
    module.add_function(wrap_pyfunction!(maps::zoomout, module)?)?;
    module.add_function(wrap_pyfunction!(maps::precise, module)?)?;
    module.add_function(wrap_pyfunction!(maps::fit, module)?)?;
    module.add_function(wrap_pyfunction!(maps::landmark_probes, module)?)?;
    module.add_function(wrap_pyfunction!(maps::signature_probes, module)?)?;
    module.add_function(wrap_pyfunction!(maps::faces_to_faces, module)?)?;
    module.add_function(wrap_pyfunction!(maps::labels_to_faces, module)?)?;
    module.add_function(wrap_pyfunction!(describe::describe, module)?)?;
    module.add_function(wrap_pyfunction!(describe::segment, module)?)?;
    module.add_function(wrap_pyfunction!(picture::faces_in_sight, module)?)?;
    Ok(())
}
