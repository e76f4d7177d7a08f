//! A person answers questions about parts and gives verdicts on shapes.

use crate::pipeline::{COLLECTION, SMALL, all_labels, library, propagate, stream};
use coseg::Library;
use coseg::library::{Answer, Correction, PartQuestion, Reason, ReviewState, Up};
use coseg::synth::{Family, Labelled, family};
use std::collections::{BTreeMap, BTreeSet};

fn ask(library: &Library) -> PartQuestion {
    library.next_question(COLLECTION, false).unwrap()
}

/// The known part that most faces of a question are of.
fn truth(shapes: &[Labelled], question: &PartQuestion) -> u32 {
    let shape = shapes.iter().find(|s| s.name == question.shape).unwrap();
    let mut counts = BTreeMap::<u32, usize>::new();
    for face in &question.faces {
        *counts.entry(shape.labels[*face as usize]).or_default() += 1;
    }
    *counts.iter().max_by_key(|c| c.1).unwrap().0
}

fn answer(library: &Library, question: &PartQuestion, answer: &Answer) -> Option<u32> {
    let part = (question.shape.as_str(), question.part);
    let done = library.answer(COLLECTION, part, answer, "ada", None);
    done.unwrap().label
}

fn review(library: &Library, shape: &str) -> ReviewState {
    library.shape(COLLECTION, shape).unwrap().review.state
}

#[test]
fn answers_pin_parts_and_name_labels_that_are_then_offered() {
    let shapes = family(Family::Pliers, 31, 6, &SMALL);
    let (_folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes);
    let mut ids = BTreeMap::<u32, u32>::new();
    let mut questions = BTreeSet::new();
    for n in 0..8 {
        let question = ask(&library);
        assert!(questions.insert((question.shape.clone(), question.part)));
        assert_eq!(question.n_answered, n);
        assert!(question.likeliest.len() <= 3 && !question.likeliest.is_empty());
        assert!((0.0..=1.0).contains(&question.doubt), "{question:?}");
        let part = truth(&shapes, &question);
        let name = format!("part {part}");
        let label = answer(&library, &question, &Answer::Named(name)).unwrap();
        assert_eq!(
            *ids.entry(part).or_insert(label),
            label,
            "a name has one id"
        );
        let labels = all_labels(&library);
        let pinned = &labels[&question.shape];
        let is_right = |face: &u32| pinned[*face as usize] == label as i32;
        assert!(question.faces.iter().all(is_right));
        assert_eq!(review(&library, &question.shape), ReviewState::Corrected);
    }
    let labels = library.collection(COLLECTION).unwrap().labels;
    for (part, id) in &ids {
        let found = labels.iter().find(|l| l.id == *id).unwrap();
        assert_eq!(found.name, Some(format!("part {part}")));
    }
    propagate(&library);
    let offered = ask(&library).likeliest;
    assert!(
        offered
            .iter()
            .any(|l| ids.values().any(|id| *id == l.label))
    );

    // The first answer is undone last, and the labels are those from before.
    for _ in 0..8 {
        let undone = library.undo(COLLECTION, None).unwrap();
        assert_eq!(undone.change, "answer");
        assert!(questions.iter().any(|(shape, _)| *shape == undone.subject));
    }
    for shape in &shapes {
        assert_eq!(review(&library, &shape.name), ReviewState::Unseen);
    }
    assert_eq!(ask(&library).n_answered, 0);
}

