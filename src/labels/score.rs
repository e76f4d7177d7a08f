//! Predicted and true labels of a collection become figures of how well they agree.
//!
//! Accuracy is computed over the collection: one assignment of predicted to true labels must serve
//! all shapes, so labels that mean different things on different shapes lower it. The Rand error is
//! that of X. Chen, A. Golovinskiy and T. Funkhouser, "A benchmark for 3D mesh segmentation", 2009.

use crate::linalg::assignment::assignment;
use crate::mesh::TriMesh;
use std::collections::{BTreeMap, BTreeSet, HashMap};

/// A shape with true and predicted labels.
#[derive(Debug, Clone, Copy)]
pub struct ScoredShape<'a> {
    /// Its mesh, m faces.
    pub mesh: &'a TriMesh,
    /// True labels, `(m,)`.
    pub truth: &'a [i32],
    /// Predicted labels, `(m,)`. A negative one is 'no label' and counts as wrong. `None`: the
    /// whole shape is wrong.
    pub predicted: Option<&'a [i32]>,
}

/// How well predicted labels agree with true ones.
#[derive(Debug, Clone, PartialEq)]
pub struct Score {
    /// Number of scored shapes.
    pub n_shapes: usize,
    /// Number of shapes without a prediction.
    pub n_missing: usize,
    /// Mean over shapes of the area share with the right label after the assignment, 0 to 1.
    pub accuracy: f64,
    /// The same if each predicted label may take its best true label, several the same one.
    pub purity: f64,
    /// One minus the Rand index of the connected pieces, by faces, averaged over shapes with a
    /// prediction; `None` without predictions.
    pub rand_error: Option<f64>,
    /// Number of predicted labels in use.
    pub n_predicted_labels: usize,
    /// Number of true labels in use.
    pub n_true_labels: usize,
    /// Pairs of predicted and true label, sorted by predicted label; one to one.
    pub assignment: Vec<(i32, i32)>,
    /// Accuracy of each shape, in the order of the input.
    pub shapes: Vec<f64>,
}

/// Why a collection cannot be scored.
#[derive(Debug, thiserror::Error, Clone, PartialEq, Eq)]
pub enum ScoreError {
    /// There is nothing to average over.
    #[error("no shapes to score")]
    Empty,
    /// A list of labels does not fit its mesh.
    #[error("shape {shape} has {n_labels} {which} labels, but the mesh has {n_faces} faces")]
    Count {
        /// Position of the shape.
        shape: usize,
        /// `true` or `predicted`.
        which: &'static str,
        /// Number of labels in the list.
        n_labels: usize,
        /// Number of faces of the mesh.
        n_faces: usize,
    },
    /// The area of a shape allows no shares of its faces.
    #[error("shape {shape} has area {area}, which must be positive and finite")]
    Area {
        /// Position of the shape.
        shape: usize,
        /// Its total area, as text because it may not be a number.
        area: String,
    },
}

