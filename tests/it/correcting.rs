//! Tests corrections: labels are pinned, propagated to all other shapes, and can be undone.

use crate::pipeline::{COLLECTION, SMALL, all_labels, file, library, propagate, stream};
use coseg::Library;
use coseg::library::{
    Correction, CorrectionOptions, EventKind, LibraryError, MAX_MAPS, Reason, RequestKey, Up,
};
use coseg::mesh::icosphere;
use coseg::synth::{Family, Labelled, family};
use std::collections::{BTreeMap, BTreeSet};

/// Known parts as labels that no discovery would number like this.
fn truth(shape: &Labelled) -> Vec<i32> {
    shape.labels.iter().map(|l| *l as i32 + 10).collect()
}

fn correct(library: &Library, shape: &Labelled) {
    let correction = Correction::Whole(truth(shape));
    library
        .correct(COLLECTION, &shape.name, &correction, None)
        .unwrap();
}

/// Share of the faces of the other shapes that have the known label, by id.
fn right(library: &Library, shapes: &[Labelled], except: &[&str]) -> f64 {
    let found = all_labels(library);
    let others: Vec<&Labelled> = shapes
        .iter()
        .filter(|s| !except.contains(&s.name.as_str()))
        .collect();
    let share = |s: &&Labelled| {
        let labels = &found[&s.name];
        let hits = labels.iter().zip(truth(s)).filter(|(l, t)| *l == t).count();
        hits as f64 / labels.len() as f64
    };
    others.iter().map(share).sum::<f64>() / others.len() as f64
}

fn kinds(library: &Library, since: u64) -> Vec<EventKind> {
    let events = library.events_since(COLLECTION, since, 10_000).unwrap();
    events.into_iter().map(|e| e.kind).collect()
}

fn sequence(library: &Library) -> u64 {
    library.collection(COLLECTION).unwrap().sequence
}

#[test]
fn one_corrected_shape_labels_all_others_by_its_ids() {
    let shapes = family(Family::Pliers, 21, 9, &SMALL);
    let (folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes[..7]);
    let since = sequence(&library);
    let next = library.suggest(COLLECTION).unwrap();
    assert_eq!(next.n_corrected, 0);
    let chosen = shapes.iter().find(|s| s.name == next.shape).unwrap();
    let correction = Correction::Whole(truth(chosen));
    let done = library
        .correct(COLLECTION, &chosen.name, &correction, None)
        .unwrap();
    assert_eq!(done.n_faces as usize, chosen.labels.len());
    assert_eq!((done.n_stale, done.changed_share > 0.99), (6, true));
    propagate(&library);

    let score = right(&library, &shapes[..7], &[&chosen.name]);
    assert!(score > 0.85, "{score:.3} of the faces are right by id");
    let used: BTreeSet<i32> = all_labels(&library).into_values().flatten().collect();
    assert_eq!(used, (10..13).collect(), "the ids are those of the person");
    let kinds = kinds(&library, since);
    let at = |wanted: &dyn Fn(&EventKind) -> bool| kinds.iter().position(wanted);
    let created = at(&|k| *k == EventKind::LabelCreated { label: 10 }).unwrap();
    let retired = at(&|k| *k == EventKind::LabelRetired { label: 0 }).unwrap();
    let corrected = at(&|k| matches!(k, EventKind::Corrected { .. })).unwrap();
    let carried = kinds
        .iter()
        .filter(|k| matches!(k, EventKind::LabelsChanged { cause, .. } if cause == "carrying"));
    assert!(created < corrected && corrected < retired);
    assert_eq!(carried.count(), 6);
    let after = kinds[corrected + 1..].iter();
    assert!(after.clone().all(|k| matches!(
        k,
        EventKind::LabelsChanged { .. } | EventKind::LabelRetired { .. }
    )));

    // Shapes that are added later have the same ids, also after the library was closed.
    let before = all_labels(&library);
    drop(library);
    let library = Library::open(folder.path()).unwrap();
    assert_eq!(all_labels(&library), before);
    stream(&library, &shapes[7..]);
    let score = right(&library, &shapes, &[&chosen.name]);
    assert!(score > 0.85, "{score:.3} of the faces are right by id");
}

