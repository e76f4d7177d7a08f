//! Functional maps between two shapes of area 1. `c_12` is in their bases of area 1.

use crate::arrays::{double, matrix, owned, rows, single};
use crate::failure::Failure;
use crate::shape::{Kept, Shape};
use crate::work::interruptible;
use coseg_geometry::fmap::convert;
use coseg_geometry::fmap::estimate::{dense, dense_back};
use coseg_geometry::fmap::icp::nearest_orthogonal;
use coseg_geometry::fmap::landmarks;
use coseg_geometry::fmap::operators::{crossing, multiplication};
use coseg_geometry::fmap::probes::{Probes, curvature_probes, probes, standardise};
use coseg_geometry::fmap::solve::{Energy, laplacian_mask, resolvent_mask};
use coseg_geometry::fmap::{self, EstimateOptions, PointMap, Side, transfer};
use nalgebra::{DMatrix, DVector};
use numpy::{PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::{Bound, PyResult, Python, pyfunction};
use pyo3::types::{PyDict, PyDictMethods, PyList, PyListMethods};
use std::sync::Arc;

/// Maps between points, the best first. `landmarks (l, 2)` are vertices that correspond;
/// `probes_1 (n1, p)` and `probes_2 (n2, p)` functions that do. Weights are relative to the
/// spectral coordinates.
#[pyfunction]
#[expect(
    clippy::too_many_arguments,
    reason = "two shapes, what is known of them, and options"
)]
pub(crate) fn point_maps<'py>(
    py: Python<'py>,
    one: &Shape,
    two: &Shape,
    landmarks: PyReadonlyArray2<'py, u32>,
    probes_1: PyReadonlyArray2<'py, f64>,
    probes_2: PyReadonlyArray2<'py, f64>,
    side: &str,
    alternative: bool,
    probe_weight: f64,
    landmark_weight: f64,
) -> PyResult<Bound<'py, PyList>> {
    let (one, two) = (Arc::clone(&one.kept), Arc::clone(&two.kept));
    let pairs = landmarks.as_slice()?.as_chunks::<2>().0.to_vec();
    let (own_1, own_2) = (single(&probes_1)?, single(&probes_2)?);
    let side = match side {
        "keep" => Side::Keep,
        "reverse" => Side::Reverse,
        _ => Side::Preferred,
    };
    let found = interruptible(py, None, move |control| {
        let options = EstimateOptions {
            side,
            alternative,
            probe_weight: probe_weight as f32,
            landmark_weight: landmark_weight as f32,
            ..EstimateOptions::default()
        };
        control.enter("probes", 0, 0);
        let known = known(&one, &two, &pairs, (own_1, own_2));
        let known = known.as_ref().map(|(a, b)| (a, b));
        let (one, two) = (one.point_shape(&options), two.point_shape(&options));
        control.enter("maps", 0, 0);
        Ok(fmap::point_maps_by_probes(&one, &two, known, &options))
    })?;
    let maps = PyList::empty(py);
    for map in found {
        maps.append(fields(py, map)?)?;
    }
    Ok(maps)
}

/// Landmarks and own probe functions, side by side.
fn known(
    one: &Kept,
    two: &Kept,
    pairs: &[[u32; 2]],
    (own_1, own_2): ((Vec<f32>, usize), (Vec<f32>, usize)),
) -> Option<(Probes, Probes)> {
    let of_pairs = |kept: &Kept, side: usize| {
        let own: Vec<u32> = pairs.iter().map(|pair| pair[side]).collect();
        landmarks::landmark_probes(&kept.basis(), &own)
    };
    let of_values = |kept: &Kept, (mut values, dim): (Vec<f32>, usize)| {
        standardise(&mut values, dim, &kept.mass);
        Probes { values, dim }
    };
    let side = |kept: &Kept, side: usize, own: (Vec<f32>, usize)| match (pairs.is_empty(), own.1) {
        (true, 0) => None,
        (false, 0) => Some(of_pairs(kept, side)),
        (true, _) => Some(of_values(kept, own)),
        (false, _) => Some(of_pairs(kept, side).beside(&of_values(kept, own), 1.0)),
    };
    side(one, 0, own_1).zip(side(two, 1, own_2))
}

