//! Tests the up axis of a collection: shapes that stand along another one are noticed, and a person
//! can change it.

use crate::pipeline::{COLLECTION, SMALL, accuracy, all_labels, file, library, stream};
use coseg::Library;
use coseg::library::{Correction, EventKind, LibraryError, RequestKey, Up, UpSet};
use coseg::synth::{Family, Labelled, family};

/// The largest disadvantage of a collection with a corrected axis, compared with one that had it
/// from the start, which was clustered at other sizes.
const SLACK: f64 = 0.03;

fn chairs(n: u32) -> Vec<Labelled> {
    family(Family::Chair, 31, n, &SMALL)
}

fn kinds(library: &Library, since: u64) -> Vec<EventKind> {
    let events = library.events_since(COLLECTION, since, 10_000).unwrap();
    events.into_iter().map(|e| e.kind).collect()
}

fn set(library: &Library, up: Up) -> UpSet {
    library.set_up(COLLECTION, up, None).unwrap()
}

fn settle(library: &Library) {
    while library.relabel_next(Some(COLLECTION)).unwrap() {}
}

#[test]
fn shapes_that_stand_along_another_axis_are_noticed() {
    let shapes = chairs(4);
    let disagrees = |library: &Library| library.collection(COLLECTION).unwrap().up_disagrees;
    for wrong in [Up::MinusX, Up::PlusZ, Up::MinusY] {
        let (_folder, library) = library(4, wrong);
        assert_eq!(disagrees(&library), None);
        stream(&library, &shapes[..2]);
        assert_eq!(disagrees(&library), None, "two shapes are too few");
        stream(&library, &shapes[2..]);
        let other = disagrees(&library).unwrap();
        assert_eq!(other.up, Up::PlusY, "given {wrong}");
        assert!(other.agreement >= 0.5, "{other:?}");
    }
    for right in [Up::PlusY, Up::Unknown, Up::Auto] {
        let (_folder, library) = library(4, right);
        stream(&library, &shapes);
        assert_eq!(disagrees(&library), None, "given {right}");
    }
}

#[test]
fn another_axis_clusters_again_and_is_undone_to_the_byte() {
    let shapes = chairs(7);
    let (_right, right) = library(4, Up::PlusY);
    stream(&right, &shapes);
    let (folder, library) = library(4, Up::PlusX);
    stream(&library, &shapes[..6]);
    let before = all_labels(&library);
    let info = library.collection(COLLECTION).unwrap();
    let done = set(&library, Up::PlusY);
    assert_eq!((done.changed, done.n_stale), (true, 0));
    let after = library.collection(COLLECTION).unwrap();
    assert_eq!((after.spec.up, after.up_disagrees), (Up::PlusY, None));
    assert_eq!((after.n_undoable, after.sequence), (1, done.sequence));
    let events = kinds(&library, info.sequence);
    let changed = EventKind::UpChanged {
        from: "+x".into(),
        to: "+y".into(),
    };
    assert_eq!(events[0], changed);
    let reclustered = |k: &EventKind| matches!(k, EventKind::Reclustered { accepted: true, .. });
    assert!(events.iter().any(reclustered), "{events:?}");
    let labelled = all_labels(&library);
    assert_ne!(labelled, before);

    // Later shapes are labelled along the new axis, also after the library was closed.
    drop(library);
    let library = Library::open(folder.path()).unwrap();
    assert_eq!(all_labels(&library), labelled);
    stream(&library, &shapes[6..]);
    let (found, wanted) = (accuracy(&library, &shapes), accuracy(&right, &shapes));
    let (found, wanted) = (found.accuracy, wanted.accuracy);
    assert!(
        found >= wanted - SLACK,
        "{found:.3}, from the start {wanted:.3}"
    );

    assert_eq!(library.undo(COLLECTION, None).unwrap().change, "up");
    settle(&library);
    let mut undone = all_labels(&library);
    assert!(undone.remove(&shapes[6].name).is_some());
    assert_eq!(undone, before);
    let undone = library.collection(COLLECTION).unwrap();
    assert_eq!((undone.spec.up, undone.n_undoable), (Up::PlusX, 0));
    assert!(undone.up_disagrees.is_some());
    drop(library);
    let findings = Library::check(folder.path()).unwrap();
    assert!(findings.iter().all(|f| !f.damage), "{findings:?}");
}