/// Share of the area of some shapes whose label no labelled shape shows.
fn unclaimed(library: &Library, shapes: &[Labelled]) -> f64 {
    let labels = library.collection(COLLECTION).unwrap().labels;
    let unclaimed: BTreeSet<u32> = labels
        .iter()
        .filter(|l| l.unclaimed)
        .map(|l| l.id)
        .collect();
    let found = all_labels(library);
    let share = |s: &Labelled| {
        let labels = &found[&s.name];
        let hits = labels.iter().filter(|l| unclaimed.contains(&(**l as u32)));
        hits.count() as f64 / labels.len() as f64
    };
    shapes.iter().map(share).sum::<f64>() / shapes.len() as f64
}

#[test]
fn labels_that_no_labelled_shape_shows_stay_until_a_person_says_otherwise() {
    let pliers = family(Family::Pliers, 31, 5, &SMALL);
    let guitars = family(Family::Guitar, 32, 5, &SMALL);
    let (folder, library) = library(6, Up::Unknown);
    stream(&library, &pliers);
    stream(&library, &guitars);
    let since = sequence(&library);
    correct(&library, &pliers[0]);
    propagate(&library);
    // Pliers have the person's labels; guitars have labels that were discovered.
    let by_id = right(&library, &pliers, &[&pliers[0].name]);
    assert!(by_id > 0.6, "{by_id:.3} of the other pliers");
    let (of_pliers, of_guitars) = (unclaimed(&library, &pliers), unclaimed(&library, &guitars));
    assert!(
        of_pliers < 0.2 && of_guitars > 0.5,
        "{of_pliers:.3} {of_guitars:.3}"
    );
    let info = library.collection(COLLECTION).unwrap();
    let area: f64 = info.labels.iter().map(|l| l.area_share).sum();
    assert!((area - 1.0).abs() < 1e-6, "{area}");
    let kept: Vec<u32> = info
        .labels
        .iter()
        .filter(|l| l.unclaimed)
        .map(|l| l.id)
        .collect();
    let retired = kinds(&library, since).into_iter().filter_map(|k| match k {
        EventKind::LabelRetired { label } => Some(label),
        _ => None,
    });
    let retired: BTreeSet<u32> = retired.collect();
    assert!(!retired.is_empty() && kept.iter().all(|l| !retired.contains(l)));
    // The next shape to label is one that shows them.
    let next = library.suggest(COLLECTION).unwrap().shape;
    assert!(guitars.iter().any(|g| g.name == next), "{next}");

    // They are the same after a restart, and an undone correction brings back the first labels.
    let labels = all_labels(&library);
    drop(library);
    let library = Library::open(folder.path()).unwrap();
    assert_eq!(all_labels(&library), labels);
    assert!(unclaimed(&library, &guitars) > 0.5);

    // A person says that there are no other labels, and takes that back.
    let say = |closed| {
        let options = CorrectionOptions {
            by: "",
            closed: Some(closed),
        };
        let same = Correction::Whole(truth(&pliers[0]));
        let done = library.correct_with(COLLECTION, &pliers[0].name, &same, &options, None);
        done.unwrap();
        propagate(&library);
    };
    say(true);
    let used: BTreeSet<i32> = all_labels(&library).into_values().flatten().collect();
    assert_eq!(used, (10..13).collect());
    say(false);
    assert_eq!(all_labels(&library), labels, "as before");

    // What a person merges into a label means that label from then on.
    library.merge_labels(COLLECTION, kept[0], 10, None).unwrap();
    let merged = unclaimed(&library, &guitars);
    correct(&library, &pliers[1]);
    propagate(&library);
    let later = unclaimed(&library, &guitars);
    assert!((later - merged).abs() < 0.1, "{merged:.3} {later:.3}");

    // A guitar that a person labelled shows all of them.
    let ids: Vec<i32> = guitars[0].labels.iter().map(|l| *l as i32 + 20).collect();
    let correction = Correction::Whole(ids);
    library
        .correct(COLLECTION, &guitars[0].name, &correction, None)
        .unwrap();
    propagate(&library);
    assert_eq!(unclaimed(&library, &guitars), 0.0);
    assert_eq!(unclaimed(&library, &pliers), 0.0);
}

