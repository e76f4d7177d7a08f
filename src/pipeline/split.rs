//! Splits the faces of one label into two labels, by the difference that is greatest over the
//! collection.
//!
//! k-means with two clusters of the mean descriptors of the label's patches groups the patches. The
//! linear discriminant of the two groups, and a cut within the label, then decide face by face.

use super::Prepared;
use crate::labels::cut::{STRENGTH, cut};
use crate::labels::{Classifier, Statistics};
use crate::linalg::kmeans::kmeans;
use crate::segmentation::Surface;
use std::sync::Arc;

const SEED: u64 = 1;
const N_STARTS: usize = 10;

/// Fits the discriminant of the two halves of a label, from the shapes, the patch of each of their
/// faces, and whether each face has the label. The second class is the smaller one. Returns `None`
/// if the label has fewer than two patches.
pub fn split_model(
    shapes: &[Arc<Prepared>],
    patches: &[&[u32]],
    is_in: &[Vec<bool>],
) -> Option<Classifier> {
    let dim = shapes.first()?.features.dim;
    let (mut points, mut weights, mut owner) = (Vec::new(), Vec::new(), Vec::new());
    for (s, shape) in shapes.iter().enumerate() {
        let n = patches[s].iter().max().map_or(0, |p| *p as usize + 1);
        let (mut sum, mut area) = (vec![0.0; n * dim], vec![0.0; n]);
        for (f, patch) in patches[s].iter().enumerate().filter(|(f, _)| is_in[s][*f]) {
            let (p, a) = (*patch as usize, shape.surface.area[f]);
            area[p] += a;
            let row = &shape.features.data[f * dim..(f + 1) * dim];
            for (sum, x) in sum[p * dim..(p + 1) * dim].iter_mut().zip(row) {
                *sum += a * f64::from(*x);
            }
        }
        for p in (0..n).filter(|p| area[*p] > 0.0) {
            points.extend(sum[p * dim..(p + 1) * dim].iter().map(|x| x / area[p]));
            weights.push(area[p]);
            owner.push((s, p as u32));
        }
    }
    if owner.len() < 2 {
        return None;
    }
    let mut group = kmeans(&points, dim, &weights, 2, SEED, N_STARTS);
    let second: f64 = group
        .iter()
        .zip(&weights)
        .filter(|(g, _)| **g == 1)
        .map(|(_, w)| w)
        .sum();
    if 2.0 * second > weights.iter().sum() {
        group.iter_mut().for_each(|g| *g = 1 - *g);
    }
    let mut statistics = Statistics::empty(2, dim);
    for (s, shape) in shapes.iter().enumerate() {
        let class = |f: usize| {
            let at = owner.binary_search(&(s, patches[s][f])).ok()?;
            is_in[s][f].then_some(group[at])
        };
        let of_shape = Statistics::of_shape(&shape.features, &shape.surface.area, class, 2);
        statistics.accumulate(&of_shape, 1.0);
    }
    Some(statistics.classifier())
}

/// Returns which faces `(m,)` of a shape take the new label, among those that have the old one.
pub fn split_faces(model: &Classifier, shape: &Prepared, is_in: &[bool]) -> Vec<bool> {
    let inside = shape
        .surface
        .edges
        .iter()
        .filter(|e| e.faces.iter().all(|f| is_in[*f as usize]));
    let surface = Surface {
        area: shape.surface.area.clone(),
        centroids: Vec::new(),
        edges: inside.copied().collect(),
    };
    let unary: Vec<f64> = model
        .log_probabilities(&shape.features)
        .iter()
        .map(|p| -p)
        .collect();
    let classes = cut(&surface, &unary, 2, STRENGTH, None);
    classes
        .iter()
        .zip(is_in)
        .map(|(class, is_in)| *is_in && *class == 1)
        .collect()
}
