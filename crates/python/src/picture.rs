//! Which face is seen in each pixel: all that a small picture of a mesh needs.

use crate::arrays::{matrix, tri_mesh};
use crate::work::interruptible;
use coseg_geometry::mesh::{Bvh, Search};
use numpy::{PyArray2, PyReadonlyArray2};
use pyo3::prelude::{Bound, PyResult, Python, pyfunction};

/// For each pixel `(height, width)` the face that is seen there, −1 where none is. The mesh is
/// looked at along −z, x to the right and y up; its bounding box fills the picture but for a
/// margin.
#[pyfunction]
pub(crate) fn faces_in_sight<'py>(
    py: Python<'py>,
    vertices: PyReadonlyArray2<'py, f64>,
    faces: PyReadonlyArray2<'py, u32>,
    width: usize,
    height: usize,
) -> PyResult<Bound<'py, PyArray2<i32>>> {
    /// Of the picture, on either side.
    const MARGIN: f64 = 0.04;
    let mesh = tri_mesh(&vertices, &faces)?;
    let seen = interruptible(py, None, move |control| {
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for p in &mesh.vertices {
            for i in 0..3 {
                low[i] = low[i].min(p[i]);
                high[i] = high[i].max(p[i]);
            }
        }
        let extent = |i: usize| (high[i] - low[i]).max(f64::MIN_POSITIVE);
        let usable = |n: usize| n as f64 * (1.0 - 2.0 * MARGIN);
        let unit = (extent(0) / usable(width)).max(extent(1) / usable(height));
        let above = high[2] + extent(0).max(extent(1));
        let tree = Bvh::new(&mesh);
        let (mut search, mut lengths) = (Search::default(), Vec::new());
        let mut seen = vec![-1; width * height];
        for (row, pixels) in seen.chunks_exact_mut(width.max(1)).enumerate() {
            if !control.enter("picture", row, height) {
                break;
            }
            for (column, pixel) in pixels.iter_mut().enumerate() {
                let x =
                    0.5 * (low[0] + high[0]) + (column as f64 + 0.5 - 0.5 * width as f64) * unit;
                let y = 0.5 * (low[1] + high[1]) - (row as f64 + 0.5 - 0.5 * height as f64) * unit;
                lengths.clear();
                let down = [[0.0, 0.0, -1.0]];
                tree.cast(&mut search, [x, y, above], &down, u32::MAX, &mut lengths);
                let Some(length) = lengths.first().filter(|length| length.is_finite()) else {
                    continue;
                };
                let at = [x, y, above - length];
                if let Some((face, _)) = tree.nearest(&mut search, at, f64::INFINITY, |_| 0.0) {
                    *pixel = face as i32;
                }
            }
        }
        Ok(seen)
    })?;
    matrix(py, seen, width)
}
