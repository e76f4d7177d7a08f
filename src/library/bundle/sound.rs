//! Checks that the verified content of a bundle fits together, so that a bundle somebody forged
//! labels badly at worst.

use super::content::Bundled;
use crate::descriptors::{GROUPS, N_SHAPE_DNA, N_UP_COLUMNS};
use crate::labels::{LabelModel, Statistics};
use crate::library::collection::state::Phase;
use crate::library::collection::{Collection, ModelState};
use crate::library::collections::WORKING_FACES;
use crate::library::linked::kind_of;
use crate::library::{MAX_LABEL, MAX_LABELS, MAX_PARTS};
use crate::pipeline::DescriptionView;
use crate::store::{CollectionRow, LinkRow, ShapeId};
use std::collections::HashMap;

/// What does not fit.
type Checked = Result<(), String>;

fn require(holds: bool, what: impl FnOnce() -> String) -> Checked {
    match holds {
        true => Ok(()),
        false => Err(what()),
    }
}

/// The number of columns of face descriptors.
fn n_descriptors() -> usize {
    GROUPS.iter().map(|g| g.1).sum()
}

fn all_finite(values: &[f64]) -> bool {
    values.iter().all(|x| x.is_finite())
}

fn are_finite(statistics: &Statistics) -> bool {
    let Statistics {
        counts,
        sums,
        moment,
    } = statistics;
    all_finite(counts) && all_finite(sums) && all_finite(moment)
}

/// Checks a label model.
pub(super) fn model(state: &ModelState) -> Checked {
    let model = &state.model;
    let (k, dim) = (model.labels.len(), model.normalisation.mean.len());
    require((1..=MAX_LABELS).contains(&k), || {
        format!("the model has {k} labels, the limit is {MAX_LABELS}")
    })?;
    require(model.labels.iter().all(|l| *l <= MAX_LABEL), || {
        format!("a label of the model is above {MAX_LABEL}")
    })?;
    let n = n_descriptors();
    let fits = match model.up {
        None => dim == n,
        Some(_) => dim > n && dim <= n + N_UP_COLUMNS,
    };
    require(fits, || {
        format!("the model has {dim} columns, but descriptors have {n}")
    })?;
    let normalisation = &model.normalisation;
    let mut finite = all_finite(&normalisation.mean) && all_finite(&normalisation.deviation);
    finite &= all_finite(&model.up.unwrap_or_default());
    finite &= are_finite(&model.statistics) && are_finite(&state.base);
    if let Some(prior) = &state.prior {
        finite &= are_finite(&prior.statistics) && all_finite(&prior.meaning);
        finite &= prior.agreement.is_finite();
    }
    require(finite, || "the model has a value that is not finite".into())
}

/// Checks the settings of the collection.
pub(super) fn settings(row: &CollectionRow) -> Checked {
    let n = row.working_faces;
    require(WORKING_FACES.contains(&n), || {
        format!("working_faces is {n}, but must be {WORKING_FACES:?}")
    })?;
    let n = row.n_parts.unwrap_or(1);
    require((1..=MAX_PARTS).contains(&n), || {
        format!("the number of parts is {n}, but must be 1 to {MAX_PARTS}")
    })?;
    let (label, ordinal) = (row.next_label, row.next_ordinal);
    require(label <= MAX_LABEL + 1 && ordinal < i64::MAX as u64, || {
        format!("the next label is {label}, the next ordinal {ordinal}")
    })
}

/// Checks the state of the collection.
pub(super) fn state(collection: &Collection) -> Checked {
    let supervision = collection.state().regime.supervision();
    require(!collection.shapes().is_empty(), || {
        "it has no shapes".into()
    })?;
    require(
        supervision.is_none_or(|s| s.phase() == Phase::Fitted),
        || "its model is not fitted".into(),
    )
}

/// Checks a shape against the model.
pub(super) fn shape(shape: &Bundled, model: &LabelModel) -> Checked {
    let (view, name) = (shape.arrays.view(), &shape.row.name);
    description(&view).map_err(|e| format!("shape {name:?}: {e}"))?;
    let (m, n_polygons) = (view.faces.len(), view.face_map.len());
    let labels = &shape.labels;
    let (n, k) = (labels.proxy_labels.len(), model.labels.len());
    let is_whole = labels.proxy_probabilities.len().is_multiple_of(m);
    require(n == m && is_whole, || {
        format!("shape {name:?} has {m} faces, but {n} labels of {k} classes")
    })?;
    let in_range = |l: &i32| (-1..=MAX_LABEL as i32).contains(l);
    let pins = shape.pins.as_deref().unwrap_or_default();
    require(labels.proxy_labels.iter().chain(pins).all(in_range), || {
        format!("shape {name:?} has a label above {MAX_LABEL}")
    })?;
    let n = pins.len();
    require(shape.pins.is_none() || n == n_polygons, || {
        format!("shape {name:?} has {n_polygons} polygons, but {n} labels by a person")
    })
}

/// Checks a description.
fn description(view: &DescriptionView<'_>) -> Checked {
    let (n, columns) = (view.vertices.len(), n_descriptors());
    let counts = [
        n,
        view.faces.len(),
        view.face_map.len(),
        view.eigenvalues.len(),
    ];
    require(!counts.contains(&0), || {
        format!("its vertices, faces, polygons and eigenvalues number {counts:?}")
    })?;
    let found = (view.n_descriptors, view.signature.len());
    require(found == (columns, 4 * columns + N_SHAPE_DNA), || {
        format!("its descriptors and signature have {found:?} columns")
    })?;
    let found = (view.n_eigenvectors, view.eigenvalues.len());
    require(found.0 > 0 && found.0 <= found.1, || {
        format!(
            "it has {} eigenvectors of {n} values for {} eigenvalues",
            found.0, found.1
        )
    })?;
    let vertices = view.vertices.as_flattened();
    let single = [
        vertices,
        view.mass,
        view.eigenvectors,
        view.hks,
        view.face_descriptors,
        view.polygon_area,
        view.signature,
    ];
    let mut single = single.into_iter().flatten();
    require(
        all_finite(view.eigenvalues) && single.all(|x| x.is_finite()),
        || "it has a value that is not finite".into(),
    )
}

/// Checks that links name parts of shapes in the bundle.
pub(super) fn links(links: &[LinkRow], shapes: &HashMap<ShapeId, Bundled>) -> Checked {
    for link in links {
        kind_of(link).map_err(|e| e.to_string())?;
        for end in &link.ends {
            let shape = shapes.get(&end.shape);
            let n = shape.map_or(0, |s| s.row.n_polygons);
            let fits = end.polygons.iter().all(|p| u64::from(*p) < n);
            require(fits && n > 0, || {
                format!("link {} names polygons that no shape has", link.id)
            })?;
        }
    }
    Ok(())
}
