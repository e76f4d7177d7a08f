//! Merges two labels into one, and splits one label into two.

use super::change::{Change, Undoable, commit_once};
use super::collection::state::Discovered;
use super::collection::{Collection, Staleness, fit, supervised};
use super::collections::{find_label, label_in};
use super::error::{LibraryError, Result};
use super::facade::Library;
use super::labelling::{NewLabels, Relabelled, area_shares, cause, face_ids, part_infos};
use super::once::{Request, answered, from_reply};
use super::pins::pins_of;
use super::reason::Reason;
use super::rows::to_json;
use super::sources::{Known, Sources};
use super::types::{LabelId, LabelInfo, RequestKey};
use crate::pipeline::{LabelChange, Prepared, split_faces, split_model};
use crate::segmentation::Surface;
use crate::store::{CollectionRow, LabelRow, LabelSummary, LabelVersionRow, ShapeId};
use std::sync::Arc;

/// New ids of a shape's proxy faces and polygons, and its probabilities.
struct Renamed {
    proxy_labels: Vec<i32>,
    proxy_probabilities: Vec<u8>,
    polygon_labels: Vec<i32>,
}

impl Library {
    /// Merges one label into another: faces with `label` have `into` from then on, on every shape.
    /// Returns the remaining label, and the number of shapes whose labels changed. Costs as much as
    /// there are shapes with the label.
    ///
    /// # Errors
    /// There is no such collection or label, or one of them is not in use.
    pub fn merge_labels(
        &self,
        collection: &str,
        label: LabelId,
        into: LabelId,
        key: Option<&RequestKey>,
    ) -> Result<(LabelInfo, u64)> {
        let request = Request::of(key, &format!("merge {collection:?} {label} {into}"));
        let row = self.collection_row(collection)?;
        self.with_collection(row, |collection| {
            if let Some(reply) = answered(&self.store, &request)? {
                return self.replied(&reply, collection.row(), into);
            }
            let id = collection.id();
            if label == into {
                let message = format!("label {label} cannot be merged into itself");
                return Err(LibraryError::invalid(Reason::FieldRange, message));
            }
            let labels = self.store.labels(id)?;
            require_in_use(&labels, label)?;
            require_in_use(&labels, into)?;
            self.check_merge(collection, (label, into))?;
            let catalog = self.store.catalog();
            let labelled = catalog.read(|r| r.shapes(id, 0, usize::MAX, Some(label)))?;
            let labelled: Vec<ShapeId> = labelled.into_iter().map(|s| s.id).collect();
            let change = merge(collection, &self.store, (label, into), &labelled)?;
            let n = change.relabelled.len() as u64;
            let reply = commit_once(&self.store, collection, change, &request, |tx, _| {
                Ok(to_json(&(label_in(tx, id, into)?, n)).into_bytes())
            })?;
            from_reply(&reply)
        })
    }

    /// Returns the reply that was stored before. An earlier version stored less of it; then the
    /// label is read again.
    fn replied(
        &self,
        reply: &[u8],
        row: &CollectionRow,
        label: LabelId,
    ) -> Result<(LabelInfo, u64)> {
        from_reply(reply).or_else(|_| {
            let stored = from_reply::<(LabelId, u64)>(reply);
            let (label, n) = stored.or_else(|_| from_reply(reply).map(|n: u64| (label, n)))?;
            let info = self.store.catalog().read(|r| label_in(r, row.id, label))?;
            Ok((info, n))
        })
    }

    /// Splits one label into two by the difference of its patches that is greatest over the
    /// collection (two means of their mean descriptors), then face by face (the discriminant of the
    /// two, and a cut). The larger share keeps the id. Returns the new label, and the number of
    /// shapes whose labels changed at once; the others follow in the background.
    ///
    /// # Errors
    /// There is no such collection or label, it is not in use, or it has fewer than two patches.
    pub fn split_label(
        &self,
        collection: &str,
        label: LabelId,
        key: Option<&RequestKey>,
    ) -> Result<(LabelInfo, u64)> {
        let request = Request::of(key, &format!("split {collection:?} {label}"));
        let row = self.collection_row(collection)?;
        self.with_collection(row, |collection| {
            if let Some(reply) = answered(&self.store, &request)? {
                return self.replied(&reply, collection.row(), label);
            }
            let id = collection.id();
            require_in_use(&self.store.labels(id)?, label)?;
            let new = collection.row().next_label;
            let change = split(collection, &self.store, label)?;
            let n = change.relabelled.len() as u64;
            let reply = commit_once(&self.store, collection, change, &request, |tx, _| {
                Ok(to_json(&(label_in(tx, id, new)?, n)).into_bytes())
            })?;
            from_reply(&reply)
        })
    }
}

