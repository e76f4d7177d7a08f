//! Tests a collection without a store: shapes are discovered, corrected and relabelled in memory.

use super::{
    Applied, Collection, KnownShape, ModelState, Staleness, discovered, fit, state::Phase,
    state::Vocabulary, supervised,
};
use crate::description::{Description, Params};
use crate::labels::LabelModel;
use crate::library::change::{Change, LabelEdit};
use crate::library::error::Result;
use crate::library::labelling::{Original, Relabelled, cause, new_labels, new_labels_of};
use crate::library::sources::{ArrayFile, Arrays, FileView, Known, Sources};
use crate::mesh::Format;
use crate::mesh::write::off;
use crate::pipeline::{LabelChange, Prepared, describe};
use crate::segmentation::Surface;
use crate::store::{
    CollectionId, CollectionRow, Digest, LabelRow, LabelVersionRow, LinkRow, MapRow, ShapeId,
    ShapeRow,
};
use crate::synth::{Family, Labelled, Options, family};
use std::collections::BTreeMap;
use std::sync::Arc;

/// A shape of a collection in memory.
#[derive(Clone)]
struct Shape {
    row: ShapeRow,
    description: Description,
    /// Version 1 first.
    versions: Vec<LabelVersionRow>,
    pins: Option<Vec<i32>>,
}

/// The rows that a store would contain.
#[derive(Clone, Default)]
struct Memory {
    shapes: BTreeMap<ShapeId, Shape>,
    maps: Vec<MapRow>,
    files: Vec<(Digest, Vec<u8>)>,
}

impl Sources for Memory {
    fn known(&self, id: ShapeId) -> Result<Known> {
        let shape = &self.shapes[&id];
        Ok(Known {
            row: shape.row.clone(),
            arrays: self.arrays(id)?,
            labels: shape.versions.last().expect("labelled").clone(),
        })
    }

    fn arrays(&self, id: ShapeId) -> Result<ArrayFile> {
        let shape = &self.shapes[&id];
        Ok(ArrayFile {
            arrays: Arrays::Owned(Box::new(shape.description.clone())),
            digest: shape.row.content_digest,
        })
    }

    fn surface(&self, shape: FileView<'_>) -> Arc<Surface> {
        Arc::new(Surface::new(&shape.view.mesh()))
    }

    fn prepared(&self, shape: FileView<'_>, model: &LabelModel) -> Arc<Prepared> {
        Arc::new(Prepared::new(&shape.view, model))
    }

    fn version(&self, id: ShapeId) -> Result<u64> {
        Ok(self.shapes[&id].row.version)
    }

    fn labels_at(&self, id: ShapeId, version: u64) -> Result<Option<LabelVersionRow>> {
        let versions = &self.shapes[&id].versions;
        Ok(versions.iter().find(|v| v.version == version).cloned())
    }

    fn pins(&self, id: ShapeId) -> Result<Option<Vec<i32>>> {
        Ok(self.shapes[&id].pins.clone())
    }

    fn map(&self, from: ShapeId, to: ShapeId) -> Result<Option<MapRow>> {
        let found = self.maps.iter().find(|m| (m.from, m.to) == (from, to));
        Ok(found.cloned())
    }

    fn has_map(&self, from: ShapeId, to: ShapeId) -> Result<bool> {
        Ok(self.maps.iter().any(|m| (m.from, m.to) == (from, to)))
    }

    fn maps_into(&self, to: ShapeId) -> Result<Vec<MapRow>> {
        Ok(self.maps.iter().filter(|m| m.to == to).cloned().collect())
    }

    fn labels(&self, _: CollectionId) -> Result<Vec<LabelRow>> {
        Ok(Vec::new())
    }

    fn links(&self, _: CollectionId) -> Result<Vec<LinkRow>> {
        Ok(Vec::new())
    }

    fn original(&self, digest: &Digest) -> Result<Vec<u8>> {
        let file = self.files.iter().find(|f| f.0 == *digest);
        Ok(file.expect("there").1.clone())
    }
}

