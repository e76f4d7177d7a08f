//! Labels depend neither on how many shapes are relabelled together, nor on the number of threads,
//! nor on which shapes stay prepared in memory.

use crate::pipeline::{COLLECTION, SMALL, all_labels, library, stream};
use coseg::Library;
use coseg::library::{CollectionSpec, Correction, Event, MAX_BATCH, MAX_REPRESENTATIVES, Up};
use coseg::synth::{Family, Labelled, Options, family};
use std::collections::BTreeMap;

/// Known parts as labels that no discovery would number so.
fn truth(shape: &Labelled) -> Vec<i32> {
    shape.labels.iter().map(|l| *l as i32 + 10).collect()
}

/// Labels with their confidence, and the log, after the library was filled, and corrected twice.
type Ended = (
    BTreeMap<String, Vec<i32>>,
    BTreeMap<String, Vec<f32>>,
    Vec<Event>,
);

/// Names of the shapes that wait to be relabelled, in the order of their arrival.
fn waiting(library: &Library) -> Vec<String> {
    let all = library.shapes(COLLECTION, 0, 1_000, None).unwrap();
    let stale = all.into_iter().filter(|s| s.stale);
    stale.map(|s| s.name).collect()
}

fn settle(library: &Library, batch: usize) -> Vec<usize> {
    let mut batches = Vec::new();
    loop {
        match library.relabel_batch(Some(COLLECTION), batch).unwrap() {
            0 => return batches,
            n => batches.push(n),
        }
    }
}

fn ended(shapes: &[Labelled], batch: usize) -> Ended {
    let (_folder, library) = library(3, Up::Unknown);
    if batch == 1 {
        library.store().prepared().set_max_bytes(0);
    }
    stream(&library, shapes);
    // A whole shape, then some faces of another, which its other faces follow.
    let whole = Correction::Whole(truth(&shapes[0]));
    let label = shapes[1].labels[0];
    let of_label = (0..).zip(&shapes[1].labels).filter(|(_, l)| **l == label);
    let faces = Correction::Faces {
        faces: of_label.map(|(face, _)| face).collect(),
        label: label + 10,
    };
    for (shape, correction) in [(&shapes[0], whole), (&shapes[1], faces)] {
        library
            .correct(COLLECTION, &shape.name, &correction, None)
            .unwrap();
        let batches = settle(&library, batch);
        assert!(batches.iter().all(|n| *n <= batch), "{batches:?}");
    }
    let (_, snapshot) = library.labels_snapshot(COLLECTION).unwrap();
    let confidence = snapshot.into_iter().map(|(name, l)| (name, l.confidence));
    let events = library.events_since(COLLECTION, 0, 10_000).unwrap();
    (all_labels(&library), confidence.collect(), events)
}

#[test]
fn neither_batches_nor_threads_nor_memory_change_labels() {
    let shapes = family(Family::Pliers, 33, 7, &SMALL);
    let on = |n_threads: usize, batch: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads);
        pool.build().unwrap().install(|| ended(&shapes, batch))
    };
    let one_by_one = on(1, 1);
    assert_eq!(on(3, MAX_BATCH), one_by_one);
}

/// More shapes than a model is fitted to, so that some are left to relabel.
#[test]
fn shapes_that_wait_are_relabelled_together() {
    let options = Options {
        n_faces: 280,
        rotate: false,
    };
    let shapes = family(Family::Pliers, 34, MAX_REPRESENTATIVES as u32 + 4, &options);
    let corrected = || {
        let folder = tempfile::tempdir().unwrap();
        let library = Library::open(folder.path()).unwrap();
        let spec = CollectionSpec {
            name: COLLECTION.into(),
            n_parts: Some(1),
            working_faces: 300,
            ..CollectionSpec::default()
        };
        library.create_collection(&spec, None).unwrap();
        stream(&library, &shapes);
        let whole = Correction::Whole(truth(&shapes[0]));
        library
            .correct(COLLECTION, &shapes[0].name, &whole, None)
            .unwrap();
        (folder, library)
    };
    let relabelled = |batch: usize| {
        let (_folder, library) = corrected();
        (settle(&library, batch), all_labels(&library))
    };
    let (batches, labels) = relabelled(3);
    assert_eq!(batches[batches.len() - 2..], [3, 1], "{batches:?}");
    let (single, of_single) = relabelled(1);
    assert_eq!(single[single.len() - 4..], [1; 4]);
    assert_eq!(labels, of_single);

    // What is shown comes first, and the labels are the same.
    let (_folder, library) = corrected();
    while waiting(&library).len() > 4 {
        assert!(library.relabel_first(Some(COLLECTION), 3, &[]).unwrap() > 0);
    }
    let all = waiting(&library);
    let shown = ["nobody", &all[3], &shapes[0].name, &all[2], &all[3]].map(str::to_owned);
    for (n, left) in [(1, &all[..3]), (1, &all[..2]), (3, &[])] {
        assert!(library.relabel_first(Some(COLLECTION), n, &shown).unwrap() > 0);
        assert_eq!(waiting(&library), left);
    }
    assert_eq!(all_labels(&library), labels);
}