/// Refuses a label that does not exist or was merged into another.
fn require_in_use(labels: &[LabelRow], label: LabelId) -> Result<()> {
    match find_label(labels, label)?.merged_into {
        None => Ok(()),
        Some(into) => Err(LibraryError::FailedPrecondition {
            reason: Reason::LabelMerged,
            message: format!("label {label} was merged into {into}"),
        }),
    }
}

/// Returns the change that merges a label into another, on the shapes that have it.
fn merge(
    collection: &Collection,
    sources: &dyn Sources,
    (label, into): (LabelId, LabelId),
    labelled: &[ShapeId],
) -> Result<Change> {
    let change = |l: &i32| if *l == label as i32 { into as i32 } else { *l };
    let mut pins = Vec::new();
    for shape in collection.shapes().iter().filter(|s| s.pinned) {
        let old = pins_of(sources, shape.id)?;
        let new: Vec<i32> = old.iter().map(change).collect();
        if new != old {
            pins.push((shape.id, Some(new)));
        }
    }
    let mut relabelled = Vec::with_capacity(labelled.len());
    for shape in labelled {
        let known = sources.known(*shape)?;
        let labels = &known.labels;
        let renamed = Renamed {
            proxy_labels: labels.proxy_labels.iter().map(change).collect(),
            proxy_probabilities: labels.proxy_probabilities.clone(),
            polygon_labels: labels.polygon_labels.iter().map(change).collect(),
        };
        relabelled.push(renamed_labels(&known, renamed, cause::MERGE));
    }
    let model = collection.model().cloned().map(|mut model| {
        for l in &mut model.model.labels {
            *l = if *l == label { into } else { *l };
        }
        model
    });
    let supervision = supervised::renamed(collection, sources)?;
    let merged = LabelChange::Merged { from: label, into };
    Ok(Change {
        undoable: Some(Undoable::Merge { label, into }),
        labels: vec![merged.into()],
        pins,
        relabelled,
        staleness: Staleness::Unchanged,
        model,
        state: Some(supervised::with(collection, supervision)),
        ..Change::default()
    })
}