impl Memory {
    /// Applies a change of stored shapes, as a commit does.
    fn take(&mut self, collection: &mut Collection, change: Change) {
        self.maps.extend(change.maps);
        for new in &change.relabelled {
            let shape = self.shapes.get_mut(&new.shape).expect("there");
            shape.row.version = new.labels.row.version;
            shape.row.label_epoch = new.labels.summary.label_epoch;
            shape.versions.push(new.labels.row.clone());
        }
        for (id, pins) in &change.pins {
            self.shapes.get_mut(id).expect("there").pins = pins.clone();
        }
        let mut row = collection.row().clone();
        let is_new = |e: &&LabelEdit| matches!(e, LabelEdit::Changed(LabelChange::Created(_)));
        row.next_label += change.labels.iter().filter(is_new).count() as u32;
        collection.apply(Applied {
            row,
            state: change.state,
            model: change.model,
            removed: None,
            added: None,
            pinned: change.pins.iter().map(|p| (p.0, p.1.is_some())).collect(),
            labelled: change.relabelled.iter().map(|r| r.shape).collect(),
            staleness: change.staleness,
            stale: change.stale,
        });
    }

    /// Labels a described shape and adds it.
    fn add(&mut self, collection: &mut Collection, name: &str, description: &Description) {
        let digest = Digest::of(name.as_bytes());
        let new = discovered::NewShape {
            arrays: FileView {
                view: description.view(),
                file: digest,
            },
            digest,
        };
        let nearest = discovered::sources_for(collection, self, new.arrays).expect("ranked");
        let voted =
            discovered::label_new(collection, self, new.arrays, &nearest).expect("labelled");
        let (labelling, maps) = match voted {
            Some(voted) => (Some(voted.labelling), voted.maps),
            None => (None, Vec::new()),
        };
        let plan = discovered::plan(collection, self, &new, labelling).expect("planned");
        let ids = (&plan.model.model.labels[..], plan.model.model.epoch);
        let original = Original {
            digest: &digest,
            format: "off",
        };
        let labels = new_labels(self, new.arrays, &plan.labelling, ids, original);
        let labels = labels.expect("finished");
        let (mut labels, epoch) = (labels.row, labels.summary.label_epoch);
        labels.version = 1;
        let relabelled = plan.relabelled.iter().map(|(known, labelling)| {
            let labels = new_labels_of(self, known, labelling, ids).expect("finished");
            Relabelled::new(known, labels, cause::RECLUSTERING)
        });
        let change = Change {
            relabelled: relabelled.collect(),
            labels: plan.changes.into_iter().map(LabelEdit::from).collect(),
            staleness: plan.staleness,
            state: Some(plan.state),
            model: Some(plan.model),
            ..Change::default()
        };
        let (id, ordinal) = (
            ShapeId(collection.row.next_ordinal as i64),
            collection.row.next_ordinal,
        );
        self.take(collection, change);
        for (from, map) in &maps {
            self.maps
                .push(crate::library::change::map_row(*from, id, map));
        }
        let shape = Shape {
            row: shape_row(id, ordinal, name, digest, epoch),
            description: description.clone(),
            versions: vec![labels],
            pins: None,
        };
        self.shapes.insert(id, shape);
        collection.row.next_ordinal += 1;
        collection.shapes.push(KnownShape {
            id,
            ordinal,
            digest,
            stale: false,
            pinned: false,
            signature: description.signature.clone(),
        });
    }

    fn newest(&self) -> Vec<&[i32]> {
        let shapes = self.shapes.values();
        let newest = shapes.map(|s| s.versions.last().expect("labelled"));
        newest.map(|v| v.polygon_labels.as_slice()).collect()
    }
}