/// A person's labels have ids of their own choice, and may have those of discovered labels.
#[test]
fn a_label_whose_id_a_person_gives_to_other_faces_gets_a_new_one() {
    let pliers = family(Family::Pliers, 31, 5, &SMALL);
    let guitars = family(Family::Guitar, 32, 5, &SMALL);
    let (_folder, library) = library(6, Up::Unknown);
    stream(&library, &pliers);
    stream(&library, &guitars);
    let ids: Vec<i32> = pliers[0].labels.iter().map(|l| *l as i32 * 2).collect();
    let given: BTreeSet<i32> = ids.iter().copied().collect();
    library
        .correct(COLLECTION, &pliers[0].name, &Correction::Whole(ids), None)
        .unwrap();
    propagate(&library);
    let labels = library.collection(COLLECTION).unwrap().labels;
    let kept: Vec<i32> = labels
        .iter()
        .filter(|l| l.unclaimed)
        .map(|l| l.id as i32)
        .collect();
    assert!(
        !kept.is_empty() && kept.iter().all(|l| !given.contains(l)),
        "{kept:?}"
    );
    let share = unclaimed(&library, &guitars);
    assert!(share > 0.5, "{share:.3}");
}

#[test]
fn undo_goes_back_to_the_first_labels_to_the_byte() {
    let shapes = family(Family::Pliers, 22, 6, &SMALL);
    let (_folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes[..5]);
    let snapshot = |library: &Library| -> BTreeMap<String, (Vec<i32>, Vec<f32>)> {
        let (_, shapes) = library.labels_snapshot(COLLECTION).unwrap();
        let shapes = shapes.into_iter();
        shapes
            .map(|(name, l)| (name, (l.labels, l.confidence)))
            .collect()
    };
    let mut states = vec![snapshot(&library)];
    correct(&library, &shapes[0]);
    propagate(&library);
    states.push(snapshot(&library));
    library.name_label(COLLECTION, 11, "jaw", None).unwrap();
    // An unfinished propagation can be undone.
    correct(&library, &shapes[1]);
    library.relabel_next(Some(COLLECTION)).unwrap();
    library.merge_labels(COLLECTION, 11, 12, None).unwrap();

    let undo = || library.undo(COLLECTION, None).unwrap();
    assert_eq!(
        (undo().change, undo().change),
        ("merge".into(), "correct".into())
    );
    assert_eq!(snapshot(&library), states[1]);
    let name = |id: u32| {
        let labels = library.collection(COLLECTION).unwrap().labels;
        labels.into_iter().find(|l| l.id == id).unwrap().name
    };
    assert_eq!(name(11).as_deref(), Some("jaw"));
    assert_eq!(undo().change, "name");
    assert_eq!(name(11), None);
    // After the undo, a shape that was added after the correction is labelled by the discovered
    // labels.
    stream(&library, &shapes[5..]);
    let last = undo();
    assert_eq!((last.change.as_str(), last.n_left), ("correct", 0));
    propagate(&library);
    let mut now = snapshot(&library);
    let newcomer = now.remove(&shapes[5].name).unwrap();
    assert_eq!(now, states[0]);
    assert!(newcomer.0.iter().all(|l| (0..3).contains(l)));
    let nothing = library.undo(COLLECTION, None);
    assert!(
        matches!(
            &nothing,
            Err(LibraryError::FailedPrecondition {
                reason: Reason::NothingToUndo,
                ..
            })
        ),
        "{nothing:?}"
    );
    // The collection remains usable.
    correct(&library, &shapes[2]);
    propagate(&library);
    assert!(right(&library, &shapes, &[&shapes[2].name]) > 0.8);
}

#[test]
fn pinned_faces_never_change_by_themselves() {
    let shapes = family(Family::Pliers, 23, 12, &SMALL);
    let (folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes[..4]);
    // A tenth of one shape, at random with respect to its parts.
    let faces: Vec<u32> = (0..shapes[1].labels.len() as u32).step_by(10).collect();
    let some = Correction::Faces {
        faces: faces.clone(),
        label: 77,
    };
    library
        .correct(COLLECTION, &shapes[1].name, &some, None)
        .unwrap();
    propagate(&library);
    let kept = |library: &Library| {
        let labels = &all_labels(library)[&shapes[1].name];
        faces.iter().all(|f| labels[*f as usize] == 77)
    };
    assert!(kept(&library));
    let others: BTreeSet<i32> = all_labels(&library).into_values().flatten().collect();
    assert!(
        others.len() > 1,
        "a correction of a tenth leaves other labels: {others:?}"
    );
    correct(&library, &shapes[3]);
    stream(&library, &shapes[4..9]);
    assert!(kept(&library));
    drop(library);
    let library = Library::open(folder.path()).unwrap();
    correct(&library, &shapes[6]);
    stream(&library, &shapes[9..]);
    assert!(kept(&library));
    for s in [&shapes[3], &shapes[6]] {
        assert_eq!(all_labels(&library)[&s.name], truth(s));
    }
    // Only a person changes them.
    let part = Correction::Faces {
        faces: vec![faces[0]],
        label: 78,
    };
    library
        .correct(COLLECTION, &shapes[1].name, &part, None)
        .unwrap();
    assert_eq!(all_labels(&library)[&shapes[1].name][faces[0] as usize], 78);
}