#[test]
fn a_new_name_is_that_of_the_discovered_label_unless_a_person_used_it() {
    let shapes = family(Family::Pliers, 37, 4, &SMALL);
    let (_folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes);
    let discovered = all_labels(&library);
    let first = ask(&library);
    let own = |question: &PartQuestion| {
        let of_shape = &discovered[&question.shape];
        let mut counts = BTreeMap::<i32, usize>::new();
        for face in &question.faces {
            *counts.entry(of_shape[*face as usize]).or_default() += 1;
        }
        *counts.iter().max_by_key(|c| c.1).unwrap().0 as u32
    };
    let label = answer(&library, &first, &Answer::Named("one".into())).unwrap();
    assert_eq!(label, own(&first), "most of the part has this label");
    let named = library.collection(COLLECTION).unwrap().labels;
    let row = named.iter().find(|l| l.id == label).unwrap();
    assert_eq!(row.name.as_deref(), Some("one"));
    // The other shapes have the label, and so the name, at once.
    let has_it = |s: &&Labelled| all_labels(&library)[&s.name].contains(&(label as i32));
    assert_eq!(shapes.iter().filter(has_it).count(), 4);
    // Another name for a part with the same label makes a new label.
    let second = loop {
        let question = ask(&library);
        if own(&question) == label {
            break question;
        }
        answer(&library, &question, &Answer::Skip);
    };
    let other = answer(&library, &second, &Answer::Named("two".into())).unwrap();
    assert!(!discovered.values().flatten().any(|l| *l == other as i32));
    library.undo(COLLECTION, None).unwrap();
    library.undo(COLLECTION, None).unwrap();
    let labels = library.collection(COLLECTION).unwrap().labels;
    let row = labels.iter().find(|l| l.id == label).unwrap();
    assert_eq!(row.name, None);
    assert_eq!(all_labels(&library), discovered);
}

#[test]
fn answers_on_many_shapes_together_leave_no_shown_label_unclaimed() {
    let shapes = family(Family::Pliers, 41, 6, &SMALL);
    let (_folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes);
    let discovered: BTreeSet<i32> = all_labels(&library).into_values().flatten().collect();
    assert_eq!(discovered.len(), 3);
    // To this person two of the three parts are one.
    let mut ids = BTreeSet::new();
    let mut unclaimed = Vec::new();
    for _ in 0..30 {
        let question = ask(&library);
        let name = match truth(&shapes, &question) {
            0 => "jaw",
            _ => "grip",
        };
        let label = answer(&library, &question, &Answer::Named(name.into())).unwrap();
        ids.insert(label as i32);
        propagate(&library);
        let now: BTreeSet<i32> = all_labels(&library).into_values().flatten().collect();
        unclaimed.push(now.difference(&ids).count());
    }
    assert_eq!(ids.len(), 2);
    assert_eq!(
        unclaimed.first(),
        Some(&2),
        "one of three labels has a name"
    );
    assert_eq!(unclaimed.last(), Some(&0), "{unclaimed:?}");
}

#[test]
fn the_next_question_does_not_wait_for_propagation() {
    let shapes = family(Family::Pliers, 32, 5, &SMALL);
    let (_folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes);
    let first = ask(&library);
    answer(&library, &first, &Answer::Named("handle".into()));
    let at_once = ask(&library);
    propagate(&library);
    let later = ask(&library);
    assert_eq!((&at_once.shape, at_once.part), (&later.shape, later.part));
}

#[test]
fn parts_that_are_passed_over_are_asked_about_again_on_request_only() {
    let shapes = family(Family::Pliers, 33, 3, &SMALL);
    let (_folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes);
    let before = all_labels(&library);
    let first = ask(&library);
    assert_eq!(answer(&library, &first, &Answer::Skip), None);
    let second = ask(&library);
    assert_ne!((&first.shape, first.part), (&second.shape, second.part));
    assert_eq!(answer(&library, &second, &Answer::CutWrongly), None);
    let again = library.next_question(COLLECTION, true).unwrap();
    assert_eq!((&again.shape, again.part), (&first.shape, first.part));
    while let Ok(question) = library.next_question(COLLECTION, false) {
        answer(&library, &question, &Answer::Skip);
    }
    let none = library.next_question(COLLECTION, false).unwrap_err();
    assert_eq!(
        coseg::library::Failure::from(&none).reason,
        Reason::NothingToAsk
    );
    assert_eq!(all_labels(&library), before, "nothing was labelled");
    assert!(library.undo(COLLECTION, None).is_err(), "nothing to undo");
}