fn fields(py: Python<'_>, map: PointMap) -> PyResult<Bound<'_, PyDict>> {
    let fields = PyDict::new(py);
    fields.set_item("c_12", matrix(py, double(&map.c_12), map.k)?)?;
    fields.set_item("p2p_21", PyArray1::from_vec(py, map.p2p_21))?;
    fields.set_item("matched", PyArray1::from_vec(py, map.matched))?;
    fields.set_item("orientation", map.orientation)?;
    fields.set_item("expected_error", map.expected_error)?;
    fields.set_item("cost", map.cost)?;
    fields.set_item("probe_residual", map.quality.descriptor_residual)?;
    fields.set_item("orthogonality", map.quality.orthogonality)?;
    fields.set_item("coverage", map.quality.coverage)?;
    fields.set_item("matched_share", map.quality.matched)?;
    fields.set_item("round_trip", map.assessment.round_trip)?;
    fields.set_item("smoothness", map.assessment.smoothness)?;
    Ok(fields)
}

/// For each vertex of shape 1 a vertex of shape 2, by the same `c_12 (k, k)`, and whether something
/// corresponds to it.
#[pyfunction]
#[expect(
    clippy::type_complexity,
    reason = "one tuple that Python unpacks at once"
)]
pub(crate) fn point_map_back<'py>(
    py: Python<'py>,
    one: &Shape,
    two: &Shape,
    c_12: PyReadonlyArray2<'py, f64>,
) -> PyResult<(Bound<'py, PyArray1<u32>>, Bound<'py, PyArray1<bool>>)> {
    let (one, two) = (Arc::clone(&one.kept), Arc::clone(&two.kept));
    let (c, k) = single(&c_12)?;
    let back = interruptible(py, None, move |_| {
        let options = EstimateOptions::default();
        let (one, two) = (one.point_shape(&options), two.point_shape(&options));
        Ok(fmap::point_map_back(&one, &two, &c, k))
    })?;
    let p2p_12 = PyArray1::from_vec(py, back.p2p_12);
    Ok((p2p_12, PyArray1::from_vec(py, back.matched)))
}

/// The pointwise map of `c_12 (k2, k1)`: for each vertex of shape 2 one of shape 1, or the other
/// way with `back`. Searched everywhere if `is_exact`, else (`k1 = k2`) in the nearest cells.
#[pyfunction]
pub(crate) fn pointwise<'py>(
    py: Python<'py>,
    one: &Shape,
    two: &Shape,
    c_12: PyReadonlyArray2<'py, f64>,
    back: bool,
    is_exact: bool,
) -> PyResult<Bound<'py, PyArray1<u32>>> {
    let (one, two) = (Arc::clone(&one.kept), Arc::clone(&two.kept));
    let (c, k1) = single(&c_12)?;
    let found = interruptible(py, None, move |_| {
        let k2 = c.len() / k1.max(1);
        let options = EstimateOptions::default();
        Ok(match (is_exact, back) {
            (true, false) => convert::pointwise(&one.basis(), &two.basis(), &c, k1),
            // The adjoint from the other side: the same distances.
            (true, true) => {
                let transposed = (0..k1 * k2)
                    .map(|i| c[i % k2 * k1 + i / k2])
                    .collect::<Vec<_>>();
                convert::pointwise_adjoint(&two.basis(), &one.basis(), &transposed, k2)
            }
            (false, false) => {
                let shape = one.point_shape(&options);
                dense((&shape.basis, shape.frame()), &two.basis(), &c, k1)
            }
            (false, true) => {
                let shape = two.point_shape(&options);
                dense_back(&one.basis(), (&shape.basis, shape.frame()), &c, k1)
            }
        })
    })?;
    Ok(PyArray1::from_vec(py, found))
}

/// `c_12 (k2, k1)` of a pointwise map `p2p_21 (n2,)`.
#[pyfunction]
pub(crate) fn functional<'py>(
    py: Python<'py>,
    one: &Shape,
    two: &Shape,
    p2p_21: PyReadonlyArray1<'py, u32>,
    k1: usize,
    k2: usize,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let (one, two) = (Arc::clone(&one.kept), Arc::clone(&two.kept));
    let p2p_21 = owned(&p2p_21)?;
    let found = interruptible(py, None, move |_| {
        Ok(convert::functional(
            &one.basis(),
            &two.basis(),
            &p2p_21,
            k1,
            k2,
        ))
    })?;
    matrix(py, double(&found), k1)
}

/// `rounds` times a pointwise map, its functional map, and the nearest orthogonal one; `(k2, k1)`.
#[pyfunction]
pub(crate) fn icp<'py>(
    py: Python<'py>,
    one: &Shape,
    two: &Shape,
    c_12: PyReadonlyArray2<'py, f64>,
    rounds: usize,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let (one, two) = (Arc::clone(&one.kept), Arc::clone(&two.kept));
    let (mut c, k1) = single(&c_12)?;
    let found = interruptible(py, None, move |control| {
        let (one, two, k2) = (one.basis(), two.basis(), c.len() / k1.max(1));
        for round in 0..rounds {
            if !control.enter("icp", round, rounds) {
                break;
            }
            let p2p_21 = convert::pointwise(&one, &two, &c, k1);
            c = nearest_orthogonal(&convert::functional(&one, &two, &p2p_21, k1, k2), k1);
        }
        Ok(c)
    })?;
    matrix(py, double(&found), k1)
}