fn shape_row(id: ShapeId, ordinal: u64, name: &str, digest: Digest, label_epoch: u64) -> ShapeRow {
    ShapeRow {
        id,
        collection: CollectionId(1),
        name: name.into(),
        ordinal,
        content_digest: digest,
        format: "off".into(),
        description_digest: digest,
        n_polygons: 0,
        area: 1.0,
        report_json: "{}".into(),
        version: 1,
        label_epoch,
        stale: false,
        parts_json: "[]".into(),
        sources_json: "[]".into(),
        stored_bytes: 0,
    }
}

fn empty(n_parts: u32) -> Collection {
    let row = CollectionRow {
        id: CollectionId(1),
        name: "in memory".into(),
        n_parts: Some(n_parts),
        up: "unknown".into(),
        operator: "tufted".into(),
        working_faces: 300,
        sequence: 0,
        next_ordinal: 1,
        next_label: 0,
        epoch: 0,
        state: Vec::new(),
    };
    Collection {
        row,
        state: super::State::default(),
        model: None::<ModelState>,
        shapes: Vec::new(),
    }
}

/// Relabels stale shapes until none is left, the last first if `backwards`.
fn settle(memory: &mut Memory, collection: &mut Collection, backwards: bool) {
    for _ in 0..100 {
        let mut stale = (0..collection.shapes.len()).filter(|at| collection.shapes[*at].stale);
        let next = match backwards {
            false => stale.next(),
            true => stale.next_back(),
        };
        let Some(at) = next else { return };
        let supervision = collection.state().regime.supervision().expect("supervised");
        let step = match supervision.phase() {
            Phase::Fitted => supervised::relabel(collection, memory, at),
            _ => fit::step(collection, memory),
        };
        let step = step.expect("a step").expect("something to do");
        memory.take(collection, step);
    }
    panic!("it does not end");
}

fn right(memory: &Memory, shapes: &[Labelled]) -> f64 {
    let (mut hits, mut all) = (0, 0);
    for (found, shape) in memory.newest().into_iter().zip(shapes).skip(1) {
        let pairs = found.iter().zip(&shape.labels);
        hits += pairs.filter(|(l, t)| **l == **t as i32 + 10).count();
        all += found.len();
    }
    hits as f64 / all as f64
}

#[test]
fn a_collection_is_discovered_and_corrected_without_a_store() {
    let options = Options {
        n_faces: 280,
        rotate: false,
    };
    let params = Params {
        working_faces: 400,
        n_eigenpairs: 40,
        ..Params::default()
    };
    let shapes = family(Family::Pliers, 41, 5, &options);
    let (mut memory, mut collection) = (Memory::default(), empty(3));
    for shape in &shapes {
        let bytes = off(&shape.mesh).into_bytes();
        let description = describe(&bytes, Format::Off, &params, &|_| true).expect("described");
        memory
            .files
            .push((Digest::of(shape.name.as_bytes()), bytes));
        memory.add(&mut collection, &shape.name, &description);
    }
    assert!(memory.newest().into_iter().flatten().all(|l| *l >= 0));
    assert!(!memory.maps.is_empty() && collection.model().is_some());

    // The first shape becomes a training shape, whose labels are already those of the person.
    let id = collection.shapes[0].id;
    let truth: Vec<i32> = shapes[0].labels.iter().map(|l| *l as i32 + 10).collect();
    let state = supervised::corrected(&collection, &memory, Vocabulary::Covered).expect("a state");
    let correction = Change {
        pins: vec![(id, Some(truth))],
        staleness: Staleness::All,
        stale: vec![(id, false)],
        state: Some(state),
        ..Change::default()
    };
    memory.take(&mut collection, correction);
    let (mut memory_2, mut collection_2) = (memory.clone(), collection.clone());
    settle(&mut memory, &mut collection, false);
    settle(&mut memory_2, &mut collection_2, true);
    let score = right(&memory, &shapes);
    assert!(
        score > 0.7,
        "{score:.3} of the other shapes' faces are right by id"
    );
    assert_eq!(
        memory.newest(),
        memory_2.newest(),
        "the order makes no difference"
    );
    assert_eq!(collection, collection_2);
}