#[test]
fn a_part_that_does_not_exist_is_refused() {
    let shapes = family(Family::Pliers, 34, 2, &SMALL);
    let (_folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes);
    let part = (shapes[0].name.as_str(), 400);
    let refused = library.answer(COLLECTION, part, &Answer::Label(0), "", None);
    let message = refused.unwrap_err().to_string();
    assert!(message.contains("part 400 is named"), "{message}");
    let unnamed = Answer::Named(String::new());
    let part = (shapes[0].name.as_str(), 0);
    assert!(
        library
            .answer(COLLECTION, part, &unnamed, "", None)
            .is_err()
    );
    let person = "x".repeat(129);
    let refused = library.answer(COLLECTION, part, &Answer::Label(0), &person, None);
    assert!(refused.is_err());
}

#[test]
fn approving_makes_the_present_labels_a_persons_and_is_undone_to_the_byte() {
    let shapes = family(Family::Pliers, 35, 5, &SMALL);
    let (folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes);
    let before = all_labels(&library);
    let name = shapes[1].name.clone();
    // A few painted faces, and the rest is right.
    let painted = Correction::Faces {
        faces: vec![0, 1, 2],
        label: 40,
    };
    library.correct(COLLECTION, &name, &painted, None).unwrap();
    propagate(&library);
    let present = all_labels(&library)[&name].clone();
    let done = library.approve(COLLECTION, &name, "ada", None).unwrap();
    assert_eq!(done.n_faces as usize, present.len());
    assert_eq!(done.changed_share, 0.0);
    assert_eq!(done.n_stale, 4);
    let shape = library.shape(COLLECTION, &name).unwrap();
    assert_eq!(
        (shape.review.state, shape.review.by.as_str()),
        (ReviewState::Approved, "ada")
    );
    assert!(shape.review.unix_ms > 1_600_000_000_000);
    propagate(&library);
    assert_eq!(all_labels(&library)[&name], present, "pinned");

    drop(library);
    let library = Library::open(folder.path()).unwrap();
    let in_state = |state| {
        let found = library.shapes_reviewed(COLLECTION, (0, 100), None, Some(state));
        let names = found.unwrap().into_iter().map(|s| s.name);
        names.collect::<Vec<String>>()
    };
    assert_eq!(in_state(ReviewState::Approved), std::slice::from_ref(&name));
    assert_eq!(in_state(ReviewState::Unseen).len(), 4);
    let undone = library.undo(COLLECTION, None).unwrap();
    assert_eq!(
        (undone.change.as_str(), &undone.subject),
        ("approve", &name)
    );
    assert_eq!(
        in_state(ReviewState::Corrected),
        std::slice::from_ref(&name)
    );
    library.undo(COLLECTION, None).unwrap();
    assert_eq!(in_state(ReviewState::Unseen).len(), 5);
    assert_eq!(all_labels(&library), before);
}

#[test]
fn a_doubtful_shape_keeps_its_labels() {
    let shapes = family(Family::Pliers, 36, 3, &SMALL);
    let (_folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes);
    let before = all_labels(&library);
    let name = &shapes[2].name;
    let verdict = library.doubt(COLLECTION, name, "bo", None).unwrap();
    assert_eq!(
        (verdict.state, verdict.by.as_str()),
        (ReviewState::Doubtful, "bo")
    );
    assert_eq!(review(&library, name), ReviewState::Doubtful);
    assert_eq!(all_labels(&library), before);
    let undone = library.undo(COLLECTION, None).unwrap();
    assert_eq!((undone.change.as_str(), &undone.subject), ("doubt", name));
    assert_eq!(review(&library, name), ReviewState::Unseen);
}