/// Scores the predictions for a collection. Every shape weighs 1, whatever its size.
///
/// The assignment maximises the pooled area share on its diagonal (Hungarian method). The cost is
/// linear in the faces, and O(m log m) for the connected pieces.
pub fn score(shapes: &[ScoredShape<'_>]) -> Result<Score, ScoreError> {
    if shapes.is_empty() {
        return Err(ScoreError::Empty);
    }
    let shares = all_shares(shapes)?;
    let Overlap {
        rows: predicted_labels,
        columns: true_labels,
        area: overlap,
    } = Overlap::new(shapes, &shares, |_| true);
    let (n_rows, n_cols) = (predicted_labels.len(), true_labels.len());
    let pairs = assigned(&overlap, &predicted_labels, &true_labels);

    let n = shapes.len() as f64;
    let per_shape: Vec<f64> = shapes
        .iter()
        .zip(&shares)
        .map(|(shape, share)| {
            let faces = shape
                .predicted
                .unwrap_or(&[])
                .iter()
                .zip(shape.truth)
                .zip(share);
            faces
                .filter(|((p, t), _)| pairs.get(p) == Some(t))
                .map(|(_, a)| a)
                .sum()
        })
        .collect();
    let best_of_row = |row: &[f64]| row.iter().copied().fold(0.0, f64::max);
    let rand: Vec<f64> = shapes
        .iter()
        .filter_map(|s| s.predicted.map(|p| rand_error(s.mesh, p, s.truth)))
        .collect();
    Ok(Score {
        n_shapes: shapes.len(),
        n_missing: shapes.iter().filter(|s| s.predicted.is_none()).count(),
        accuracy: per_shape.iter().sum::<f64>() / n,
        purity: overlap.chunks(n_cols.max(1)).map(best_of_row).sum::<f64>() / n,
        rand_error: (!rand.is_empty()).then(|| rand.iter().sum::<f64>() / rand.len() as f64),
        n_predicted_labels: n_rows,
        n_true_labels: n_cols,
        assignment: pairs.into_iter().collect(),
        shapes: per_shape,
    })
}

/// Shared area of predicted and true labels.
struct Overlap {
    /// The predicted labels, one row each.
    rows: Vec<i32>,
    /// The true labels, one column each.
    columns: Vec<i32>,
    /// Sum of the area shares that have both, row-major.
    area: Vec<f64>,
}

impl Overlap {
    /// Takes labels into account, predicted ones and true ones alike, for which `counts` holds.
    /// Negative predicted labels never count.
    fn new(shapes: &[ScoredShape<'_>], shares: &[Vec<f64>], counts: impl Fn(i32) -> bool) -> Self {
        let columns = distinct(shapes.iter().flat_map(|s| s.truth).filter(|t| counts(**t)));
        let given = shapes.iter().filter_map(|s| s.predicted).flatten();
        let rows: Vec<i32> = distinct(given.filter(|p| **p >= 0 && counts(**p)));
        let row_of: HashMap<i32, usize> = rows.iter().copied().zip(0..).collect();
        let col_of: HashMap<i32, usize> = columns.iter().copied().zip(0..).collect();
        let mut area = vec![0.0; rows.len() * columns.len()];
        for (shape, share) in shapes.iter().zip(shares) {
            let labels = shape.predicted.unwrap_or(&[]).iter().zip(shape.truth);
            for ((p, t), a) in labels.zip(share) {
                if let (Some(i), Some(j)) = (row_of.get(p), col_of.get(t)) {
                    area[i * columns.len() + j] += a;
                }
            }
        }
        Self {
            rows,
            columns,
            area,
        }
    }
}

/// Returns the true label of each predicted one that has one, one to one, so that most area agrees.
fn assigned(overlap: &[f64], rows: &[i32], columns: &[i32]) -> BTreeMap<i32, i32> {
    let cost: Vec<f64> = overlap.iter().map(|x| -x).collect();
    let column_of = assignment(&cost, rows.len(), columns.len());
    let pairs = rows.iter().zip(column_of);
    pairs
        .filter_map(|(row, j)| j.map(|j| (*row, columns[j])))
        .collect()
}

/// Returns the mean over shapes of the area share with the right label, where persons gave the
/// labels `given` and no others. These must *be* the true ones. Predicted labels that no person
/// gave stand for true labels that no person gave, by one assignment, one to one, that serves all
/// shapes.
pub fn accuracy_open(shapes: &[ScoredShape<'_>], given: &BTreeSet<i32>) -> Result<f64, ScoreError> {
    if shapes.is_empty() {
        return Err(ScoreError::Empty);
    }
    let shares = all_shares(shapes)?;
    let unnamed = Overlap::new(shapes, &shares, |label| !given.contains(&label));
    let meaning = assigned(&unnamed.area, &unnamed.rows, &unnamed.columns);
    let is_right = |p: &i32, t: &i32| match given.contains(p) {
        true => p == t,
        false => meaning.get(p) == Some(t),
    };
    let mut sum = 0.0;
    for (shape, share) in shapes.iter().zip(&shares) {
        let labels = shape.predicted.unwrap_or(&[]).iter().zip(shape.truth);
        let right = labels.zip(share).filter(|((p, t), _)| is_right(p, t));
        sum += right.map(|(_, a)| a).sum::<f64>();
    }
    Ok(sum / shapes.len() as f64)
}

fn all_shares(shapes: &[ScoredShape<'_>]) -> Result<Vec<Vec<f64>>, ScoreError> {
    let shares = shapes.iter().enumerate();
    shares.map(|(i, shape)| area_shares(i, shape)).collect()
}

/// Returns the mean over shapes of the area share whose predicted label *is* the true one, without
/// an assignment: for labels whose ids come from training shapes.
pub fn accuracy_by_id(shapes: &[ScoredShape<'_>]) -> Result<f64, ScoreError> {
    if shapes.is_empty() {
        return Err(ScoreError::Empty);
    }
    let mut sum = 0.0;
    for (i, shape) in shapes.iter().enumerate() {
        let labels = shape.predicted.unwrap_or(&[]).iter().zip(shape.truth);
        let shares = area_shares(i, shape)?;
        sum += labels
            .zip(shares)
            .filter(|((p, t), _)| p == t)
            .map(|(_, a)| a)
            .sum::<f64>();
    }
    Ok(sum / shapes.len() as f64)
}

fn distinct<'a>(labels: impl Iterator<Item = &'a i32>) -> Vec<i32> {
    labels
        .copied()
        .collect::<BTreeSet<_>>()
        .into_iter()
        .collect()
}

/// Returns the share of each face in the shape's area; the shares sum to 1.
fn area_shares(i: usize, shape: &ScoredShape<'_>) -> Result<Vec<f64>, ScoreError> {
    let n_faces = shape.mesh.faces.len();
    let count = |which, n_labels| ScoreError::Count {
        shape: i,
        which,
        n_labels,
        n_faces,
    };
    if shape.truth.len() != n_faces {
        return Err(count("true", shape.truth.len()));
    }
    if let Some(p) = shape.predicted.filter(|p| p.len() != n_faces) {
        return Err(count("predicted", p.len()));
    }
    let corner = |v: u32| shape.mesh.vertices[v as usize];
    let areas: Vec<f64> = shape
        .mesh
        .faces
        .iter()
        .map(|&[a, b, c]| {
            let (o, p, q) = (corner(a), corner(b), corner(c));
            let u = [p[0] - o[0], p[1] - o[1], p[2] - o[2]];
            let v = [q[0] - o[0], q[1] - o[1], q[2] - o[2]];
            let x = u[1] * v[2] - u[2] * v[1];
            let y = u[2] * v[0] - u[0] * v[2];
            let z = u[0] * v[1] - u[1] * v[0];
            (x * x + y * y + z * z).sqrt() / 2.0
        })
        .collect();
    let total: f64 = areas.iter().sum();
    if !(total > 0.0 && total.is_finite()) {
        return Err(ScoreError::Area {
            shape: i,
            area: total.to_string(),
        });
    }
    Ok(areas.into_iter().map(|a| a / total).collect())
}

/// Returns one minus the Rand index of two segmentations of one mesh into connected pieces of equal
/// label: the share of pairs of faces that are in one piece by one of them only. 0 for fewer than
/// two faces.
///
/// # Panics
///
/// If a list of labels is shorter than the faces.
pub fn rand_error(mesh: &TriMesh, one: &[i32], other: &[i32]) -> f64 {
    let n = mesh.faces.len() as f64;
    if mesh.faces.len() < 2 {
        return 0.0;
    }
    let (s, t) = (pieces(&mesh.faces, one), pieces(&mesh.faces, other));
    let squares =
        |counts: BTreeMap<(usize, usize), f64>| counts.values().map(|c| c * c).sum::<f64>();
    let mut joint = BTreeMap::new();
    let (mut first, mut second) = (BTreeMap::new(), BTreeMap::new());
    for (&a, &b) in s.iter().zip(&t) {
        *joint.entry((a, b)).or_insert(0.0) += 1.0;
        *first.entry((a, 0)).or_insert(0.0) += 1.0;
        *second.entry((b, 0)).or_insert(0.0) += 1.0;
    }
    (squares(first) / 2.0 + squares(second) / 2.0 - squares(joint)) / (n * (n - 1.0) / 2.0)
}

/// Returns the piece of each face, `(m,)`: faces of equal label that are connected across shared
/// edges, numbered by their first face.
pub fn pieces(faces: &[[u32; 3]], labels: &[i32]) -> Vec<usize> {
    let mut edges: Vec<([u32; 2], usize)> = Vec::with_capacity(3 * faces.len());
    for (f, &[a, b, c]) in faces.iter().enumerate() {
        edges.extend([(a, b), (b, c), (c, a)].map(|(u, v)| ([u.min(v), u.max(v)], f)));
    }
    edges.sort_unstable();
    let mut parent: Vec<usize> = (0..faces.len()).collect();
    for pair in edges.windows(2) {
        let ((e, f), (d, g)) = (pair[0], pair[1]);
        if e == d && labels[f] == labels[g] {
            let (a, b) = (root(&mut parent, f), root(&mut parent, g));
            parent[a.max(b)] = a.min(b);
        }
    }
    (0..faces.len()).map(|f| root(&mut parent, f)).collect()
}

fn root(parent: &mut [usize], mut i: usize) -> usize {
    while parent[i] != i {
        parent[i] = parent[parent[i]];
        i = parent[i];
    }
    i
}

#[cfg(test)]
mod tests {
    use super::{
        ScoreError, ScoredShape, accuracy_by_id, accuracy_open, pieces, rand_error, score,
    };
    use crate::mesh::TriMesh;

    const TOLERANCE: f64 = 1e-12;

    /// Builds a strip of right triangles along x whose areas are `widths / 2`.
    fn strip(widths: &[f64]) -> TriMesh {
        let mut mesh = TriMesh {
            vertices: vec![[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
            faces: vec![],
        };
        let mut ends = [0.0, 0.0];
        for (i, w) in widths.iter().enumerate() {
            let n = mesh.vertices.len() as u32;
            ends[i % 2] += w;
            mesh.vertices.push([ends[i % 2], (i % 2) as f64, 0.0]);
            mesh.faces.push([n - 2, n - 1, n]);
        }
        mesh
    }

    #[test]
    fn strip_areas_are_the_widths() {
        // Widths must be measured along the side on which a triangle has its base.
        let mesh = strip(&[1.0, 3.0]);
        assert_eq!(mesh.vertices.len(), 4);
        assert_eq!(mesh.faces, [[0, 1, 2], [1, 2, 3]]);
    }

    #[test]
    fn labels_that_nobody_gave_stand_for_true_labels_that_nobody_gave() {
        let mesh = strip(&[1.0, 1.0, 1.0, 1.0]);
        let of = |truth: &[i32], predicted: &[i32], given: &[i32]| {
            let shape = ScoredShape {
                mesh: &mesh,
                truth,
                predicted: Some(predicted),
            };
            accuracy_open(&[shape], &given.iter().copied().collect()).unwrap()
        };
        let truth = [0, 1, 2, 2];
        assert!((of(&truth, &[0, 1, 9, 9], &[0, 1]) - 1.0).abs() < TOLERANCE);
        // 9 cannot stand for a label that a person gave, and one label stands for one.
        assert!((of(&truth, &[9, 1, 9, 9], &[0, 1]) - 0.75).abs() < TOLERANCE);
        assert!((of(&truth, &[0, 1, 9, 8], &[0, 1]) - 0.75).abs() < TOLERANCE);
        // A given label is right by its id alone; the ids of others do not matter.
        assert!((of(&truth, &[1, 0, 2, 2], &[0, 1]) - 0.5).abs() < TOLERANCE);
        assert!((of(&truth, &[2, 1, 0, 0], &[1]) - 1.0).abs() < TOLERANCE);
    }

    #[test]
    fn one_assignment_serves_all_shapes() {
        // Shape 1 agrees up to names; shape 2 swaps the names, so it is wrong.
        let mesh = strip(&[1.0, 1.0, 1.0, 1.0]);
        let truth = [0, 0, 1, 1];
        let (p1, p2) = ([7, 7, 3, 3], [3, 3, 7, 3]);
        let shapes = [
            ScoredShape {
                mesh: &mesh,
                truth: &truth,
                predicted: Some(&p1),
            },
            ScoredShape {
                mesh: &mesh,
                truth: &truth,
                predicted: Some(&p2),
            },
        ];
        let s = score(&shapes).unwrap();
        // Pooled overlap: 7 with 0: .5, 7 with 1: .25, 3 with 0: .5, 3 with 1: .75.
        assert_eq!(s.assignment, [(3, 1), (7, 0)]);
        assert!((s.shapes[0] - 1.0).abs() < TOLERANCE);
        assert!((s.shapes[1] - 0.25).abs() < TOLERANCE);
        assert!((s.accuracy - 0.625).abs() < TOLERANCE);
        assert!((s.purity - 0.625).abs() < TOLERANCE);
        assert_eq!(
            (s.n_predicted_labels, s.n_true_labels, s.n_missing),
            (2, 2, 0)
        );
    }

    #[test]
    fn faces_weigh_by_area() {
        let mesh = strip(&[1.0, 3.0]);
        let s = score(&[ScoredShape {
            mesh: &mesh,
            truth: &[0, 1],
            predicted: Some(&[5, 5]),
        }]);
        let s = s.unwrap();
        assert_eq!(s.assignment, [(5, 1)]);
        assert!((s.accuracy - 0.75).abs() < TOLERANCE);
    }

    #[test]
    fn over_splitting_costs_accuracy_but_not_purity() {
        let mesh = strip(&[1.0; 4]);
        let shape = ScoredShape {
            mesh: &mesh,
            truth: &[0, 0, 0, 1],
            predicted: Some(&[1, 1, 2, 3]),
        };
        let s = score(&[shape]).unwrap();
        assert!((s.accuracy - 0.75).abs() < TOLERANCE);
        assert!((s.purity - 1.0).abs() < TOLERANCE);
    }

    #[test]
    fn unlabelled_and_missing_are_wrong() {
        let mesh = strip(&[1.0; 4]);
        let truth = [0, 0, 1, 1];
        let shapes = [
            ScoredShape {
                mesh: &mesh,
                truth: &truth,
                predicted: Some(&[0, -1, -1, 1]),
            },
            ScoredShape {
                mesh: &mesh,
                truth: &truth,
                predicted: None,
            },
        ];
        let s = score(&shapes).unwrap();
        assert!((s.accuracy - 0.25).abs() < TOLERANCE);
        assert_eq!((s.n_missing, s.n_predicted_labels), (1, 2));
        let none = score(&shapes[1..]).unwrap();
        assert_eq!(
            (none.accuracy, none.purity, none.rand_error),
            (0.0, 0.0, None)
        );
    }

    #[test]
    fn rand_error_counts_pairs() {
        let mesh = strip(&[1.0; 4]);
        assert_eq!(rand_error(&mesh, &[0, 0, 1, 1], &[5, 5, 2, 2]), 0.0);
        // One piece against two halves: the 4 pairs across are together in one and apart in the
        // other.
        let e = rand_error(&mesh, &[0, 0, 0, 0], &[0, 0, 1, 1]);
        assert!((e - 4.0 / 6.0).abs() < TOLERANCE);
        // Equal labels in separate pieces are separate segments.
        let e = rand_error(&mesh, &[0, 1, 1, 0], &[0, 1, 1, 2]);
        assert_eq!(e, 0.0);
        assert_eq!(pieces(&mesh.faces, &[0, 1, 1, 0]), [0, 1, 1, 3]);
    }

    #[test]
    fn says_what_does_not_fit() {
        let mesh = strip(&[1.0; 4]);
        let short = ScoredShape {
            mesh: &mesh,
            truth: &[0; 4],
            predicted: Some(&[0; 3]),
        };
        assert_eq!(
            score(&[short]).unwrap_err().to_string(),
            "shape 0 has 3 predicted labels, but the mesh has 4 faces"
        );
        assert_eq!(score(&[]), Err(ScoreError::Empty));
        let flat = strip(&[0.0]);
        let flat = ScoredShape {
            mesh: &flat,
            truth: &[0],
            predicted: None,
        };
        assert!(matches!(score(&[flat]), Err(ScoreError::Area { .. })));
    }

    #[test]
    fn labels_named_by_example_are_compared_by_id() {
        let mesh = strip(&[1.0, 2.0, 1.0]);
        let truth = [0, 1, 1];
        let shape = |predicted| ScoredShape {
            mesh: &mesh,
            truth: &truth,
            predicted,
        };
        let swapped = accuracy_by_id(&[shape(Some(&[1, 0, 0]))]).unwrap();
        let half = accuracy_by_id(&[shape(Some(&[0, 1, -1])), shape(None)]).unwrap();
        assert!(swapped.abs() < TOLERANCE, "{swapped}");
        assert!((half - 0.375).abs() < TOLERANCE, "{half}");
        assert_eq!(accuracy_by_id(&[]), Err(ScoreError::Empty));
    }
}