/// ZoomOut: `rounds` times a pointwise map and a functional map larger by `step`; `(k, k)`.
#[pyfunction]
pub(crate) fn zoomout<'py>(
    py: Python<'py>,
    one: &Shape,
    two: &Shape,
    c_12: PyReadonlyArray2<'py, f64>,
    step: usize,
    rounds: usize,
    is_exact: bool,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let (one, two) = (Arc::clone(&one.kept), Arc::clone(&two.kept));
    let (mut c, mut k) = single(&c_12)?;
    let (c, k) = interruptible(py, None, move |control| {
        let options = EstimateOptions::default();
        let cells = (!is_exact).then(|| one.point_shape(&options));
        for round in 0..rounds {
            if !control.enter("zoomout", round, rounds) {
                break;
            }
            let (one, two) = (one.basis(), two.basis());
            let p2p_21 = match &cells {
                None => convert::pointwise(&one, &two, &c, k),
                Some(shape) => dense((&one, shape.frame()), &two, &c, k),
            };
            k += step;
            c = convert::functional(&one, &two, &p2p_21, k, k);
        }
        Ok((c, k))
    })?;
    matrix(py, double(&c), k)
}

/// For each vertex of shape 2 a face of shape 1 and barycentric coordinates `(n2, 3)` there.
#[pyfunction]
#[expect(
    clippy::type_complexity,
    reason = "one tuple that Python unpacks at once"
)]
pub(crate) fn precise<'py>(
    py: Python<'py>,
    one: &Shape,
    two: &Shape,
    c_12: PyReadonlyArray2<'py, f64>,
) -> PyResult<(Bound<'py, PyArray1<u32>>, Bound<'py, PyArray2<f64>>)> {
    let (one, two) = (Arc::clone(&one.kept), Arc::clone(&two.kept));
    let (c, k1) = single(&c_12)?;
    let found = interruptible(py, None, move |_| {
        Ok(fmap::precise::precise(
            &one.basis(),
            &two.basis(),
            &one.faces,
            &c,
            k1,
        ))
    })?;
    let weights = double(found.barycentric.as_flattened());
    Ok((PyArray1::from_vec(py, found.face), matrix(py, weights, 3)?))
}

/// The functional map `(k2, k1)` that carries probe functions `(n1, p)` to probe functions
/// `(n2, p)`, both standardised here, by the weights of the four terms.
#[pyfunction]
#[expect(
    clippy::too_many_arguments,
    reason = "two shapes, their functions, sizes and weights"
)]
pub(crate) fn fit<'py>(
    py: Python<'py>,
    one: &Shape,
    two: &Shape,
    probes_1: PyReadonlyArray2<'py, f64>,
    probes_2: PyReadonlyArray2<'py, f64>,
    k1: usize,
    k2: usize,
    weights: [f64; 4],
    mask: &str,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let (one, two) = (Arc::clone(&one.kept), Arc::clone(&two.kept));
    let (own_1, own_2) = (single(&probes_1)?, single(&probes_2)?);
    let is_resolvent = mask == "resolvent";
    let found = interruptible(py, None, move |_| {
        let [probe_weight, mask_weight, commute_weight, orient_weight] = weights;
        let of_one = Terms::new(&one, own_1, k1, [commute_weight, orient_weight]);
        let of_two = Terms::new(&two, own_2, k2, [commute_weight, orient_weight]);
        let (values_1, values_2) = (&one.eigenvalues[..k1], &two.eigenvalues[..k2]);
        let pairs = of_one.operators.into_iter().zip(of_two.operators);
        let energy = Energy {
            probes_1: of_one.coefficients,
            probes_2: of_two.coefficients,
            probe_weight,
            mask: if is_resolvent {
                resolvent_mask(values_1, values_2, 0.5)
            } else {
                laplacian_mask(values_1, values_2)
            },
            mask_weight,
            operators: pairs.map(|((x, w), (y, _))| (x, y, w)).collect(),
        };
        // Constants go to constants: the first eigenfunctions are, and both are positive.
        let mut first_column = DVector::zeros(k2);
        first_column[0] = 1.0;
        Ok::<_, Failure>(
            energy
                .minimiser(&first_column)?
                .transpose()
                .as_slice()
                .to_vec(),
        )
    })?;
    matrix(py, found, k1)
}