#[test]
fn the_same_axis_again_does_nothing_and_the_same_request_has_one_effect() {
    let shapes = chairs(3);
    let (_folder, library) = library(4, Up::PlusX);
    stream(&library, &shapes);
    let key = |id: &str| RequestKey {
        client_id: "me".into(),
        request_id: id.into(),
    };
    let set = |up, id| library.set_up(COLLECTION, up, Some(&key(id)));
    let same = set(Up::PlusX, "same").unwrap();
    assert!(!same.changed);
    assert_eq!(library.collection(COLLECTION).unwrap().n_undoable, 0);
    let first = set(Up::PlusY, "once").unwrap();
    assert_eq!(set(Up::PlusY, "once").unwrap(), first);
    let back = set(Up::PlusX, "back").unwrap();
    assert!(back.sequence > first.sequence);
    assert_eq!(set(Up::PlusY, "once").unwrap(), first);
    assert_eq!(set(Up::PlusX, "same").unwrap(), same);
    let info = library.collection(COLLECTION).unwrap();
    assert_eq!((info.sequence, info.spec.up), (back.sequence, Up::PlusX));
    assert!(set(Up::PlusZ, "once").is_err(), "the id of another request");
    let missing = library.set_up("no such", Up::PlusZ, None);
    assert!(matches!(missing, Err(LibraryError::NotFound { .. })));
}

#[test]
fn labels_stay_where_the_axis_in_force_does() {
    let shapes = chairs(4);
    let (_folder, library) = library(4, Up::PlusY);
    stream(&library, &shapes);
    let before = all_labels(&library);
    let info = library.collection(COLLECTION).unwrap();
    // The estimate is the given axis.
    assert!(set(&library, Up::Auto).changed);
    let after = library.collection(COLLECTION).unwrap();
    assert_eq!(after.up_estimate.unwrap().up, Up::PlusY);
    assert_eq!(after.sequence, info.sequence + 1);
    assert_eq!(all_labels(&library), before);
    assert!(set(&library, Up::Unknown).changed);
    settle(&library);
    assert_eq!(library.collection(COLLECTION).unwrap().up_estimate, None);
}

#[test]
fn an_empty_collection_begins_along_the_new_axis() {
    let shapes = chairs(4);
    let (_folder, fresh) = library(4, Up::PlusY);
    stream(&fresh, &shapes);
    let (_folder, library) = library(4, Up::PlusX);
    let done = set(&library, Up::PlusY);
    assert_eq!((done.changed, done.n_stale), (true, 0));
    stream(&library, &shapes);
    assert_eq!(all_labels(&library), all_labels(&fresh));
    // An emptied collection starts again.
    for s in &shapes {
        library.remove(COLLECTION, &s.name, None).unwrap();
    }
    assert!(set(&library, Up::PlusZ).changed);
    stream(&library, &shapes);
    assert_eq!(library.collection(COLLECTION).unwrap().spec.up, Up::PlusZ);
    assert!(
        library
            .collection(COLLECTION)
            .unwrap()
            .up_disagrees
            .is_some()
    );
}

#[test]
fn what_a_person_labelled_stays_and_the_rest_follows() {
    let shapes = chairs(5);
    let truth = |s: &Labelled| -> Vec<i32> { s.labels.iter().map(|l| *l as i32 + 10).collect() };
    let taught = |up: Up| {
        let (folder, library) = library(4, up);
        stream(&library, &shapes);
        let correction = Correction::Whole(truth(&shapes[1]));
        library
            .correct(COLLECTION, &shapes[1].name, &correction, None)
            .unwrap();
        settle(&library);
        (folder, library)
    };
    let (_folder, library) = taught(Up::PlusX);
    let before = all_labels(&library);
    let wrong = accuracy(&library, &shapes).accuracy;
    let done = set(&library, Up::PlusY);
    assert!(done.changed && done.n_stale > 0, "{done:?}");
    settle(&library);
    let after = all_labels(&library);
    assert_eq!(after[&shapes[1].name], truth(&shapes[1]));
    assert_eq!(library.collection(COLLECTION).unwrap().n_stale, 0);
    assert_eq!(library.collection(COLLECTION).unwrap().up_disagrees, None);
    // Along the wrong axis: 0.625.
    let found = accuracy(&library, &shapes).accuracy;
    assert!(found > wrong, "{found:.3}, along the wrong axis {wrong:.3}");
    // A shape that is added now has the person's labels too.
    let late = &chairs(6)[5];
    library
        .add(COLLECTION, file(&late.name, &late.mesh))
        .unwrap();
    settle(&library);
    assert!(
        all_labels(&library)[&late.name]
            .iter()
            .all(|l| (10..14).contains(l))
    );
    library.remove(COLLECTION, &late.name, None).unwrap();
    assert_eq!(library.undo(COLLECTION, None).unwrap().change, "up");
    settle(&library);
    assert_eq!(all_labels(&library), before);
}
