//! Converts labellings of a proxy to labels of the polygons of its file, and to new versions of a
//! shape's labels.

use super::error::Result;
use super::event::LabelMove;
use super::rows::{format_from_name, to_json};
use super::sources::{FileView, Known, Sources};
use super::types::{LabelId, PartInfo, Source};
use crate::correspondence::parts;
use crate::labels::refine_boundary;
use crate::mesh;
use crate::pipeline::{DescriptionView, Labelling};
use crate::segmentation::Surface;
use crate::store::{Digest, LabelSummary, LabelVersionRow, ShapeId};
use std::collections::BTreeMap;

/// Causes of new labels of stored shapes.
pub(super) mod cause {
    pub(crate) const ADDED: &str = "added";
    pub(crate) const RECLUSTERING: &str = "reclustering";
    pub(crate) const CORRECTION: &str = "correction";
    /// Propagation of a person's labels.
    pub(crate) const PROPAGATION: &str = "carrying";
    pub(crate) const MERGE: &str = "merge";
    pub(crate) const SPLIT: &str = "split";
    pub(crate) const UNDO: &str = "undo";
    pub(crate) const CHOICE: &str = "choice";
}

/// Labels of one shape, ready to be committed; the commit sets their sequence number.
#[derive(Debug)]
pub(super) struct NewLabels {
    pub(super) row: LabelVersionRow,
    pub(super) summary: LabelSummary,
}

impl NewLabels {
    /// Returns the same labels with the shapes that voted for them.
    pub(super) fn voted_by(mut self, sources: &[Source]) -> Self {
        self.row.sources_json = to_json(&sources);
        self
    }
}

/// A new version of a stored shape's labels.
#[derive(Debug)]
pub(super) struct Relabelled {
    pub(super) shape: ShapeId,
    pub(super) name: String,
    pub(super) labels: NewLabels,
    pub(super) moves: Vec<LabelMove>,
}

impl Relabelled {
    /// Makes these labels the next version of a stored shape's labels.
    pub(super) fn new(known: &Known, mut labels: NewLabels, cause: &'static str) -> Self {
        labels.row.version = known.row.version + 1;
        labels.row.cause = cause.into();
        let moves = moves(
            &known.labels.polygon_labels,
            &labels.row.polygon_labels,
            known.view().polygon_area,
        );
        Self {
            shape: known.row.id,
            name: known.row.name.clone(),
            labels,
            moves,
        }
    }
}

/// The file from which a shape was described.
#[derive(Debug, Clone, Copy)]
pub(super) struct Original<'a> {
    pub(super) digest: &'a Digest,
    pub(super) format: &'a str,
}

/// Returns the labels of the file's polygons and of the proxy's faces, and the parts that they
/// make. `ids` are the labels of the classes, and `epoch` is that of their model.
pub(super) fn new_labels(
    sources: &dyn Sources,
    shape: FileView<'_>,
    labelling: &Labelling,
    (ids, epoch): (&[LabelId], u64),
    original: Original<'_>,
) -> Result<NewLabels> {
    let k = ids.len();
    let (view, surface) = (&shape.view, sources.surface(shape));
    let class_of_polygon = polygon_classes(sources, view, labelling, k, original)?;
    let probability = |proxy_face: usize, class: u32| {
        f64::from(labelling.probabilities[proxy_face * k + class as usize]) / 255.0
    };
    let confidence = class_of_polygon
        .iter()
        .zip(view.face_map)
        .map(|(class, f)| labelling.probabilities[*f as usize * k + *class as usize])
        .collect();
    // Two classes may have the same label after labels were merged.
    let ids_of_face: Vec<u32> = labelling.classes.iter().map(|c| ids[*c as usize]).collect();
    let infos = part_infos(&surface, &ids_of_face, |f| {
        probability(f, labelling.classes[f])
    });
    let to_ids =
        |classes: &[u32]| -> Vec<i32> { classes.iter().map(|c| ids[*c as usize] as i32).collect() };
    let polygon_labels = to_ids(&class_of_polygon);
    let area_shares = area_shares(view, &polygon_labels);
    Ok(NewLabels {
        row: LabelVersionRow {
            proxy_labels: to_ids(&labelling.classes),
            proxy_probabilities: labelling.probabilities.clone(),
            polygon_labels,
            polygon_confidence: confidence,
            sources_json: "[]".into(),
            ..LabelVersionRow::default()
        },
        summary: LabelSummary {
            label_epoch: epoch,
            parts_json: to_json(&infos),
            area_shares,
        },
    })
}

/// Computes [`new_labels`] of a stored shape.
pub(super) fn new_labels_of(
    sources: &dyn Sources,
    known: &Known,
    labelling: &Labelling,
    ids: (&[LabelId], u64),
) -> Result<NewLabels> {
    let original = Original {
        digest: &known.row.content_digest,
        format: &known.row.format,
    };
    new_labels(sources, known.file(), labelling, ids, original)
}

