//! A person says that two labels are one, or that one is two.

use super::collections::{find_label, label_in};
use super::commit::{collection_row, event, put_relabelled};
use super::history::{Before, from_reply};
use super::lane::Lane;
use super::learnt::Learnt;
use super::place::Known;
use super::relabel::{NewLabels, Relabelled, area_shares, cause, face_ids, part_infos};
use super::rows::{CollectionState, label_colour, to_json};
use super::teach::pupils;
use super::{EventKind, LabelId, LabelInfo, Library, LibraryError, RequestKey, Result};
use crate::labels::LabelModel;
use crate::pipeline::{Prepared, split_faces, split_model};
use crate::segmentation::Surface;
use crate::store::{Digest, LabelRow, LabelSummary, LabelVersionRow, ShapeId, Tx};

/// What becomes of the labels of one shape: new ids of its proxy faces and polygons, and its probabilities.
struct Renamed {
    proxy_labels: Vec<i32>,
    proxy_probabilities: Vec<u8>,
    polygon_labels: Vec<i32>,
}

impl Library {
    /// Makes one label of two: faces of `label` carry `into` from then on, on every shape. The label as it stands,
    /// and the number of shapes whose labels changed. Costs as much as there are shapes that carry it.
    ///
    /// # Errors
    /// There is no such collection or label, or one of them is out of use.
    pub fn merge_labels(
        &self,
        collection: &str,
        label: LabelId,
        into: LabelId,
        key: Option<&RequestKey>,
    ) -> Result<(LabelInfo, u64)> {
        let request = Digest::of(format!("merge {collection:?} {label} {into}").as_bytes());
        let row = self.collection_row(collection)?;
        self.with_lane(row, |lane| {
            if let Some(reply) = self.answered(key, request)? {
                return self.told(&reply, lane, into);
            }
            if label == into {
                let message = format!("label {label} cannot be merged into itself");
                return Err(LibraryError::invalid("FIELD_RANGE", message));
            }
            let old = self.label_in_use(lane, label)?;
            self.label_in_use(lane, into)?;
            let change = |l: i32| if l == label as i32 { into as i32 } else { l };
            let pinned =
                self.pins_changed(lane, |pins| pins.iter().map(|p| change(*p)).collect())?;
            let carrying = self
                .store
                .catalog()
                .read(|r| r.shapes(lane.row.id, 0, usize::MAX, Some(label)))?;
            let mut relabelled = Vec::with_capacity(carrying.len());
            for shape in &carrying {
                let known = self.known(shape.id)?;
                let renamed = Renamed {
                    proxy_labels: known
                        .labels
                        .proxy_labels
                        .iter()
                        .map(|l| change(*l))
                        .collect(),
                    proxy_probabilities: known.labels.proxy_probabilities.clone(),
                    polygon_labels: known
                        .labels
                        .polygon_labels
                        .iter()
                        .map(|l| change(*l))
                        .collect(),
                };
                relabelled.push(renamed_labels(&known, renamed, cause::MERGE));
            }
            let learnt = lane.learnt.clone().map(|learnt| {
                let rename = |l: &u32| if *l == label { into } else { *l };
                let labels = learnt.model.labels.iter().map(rename).collect();
                Learnt {
                    model: LabelModel {
                        labels,
                        ..learnt.model
                    },
                    ..learnt
                }
            });
            let state = self.taught_state(lane, false)?;
            let reply = self.once(key, request, |tx| {
                let id = lane.row.id;
                let shapes: Vec<ShapeId> = pinned.iter().map(|p| p.0).collect();
                let before = Before::labels(tx, lane, &shapes)?;
                let detail = to_json(&serde_json::json!({ "label": label, "into": into }));
                tx.insert_correction(id, "merge", &detail, &before.encode())?;
                let merged = LabelRow {
                    merged_into: Some(into),
                    ..old
                };
                tx.put_label(id, &merged)?;
                event(tx, id, &EventKind::LabelMerged { from: label, into })?;
                put_changes(tx, lane, &mut relabelled, &pinned, &state)?;
                if let Some(learnt) = &learnt {
                    tx.set_model(id, &learnt.encode())?;
                }
                let label = label_in(tx, id, into)?;
                Ok(to_json(&(label, relabelled.len() as u64)).into_bytes())
            })?;
            self.reload(lane)?;
            from_reply(&reply)
        })
    }