/// What one shape brings to the energy.
struct Terms {
    /// `(k, p)`.
    coefficients: DMatrix<f64>,
    /// `(k, k)` each, with its weight.
    operators: Vec<(DMatrix<f64>, f64)>,
}

impl Terms {
    fn new(kept: &Kept, (mut values, p): (Vec<f32>, usize), k: usize, weights: [f64; 2]) -> Self {
        standardise(&mut values, p, &kept.mass);
        let (basis, n) = (kept.basis(), kept.n_vertices());
        let coefficients = double(&basis.project(&values, p, k));
        let vectors = DMatrix::from_row_slice(n, k, &double(&basis.leading(k)));
        let mass: Vec<f64> = kept.mass.iter().map(|m| f64::from(*m)).collect();
        let mut operators = Vec::new();
        for column in 0..p {
            let f: Vec<f64> = (0..n).map(|v| f64::from(values[v * p + column])).collect();
            if weights[0] > 0.0 {
                operators.push((multiplication(&vectors, &mass, &f), weights[0]));
            }
            if weights[1] > 0.0 {
                operators.push((crossing(&kept.faces, &vectors, &f), weights[1]));
            }
        }
        Self {
            coefficients: DMatrix::from_row_slice(k, p, &coefficients),
            operators,
        }
    }
}

/// Probe functions `(n, 3 landmarks)`: logarithms of heat from each vertex at three times.
#[pyfunction]
pub(crate) fn landmark_probes<'py>(
    py: Python<'py>,
    shape: &Shape,
    vertices: PyReadonlyArray1<'py, u32>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let vertices = vertices.as_slice()?;
    let found = py.detach(|| landmarks::landmark_probes(&shape.kept.basis(), vertices));
    matrix(py, double(&found.values), found.dim)
}

/// Probe functions `(n, energies + times + scales)`: wave kernel, heat kernel, mean curvature.
#[pyfunction]
pub(crate) fn signature_probes<'py>(
    py: Python<'py>,
    shape: &Shape,
    n_energies: usize,
    n_times: usize,
    n_scales: usize,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let kept = &shape.kept;
    let found = py.detach(|| {
        let found = probes(&kept.basis(), n_energies, n_times);
        if n_scales == 0 {
            return found;
        }
        let bulges = curvature_probes(&kept.vertices, &kept.faces, &kept.basis(), n_scales);
        let weight = n_scales as f32 / found.dim.max(1) as f32;
        found.beside(&bulges, weight)
    });
    matrix(py, double(&found.values), found.dim)
}

/// Values `(m1, p)` at faces of shape 1 become values `(m2, p)` at faces of shape 2; NaN where
/// nothing corresponds.
#[pyfunction]
pub(crate) fn faces_to_faces<'py>(
    py: Python<'py>,
    faces_1: PyReadonlyArray2<'py, u32>,
    faces_2: PyReadonlyArray2<'py, u32>,
    n_1: usize,
    p2p_21: PyReadonlyArray1<'py, u32>,
    matched: PyReadonlyArray1<'py, bool>,
    values: PyReadonlyArray2<'py, f64>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let (faces_1, faces_2) = (rows(&faces_1)?, rows(&faces_2)?);
    let (p2p_21, matched) = (p2p_21.as_slice()?, matched.as_slice()?);
    let (values, dim) = single(&values)?;
    let found = py
        .detach(|| transfer::faces_to_faces(faces_1, faces_2, n_1, p2p_21, matched, &values, dim));
    matrix(py, double(&found), dim)
}

/// Labels `(m1,)` of faces of shape 1 become labels `(m2,)` of faces of shape 2; −1 where nothing
/// corresponds.
#[pyfunction]
pub(crate) fn labels_to_faces<'py>(
    py: Python<'py>,
    faces_1: PyReadonlyArray2<'py, u32>,
    faces_2: PyReadonlyArray2<'py, u32>,
    n_1: usize,
    p2p_21: PyReadonlyArray1<'py, u32>,
    matched: PyReadonlyArray1<'py, bool>,
    labels: PyReadonlyArray1<'py, i32>,
) -> PyResult<Bound<'py, PyArray1<i32>>> {
    let (faces_1, faces_2) = (rows(&faces_1)?, rows(&faces_2)?);
    let (p2p_21, matched) = (p2p_21.as_slice()?, matched.as_slice()?);
    let labels = labels.as_slice()?;
    let found =
        py.detach(|| transfer::labels_to_faces(faces_1, faces_2, n_1, p2p_21, matched, labels));
    Ok(PyArray1::from_vec(py, found))
}