#[test]
fn the_same_correction_again_has_one_effect_and_the_same_reply() {
    let shapes = family(Family::Pliers, 24, 3, &SMALL);
    let (_folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes);
    let key = RequestKey {
        client_id: "c".into(),
        request_id: "1".into(),
    };
    let correction = Correction::Whole(truth(&shapes[0]));
    let once = || library.correct(COLLECTION, &shapes[0].name, &correction, Some(&key));
    let first = once().unwrap();
    propagate(&library);
    let after = sequence(&library);
    assert_eq!(once().unwrap(), first);
    assert_eq!(sequence(&library), after);
    let other = library.correct(COLLECTION, &shapes[1].name, &correction, Some(&key));
    assert!(matches!(
        other,
        Err(LibraryError::FailedPrecondition {
            reason: Reason::RequestIdReused,
            ..
        })
    ));
}

#[test]
fn wrong_corrections_are_refused_and_change_nothing() {
    let shapes = family(Family::Pliers, 25, 2, &SMALL);
    let (_folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes);
    let n = shapes[0].labels.len();
    let name = &shapes[0].name;
    let since = sequence(&library);
    let mut range = vec![0; n];
    range[7] = -2;
    let mut large = vec![0; n];
    large[9] = 65_536;
    let faces = |f: u32, label: u32| Correction::Faces {
        faces: vec![f],
        label,
    };
    for (correction, message) in [
        (
            Correction::Whole(vec![1; n - 1]),
            format!(
                "{} labels were given, but shape {name:?} has {n} faces",
                n - 1
            ),
        ),
        (
            Correction::Whole(range),
            "the label of face 7 is -2, but must be -1 to 65535".into(),
        ),
        (
            Correction::Whole(large),
            "the label of face 9 is 65536, but must be -1 to 65535".into(),
        ),
        (
            Correction::Whole(vec![-1; n]),
            format!("no face of shape {name:?} is given a label, so nothing is corrected"),
        ),
        (
            Correction::Whole((0..n as i32).map(|i| i % 65).collect()),
            format!("collection {COLLECTION:?} would have 65 labels, the limit is 64"),
        ),
        (
            faces(n as u32, 1),
            format!("face {n} is named, but shape {name:?} has {n}"),
        ),
        (
            faces(0, 65_536),
            "the label is 65536, but must be at most 65535".into(),
        ),
        (
            Correction::Part {
                part: 999,
                label: 1,
            },
            format!(
                "part 999 is named, but shape {name:?} has {}",
                library.shape(COLLECTION, name).unwrap().parts.len()
            ),
        ),
    ] {
        let refused = library.correct(COLLECTION, name, &correction, None);
        assert_eq!(refused.unwrap_err().to_string(), message);
    }
    assert_eq!(kinds(&library, since), []);
}

#[test]
fn a_part_is_corrected_as_a_whole() {
    let shapes = family(Family::Pliers, 26, 5, &SMALL);
    let (_folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes);
    let name = &shapes[0].name;
    let part = &library.shape(COLLECTION, name).unwrap().parts[1];
    let correction = Correction::Part { part: 1, label: 40 };
    let done = library
        .correct(COLLECTION, name, &correction, None)
        .unwrap();
    assert!(
        (done.area_share - part.area_share).abs() < 0.05,
        "{done:?} {part:?}"
    );
    propagate(&library);
    let there = all_labels(&library)[name]
        .iter()
        .filter(|l| **l == 40)
        .count();
    assert!(there as u64 >= done.n_faces);
}