    /// What was answered before; an earlier version kept less of it, and the label is told as it stands.
    fn told(&self, reply: &[u8], lane: &Lane, label: LabelId) -> Result<(LabelInfo, u64)> {
        from_reply(reply).or_else(|_| {
            let told = from_reply::<(LabelId, u64)>(reply);
            let (label, n) = told.or_else(|_| from_reply(reply).map(|n: u64| (label, n)))?;
            Ok((self.label_of(&lane.row, label)?, n))
        })
    }

    /// Makes two labels of one, by what tells its patches apart most over the collection (two means of their mean
    /// descriptors), then face by face (the discriminant of the two, and a cut). The larger share keeps the id. The
    /// new label, and the number of shapes whose labels changed at once; the others follow in the background.
    ///
    /// # Errors
    /// There is no such collection or label, it is out of use, or it has too few patches to be two.
    pub fn split_label(
        &self,
        collection: &str,
        label: LabelId,
        key: Option<&RequestKey>,
    ) -> Result<(LabelInfo, u64)> {
        let request = Digest::of(format!("split {collection:?} {label}").as_bytes());
        let row = self.collection_row(collection)?;
        self.with_lane(row, |lane| {
            if let Some(reply) = self.answered(key, request)? {
                return self.told(&reply, lane, label);
            }
            self.label_in_use(lane, label)?;
            let new = lane.row.next_label;
            let closed = lane.state.teaching.as_ref().is_some_and(|t| t.closed);
            let Some(learnt) = &lane.learnt else {
                return Err(too_few(label));
            };
            let pupils = pupils(lane);
            let chosen: Vec<usize> = (0..lane.shapes.len())
                .filter(|at| lane.shapes[*at].pinned || !closed && pupils.contains(at))
                .collect();
            let known: Vec<Known> = chosen
                .iter()
                .map(|at| self.known(lane.shapes[*at].id))
                .collect::<Result<_>>()?;
            let prepared: Vec<Prepared> = known
                .iter()
                .map(|k| Prepared::new(&k.mapped.view(), &learnt.model))
                .collect();
            let is_in: Vec<Vec<bool>> = known
                .iter()
                .map(|k| {
                    k.labels
                        .proxy_labels
                        .iter()
                        .map(|l| *l == label as i32)
                        .collect()
                })
                .collect();
            let patches: Vec<&[u32]> = known.iter().map(|k| k.mapped.view().patches).collect();
            let Some(model) = split_model(&prepared, &patches, &is_in) else {
                return Err(too_few(label));
            };
            let mut state = self.taught_state(lane, true)?;
            let mut relabelled = Vec::new();
            let mut pinned = Vec::new();
            let (mut labels, n_old) = (learnt.model.labels.clone(), learnt.model.labels.len());
            labels.push(new);
            let mut discovered = Vec::new();
            for (((at, known), prepared), is_in) in
                chosen.iter().zip(&known).zip(&prepared).zip(&is_in)
            {
                let is_new = split_faces(&model, prepared, is_in);
                let view = known.mapped.view();
                let change = |p: usize, l: i32| match is_new[view.face_map[p] as usize] {
                    true if l == label as i32 => new as i32,
                    _ => l,
                };
                let proxy: Vec<i32> = known
                    .labels
                    .proxy_labels
                    .iter()
                    .zip(&is_new)
                    .map(|(l, n)| if *n { new as i32 } else { *l })
                    .collect();
                let renamed = Renamed {
                    proxy_probabilities: with_new_class(&known.labels, n_old, &labels, &proxy),
                    proxy_labels: proxy,
                    polygon_labels: known
                        .labels
                        .polygon_labels
                        .iter()
                        .enumerate()
                        .map(|(p, l)| change(p, *l))
                        .collect(),
                };
                let shape = &lane.shapes[*at];
                if shape.pinned {
                    let pins = self.pinned(shape.id)?.1;
                    let pins: Vec<i32> = pins
                        .iter()
                        .enumerate()
                        .map(|(p, l)| change(p, *l))
                        .collect();
                    pinned.push((shape.id, pins));
                }
                discovered.push((shape.ordinal, known.row.version + 1));
                relabelled.push(renamed_labels(known, renamed, cause::SPLIT));
            }
            if let Some(teaching) = &mut state.teaching {
                teaching.pending = true;
                teaching.normalised = false;
                teaching.discovered = discovered;
                teaching.discovered_labels = labels;
            }
            let reply = self.once(key, request, |tx| {
                let id = lane.row.id;
                let shapes: Vec<ShapeId> = pinned.iter().map(|p| p.0).collect();
                let before = Before::labels(tx, lane, &shapes)?;
                let detail = to_json(&serde_json::json!({ "label": label, "new": new }));
                tx.insert_correction(id, "split", &detail, &before.encode())?;
                tx.take_labels(id, 1)?;
                let row = LabelRow {
                    id: new,
                    name: None,
                    colour: label_colour(new),
                    merged_into: None,
                };
                tx.put_label(id, &row)?;
                event(tx, id, &EventKind::LabelCreated { label: new })?;
                let split = EventKind::LabelSplit {
                    from: label,
                    into: vec![new],
                };
                event(tx, id, &split)?;
                put_changes(tx, lane, &mut relabelled, &pinned, &state)?;
                tx.mark_all_stale(id)?;
                let label = label_in(tx, id, new)?;
                Ok(to_json(&(label, relabelled.len() as u64)).into_bytes())
            })?;
            self.reload(lane)?;
            from_reply(&reply)
        })
    }

