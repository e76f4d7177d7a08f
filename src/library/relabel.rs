//! Labellings of the proxy become labels of the input, and stale shapes are labelled anew.

use super::carry::MapIn;
use super::lane::Lane;
use super::place::{Known, sources_of};
use super::rows::{format_from_name, to_json};
use super::{LabelId, LabelMove, Library, PartInfo, Result, Source};
use crate::correspondence::parts;
use crate::labels::refine_boundary;
use crate::mesh;
use crate::pipeline::{DescriptionView, Labelling, Prepared, Vote, label};
use crate::segmentation::Surface;
use crate::store::{LabelSummary, LabelVersionRow, ShapeId};
use std::collections::BTreeMap;

/// Labels of one shape, ready to be committed; version, sequence and cause are set by the commit.
pub(super) struct NewLabels {
    pub(super) row: LabelVersionRow,
    pub(super) summary: LabelSummary,
}

/// A new version of a stored shape's labels.
pub(super) struct Relabelled {
    pub(super) shape: ShapeId,
    pub(super) name: String,
    pub(super) labels: NewLabels,
    pub(super) moves: Vec<LabelMove>,
    /// The rule that allows it.
    pub(super) cause: &'static str,
}

impl Relabelled {
    /// What changes when a stored shape gets these labels, as its next version.
    pub(super) fn new(known: &Known, mut labels: NewLabels, cause: &'static str) -> Self {
        labels.row.version = known.row.version + 1;
        let moves = moves(
            &known.labels.polygon_labels,
            &labels.row.polygon_labels,
            known.mapped.view().polygon_area,
        );
        Self {
            shape: known.row.id,
            name: known.row.name.clone(),
            labels,
            moves,
            cause,
        }
    }
}

/// Causes of new labels of stored shapes.
pub(super) mod cause {
    pub(crate) const RECLUSTERING: &str = "reclustering";
    pub(crate) const CORRECTION: &str = "correction";
    pub(crate) const CARRYING: &str = "carrying";
    pub(crate) const MERGE: &str = "merge";
    pub(crate) const SPLIT: &str = "split";
    pub(crate) const UNDO: &str = "undo";
}

/// Where the bytes of a shape come from, and their format.
pub(super) type Original<'a> = (&'a dyn Fn() -> Result<Vec<u8>>, &'a str);

impl Library {
    /// Labels of the input's polygons, of the proxy's faces, and of the parts they make.
    pub(super) fn finish_labels(
        &self,
        view: &DescriptionView<'_>,
        labelling: &Labelling,
        ids: &[LabelId],
        original: Original<'_>,
    ) -> Result<NewLabels> {
        let k = ids.len();
        let surface = Surface::new(&view.mesh());
        let class_of_polygon = polygon_classes(view, labelling, k, original)?;
        let probability = |proxy_face: usize, class: u32| {
            f64::from(labelling.probabilities[proxy_face * k + class as usize]) / 255.0
        };
        let confidence = class_of_polygon
            .iter()
            .zip(view.face_map)
            .map(|(class, f)| labelling.probabilities[*f as usize * k + *class as usize])
            .collect();
        // Two classes may be one label, after labels were merged.
        let ids_of_face: Vec<u32> = labelling.classes.iter().map(|c| ids[*c as usize]).collect();
        let infos = part_infos(&surface, &ids_of_face, |f| {
            probability(f, labelling.classes[f])
        });
        let to_ids = |classes: &[u32]| -> Vec<i32> {
            classes.iter().map(|c| ids[*c as usize] as i32).collect()
        };
        let polygon_labels = to_ids(&class_of_polygon);
        let area_shares = area_shares(view, &polygon_labels);
        Ok(NewLabels {
            row: LabelVersionRow {
                proxy_labels: to_ids(&labelling.classes),
                proxy_probabilities: labelling.probabilities.clone(),
                polygon_labels,
                polygon_confidence: confidence,
                ..LabelVersionRow::default()
            },
            summary: LabelSummary {
                label_epoch: 0,
                parts_json: to_json(&infos),
                area_shares,
            },
        })
    }

    /// New versions of the labels of stored shapes that were clustered anew.
    pub(super) fn finish_relabelled(
        &self,
        relabelled: &[(Known, Labelling)],
        ids: &[LabelId],
    ) -> Result<Vec<Relabelled>> {
        let mut out = Vec::new();
        for (known, labelling) in relabelled {
            out.push(self.relabelled(known, labelling, ids)?);
        }
        Ok(out)
    }