/// A coarse mesh has a finer proxy, most of whose faces stand for no polygon of the file.
#[test]
fn a_wholly_labelled_coarse_shape_keeps_no_label_that_nobody_gave() {
    let (_folder, library) = library(2, Up::Unknown);
    let egg = |stretch: f64| {
        let mut mesh = icosphere(2);
        for v in &mut mesh.vertices {
            *v = [v[0] * stretch, v[1], v[2] * (1.0 + 0.3 * v[0])];
        }
        mesh
    };
    for (name, stretch) in [("a", 1.5), ("b", 1.7), ("c", 1.9)] {
        library.add(COLLECTION, file(name, &egg(stretch))).unwrap();
    }
    let (description, ..) = library.labelled_proxy(COLLECTION, "a").unwrap();
    let view = description.view();
    assert!(view.faces.len() > 2 * view.face_map.len(), "it is coarse");
    let mesh = egg(1.5);
    let half = |face: &[u32; 3]| {
        let middle: f64 = face.iter().map(|v| mesh.vertices[*v as usize][0]).sum();
        if middle < 0.0 { 10 } else { 11 }
    };
    let halves = Correction::Whole(mesh.faces.iter().map(half).collect());
    library.correct(COLLECTION, "a", &halves, None).unwrap();
    for when in ["at once", "after it was propagated"] {
        let (_, labels, _) = library.labelled_proxy(COLLECTION, "a").unwrap();
        let used: BTreeSet<i32> = labels.iter().copied().collect();
        assert_eq!(used, BTreeSet::from([10, 11]), "{when}");
        let n_parts = library.shape(COLLECTION, "a").unwrap().parts.len();
        assert_eq!(n_parts, 2, "{when}");
        propagate(&library);
    }
}

/// A training shape that is removed before anything follows from it leaves nothing to fit to.
#[test]
fn a_correction_whose_shape_is_removed_at_once_leaves_all_labels() {
    let shapes = family(Family::Pliers, 34, 6, &SMALL);
    for n_steps in 0..2 {
        let (_folder, library) = library(3, Up::Unknown);
        stream(&library, &shapes[..4]);
        let mut before = all_labels(&library);
        correct(&library, &shapes[0]);
        for _ in 0..n_steps {
            assert!(library.relabel_next(Some(COLLECTION)).unwrap());
        }
        library.remove(COLLECTION, &shapes[0].name, None).unwrap();
        propagate(&library);
        before.remove(&shapes[0].name);
        assert_eq!(all_labels(&library), before, "after {n_steps} steps");
        stream(&library, &shapes[4..]);
        let used: BTreeSet<i32> = all_labels(&library).into_values().flatten().collect();
        assert_eq!(used, (0..3).collect(), "after {n_steps} steps");
    }
}

#[test]
fn labels_are_merged_and_split_on_all_shapes() {
    let shapes = family(Family::Pliers, 27, 6, &SMALL);
    let (_folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes);
    correct(&library, &shapes[0]);
    propagate(&library);
    let before = all_labels(&library);
    let (into, n) = library.merge_labels(COLLECTION, 10, 11, None).unwrap();
    assert_eq!((into.id, into.n_shapes), (11, 6));
    assert!(n > 0);
    let merged = |l: &i32| if *l == 10 { 11 } else { *l };
    for (name, labels) in all_labels(&library) {
        let expected: Vec<i32> = before[&name].iter().map(merged).collect();
        assert_eq!(labels, expected, "only the label that is merged changes");
    }
    let old = library.collection(COLLECTION).unwrap().labels;
    let old = old.iter().find(|l| l.id == 10).unwrap();
    assert_eq!((old.merged_into, old.n_shapes), (Some(11), 0));
    let again = library.merge_labels(COLLECTION, 10, 12, None);
    assert_eq!(
        again.unwrap_err().to_string(),
        "label 10 was merged into 11"
    );

    let since = sequence(&library);
    let (new, n) = library.split_label(COLLECTION, 11, None).unwrap();
    assert!(n > 0 && new.id > 12, "{new:?}");
    propagate(&library);
    let split = EventKind::LabelSplit {
        from: 11,
        into: vec![new.id],
    };
    assert!(kinds(&library, since).contains(&split));
    let used: BTreeSet<i32> = all_labels(&library).into_values().flatten().collect();
    assert_eq!(used, BTreeSet::from([11, 12, new.id as i32]));
    // Other labels by the person stay.
    let exemplar = &all_labels(&library)[&shapes[0].name];
    for (now, was) in exemplar.iter().zip(&before[&shapes[0].name]) {
        assert_eq!(*now == 12, *was == 12);
    }
    library.undo(COLLECTION, None).unwrap();
    library.undo(COLLECTION, None).unwrap();
    assert_eq!(all_labels(&library), before);
}