    /// A label that is there and was not merged into another.
    fn label_in_use(&self, lane: &Lane, label: LabelId) -> Result<LabelRow> {
        let row = self
            .store
            .catalog()
            .read(|r| find_label(r, lane.row.id, label))?;
        match row.merged_into {
            None => Ok(row),
            Some(into) => Err(LibraryError::FailedPrecondition {
                reason: "LABEL_MERGED",
                message: format!("label {label} was merged into {into}"),
            }),
        }
    }

    /// The pinned shapes whose pins a change concerns, with their new pins.
    fn pins_changed(
        &self,
        lane: &Lane,
        change: impl Fn(&[i32]) -> Vec<i32>,
    ) -> Result<Vec<(ShapeId, Vec<i32>)>> {
        let mut out = Vec::new();
        for shape in lane.shapes.iter().filter(|s| s.pinned) {
            let pins = self.pinned(shape.id)?.1;
            let changed = change(&pins);
            if changed != pins {
                out.push((shape.id, changed));
            }
        }
        Ok(out)
    }

    /// The state after a change by a person: discovery is over.
    fn taught_state(&self, lane: &Lane, learn: bool) -> Result<CollectionState> {
        let mut state = lane.state.clone();
        let mut teaching = match state.teaching.take() {
            Some(teaching) => teaching,
            None => {
                let mut teaching = self.discovered(lane)?;
                // The model is there, and the representatives have its labels.
                teaching.normalised = true;
                teaching.taught = teaching.discovered.iter().map(|d| d.0).collect();
                teaching
            }
        };
        teaching.pending |= learn;
        state.teaching = Some(teaching);
        Ok(state)
    }
}

fn too_few(label: LabelId) -> LibraryError {
    LibraryError::FailedPrecondition {
        reason: "LABEL_TOO_SMALL",
        message: format!("label {label} has fewer than 2 patches, so it cannot become 2 labels"),
    }
}

/// Writes the new labels of shapes, new pins and the new state.
fn put_changes(
    tx: &Tx<'_>,
    lane: &Lane,
    relabelled: &mut [Relabelled],
    pinned: &[(ShapeId, Vec<i32>)],
    state: &CollectionState,
) -> Result<()> {
    let id = lane.row.id;
    for (shape, pins) in pinned {
        tx.set_pins(*shape, Some(pins))?;
    }
    for shape in relabelled {
        let (epoch, stale) = (
            shape.labels.summary.label_epoch,
            tx.shape(shape.shape)?.is_some_and(|s| s.stale),
        );
        put_relabelled(tx, id, shape, &[], epoch)?;
        tx.set_stale(shape.shape, stale)?;
    }
    tx.set_state(id, to_json(state).as_bytes())?;
    collection_row(tx, id)?;
    Ok(())
}

/// A new version of a shape's labels with other ids.
fn renamed_labels(known: &Known, renamed: Renamed, cause: &'static str) -> Relabelled {
    let view = known.mapped.view();
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
        ..LabelVersionRow::default()
    };
    let summary = LabelSummary {
        label_epoch: known.row.label_epoch,
        parts_json: to_json(&infos),
        area_shares: area_shares(&view, &row.polygon_labels),
    };
    Relabelled::new(known, NewLabels { row, summary }, cause)
}

/// Probabilities `(m, k + 1)` in which the faces of the new last class have what their old one had.
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