/// Returns the change that splits a label: on training shapes, and on shapes with discovered
/// labels.
fn split(collection: &Collection, sources: &dyn Sources, label: LabelId) -> Result<Change> {
    let Some(model) = collection.label_model() else {
        return Err(too_few(label));
    };
    let shapes = collection.shapes();
    let new = collection.row().next_label;
    let supervision = collection.state().regime.supervision();
    let mut kept = supervision.map_or_else(Vec::new, |s| s.discovered().kept.clone());
    // Training shapes show every label, unless discovered ones may be on other shapes alone.
    let on_training = supervision.is_some_and(|s| !s.is_open()) && kept.is_empty();
    let members = fit::members(collection, &sources.links(collection.id())?);
    let chosen: Vec<usize> = (0..shapes.len())
        .filter(|at| shapes[*at].pinned || !on_training && members.contains(at))
        .collect();
    let known = chosen.iter().map(|at| sources.known(shapes[*at].id));
    let known: Vec<Known> = known.collect::<Result<_>>()?;
    let prepared = known.iter().map(|k| sources.prepared(k.file(), model));
    let prepared: Vec<Arc<Prepared>> = prepared.collect();
    let is_in = known.iter().map(|k| {
        let labels = k.labels.proxy_labels.iter();
        labels.map(|l| *l == label as i32).collect()
    });
    let is_in: Vec<Vec<bool>> = is_in.collect();
    let patches: Vec<&[u32]> = known.iter().map(|k| k.view().patches).collect();
    let Some(halves) = split_model(&prepared, &patches, &is_in) else {
        return Err(too_few(label));
    };
    let n_old = model.labels.len();
    if kept.contains(&label) {
        kept.push(new);
    }
    let mut discovered = Discovered {
        labels: model.labels.iter().copied().chain([new]).collect(),
        versions: Vec::new(),
        kept,
    };
    let (mut relabelled, mut pins) = (Vec::new(), Vec::new());
    for (i, known) in known.iter().enumerate() {
        let is_new = split_faces(&halves, &prepared[i], &is_in[i]);
        let of_face = |(l, is_new): (&i32, &bool)| if *is_new { new as i32 } else { *l };
        let proxy: Vec<i32> = known
            .labels
            .proxy_labels
            .iter()
            .zip(&is_new)
            .map(of_face)
            .collect();
        let face_map = known.view().face_map;
        let of_polygon = |(p, l): (usize, &i32)| match is_new[face_map[p] as usize] {
            true if *l == label as i32 => new as i32,
            _ => *l,
        };
        let polygons = known.labels.polygon_labels.iter().enumerate();
        let renamed = Renamed {
            proxy_probabilities: with_new_class(&known.labels, n_old, &discovered.labels, &proxy),
            proxy_labels: proxy,
            polygon_labels: polygons.map(of_polygon).collect(),
        };
        let shape = &shapes[chosen[i]];
        if shape.pinned {
            let old = pins_of(sources, shape.id)?;
            let changed = old.iter().enumerate().map(of_polygon).collect();
            pins.push((shape.id, Some(changed)));
        }
        discovered
            .versions
            .push((shape.ordinal, known.row.version + 1));
        relabelled.push(renamed_labels(known, renamed, cause::SPLIT));
    }
    let supervision = supervised::renamed(collection, sources)?.rediscovered(discovered);
    let split = LabelChange::Split {
        from: label,
        into: new,
    };
    Ok(Change {
        undoable: Some(Undoable::Split { label, new }),
        labels: vec![LabelChange::Created(new).into(), split.into()],
        pins,
        relabelled,
        staleness: Staleness::All,
        state: Some(supervised::with(collection, supervision)),
        ..Change::default()
    })
}

fn too_few(label: LabelId) -> LibraryError {
    LibraryError::FailedPrecondition {
        reason: Reason::LabelTooSmall,
        message: format!("label {label} has fewer than 2 patches, so it cannot become 2 labels"),
    }
}

/// Returns a new version of a shape's labels with other ids.
fn renamed_labels(known: &Known, renamed: Renamed, cause: &'static str) -> Relabelled {
    let view = known.view();
    let surface = Surface::new(&view.mesh());
    let k = renamed.proxy_probabilities.len() / renamed.proxy_labels.len().max(1);
    let infos = part_infos(&surface, &face_ids(&renamed.proxy_labels), |f| {
        let row = &renamed.proxy_probabilities[f * k..(f + 1) * k];
        f64::from(row.iter().copied().max().unwrap_or(0)) / 255.0
    });
    let row = LabelVersionRow {
        proxy_labels: renamed.proxy_labels,
        proxy_probabilities: renamed.proxy_probabilities,
        polygon_labels: renamed.polygon_labels,
        polygon_confidence: known.labels.polygon_confidence.clone(),
        sources_json: "[]".into(),
        ..LabelVersionRow::default()
    };
    let summary = LabelSummary {
        label_epoch: known.row.label_epoch,
        parts_json: to_json(&infos),
        area_shares: area_shares(&view, &row.polygon_labels),
    };
    Relabelled::new(known, NewLabels { row, summary }, cause)
}

/// Returns probabilities `(m, k + 1)` in which the faces of the new last class have the
/// probabilities of their old class.
fn with_new_class(old: &LabelVersionRow, k: usize, labels: &[LabelId], proxy: &[i32]) -> Vec<u8> {
    let mut out = vec![0; proxy.len() * (k + 1)];
    let new = labels[k] as i32;
    for (f, row) in out.chunks_exact_mut(k + 1).enumerate() {
        let was = old
            .proxy_probabilities
            .get(f * k..(f + 1) * k)
            .unwrap_or(&[]);
        row[..was.len()].copy_from_slice(was);
        let class = labels
            .iter()
            .position(|l| i64::from(*l) == i64::from(old.proxy_labels[f]));
        if let (true, Some(class)) = (proxy[f] == new, class) {
            row.swap(class, k);
        }
    }
    out
}