#[test]
fn an_addition_after_a_correction_computes_few_maps_and_relabels_nobody() {
    let shapes = family(Family::Pliers, 28, 9, &SMALL);
    let (_folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes[..7]);
    for s in &shapes[..4] {
        correct(&library, s);
    }
    propagate(&library);
    let before = all_labels(&library);
    let placed = library
        .add(COLLECTION, file(&shapes[7].name, &shapes[7].mesh))
        .unwrap();
    assert_eq!((placed.n_maps as usize, placed.n_relabelled), (MAX_MAPS, 0));
    let mut after = all_labels(&library);
    after.remove(&shapes[7].name);
    assert_eq!(after, before);
}

#[test]
fn when_the_correction_is_carried_makes_no_difference() {
    let shapes = family(Family::Pliers, 29, 9, &SMALL);
    let run = |eager: bool| {
        let (folder, library) = library(3, Up::Unknown);
        stream(&library, &shapes[..6]);
        for s in &shapes[..2] {
            correct(&library, s);
            if eager {
                propagate(&library);
            }
        }
        for s in &shapes[6..] {
            library.add(COLLECTION, file(&s.name, &s.mesh)).unwrap();
            if eager {
                propagate(&library);
            }
        }
        propagate(&library);
        drop(folder);
        all_labels(&library)
    };
    assert_eq!(run(true), run(false));
}

#[test]
fn the_next_suggestion_is_never_one_that_was_corrected() {
    let shapes = family(Family::Pliers, 30, 4, &SMALL);
    let (_folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes);
    let mut seen = BTreeSet::new();
    for n in 0..4 {
        let next = library.suggest(COLLECTION).unwrap();
        assert_eq!(next.n_corrected, n);
        assert!(seen.insert(next.shape.clone()) && !next.reason.is_empty());
        correct(
            &library,
            shapes.iter().find(|s| s.name == next.shape).unwrap(),
        );
        propagate(&library);
    }
    let none = library.suggest(COLLECTION).unwrap_err().to_string();
    assert_eq!(
        none,
        "collection \"shapes\" has 4 shapes, and a person labelled 4 of them"
    );
}

#[test]
fn without_its_exemplar_a_collection_keeps_its_labels() {
    let shapes = family(Family::Pliers, 31, 7, &SMALL);
    let (_folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes[..5]);
    correct(&library, &shapes[0]);
    propagate(&library);
    let mut before = all_labels(&library);
    library.remove(COLLECTION, &shapes[0].name, None).unwrap();
    propagate(&library);
    before.remove(&shapes[0].name);
    assert_eq!(all_labels(&library), before);
    stream(&library, &shapes[5..]);
    let used: BTreeSet<i32> = all_labels(&library).into_values().flatten().collect();
    assert_eq!(used, (10..13).collect());
}

#[test]
fn any_order_of_arrival_ends_within_a_point_of_the_batch() {
    let shapes = family(Family::Pliers, 32, 8, &SMALL);
    let run = |order: &[usize], corrected_at: usize| {
        let (_folder, library) = library(3, Up::Unknown);
        for (n, at) in order.iter().enumerate() {
            stream(&library, &shapes[*at..=*at]);
            if n == corrected_at {
                correct(&library, &shapes[0]);
            }
        }
        propagate(&library);
        right(&library, &shapes, &[&shapes[0].name])
    };
    // Compares corrections after all shapes are known with corrections of the first shape of a
    // stream, forwards and backwards.
    let batch = run(&[0, 1, 2, 3, 4, 5, 6, 7], 7);
    let streamed = [
        run(&[0, 1, 2, 3, 4, 5, 6, 7], 0),
        run(&[0, 7, 6, 5, 4, 3, 2, 1], 0),
    ];
    for score in streamed {
        assert!(
            (score - batch).abs() <= 0.01,
            "{streamed:?} against {batch:.4}"
        );
    }
}