/// Returns the share of the area that each label covers.
pub(super) fn area_shares(view: &DescriptionView<'_>, labels: &[i32]) -> Vec<(LabelId, f64)> {
    let mut shares = BTreeMap::<LabelId, f64>::new();
    for (label, area) in labels.iter().zip(view.polygon_area) {
        if let Ok(label) = u32::try_from(*label) {
            *shares.entry(label).or_default() += f64::from(*area);
        }
    }
    shares.into_iter().collect()
}

/// Converts labels of faces that are all labelled to ids.
pub(super) fn face_ids(labels: &[i32]) -> Vec<LabelId> {
    labels.iter().map(|l| *l as LabelId).collect()
}

/// Returns the parts that the labels of proxy faces make. `confidence` returns the confidence of a
/// face, from 0 to 1.
pub(super) fn part_infos(
    surface: &Surface,
    ids: &[LabelId],
    confidence: impl Fn(usize) -> f64,
) -> Vec<PartInfo> {
    let pieces = parts(surface, ids);
    let mut confident_area = vec![0.0; pieces.label.len()];
    for (f, part) in pieces.part_of_face.iter().enumerate() {
        confident_area[*part as usize] += surface.area[f] * confidence(f);
    }
    (0..pieces.label.len())
        .map(|p| PartInfo {
            label: pieces.label[p],
            area_share: pieces.area[p],
            confidence: confident_area[p] / pieces.area[p].max(1e-300),
        })
        .collect()
}

/// Returns the class of each polygon: that of its proxy face, with boundaries refined where the
/// input is finer than the proxy.
fn polygon_classes(
    sources: &dyn Sources,
    view: &DescriptionView<'_>,
    labelling: &Labelling,
    k: usize,
    original: Original<'_>,
) -> Result<Vec<u32>> {
    let plain = || {
        view.face_map
            .iter()
            .map(|p| labelling.classes[*p as usize])
            .collect()
    };
    let one_class = labelling.classes.iter().all(|c| *c == labelling.classes[0]);
    if view.face_map.len() <= view.faces.len() || one_class {
        return Ok(plain());
    }
    let format = format_from_name(original.format, "shapes.format")?;
    let bytes = sources.original(original.digest)?;
    // The same bytes passed these two steps when they were described, but perhaps in a release that
    // read other polygons from them.
    let Ok(parsed) = mesh::parse(&bytes, format) else {
        return Ok(plain());
    };
    if parsed.n_polygons != view.face_map.len() {
        return Ok(plain());
    }
    let Ok(cleaned) = mesh::clean(&parsed) else {
        return Ok(plain());
    };
    let cleaned = mesh::outer_shells(cleaned);
    let mut proxy_face = vec![0u32; cleaned.mesh.faces.len()];
    let mut seen = vec![false; proxy_face.len()];
    for (t, face) in cleaned.face_of_triangle.iter().enumerate() {
        let polygon = parsed.polygon_of_triangle[t] as usize;
        if !std::mem::replace(&mut seen[*face as usize], true) {
            proxy_face[*face as usize] = view.face_map[polygon];
        }
    }
    let surface = Surface::new(&cleaned.mesh);
    let edge = mean_edge(&view.mesh());
    let classes = refine_boundary(
        &surface,
        &proxy_face,
        edge,
        &labelling.classes,
        &labelling.probabilities,
        k,
    );
    // A polygon takes the class of most of its area.
    let mut area = vec![0.0; view.face_map.len() * k];
    for (t, face) in cleaned.face_of_triangle.iter().enumerate() {
        let (polygon, face) = (parsed.polygon_of_triangle[t] as usize, *face as usize);
        area[polygon * k + classes[face] as usize] += surface.area[face].max(1e-300);
    }
    let most = |(p, row): (usize, &[f64])| {
        let best = (0..k)
            .max_by(|&a, &b| row[a].total_cmp(&row[b]).then(b.cmp(&a)))
            .unwrap_or(0);
        if row[best] > 0.0 {
            best as u32
        } else {
            labelling.classes[view.face_map[p] as usize]
        }
    };
    Ok(area.chunks_exact(k).enumerate().map(most).collect())
}

fn mean_edge(mesh: &mesh::TriMesh) -> f64 {
    let mut sum = 0.0;
    for f in &mesh.faces {
        for c in 0..3 {
            let (a, b) = (
                mesh.vertices[f[c] as usize],
                mesh.vertices[f[(c + 1) % 3] as usize],
            );
            sum += (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt();
        }
    }
    sum / (3 * mesh.faces.len()).max(1) as f64
}

/// Returns the area that moves from label to label, largest first; empty if nothing changes.
pub(super) fn moves(before: &[i32], after: &[i32], area: &[f32]) -> Vec<LabelMove> {
    let mut moved = BTreeMap::<(i32, i32), f64>::new();
    for ((b, a), w) in before.iter().zip(after).zip(area) {
        if a != b {
            *moved.entry((*b, *a)).or_default() += f64::from(*w);
        }
    }
    let mut out: Vec<LabelMove> = moved
        .into_iter()
        .map(|((from, to), area_share)| LabelMove {
            from: from.into(),
            to: to.into(),
            area_share,
        })
        .collect();
    out.sort_by(|a, b| b.area_share.total_cmp(&a.area_share));
    out
}