    fn relabelled(
        &self,
        known: &Known,
        labelling: &Labelling,
        ids: &[LabelId],
    ) -> Result<Relabelled> {
        let labels = self.finish_known(known, labelling, ids)?;
        Ok(Relabelled::new(known, labels, cause::RECLUSTERING))
    }

    /// [`Library::finish_labels`] of a stored shape.
    pub(super) fn finish_known(
        &self,
        known: &Known,
        labelling: &Labelling,
        ids: &[LabelId],
    ) -> Result<NewLabels> {
        let original = || self.original_bytes(&known.row.content_digest);
        let original: Original<'_> = (&original, &known.row.format);
        self.finish_labels(&known.mapped.view(), labelling, ids, original)
    }

    /// Labels a stale shape anew from kept maps and the model its epoch began with: a vote and a cut. Whether it was
    /// stale. The result depends on neither the time nor the order in which stale shapes are labelled, because only
    /// representatives, which are never stale, vote.
    pub(super) fn relabel(&self, lane: &mut Lane, at: usize) -> Result<bool> {
        if lane.state.teaching.is_some() {
            return self.relabel_taught(lane, at);
        }
        let shape = &lane.shapes[at];
        let Some(learnt) = lane.learnt.as_ref().filter(|_| shape.stale) else {
            return Ok(false);
        };
        let id = shape.id;
        let model = learnt.base_model();
        let known = self.known(id)?;
        let view = known.mapped.view();
        let kept = self.store.catalog().read(|r| r.maps_into(id))?;
        let is_source = |from: ShapeId| {
            let shape = lane.shapes.iter().find(|s| s.id == from);
            shape.is_some_and(|s| lane.state.representatives.contains(&s.ordinal))
        };
        let mut sources = Vec::new();
        let mut maps = Vec::new();
        for map in kept.into_iter().filter(|m| is_source(m.from)) {
            sources.push(self.known(map.from)?);
            maps.push(MapIn::of_row(map)?);
        }
        let views: Vec<DescriptionView<'_>> = sources.iter().map(|k| k.mapped.view()).collect();
        let votes: Vec<Vote<'_>> = sources
            .iter()
            .zip(&views)
            .zip(&maps)
            .map(|((k, v), map)| Vote {
                faces: v.faces,
                probabilities: &k.labels.proxy_probabilities,
                p2p: &map.p2p_21,
                confidence: &map.confidence,
                trust: 1.0,
            })
            .collect();
        let prepared = Prepared::new(&view, &model);
        let labelling = label(&view, &prepared, &model, &votes);
        let carried_from: Vec<Source> = sources_of(&sources, &labelling.weights);
        let relabelled = self.relabelled(&known, &labelling, &model.labels)?;
        self.commit_relabelled(lane, relabelled, &carried_from, model.epoch)?;
        lane.shapes[at].stale = false;
        Ok(true)
    }
}

/// Share of the area that each label covers.
pub(super) fn area_shares(view: &DescriptionView<'_>, labels: &[i32]) -> Vec<(LabelId, f64)> {
    let mut shares = BTreeMap::<LabelId, f64>::new();
    for (label, area) in labels.iter().zip(view.polygon_area) {
        if let Ok(label) = u32::try_from(*label) {
            *shares.entry(label).or_default() += f64::from(*area);
        }
    }
    shares.into_iter().collect()
}

/// The label ids of faces all of which have one.
pub(super) fn face_ids(labels: &[i32]) -> Vec<LabelId> {
    labels.iter().map(|l| *l as LabelId).collect()
}

/// The parts that the labels of proxy faces make; `confidence` is that of a face, from 0 to 1.
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

/// Class of each polygon: that of its proxy face, with boundaries refined where the input is finer than the proxy.
fn polygon_classes(
    view: &DescriptionView<'_>,
    labelling: &Labelling,
    k: usize,
    (original, format): Original<'_>,
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
    let format = format_from_name(format, "shapes.format")?;
    let bytes = original()?;
    // The same bytes passed these two steps when they were described, perhaps by a release that
    // read other polygons in them.
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

/// Area that moves from label to label, largest first; empty if nothing changes.
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
